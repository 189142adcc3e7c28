//! Builds a leaf from followed roots: finds clusters whose symmetric functions converge, expands and bounds them, and
//! arranges the coefficients.

use faer::{Mat, c64};

use super::build::Builder;
use super::cluster::{max_size, symmetric_curvatures, symmetric_functions, symmetric_slopes};
use super::derivatives::pairs;
use super::fit::{Basis, Fit, Fitted};
use super::samples::Sample;
use super::{Channels, Cluster, Leaf, MAX_AXES};

/// Factor by which error bounds exceed estimated and observed errors. Leaves are split until this many times the estimate is
/// within the tolerance.
const SAFETY: f64 = 4.0;
/// The factor of bounds with a contact state, which makes roots less smooth functions of the load: of 10⁴ held-out conditions
/// of a rig of 160 modes, roots at two were up to 5.4 times the estimate away.
const SAFETY_WITH_STATE: f64 = 12.0;
/// Required error of a charted pad participation; if it is not reached, the participation is NaN.
pub const SHARE_TOLERANCE: f64 = 1e-4;
/// Relative distance below which two roots are considered merging.
pub const MERGING: f64 = 1e-4;

/// The samples of a box, with their roots connected to branches.
pub struct Branches<'a> {
    pub samples: Vec<&'a Sample>,
    pub units: Vec<[f64; MAX_AXES]>,
    /// Half the width of the box along each axis.
    pub half: [f64; MAX_AXES],
    /// Index of the root, by `[sample][branch]`.
    pub roots: Vec<Vec<usize>>,
    /// Number of branches, which is the number of followed roots.
    pub count: usize,
    /// Rounding error of a well-conditioned root.
    pub rounding: f64,
    pub undamped: bool,
}

impl Branches<'_> {
    /// Number of real functions per symmetric function: those of `λ²` of an undamped model are real.
    fn parts(&self) -> usize {
        if self.undamped { 1 } else { 2 }
    }

    /// Value of a branch: `λ²` of an undamped model, `λ` of a damped one.
    fn z(&self, sample: usize, branch: usize) -> c64 {
        self.samples[sample].z[self.roots[sample][branch]]
    }

    /// Slope with respect to the unit coordinate of an axis.
    fn slope(&self, sample: usize, branch: usize, axis: usize) -> c64 {
        self.samples[sample].slopes[self.roots[sample][branch]][axis] * self.half[axis]
    }

    /// Second derivative with respect to the unit coordinates of axes `a` and `b`, `a ≤ b`.
    fn curvature(&self, sample: usize, branch: usize, [a, b]: [usize; 2]) -> c64 {
        let along = self.samples[sample].curvatures[self.roots[sample][branch]][b * (b + 1) / 2 + a];
        along * self.half[a] * self.half[b]
    }

    fn has_curvature(&self, sample: usize, branch: usize) -> bool {
        self.samples[sample].has_curvature(self.roots[sample][branch])
    }

    /// Condition number of the root of a branch.
    fn condition(&self, sample: usize, branch: usize) -> f64 {
        self.samples[sample].conditions[self.roots[sample][branch]]
    }
}

/// The symmetric functions of a cluster at the samples.
struct Sampled {
    /// Values and derivatives: rows by sample and derivative, columns by function and its real and imaginary part.
    data: Mat<f64>,
    /// Largest distance of a member from the mean.
    radius: f64,
    /// Largest imaginary part, relative, of a function of an undamped model.
    stray: f64,
    /// Whether the derivatives of all members are sound, by sample.
    sound: Vec<bool>,
    /// Allowed error of every function.
    allowed: Vec<f64>,
    /// Largest condition number of a single root; 1 for a cluster of several.
    condition: f64,
}

impl Builder<'_> {
    /// Clusters the branches of the band until every symmetric function converges. The error is the axis to split
    /// along.
    pub(super) fn cluster(&self, branches: &Branches<'_>, fit: &Fit) -> Result<Vec<(Vec<usize>, Expansion)>, usize> {
        let omega = |z: c64| if branches.undamped { (-z.re).max(0.0).sqrt() } else { z.im };
        let limit = self.options.band_max_hz.map_or(f64::INFINITY, |hz| hz * std::f64::consts::TAU);
        let in_band = |branch: usize| (0..branches.samples.len()).any(|k| omega(branches.z(k, branch)) <= limit);
        let most = max_size(self.chart.axes.len());
        let mut settled: Vec<(Vec<usize>, Expansion)> = vec![];
        let mut open: Vec<Vec<usize>> = (0..branches.count).filter(|&k| in_band(k)).map(|k| vec![k]).collect();
        while let Some(members) = open.pop() {
            let expansion = self.expand(branches, fit, &members);
            let Some(axis) = expansion.failing else {
                settled.push((members, expansion));
                continue;
            };
            if members.len() >= most {
                return Err(axis);
            }
            // The branch nearest to any member joins the cluster, with its own cluster if it has one.
            let nearest = (0..branches.count)
                .filter(|k| !members.contains(k))
                .map(|k| (closeness(branches, &members, k), k))
                .min_by(|a, b| a.0.total_cmp(&b.0));
            let Some((_, nearest)) = nearest else { return Err(axis) };
            let mut joined = members;
            let taken = |cluster: &Vec<usize>| cluster.contains(&nearest);
            if let Some(at) = settled.iter().position(|(cluster, _)| taken(cluster)) {
                joined.extend(settled.swap_remove(at).0);
            } else if let Some(at) = open.iter().position(taken) {
                joined.extend(open.swap_remove(at));
            } else {
                joined.push(nearest);
            }
            if joined.len() > most {
                return Err(axis);
            }
            open.push(joined);
        }
        Ok(settled)
    }

    /// Factor by which the error bounds of this model exceed estimated errors.
    fn safety(&self) -> f64 {
        if self.sampler.model.statics().is_some() { SAFETY_WITH_STATE } else { SAFETY }
    }

    /// Expands the symmetric functions of the branches `members`.
    fn expand(&self, branches: &Branches<'_>, fit: &Fit, members: &[usize]) -> Expansion {
        let (size, parts) = (members.len(), branches.parts());
        let Sampled { data, radius, stray, sound, allowed, condition } = self.sampled(branches, members);
        let mut expansion = Expansion { channels: vec![], errors: vec![0.0; size], degree: 0, failing: Some(0) };
        // Complex functions in an undamped model: the conjugate of a member is not in the cluster.
        if stray > 1e-6 {
            return expansion;
        }
        let fitted = if sound.iter().all(|&sound| sound) {
            fit.expand(data)
        } else {
            match Fit::new(&self.chart.basis, &branches.units, &sound) {
                Some(fit) => fit.expand(data),
                None => return expansion,
            }
        };
        let mut failing: Option<(f64, usize)> = None;
        for k in 0..size {
            let floor = branches.rounding * size as f64 * condition * radius.max(branches.rounding).powi(k as i32);
            for fitted in &fitted[k * parts..(k + 1) * parts] {
                expansion.errors[k] += self.safety() * fitted.missing + floor;
                let missing = SAFETY * fitted.missing;
                let excess = missing / (allowed[k] / parts as f64 + 8.0 * floor);
                if excess.is_nan() || excess > 1.0 && failing.is_none_or(|(worst, _)| excess > worst) {
                    failing = Some((excess, fitted.worst_axis));
                }
            }
        }
        expansion.channels = fitted.into_iter().map(|fitted| fitted.coefficients).collect();
        let degree = self.truncate(&mut expansion, &allowed, parts);
        expansion.degree = degree;
        expansion.failing = failing.map(|(_, axis)| axis);
        expansion
    }

    /// The symmetric functions of the branches `members` and their derivatives at the samples.
    fn sampled(&self, branches: &Branches<'_>, members: &[usize]) -> Sampled {
        let (axes, size, count) = (self.chart.axes.len(), members.len(), branches.samples.len());
        let parts = branches.parts();
        // A relative error of `λ` counts twice in `λ²`.
        let tolerance = self.options.tolerance / parts as f64;
        let per_point = Basis::orders(axes).len();
        let mut data = Mat::zeros(count * per_point, size * parts);
        let (mut radius, mut stray) = (0.0f64, 0.0f64);
        let mut sound = vec![true; count];
        let mut allowed = vec![f64::INFINITY; size];
        let mut condition = 1.0f64;
        for node in 0..count {
            let z: Vec<c64> = members.iter().map(|&k| branches.z(node, k)).collect();
            let functions = symmetric_functions(&z);
            sound[node] = members.iter().all(|&k| branches.samples[node].is_sound(branches.roots[node][k]));
            radius = z.iter().map(|z| (z - functions[0]).norm()).fold(radius, f64::max);
            if size == 1 {
                condition = condition.max(branches.condition(node, members[0]));
            }
            allow(&z, functions[0], tolerance, &mut allowed);
            if parts == 1 {
                let imaginary = |function: &c64| function.im.abs() / function.norm().max(f64::MIN_POSITIVE);
                stray = functions.iter().map(imaginary).fold(stray, f64::max);
            }
            let along = |axis: usize| -> Vec<c64> { members.iter().map(|&k| branches.slope(node, k, axis)).collect() };
            let slopes: Vec<Vec<c64>> = (0..axes).map(along).collect();
            let curved = |pair: [usize; 2]| -> Vec<c64> {
                let curvatures: Vec<c64> = members.iter().map(|&k| branches.curvature(node, k, pair)).collect();
                symmetric_curvatures(&z, &slopes[pair[0]], &slopes[pair[1]], &curvatures)
            };
            let derived = slopes.iter().map(|dz| symmetric_slopes(&z, dz)).chain(pairs(axes).map(curved));
            for (row, values) in std::iter::once(functions).chain(derived).enumerate() {
                for (k, value) in values.into_iter().enumerate() {
                    data[(node * per_point + row, k * parts)] = value.re;
                    if parts == 2 {
                        data[(node * per_point + row, k * parts + 1)] = value.im;
                    }
                }
            }
        }
        Sampled { data, radius, stray, sound, allowed, condition }
    }

    /// Truncates all functions of a cluster at a common degree, adds what is dropped to their error bounds, and returns
    /// the degree. The sum of the magnitudes of the dropped coefficients bounds the error. The bound is attained if one
    /// of them dominates: errors equal to their bound have been observed. The dropped sum is at most 0.1 of the allowed
    /// error.
    fn truncate(&self, expansion: &mut Expansion, allowed: &[f64], parts: usize) -> usize {
        let columns = expansion.channels.len();
        let basis = &self.chart.basis;
        let beyond = |column: usize, degree: usize| basis.beyond(&expansion.channels[column], degree);
        let enough =
            |degree: &usize| (0..columns).all(|column| beyond(column, *degree) <= 0.1 * allowed[column / parts]);
        let degree = (0..basis.degree()).find(enough).unwrap_or(basis.degree());
        for column in 0..columns {
            expansion.errors[column / parts] += basis.beyond(&expansion.channels[column], degree);
        }
        degree
    }

    /// Expands the remainders of the traces and the pad participations, and arranges all coefficients as a leaf. The
    /// error is the axis to split along.
    pub(super) fn assemble(
        &self,
        branches: &Branches<'_>,
        settled: Vec<(Vec<usize>, Expansion)>,
        low: &[f64; MAX_AXES],
        high: &[f64; MAX_AXES],
    ) -> Result<Leaf, usize> {
        let (remainders, remainder_errors) = self.expand_remainders(branches, &settled)?;
        let shares = self.shares(branches, &settled);
        let (clusters, functions, auxiliary) = self.arrange(settled, remainders, shares);
        Ok(Leaf { low: *low, high: *high, clusters, tracked: branches.count, functions, auxiliary, remainder_errors })
    }

    /// Coefficients and error bounds of the remainders of both traces. The error is the axis to split along.
    fn expand_remainders(
        &self,
        branches: &Branches<'_>,
        settled: &[(Vec<usize>, Expansion)],
    ) -> Result<(Vec<Vec<f64>>, [f64; 2]), usize> {
        let (rest, largest) = self.remainders(branches, settled);
        let sound: Vec<bool> = (0..branches.samples.len())
            .map(|node| {
                let members = || settled.iter().flat_map(|(members, _)| members);
                members().all(|&k| branches.condition(node, k) < 1e5 && branches.has_curvature(node, k))
            })
            .collect();
        let Some(fit) = Fit::new(&self.chart.basis, &branches.units, &sound) else { return Err(0) };
        let mut remainders = vec![];
        let mut remainder_errors = [0.0; 2];
        for (k, fitted) in fit.expand(rest).into_iter().enumerate() {
            let floor = 64.0 * f64::EPSILON * largest[k] * self.sampler.model.dimension() as f64;
            remainder_errors[k] = self.safety() * fitted.missing + floor;
            let converged = SAFETY * fitted.missing <= 1e-6 * largest[k] + floor;
            if !converged {
                return Err(fitted.worst_axis);
            }
            remainders.push(fitted.coefficients);
        }
        Ok((remainders, remainder_errors))
    }

    /// What both traces and their derivatives leave after the charted roots, with a column for each trace, and the
    /// largest magnitude of each trace; at least `|C|` for the first one, because that of a gyroscopic matrix vanishes.
    fn remainders(&self, branches: &Branches<'_>, settled: &[(Vec<usize>, Expansion)]) -> (Mat<f64>, [f64; 2]) {
        let axes = self.chart.axes.len();
        let weight = if branches.undamped { 1.0 } else { 2.0 };
        let per_point = Basis::orders(axes).len();
        let mut rest = Mat::zeros(branches.samples.len() * per_point, 2);
        let mut largest = [0.0f64; 2];
        for (node, sample) in branches.samples.iter().enumerate() {
            let row = node * per_point;
            let [_, damping, _] = sample.totals.norms;
            largest[0] = largest[0].max(damping);
            for k in 0..2 {
                largest[k] = largest[k].max(sample.totals.powers[k].abs());
                rest[(row, k)] = sample.totals.powers[k];
                for axis in 0..axes {
                    rest[(row + 1 + axis, k)] = sample.total_slopes[axis][k] * branches.half[axis];
                }
                for (pair, [a, b]) in pairs(axes).enumerate() {
                    let scale = branches.half[a] * branches.half[b];
                    rest[(row + 1 + axes + pair, k)] = sample.total_curvatures[pair][k] * scale;
                }
            }
            for &branch in settled.iter().flat_map(|(members, _)| members) {
                let z = branches.z(node, branch);
                rest[(row, 0)] -= weight * z.re;
                rest[(row, 1)] -= weight * (z * z).re;
                for axis in 0..axes {
                    let slope = branches.slope(node, branch, axis);
                    rest[(row + 1 + axis, 0)] -= weight * slope.re;
                    rest[(row + 1 + axis, 1)] -= weight * 2.0 * (z * slope).re;
                }
                for (pair, [a, b]) in pairs(axes).enumerate() {
                    let curvature = branches.curvature(node, branch, [a, b]);
                    let slopes = branches.slope(node, branch, a) * branches.slope(node, branch, b);
                    rest[(row + 1 + axes + pair, 0)] -= weight * curvature.re;
                    rest[(row + 1 + axes + pair, 1)] -= weight * 2.0 * (z * curvature + slopes).re;
                }
            }
        }
        (rest, largest)
    }

    /// Arranges clusters and channels: those of the symmetric functions, and those of remainders and pad participations.
    fn arrange(
        &self,
        settled: Vec<(Vec<usize>, Expansion)>,
        remainders: Vec<Vec<f64>>,
        shares: Vec<Option<(usize, Vec<f64>)>>,
    ) -> (Vec<Cluster>, Channels, Channels) {
        let degree = self.chart.basis.degree();
        let mut auxiliary: Vec<(usize, Option<usize>, Vec<f64>)> =
            remainders.into_iter().map(|coefficients| (degree, None, coefficients)).collect();
        let mut functions = vec![];
        let (mut clusters, mut lowest) = (vec![], vec![]);
        for (k, ((members, expansion), share)) in settled.into_iter().zip(shares).enumerate() {
            lowest.push(members.iter().copied().min());
            let Expansion { channels, errors, degree, .. } = expansion;
            functions.push((degree, k, channels));
            auxiliary.extend(share.map(|(degree, channel)| (degree, Some(k), channel)));
            clusters.push(Cluster { channel: 0, errors, share: None });
        }
        // Channels of high degree come first, so that the channels with coefficients of a degree are contiguous.
        functions.sort_by_key(|(degree, ..)| std::cmp::Reverse(*degree));
        auxiliary.sort_by_key(|(degree, ..)| std::cmp::Reverse(*degree));
        let mut columns = vec![];
        for (degree, k, channels) in functions {
            clusters[k].channel = columns.len();
            columns.extend(channels.into_iter().map(|channel| (degree, channel)));
        }
        for (place, (_, cluster, _)) in auxiliary.iter().enumerate() {
            if let Some(k) = *cluster {
                clusters[k].share = Some(place);
            }
        }
        let auxiliary: Vec<_> = auxiliary.into_iter().map(|(degree, _, channel)| (degree, channel)).collect();
        // Clusters nearly in order of frequency, which makes sorting the roots fast.
        let mut clusters: Vec<_> = lowest.into_iter().zip(clusters).collect();
        clusters.sort_by_key(|(lowest, _)| *lowest);
        let clusters = clusters.into_iter().map(|(_, cluster)| cluster).collect();
        (clusters, Channels::new(&self.chart.basis, &columns), Channels::new(&self.chart.basis, &auxiliary))
    }

    /// Degree and coefficients of the pad participation of every single root, where they converge. Slopes of
    /// participations are not available, so the degree is limited by the number of points.
    fn shares(&self, branches: &Branches<'_>, settled: &[(Vec<usize>, Expansion)]) -> Vec<Option<(usize, Vec<f64>)>> {
        let axes = self.chart.axes.len();
        let points = branches.units.len();
        let degree = (0..=self.chart.basis.degree())
            .take_while(|&degree| 4 * Basis::new(axes, degree).len() <= 3 * points)
            .last()
            .unwrap_or(0);
        let basis = Basis::new(axes, degree);
        let alone: Vec<usize> =
            settled.iter().map(|(members, _)| if members.len() == 1 { members[0] } else { usize::MAX }).collect();
        let Some(fit) = Fit::new(&basis, &branches.units, &vec![false; points]) else {
            return vec![None; settled.len()];
        };
        let share = |node: usize, branch: usize| match alone[branch] {
            usize::MAX => f64::NAN,
            branch => branches.samples[node].spectrum.roots[branches.roots[node][branch]].pad_participation,
        };
        let per_point = Basis::orders(axes).len();
        let data = Mat::from_fn(points * per_point, settled.len(), |row, k| {
            if row % per_point == 0 { share(row / per_point, k) } else { 0.0 }
        });
        // The comparison is false for NaN, which marks a participation that is not available.
        let converged = |fitted: &Fitted| SAFETY * fitted.missing <= SHARE_TOLERANCE;
        fit.expand(data).into_iter().map(|f| converged(&f).then_some((degree, f.coefficients))).collect()
    }
}

/// Lowers `allowed` to the errors of the symmetric functions of the roots `z` that keep each root within the
/// tolerance. The nearest other root is taken to be [`MERGING`] away, however far it is.
fn allow(z: &[c64], mean: c64, tolerance: f64, allowed: &mut [f64]) {
    let size = mean.norm();
    allowed[0] = allowed[0].min(if z.len() == 1 { 0.8 } else { 0.4 } * tolerance * size);
    for (i, &root) in z.iter().enumerate() {
        let mut gaps: Vec<f64> = (0..z.len()).filter(|&j| j != i).map(|j| (z[j] - root).norm()).collect();
        gaps.sort_by(f64::total_cmp);
        let near = MERGING * size;
        let product: f64 =
            gaps.iter().enumerate().map(|(rank, &gap)| if rank == 0 { near } else { gap.max(near) }).product();
        let reach = (root - mean).norm().max(near);
        for (m, allowed) in allowed.iter_mut().enumerate().skip(1) {
            let weight = reach.powi((z.len() - 1 - m) as i32) * (2 * z.len() * (z.len() - 1)) as f64;
            *allowed = allowed.min(tolerance * size * product / weight);
        }
    }
}

/// Smallest relative distance of branch `k` from any of `members` or its complex conjugate, over all samples.
fn closeness(branches: &Branches<'_>, members: &[usize], k: usize) -> f64 {
    let gap = |node: usize| {
        let z = branches.z(node, k);
        let member = |&j: &usize| {
            let other = branches.z(node, j);
            (other - z).norm().min((other.conj() - z).norm())
        };
        members.iter().map(member).fold(f64::INFINITY, f64::min) / z.norm()
    };
    (0..branches.samples.len()).map(gap).fold(f64::INFINITY, f64::min)
}

/// Expansions of the symmetric functions of a cluster.
pub struct Expansion {
    /// Coefficients of each function, real and imaginary part separately for a damped model.
    channels: Vec<Vec<f64>>,
    /// Error bound of each function.
    errors: Vec<f64>,
    /// Truncation degree: coefficients of higher total degree are not needed.
    degree: usize,
    /// The axis along which it converges worst, if it does not converge.
    failing: Option<usize>,
}

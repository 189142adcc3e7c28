//! Identities of modes. They are assigned only here, in the same way for solved and charted modes.
//!
//! A [`StabilityMap`] follows every root by its shape from friction coefficient 0, where identities ascend in
//! frequency. Between two nodes of the map the followed roots are interpolated. A mode takes the identity of the
//! interpolated root with the same rank in frequency. Rank is unreliable where two frequencies are close but the
//! growth rates are not. Two modes therefore exchange identities if the difference of their roots points opposite to
//! the difference of the two interpolated roots; an error common to both cancels in the differences. Only the values
//! of the roots are used, so solved and charted modes get the same identities.

use faer::c64;

use super::spectrum::{Root, Spectrum, square_root};
use super::stability_map::{Node, StabilityMap};
use super::summary::Mode;
use super::tracking::tracked;

/// Two roots closer than this, relative, cannot be distinguished on a chart; they keep the order of the interpolated
/// roots.
const TOGETHER: f64 = 1e-7;
/// Maximum deviation of an interpolated root from a straight line, relative to the distance to its nearest neighbour.
const STRAY: f64 = 0.25;
/// Maximum difference in rank of two modes that may exchange identities.
const REACH: usize = 3;
/// Followed roots that stay above the highest mode by this factor are counted but not interpolated.
const ABOVE: f64 = 1.2;
/// First of the identities given to modes that no node of the map has.
const UNKNOWN: u32 = 1_000_000;

/// A followed root between two neighbouring nodes.
#[derive(Clone, Copy, Debug)]
struct Path {
    id: u32,
    course: Course,
    /// The lower of its frequencies at the two nodes, rad/s.
    lowest: f64,
}

/// The interpolated quantity of a followed root between two nodes. It is kept here, in the order in which it is read,
/// because every prediction reads all of it.
#[derive(Clone, Copy, Debug)]
enum Course {
    /// The root is followed at both nodes: its value at the left one and its change to the right one. A curved course
    /// is the cubic through values and slopes, else it is a straight line, which crosses only those neighbours that
    /// it also crosses at the nodes.
    Through { from: c64, change: c64, bends: Option<[c64; 2]> },
    /// It is followed at the left node only.
    Left(c64),
    /// It is followed at the right node only.
    Right(c64),
}

/// The followed roots between two neighbouring nodes of a map.
#[derive(Clone, Debug)]
struct Span {
    paths: Vec<Path>,
    /// Number of followed roots at each of the two nodes.
    followed: [usize; 2],
}

/// The followed roots between every two neighbouring nodes of a map.
#[derive(Clone, Debug, Default)]
pub(super) struct Numbering {
    spans: Vec<Span>,
}

/// A followed root, interpolated to a friction coefficient.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Followed {
    id: u32,
    /// `λ²` of an undamped model, `λ` of a damped one.
    z: c64,
    /// Sort key: `ω` of a mode, `-|λ|` of a static root.
    rank: f64,
    growth: f64,
}

/// Numbers of roots at a point, which are needed to number the modes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Census {
    /// Whether all damping is zero.
    pub undamped: bool,
    /// Number of followed roots, in the band or not.
    pub tracked: usize,
    /// Number of followed roots that are static.
    pub statics: usize,
}

impl Census {
    /// The census of a spectrum.
    pub fn of(spectrum: &Spectrum) -> Self {
        let tracked = tracked(spectrum);
        Self { undamped: spectrum.undamped, tracked, statics: tracked - spectrum.mode_count }
    }
}

impl Numbering {
    /// Connects the roots of neighbouring nodes of a map.
    pub(super) fn new(nodes: &[Node]) -> Self {
        let gaps: Vec<Vec<f64>> = nodes.iter().map(|node| gaps(&node.spectrum)).collect();
        let span = |k: usize| {
            let (left, right) = (&nodes[k], nodes.get(k + 1).unwrap_or(&nodes[k]));
            let mut at_right: Vec<Option<usize>> = vec![];
            for (j, id) in right.ids.iter().enumerate().filter_map(|(j, id)| Some((j, (*id)? as usize))) {
                at_right.resize(at_right.len().max(id + 1), None);
                at_right[id] = Some(j);
            }
            let mut paths: Vec<Path> = vec![];
            let omega = |node: &Node, k: usize| node.spectrum.roots[k].lambda.im;
            for (i, id) in left.ids.iter().enumerate().filter_map(|(i, id)| Some((i, (*id)?))) {
                let there = at_right.get_mut(id as usize).and_then(Option::take);
                let lowest = there.map_or(f64::INFINITY, |j| omega(right, j)).min(omega(left, i));
                let course = there.map_or_else(
                    || Course::Left(value(&left.spectrum, i)),
                    |j| {
                        let gap = gaps[k][i].min(gaps[(k + 1).min(nodes.len() - 1)][j]);
                        Course::through(left, i, right, j, gap)
                    },
                );
                paths.push(Path { id, course, lowest });
            }
            for (id, j) in at_right.iter().enumerate().filter_map(|(id, &j)| Some((id as u32, j?))) {
                let course = Course::Right(value(&right.spectrum, j));
                paths.push(Path { id, course, lowest: omega(right, j) });
            }
            Span { paths, followed: [left, right].map(|node| node.ids.iter().flatten().count()) }
        };
        let spans = if nodes.len() == 1 { 1 } else { nodes.len().saturating_sub(1) };
        Self { spans: (0..spans).map(span).collect() }
    }

    /// Writes the followed roots at friction coefficient `mu` to `out`, sorted by rank. If the two neighbouring nodes
    /// have different numbers of followed roots, those of the node with `tracked` roots are used; beyond the nodes,
    /// those of the last node. Roots that stay above `highest`, rad/s, are counted but not written. Returns the
    /// number of all followed roots.
    fn at(&self, nodes: &[Node], mu: f64, tracked: usize, highest: f64, out: &mut Vec<Followed>) -> usize {
        out.clear();
        let after = nodes.partition_point(|node| node.mu() < mu);
        let k = after.saturating_sub(1).min(self.spans.len().saturating_sub(1));
        let (Some(left), Some(right)) = (nodes.get(k), nodes.get(k + 1).or(nodes.last())) else { return 0 };
        let Some(span) = self.spans.get(k) else { return 0 };
        let step = right.mu() - left.mu();
        let share = if step > 0.0 { ((mu - left.mu()) / step).clamp(0.0, 1.0) } else { 0.0 };
        let undamped = left.spectrum.undamped;
        let from_left = match span.followed.map(|count| count == tracked) {
            [true, false] => true,
            [false, true] => false,
            [true, true] | [false, false] => share <= 0.5,
        };
        let mut count = 0;
        for path in &span.paths {
            let z = match path.course {
                Course::Through { .. } if path.lowest > highest => {
                    count += 1;
                    continue;
                }
                Course::Through { from, change, bends } => between(from, change, bends, share),
                Course::Left(z) if from_left => z,
                Course::Right(z) if !from_left => z,
                Course::Left(_) | Course::Right(_) => continue,
            };
            let lambda = if undamped { square_root(z) } else { z };
            let rank = if lambda.im > 0.0 { lambda.im } else { -lambda.re.abs() };
            count += 1;
            out.push(Followed { id: path.id, z, rank, growth: lambda.re });
        }
        out.sort_unstable_by(|a, b| {
            a.rank.total_cmp(&b.rank).then(b.growth.total_cmp(&a.growth)).then(a.id.cmp(&b.id))
        });
        count
    }
}

impl StabilityMap {
    /// Assigns identities to `modes`, the lowest modes at friction coefficient `mu`, without gaps and ordered as in a
    /// [`Spectrum`]. `followed` is a work array.
    pub fn number(&self, mu: f64, census: Census, modes: &mut [Mode], followed: &mut Vec<Followed>) {
        let comparable = self.nodes.first().is_some_and(|node| node.spectrum.undamped == census.undamped);
        if !comparable {
            modes.iter_mut().enumerate().for_each(|(k, mode)| mode.id = k as u32);
            return;
        }
        let highest = modes.last().map_or(0.0, |mode| mode.root.lambda.im);
        let all = self.numbering.at(&self.nodes, mu, census.tracked, ABOVE * highest, followed);
        // Modes that become static disappear at the low end of the ranks, so modes are counted from the high end.
        let missing = census.tracked as isize - all as isize;
        let place = |k: usize| usize::try_from((k + census.statics) as isize - missing).ok();
        let at = |k: usize| place(k).filter(|&place| place < followed.len());
        for (k, mode) in modes.iter_mut().enumerate() {
            mode.id = at(k).map_or(UNKNOWN + k as u32, |place| followed[place].id);
        }
        let (Some(first), Some(place)) =
            (modes.iter().position(|mode| mode.id < UNKNOWN), (0..modes.len()).find_map(at))
        else {
            return;
        };
        let count = (modes.len() - first).min(followed.len() - place);
        let (modes, followed) = (&mut modes[first..first + count], &mut followed[place..place + count]);
        let z = |root: &Root| if census.undamped { root.square } else { root.lambda };
        for _ in 0..count {
            let mut settled = true;
            // Not only direct neighbours: the two modes of a flutter pair have one frequency, and another mode may
            // lie between them in rank.
            for (k, apart_by) in (1..=REACH).flat_map(|by| (by..count).map(move |k| (k, by))) {
                let before = k - apart_by;
                let (here, there) = (z(&modes[before].root), z(&modes[k].root));
                let (off, expected) = (there - here, followed[k].z - followed[before].z);
                let against = (off * expected.conj()).re < 0.0;
                let apart = || off.norm() > TOGETHER * there.norm();
                if against && apart() && self.in_band(&modes[before].root) == self.in_band(&modes[k].root) {
                    followed.swap(before, k);
                    settled = false;
                }
            }
            if settled {
                break;
            }
        }
        modes.iter_mut().zip(followed).for_each(|(mode, followed)| mode.id = followed.id);
    }

    /// Identities of the roots of `spectrum`, which must be solved at this map's load and speed or close to them;
    /// `None` for roots that are not followed.
    pub fn ids(&self, spectrum: &Spectrum) -> Vec<Option<u32>> {
        let mut modes: Vec<Mode> = spectrum.modes().iter().map(|&root| Mode { id: 0, root }).collect();
        let mut followed = vec![];
        let census = Census::of(spectrum);
        self.number(spectrum.point.friction_coefficient, census, &mut modes, &mut followed);
        let mut ids: Vec<Option<u32>> = modes.iter().map(|mode| Some(mode.id)).collect();
        // Static roots of an undamped model have the lowest ranks.
        let statics = followed.iter().take(census.statics).map(|followed| Some(followed.id));
        ids.extend(statics);
        ids.resize(spectrum.roots.len(), None);
        ids
    }

    /// Whether the frequency of a root lies in the band.
    fn in_band(&self, root: &Root) -> bool {
        self.band_max_hz.is_none_or(|max_hz| root.frequency_hz() <= max_hz)
    }
}

/// The interpolated quantity: `λ²` of an undamped model, `λ` of a damped one.
pub(crate) fn value(spectrum: &Spectrum, k: usize) -> c64 {
    let root = &spectrum.roots[k];
    if spectrum.undamped { root.square } else { root.lambda }
}

/// Derivative of the interpolated quantity with respect to the friction coefficient.
fn slope(spectrum: &Spectrum, k: usize) -> c64 {
    let of_square = spectrum.friction_sensitivity[k];
    if spectrum.undamped { of_square } else { of_square / (2.0 * spectrum.roots[k].lambda) }
}

impl Course {
    /// The course from root `i` of `left` to root `j` of `right`. It is curved where the cubic stays close to the straight
    /// line compared with `gap`, the distance to the nearest neighbour.
    fn through(left: &Node, i: usize, right: &Node, j: usize, gap: f64) -> Self {
        let (step, left, right) = (right.mu() - left.mu(), &left.spectrum, &right.spectrum);
        let from = value(left, i);
        let change = value(right, j) - from;
        let bends = [(left, i), (right, j)].map(|(spectrum, k)| step * slope(spectrum, k) - change);
        // The maximum of `s (1 - s)²` is 4/27.
        let stray = 4.0 / 27.0 * (bends[0].norm() + bends[1].norm());
        Self::Through { from, change, bends: (stray <= STRAY * gap).then_some(bends) }
    }
}

/// A root interpolated at fraction `share` between two nodes: by a cubic if there are `bends`, else linearly.
fn between(from: c64, change: c64, bends: Option<[c64; 2]>, share: f64) -> c64 {
    let line = from + share * change;
    let Some([at_left, at_right]) = bends else { return line };
    let rest = 1.0 - share;
    line + share * rest * (rest * at_left - share * at_right)
}

/// Distance of each followed root to its nearest neighbour.
pub(crate) fn gaps(spectrum: &Spectrum) -> Vec<f64> {
    let count = tracked(spectrum);
    let gap = |k: usize| {
        let others = (0..count).filter(|&j| j != k);
        others.map(|j| (value(spectrum, j) - value(spectrum, k)).norm()).fold(f64::INFINITY, f64::min)
    };
    (0..count).map(gap).collect()
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use faer::Mat;

    use super::super::law::{ContactLaw, CustomLaw, Law};
    use super::super::model::{Model, Term};
    use super::super::operating_point::OperatingPoint;
    use super::super::solver::Solver;
    use super::super::spectrum::Vectors;
    use super::super::stability_map::MapOptions;
    use super::*;

    /// Two coordinates that nothing couples: `k = k_0(μ)` with damping `c`, and `k = 110` with damping `-c/10`. Their
    /// shapes tell them apart wherever they cross. The band excludes both, so that the map has no nodes close to a
    /// crossing.
    fn crossing(k_0: fn(f64) -> f64, c: f64, [from, to]: [f64; 2]) {
        let entry =
            |place: usize, value: f64| Mat::from_fn(2, 2, |i, j| if i == place && j == place { value } else { 0.0 });
        let law = CustomLaw {
            text: "k_0".to_owned(),
            evaluate: Arc::new(move |p: &OperatingPoint| k_0(p.friction_coefficient)),
            depends_on_load: false,
            depends_on_speed: false,
            depends_on_friction: true,
        };
        let constant = |matrix| Term { matrix, law: Law::Constant };
        let stiffness = vec![Term { matrix: entry(0, 1.0), law: Law::Custom(law) }, constant(entry(1, 110.0))];
        let damping = vec![constant(entry(0, c)), constant(entry(1, -0.1 * c))];
        let model = Model::new(2, stiffness, damping, ContactLaw::default(), None).unwrap();
        let options = MapOptions {
            mu_min: 0.0,
            mu_max: 1.0,
            band_max_hz: Some(0.1),
            instability_threshold: 1e-6,
            windows: false,
        };
        let at = OperatingPoint { normal_load_n: 500.0, disc_speed_rad_s: 13.0, friction_coefficient: 0.0 };
        let mut solver = Solver::new(2);
        let map = StabilityMap::build(&model, &mut solver, &at, &options).unwrap();
        assert!(map.nodes.len() < 40, "{}", map.nodes.len());
        let mut orders = [0; 2];
        for k in 0..=40 {
            let mu = from + (to - from) * f64::from(k) / 40.0;
            let spectrum = solver.solve(&model, &at.with_friction(mu), Vectors::Both).unwrap();
            assert_eq!(map.ids(&spectrum), map.identify(&spectrum), "friction coefficient {mu}");
            orders[usize::from(spectrum.shapes[(0, 0)].norm() > 0.5)] += 1;
        }
        assert!(orders.iter().all(|&count| count > 5), "{orders:?}");
    }

    /// Undamped roots cross where a parabola does, between two nodes; a straight line between these crosses 1e-4 away.
    #[test]
    fn undamped_roots_cross_where_the_curves_through_the_nodes_do() {
        crossing(|mu| 100.0 + 25.0 * mu * mu, 0.0, [0.632_43, 0.632_48]);
    }

    /// Where two damped roots have the same frequency, their growth rates differ: which frequency the interpolation
    /// finds higher does not decide. The sine crosses 110 near 0.14, and a cubic 1e-5 away.
    #[test]
    fn damped_roots_keep_their_identities_where_frequencies_cross() {
        // `ω² = k - c²/4` of each.
        let crosses = (std::f64::consts::PI - ((10.0 - 0.000_625 + 0.0625) / 30.0_f64).asin()) / 20.0;
        crossing(|mu| 100.0 + 30.0 * (20.0 * mu).sin(), 0.5, [crosses - 2e-5, crosses + 2e-5]);
    }
}

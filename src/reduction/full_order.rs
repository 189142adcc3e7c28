//! Complex eigenvalues of a full model, `(λ² M + λ C + K) x = 0`, `C` and `K` of any symmetry.
//!
//! Around a shift `s = iω` the problem is inverted, and Krylov-Schur (`krylov_schur`) finds the largest eigenvalues of the
//! inverse: the roots nearest to the shift, and how far from it all of them are found. Undamped, in `κ = -λ²`:
//!
//! ```text
//! x -> (K - ω² M)⁻¹ M x,   θ = 1/(κ - ω²)
//! ```
//!
//! real and of size `n`; damped, in `λ`, complex and of size `2n`:
//!
//! ```text
//! (x, y) -> x' = -Q(s)⁻¹ (M y + (C + s M) x),  y' = x + s x',   θ = 1/(λ - s),   Q(s) = s² M + s C + K
//! ```
//!
//! The inverse comes from symmetric factors of the parts and the low rank of their contact (`contact_solver`); where there
//! are other terms, from a sparse LU. Shifts are placed where the band is not yet covered. A root that two discs cover
//! must have been found around both shifts.
//!
//! Source: Saad, "Numerical methods for large eigenvalue problems" (2011), chapters 6 and 8; Tisseur, Meerbergen, "The
//! quadratic eigenvalue problem", SIAM Review 43 (2001) 235-286.

use faer::linalg::solvers::Solve;
use faer::sparse::linalg::solvers::Lu;
use faer::sparse::{SparseColMat, Triplet};
use faer::{Mat, MatRef, c64};

use super::contact_solver::{Coupled, Parts, Shifted};
use super::full_model::{FullModel, LowRank};
use super::krylov_schur::{Iteration, Largest, capacity, random};
use super::sparse::{entries, one_norm, times};
use super::{ReductionError, SparseMatrix};
use crate::physics::{self, OperatingPoint, Vectors};

/// Roots that are sought around each shift.
const WANTED: usize = 48;
/// Residual a pair of the inverse may have, relative to its `θ`.
const KRYLOV_LIMIT: f64 = 1e-12;
/// Residual a root may have, relative to the size of its parts.
const RESIDUAL_LIMIT: f64 = 1e-12;
/// Residual a solve may have, relative to the size of its parts.
const SOLVE_LIMIT: f64 = 1e-13;
/// Half the chord of a disc that counts as covered, relative to its radius: its half width there is 0.31 of it.
const CHORD: f64 = 0.95;
/// Growth rates that are to be covered at least, relative to the band's highest angular frequency.
const GROWTH: f64 = 0.02;
/// Shifts after which the band is given up.
const MOST_SHIFTS: usize = 200;
/// Shifts whose factors are kept for other operating points.
const MOST_KEPT: usize = 4;
/// Imaginary part, relative to `|λ|`, below which a root does not oscillate.
const REAL: f64 = 1e-9;
/// Distance, relative to `|λ|`, at which two roots found are the same: ten times the square root of the residual of a
/// pair, for where roots merge.
const SAME: f64 = 1e-5;
/// `|λ²|`, relative to that of the shift, of a body that floats freely.
const FLOATING: f64 = 1e-10;
/// Below this many degrees of freedom a dense solve is faster.
const DENSE_BELOW: usize = 240;
/// Columns that residuals are computed of at once.
const TOGETHER: usize = 8;

const ZERO: c64 = c64::new(0.0, 0.0);

/// Which vectors of the roots are wanted.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum FullVectors {
    None,
    /// `x`: `(λ² M + λ C + K) x = 0`.
    Right,
    /// `y` too: `yᴴ (λ² M + λ C + K) = 0`.
    Both,
}

/// A root of the full model.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FullRoot {
    /// `λ`, 1/s, with an imaginary part of at least 0.
    pub lambda: c64,
    /// `|(λ² M + λ C + K) x| / ((|λ|² |M| + |λ| |C| + |K|) |x|)`, 1-norms of matrices and 2-norms of vectors.
    pub residual: f64,
}

/// A disc around a shift in which every root has converged.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CoveredDisc {
    /// Its centre: `λ = iω`, or `-λ² = ω²`, by `ω` in rad/s.
    pub shift_rad_s: f64,
    /// Its radius: of `λ` in 1/s, or of `λ²` in 1/s².
    pub radius: f64,
    /// It is a disc of `λ²`, of an undamped model.
    pub squared: bool,
}

impl CoveredDisc {
    /// The stretch of the imaginary axis that it covers, rad/s.
    pub fn stretch_rad_s(&self) -> [f64; 2] {
        let (omega, half) = (self.shift_rad_s, CHORD * self.radius);
        if self.squared {
            let square = omega * omega;
            let low = if half >= square { 0.0 } else { (square - half).sqrt() };
            return [low, (square + half).sqrt()];
        }
        [(omega - half).max(0.0), omega + half]
    }

    /// The growth rate up to which, either way, it covers this frequency, 1/s.
    pub fn growth_per_s(&self, omega: f64) -> f64 {
        if self.radius == f64::INFINITY {
            return f64::INFINITY;
        }
        if self.squared {
            // |ω² - σ² - ω₀² - 2 i σ ω|² < ρ², quadratic in σ².
            let (a, b) = (omega * omega, self.shift_rad_s * self.shift_rad_s);
            return ((4.0 * a * b + self.radius * self.radius).sqrt() - a - b).max(0.0).sqrt();
        }
        let off = (omega - self.shift_rad_s).abs().min(self.radius);
        (self.radius * self.radius - off * off).sqrt()
    }

    /// Whether it covers a stretch, and there growth rates up to `growth`.
    fn covers(&self, [from, to]: [f64; 2], growth: f64) -> bool {
        let [low, high] = self.stretch_rad_s();
        low <= from && high >= to && self.growth_per_s(from).min(self.growth_per_s(to)) >= growth
    }

    /// Whether `λ` lies in the disc shrunk by [`CHORD`].
    fn holds(&self, lambda: c64) -> bool {
        let centre = c64::new(0.0, self.shift_rad_s);
        let distance = if self.squared { (lambda * lambda - centre * centre).norm() } else { (lambda - centre).norm() };
        distance < CHORD * self.radius
    }
}

/// The roots of a band and where they were looked for.
#[derive(Clone, Debug)]
pub struct FullSpectrum {
    /// Ascending in frequency.
    pub roots: Vec<FullRoot>,
    /// `n×roots`: right vectors, norm 1; no columns unless asked for.
    pub right: Mat<c64>,
    /// `n×roots`: left vectors, norm 1; no columns unless asked for.
    pub left: Mat<c64>,
    /// Ascending; together they cover the imaginary axis from 0 to the end of the band. None of a small model, whose
    /// roots are all known.
    pub discs: Vec<CoveredDisc>,
    /// At every frequency of the band growth rates up to this magnitude were covered, 1/s.
    pub covered_growth_per_s: f64,
}

/// What a full solve is doing.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum FullProgress {
    /// Ordered and analysed: the bytes that will be needed in all.
    Analysed { bytes: usize },
    /// Factored at this shift, rad/s.
    Factored { shift_rad_s: f64 },
    /// Vectors built so far around the shift, and roots converged.
    Iterated { shift_rad_s: f64, vectors: usize, converged: usize },
    /// A disc with so many roots.
    Covered { disc: CoveredDisc, roots: usize },
}

/// Solves one full model at many operating points: orders and analyses once, and keeps factors, which do not depend on
/// the operating point, from one to the next.
pub struct FullSolver<'a> {
    what: String,
    model: &'a FullModel,
    /// `None` where a sparse LU is needed.
    parts: Option<Parts<'a>>,
    kept: Vec<Shifted>,
    memory_limit_bytes: Option<usize>,
}

/// What was found around one shift.
struct Found {
    disc: CoveredDisc,
    roots: Vec<FullRoot>,
    right: Mat<c64>,
    left: Mat<c64>,
}

impl<'a> FullSolver<'a> {
    /// `what` is how errors name the model; `memory_limit_bytes` is compared with an estimate before the work starts.
    ///
    /// # Errors
    /// [`ReductionError`]: `Shape`, `NotFinite`, `Unsymmetric`, `Indefinite`, `Memory`, `Factorisation`.
    pub fn new(
        what: &str,
        model: &'a FullModel,
        memory_limit_bytes: Option<usize>,
        progress: &mut dyn FnMut(FullProgress),
    ) -> Result<Self, ReductionError> {
        let n = model.dimension();
        let by_parts = model.stiffness.is_empty() && model.damping.is_empty() && model.contact.is_some();
        let parts = if by_parts { Some(Parts::new(model)?) } else { None };
        // A complex basis of twice the size, the vectors of the roots, and what they are made from.
        let vectors = size_of::<c64>() * 2 * n * (capacity(2 * n, WANTED) + 3 * WANTED);
        let factors = match &parts {
            Some(parts) => {
                let (factors, held) = parts.bytes();
                factors + held
            }
            // Columns of a sparse LU fill up unforeseeably: as many entries as a tenth of all places, at most.
            None => size_of::<c64>() * (n * n / 10).min(400 * n),
        };
        let bytes = factors + vectors;
        progress(FullProgress::Analysed { bytes });
        if let Some(limit) = memory_limit_bytes
            && bytes > limit
        {
            return Err(ReductionError::Memory { what: what.to_owned(), bytes, limit });
        }
        Ok(Self { what: what.to_owned(), model, parts, kept: vec![], memory_limit_bytes })
    }

    /// Every root with a frequency from 0 to `band_rad_s` at `p`, as far as discs around shifts on the imaginary axis
    /// cover it.
    ///
    /// # Errors
    /// [`ReductionError`]: `Factorisation`, `NotConverged`, `NotCovered`, `MissedRoot`, `Residual`.
    pub fn roots(
        &mut self,
        p: &OperatingPoint,
        band_rad_s: f64,
        vectors: FullVectors,
        progress: &mut dyn FnMut(FullProgress),
    ) -> Result<FullSpectrum, ReductionError> {
        if self.model.dimension() < DENSE_BELOW {
            return self.dense(p, band_rad_s, vectors);
        }
        let mut problem = Problem::new(&self.what, self.model, p, vectors, self.parts.is_some(), GROWTH * band_rad_s)?;
        let mut found: Vec<Found> = vec![];
        while let Some(gap) = first_gap(&found, band_rad_s) {
            if found.len() == MOST_SHIFTS {
                return Err(ReductionError::NotCovered { what: self.what.clone(), covered: gap[0], band: band_rad_s });
            }
            let [low, high] = gap;
            let middle = if problem.undamped { (0.5 * (low * low + high * high)).sqrt() } else { 0.5 * (low + high) };
            let new = match &self.parts {
                Some(parts) => {
                    let index =
                        Self::factored(&mut self.kept, parts, &problem, middle, self.memory_limit_bytes, progress)?;
                    problem.around_parts(&self.kept[index], gap, progress)?
                }
                None => problem.around_system(middle, gap, progress)?,
            };
            progress(FullProgress::Covered { disc: new.disc, roots: new.roots.len() });
            found.push(new);
            found.sort_by(|a, b| a.disc.shift_rad_s.total_cmp(&b.disc.shift_rad_s));
        }
        agree(&self.what, &found)?;
        Ok(assemble(&found, band_rad_s))
    }

    /// Where in `kept` the factors at the shift are: `ω` itself or, where it is too near to a root, a little above.
    fn factored(
        kept: &mut Vec<Shifted>,
        parts: &Parts<'_>,
        problem: &Problem<'_>,
        omega: f64,
        memory_limit_bytes: Option<usize>,
        progress: &mut dyn FnMut(FullProgress),
    ) -> Result<usize, ReductionError> {
        let mut worst = 0.0;
        for attempt in 0..6 {
            let square = omega * omega * (1.0 + 0.002 * f64::from(attempt));
            let known = kept.iter().position(|shifted| shifted.square == square);
            let index = match known {
                Some(index) => index,
                None => {
                    let (each, held) = parts.bytes();
                    let full = memory_limit_bytes.is_some_and(|limit| (kept.len() + 1) * each + held > limit);
                    if kept.len() == MOST_KEPT || (full && !kept.is_empty()) {
                        kept.remove(0);
                    }
                    kept.push(parts.at(square)?);
                    progress(FullProgress::Factored { shift_rad_s: square.sqrt() });
                    kept.len() - 1
                }
            };
            let residual = problem.solve_residual(&kept[index]);
            if residual < SOLVE_LIMIT {
                return Ok(index);
            }
            worst = residual;
            kept.remove(index);
        }
        let reason = format!("L D Lᵀ around {omega} rad/s leaves residuals of {worst:.1e}, limit {SOLVE_LIMIT:.1e}");
        Err(ReductionError::Factorisation { what: problem.what.to_owned(), reason })
    }

    /// All roots by a dense solve.
    fn dense(&self, p: &OperatingPoint, band_rad_s: f64, vectors: FullVectors) -> Result<FullSpectrum, ReductionError> {
        let n = self.model.dimension();
        let failed = |reason: String| ReductionError::Factorisation { what: self.what.clone(), reason };
        let projected = self.model.project(Mat::<f64>::identity(n, n).as_ref())?;
        let model = projected.model(self.model.contact_law).map_err(|error| failed(error.to_string()))?;
        let which = if vectors == FullVectors::Both { Vectors::Both } else { Vectors::Right };
        let spectrum = physics::Solver::new(n).solve(&model, p, which).map_err(|error| failed(error.to_string()))?;
        let basis = Mat::from_fn(n, n, |i, j| c64::new(projected.basis[(i, j)], 0.0));
        let mut chosen: Vec<(c64, usize)> = vec![];
        for (k, root) in spectrum.roots.iter().enumerate().filter(|(_, root)| root.lambda.im <= band_rad_s) {
            chosen.push((root.lambda, k));
            if spectrum.undamped && root.lambda.re != 0.0 && root.lambda.im == 0.0 {
                chosen.push((-root.lambda, k));
            }
        }
        chosen.sort_by(|a, b| a.0.im.total_cmp(&b.0.im));
        let taken = |shapes: &Mat<c64>| {
            let shapes = Mat::from_fn(n, chosen.len(), |i, j| shapes[(i, chosen[j].1)]);
            unit(&basis * shapes)
        };
        Ok(FullSpectrum {
            roots: chosen
                .iter()
                .map(|&(lambda, k)| FullRoot { lambda, residual: spectrum.roots[k].residual })
                .collect(),
            right: if vectors == FullVectors::None { Mat::zeros(n, 0) } else { taken(&spectrum.shapes) },
            left: if vectors == FullVectors::Both { taken(&spectrum.left) } else { Mat::zeros(n, 0) },
            discs: vec![],
            covered_growth_per_s: f64::INFINITY,
        })
    }
}

/// Columns scaled to norm 1.
fn unit(mut vectors: Mat<c64>) -> Mat<c64> {
    for k in 0..vectors.ncols() {
        let norm = vectors.col(k).norm_l2();
        vectors.col_mut(k).iter_mut().for_each(|value| *value /= norm);
    }
    vectors
}

/// The lowest stretch of the band that no disc covers.
fn first_gap(found: &[Found], band_rad_s: f64) -> Option<[f64; 2]> {
    let mut covered = 0.0;
    for [low, high] in found.iter().map(|found| found.disc.stretch_rad_s()) {
        if low > covered {
            return Some([covered, low.min(band_rad_s)]);
        }
        covered = high.max(covered);
        if covered >= band_rad_s {
            return None;
        }
    }
    (covered < band_rad_s).then_some([covered, band_rad_s])
}

/// That roots which two discs cover were found around both shifts.
fn agree(what: &str, found: &[Found]) -> Result<(), ReductionError> {
    for (a, b) in found.iter().zip(found.iter().skip(1)).flat_map(|(a, b)| [(a, b), (b, a)]) {
        let mut free: Vec<c64> = b.roots.iter().map(|root| root.lambda).collect();
        for root in a.roots.iter().filter(|root| a.disc.holds(root.lambda) && b.disc.holds(root.lambda)) {
            let near = |lambda: &c64| (*lambda - root.lambda).norm() <= SAME * root.lambda.norm();
            match free.iter().position(near) {
                Some(index) => {
                    free.swap_remove(index);
                }
                None => {
                    return Err(ReductionError::MissedRoot {
                        what: what.to_owned(),
                        growth_per_s: root.lambda.re,
                        omega_rad_s: root.lambda.im,
                        found: a.disc.shift_rad_s,
                        missed: b.disc.shift_rad_s,
                    });
                }
            }
        }
    }
    Ok(())
}

/// Takes every root from the disc whose stretch of the axis it lies in.
fn assemble(found: &[Found], band_rad_s: f64) -> FullSpectrum {
    let mut chosen: Vec<(FullRoot, usize, usize)> = vec![];
    let (mut from, mut half_width) = (0.0, f64::INFINITY);
    for (index, part) in found.iter().enumerate() {
        let [_, high] = part.disc.stretch_rad_s();
        let to: f64 = match found.get(index + 1) {
            // The middle of what both cover.
            Some(next) => {
                let [low, _] = next.disc.stretch_rad_s();
                (0.5 * (high.min(next.disc.shift_rad_s) + low.max(part.disc.shift_rad_s))).max(from).min(band_rad_s)
            }
            None => band_rad_s,
        };
        let last = index + 1 == found.len();
        for (k, root) in part.roots.iter().enumerate() {
            let omega = root.lambda.im;
            if omega < from || omega > to || (omega == to && !last) {
                continue;
            }
            // One on the border may have been found just before it too.
            let again = |other: &(FullRoot, usize, usize)| {
                other.1 != index && (other.0.lambda - root.lambda).norm() <= SAME * root.lambda.norm()
            };
            if (omega - from).abs() > SAME * from || !chosen.iter().any(again) {
                chosen.push((*root, index, k));
            }
        }
        half_width = half_width.min(part.disc.growth_per_s(from)).min(part.disc.growth_per_s(to));
        from = to;
    }
    chosen.sort_by(|a, b| a.0.lambda.im.total_cmp(&b.0.lambda.im).then(a.0.lambda.re.total_cmp(&b.0.lambda.re)));
    let n = found.first().map_or(0, |found| found.right.nrows());
    let gather = |of: &dyn Fn(&Found) -> MatRef<'_, c64>| {
        let there = found.iter().all(|found| of(found).ncols() == found.roots.len());
        let mut gathered = Mat::<c64>::zeros(n, if there { chosen.len() } else { 0 });
        for column in 0..gathered.ncols() {
            let (_, part, k) = chosen[column];
            for i in 0..n {
                gathered[(i, column)] = of(&found[part])[(i, k)];
            }
        }
        gathered
    };
    FullSpectrum {
        right: gather(&|found| found.right.as_ref()),
        left: gather(&|found| found.left.as_ref()),
        roots: chosen.iter().map(|(root, ..)| *root).collect(),
        discs: found.iter().map(|found| found.disc).collect(),
        covered_growth_per_s: half_width,
    }
}

/// A full model at one operating point.
struct Problem<'a> {
    what: &'a str,
    model: &'a FullModel,
    vectors: FullVectors,
    undamped: bool,
    low_rank: LowRank,
    /// `M`, `C`, `K` as they are, of a system.
    matrices: Option<[SparseMatrix; 3]>,
    /// 1-norms of `M`, `C`, `K`.
    norms: [f64; 3],
    /// Growth rates that are to be covered, 1/s.
    growth_per_s: f64,
}

impl<'a> Problem<'a> {
    fn new(
        what: &'a str,
        model: &'a FullModel,
        p: &OperatingPoint,
        vectors: FullVectors,
        by_parts: bool,
        growth_per_s: f64,
    ) -> Result<Self, ReductionError> {
        if by_parts {
            let low_rank = model.low_rank(p);
            let largest = |matrix: &dyn Fn(usize) -> f64| (0..model.parts.len()).map(matrix).fold(0.0, f64::max);
            // Pair by pair, |leftᵀ k right|₁ is at most |k| |left|₁ |right|∞; pairs share few columns.
            let pairs = |weights: &[f64]| {
                let size = |k: usize| {
                    let left: f64 = low_rank.left[k].iter().map(|(_, weight)| weight.abs()).sum();
                    let right = low_rank.right[k].iter().map(|(_, weight)| weight.abs()).fold(0.0, f64::max);
                    weights[k].abs() * left * right
                };
                (0..weights.len()).map(size).fold(0.0, f64::max)
            };
            let norms = [
                largest(&|part| one_norm(&model.parts[part].mass)),
                pairs(&low_rank.damping),
                largest(&|part| one_norm(&model.parts[part].stiffness)) + pairs(&low_rank.stiffness),
            ];
            let undamped = low_rank.damping.iter().all(|value| *value == 0.0);
            return Ok(Self { what, model, vectors, undamped, low_rank, matrices: None, norms, growth_per_s });
        }
        let matrices = model.matrices_at(p)?;
        let norms = [one_norm(&matrices[0]), one_norm(&matrices[1]), one_norm(&matrices[2])];
        let low_rank = LowRank::default();
        Ok(Self { what, model, vectors, undamped: false, low_rank, matrices: Some(matrices), norms, growth_per_s })
    }

    /// `(a M + b C + c K) X`, or with the transposed matrices.
    fn times(&self, [a, b, c]: [c64; 3], x: MatRef<'_, c64>, transposed: bool) -> Mat<c64> {
        let k = x.ncols();
        // Real matrices times real and imaginary parts side by side.
        let parts = Mat::from_fn(x.nrows(), 2 * k, |i, j| if j < k { x[(i, j)].re } else { x[(i, j - k)].im });
        let complex = |of: &Mat<f64>, i: usize, j: usize| c64::new(of[(i, j)], of[(i, k + j)]);
        let mut sum = Mat::<c64>::zeros(x.nrows(), k);
        let mut add = |factor: c64, product: &Mat<f64>, offset: usize| {
            for j in 0..k {
                for i in 0..product.nrows() {
                    sum[(offset + i, j)] += factor * complex(product, i, j);
                }
            }
        };
        match &self.matrices {
            Some(matrices) => {
                for (factor, matrix) in [a, b, c].into_iter().zip(matrices) {
                    if factor != ZERO {
                        let product =
                            if transposed { times_transposed(matrix, &parts) } else { times(matrix, parts.as_ref()) };
                        add(factor, &product, 0);
                    }
                }
            }
            None => {
                for (part, offset) in self.model.parts.iter().zip(self.model.offsets()) {
                    let rows = parts.subrows(offset, part.mass.nrows());
                    for (factor, matrix) in [(a, &part.mass), (c, &part.stiffness)] {
                        if factor != ZERO {
                            add(factor, &times(matrix, rows), offset);
                        }
                    }
                }
                let LowRank { left, right, stiffness, damping } = &self.low_rank;
                let (left, right) = if transposed { (right, left) } else { (left, right) };
                for (pair, row) in right.iter().enumerate() {
                    let weight = c * stiffness[pair] + b * damping[pair];
                    for j in 0..k {
                        let along: c64 = row.iter().map(|&(i, value)| x[(i, j)] * value).sum();
                        left[pair].iter().for_each(|&(i, value)| sum[(i, j)] += weight * along * value);
                    }
                }
            }
        }
        sum
    }

    /// `|(λ² M + λ C + K) x|` relative to the size of its parts, of every column.
    fn residuals(&self, lambdas: &[c64], x: MatRef<'_, c64>, transposed: bool) -> Vec<f64> {
        let mut residuals = vec![];
        let one = c64::new(1.0, 0.0);
        for first in (0..lambdas.len()).step_by(TOGETHER) {
            let width = TOGETHER.min(lambdas.len() - first);
            let chunk = x.subcols(first, width);
            let of = [[one, ZERO, ZERO], [ZERO, one, ZERO], [ZERO, ZERO, one]];
            let [mass, damping, stiffness] = of.map(|factors| self.times(factors, chunk, transposed));
            for j in 0..width {
                let lambda = lambdas[first + j];
                let value = |i: usize| lambda * lambda * mass[(i, j)] + lambda * damping[(i, j)] + stiffness[(i, j)];
                let norm = (0..x.nrows()).map(|i| value(i).norm_sqr()).sum::<f64>().sqrt();
                let rate = lambda.norm();
                let parts = rate * rate * self.norms[0] + rate * self.norms[1] + self.norms[2];
                residuals.push(norm / (parts * chunk.col(j).norm_l2()));
            }
        }
        residuals
    }

    /// The residual of one solve at a shift, relative to the size of its parts.
    fn solve_residual(&self, shifted: &Shifted) -> f64 {
        let s = c64::new(0.0, shifted.square.sqrt());
        let b = random::<c64>(self.model.dimension(), 1, 77);
        let x = self.coupled(shifted, s, false).solve(b.as_ref());
        let r = self.times([s * s, s, c64::new(1.0, 0.0)], x.as_ref(), false) - &b;
        let parts = shifted.square * self.norms[0] + s.im * self.norms[1] + self.norms[2];
        r.norm_l2() / (parts * x.norm_l2() + b.norm_l2())
    }

    fn coupled<'s>(&self, shifted: &'s Shifted, s: c64, transposed: bool) -> Coupled<'s, c64> {
        let weight = |(k, c): (&f64, &f64)| c64::new(*k, 0.0) + s * *c;
        let weights = self.low_rank.stiffness.iter().zip(&self.low_rank.damping).map(weight).collect();
        shifted.couple(&self.low_rank, weights, transposed)
    }

    /// The roots nearest to a shift of a model of parts.
    fn around_parts(
        &mut self,
        shifted: &Shifted,
        gap: [f64; 2],
        progress: &mut dyn FnMut(FullProgress),
    ) -> Result<Found, ReductionError> {
        let (square, omega) = (shifted.square, shifted.square.sqrt());
        if !self.undamped {
            let s = c64::new(0.0, omega);
            // Either way round is made once.
            let (forward, backward) = (self.coupled(shifted, s, false), self.coupled(shifted, s, true));
            let solve =
                |b: MatRef<'_, c64>, transposed: bool| if transposed { backward.solve(b) } else { forward.solve(b) };
            return self.around(omega, gap, &solve, progress);
        }
        let run = |transposed: bool, count: usize, progress: &mut dyn FnMut(FullProgress)| {
            let coupled = shifted.couple::<f64>(&self.low_rank, self.low_rank.stiffness.clone(), transposed);
            let iteration = Iteration {
                what: self.what,
                dimension: self.model.dimension(),
                count,
                residual_limit: KRYLOV_LIMIT,
                seed: if transposed { 2 } else { 1 },
            };
            let enough = |theta: &[c64]| {
                theta.last().is_some_and(|last| {
                    let disc = CoveredDisc { shift_rad_s: omega, radius: 1.0 / last.norm(), squared: true };
                    !transposed && disc.covers(gap, self.growth_per_s)
                })
            };
            iteration.run::<f64>(
                &|x| coupled.solve(self.model.mass_times(x.as_ref()).as_ref()),
                &enough,
                &mut |vectors, converged| progress(FullProgress::Iterated { shift_rad_s: omega, vectors, converged }),
            )
        };
        let found = run(false, WANTED.min(self.model.dimension() / 4), progress)?;
        let radius = found.theta.last().map_or(0.0, |last| 1.0 / last.norm());
        let disc = CoveredDisc { shift_rad_s: omega, radius, squared: true };
        // Both of ±λ have the same vector; those that oscillate are listed once.
        let lambdas_of = |theta: c64| {
            let kappa = 1.0 / theta + square;
            if kappa.norm() < FLOATING * square {
                return vec![ZERO];
            }
            let root = (-kappa).sqrt();
            let root = if root.im < 0.0 { -root } else { root };
            if root.im > REAL * root.norm() {
                vec![root]
            } else {
                vec![c64::new(root.re, 0.0), c64::new(-root.re, 0.0)]
            }
        };
        let left = match self.vectors {
            FullVectors::Both => Some(run(true, found.theta.len(), progress)?),
            _ => None,
        };
        self.finish(disc, found, left, &lambdas_of)
    }

    /// The roots nearest to a shift of a system.
    fn around_system(
        &mut self,
        omega: f64,
        gap: [f64; 2],
        progress: &mut dyn FnMut(FullProgress),
    ) -> Result<Found, ReductionError> {
        let Some([mass, damping, stiffness]) = &self.matrices else {
            unreachable!("a system has its matrices");
        };
        let failed = |reason: String| ReductionError::Factorisation { what: self.what.to_owned(), reason };
        let (n, s) = (mass.nrows(), c64::new(0.0, omega));
        let triplets: Vec<Triplet<usize, usize, c64>> = [(s * s, mass), (s, damping), (c64::new(1.0, 0.0), stiffness)]
            .into_iter()
            .flat_map(|(weight, matrix)| entries(matrix).map(move |(i, j, value)| Triplet::new(i, j, weight * value)))
            .collect();
        let sum = SparseColMat::try_new_from_triplets(n, n, &triplets).map_err(|error| failed(format!("{error:?}")))?;
        let factor: Lu<usize, c64> =
            sum.sp_lu().map_err(|error| failed(format!("the sparse factor at {s} failed: {error:?}")))?;
        progress(FullProgress::Factored { shift_rad_s: omega });
        let solve = |b: MatRef<'_, c64>, transposed: bool| {
            let mut x = b.to_owned();
            if transposed {
                factor.solve_transpose_in_place(x.as_mut());
            } else {
                factor.solve_in_place(x.as_mut());
            }
            x
        };
        self.around(omega, gap, &solve, progress)
    }

    /// The roots nearest to `iω` by the linearised problem.
    fn around(
        &self,
        omega: f64,
        gap: [f64; 2],
        solve: &dyn Fn(MatRef<'_, c64>, bool) -> Mat<c64>,
        progress: &mut dyn FnMut(FullProgress),
    ) -> Result<Found, ReductionError> {
        let n = self.model.dimension();
        let s = c64::new(0.0, omega);
        let one = c64::new(1.0, 0.0);
        let run = |transposed: bool, count: usize, progress: &mut dyn FnMut(FullProgress)| {
            // Velocities are divided by ω, so that both halves of a vector weigh alike.
            let apply = |v: Mat<c64>| {
                let (x, y) = (v.subrows(0, n), v.subrows(n, n));
                let b = self.times([c64::new(-omega, 0.0), ZERO, ZERO], y, transposed)
                    + self.times([-s, -one, ZERO], x, transposed);
                let next = solve(b.as_ref(), transposed);
                Mat::from_fn(2 * n, v.ncols(), |i, j| {
                    if i < n { next[(i, j)] } else { (x[(i - n, j)] + s * next[(i - n, j)]) / omega }
                })
            };
            let iteration = Iteration {
                what: self.what,
                dimension: 2 * n,
                count,
                residual_limit: KRYLOV_LIMIT,
                seed: if transposed { 2 } else { 1 },
            };
            let enough = |theta: &[c64]| {
                theta.last().is_some_and(|last| {
                    let disc = CoveredDisc { shift_rad_s: omega, radius: 1.0 / last.norm(), squared: false };
                    !transposed && disc.covers(gap, self.growth_per_s)
                })
            };
            let found = iteration.run::<c64>(&apply, &enough, &mut |vectors, converged| {
                progress(FullProgress::Iterated { shift_rad_s: omega, vectors, converged });
            })?;
            let vectors = found.vectors.subrows(0, n).to_owned();
            Ok::<_, ReductionError>(Largest { theta: found.theta, vectors })
        };
        let found = run(false, WANTED.min(n / 2), progress)?;
        let radius = found.theta.last().map_or(0.0, |last| 1.0 / last.norm());
        let disc = CoveredDisc { shift_rad_s: omega, radius, squared: false };
        let left = match self.vectors {
            FullVectors::Both => Some(run(true, found.theta.len(), progress)?),
            _ => None,
        };
        let lambdas_of = |theta: c64| {
            let lambda = s + 1.0 / theta;
            if lambda.im < -REAL * lambda.norm() { vec![] } else { vec![c64::new(lambda.re, lambda.im.max(0.0))] }
        };
        self.finish(disc, found, left, &lambdas_of)
    }

    /// Roots with residuals and the vectors that are wanted.
    fn finish(
        &self,
        disc: CoveredDisc,
        found: Largest,
        left: Option<Largest>,
        lambdas_of: &dyn Fn(c64) -> Vec<c64>,
    ) -> Result<Found, ReductionError> {
        let n = self.model.dimension();
        let listed = |theta: &[c64]| -> Vec<(c64, usize)> {
            theta
                .iter()
                .enumerate()
                .flat_map(|(k, &theta)| lambdas_of(theta).into_iter().map(move |lambda| (lambda, k)))
                .collect()
        };
        let roots = listed(&found.theta);
        let gathered = |vectors: &Mat<c64>, columns: &[usize]| {
            unit(Mat::from_fn(n, columns.len(), |i, j| vectors[(i, columns[j])]))
        };
        let columns: Vec<usize> = roots.iter().map(|(_, k)| *k).collect();
        let right = gathered(&found.vectors, &columns);
        let lambdas: Vec<c64> = roots.iter().map(|(lambda, _)| *lambda).collect();
        let residuals = self.checked(&lambdas, &right, false)?;
        let left = match left {
            None => Mat::zeros(n, 0),
            Some(left) => {
                let mut of_left = listed(&left.theta);
                // Where roots merge, those of the transposed problem differ by the square root of rounding.
                let (mut columns, mut own) = (vec![], vec![]);
                for lambda in &lambdas {
                    let off = |other: &(c64, usize)| (other.0 - lambda).norm();
                    let nearest = (0..of_left.len()).min_by(|&a, &b| off(&of_left[a]).total_cmp(&off(&of_left[b])));
                    match nearest.filter(|&k| off(&of_left[k]) < SAME * lambda.norm().max(disc.shift_rad_s * SAME)) {
                        Some(k) => {
                            let (lambda, column) = of_left.swap_remove(k);
                            own.push(lambda);
                            columns.push(column);
                        }
                        None => {
                            return Err(ReductionError::MissedRoot {
                                what: format!("{} (transposed)", self.what),
                                growth_per_s: lambda.re,
                                omega_rad_s: lambda.im,
                                found: disc.shift_rad_s,
                                missed: disc.shift_rad_s,
                            });
                        }
                    }
                }
                let vectors = gathered(&left.vectors, &columns);
                self.checked(&own, &vectors, true)?;
                // uᵀ Q = 0: yᴴ Q = 0 with y the conjugate of u.
                Mat::from_fn(n, vectors.ncols(), |i, j| vectors[(i, j)].conj())
            }
        };
        let roots =
            lambdas.into_iter().zip(residuals).map(|(lambda, residual)| FullRoot { lambda, residual }).collect();
        let right = if self.vectors == FullVectors::None { Mat::zeros(n, 0) } else { right };
        Ok(Found { disc, roots, right, left })
    }

    /// Residuals, all of them small.
    fn checked(&self, lambdas: &[c64], x: &Mat<c64>, transposed: bool) -> Result<Vec<f64>, ReductionError> {
        let residuals = self.residuals(lambdas, x.as_ref(), transposed);
        match residuals.iter().enumerate().find(|(_, value)| value.is_nan() || **value > RESIDUAL_LIMIT) {
            None => Ok(residuals),
            Some((mode, &value)) => {
                Err(ReductionError::Residual { what: self.what.to_owned(), mode, value, limit: RESIDUAL_LIMIT })
            }
        }
    }
}

/// `Aᵀ X`.
fn times_transposed(matrix: &SparseMatrix, x: &Mat<f64>) -> Mat<f64> {
    let view = matrix.as_ref();
    Mat::from_fn(matrix.ncols(), x.ncols(), |column, j| {
        view.row_idx_of_col(column).zip(view.val_of_col(column)).map(|(row, value)| value * x[(row, j)]).sum()
    })
}

#[cfg(test)]
pub(super) mod tests {
    use super::super::full_model::{FullContact, FullPart, SparseTerm};
    use super::*;
    use crate::physics::{ContactLaw, Law};

    fn sparse(n: usize, triplets: &[(usize, usize, f64)]) -> SparseMatrix {
        let triplets: Vec<_> = triplets.iter().map(|&(i, j, value)| Triplet::new(i, j, value)).collect();
        SparseMatrix::try_new_from_triplets(n, n, &triplets).unwrap()
    }

    #[test]
    fn a_damped_unsymmetric_system_in_blocks() {
        // Blocks of two: [[a - d, w], [-w, a + d]] with unit mass, damping g; λ² + g λ + κ = 0, κ = a ± sqrt(d² - w²).
        let blocks = 150;
        let (mut mass, mut damping, mut stiffness, mut expected) = (vec![], vec![], vec![], vec![]);
        for b in 0..blocks {
            let a = (100.0 * (b + 1) as f64).powi(2);
            let (d, w, g) = (0.05 * a, if b % 3 == 0 { 0.08 * a } else { 0.03 * a }, 4.0 + (b % 7) as f64);
            let (i, j) = (2 * b, 2 * b + 1);
            for k in [i, j] {
                mass.push((k, k, 1.0));
                damping.push((k, k, g));
            }
            stiffness.extend([(i, i, a - d), (j, j, a + d), (i, j, w), (j, i, -w)]);
            let split = c64::new(d * d - w * w, 0.0).sqrt();
            for kappa in [c64::new(a, 0.0) + split, c64::new(a, 0.0) - split] {
                let root = (c64::new(g * g, 0.0) - kappa * 4.0).sqrt();
                for lambda in [(root - g) * 0.5, (-root - g) * 0.5] {
                    if lambda.im > 0.0 && lambda.im < 8000.0 {
                        expected.push(lambda);
                    }
                }
            }
        }
        let n = 2 * blocks;
        let term = |triplets: &[(usize, usize, f64)]| SparseTerm { matrix: sparse(n, triplets), law: Law::Constant };
        let model = FullModel {
            parts: vec![FullPart { name: "system".into(), mass: sparse(n, &mass), stiffness: sparse(n, &[]) }],
            stiffness: vec![term(&stiffness)],
            damping: vec![term(&damping)],
            contact: None,
            contact_law: ContactLaw::default(),
        };
        let mut solver = FullSolver::new("system", &model, None, &mut |_| {}).unwrap();
        let p = point(0.3);
        let found = solver.roots(&p, 8000.0, FullVectors::Both, &mut |_| {}).unwrap();
        // Flutter pairs share their imaginary part but for damping: compared as sets.
        assert_eq!(found.roots.len(), expected.len());
        for lambda in expected {
            let nearest = found.roots.iter().map(|root| (root.lambda - lambda).norm()).fold(f64::INFINITY, f64::min);
            assert!(nearest < 1e-10 * lambda.norm(), "{lambda}: {nearest:e}");
        }
        assert!(found.discs.len() > 2 && found.covered_growth_per_s > 100.0, "{:?}", found.discs);
        vectors_belong(&model, &p, &found);
    }

    pub(in crate::reduction) fn point(friction_coefficient: f64) -> OperatingPoint {
        OperatingPoint { normal_load_n: 600.0, disc_speed_rad_s: 7.0, friction_coefficient }
    }

    /// Right and left vectors make the full matrices singular, to the rounding of their norm.
    fn vectors_belong(model: &FullModel, p: &OperatingPoint, found: &FullSpectrum) {
        let [mass, damping, stiffness] = model.matrices_at(p).unwrap().map(|matrix| matrix.to_dense());
        let n = model.dimension();
        for (k, root) in found.roots.iter().enumerate() {
            let lambda = root.lambda;
            let q = Mat::from_fn(n, n, |i, j| {
                lambda * lambda * mass[(i, j)] + lambda * damping[(i, j)] + c64::new(stiffness[(i, j)], 0.0)
            });
            let (x, y) = (found.right.subcols(k, 1), found.left.subcols(k, 1));
            assert!((&q * x).norm_l2() < 1e-10 * q.norm_l2(), "right of {lambda}");
            assert!((y.adjoint() * &q).norm_l2() < 1e-10 * q.norm_l2(), "left of {lambda}");
        }
    }

    /// Two chains, each of `3·nodes` rows in three directions with springs of its own along them, that touch at every
    /// seventh node.
    pub(in crate::reduction) fn touching(nodes: usize, damping: f64, law: ContactLaw) -> FullModel {
        let part = |name: &str, spring: f64, first: f64| {
            let (mut mass, mut stiffness) = (vec![], vec![]);
            for node in 0..nodes {
                for axis in 0..3 {
                    let (i, weight) = (3 * node + axis, 1.0 + 0.3 * ((node + axis) as f64 * first).sin());
                    mass.push((i, i, weight));
                    let k = spring * (1.0 + 0.2 * axis as f64);
                    stiffness.push((i, i, 2.0 * k));
                    if node > 0 {
                        stiffness.extend([(i, i - 3, -k), (i - 3, i, -k)]);
                    }
                    // Directions are joined weakly.
                    let j = 3 * node + (axis + 1) % 3;
                    stiffness.extend([(i, i, 0.05 * k), (j, j, 0.05 * k), (i, j, -0.05 * k), (j, i, -0.05 * k)]);
                }
            }
            FullPart { name: name.into(), mass: sparse(3 * nodes, &mass), stiffness: sparse(3 * nodes, &stiffness) }
        };
        let touching: Vec<usize> = (0..nodes).step_by(7).collect();
        let rows = |axis: usize| {
            let row = |&node: &usize| vec![(3 * node + axis, 1.0), (3 * nodes + 3 * node + axis, -1.0)];
            touching.iter().map(row).collect::<Vec<_>>()
        };
        FullModel {
            parts: vec![part("pad", 1e6, 0.4), part("disc", 1.7e6, 0.9)],
            stiffness: vec![],
            damping: vec![],
            contact: Some(FullContact {
                normal: rows(1),
                sliding: rows(0),
                lateral: rows(2),
                stiffness_n_per_m: vec![4e5; touching.len()],
                damping_n_s_per_m: vec![damping; touching.len()],
                radius_m: vec![0.1; touching.len()],
            }),
            contact_law: law,
        }
    }

    /// Against a dense solve of the same matrices: undamped and with every kind of contact damping.
    #[test]
    fn touching_parts_against_a_dense_solve() {
        let law = ContactLaw { exponent: 0.5, reference_n: 500.0, slope_s_per_m: -0.01, lateral_damping: true };
        for (damping, law) in [(0.0, ContactLaw::default()), (3.0, law)] {
            let model = touching(60, damping, law);
            let n = model.dimension();
            assert!(n > DENSE_BELOW);
            let p = point(0.7);
            let mut solver = FullSolver::new("full", &model, None, &mut |_| {}).unwrap();
            let band = 900.0;
            let found = solver.roots(&p, band, FullVectors::Both, &mut |_| {}).unwrap();
            let projected = model.project(Mat::<f64>::identity(n, n).as_ref()).unwrap();
            let dense = projected.model(model.contact_law).unwrap();
            let spectrum = physics::Solver::new(n).solve(&dense, &p, Vectors::Right).unwrap();
            let expected: Vec<c64> = spectrum.roots.iter().map(|root| root.lambda).filter(|l| l.im <= band).collect();
            assert!(expected.len() > 60, "{}", expected.len());
            assert_eq!(found.roots.len(), expected.len(), "{:?}", found.discs);
            let mut left = expected;
            for root in &found.roots {
                let (index, off) = left
                    .iter()
                    .enumerate()
                    .map(|(index, lambda)| (index, (lambda * lambda - root.lambda * root.lambda).norm()))
                    .min_by(|a, b| a.1.total_cmp(&b.1))
                    .unwrap();
                // Rounding of the dense solve: ε times the largest square, 1e7, times conditions of a few hundred.
                assert!(off < 1e-6, "{} off by {off:e}", root.lambda);
                left.swap_remove(index);
            }
            vectors_belong(&model, &p, &found);
            // Apart from each other, and other conditions with the same factors.
            let open = OperatingPoint { normal_load_n: 0.0, ..p };
            assert!(solver.roots(&open, band, FullVectors::None, &mut |_| {}).unwrap().roots.len() > 60);
            let factors = solver.kept.len();
            solver.roots(&point(0.2), band, FullVectors::None, &mut |_| {}).unwrap();
            assert!(factors > 0 && solver.kept.len() <= MOST_KEPT);
        }
    }

    #[test]
    fn too_little_memory_is_refused() {
        let model = touching(100, 0.0, ContactLaw::default());
        let refused = FullSolver::new("full", &model, Some(1 << 20), &mut |_| {});
        assert!(matches!(refused.err(), Some(ReductionError::Memory { limit: 1_048_576, .. })));
    }
}

//! First derivatives of roots with respect to the conditions and the contact, from left and right vectors.
//!
//! Let `z = λ²` for an undamped model and `z = λ` for a damped one. `z` is an eigenvalue of a matrix `A(p)`: of `-K`,
//! or of the scaled state matrix. For a simple root `dz = yᴴ dA x / yᴴ x`. Of two roots close to merging only
//! symmetric functions are differentiable. Let `V` be a basis of the span of their right vectors, `W` one of their
//! left vectors with `Wᴴ V = I`, and `T = Wᴴ A V`. The `2×2` matrix `T` has the mean `m` and the discriminant `d`:
//!
//! ```text
//! m = (T₁₁ + T₂₂) / 2        d = ((T₁₁ - T₂₂) / 2)² + T₁₂ T₂₁ = ((z₁ - z₂) / 2)²        z = m ± √d
//! ```
//!
//! To first order `T` changes by `dT = Wᴴ dA V`. The span of two merging vectors is well defined even where the
//! vectors themselves are not.
//!
//! # Source
//! Lancaster (1964) for simple roots; Kirillov, *Nonconservative Stability Problems of Modern Physics* (2013),
//! chapter 2, for double ones.

use faer::prelude::Solve;
use faer::{Mat, MatRef, c64};

use super::law::Parameter;
use super::model::Model;
use super::model_error::ModelError;
use super::solver::{ROUNDING, displacement_scale};
use super::spectrum::Spectrum;

/// Relative distance beyond which two roots are treated separately.
const APART: f64 = 0.05;

/// Relative change of a condition or of the contact over which a linear law must hold to be reported.
pub const REACH: f64 = 0.01;
/// Minimum change of the friction coefficient over which a linear law must hold.
pub const FRICTION_REACH: f64 = 1e-3;

/// Derivatives with respect to each of [`Parameter::ALL`].
pub type Slopes = [c64; 5];

/// Mean and discriminant of two roots `z`, which stay analytic where the roots merge; see the module documentation.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pair {
    /// Mean `m`.
    pub mean: c64,
    /// Derivatives of `m`.
    pub mean_slope: Slopes,
    /// Discriminant `d`.
    pub discriminant: c64,
    /// Derivatives of `d`.
    pub discriminant_slope: Slopes,
    /// Bound of the rounding error of `d`.
    pub discriminant_error: f64,
}

/// The law by which a root changes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Change {
    /// Linear: derivatives of `λ`, 1/s per unit of the parameter.
    Linear(Slopes),
    /// `z = m + m' δ ± √(d + d' δ)`, for a root too close to its partner for a linear law.
    SquareRoot {
        /// Index of the other root of the pair.
        partner: usize,
        /// Mean and discriminant, which change linearly.
        pair: Pair,
    },
}

/// Sensitivity of a root.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RootSensitivity {
    /// Index of the root in its spectrum.
    pub root: usize,
    /// Derivatives of `z`; not useful close to a merging point, where they are unbounded.
    pub slope: Slopes,
    /// The law that holds for changes up to [`REACH`].
    pub change: Change,
    /// Bound of the rounding error of `z`.
    pub error: f64,
}

/// Why sensitivities could not be computed.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum SensitivityError {
    /// The derivative of a term could not be evaluated.
    #[error(transparent)]
    Model(#[from] ModelError),
    /// The spectrum does not hold all roots.
    #[error("{found} roots with their conjugates, expected {expected}: no basis of left vectors")]
    Roots {
        /// Number of roots found, conjugates counted.
        found: usize,
        /// Number of roots of the model.
        expected: usize,
    },
    /// The right vectors are linearly dependent: a root is defective.
    #[error("root {root}: the basis of right vectors is singular")]
    Singular {
        /// Index of the root.
        root: usize,
    },
}

/// Roots treated together: one, or a pair.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Group {
    first: usize,
    second: Option<usize>,
}

/// Projection `T` of `A` on a group, and its derivatives. For a single root only the entry `(0, 0)` is used, the
/// others are zero.
#[derive(Clone, Copy, Debug)]
struct Block {
    t: [[c64; 2]; 2],
    dt: [[[c64; 2]; 2]; 5],
    /// Bound of the rounding error of the entries of `t`.
    error: f64,
}

/// The eigenvalue `z` of root `k`.
fn value(spectrum: &Spectrum, k: usize) -> c64 {
    let root = &spectrum.roots[k];
    if spectrum.undamped { root.square } else { root.lambda }
}

/// Sensitivities of the roots `chosen` of `spectrum`, in that order.
///
/// # Errors
/// [`SensitivityError`].
pub fn of_roots(
    model: &Model,
    spectrum: &Spectrum,
    chosen: &[usize],
) -> Result<Vec<RootSensitivity>, SensitivityError> {
    let groups = grouped(spectrum);
    let wanted: Vec<Group> = groups
        .iter()
        .copied()
        .filter(|group| chosen.contains(&group.first) || group.second.is_some_and(|second| chosen.contains(&second)))
        .collect();
    let blocks = blocks(model, spectrum, &groups, &wanted)?;
    let reach = reach(spectrum);
    chosen
        .iter()
        .map(|&root| {
            let at = wanted.iter().position(|group| group.first == root || group.second == Some(root));
            let k = at.ok_or(SensitivityError::Singular { root })?;
            Ok(of_root(spectrum, root, &wanted[k], &blocks[k], &reach))
        })
        .collect()
}

/// Mean and discriminant of roots `first` and `second` of `spectrum`, at any distance from each other.
///
/// # Errors
/// [`SensitivityError`].
pub fn of_pair(model: &Model, spectrum: &Spectrum, first: usize, second: usize) -> Result<Pair, SensitivityError> {
    let group = Group { first, second: Some(second) };
    let mut groups = vec![group];
    let others = grouped(spectrum).into_iter().filter(|other| !other.touches(&group));
    groups.extend(others);
    // Roots whose partner is in this pair become groups of one.
    for k in 0..spectrum.roots.len() {
        let single = Group { first: k, second: None };
        if !groups.iter().any(|group| group.touches(&single)) {
            groups.push(single);
        }
    }
    Ok(blocks(model, spectrum, &groups, &[group])?[0].pair())
}

/// Change of each parameter over which a law must hold.
fn reach(spectrum: &Spectrum) -> [f64; 5] {
    let p = &spectrum.point;
    let friction = (REACH * p.friction_coefficient.abs()).max(FRICTION_REACH);
    [friction, REACH * p.normal_load_n.abs(), REACH * p.disc_speed_rad_s.abs(), REACH, REACH]
}

impl Group {
    /// Whether the groups have a root in common.
    fn touches(&self, other: &Self) -> bool {
        let members = |group: &Self| [Some(group.first), group.second];
        members(self).iter().flatten().any(|k| members(other).iter().flatten().any(|l| k == l))
    }
}

/// Divides all roots into groups: two roots closer than [`APART`] that are each other's nearest neighbour form a
/// pair.
fn grouped(spectrum: &Spectrum) -> Vec<Group> {
    let count = spectrum.roots.len();
    let z: Vec<c64> = (0..count).map(|k| value(spectrum, k)).collect();
    let nearest = |k: usize| {
        let distance = |j: usize| (z[j] - z[k]).norm();
        (0..count).filter(|&j| j != k).min_by(|&a, &b| distance(a).total_cmp(&distance(b)))
    };
    let near: Vec<Option<usize>> = (0..count)
        .map(|k| nearest(k).filter(|&j| (z[j] - z[k]).norm() <= APART * (z[j].norm() + z[k].norm())))
        .collect();
    (0..count)
        .filter_map(|k| match near[k].filter(|&j| near[j] == Some(k)) {
            Some(partner) if partner < k => None,
            partner => Some(Group { first: k, second: partner }),
        })
        .collect()
}

/// Sensitivity of a root of `group`, whose block is `block`.
fn of_root(spectrum: &Spectrum, root: usize, group: &Group, block: &Block, reach: &[f64; 5]) -> RootSensitivity {
    let z = value(spectrum, root);
    let to_lambda = |slope: Slopes| {
        // `λ = √z` for an undamped model.
        let lambda = spectrum.roots[root].lambda;
        if spectrum.undamped { slope.map(|dz| dz / (2.0 * lambda)) } else { slope }
    };
    let Some(second) = group.second else {
        let slope = block.dt.map(|dt| dt[0][0]);
        return RootSensitivity { root, slope, change: Change::Linear(to_lambda(slope)), error: block.error };
    };
    let partner = if root == group.first { second } else { group.first };
    let pair = block.pair();
    // This root is `m + half`, the partner `m - half`.
    let half = 0.5 * (z - value(spectrum, partner));
    let slope: Slopes = std::array::from_fn(|k| pair.mean_slope[k] + pair.discriminant_slope[k] / (2.0 * half));
    // Along a parameter `d(δ) = d + d' δ + d'' δ²`. If this is a perfect square, the roots are two straight lines
    // that cross. Its deviation from a perfect square is the curvature of both roots.
    let bends = (0..5).any(|k| {
        let [[a, b], [c, e]] = block.dt[k];
        let curvature = 0.25 * (a - e) * (a - e) + b * c;
        let deviation = curvature - pair.discriminant_slope[k] * pair.discriminant_slope[k] / (4.0 * pair.discriminant);
        let bend = deviation.norm() * reach[k] * reach[k];
        bend.is_nan() || bend > half.norm_sqr()
    });
    let change = if bends { Change::SquareRoot { partner, pair } } else { Change::Linear(to_lambda(slope)) };
    RootSensitivity { root, slope, change, error: block.error * (1.0 + block.spread() / half.norm()) }
}

impl Block {
    /// Mean and discriminant of the block, with derivatives.
    fn pair(&self) -> Pair {
        let [[a, b], [c, e]] = self.t;
        let half = 0.5 * (a - e);
        Pair {
            mean: 0.5 * (a + e),
            mean_slope: self.dt.map(|dt| 0.5 * (dt[0][0] + dt[1][1])),
            discriminant: half * half + b * c,
            discriminant_slope: self.dt.map(|dt| half * (dt[0][0] - dt[1][1]) + dt[0][1] * c + b * dt[1][0]),
            discriminant_error: self.error * (2.0 * half.norm() + b.norm() + c.norm() + self.error),
        }
    }

    /// Distance of the block from a multiple of the identity.
    fn spread(&self) -> f64 {
        let [[a, b], [c, e]] = self.t;
        0.5 * (a - e).norm() + b.norm() + c.norm()
    }
}

/// The matrix `A` of the module documentation, with what is needed to apply it and its derivatives.
struct Operator {
    stiffness: Mat<f64>,
    damping: Mat<f64>,
    /// Scale `S` of a damped model, rad/s.
    scale: Option<Vec<f64>>,
}

impl Operator {
    fn new(model: &Model, spectrum: &Spectrum) -> Result<Self, ModelError> {
        let n = model.dimension();
        let (mut stiffness, mut damping) = (Mat::zeros(n, n), Mat::zeros(n, n));
        model.assemble_at(&spectrum.situation(), &mut stiffness, &mut damping)?;
        let scale = (!spectrum.undamped).then(|| displacement_scale(stiffness.as_ref()));
        Ok(Self { stiffness, damping, scale })
    }

    /// The right vector of root `k`, of norm 1: its shape, or its scaled state `[S x; λ x]`.
    fn vector(&self, spectrum: &Spectrum, k: usize) -> Vec<c64> {
        let n = self.stiffness.nrows();
        let lambda = spectrum.roots[k].lambda;
        let shape = (0..n).map(|i| spectrum.shapes[(i, k)]);
        let mut vector: Vec<c64> = match &self.scale {
            None => shape.collect(),
            Some(scale) => {
                let displacement = shape.clone().zip(scale).map(|(x, s)| x * s);
                displacement.chain(shape.map(|x| lambda * x)).collect()
            }
        };
        normalise(&mut vector);
        vector
    }

    /// The right vectors of all `groups`, orthonormal within each group, and for a damped model their conjugates; and the
    /// column of the first vector of each group.
    fn basis(&self, spectrum: &Spectrum, groups: &[Group]) -> Result<(Mat<c64>, Vec<usize>), SensitivityError> {
        let mut basis: Vec<Vec<c64>> = vec![];
        let mut places = vec![];
        for group in groups {
            places.push(basis.len());
            basis.push(self.vector(spectrum, group.first));
            if let Some(second) = group.second {
                let mut vector = self.vector(spectrum, second);
                let first = &basis[basis.len() - 1];
                let mut off = orthogonalise(&mut vector, first);
                if off < 1e-12 && self.scale.is_some() {
                    // A double root at the origin has a single shape; a state with velocity only gives the second vector.
                    let n = spectrum.shapes.nrows();
                    let shape = (0..n).map(|i| spectrum.shapes[(i, second)]);
                    vector = std::iter::repeat_n(c64::ZERO, n).chain(shape).collect();
                    off = orthogonalise(&mut vector, first);
                }
                if off < 1e-12 {
                    return Err(SensitivityError::Singular { root: second });
                }
                basis.push(vector);
            }
        }
        if self.scale.is_some() {
            // The complex conjugates of the modes complete the basis.
            let mut conjugates = vec![];
            for (group, &place) in groups.iter().zip(&places) {
                let members = if group.second.is_some() { 2 } else { 1 };
                if group.first < spectrum.mode_count {
                    let conjugate = |v: &Vec<c64>| v.iter().map(|x| x.conj()).collect::<Vec<c64>>();
                    conjugates.extend(basis[place..place + members].iter().map(conjugate));
                }
            }
            basis.extend(conjugates);
        }
        let size = basis.first().map_or(0, Vec::len);
        if basis.len() != size {
            return Err(SensitivityError::Roots { found: basis.len(), expected: size });
        }
        Ok((Mat::from_fn(size, size, |i, j| basis[j][i]), places))
    }

    /// `A V`.
    fn apply(&self, v: MatRef<'_, c64>) -> Mat<c64> {
        let n = self.stiffness.nrows();
        let mut out = self.forced(&self.stiffness, &self.damping, v);
        if let Some(scale) = &self.scale {
            for j in 0..v.ncols() {
                for i in 0..n {
                    out[(i, j)] = v[(n + i, j)] * scale[i];
                }
            }
        }
        out
    }

    /// `dA V` for changes `dK` and `dC`. The scale `S` is held constant.
    fn forced(&self, stiffness: &Mat<f64>, damping: &Mat<f64>, v: MatRef<'_, c64>) -> Mat<c64> {
        let n = self.stiffness.nrows();
        let Some(scale) = &self.scale else { return times(stiffness, v) * faer::Scale(c64::new(-1.0, 0.0)) };
        let displacement = Mat::from_fn(n, v.ncols(), |i, j| v[(i, j)] / scale[i]);
        let force = times(stiffness, displacement.as_ref()) + times(damping, v.get(n.., ..));
        Mat::from_fn(2 * n, v.ncols(), |i, j| if i < n { c64::ZERO } else { -force[(i - n, j)] })
    }
}

/// The blocks of the groups `wanted`. `groups` must contain every root exactly once.
fn blocks(
    model: &Model,
    spectrum: &Spectrum,
    groups: &[Group],
    wanted: &[Group],
) -> Result<Vec<Block>, SensitivityError> {
    let operator = Operator::new(model, spectrum)?;
    let (right, places) = operator.basis(spectrum, groups)?;
    let size = right.nrows();
    let columns: Vec<usize> = wanted
        .iter()
        .flat_map(|group| {
            let place = groups.iter().position(|other| other == group).map_or(0, |k| places[k]);
            place..place + if group.second.is_some() { 2 } else { 1 }
        })
        .collect();
    // Columns of `W = V⁻ᴴ`, so that `Wᴴ V = I`.
    let unit = Mat::from_fn(size, columns.len(), |i, j| if i == columns[j] { c64::ONE } else { c64::ZERO });
    let left = right.adjoint().to_owned().partial_piv_lu().solve(&unit);
    let chosen = Mat::from_fn(size, columns.len(), |i, j| right[(i, columns[j])]);
    let image = operator.apply(chosen.as_ref());
    let n = model.dimension();
    let (mut stiffness, mut damping) = (Mat::zeros(n, n), Mat::zeros(n, n));
    let here = spectrum.situation();
    let mut slopes = vec![];
    for parameter in Parameter::ALL {
        model.assemble_derivative_at(&here, parameter, &mut stiffness, &mut damping)?;
        slopes.push(operator.forced(&stiffness, &damping, chosen.as_ref()));
    }
    let backward_error = ROUNDING * f64::EPSILON * spectrum.matrix_norm;
    let mut blocks = vec![];
    let mut at = 0;
    for group in wanted {
        let members = if group.second.is_some() { 2 } else { 1 };
        let project = |m: &Mat<c64>| {
            let entry = |a: usize, b: usize| -> c64 {
                if a >= members || b >= members {
                    return c64::ZERO;
                }
                (0..size).map(|i| left[(i, at + a)].conj() * m[(i, at + b)]).sum()
            };
            [[entry(0, 0), entry(0, 1)], [entry(1, 0), entry(1, 1)]]
        };
        let size_of_left = (0..members).map(|a| (0..size).map(|i| left[(i, at + a)].norm_sqr()).sum::<f64>());
        let error = backward_error * size_of_left.sum::<f64>().sqrt();
        if !error.is_finite() {
            return Err(SensitivityError::Singular { root: group.first });
        }
        let mut t = project(&image);
        if members == 1 {
            t[0][0] = value(spectrum, group.first);
        }
        blocks.push(Block { t, dt: std::array::from_fn(|k| project(&slopes[k])), error });
        at += members;
    }
    Ok(blocks)
}

/// Removes the component along the unit vector `unit`, normalises the rest and returns its relative length.
fn orthogonalise(vector: &mut [c64], unit: &[c64]) -> f64 {
    normalise(vector);
    let mut length = 1.0;
    // Two passes are enough (Kahan).
    for _ in 0..2 {
        let along: c64 = unit.iter().zip(vector.iter()).map(|(u, v)| u.conj() * v).sum();
        vector.iter_mut().zip(unit).for_each(|(v, u)| *v -= along * u);
        length *= normalise(vector);
    }
    length
}

/// Scales a vector to norm 1 and returns its previous norm.
fn normalise(vector: &mut [c64]) -> f64 {
    let length = vector.iter().map(|x| x.norm_sqr()).sum::<f64>().sqrt();
    if length > 0.0 {
        vector.iter_mut().for_each(|x| *x /= length);
    }
    length
}

/// Real matrix times complex vectors.
fn times(matrix: &Mat<f64>, v: MatRef<'_, c64>) -> Mat<c64> {
    let re = matrix * Mat::from_fn(v.nrows(), v.ncols(), |i, j| v[(i, j)].re);
    let im = matrix * Mat::from_fn(v.nrows(), v.ncols(), |i, j| v[(i, j)].im);
    Mat::from_fn(re.nrows(), re.ncols(), |i, j| c64::new(re[(i, j)], im[(i, j)]))
}

#[cfg(test)]
mod tests {
    use faer::mat;

    use super::super::law::{ContactLaw, Law};
    use super::super::model::{ContactPairs, Term};
    use super::super::operating_point::OperatingPoint;
    use super::super::solver::Solver;
    use super::super::spectrum::Vectors;
    use super::super::stribeck::Stribeck;
    use super::super::test_models::{REFERENCE, hulten, nine_dof};
    use super::*;
    use crate::proof::synthetic::{Synthetic, rig};

    fn solve(model: &Model, p: &OperatingPoint) -> Spectrum {
        Solver::new(model.dimension()).solve(model, p, Vectors::Right).expect("it solves")
    }

    fn all(model: &Model, spectrum: &Spectrum) -> Vec<RootSensitivity> {
        of_roots(model, spectrum, &(0..spectrum.roots.len()).collect::<Vec<_>>()).expect("it has sensitivities")
    }

    /// Hoffmann's two-degree-of-freedom model, `K = [[2, 1-μ], [1, 2]]`: `λ² = -2 ± √(1 - μ)`, merging at `μ = 1`.
    fn hoffmann() -> Model {
        let term = |matrix, law| Term { matrix, law };
        let terms = vec![
            term(mat![[2.0, 1.0], [1.0, 2.0]], Law::Constant),
            term(mat![[0.0, -1.0], [0.0, 0.0]], Law::FrictionStiffness),
        ];
        Model::new(2, terms, vec![], ContactLaw::default(), None).expect("well formed")
    }

    #[test]
    fn hoffmann_by_hand_before_at_and_beyond_the_merging_point() {
        let model = hoffmann();
        // `d = 1 - μ` and `m = -2` everywhere, so `d' = -1` and `m' = 0`.
        for mu in [0.2, 0.9, 0.999, 1.0 - 1e-9, 1.0 + 1e-9, 1.001, 1.5] {
            let spectrum = solve(&model, &REFERENCE.with_friction(mu));
            let pair = of_pair(&model, &spectrum, 0, 1).unwrap();
            // The span of two vectors `√1e-9` apart is accurate to `1e-16 / √1e-9`.
            assert!((pair.mean + 2.0).norm() < 1e-11 && pair.mean_slope[0].norm() < 1e-10, "{mu}: {pair:?}");
            assert!((pair.discriminant - (1.0 - mu)).norm() < 1e-11, "{mu}: {pair:?}");
            assert!((pair.discriminant - (1.0 - mu)).norm() <= pair.discriminant_error, "{mu}: {pair:?}");
            assert!((pair.discriminant_slope[0] + 1.0).norm() < 1e-10, "{mu}: {pair:?}");
        }
        let far = all(&model, &solve(&model, &REFERENCE.with_friction(0.2)));
        // The first root is `λ = iω` with `ω² = 2 - √0.8`: `dω/dμ = 1 / (4 ω √0.8)`.
        let omega = (2.0 - 0.8f64.sqrt()).sqrt();
        let Change::Linear(slope) = far[0].change else { panic!("0.8 is far from merging: {:?}", far[0]) };
        assert!((slope[0] - c64::new(0.0, 1.0 / (4.0 * omega * 0.8f64.sqrt()))).norm() < 1e-13, "{slope:?}");
        for mu in [0.9999, 1.0001] {
            let near = all(&model, &solve(&model, &REFERENCE.with_friction(mu)));
            assert!(matches!(near[0].change, Change::SquareRoot { partner: 1, .. }), "{near:?}");
        }
    }

    /// Two modes that cross without coupling have linear laws, however close they are.
    #[test]
    fn a_crossing_is_no_merging() {
        let terms = vec![
            Term { matrix: mat![[4.0 - 0.7, 0.0], [0.0, 4.0 + 0.7]], law: Law::Constant },
            Term { matrix: mat![[1.0, 0.0], [0.0, -1.0]], law: Law::FrictionStiffness },
        ];
        let model = Model::new(2, terms, vec![], ContactLaw::default(), None).unwrap();
        for sensitivity in all(&model, &solve(&model, &REFERENCE.with_friction(0.7 + 1e-7))) {
            assert!(matches!(sensitivity.change, Change::Linear(_)), "{sensitivity:?}");
            // Roots near 4 that are 2e-7 apart: the relative error of their distance is 4 ε / 2e-7.
            assert!((sensitivity.slope[0].norm() - 1.0).abs() < 1e-7, "{sensitivity:?}");
        }
    }

    fn moved(p: &OperatingPoint, parameter: Parameter, by: f64) -> OperatingPoint {
        let mut moved = *p;
        parameter.condition(&mut moved).into_iter().for_each(|condition| *condition += by);
        moved
    }

    /// Comparison with central differences of the roots, with every dependence on load and speed, damped and
    /// undamped.
    #[test]
    fn slopes_are_the_derivatives() {
        let laws = [
            (0.01, ContactLaw { exponent: 0.4, slope_s_per_m: -2e-3, lateral_damping: true, ..Default::default() }),
            (
                0.01,
                ContactLaw {
                    stribeck: Some(Stribeck { drop: 0.05, speed_m_s: 1.5, exponent: 2.0 }),
                    ..Default::default()
                },
            ),
            (0.0, ContactLaw { exponent: 0.4, ..Default::default() }),
        ];
        let mut checked = 0;
        for (damping_ratio, contact_law) in laws {
            let model = rig(&Synthetic { modes: 12, pairs: 10, damping_ratio, contact_law, seed: 3 }).unwrap();
            let p = REFERENCE.with_friction(0.31);
            let spectrum = solve(&model, &p);
            for (k, parameter) in Parameter::ALL.into_iter().take(3).enumerate() {
                let step = 1e-5 * [1.0, p.normal_load_n, p.disc_speed_rad_s][k];
                let (up, down) =
                    (solve(&model, &moved(&p, parameter, step)), solve(&model, &moved(&p, parameter, -step)));
                for sensitivity in all(&model, &spectrum) {
                    let Change::Linear(slope) = sensitivity.change else { continue };
                    let root = sensitivity.root;
                    let difference = (up.roots[root].lambda - down.roots[root].lambda) / (2.0 * step);
                    // Tolerance: rounding of `1e-13 |λ| / step`, and truncation, 1e-6 for a root that is nonlinear
                    // over a relative change of 0.01.
                    let limit = 1e-13 * spectrum.roots[root].lambda.norm() / step + 1e-5 * slope[k].norm();
                    assert!((slope[k] - difference).norm() < limit, "{parameter:?} {root}: {} {difference}", slope[k]);
                    checked += usize::from(slope[k].norm() > 0.0);
                }
            }
        }
        assert!(checked > 30, "{checked} slopes other than zero");
    }

    /// Derivatives with respect to contact stiffness and damping, compared with the same rig with other springs and
    /// dampers.
    #[test]
    fn contact_slopes_are_the_derivatives() {
        let with = |stiffer: f64, damper: f64| {
            let diagonal =
                |values: [f64; 2]| Term { matrix: mat![[values[0], 0.0], [0.0, values[1]]], law: Law::Constant };
            let pairs = ContactPairs {
                normal: mat![[0.7, -0.4]],
                sliding: mat![[0.2, 0.9]],
                lateral: mat![[0.0, 0.0]],
                stiffness_n_per_m: vec![5.0 * stiffer],
                damping_n_s_per_m: vec![0.1 * damper],
                radius_m: vec![0.1],
            };
            let model = Model::new(
                2,
                vec![diagonal([9.0, 30.0])],
                vec![diagonal([0.02, 0.03])],
                ContactLaw::default(),
                Some(1),
            );
            model.unwrap().with_contact(&pairs).unwrap()
        };
        let model = with(1.0, 1.0);
        let spectrum = solve(&model, &REFERENCE);
        let step = 1e-5;
        let differences =
            [(3, with(1.0 + step, 1.0), with(1.0 - step, 1.0)), (4, with(1.0, 1.0 + step), with(1.0, 1.0 - step))];
        for (k, up, down) in differences {
            for sensitivity in all(&model, &spectrum) {
                let root = sensitivity.root;
                let difference = (solve(&up, &REFERENCE).roots[root].lambda
                    - solve(&down, &REFERENCE).roots[root].lambda)
                    / (2.0 * step);
                assert!((sensitivity.slope[k] - difference).norm() < 1e-9, "{k} {root}");
                assert!(difference.norm() > 1e-4, "{k} {root}: worth testing");
            }
        }
    }

    /// The paper's 9-degree-of-freedom model at its first merging point: mean and discriminant, extrapolated linearly
    /// in friction, predict the roots on both sides of it, where a linear law of the roots would not.
    #[test]
    fn nine_dof_square_root_law() {
        let model = nine_dof(1.0, 1.0, 1.0);
        let mu = 0.82001495938185 - 1e-5;
        let spectrum = solve(&model, &REFERENCE.with_friction(mu));
        let sensitivity = of_roots(&model, &spectrum, &[1]).unwrap()[0];
        let Change::SquareRoot { partner: 2, pair } = sensitivity.change else { panic!("{sensitivity:?}") };
        for step in [-1e-4, 1e-4, 1e-3] {
            let predicted = (pair.mean + pair.mean_slope[0] * step)
                + (pair.discriminant + pair.discriminant_slope[0] * step).sqrt();
            let there = solve(&model, &REFERENCE.with_friction(mu + step));
            let off =
                [1, 2].map(|k| (there.roots[k].square - predicted).norm()).into_iter().fold(f64::INFINITY, f64::min);
            // Second derivatives of mean and discriminant are below 10, so the error under the square root is of the
            // order of 10 step².
            assert!(off < 30.0 * step.abs().powf(1.5), "{step}: {off}");
        }
    }

    /// Hultén's damped model at its stability limit: the derivative of the growth rate agrees with a central
    /// difference.
    #[test]
    fn hulten_growth() {
        let model = hulten(0.02, 0.10);
        let p = REFERENCE.with_friction(0.35);
        let spectrum = solve(&model, &p);
        let step = 1e-5;
        for sensitivity in all(&model, &spectrum) {
            let at = |mu| solve(&model, &p.with_friction(mu)).roots[sensitivity.root].lambda;
            let difference = (at(0.35 + step) - at(0.35 - step)) / (2.0 * step);
            assert!(
                (sensitivity.slope[0] - difference).norm() < 1e-6 * difference.norm(),
                "{sensitivity:?} {difference}"
            );
        }
    }
}

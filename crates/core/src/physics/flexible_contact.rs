//! Contact with residual flexibility and residual inertia of the truncated modes.
//!
//! Let `R` be the residual flexibility between contact pairs, the sum of both sides. The contact forces `N` satisfy
//! `S(μ) N = -B_n q`:
//!
//! ```text
//! S(μ) = K_c⁻¹ + R_nn + μ R_nt,   S⁻¹ = A K_c,   A = (I + K_c (R_nn + μ R_nt))⁻¹
//! K(μ) = diag(Ω²) + (B_n + μ B_t)ᵀ S⁻¹ B_n
//! C(μ) = diag(2ζΩ) + (B_n + μ B_t)ᵀ A C_c (I + (R_nn + μ R_nt) K_c)⁻¹ B_n
//! M(μ) = I + (B_n + μ B_t)ᵀ S⁻¹ (Q_nn + μ Q_nt) S⁻¹ B_n
//! ```
//!
//! Gyroscopic and spin terms `Ω^p A` of the disc become `Ω^p M⁻¹ A`; the rotation of the truncated modes is omitted.
//!
//! `M⁻¹ K` and `M⁻¹ C` are smooth in `μ`. They become sums of terms: the value at 0, plus `x = s μ` times a Chebyshev
//! expansion of `(f(x) - f(0)) / x`. Damping by the friction slope and by lateral friction acts on modal velocities
//! without `M⁻¹`; the error is of second order in the residual.
//!
//! Source: MacNeal 1971 (residual flexibility); Rubin 1975 (residual inertia); Craig and Chang 1977.

use faer::linalg::solvers::Solve;
use faer::{Mat, MatRef};

use super::law::Law;
use super::model::{ContactPairs, KnownTerm, Model};
use super::model_error::ModelError;
use crate::chebyshev;

/// Maximum condition number of `I + K_c R(μ)`.
const CONDITION_LIMIT: f64 = 1e10;
/// Maximum size of the two highest Chebyshev coefficients, relative to the largest entry of the matrix.
const FIT_LIMIT: f64 = 1e-9;

/// Residuals of the truncated modes between `c` contact pairs, for relative displacement, pad minus disc; sum of both
/// sides.
#[derive(Clone, Debug)]
pub struct ResidualFlexibility {
    /// `R_nn`, `c×c`, m/N: displacement along `n` due to forces along `n`.
    pub normal: Mat<f64>,
    /// `R_nt`, `c×c`, m/N: displacement along `n` due to forces along `t`.
    pub sliding: Mat<f64>,
    /// `Q_nn` and `Q_nt`, `c×c`, s²·m/N; `None` to omit residual inertia.
    pub inertia: Option<[Mat<f64>; 2]>,
}

impl Model {
    /// Adds the terms of a contact with residual flexibility, for friction coefficients up to `range`.
    ///
    /// # Errors
    /// Those of [`Model::with_contact`]; [`ModelError::FlexibleLoadExponent`], [`ModelError::IllConditioned`],
    /// [`ModelError::FlexibilityFit`].
    pub fn with_flexible_contact(
        mut self,
        pairs: &ContactPairs,
        residual: &ResidualFlexibility,
        range: f64,
    ) -> Result<Self, ModelError> {
        let contact = self.flexible_contact(pairs, residual)?;
        let at_rest = contact.at(0.0)?;
        let expansion = contact.expansion(&at_rest, range)?;
        self.add_at_rest(at_rest)?;
        let turning = self.turning_powers();
        for (degree, matrices) in expansion.into_iter().enumerate() {
            let law = Law::FrictionChebyshev { degree, range };
            let turned = |power| Law::DiscSpeedChebyshev { power, degree, range };
            self.add_matrices(
                ["friction stiffness", "friction damping"],
                matrices,
                [law.clone(), law],
                &turning,
                turned,
            )?;
        }
        self.with_friction_damping(pairs)
    }

    /// Adds the contact without friction and without a Chebyshev expansion. The model is valid at friction
    /// coefficient 0 only.
    ///
    /// # Errors
    /// Those of [`Model::with_contact`]; [`ModelError::FlexibleLoadExponent`], [`ModelError::IllConditioned`].
    pub fn with_flexible_contact_at_rest(
        mut self,
        pairs: &ContactPairs,
        residual: &ResidualFlexibility,
    ) -> Result<Self, ModelError> {
        let at_rest = self.flexible_contact(pairs, residual)?.at(0.0)?;
        self.add_at_rest(at_rest)?;
        self.has_contact = true;
        Ok(self.finished())
    }

    /// Adds the contact's stiffness and damping at `μ = 0`.
    fn add_at_rest(&mut self, matrices: Vec<Mat<f64>>) -> Result<(), ModelError> {
        let (turning, laws) = (self.turning_powers(), [Law::ContactStiffness, Law::ContactDamping]);
        let turned = |power| Law::DiscSpeedInContact { power };
        self.add_matrices(["contact stiffness", "contact damping"], matrices, laws, &turning, turned)
    }

    /// Adds the matrices of [`FlexibleContact::at`]: stiffness and damping with their `laws`, and those of the terms of
    /// [`Self::turning_powers`] with the law `turned` of their power.
    fn add_matrices(
        &mut self,
        what: [&str; 2],
        matrices: Vec<Mat<f64>>,
        laws: [Law; 2],
        turning: &[Vec<u8>; 2],
        turned: impl Fn(u8) -> Law,
    ) -> Result<(), ModelError> {
        let [of_stiffness, of_damping] = turning.each_ref().map(|powers| powers.iter().map(|&power| turned(power)));
        let [stiffness, damping] = laws;
        let kinds = [(true, stiffness), (false, damping)].into_iter();
        let kinds = kinds.chain(of_stiffness.map(|law| (true, law))).chain(of_damping.map(|law| (false, law)));
        for (matrix, (is_stiffness, law)) in matrices.into_iter().zip(kinds) {
            if is_stiffness {
                self.add_stiffness(what[0], matrix, law)?;
            } else {
                self.add_damping(what[1], matrix, law)?;
            }
        }
        Ok(())
    }

    /// The powers `p` of the terms of `K` and of `C` with [`Law::DiscSpeed`].
    fn turning_powers(&self) -> [Vec<u8>; 2] {
        [&self.stiffness, &self.damping].map(|terms| turning(terms).map(|(power, _)| power).collect())
    }

    /// Checks the contact and combines it with the model's terms without contact.
    fn flexible_contact<'a>(
        &self,
        pairs: &'a ContactPairs,
        residual: &'a ResidualFlexibility,
    ) -> Result<FlexibleContact<'a>, ModelError> {
        self.check_pairs(pairs)?;
        let exponent = self.contact_law.exponent;
        if exponent != 0.0 {
            return Err(ModelError::FlexibleLoadExponent { exponent });
        }
        let count = pairs.normal.nrows();
        let inertia = residual.inertia.iter().flatten();
        for matrix in [&residual.normal, &residual.sliding].into_iter().chain(inertia) {
            let (rows, columns) = matrix.shape();
            if (rows, columns) != (count, count) {
                let what = "residual flexibility".to_owned();
                return Err(ModelError::Shape { what, rows, columns, expected: count });
            }
        }
        let turning = turning(&self.stiffness).chain(turning(&self.damping));
        let turning = turning.map(|(_, matrix)| matrix.clone()).collect();
        Ok(FlexibleContact { pairs, residual, free: self.constant_terms(), turning })
    }

    /// `K` and `C` without contact.
    fn constant_terms(&self) -> [Mat<f64>; 2] {
        [&self.stiffness, &self.damping].map(|terms| {
            let mut sum = Mat::zeros(self.dimension, self.dimension);
            for known in terms.iter().filter(|known| matches!(known.term.law, Law::Constant)) {
                sum += &known.term.matrix;
            }
            sum
        })
    }
}

/// Power and matrix of each term with [`Law::DiscSpeed`].
fn turning(terms: &[KnownTerm]) -> impl Iterator<Item = (u8, &Mat<f64>)> {
    terms.iter().filter_map(|known| {
        let Law::DiscSpeed { power } = known.term.law else { return None };
        Some((power, &known.term.matrix))
    })
}

/// A contact with residual flexibility and the model it is added to.
struct FlexibleContact<'a> {
    pairs: &'a ContactPairs,
    residual: &'a ResidualFlexibility,
    /// `diag(Ω²)` and `diag(2ζΩ)`.
    free: [Mat<f64>; 2],
    /// Gyroscopic and spin terms.
    turning: Vec<Mat<f64>>,
}

impl FlexibleContact<'_> {
    /// The contribution of the contact to `M⁻¹ K` and `M⁻¹ C` at `x = s μ`, and to `M⁻¹ A` of every gyroscopic and spin
    /// term, all `n×n`. Without residual inertia there are only the first two.
    fn at(&self, x: f64) -> Result<Vec<Mat<f64>>, ModelError> {
        let ContactPairs { normal, sliding, stiffness_n_per_m, damping_n_s_per_m, .. } = self.pairs;
        let c = normal.nrows();
        let flexibility = &self.residual.normal + faer::Scale(x) * &self.residual.sliding;
        let coupled = |by_row: bool| {
            Mat::from_fn(c, c, |i, j| {
                let spring = stiffness_n_per_m[if by_row { i } else { j }];
                spring * flexibility[(i, j)] + if i == j { 1.0 } else { 0.0 }
            })
        };
        let (left, right) = (coupled(true), coupled(false));
        let scaled = |values: &[f64], rows: MatRef<'_, f64>| {
            Mat::from_fn(rows.nrows(), rows.ncols(), |i, j| values[i] * rows[(i, j)])
        };
        let solver = left.partial_piv_lu();
        let inverse = solver.solve(Mat::<f64>::identity(c, c));
        let condition = one_norm(&left) * one_norm(&inverse);
        if condition.is_nan() || condition > CONDITION_LIMIT {
            let limit = CONDITION_LIMIT;
            return Err(ModelError::IllConditioned { friction_coefficient: x, condition, limit });
        }
        // Contact forces per displacement and per velocity: `K_c` and `C_c` in series with the residual flexibility.
        let springs = &inverse * scaled(stiffness_n_per_m, normal.as_ref());
        let seen = right.partial_piv_lu().solve(normal);
        let dampers = &inverse * scaled(damping_n_s_per_m, seen.as_ref());
        let forces = normal + faer::Scale(x) * sliding;
        let mut stiffness = forces.transpose() * &springs;
        let mut damping = forces.transpose() * &dampers;
        if x == 0.0 {
            // Symmetric up to rounding because `R` is; made exactly symmetric.
            stiffness = symmetric_part(&stiffness);
            damping = symmetric_part(&damping);
        }
        if let Some([inertia_n, inertia_t]) = &self.residual.inertia {
            let inertia = inertia_n + faer::Scale(x) * inertia_t;
            let response = &inverse * scaled(stiffness_n_per_m, (inertia * &springs).as_ref());
            let n = normal.ncols();
            let mass = Mat::<f64>::identity(n, n) + forces.transpose() * response;
            let solver = mass.partial_piv_lu();
            // `M⁻¹ (K_free + K_contact) - K_free`, and the same for `C`.
            stiffness = solver.solve(stiffness + &self.free[0]) - &self.free[0];
            damping = solver.solve(damping + &self.free[1]) - &self.free[1];
            let turning = self.turning.iter().map(|term| solver.solve(term) - term);
            return Ok([stiffness, damping].into_iter().chain(turning).collect());
        }
        Ok(vec![stiffness, damping])
    }

    /// Chebyshev coefficients over `[-range, range]` of `(f(x) - at_rest) / x`, where `f` is [`Self::at`].
    fn expansion(&self, at_rest: &[Mat<f64>], range: f64) -> Result<Vec<Vec<Mat<f64>>>, ModelError> {
        // The number of nodes is even so that no node is 0.
        let mut m = 8;
        loop {
            let mut quotients = vec![];
            for node in chebyshev::nodes(m) {
                let x = node * range;
                let moved = self.at(x)?.into_iter().zip(at_rest);
                quotients.push(moved.map(|(moved, rest)| faer::Scale(1.0 / x) * (moved - rest)).collect());
            }
            let expansion = coefficients(&quotients);
            let worst = (0..at_rest.len())
                .map(|part| {
                    let largest = at_rest[part].norm_max() + expansion[0][part].norm_max();
                    let tail = expansion[m - 2][part].norm_max() + expansion[m - 1][part].norm_max();
                    if largest > 0.0 { tail / largest } else { 0.0 }
                })
                .fold(0.0, f64::max);
            if worst < FIT_LIMIT {
                let kept = expansion.iter().rposition(|coefficient| {
                    (0..at_rest.len())
                        .any(|part| coefficient[part].norm_max() > 0.01 * FIT_LIMIT * expansion[0][part].norm_max())
                });
                return Ok(expansion.into_iter().take(kept.map_or(0, |last| last + 1)).collect());
            }
            if m == chebyshev::MOST_DEGREES {
                return Err(ModelError::FlexibilityFit { range, degrees: m, value: worst, limit: FIT_LIMIT });
            }
            m *= 2;
        }
    }
}

/// Chebyshev coefficients of the interpolating polynomial through matrices at the nodes.
fn coefficients(values: &[Vec<Mat<f64>>]) -> Vec<Vec<Mat<f64>>> {
    let m = values.len();
    let weights: Vec<Vec<f64>> = (0..m)
        .map(|node| {
            let mut unit = vec![0.0; m];
            unit[node] = 1.0;
            chebyshev::coefficients(&unit)
        })
        .collect();
    let (rows, columns) = values[0][0].shape();
    let sum = |degree: usize, part: usize| {
        let mut sum = Mat::zeros(rows, columns);
        for (value, weight) in values.iter().zip(&weights) {
            sum += faer::Scale(weight[degree]) * &value[part];
        }
        sum
    };
    (0..m).map(|degree| (0..values[0].len()).map(|part| sum(degree, part)).collect()).collect()
}

fn symmetric_part(matrix: &Mat<f64>) -> Mat<f64> {
    Mat::from_fn(matrix.nrows(), matrix.ncols(), |i, j| 0.5 * (matrix[(i, j)] + matrix[(j, i)]))
}

fn one_norm(matrix: &Mat<f64>) -> f64 {
    matrix.col_iter().map(|column| column.norm_l1()).fold(0.0, f64::max)
}

#[cfg(test)]
mod tests {
    use super::super::law::ContactLaw;
    use super::super::model::Term;
    use super::super::operating_point::OperatingPoint;
    use super::*;

    const KEPT: usize = 4;
    const ALL: usize = 12;
    const PAIRS: usize = 3;

    fn omega(mode: usize) -> f64 {
        1000.0 * (mode + 1) as f64
    }

    /// Contact rows of relative displacement, all different.
    fn rows(modes: usize, phase: f64) -> Mat<f64> {
        Mat::from_fn(PAIRS, modes, |pair, mode| (phase + 1.7 * pair as f64 + 2.3 * mode as f64).sin())
    }

    fn pairs(modes: usize) -> ContactPairs {
        ContactPairs {
            normal: rows(modes, 0.3),
            sliding: rows(modes, 1.1),
            lateral: rows(modes, 2.0),
            stiffness_n_per_m: vec![2e6, 3e6, 0.0],
            damping_n_s_per_m: vec![5.0, 7.0, 1.0],
            radius_m: vec![0.1; PAIRS],
        }
    }

    fn free(modes: usize) -> Model {
        let matrix = Mat::from_fn(modes, modes, |i, j| if i == j { omega(i).powi(2) } else { 0.0 });
        let term = Term { matrix, law: Law::Constant };
        Model::new(modes, vec![term], vec![], ContactLaw::default(), None).unwrap()
    }

    fn residual() -> ResidualFlexibility {
        let all = pairs(ALL);
        let sum = |rows: &Mat<f64>, power: i32| {
            Mat::from_fn(PAIRS, PAIRS, |a, b| {
                (KEPT..ALL).map(|k| all.normal[(a, k)] * rows[(b, k)] / omega(k).powi(power)).sum()
            })
        };
        ResidualFlexibility {
            normal: sum(&all.normal, 2),
            sliding: sum(&all.sliding, 2),
            inertia: Some([sum(&all.normal, 4), sum(&all.sliding, 4)]),
        }
    }

    fn assembled(model: &Model, mu: f64) -> [Mat<f64>; 2] {
        let n = model.dimension();
        let (mut stiffness, mut damping) = (Mat::zeros(n, n), Mat::zeros(n, n));
        let point =
            OperatingPoint { normal_load_n: 500.0, disc_speed_rad_s: mu.signum(), friction_coefficient: mu.abs() };
        model.assemble(&point, &mut stiffness, &mut damping).unwrap();
        [stiffness, damping]
    }

    /// Static condensation of the modes beyond [`KEPT`], by block elimination in the model of all modes. Returns `K`,
    /// `M` and `C`.
    fn condensed(mu: f64) -> [Mat<f64>; 3] {
        let [stiffness, damping] = assembled(&free(ALL).with_contact(&pairs(ALL)).unwrap(), mu);
        let rest = ALL - KEPT;
        let part = |matrix: &Mat<f64>, i: usize, j: usize| {
            let (from, size) = (|k: usize| k * KEPT, |k: usize| if k == 0 { KEPT } else { rest });
            matrix.submatrix(from(i), from(j), size(i), size(j)).to_owned()
        };
        let inverse = part(&stiffness, 1, 1).partial_piv_lu().solve(Mat::<f64>::identity(rest, rest));
        let right = -(&inverse * part(&stiffness, 1, 0));
        let left = -(part(&stiffness, 0, 1) * &inverse);
        let seen = |m: &Mat<f64>| {
            part(m, 0, 0) + part(m, 0, 1) * &right + &left * part(m, 1, 0) + &left * part(m, 1, 1) * &right
        };
        let mass = Mat::<f64>::identity(KEPT, KEPT) + &left * &right;
        [part(&stiffness, 0, 0) + part(&stiffness, 0, 1) * &right, mass, seen(&damping)]
    }

    #[test]
    fn truncated_modes_follow_statically() {
        let mut flexibility = residual();
        let with_inertia = free(KEPT).with_flexible_contact(&pairs(KEPT), &flexibility, 1.0).unwrap();
        flexibility.inertia = None;
        let without = free(KEPT).with_flexible_contact(&pairs(KEPT), &flexibility, 1.0).unwrap();
        for mu in [0.0, 0.123, 0.377, 0.9, 1.0, -0.6] {
            let [stiffness, mass, damping] = condensed(mu);
            let solver = mass.partial_piv_lu();
            let [k, c] = assembled(&without, mu);
            let [k_inertia, c_inertia] = assembled(&with_inertia, mu);
            for (found, expected) in [
                (k, stiffness.clone()),
                (c, damping.clone()),
                (k_inertia, solver.solve(&stiffness)),
                (c_inertia, solver.solve(&damping)),
            ] {
                // The expansion is truncated where its last coefficients fall below 1e-9.
                let error = (&found - &expected).norm_max() / expected.norm_max();
                assert!(error < 1e-8, "mu {mu}: {error:e}");
            }
        }
        // At `μ = 0`, `K` is exactly symmetric, which the choice of the solver depends on; and equal to the model
        // without expansion.
        let [k, _] = assembled(&without, 0.0);
        assert_eq!(k, k.transpose().to_owned());
        let at_rest = free(KEPT).with_flexible_contact_at_rest(&pairs(KEPT), &residual()).unwrap();
        assert_eq!(assembled(&at_rest, 0.0), assembled(&with_inertia, 0.0));
        assert_eq!(assembled(&with_inertia.without_contact(), 0.0), assembled(&free(KEPT), 0.0));
    }

    #[test]
    fn without_residual_it_is_the_plain_contact() {
        let zero = Mat::<f64>::zeros(PAIRS, PAIRS);
        let none = ResidualFlexibility { normal: zero.clone(), sliding: zero, inertia: None };
        let flexible = free(KEPT).with_flexible_contact(&pairs(KEPT), &none, 2.0).unwrap();
        let plain = free(KEPT).with_contact(&pairs(KEPT)).unwrap();
        for mu in [0.0, 0.4, -1.9] {
            for (found, expected) in assembled(&flexible, mu).iter().zip(assembled(&plain, mu)) {
                assert!((found - &expected).norm_max() <= 1e-13 * expected.norm_max(), "{mu}");
            }
        }
    }

    #[test]
    fn unsupported_contacts_are_refused() {
        let with = |residual: &ResidualFlexibility, law: ContactLaw, range: f64| {
            let mut model = free(KEPT);
            model.contact_law = law;
            model.with_flexible_contact(&pairs(KEPT), residual, range).map(|_| ()).unwrap_err()
        };
        let hertzian = ContactLaw { exponent: 1.0 / 3.0, ..ContactLaw::default() };
        assert!(matches!(with(&residual(), hertzian, 1.0), ModelError::FlexibleLoadExponent { .. }));
        // The first pivot of `I + K_c R` becomes zero near `μ = 0.5`: `1 + 2e6 (1e-6 - 3e-6 μ)`.
        let one = |value: f64| Mat::from_fn(PAIRS, PAIRS, |i, j| if i == 0 && j == 0 { value } else { 0.0 });
        let singular = ResidualFlexibility { normal: one(1e-6), sliding: one(-3e-6), inertia: None };
        let refused = with(&singular, ContactLaw::default(), 1.0);
        assert!(matches!(refused, ModelError::FlexibilityFit { .. } | ModelError::IllConditioned { .. }), "{refused}");
        let fitted = free(KEPT).with_flexible_contact(&pairs(KEPT), &residual(), 0.5).unwrap();
        let (mut k, mut c) = (Mat::zeros(KEPT, KEPT), Mat::zeros(KEPT, KEPT));
        let beyond = OperatingPoint { normal_load_n: 500.0, disc_speed_rad_s: 1.0, friction_coefficient: 0.6 };
        assert!(matches!(fitted.assemble(&beyond, &mut k, &mut c), Err(ModelError::LawNotFinite { .. })));
    }
}

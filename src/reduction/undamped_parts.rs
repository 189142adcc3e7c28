//! Roots and vectors of undamped parts in contact, from one symmetric factor of each part for all operating points.
//!
//! ```text
//! K(p) x = κ M x,  λ² = -κ,   K(p) + s M = A + U B_n,   A = diag(K_part + s M_part) = L Lᵀ,   U = (B_n + μ B_t)ᵀ κ(N) K_c
//! (A + U B_n)⁻¹ = A⁻¹ - A⁻¹ U (I + B_n A⁻¹ U)⁻¹ B_n A⁻¹
//! ```
//!
//! Arnoldi's method in the inner product of `M` on `(K + s M)⁻¹ M`, and on its transposed for the left vectors, until all
//! eigenvalues `κ` with `|κ + s|` up to what the band asks for have converged: real roots and those that flutter.
//!
//! Source: Sherman, Morrison, Woodbury; Saad, "Numerical methods for large eigenvalue problems" (2011), chapter 6.

use faer::linalg::solvers::{PartialPivLu, Solve};
use faer::{Mat, MatRef, c64};

use super::full_model::{FullModel, SparseRow};
use super::lanczos::random_block;
use super::pencil::{Llt, Pencil};
use super::{Eigenpair, FullSource, ReductionError};
use crate::physics::{Law, OperatingPoint};

/// Steps of the recurrence between looks at what has converged.
const STEPS: usize = 20;
/// Steps after which it is given up.
const MOST_STEPS: usize = 1000;
/// Residual of a converged eigenvalue, relative to it.
const CONVERGED: f64 = 1e-13;

/// The parts of a model, ordered and analysed.
pub struct PartPencils<'a>(Vec<Pencil<'a>>);

impl<'a> PartPencils<'a> {
    /// Orders and analyses every part of `full`.
    ///
    /// # Errors
    /// [`ReductionError`]: shapes, symmetry, definiteness, `Factorisation`.
    pub fn new(full: &'a FullModel) -> Result<Self, ReductionError> {
        let pencils = full.parts.iter().map(|part| Pencil::new(&part.name, &part.mass, &part.stiffness));
        pencils.collect::<Result<_, _>>().map(Self)
    }
}

/// Parts with their factors, joined by contact without damping.
pub struct UndampedParts<'a> {
    full: &'a FullModel,
    factors: Vec<Llt<'a>>,
    shift: f64,
    /// `A⁻¹ B_nᵀ` and `A⁻¹ B_tᵀ`, `n×c`.
    normal: Mat<f64>,
    sliding: Mat<f64>,
}

/// `K + s M` at an operating point.
struct At<'a> {
    parts: &'a UndampedParts<'a>,
    friction: f64,
    /// `κ(N) k` of every pair.
    stiffness: Vec<f64>,
    /// `A⁻¹ U`.
    pushed: Mat<f64>,
    /// `I + B_n A⁻¹ U`.
    small: PartialPivLu<f64>,
}

impl<'a> UndampedParts<'a> {
    /// Whether `full` is of that kind: parts, joined by contact, and nothing that damps.
    pub fn fits(full: &FullModel) -> bool {
        let law = &full.contact_law;
        full.stiffness.is_empty()
            && full.damping.is_empty()
            && !law.lateral_damping
            && law.slope_s_per_m == 0.0
            && full.contact.as_ref().is_some_and(|contact| contact.damping_n_s_per_m.iter().all(|c| *c == 0.0))
    }

    /// Factors the parts at the shift `s = shift_rad_s²`, which makes them positive definite.
    ///
    /// # Errors
    /// [`ReductionError`]: `NoShift`, `Factorisation`.
    pub fn new(full: &'a FullModel, pencils: &'a PartPencils<'a>, shift_rad_s: f64) -> Result<Self, ReductionError> {
        let shift = shift_rad_s * shift_rad_s;
        let mut factors = vec![];
        for pencil in &pencils.0 {
            let no_shift = ReductionError::NoShift { what: pencil.what.to_owned(), value: shift };
            factors.push(pencil.llt(shift)?.ok_or(no_shift)?);
        }
        let mut parts = Self { full, factors, shift, normal: Mat::new(), sliding: Mat::new() };
        let rows = |rows: &[SparseRow]| {
            let mut dense = Mat::<f64>::zeros(full.dimension(), rows.len());
            for (pair, row) in rows.iter().enumerate() {
                row.iter().for_each(|&(i, weight)| dense[(i, pair)] += weight);
            }
            dense
        };
        let contact = full.contact.as_ref().expect("parts in contact");
        let (mut normal, mut sliding) = (rows(&contact.normal), rows(&contact.sliding));
        parts.solve(&mut normal);
        parts.solve(&mut sliding);
        (parts.normal, parts.sliding) = (normal, sliding);
        Ok(parts)
    }

    /// `A⁻¹ X` in place.
    fn solve(&self, x: &mut Mat<f64>) {
        for ((factor, part), offset) in self.factors.iter().zip(&self.full.parts).zip(self.full.offsets()) {
            // The factor wants columns that follow each other in memory.
            let mut rows = x.subrows(offset, part.mass.nrows()).to_owned();
            factor.solve(rows.as_mut());
            x.subrows_mut(offset, part.mass.nrows()).copy_from(&rows);
        }
    }

    fn at(&self, p: &OperatingPoint) -> At<'_> {
        let contact = self.full.contact.as_ref().expect("parts in contact");
        let value = |law: Law| law.value(&self.full.contact_law, p.contact_state(), p);
        let (kappa, friction) = (value(Law::ContactStiffness), value(Law::FrictionDamping));
        let stiffness: Vec<f64> = contact.stiffness_n_per_m.iter().map(|k| kappa * k).collect();
        let pushed = Mat::from_fn(self.normal.nrows(), stiffness.len(), |i, pair| {
            (self.normal[(i, pair)] + friction * self.sliding[(i, pair)]) * stiffness[pair]
        });
        let mut small = rows_times(&contact.normal, pushed.as_ref());
        (0..small.nrows()).for_each(|pair| small[(pair, pair)] += 1.0);
        At { parts: self, friction, stiffness, pushed, small: small.partial_piv_lu() }
    }

    /// Every `κ` with `|κ + s|` at most what the band asks for, and its vectors of one side, in the norm of `M`.
    fn eigen(&self, at: &At<'_>, band_rad_s: f64, transposed: bool) -> Result<Vec<(c64, Mat<c64>)>, ReductionError> {
        let full = self.full;
        let n = full.dimension();
        let failed = |reason: String| ReductionError::Factorisation { what: "full model".to_owned(), reason };
        let wanted = band_rad_s * band_rad_s + self.shift;
        let mut basis = Mat::<f64>::zeros(n, 0);
        // The same times M: inner products cost no further product.
        let mut weighted = Mat::<f64>::zeros(n, 0);
        let most = MOST_STEPS.min(n);
        let mut hessenberg = Mat::<f64>::zeros(most + 1, most);
        let mut last = 0;
        let mut vector = at.solve(&full.mass_times(random_block(n, 1, 1).as_ref()), transposed);
        let mut of_vector = full.mass_times(vector.as_ref());
        let length = (vector.transpose() * &of_vector)[(0, 0)].sqrt();
        vector *= faer::Scale(1.0 / length);
        of_vector *= faer::Scale(1.0 / length);
        while last < most {
            let first = last;
            last = (first + STEPS).min(most);
            basis.resize_with(n, last, |_, _| 0.0);
            weighted.resize_with(n, last, |_, _| 0.0);
            let mut beyond = 0.0;
            for size in first + 1..=last {
                basis.col_mut(size - 1).copy_from(vector.col(0));
                weighted.col_mut(size - 1).copy_from(of_vector.col(0));
                let mut next = at.solve(&of_vector, transposed);
                for _ in 0..2 {
                    let step = weighted.subcols(0, size).transpose() * &next;
                    next -= basis.subcols(0, size) * &step;
                    (0..size).for_each(|i| hessenberg[(i, size - 1)] += step[(i, 0)]);
                }
                let of_next = full.mass_times(next.as_ref());
                beyond = (next.transpose() * &of_next)[(0, 0)].max(0.0).sqrt();
                hessenberg[(size, size - 1)] = beyond;
                vector = faer::Scale(1.0 / beyond) * next;
                of_vector = faer::Scale(1.0 / beyond) * of_next;
            }
            let eigen = hessenberg.submatrix(0, 0, last, last).eigen().map_err(|error| failed(format!("{error:?}")))?;
            let (theta, vectors) = (eigen.S().column_vector(), eigen.U());
            let mut order: Vec<usize> = (0..last).collect();
            order.sort_by(|&a, &b| theta[b].norm().total_cmp(&theta[a].norm()));
            let converged = |k: &usize| {
                let tail = beyond * vectors[(last - 1, *k)].norm() / vectors.col(*k).norm_l2();
                tail < CONVERGED * theta[*k].norm()
            };
            let good = order.iter().take_while(|k| converged(k)).count();
            let reached =
                if good == n { f64::INFINITY } else { order.get(good).map_or(0.0, |&k| 1.0 / theta[k].norm()) };
            if reached > wanted {
                return Ok(order[..good]
                    .iter()
                    .filter(|&&k| 1.0 / theta[k].norm() <= wanted)
                    .map(|&k| {
                        let parts =
                            Mat::from_fn(last, 2, |i, j| if j == 0 { vectors[(i, k)].re } else { vectors[(i, k)].im });
                        let parts = &basis * &parts;
                        let shape = Mat::from_fn(n, 1, |i, _| c64::new(parts[(i, 0)], parts[(i, 1)]));
                        (1.0 / theta[k] - self.shift, shape)
                    })
                    .collect());
            }
            if good == n {
                break;
            }
        }
        Err(failed(format!("the band has not converged after {MOST_STEPS} steps")))
    }
}

impl At<'_> {
    /// `(K + s M)⁻¹ X`, or of the transposed.
    fn solve(&self, x: &Mat<f64>, transposed: bool) -> Mat<f64> {
        let parts = self.parts;
        let contact = parts.full.contact.as_ref().expect("parts in contact");
        let mut solved = x.clone();
        parts.solve(&mut solved);
        let of_normal = rows_times(&contact.normal, solved.as_ref());
        if !transposed {
            let forces = self.small.solve(&of_normal);
            return solved - &self.pushed * forces;
        }
        let of_sliding = rows_times(&contact.sliding, solved.as_ref());
        let pushed = Mat::from_fn(of_normal.nrows(), of_normal.ncols(), |pair, j| {
            self.stiffness[pair] * (of_normal[(pair, j)] + self.friction * of_sliding[(pair, j)])
        });
        let forces = self.small.solve_transpose(&pushed);
        solved - &parts.normal * forces
    }
}

impl FullSource for UndampedParts<'_> {
    fn roots(&mut self, p: &OperatingPoint, band_rad_s: f64) -> Result<Vec<c64>, ReductionError> {
        let found = self.eigen(&self.at(p), band_rad_s, false)?;
        Ok(found.into_iter().map(|(kappa, _)| root(kappa)).filter(|lambda| lambda.im > 0.0).collect())
    }

    fn pairs(
        &mut self,
        p: &OperatingPoint,
        band_rad_s: f64,
        wanted: &dyn Fn(c64) -> bool,
    ) -> Result<(Vec<c64>, Vec<Eigenpair>), ReductionError> {
        let at = self.at(p);
        let (right, mut left) = (self.eigen(&at, band_rad_s, false)?, self.eigen(&at, band_rad_s, true)?);
        let (mut roots, mut pairs) = (vec![], vec![]);
        for (kappa, shape) in right {
            let lambda = root(kappa);
            if lambda.im <= 0.0 {
                continue;
            }
            roots.push(lambda);
            if !wanted(lambda) {
                continue;
            }
            // xᵀ of the transposed problem is yᴴ.
            let nearest = (0..left.len())
                .min_by(|&a, &b| (left[a].0 - kappa).norm().total_cmp(&(left[b].0 - kappa).norm()))
                .filter(|&k| (left[k].0 - kappa).norm() < 1e-6 * kappa.norm());
            let Some(nearest) = nearest else {
                let reason = format!("{lambda} has no left vector at {p:?}");
                return Err(ReductionError::Factorisation { what: "full model".to_owned(), reason });
            };
            let (other, left) = left.swap_remove(nearest);
            let left = Mat::from_fn(left.nrows(), 1, |i, _| left[(i, 0)].conj());
            pairs.push(Eigenpair { lambda, right: shape, left, residual: (other - kappa).norm() / kappa.norm() });
        }
        Ok((roots, pairs))
    }
}

/// `λ` with `λ² = -κ`, of the two the one that oscillates with `ω >= 0`.
fn root(kappa: c64) -> c64 {
    // A real one is exactly real: its root has no growth rate.
    let lambda = if kappa.im == 0.0 && kappa.re > 0.0 { c64::new(0.0, kappa.re.sqrt()) } else { (-kappa).sqrt() };
    if lambda.im < 0.0 { -lambda } else { lambda }
}

/// A matrix of sparse rows times `x`.
fn rows_times(rows: &[SparseRow], x: MatRef<'_, f64>) -> Mat<f64> {
    Mat::from_fn(rows.len(), x.ncols(), |pair, j| rows[pair].iter().map(|&(i, weight)| weight * x[(i, j)]).sum())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::physics::ContactLaw;
    use crate::reduction::SparseSource;
    use crate::reduction::eigenpair::tests::residuals;
    use crate::reduction::test_models::chains;

    /// The same roots as by sparse factors of the whole, with flutter among them, whatever load and direction; both
    /// vectors satisfy their equation.
    #[test]
    fn the_same_roots_as_of_the_whole() {
        let full = chains(0.0, ContactLaw { exponent: 0.5, ..Default::default() });
        assert!(UndampedParts::fits(&full));
        assert!(!UndampedParts::fits(&chains(1.0, ContactLaw::default())));
        let pencils = PartPencils::new(&full).unwrap();
        let mut source = UndampedParts::new(&full, &pencils, 300.0).unwrap();
        let (band, mut growing) = (1500.0, 0);
        for (normal_load_n, disc_speed_rad_s, friction_coefficient) in
            [(500.0, 13.0, 0.0), (500.0, 13.0, 0.9), (2000.0, -5.0, 0.7), (60.0, 13.0, 1.0)]
        {
            let p = OperatingPoint { normal_load_n, disc_speed_rad_s, friction_coefficient };
            let expected = SparseSource { full: &full }.roots(&p, band).unwrap();
            let (roots, pairs) = source.pairs(&p, band, &|_| true).unwrap();
            let inside: Vec<c64> = roots.into_iter().filter(|root| root.im <= band).collect();
            assert!(expected.len() > 8 && inside.len() == expected.len(), "{} {}", inside.len(), expected.len());
            for lambda in expected {
                growing += usize::from(lambda.re > 1.0);
                let nearest = inside.iter().map(|root| (root - lambda).norm()).fold(f64::INFINITY, f64::min);
                assert!(nearest < 1e-9 * lambda.norm(), "{p:?} {lambda}: {nearest:e}");
            }
            for pair in &pairs {
                let [right, left] = residuals(&full, &p, pair);
                assert!(right < 1e-11 && left < 1e-11, "{p:?} {}: {right:e} {left:e}", pair.lambda);
            }
        }
        assert!(growing > 0, "no flutter in this test");
    }
}

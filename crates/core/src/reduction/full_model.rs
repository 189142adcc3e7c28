//! The full model: the matrices of a finite-element model before reduction.
//!
//! ```text
//! M q̈ + C(p) q̇ + K(p) q = 0,   K(p) = diag(K_part) + Σ law(p) K_term + κ(N) (B_n + s μ B_t)ᵀ K_c B_n
//! C(p) = Σ law(p) C_term + (B_n + s μ B_t)ᵀ C_c B_n + dμ/dv B_tᵀ diag(N_0) B_t + μ B_bᵀ diag(N_0 / v) B_b
//! ```
//!
//! `B_n`, `B_t` and `B_b` are the rows of the contact pairs along the normal, the sliding and the lateral direction.
//! `K_c` and `C_c` hold stiffness and damping of the pairs on their diagonals. `κ(N)` is the load dependence of the
//! contact stiffness, `s` the sign of the disc speed, `N_0` the normal load per pair and `v` the sliding speed at the
//! pair. Friction terms vanish without sliding, all contact terms if the contact is open. About a state of steady sliding
//! (`full_state`) `κ K_c`, `C_c` and `N_0` are those of the state.
//!
//! All matrices are sparse. The parts are symmetric and not coupled to each other, terms may have any symmetry, and the
//! rows `B` of the contact pairs couple the parts. [`FullModel::project`] projects everything on a basis, which gives
//! an ordinary [`Model`].

use std::sync::Arc;

use faer::sparse::Triplet;
use faer::{Mat, MatRef};

use super::dense::symmetric_eigen;
use super::sparse::{
    SparseMatrix, entries, first_asymmetry, is_symmetric, symmetric_times, times, times_transposed, weighted_sum,
};
use super::{ReductionError, SparseModes, project_dense, project_sparse, whiten};
use crate::contact::Statics;
use crate::physics::{ContactLaw, ContactPairs, Law, Model, ModelError, OperatingPoint, Situation, Term};

/// A part of a full model: a substructure with its contact interface free, or a whole system.
#[derive(Clone, Debug)]
pub struct FullPart {
    /// Name in errors: `pad`, `disc` or `system`.
    pub name: String,
    /// `M`, `n×n`, kg, symmetric, positive semidefinite with a positive diagonal.
    pub mass: SparseMatrix,
    /// Constant `K`, `n×n`, N/m, symmetric; empty if all stiffness is in terms.
    pub stiffness: SparseMatrix,
}

/// A sparse matrix multiplied by a law that depends on the operating point.
#[derive(Clone, Debug)]
pub struct SparseTerm {
    /// `n×n` over the rows of all parts.
    pub matrix: SparseMatrix,
    /// Scalar factor of the matrix, as a function of the operating point.
    pub law: Law,
}

/// A linear form of the displacements: a list of `(row, weight)`.
pub type SparseRow = Vec<(usize, f64)>;

/// Contact pairs over the rows of all parts: relative displacement, pad minus disc, along the triad `n`, `t`, `b`.
#[derive(Clone, Debug, Default)]
pub struct FullContact {
    /// `B_n`: displacement along the contact normal, one row per pair.
    pub normal: Vec<SparseRow>,
    /// `B_t`: displacement along the sliding direction, one row per pair.
    pub sliding: Vec<SparseRow>,
    /// `B_b`: displacement along `b = n × t`, one row per pair.
    pub lateral: Vec<SparseRow>,
    /// `k` per pair at the reference load, N/m.
    pub stiffness_n_per_m: Vec<f64>,
    /// `c` per pair, N·s/m.
    pub damping_n_s_per_m: Vec<f64>,
    /// Distance of each pair from the disc's axis, m.
    pub radius_m: Vec<f64>,
    /// Steady sliding of pairs that open and close; `None` for pairs that are always closed.
    pub steady: Option<FullSteady>,
}

/// The load of a full model, and its statics of steady sliding.
#[derive(Clone, Debug)]
pub struct FullSteady {
    /// `p`: generalised force of a load of 1 N, over the rows of all parts.
    pub load: SparseRow,
    /// Statics of the contact pairs, in their order.
    pub statics: Arc<Statics>,
    /// `c_ref / k_ref` of each pair, s.
    pub(super) relaxation_s: Vec<f64>,
}

/// A full model. The rows of its parts are concatenated in order.
#[derive(Clone, Debug)]
pub struct FullModel {
    /// Pad and disc, or a single system.
    pub parts: Vec<FullPart>,
    /// Terms of `K` in addition to parts and contact pairs.
    pub stiffness: Vec<SparseTerm>,
    /// Terms of `C` in addition to contact pairs.
    pub damping: Vec<SparseTerm>,
    /// Damping of modes of the parts.
    pub modal_damping: Vec<ModalDamping>,
    /// Contact pairs; `None` for a model described by terms only.
    pub contact: Option<FullContact>,
    /// How contact and friction depend on load and speed.
    pub contact_law: ContactLaw,
}

/// A full model projected on a basis.
#[derive(Clone, Debug)]
pub struct Projected {
    /// `V`, `n×k`, kg^-1/2: mass-normalised, and `Vᵀ diag(K_part) V = diag(Ω²)`.
    pub basis: Mat<f64>,
    /// `Ω²`, rad²/s², ascending.
    pub omega_squared: Vec<f64>,
    /// The contact pairs in the coordinates of the basis.
    pub contact: Option<ContactPairs>,
    /// Statics of the full model if its pairs open and close: on the basis they are the same.
    pub statics: Option<Arc<Statics>>,
    /// Terms of `K` in the coordinates of the basis, without parts and contact pairs.
    pub stiffness: Vec<Term>,
    /// Terms of `C` in the coordinates of the basis, without contact pairs.
    pub damping: Vec<Term>,
}

/// Matrices of a part that turns with the disc speed in the frame of the other part, all `n×n`, kg.
#[derive(Clone, Debug, Default)]
pub struct PartTurning {
    /// `H`, skew: the force is `2 Ω H u̇`.
    pub gyroscopic: Option<SparseMatrix>,
    /// `L`, symmetric: the force is `-Ω² L u`.
    pub spin: Option<SparseMatrix>,
    /// `K_σ`, symmetric: the force is `Ω² K_σ u`, of the stress of the centrifugal load at 1 rad/s.
    pub stress_stiffening: Option<SparseMatrix>,
}

/// Damping of some modes of a part: `C = W diag(2 ζ ω) Wᵀ` with `W = M Φ`.
#[derive(Clone, Debug)]
pub struct ModalDamping {
    /// Index of the part.
    pub part: usize,
    /// `W`, with a row for each of the part, kg^1/2.
    pub mass_times_modes: Mat<f64>,
    /// `2 ζ ω` of each mode, 1/s, above 0.
    pub rates_per_s: Vec<f64>,
}

/// Damping and rotation of a part in mass-normalised coordinates, all `k×k`.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct PartMatrices {
    /// Constant damping, 1/s, symmetric.
    pub damping: Option<Mat<f64>>,
    /// `Φᵀ H Φ`, skew.
    pub gyroscopic: Option<Mat<f64>>,
    /// `Φᵀ (L - K_σ) Φ`, symmetric.
    pub spin: Option<Mat<f64>>,
}

/// A sum over contact pairs, `leftᵀ diag(weights) right`, with one row of `left` and `right` per pair.
struct ContactTerm<'a> {
    left: Vec<SparseRow>,
    weights: Vec<f64>,
    right: &'a [SparseRow],
}

/// A low-rank matrix `Σ leftᵀ (stiffness + λ damping) right`.
#[derive(Clone, Debug, Default)]
pub(super) struct LowRank {
    pub left: Vec<SparseRow>,
    pub right: Vec<SparseRow>,
    pub stiffness: Vec<f64>,
    pub damping: Vec<f64>,
}

impl FullModel {
    /// Number of degrees of freedom, `n`.
    pub fn dimension(&self) -> usize {
        self.parts.iter().map(|part| part.mass.nrows()).sum()
    }

    /// The first row of every part.
    pub fn offsets(&self) -> Vec<usize> {
        let mut next = 0;
        self.parts
            .iter()
            .map(|part| {
                let offset = next;
                next += part.mass.nrows();
                offset
            })
            .collect()
    }

    /// Whether the model depends on load and on speed, apart from opening of the contact, stopping and reversal of
    /// sliding: `(load, speed)`.
    pub fn depends_on_load_and_speed(&self) -> (bool, bool) {
        let of_terms = self.stiffness.iter().chain(&self.damping).map(|term| &term.law);
        let by_state = self.statics().is_some();
        of_terms.chain(&self.contact_laws()).fold((by_state, false), |(load, speed), law| {
            let (by_load, by_speed) = law.depends_on_load_and_speed(&self.contact_law);
            (load | by_load, speed | by_speed)
        })
    }

    /// The laws of the contact that are not zero at every operating point.
    fn contact_laws(&self) -> Vec<Law> {
        if self.contact.is_none() {
            return vec![];
        }
        let mut laws = vec![Law::ContactStiffness, Law::FrictionStiffness, Law::ContactDamping, Law::FrictionDamping];
        laws.extend((self.contact_law.slope_s_per_m != 0.0).then_some(Law::FrictionSlope));
        let radius_m = self.contact.iter().flat_map(|contact| &contact.radius_m).copied().next().unwrap_or(0.0);
        laws.extend(self.contact_law.stribeck.map(|_| Law::FallingFriction { radius_m }));
        laws.extend(self.contact_law.lateral_damping.then_some(Law::LateralFriction));
        laws
    }

    /// Whether `C` vanishes at every operating point.
    pub(super) fn is_undamped(&self) -> bool {
        let ContactLaw { exponent: _, reference_n: _, slope_s_per_m, stribeck, lateral_damping } = self.contact_law;
        let rubs = slope_s_per_m != 0.0 || stribeck.is_some() || lateral_damping;
        let dampers = |contact: &FullContact| contact.damping_n_s_per_m.iter().any(|damping| *damping != 0.0);
        let inside = !self.damping.is_empty() || !self.modal_damping.is_empty();
        !inside && !self.contact.as_ref().is_some_and(|contact| rubs || dampers(contact))
    }

    /// Value of `law` at `p`; a model without contact pairs is always closed.
    fn value(&self, law: &Law, p: &OperatingPoint) -> f64 {
        law.value(&self.contact_law, self.contact.is_some(), p)
    }

    /// Assembles `M`, `C(p)` and `K(p)`, `n×n`, both triangles stored. `C` is without the damping of modes, which would
    /// fill it.
    ///
    /// # Errors
    /// [`ReductionError::Factorisation`] if memory is insufficient; [`ReductionError::State`].
    pub fn matrices_at(&self, p: &OperatingPoint) -> Result<[SparseMatrix; 3], ReductionError> {
        self.matrices_in(&self.at(p)?)
    }

    /// Does the same as [`Self::matrices_at`] where the contact state is known.
    pub(super) fn matrices_in(&self, here: &Situation) -> Result<[SparseMatrix; 3], ReductionError> {
        let p = here.point();
        let n = self.dimension();
        let (mut mass, mut damping, mut stiffness) = (vec![], vec![], vec![]);
        for (part, offset) in self.parts.iter().zip(self.offsets()) {
            for (matrix, triplets) in [(&part.mass, &mut mass), (&part.stiffness, &mut stiffness)] {
                triplets.extend(entries(matrix).map(|(i, j, value)| Triplet::new(offset + i, offset + j, value)));
            }
        }
        for (terms, triplets) in [(&self.stiffness, &mut stiffness), (&self.damping, &mut damping)] {
            for term in terms {
                let factor = self.value(&term.law, p);
                triplets.extend(entries(&term.matrix).map(|(i, j, value)| Triplet::new(i, j, factor * value)));
            }
        }
        let [contact_stiffness, contact_damping] = self.contact_terms(here);
        for (terms, triplets) in [(contact_stiffness, &mut stiffness), (contact_damping, &mut damping)] {
            for term in &terms {
                for ((left, weight), right) in term.left.iter().zip(&term.weights).zip(term.right) {
                    for &(i, a) in left {
                        triplets.extend(right.iter().map(|&(j, b)| Triplet::new(i, j, a * weight * b)));
                    }
                }
            }
        }
        let build = |triplets: &[Triplet<usize, usize, f64>]| {
            SparseMatrix::try_new_from_triplets(n, n, triplets).map_err(|error| ReductionError::Factorisation {
                what: "full model".to_owned(),
                reason: format!("could not be stored: {error:?}"),
            })
        };
        Ok([build(&mass)?, build(&damping)?, build(&stiffness)?])
    }

    /// Low-rank contributions of the contact to `K` and `C`; terms whose weights are all 0 are omitted.
    fn contact_terms(&self, here: &Situation) -> [Vec<ContactTerm<'_>>; 2] {
        let Some(contact) = &self.contact else { return [vec![], vec![]] };
        let (p, pairs) = (here.point(), contact.pairs_in(here));
        let [kappa, damper, friction, slope, lateral] = [
            Law::ContactStiffness,
            Law::ContactDamping,
            Law::FrictionDamping,
            Law::FrictionSlope,
            Law::LateralFriction,
        ]
        .map(|law| self.value(&law, p));
        let pushed: Vec<SparseRow> = contact
            .normal
            .iter()
            .zip(&contact.sliding)
            .map(|(n, t)| n.iter().copied().chain(t.iter().map(|&(row, weight)| (row, friction * weight))).collect())
            .collect();
        let scaled = |values: &[f64], factor: f64| values.iter().map(|value| factor * value).collect::<Vec<f64>>();
        let slopes = self.slopes(contact, p);
        let along = slopes.iter().zip(&pairs.load_share).map(|(by_speed, share)| share * slope * by_speed).collect();
        let across = if self.contact_law.lateral_damping {
            let shares = pairs.load_share.iter().zip(&contact.radius_m);
            shares.map(|(share, radius_m)| share * lateral / radius_m).collect()
        } else {
            vec![0.0; contact.normal.len()]
        };
        let some = |term: &ContactTerm<'_>| term.weights.iter().any(|weight| *weight != 0.0);
        let stiffness = vec![ContactTerm {
            left: pushed.clone(),
            weights: scaled(&pairs.stiffness_n_per_m, kappa),
            right: &contact.normal,
        }];
        let damping = vec![
            ContactTerm { left: pushed, weights: scaled(&pairs.damping_n_s_per_m, damper), right: &contact.normal },
            ContactTerm { left: contact.sliding.clone(), weights: along, right: &contact.sliding },
            ContactTerm { left: contact.lateral.clone(), weights: across, right: &contact.lateral },
        ];
        [stiffness, damping].map(|terms| terms.into_iter().filter(some).collect())
    }

    /// `dμ/dv` of each pair at `p`, s/m.
    fn slopes(&self, contact: &FullContact, p: &OperatingPoint) -> Vec<f64> {
        let ContactLaw { slope_s_per_m, stribeck, .. } = self.contact_law;
        match stribeck {
            None => vec![slope_s_per_m; contact.normal.len()],
            Some(stribeck) => {
                let speed = p.disc_speed_rad_s.abs();
                contact.radius_m.iter().map(|radius| slope_s_per_m + stribeck.slope(speed * radius)).collect()
            }
        }
    }

    /// Contact contributions, pair by pair: `Σ leftᵀ (k + λ c) right`.
    pub(super) fn low_rank(&self, here: &Situation) -> LowRank {
        let [stiffness, damping] = self.contact_terms(here);
        let mut sum = LowRank::default();
        for term in &stiffness {
            sum.left.extend(term.left.iter().cloned());
            sum.right.extend(term.right.iter().cloned());
            sum.stiffness.extend(&term.weights);
            sum.damping.resize(sum.stiffness.len(), 0.0);
        }
        for term in &damping {
            // The spring and the damper of a pair act along the same rows and share one entry.
            if sum.left == term.left && sum.right == term.right && sum.damping.iter().all(|value| *value == 0.0) {
                sum.damping.clone_from(&term.weights);
                continue;
            }
            sum.left.extend(term.left.iter().cloned());
            sum.right.extend(term.right.iter().cloned());
            sum.damping.extend(&term.weights);
            sum.stiffness.resize(sum.damping.len(), 0.0);
        }
        sum
    }

    /// Rows of all parts that belong to contact pairs, ascending.
    pub(super) fn contact_rows(&self) -> Vec<usize> {
        let contact = self.contact.iter();
        let mut rows: Vec<usize> = contact
            .flat_map(|contact| contact.normal.iter().chain(&contact.sliding).chain(&contact.lateral))
            .flat_map(|row| row.iter().map(|(index, _)| *index))
            .collect();
        rows.sort_unstable();
        rows.dedup();
        rows
    }

    /// Projects the model on the span of `basis`, `n×k`, whose columns must be linearly independent but need not be
    /// orthogonal.
    ///
    /// # Errors
    /// [`ReductionError`]: `Indefinite` where the columns depend on each other, `Factorisation`.
    pub fn project(&self, basis: MatRef<'_, f64>) -> Result<Projected, ReductionError> {
        let k = basis.ncols();
        let (mut mass, mut stiffness) = (Mat::<f64>::zeros(k, k), Mat::<f64>::zeros(k, k));
        for (part, offset) in self.parts.iter().zip(self.offsets()) {
            let rows = basis.subrows(offset, part.mass.nrows());
            mass += project_sparse(&part.mass, rows, true);
            stiffness += project_sparse(&part.stiffness, rows, true);
        }
        let whitening = whiten("basis", mass.as_ref())?;
        let (omega_squared, mut mixed) =
            symmetric_eigen("basis", whitening.congruence(stiffness.as_ref(), true).as_ref())?;
        whitening.back(&mut mixed);
        let basis = basis * &mixed;
        let terms = |terms: &[SparseTerm]| -> Vec<Term> {
            let on_basis = |term: &SparseTerm| Term { matrix: on_basis(term, basis.as_ref()), law: term.law.clone() };
            terms.iter().map(on_basis).collect()
        };
        let (stiffness, mut damping) = (terms(&self.stiffness), terms(&self.damping));
        for (part, offset) in self.offsets().into_iter().enumerate() {
            let rows = basis.subrows(offset, self.parts[part].mass.nrows());
            let of_modes = self.modal_damping_of_part(part, rows);
            damping.extend(of_modes.map(|matrix| Term { matrix, law: Law::Constant }));
        }
        let contact = self.contact.as_ref().map(|contact| contact.on(basis.as_ref()));
        Ok(Projected { basis, omega_squared, contact, statics: self.statics().cloned(), stiffness, damping })
    }

    /// Adds the terms of part `part`, which turns with the disc speed `Ω`: `2 Ω H` to `C` and `Ω² (K_σ - L)` to `K`.
    ///
    /// # Errors
    /// [`ReductionError`]: `Shape`; `Factorisation` if memory is insufficient.
    pub fn turn(&mut self, part: usize, turning: &PartTurning) -> Result<(), ReductionError> {
        let PartTurning { gyroscopic, spin, stress_stiffening } = turning;
        if let Some(gyroscopic) = gyroscopic {
            let term = self.within_part(part, &[(2.0, gyroscopic)], Law::DiscSpeed { power: 1 })?;
            self.damping.push(term);
        }
        let of_spin = [(-1.0, spin), (1.0, stress_stiffening)];
        let of_spin: Vec<(f64, &SparseMatrix)> =
            of_spin.into_iter().filter_map(|(factor, matrix)| Some((factor, matrix.as_ref()?))).collect();
        if !of_spin.is_empty() {
            let term = self.within_part(part, &of_spin, Law::DiscSpeed { power: 2 })?;
            self.stiffness.push(term);
        }
        Ok(())
    }

    /// Adds Rayleigh damping `α M + β K` of part `part` to `C`; `alpha_per_s` in 1/s, `beta_s` in s.
    ///
    /// # Errors
    /// [`ReductionError::Factorisation`] if memory is insufficient.
    pub fn damp(&mut self, part: usize, alpha_per_s: f64, beta_s: f64) -> Result<(), ReductionError> {
        let FullPart { mass, stiffness, .. } = &self.parts[part];
        let terms = [(alpha_per_s, mass), (beta_s, stiffness)];
        let terms: Vec<(f64, &SparseMatrix)> = terms.into_iter().filter(|(factor, _)| *factor != 0.0).collect();
        if !terms.is_empty() {
            let term = self.within_part(part, &terms, Law::Constant)?;
            self.damping.push(term);
        }
        Ok(())
    }

    /// A term over the rows of all parts: the weighted sum of matrices of part `part`.
    fn within_part(&self, part: usize, sum: &[(f64, &SparseMatrix)], law: Law) -> Result<SparseTerm, ReductionError> {
        let (n, offset) = (self.dimension(), self.offsets()[part]);
        let sum = weighted_sum(self.parts[part].mass.nrows(), sum)?;
        let triplets: Vec<_> = entries(&sum).map(|(i, j, value)| Triplet::new(offset + i, offset + j, value)).collect();
        let matrix =
            SparseMatrix::try_new_from_triplets(n, n, &triplets).map_err(|error| ReductionError::Factorisation {
                what: self.parts[part].name.clone(),
                reason: format!("a term could not be stored: {error:?}"),
            })?;
        Ok(SparseTerm { matrix, law })
    }

    /// Damping and rotation of part `part` in the coordinates `phi`, with a row for each of the part.
    pub fn matrices_of_part(&self, part: usize, phi: MatRef<'_, f64>) -> PartMatrices {
        if self.stiffness.is_empty() && self.damping.is_empty() {
            return PartMatrices::default();
        }
        let (offset, rows) = (self.offsets()[part], self.parts[part].mass.nrows());
        let range = offset..offset + rows;
        let mut basis = Mat::zeros(self.dimension(), phi.ncols());
        basis.subrows_mut(offset, rows).copy_from(phi);
        let within =
            |term: &SparseTerm| entries(&term.matrix).all(|(i, j, _)| range.contains(&i) && range.contains(&j));
        let sum = |terms: &[SparseTerm], factor: f64, counts: &dyn Fn(&Law) -> bool| {
            let of_part = terms.iter().filter(|term| counts(&term.law) && within(term));
            let projected = of_part.map(|term| faer::Scale(factor) * on_basis(term, basis.as_ref()));
            projected.reduce(|sum, matrix| sum + matrix)
        };
        PartMatrices {
            damping: sum(&self.damping, 1.0, &|law| matches!(law, Law::Constant)),
            gyroscopic: sum(&self.damping, 0.5, &|law| matches!(law, Law::DiscSpeed { power: 1 })),
            spin: sum(&self.stiffness, -1.0, &|law| matches!(law, Law::DiscSpeed { power: 2 })),
        }
    }

    /// `M X`.
    pub(super) fn mass_times(&self, x: MatRef<'_, f64>) -> Mat<f64> {
        self.parts_times(|part| &part.mass, x)
    }

    /// `C(p) X`, or `C(p)ᵀ X` if `transposed`, without assembling `C`.
    pub(super) fn damping_times(&self, here: &Situation, x: MatRef<'_, f64>, transposed: bool) -> Mat<f64> {
        let mut product = self.modal_damping_times(x);
        let [_, contact] = self.contact_terms(here);
        self.add_terms(&self.damping, &contact, here.point(), x, transposed, &mut product);
        product
    }

    /// The damping of modes times `X`; it is symmetric.
    pub(super) fn modal_damping_times(&self, x: MatRef<'_, f64>) -> Mat<f64> {
        let (mut product, offsets) = (Mat::zeros(x.nrows(), x.ncols()), self.offsets());
        for ModalDamping { part, mass_times_modes, rates_per_s } in &self.modal_damping {
            let mut rows = product.subrows_mut(offsets[*part], mass_times_modes.nrows());
            let x = x.subrows(offsets[*part], mass_times_modes.nrows());
            let along = mass_times_modes.transpose() * x;
            rows += mass_times_modes
                * Mat::from_fn(along.nrows(), along.ncols(), |mode, j| rates_per_s[mode] * along[(mode, j)]);
        }
        product
    }

    /// The factors `W` and `2 ζ ω` of the damping of all modes, `n×j` and `j`.
    pub(super) fn modal_factors(&self) -> (Mat<f64>, Vec<f64>) {
        let offsets = self.offsets();
        let rates: Vec<f64> =
            self.modal_damping.iter().flat_map(|of_part| of_part.rates_per_s.iter().copied()).collect();
        let (mut rows, mut first) = (Mat::zeros(self.dimension(), rates.len()), 0);
        for ModalDamping { part, mass_times_modes, .. } in &self.modal_damping {
            let (n, count) = mass_times_modes.shape();
            rows.submatrix_mut(offsets[*part], first, n, count).copy_from(mass_times_modes);
            first += count;
        }
        (rows, rates)
    }

    /// Damps the lowest modes of part `part`: `ratios` are `ζ` of `modes`, in the same order.
    pub fn damp_modes(&mut self, part: usize, modes: &SparseModes, ratios: &[f64]) {
        let rate = |mode: usize| 2.0 * ratios[mode] * modes.omega_squared[mode].max(0.0).sqrt();
        let damped: Vec<usize> = (0..ratios.len()).filter(|&mode| rate(mode) > 0.0).collect();
        if damped.is_empty() {
            return;
        }
        let phi = Mat::from_fn(modes.phi.nrows(), damped.len(), |i, j| modes.phi[(i, damped[j])]);
        let mass_times_modes = symmetric_times(&self.parts[part].mass, phi.as_ref());
        let rates_per_s = damped.into_iter().map(rate).collect();
        self.modal_damping.push(ModalDamping { part, mass_times_modes, rates_per_s });
    }

    /// The damping of modes of part `part` in the coordinates `phi`, with a row for each of the part, exactly symmetric;
    /// `None` without any.
    pub fn modal_damping_of_part(&self, part: usize, phi: MatRef<'_, f64>) -> Option<Mat<f64>> {
        let of_part = self.modal_damping.iter().filter(|damping| damping.part == part);
        let on_basis = |ModalDamping { mass_times_modes, rates_per_s, .. }: &ModalDamping| {
            let along = mass_times_modes.transpose() * phi;
            let rated = Mat::from_fn(along.nrows(), along.ncols(), |mode, j| rates_per_s[mode] * along[(mode, j)]);
            let product = along.transpose() * rated;
            Mat::from_fn(product.nrows(), product.ncols(), |i, j| product[(i.max(j), i.min(j))])
        };
        of_part.map(on_basis).reduce(|sum, matrix| sum + matrix)
    }

    /// `K(p) X`, or `K(p)ᵀ X` if `transposed`, without assembling `K`.
    pub(super) fn stiffness_times(&self, here: &Situation, x: MatRef<'_, f64>, transposed: bool) -> Mat<f64> {
        let mut product = self.parts_times(|part| &part.stiffness, x);
        let [contact, _] = self.contact_terms(here);
        self.add_terms(&self.stiffness, &contact, here.point(), x, transposed, &mut product);
        product
    }

    /// `½ (K(p) + K(p)ᵀ) X`, without assembling `K`.
    pub(super) fn symmetric_stiffness_times(&self, here: &Situation, x: MatRef<'_, f64>) -> Mat<f64> {
        let [contact, _] = self.contact_terms(here);
        let mut of_terms = Mat::zeros(x.nrows(), x.ncols());
        for transposed in [false, true] {
            self.add_terms(&self.stiffness, &contact, here.point(), x, transposed, &mut of_terms);
        }
        self.parts_times(|part| &part.stiffness, x) + faer::Scale(0.5) * of_terms
    }

    /// `diag(A_part) X`, where `of` selects a symmetric matrix of every part.
    fn parts_times(&self, of: fn(&FullPart) -> &SparseMatrix, x: MatRef<'_, f64>) -> Mat<f64> {
        let mut product = Mat::zeros(x.nrows(), x.ncols());
        for (part, offset) in self.parts.iter().zip(self.offsets()) {
            let n = part.mass.nrows();
            product.subrows_mut(offset, n).copy_from(symmetric_times(of(part), x.subrows(offset, n)));
        }
        product
    }

    /// Adds the products of terms and contact with `X`, or those of their transposes, to `product`.
    fn add_terms(
        &self,
        terms: &[SparseTerm],
        contact: &[ContactTerm<'_>],
        p: &OperatingPoint,
        x: MatRef<'_, f64>,
        transposed: bool,
        product: &mut Mat<f64>,
    ) {
        for term in terms {
            let of_term = if transposed { times_transposed(&term.matrix, x) } else { times(&term.matrix, x) };
            *product += faer::Scale(self.value(&term.law, p)) * of_term;
        }
        for term in contact {
            for ((left, weight), right) in term.left.iter().zip(&term.weights).zip(term.right) {
                let (from, to) = if transposed { (left, right) } else { (right, left) };
                for j in 0..x.ncols() {
                    let along: f64 = from.iter().map(|&(i, value)| value * x[(i, j)]).sum();
                    to.iter().for_each(|&(i, value)| product[(i, j)] += weight * along * value);
                }
            }
        }
    }
}

/// `Vᵀ A V` of a term, exactly symmetric or skew if `A` is up to rounding.
fn on_basis(term: &SparseTerm, basis: MatRef<'_, f64>) -> Mat<f64> {
    let matrix = project_sparse(&term.matrix, basis, is_symmetric(&term.matrix));
    if turns(&term.law) && first_asymmetry(&term.matrix, -1.0).is_none() { skew_part(&matrix) } else { matrix }
}

/// Whether a law is a power of the disc speed. Only matrices of such terms are made exactly skew.
fn turns(law: &Law) -> bool {
    matches!(law, Law::DiscSpeed { .. })
}

/// `(A - Aᵀ) / 2`.
fn skew_part(matrix: &Mat<f64>) -> Mat<f64> {
    Mat::from_fn(matrix.nrows(), matrix.ncols(), |i, j| 0.5 * (matrix[(i, j)] - matrix[(j, i)]))
}

impl FullContact {
    /// The contact pairs in the coordinates of a basis, `n×k`.
    pub fn on(&self, basis: MatRef<'_, f64>) -> ContactPairs {
        let rows = |rows: &[SparseRow]| {
            Mat::from_fn(rows.len(), basis.ncols(), |pair, column| {
                rows[pair].iter().map(|&(row, weight)| weight * basis[(row, column)]).sum()
            })
        };
        ContactPairs {
            normal: rows(&self.normal),
            sliding: rows(&self.sliding),
            lateral: rows(&self.lateral),
            stiffness_n_per_m: self.stiffness_n_per_m.clone(),
            damping_n_s_per_m: self.damping_n_s_per_m.clone(),
            radius_m: self.radius_m.clone(),
        }
    }
}

impl Projected {
    /// Projects further on the span of `coefficients`, `k×r`: linearly independent columns in the coordinates of this
    /// basis.
    ///
    /// # Errors
    /// [`ReductionError`]: `Indefinite` where the columns depend on each other, `Factorisation`.
    pub fn restricted(&self, coefficients: MatRef<'_, f64>) -> Result<Self, ReductionError> {
        let free = Mat::from_fn(coefficients.nrows(), coefficients.ncols(), |i, j| {
            self.omega_squared[i] * coefficients[(i, j)]
        });
        let stiffness = coefficients.transpose() * &free;
        // M is the identity in these coordinates.
        let gram = coefficients.transpose() * coefficients;
        let symmetric = |m: &Mat<f64>| Mat::from_fn(m.nrows(), m.ncols(), |i, j| m[(i.max(j), i.min(j))]);
        let whitening = whiten("basis", symmetric(&gram).as_ref())?;
        let (omega_squared, mut mixed) =
            symmetric_eigen("basis", whitening.congruence(symmetric(&stiffness).as_ref(), true).as_ref())?;
        whitening.back(&mut mixed);
        let turn = coefficients * &mixed;
        let terms = |terms: &[Term]| -> Vec<Term> {
            let mirrors =
                |m: &Mat<f64>, sign: f64| (0..m.ncols()).all(|j| (0..=j).all(|i| m[(i, j)] == sign * m[(j, i)]));
            let turned = |term: &Term| {
                let matrix = project_dense(term.matrix.as_ref(), turn.as_ref(), mirrors(&term.matrix, 1.0));
                let skew = turns(&term.law) && mirrors(&term.matrix, -1.0);
                Term { matrix: if skew { skew_part(&matrix) } else { matrix }, law: term.law.clone() }
            };
            terms.iter().map(turned).collect()
        };
        let contact = self.contact.as_ref().map(|pairs| ContactPairs {
            normal: &pairs.normal * &turn,
            sliding: &pairs.sliding * &turn,
            lateral: &pairs.lateral * &turn,
            ..pairs.clone()
        });
        Ok(Self {
            basis: &self.basis * &turn,
            omega_squared,
            contact,
            statics: self.statics.clone(),
            stiffness: terms(&self.stiffness),
            damping: terms(&self.damping),
        })
    }

    /// The reduced equation of motion in the coordinates of the basis, with `contact_law`.
    ///
    /// # Errors
    /// Those of [`Model::new`], [`Model::with_contact`] and [`Model::with_steady_contact`].
    pub fn model(&self, contact_law: ContactLaw) -> Result<Model, ModelError> {
        let k = self.omega_squared.len();
        let mut stiffness = self.stiffness.clone();
        let free = Mat::from_fn(k, k, |i, j| if i == j { self.omega_squared[i] } else { 0.0 });
        stiffness.insert(0, Term { matrix: free, law: Law::Constant });
        let model = Model::new(k, stiffness, self.damping.clone(), contact_law, None)?;
        match (&self.contact, &self.statics) {
            (Some(pairs), Some(statics)) => model.with_steady_contact(pairs, statics.clone(), None),
            (Some(pairs), None) => model.with_contact(pairs),
            (None, _) => Ok(model),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::physics::{Solver, Stribeck, Vectors};

    fn sparse(n: usize, triplets: &[(usize, usize, f64)]) -> SparseMatrix {
        let triplets: Vec<_> = triplets.iter().map(|&(i, j, value)| Triplet::new(i, j, value)).collect();
        SparseMatrix::try_new_from_triplets(n, n, &triplets).unwrap()
    }

    /// Two grounded chains of three masses with contact pairs along three directions.
    fn two_chains() -> FullModel {
        let part = |name: &str, spring: f64| FullPart {
            name: name.to_owned(),
            mass: sparse(3, &[(0, 0, 1.0), (1, 1, 2.0), (2, 2, 1.5), (0, 1, 0.1), (1, 0, 0.1)]),
            stiffness: sparse(
                3,
                &[
                    (0, 0, 2.0 * spring),
                    (1, 1, 2.0 * spring),
                    (2, 2, spring),
                    (0, 1, -spring),
                    (1, 0, -spring),
                    (1, 2, -spring),
                    (2, 1, -spring),
                ],
            ),
        };
        FullModel {
            parts: vec![part("pad", 1e6), part("disc", 3e6)],
            stiffness: vec![],
            damping: vec![],
            modal_damping: vec![],
            contact: Some(FullContact {
                normal: vec![vec![(2, 1.0), (5, -1.0)], vec![(1, 1.0), (4, -0.5)]],
                sliding: vec![vec![(1, 1.0), (4, -1.0)], vec![(0, 1.0), (3, -1.0)]],
                lateral: vec![vec![(0, 1.0), (3, -1.0)], vec![(2, 1.0), (5, -1.0)]],
                stiffness_n_per_m: vec![2e5, 3e5],
                damping_n_s_per_m: vec![4.0, 5.0],
                radius_m: vec![0.1, 0.2],
                steady: None,
            }),
            contact_law: ContactLaw {
                exponent: 0.5,
                reference_n: 400.0,
                slope_s_per_m: -0.02,
                stribeck: Some(Stribeck { drop: 0.1, speed_m_s: 1.5, exponent: 2.0 }),
                lateral_damping: true,
            },
        }
    }

    /// A basis with as many vectors as degrees of freedom loses nothing: the roots of the projected model make the full
    /// matrices singular, for either direction of sliding, without sliding and without contact.
    #[test]
    fn a_whole_basis_loses_nothing() {
        let full = two_chains();
        let n = full.dimension();
        let basis = Mat::from_fn(n, n, |i, j| if i == j { 1.0 } else { 0.1 * ((3 * i + 7 * j) as f64).sin() });
        let projected = full.project(basis.as_ref()).unwrap();
        let model = projected.model(full.contact_law).unwrap();
        let mut solver = Solver::new(n);
        for (normal_load_n, disc_speed_rad_s) in [(500.0, 13.0), (900.0, -2.0), (500.0, 0.0), (0.0, 13.0)] {
            let p = OperatingPoint { normal_load_n, disc_speed_rad_s, friction_coefficient: 0.4 };
            let spectrum = solver.solve(&model, &p, Vectors::Right).unwrap();
            let [mass, damping, stiffness] = full.matrices_at(&p).unwrap().map(|matrix| matrix.to_dense());
            assert_eq!(spectrum.roots.len(), n);
            for (k, root) in spectrum.roots.iter().enumerate() {
                let lambda = root.lambda;
                let y = &spectrum.shapes;
                let x =
                    Mat::from_fn(n, 1, |i, _| (0..n).map(|j| y[(j, k)] * projected.basis[(i, j)]).sum::<faer::c64>());
                let parts = |matrix: &Mat<f64>, i: usize| (0..n).map(|j| x[(j, 0)] * matrix[(i, j)]).sum::<faer::c64>();
                let residual = (0..n)
                    .map(|i| {
                        (lambda * lambda * parts(&mass, i) + lambda * parts(&damping, i) + parts(&stiffness, i)).norm()
                    })
                    .fold(0.0, f64::max);
                // Rounding error of a dense solve, relative to the largest stiffness entry.
                assert!(residual < 1e-10 * stiffness.norm_max() * x.norm_max(), "{p:?} {lambda} {residual:e}");
            }
        }
    }
}

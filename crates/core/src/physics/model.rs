//! The equation of motion of a rig, `q̈ + C(p) q̇ + K(p) q = 0`, as sums of terms.
//!
//! Coordinates are mass-normalised (`M = I`) for every kind of rig: substructures by their mass-normalised modes,
//! systems given by matrices by a Cholesky factor of `M` or by projection on modes. A term is a constant matrix times
//! a scalar [`Law`] of the operating point. Contact is given as [`ContactPairs`] and converted to terms when the
//! model is built.

use faer::{Mat, MatRef};

use super::decoupled::Division;
use super::law::{ContactLaw, Law, Parameter};
use super::model_error::ModelError;
use super::operating_point::{ContactState, OperatingPoint};
use super::steady_contact::{Response, Situation, SteadyContact, signed_friction};
use super::stribeck::Node;

/// A constant matrix times a scalar law of the operating point.
#[derive(Clone, Debug)]
pub struct Term {
    /// `n×n`; in `K` rad²/s² per unit of the law, in `C` 1/s per unit of the law.
    pub matrix: Mat<f64>,
    /// The scalar function that multiplies the matrix.
    pub law: Law,
}

/// Contact pairs in modal coordinates. The rows map coordinates to the relative displacement, pad minus disc, along
/// the triad `n`, `t`, `b`.
#[derive(Clone, Debug)]
pub struct ContactPairs {
    /// `B_n`, `c×n`, kg^-1/2: along the normal, which points from disc to pad.
    pub normal: Mat<f64>,
    /// `B_t`, `c×n`, kg^-1/2: along the sliding direction of the disc at positive speed.
    pub sliding: Mat<f64>,
    /// `B_b`, `c×n`, kg^-1/2: along `b = n × t`.
    pub lateral: Mat<f64>,
    /// Stiffness `k` of each pair at the reference load, N/m.
    pub stiffness_n_per_m: Vec<f64>,
    /// Damping coefficient `c` of each pair, N·s/m.
    pub damping_n_s_per_m: Vec<f64>,
    /// Distance of each pair from the disc's axis, m; used by lateral damping only.
    pub radius_m: Vec<f64>,
}

impl ContactPairs {
    /// Checks that every pair is at a distance from the disc's axis.
    pub(super) fn check_radius(&self) -> Result<(), ModelError> {
        match self.radius_m.iter().position(|radius_m| radius_m.is_nan() || *radius_m <= 0.0) {
            Some(pair) => Err(ModelError::Radius { pair, radius_m: self.radius_m[pair] }),
            None => Ok(()),
        }
    }

    /// `1 / r` of each pair.
    ///
    /// # Errors
    /// [`ModelError::Radius`].
    pub(super) fn inverse_radius(&self) -> Result<Vec<f64>, ModelError> {
        self.check_radius()?;
        Ok(self.radius_m.iter().map(|radius_m| radius_m.recip()).collect())
    }
}

/// A term, with the known symmetry of its matrix.
#[derive(Clone, Debug)]
pub(super) struct KnownTerm {
    pub(super) term: Term,
    pub(super) symmetric: bool,
}

impl KnownTerm {
    /// Checks that the matrix of a term is `dimension×dimension` and finite, and determines whether it is symmetric.
    /// `what` names the term in errors.
    fn new(term: Term, dimension: usize, what: impl Fn() -> String) -> Result<Self, ModelError> {
        let (rows, columns) = term.matrix.shape();
        if rows != dimension || columns != dimension {
            return Err(ModelError::Shape { what: what(), rows, columns, expected: dimension });
        }
        let mut symmetric = true;
        for column in 0..columns {
            for row in 0..rows {
                let value = term.matrix[(row, column)];
                if !value.is_finite() {
                    return Err(ModelError::NotFinite { what: what(), row, column, value });
                }
                symmetric &= value == term.matrix[(column, row)];
            }
        }
        Ok(Self { term, symmetric })
    }

    /// `coefficient` of the term's law, checked to be finite.
    pub(super) fn factor(&self, coefficient: impl Fn(&Law) -> f64, p: &OperatingPoint) -> Result<f64, ModelError> {
        let value = coefficient(&self.term.law);
        if value.is_finite() {
            return Ok(value);
        }
        Err(ModelError::LawNotFinite {
            what: match &self.term.law {
                Law::Custom(custom) => format!("scale `{}`", custom.text),
                law => format!("{law:?}"),
            },
            value,
            normal_load_n: p.normal_load_n,
            disc_speed_rad_s: p.disc_speed_rad_s,
            friction_coefficient: p.friction_coefficient,
        })
    }
}

/// The equation of motion of a rig in `n` mass-normalised coordinates.
#[derive(Clone, Debug)]
pub struct Model {
    pub(super) dimension: usize,
    pub(super) stiffness: Vec<KnownTerm>,
    pub(super) damping: Vec<KnownTerm>,
    pub(super) contact_law: ContactLaw,
    pub(super) has_contact: bool,
    pub(super) pad_modes: Option<usize>,
    pub(super) pad_mass: Option<Mat<f64>>,
    /// Contact whose springs follow the state of steady sliding. The other contact terms are then absent.
    pub(super) steady: Option<Box<SteadyContact>>,
    /// Division into coupled and uncoupled coordinates; `None` if all are coupled, and also if none are. Computed by
    /// [`Model::finished`], with which every constructor ends.
    pub(super) division: Option<Box<Division>>,
}

/// Properties of the matrices that [`Model::assemble`] wrote.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Structure {
    /// Whether any damping term has a nonzero coefficient.
    pub damped: bool,
    /// Whether every stiffness term with a nonzero coefficient is symmetric.
    pub symmetric_stiffness: bool,
}

impl Model {
    /// A model from its terms, without contact.
    ///
    /// `pad_modes`: number of leading coordinates that belong to the pad; `None` if coordinates are not separated
    /// into pad and disc.
    ///
    /// # Errors
    /// [`ModelError::Shape`], [`ModelError::NotFinite`].
    pub fn new(
        dimension: usize,
        stiffness: Vec<Term>,
        damping: Vec<Term>,
        contact_law: ContactLaw,
        pad_modes: Option<usize>,
    ) -> Result<Self, ModelError> {
        let known = |terms: Vec<Term>, what: &str| -> Result<Vec<KnownTerm>, ModelError> {
            let numbered = terms.into_iter().enumerate();
            numbered.map(|(k, term)| KnownTerm::new(term, dimension, || format!("{what} term {k}"))).collect()
        };
        let model = Self {
            dimension,
            stiffness: known(stiffness, "stiffness")?,
            damping: known(damping, "damping")?,
            contact_law,
            has_contact: false,
            pad_modes,
            pad_mass: None,
            steady: None,
            division: None,
        };
        Ok(model.finished())
    }

    /// Adds the terms of the contact between pad and disc:
    ///
    /// ```text
    /// K += κ(N) (B_n + s μ B_t)ᵀ K_c B_n
    /// C += (B_n + s μ B_t)ᵀ C_c B_n + B_tᵀ diag(N_0 μ'(v)) B_t + μ B_bᵀ diag(N_0 / v) B_b
    /// N_0 = N / c, v_k = |ω| r_k
    /// ```
    ///
    /// # Errors
    /// [`ModelError::Shape`], [`ModelError::NotFinite`], [`ModelError::PairCount`], [`ModelError::Radius`],
    /// [`ModelError::StribeckRadii`].
    pub fn with_contact(mut self, pairs: &ContactPairs) -> Result<Self, ModelError> {
        self.check_pairs(pairs)?;
        let (n, t) = (pairs.normal.as_ref(), pairs.sliding.as_ref());
        let (k, c) = (&pairs.stiffness_n_per_m, &pairs.damping_n_s_per_m);
        self.add_stiffness("contact stiffness", congruence(n, k, n), Law::ContactStiffness)?;
        self.add_stiffness("friction stiffness", congruence(t, k, n), Law::FrictionStiffness)?;
        self.add_damping("contact damping", congruence(n, c, n), Law::ContactDamping)?;
        self.add_damping("friction damping", congruence(t, c, n), Law::FrictionDamping)?;
        self.with_friction_damping(pairs)
    }

    /// Checks that there is one `c×n` matrix for each displacement and one value for each pair.
    pub(super) fn check_pairs(&self, pairs: &ContactPairs) -> Result<(), ModelError> {
        let count = pairs.normal.nrows();
        for (what, rows) in [("sliding", &pairs.sliding), ("lateral", &pairs.lateral), ("normal", &pairs.normal)] {
            if rows.nrows() != count || rows.ncols() != self.dimension {
                return Err(ModelError::Shape {
                    what: format!("contact rows `{what}`"),
                    rows: rows.nrows(),
                    columns: rows.ncols(),
                    expected: self.dimension,
                });
            }
        }
        for (what, values) in [
            ("stiffness_n_per_m", &pairs.stiffness_n_per_m),
            ("damping_n_s_per_m", &pairs.damping_n_s_per_m),
            ("radius_m", &pairs.radius_m),
        ] {
            if values.len() != count {
                return Err(ModelError::PairCount { what, found: values.len(), expected: count });
            }
        }
        Ok(())
    }

    /// Adds the damping that friction causes along and across the sliding direction (falling slope, lateral
    /// friction). It does not depend on the contact springs.
    pub(super) fn with_friction_damping(mut self, pairs: &ContactPairs) -> Result<Self, ModelError> {
        let count = pairs.normal.nrows();
        let each_n_0 = 1.0 / count.max(1) as f64;
        let mut inverse_radius = vec![0.0; count];
        if self.contact_law.lateral_damping {
            pairs.check_radius()?;
            inverse_radius = pairs.radius_m.iter().map(|radius_m| each_n_0 / radius_m).collect();
        }
        let slope = vec![each_n_0 * self.contact_law.slope_s_per_m; count];
        let (t, b) = (pairs.sliding.as_ref(), pairs.lateral.as_ref());
        self.add_damping("friction slope", congruence(t, &slope, t), Law::FrictionSlope)?;
        self.add_damping("lateral friction", congruence(b, &inverse_radius, b), Law::LateralFriction)?;
        if let Some(stribeck) = self.contact_law.stribeck {
            pairs.check_radius()?;
            for Node { radius_m, shares } in stribeck.nodes(&pairs.radius_m)? {
                let weights: Vec<f64> = shares.iter().map(|share| each_n_0 * share).collect();
                let matrix = congruence(t, &weights, t);
                self.add_damping("falling friction", matrix, Law::FallingFriction { radius_m })?;
            }
        }
        self.has_contact = true;
        Ok(self.finished())
    }

    pub(super) fn add_stiffness(&mut self, what: &str, matrix: Mat<f64>, law: Law) -> Result<(), ModelError> {
        let known = KnownTerm::new(Term { matrix, law }, self.dimension, || what.to_owned())?;
        self.stiffness.push(known);
        Ok(())
    }

    pub(super) fn add_damping(&mut self, what: &str, matrix: Mat<f64>, law: Law) -> Result<(), ModelError> {
        let known = KnownTerm::new(Term { matrix, law }, self.dimension, || what.to_owned())?;
        self.damping.push(known);
        Ok(())
    }

    /// The model with all its terms: drops terms whose matrix is zero, which would only cost time, and divides the
    /// coordinates into coupled and uncoupled ones.
    pub(super) fn finished(mut self) -> Self {
        let is_zero = |known: &KnownTerm| known.term.matrix.norm_max() == 0.0;
        self.stiffness.retain(|known| !is_zero(known));
        self.damping.retain(|known| !is_zero(known));
        self.division = Division::of(&self).map(Box::new);
        self
    }

    /// How contact stiffness and friction follow load and speed.
    pub fn contact_law(&self) -> &ContactLaw {
        &self.contact_law
    }

    /// Number of coordinates, `n`.
    pub fn dimension(&self) -> usize {
        self.dimension
    }

    /// Number of leading coordinates that belong to the pad; `None` if coordinates are not separated into pad and
    /// disc.
    pub fn pad_modes(&self) -> Option<usize> {
        self.pad_modes
    }

    /// Declares coordinates that move pad and disc together. `mass`, `n×n`, is the pad's contribution to the unit
    /// mass matrix.
    ///
    /// # Errors
    /// [`ModelError::Shape`], [`ModelError::NotFinite`].
    pub fn with_pad_mass(mut self, mass: Mat<f64>) -> Result<Self, ModelError> {
        let term = Term { matrix: mass, law: Law::Constant };
        self.pad_mass = Some(KnownTerm::new(term, self.dimension, || "mass of the pad".to_owned())?.term.matrix);
        Ok(self.finished())
    }

    /// The pad's contribution to the unit mass matrix, `n×n`, if coordinates move pad and disc together and it is
    /// known.
    pub fn pad_mass(&self) -> Option<&Mat<f64>> {
        self.pad_mass.as_ref()
    }

    /// The model without contact, in the same coordinates: only the terms with a constant law.
    pub fn without_contact(&self) -> Self {
        let constant = |terms: &[KnownTerm]| -> Vec<KnownTerm> {
            terms.iter().filter(|known| matches!(known.term.law, Law::Constant)).cloned().collect()
        };
        let model = Self {
            stiffness: constant(&self.stiffness),
            damping: constant(&self.damping),
            has_contact: false,
            pad_mass: self.pad_mass.clone(),
            steady: None,
            division: None,
            ..*self
        };
        model.finished()
    }

    /// Whether the model has contact pairs, which open at zero load.
    pub fn has_contact(&self) -> bool {
        self.has_contact
    }

    /// Whether derivatives with respect to contact stiffness and damping are available: the contact terms of `K` and
    /// `C` are proportional to them, or follow a contact state. Not with springs that are always closed and residual
    /// flexibility.
    pub fn is_linear_in_contact(&self) -> bool {
        let mut terms = self.stiffness.iter().chain(&self.damping);
        self.has_contact && terms.all(|known| known.term.law.is_linear_in_contact())
    }

    /// The contact state at `p`; a model without contact pairs is always closed.
    pub fn contact_state(&self, p: &OperatingPoint) -> ContactState {
        p.state_of_contact(self.has_contact)
    }

    /// Value of `law` at `p`.
    pub(super) fn coefficient(&self, law: &Law, p: &OperatingPoint) -> f64 {
        law.value(&self.contact_law, self.has_contact, p)
    }

    /// Derivative of the value of `law` at `p` with respect to `parameter`; see [`Law::derivative`].
    pub(super) fn derivative(&self, law: &Law, p: &OperatingPoint, parameter: Parameter) -> f64 {
        law.derivative(&self.contact_law, self.has_contact, p, parameter)
    }

    /// Writes `K(p)` and `C(p)`, both `n×n`, and returns their properties.
    ///
    /// # Errors
    /// [`ModelError::PointNotFinite`], [`ModelError::LawNotFinite`], [`ModelError::State`].
    pub fn assemble(
        &self,
        p: &OperatingPoint,
        stiffness: &mut Mat<f64>,
        damping: &mut Mat<f64>,
    ) -> Result<Structure, ModelError> {
        self.assemble_at(&self.at(p)?, stiffness, damping)
    }

    /// Does the same as [`Model::assemble`] for an operating point whose contact state is known.
    ///
    /// # Errors
    /// [`ModelError::LawNotFinite`].
    pub fn assemble_at(
        &self,
        here: &Situation,
        stiffness: &mut Mat<f64>,
        damping: &mut Mat<f64>,
    ) -> Result<Structure, ModelError> {
        self.assemble_known(here, self.response(here).as_ref(), stiffness, damping)
    }

    /// Writes `K` and `C` to `values`, and to `slopes` their derivatives with respect to the friction coefficient.
    ///
    /// # Errors
    /// [`ModelError::LawNotFinite`].
    pub(super) fn assemble_with_friction_slopes(
        &self,
        here: &Situation,
        values: [&mut Mat<f64>; 2],
        slopes: [&mut Mat<f64>; 2],
    ) -> Result<Structure, ModelError> {
        let response = self.response(here);
        let ([stiffness, damping], [stiffness_slope, damping_slope]) = (values, slopes);
        let structure = self.assemble_known(here, response.as_ref(), stiffness, damping)?;
        self.derive_known(here, response.as_ref(), Parameter::Friction, stiffness_slope, damping_slope)?;
        Ok(structure)
    }

    fn response<'a>(&'a self, here: &'a Situation) -> Option<Response<'a>> {
        let (contact, state) = self.steady.as_ref().zip(here.state.as_ref())?;
        Some(contact.response(&here.point, state))
    }

    fn assemble_known(
        &self,
        here: &Situation,
        response: Option<&Response<'_>>,
        stiffness: &mut Mat<f64>,
        damping: &mut Mat<f64>,
    ) -> Result<Structure, ModelError> {
        let p = &here.point;
        let coefficient = |law: &Law| self.coefficient(law, p);
        let (_, mut symmetric_stiffness) = sum(&self.stiffness, coefficient, p, stiffness)?;
        let (mut damped, _) = sum(&self.damping, coefficient, p, damping)?;
        if let (Some(contact), Some(response)) = (&self.steady, response) {
            contact.add(p, response, stiffness, damping);
            symmetric_stiffness &= signed_friction(p) == 0.0;
            damped |= contact.is_damped(p);
        }
        Ok(Structure { damped, symmetric_stiffness })
    }

    /// Writes the derivatives of `K` and `C` at `p` with respect to `parameter`, both `n×n`. Custom laws are
    /// differentiated by central differences, which are exact up to rounding for a linear law.
    ///
    /// # Errors
    /// [`ModelError::PointNotFinite`], [`ModelError::LawNotFinite`], [`ModelError::State`].
    pub fn assemble_derivative(
        &self,
        p: &OperatingPoint,
        parameter: Parameter,
        stiffness: &mut Mat<f64>,
        damping: &mut Mat<f64>,
    ) -> Result<(), ModelError> {
        self.assemble_derivative_at(&self.at(p)?, parameter, stiffness, damping)
    }

    /// Does the same as [`Model::assemble_derivative`] for an operating point whose contact state is known. The state
    /// follows the parameter.
    ///
    /// # Errors
    /// [`ModelError::LawNotFinite`].
    pub fn assemble_derivative_at(
        &self,
        here: &Situation,
        parameter: Parameter,
        stiffness: &mut Mat<f64>,
        damping: &mut Mat<f64>,
    ) -> Result<(), ModelError> {
        self.derive_known(here, self.response(here).as_ref(), parameter, stiffness, damping)
    }

    fn derive_known(
        &self,
        here: &Situation,
        response: Option<&Response<'_>>,
        parameter: Parameter,
        stiffness: &mut Mat<f64>,
        damping: &mut Mat<f64>,
    ) -> Result<(), ModelError> {
        let p = &here.point;
        let derivative = |law: &Law| self.derivative(law, p, parameter);
        sum(&self.stiffness, derivative, p, stiffness)?;
        sum(&self.damping, derivative, p, damping)?;
        if let (Some(contact), Some(response)) = (&self.steady, response) {
            contact.add_derivative(p, response, parameter, stiffness, damping);
        }
        Ok(())
    }

    /// Whether any damping term has a nonzero coefficient at `p`.
    pub fn is_damped(&self, p: &OperatingPoint) -> bool {
        self.damping.iter().any(|known| self.coefficient(&known.term.law, p) != 0.0)
            || self.steady.as_ref().is_some_and(|contact| contact.is_damped(p))
    }

    /// Number of terms with a coefficient of zero at `p`; their matrices need not be added.
    pub fn zero_terms(&self, p: &OperatingPoint) -> usize {
        self.stiffness.iter().chain(&self.damping).filter(|known| self.coefficient(&known.term.law, p) == 0.0).count()
    }

    /// Writes `(K(above) - K(below)) per` and the same for `C`, both `n×n`. The laws are subtracted before the
    /// matrices are summed, so constant terms contribute no rounding. Returns whether `K` and whether `C` changes.
    ///
    /// # Errors
    /// [`ModelError::LawNotFinite`].
    pub fn assemble_difference(
        &self,
        below: &OperatingPoint,
        above: &OperatingPoint,
        per: f64,
        stiffness: &mut Mat<f64>,
        damping: &mut Mat<f64>,
    ) -> Result<[bool; 2], ModelError> {
        let difference = |law: &Law| (self.coefficient(law, above) - self.coefficient(law, below)) * per;
        let (stiffness_changes, _) = sum(&self.stiffness, difference, above, stiffness)?;
        let (damping_changes, _) = sum(&self.damping, difference, above, damping)?;
        Ok([stiffness_changes, damping_changes])
    }

    /// Whether any coefficient depends on the load, and whether any depends on the speed, apart from opening,
    /// stopping and reversing.
    pub fn depends_on_load_and_speed(&self) -> (bool, bool) {
        let mut load = self.steady.is_some();
        let mut speed = self.steady.as_ref().is_some_and(|contact| contact.depends_on_speed());
        for known in self.stiffness.iter().chain(&self.damping) {
            let (by_load, by_speed) = known.term.law.depends_on_load_and_speed(&self.contact_law);
            (load, speed) = (load | by_load, speed | by_speed);
        }
        (load, speed)
    }

    /// Whether the model depends on load and speed through their ratio only.
    pub fn depends_on_load_over_speed_only(&self) -> bool {
        let constant = |law: &Law| law.depends_on_load_and_speed(&self.contact_law) == (false, false);
        let rest = || self.stiffness.iter().chain(&self.damping).filter(|known| !constant(&known.term.law));
        self.steady.is_none()
            && rest().count() > 0
            && rest().all(|known| matches!(known.term.law, Law::LateralFriction))
    }
}

/// Writes `Σ coefficient(law) · matrix` to `out`. Returns whether any coefficient was nonzero, and whether all terms
/// with a nonzero coefficient are symmetric.
fn sum(
    terms: &[KnownTerm],
    coefficient: impl Fn(&Law) -> f64,
    p: &OperatingPoint,
    out: &mut Mat<f64>,
) -> Result<(bool, bool), ModelError> {
    out.fill(0.0);
    let (mut any, mut symmetric) = (false, true);
    for known in terms {
        let factor = known.factor(&coefficient, p)?;
        if factor != 0.0 {
            faer::zip!(out.as_mut(), known.term.matrix.as_ref()).for_each(|faer::unzip!(o, m)| *o += factor * *m);
            any = true;
            symmetric &= known.symmetric;
        }
    }
    Ok((any, symmetric))
}

/// `Aᵀ diag(d) B`.
pub(super) fn congruence(a: MatRef<'_, f64>, d: &[f64], b: MatRef<'_, f64>) -> Mat<f64> {
    let scaled = Mat::from_fn(b.nrows(), b.ncols(), |row, column| d[row] * b[(row, column)]);
    let product = a.transpose() * &scaled;
    if std::ptr::eq(a.as_ptr(), b.as_ptr()) {
        // Symmetrised exactly, not only up to rounding: the choice of the solver depends on it.
        return Mat::from_fn(product.nrows(), product.ncols(), |i, j| product[(i.min(j), i.max(j))]);
    }
    product
}

#[cfg(test)]
mod tests {
    use super::super::solver::Solver;
    use super::super::spectrum::Vectors;
    use super::*;

    /// One contact pair between a coordinate along the normal and one along the sliding direction: stiffness and damping
    /// are `[1 0; s μ 0]` times `k` and `c` while it slides, `[1 0; 0 0]` at rest, and zero if the contact is open.
    #[test]
    fn contact_terms_follow_the_state_of_the_contact() {
        let pairs = ContactPairs {
            normal: faer::mat![[1.0, 0.0]],
            sliding: faer::mat![[0.0, 1.0]],
            lateral: Mat::zeros(1, 2),
            stiffness_n_per_m: vec![3e4],
            damping_n_s_per_m: vec![5.0],
            radius_m: vec![0.1],
        };
        let free = Model::new(2, vec![], vec![], ContactLaw::default(), None).unwrap();
        let model = free.with_contact(&pairs).unwrap();
        let cases = [(500.0, 13.0, 1.0, 0.4), (500.0, -13.0, 1.0, -0.4), (500.0, 0.0, 1.0, 0.0), (0.0, 13.0, 0.0, 0.0)];
        for (normal_load_n, disc_speed_rad_s, closed, friction) in cases {
            let p = OperatingPoint { normal_load_n, disc_speed_rad_s, friction_coefficient: 0.4 };
            let (mut k, mut c) = (Mat::zeros(2, 2), Mat::zeros(2, 2));
            let structure = model.assemble(&p, &mut k, &mut c).unwrap();
            let unit = faer::mat![[closed, 0.0], [friction, 0.0]];
            assert_eq!((k, c), (&unit * faer::Scale(3e4), &unit * faer::Scale(5.0)), "{p:?}");
            assert_eq!(structure, Structure { damped: closed != 0.0, symmetric_stiffness: friction == 0.0 });
        }
    }

    /// Two contact pairs in two coordinates. One coordinate moves along the sliding direction, the other across it;
    /// each obeys `λ² + c λ + k = 0`. Along, the friction slope gives `c = N dμ/dv`; across, lateral friction gives
    /// `c = μ N / (|ω| r)`, for both directions of rotation. Calculated by hand: -10 and 153.846 1/s.
    #[test]
    fn friction_damps_along_and_across_the_direction_of_sliding_as_by_hand() {
        let law = |slope_s_per_m: f64, lateral_damping: bool| ContactLaw {
            slope_s_per_m,
            lateral_damping,
            ..Default::default()
        };
        let row = |along: usize| Mat::from_fn(2, 2, |_, column| if column == along { 1.0 } else { 0.0 });
        let pairs = ContactPairs {
            normal: Mat::zeros(2, 2),
            sliding: row(0),
            lateral: row(1),
            stiffness_n_per_m: vec![0.0; 2],
            damping_n_s_per_m: vec![0.0; 2],
            radius_m: vec![0.1; 2],
        };
        let stiffness = faer::mat![[4e4, 0.0], [0.0, 1e6]];
        let point =
            |disc_speed_rad_s| OperatingPoint { normal_load_n: 500.0, disc_speed_rad_s, friction_coefficient: 0.4 };
        let across = 0.4 * 500.0 / (13.0 * 0.1);
        let cases =
            [(law(-0.02, false), [-10.0, 0.0]), (law(0.0, true), [0.0, across]), (law(0.03, true), [15.0, across])];
        for (law, expected) in cases {
            let terms = vec![Term { matrix: stiffness.clone(), law: Law::Constant }];
            let model = Model::new(2, terms, vec![], law, None).and_then(|model| model.with_contact(&pairs)).unwrap();
            for speed in [13.0, -13.0] {
                let (mut k, mut c) = (Mat::zeros(2, 2), Mat::zeros(2, 2));
                model.assemble(&point(speed), &mut k, &mut c).unwrap();
                let spectrum = Solver::new(2).solve(&model, &point(speed), Vectors::Right).unwrap();
                for (mode, damping) in expected.into_iter().enumerate() {
                    assert!((c[(mode, mode)] - damping).abs() < 1e-12 * across, "{law:?} at {speed}: {c:?}");
                    // `σ = -c/2` of an oscillating root.
                    let growth = spectrum.roots[mode].lambda.re;
                    assert!((growth + 0.5 * damping).abs() < 1e-9, "{law:?} at {speed}: {growth} 1/s");
                }
                assert_eq!((c[(0, 1)], c[(1, 0)]), (0.0, 0.0));
            }
            // Twice the speed halves the damping across the sliding direction; along it, the speed has no effect.
            let (mut k, mut c) = (Mat::zeros(2, 2), Mat::zeros(2, 2));
            model.assemble(&point(-26.0), &mut k, &mut c).unwrap();
            assert!((c[(1, 1)] - 0.5 * expected[1]).abs() < 1e-12 * across && (c[(0, 0)] - expected[0]).abs() < 1e-12);
        }
    }
}

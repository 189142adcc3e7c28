//! The equation of motion of a rig, `q̈ + C(p) q̇ + K(p) q = 0`, as sums of terms.
//!
//! Coordinates are mass-normalised (`M = I`) for every kind of rig: substructures by their mass-normalised modes,
//! systems given by matrices by a Cholesky factor of `M` or by projection on modes. A term is a constant matrix times
//! a scalar [`Law`] of the operating point. Contact is given as [`ContactPairs`] and converted to terms when the
//! model is built.

use std::sync::Arc;

use faer::{Mat, MatRef};

use super::decoupled::Division;
use super::operating_point::{ContactState, OperatingPoint};
use super::steady_contact::{Response, Situation, SteadyContact, signed_friction};
use crate::chebyshev;
use crate::contact::StaticsError;

/// A constant matrix times a scalar law of the operating point.
#[derive(Clone, Debug)]
pub struct Term {
    /// `n×n`; in `K` rad²/s² per unit of the law, in `C` 1/s per unit of the law.
    pub matrix: Mat<f64>,
    /// The scalar function that multiplies the matrix.
    pub law: Law,
}

/// The scalar factor of a term, as a function of the operating point. Where its condition (contact closed, or
/// sliding) does not hold, the factor is 0.
#[derive(Clone, Debug)]
pub enum Law {
    /// `1` at every operating point.
    Constant,
    /// `κ(N) = (N / N_ref)^α` while the contact is closed.
    ContactStiffness,
    /// `s μ κ(N)` while the contact slides; `s` is the sign of the disc speed.
    FrictionStiffness,
    /// `1` while the contact is closed.
    ContactDamping,
    /// `s μ` while the contact slides.
    FrictionDamping,
    /// `N` while the contact slides; the matrix contains the slope `dμ/dv`.
    FrictionSlope,
    /// `μ N / |ω|` while the contact slides.
    LateralFriction,
    /// `x T_k(x / r)` with `x = s μ`, while the contact slides. A sum of such terms expands `f(x) - f(0)` of a smooth
    /// function `f`. Undefined for `|μ| > r`.
    FrictionChebyshev {
        /// Degree `k` of the polynomial.
        degree: usize,
        /// Largest `|μ|` of the expansion, `r`.
        range: f64,
    },
    /// `Ω^p` of the disc speed `Ω` with its sign, rad/s, in any contact state: gyroscopic terms (`p = 1`) and spin
    /// terms (`p = 2`) of a disc that turns in the frame of the pad.
    DiscSpeed {
        /// Exponent `p`.
        power: u8,
    },
    /// `Ω^p` while the contact is closed.
    DiscSpeedInContact {
        /// Exponent `p`.
        power: u8,
    },
    /// `Ω^p x T_k(x / r)`, the product of [`Law::DiscSpeed`] and [`Law::FrictionChebyshev`].
    DiscSpeedChebyshev {
        /// Exponent `p`.
        power: u8,
        /// Degree `k` of the polynomial.
        degree: usize,
        /// Largest `|μ|` of the expansion, `r`.
        range: f64,
    },
    /// Any other function, given as an expression in the rig file.
    Custom(CustomLaw),
}

/// A law supplied by the caller, with the conditions it depends on.
#[derive(Clone)]
pub struct CustomLaw {
    /// The expression as written in the rig file.
    pub text: String,
    /// Evaluates the law. It receives a friction coefficient of 0 where the contact does not slide.
    pub evaluate: Arc<dyn Fn(&OperatingPoint) -> f64 + Send + Sync>,
    /// Whether its value changes with the normal load.
    pub depends_on_load: bool,
    /// Whether its value changes with the disc speed.
    pub depends_on_speed: bool,
    /// Whether its value changes with the friction coefficient.
    pub depends_on_friction: bool,
}

impl std::fmt::Debug for CustomLaw {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_tuple("CustomLaw").field(&self.text).finish()
    }
}

impl Law {
    /// Value of the law at `p` for the contact parameters `contact` and the contact state `state`.
    pub fn value(&self, contact: &ContactLaw, state: ContactState, p: &OperatingPoint) -> f64 {
        let closed = state != ContactState::Open;
        let sliding = state == ContactState::Sliding;
        let when = |holds: bool, value: f64| if holds { value } else { 0.0 };
        let (load, mu) = (p.normal_load_n, p.friction_coefficient);
        let stiffening = || match contact.exponent {
            0.0 => 1.0,
            exponent => (load / contact.reference_n).powf(exponent),
        };
        match self {
            Self::Constant => 1.0,
            Self::ContactStiffness => when(closed, stiffening()),
            Self::FrictionStiffness => when(sliding, p.disc_speed_rad_s.signum() * mu * stiffening()),
            Self::ContactDamping => when(closed, 1.0),
            Self::FrictionDamping => when(sliding, p.disc_speed_rad_s.signum() * mu),
            Self::FrictionSlope => when(sliding, load),
            Self::LateralFriction => when(sliding, mu * load / p.disc_speed_rad_s.abs()),
            Self::FrictionChebyshev { degree, range } => {
                let x = p.disc_speed_rad_s.signum() * mu;
                when(sliding, chebyshev::odd_at_zero(x, *degree, *range))
            }
            Self::DiscSpeed { power } => p.disc_speed_rad_s.powi(i32::from(*power)),
            Self::DiscSpeedInContact { power } => when(closed, p.disc_speed_rad_s.powi(i32::from(*power))),
            Self::DiscSpeedChebyshev { power, degree, range } => {
                let x = p.disc_speed_rad_s.signum() * mu;
                let turning = p.disc_speed_rad_s.powi(i32::from(*power));
                when(sliding, turning * chebyshev::odd_at_zero(x, *degree, *range))
            }
            Self::Custom(custom) => (custom.evaluate)(&if sliding { *p } else { p.with_friction(0.0) }),
        }
    }
}

/// Parameters of contact and friction: how both depend on load and speed.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ContactLaw {
    /// `α` in `k = k_ref (N / N_ref)^α`: 0 for a linear spring, 1/3 for Hertzian, 1 for exponential contact.
    pub exponent: f64,
    /// `N_ref`, N.
    pub reference_n: f64,
    /// `dμ/dv`, s/m; negative where friction falls with speed.
    pub slope_s_per_m: f64,
    /// Whether the friction force follows the direction of the sliding velocity, and so damps motion along `b`.
    pub lateral_damping: bool,
}

impl Default for ContactLaw {
    fn default() -> Self {
        Self { exponent: 0.0, reference_n: 500.0, slope_s_per_m: 0.0, lateral_damping: false }
    }
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
    fn check_radius(&self) -> Result<(), ModelError> {
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

/// The parameter of a derivative.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Parameter {
    /// The friction coefficient.
    Friction,
    /// The normal load, N.
    Load,
    /// The disc speed, rad/s.
    Speed,
    /// The logarithm of a common factor on the stiffness of all contact pairs, so that derivatives are per relative
    /// change.
    ContactStiffness,
    /// The logarithm of a common factor on the damping of all contact pairs.
    ContactDamping,
}

impl Parameter {
    /// All parameters, in the order in which derivatives are listed.
    pub const ALL: [Self; 5] = [Self::Friction, Self::Load, Self::Speed, Self::ContactStiffness, Self::ContactDamping];
}

/// Why a model could not be built or evaluated.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum ModelError {
    /// A matrix has the wrong shape.
    #[error("{what} is {rows}x{columns}, expected {expected}x{expected}")]
    Shape {
        /// Which matrix.
        what: String,
        /// Number of rows found.
        rows: usize,
        /// Number of columns found.
        columns: usize,
        /// Number of rows and columns expected.
        expected: usize,
    },
    /// A matrix has an entry that is no finite number.
    #[error("{what}: entry ({row}, {column}) is {value}, expected a finite number")]
    NotFinite {
        /// Which matrix.
        what: String,
        /// Row of the entry, from 0.
        row: usize,
        /// Column of the entry, from 0.
        column: usize,
        /// The entry.
        value: f64,
    },
    /// A law has no finite value at an operating point.
    #[error(
        "{what} is {value} at {normal_load_n} N, {disc_speed_rad_s} rad/s, friction coefficient {friction_coefficient}; expected a finite number"
    )]
    LawNotFinite {
        /// Which law.
        what: String,
        /// The value found.
        value: f64,
        /// Normal load, N.
        normal_load_n: f64,
        /// Disc speed, rad/s.
        disc_speed_rad_s: f64,
        /// Friction coefficient.
        friction_coefficient: f64,
    },
    /// A list does not have one value for each contact pair.
    #[error("{what} has {found} values, expected one for each of {expected} contact pairs")]
    PairCount {
        /// Which list.
        what: &'static str,
        /// The number found.
        found: usize,
        /// Number of contact pairs.
        expected: usize,
    },
    /// Residual flexibility beside a contact stiffness that depends on the load.
    #[error(
        "residual flexibility with [load] exponent {exponent}, expected 0: it requires a contact stiffness that \
         does not depend on the load"
    )]
    FlexibleLoadExponent {
        /// [`ContactLaw::exponent`].
        exponent: f64,
    },
    /// The contact flexibility is nearly singular.
    #[error(
        "contact flexibility at friction coefficient {friction_coefficient} has condition number {condition:.1e}, \
         limit {limit:.1e}; a smaller search.mu_max and limits.friction_coefficient exclude it"
    )]
    IllConditioned {
        /// Friction coefficient.
        friction_coefficient: f64,
        /// Its condition number.
        condition: f64,
        /// Largest condition number accepted.
        limit: f64,
    },
    /// The contact flexibility is not resolved by Chebyshev polynomials in the friction coefficient.
    #[error(
        "contact flexibility over friction coefficients up to {range} leaves {value:.1e} to the highest of {degrees} \
         Chebyshev polynomials, limit {limit:.1e}; a smaller search.mu_max and limits.friction_coefficient help"
    )]
    FlexibilityFit {
        /// Largest friction coefficient of the expansion.
        range: f64,
        /// Number of polynomials.
        degrees: usize,
        /// Size of the highest coefficient, relative.
        value: f64,
        /// Largest such size accepted.
        limit: f64,
    },
    /// A contact pair has no lever arm, which lateral damping needs.
    #[error("contact pair {pair}: radius_m is {radius_m}, expected more than 0 for lateral damping")]
    Radius {
        /// Index of the pair.
        pair: usize,
        /// Its distance from the axis, m.
        radius_m: f64,
    },
    /// Damping of a pair that is not proportional to its stiffness.
    #[error(
        "contact pair {pair}: damping {damping} N·s/m with stiffness {stiffness} N/m; with a contact state the damping \
         of a pair is proportional to its stiffness"
    )]
    StateDamping {
        /// Index of the pair.
        pair: usize,
        /// Its stiffness, N/m.
        stiffness: f64,
        /// Its damping, N·s/m.
        damping: f64,
    },
    /// Residual inertia together with a contact state.
    #[error("residual inertia with a contact state, expected residual flexibility only")]
    StateInertia,
    /// A load exponent together with a contact state.
    #[error(
        "[load] exponent {exponent} with a contact state, expected 0: the law of the contact state gives the stiffness"
    )]
    StateLoadExponent {
        /// [`ContactLaw::exponent`].
        exponent: f64,
    },
    /// There is no contact state at the operating point.
    #[error("contact state: {0}")]
    State(#[source] StaticsError),
    /// An operating point with a value that is no finite number.
    #[error(
        "operating point ({normal_load_n} N, {disc_speed_rad_s} rad/s, friction coefficient {friction_coefficient}) is not finite"
    )]
    PointNotFinite {
        /// Normal load, N.
        normal_load_n: f64,
        /// Disc speed, rad/s.
        disc_speed_rad_s: f64,
        /// Friction coefficient.
        friction_coefficient: f64,
    },
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
    /// C += (B_n + s μ B_t)ᵀ C_c B_n + dμ/dv B_tᵀ diag(N_0) B_t + μ B_bᵀ diag(N_0 / v) B_b
    /// N_0 = N / c, v_k = |ω| r_k
    /// ```
    ///
    /// # Errors
    /// [`ModelError::Shape`], [`ModelError::NotFinite`], [`ModelError::PairCount`], [`ModelError::Radius`].
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
        let expands = |law: &Law| matches!(law, Law::FrictionChebyshev { .. } | Law::DiscSpeedChebyshev { .. });
        self.has_contact && !terms.any(|known| expands(&known.term.law))
    }

    /// The contact state at `p`; a model without contact pairs is always closed.
    pub fn contact_state(&self, p: &OperatingPoint) -> ContactState {
        if self.has_contact { p.contact_state() } else { p.state_closed() }
    }

    /// Value of `law` at `p`.
    pub(super) fn coefficient(&self, law: &Law, p: &OperatingPoint) -> f64 {
        law.value(&self.contact_law, self.contact_state(p), p)
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

    /// Derivative of the value of `law` at `p` with respect to `parameter`: per unit of the friction coefficient, per
    /// N, per rad/s, or per relative change of contact stiffness or damping.
    pub(super) fn derivative(&self, law: &Law, p: &OperatingPoint, parameter: Parameter) -> f64 {
        use Parameter::{ContactDamping, ContactStiffness, Friction, Load, Speed};
        let value = self.coefficient(law, p);
        // The factor of the friction coefficient; evaluated at `μ = 1` because `μ` may be zero.
        let per_friction = || self.coefficient(law, &p.with_friction(1.0));
        // The value is 0 where nothing slides, and load or speed may be zero there.
        let ratio = |value: f64, by: f64| if value == 0.0 { 0.0 } else { value / by };
        match law {
            Law::Constant => 0.0,
            Law::ContactStiffness => match parameter {
                Load => ratio(value * self.contact_law.exponent, p.normal_load_n),
                ContactStiffness => value,
                Friction | Speed | ContactDamping => 0.0,
            },
            Law::FrictionStiffness => match parameter {
                Friction => per_friction(),
                Load => ratio(value * self.contact_law.exponent, p.normal_load_n),
                ContactStiffness => value,
                Speed | ContactDamping => 0.0,
            },
            Law::ContactDamping => match parameter {
                ContactDamping => value,
                Friction | Load | Speed | ContactStiffness => 0.0,
            },
            Law::FrictionDamping => match parameter {
                Friction => per_friction(),
                ContactDamping => value,
                Load | Speed | ContactStiffness => 0.0,
            },
            Law::FrictionSlope => match parameter {
                Load => ratio(value, p.normal_load_n),
                Friction | Speed | ContactStiffness | ContactDamping => 0.0,
            },
            Law::LateralFriction => match parameter {
                Friction => per_friction(),
                Load => ratio(value, p.normal_load_n),
                Speed => ratio(-value, p.disc_speed_rad_s),
                ContactStiffness | ContactDamping => 0.0,
            },
            Law::FrictionChebyshev { degree, range } => match parameter {
                Friction if value.is_finite() && p.contact_state() == ContactState::Sliding => {
                    let sign = p.disc_speed_rad_s.signum();
                    sign * chebyshev::odd_at_zero_slope(sign * p.friction_coefficient, *degree, *range)
                }
                Friction | Load | Speed | ContactStiffness | ContactDamping => 0.0,
            },
            Law::DiscSpeed { power } => match parameter {
                Speed => power_slope(p.disc_speed_rad_s, *power),
                Friction | Load | ContactStiffness | ContactDamping => 0.0,
            },
            Law::DiscSpeedInContact { power } => match parameter {
                Speed if self.contact_state(p) != ContactState::Open => power_slope(p.disc_speed_rad_s, *power),
                Friction | Load | Speed | ContactStiffness | ContactDamping => 0.0,
            },
            Law::DiscSpeedChebyshev { power, degree, range } => {
                let expansion = Law::FrictionChebyshev { degree: *degree, range: *range };
                match parameter {
                    Speed => power_slope(p.disc_speed_rad_s, *power) * self.coefficient(&expansion, p),
                    Friction => p.disc_speed_rad_s.powi(i32::from(*power)) * self.derivative(&expansion, p, Friction),
                    Load | ContactStiffness | ContactDamping => 0.0,
                }
            }
            Law::Custom(custom) => self.custom_derivative(custom, law, p, parameter),
        }
    }

    /// Derivative of a custom law by a central difference with a relative step of 1e-6.
    fn custom_derivative(&self, custom: &CustomLaw, law: &Law, p: &OperatingPoint, parameter: Parameter) -> f64 {
        let (depends, at, least) = match parameter {
            Parameter::Friction => (custom.depends_on_friction, p.friction_coefficient, 1.0),
            Parameter::Load => (custom.depends_on_load, p.normal_load_n, 1e-3),
            Parameter::Speed => (custom.depends_on_speed, p.disc_speed_rad_s, 1e-3),
            Parameter::ContactStiffness | Parameter::ContactDamping => return 0.0,
        };
        if !depends {
            return 0.0;
        }
        let step = 1e-6 * at.abs().max(least);
        let moved = |to: f64| match parameter {
            Parameter::Load => OperatingPoint { normal_load_n: to, ..*p },
            Parameter::Speed => OperatingPoint { disc_speed_rad_s: to, ..*p },
            _ => p.with_friction(to),
        };
        let (up, down) = (self.coefficient(law, &moved(at + step)), self.coefficient(law, &moved(at - step)));
        // A law may be undefined for negative friction coefficients; the difference is then one-sided.
        if down.is_finite() { (up - down) / (2.0 * step) } else { (up - self.coefficient(law, p)) / step }
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
            match &known.term.law {
                Law::Constant | Law::ContactDamping | Law::FrictionDamping | Law::FrictionChebyshev { .. } => {}
                Law::ContactStiffness | Law::FrictionStiffness => load |= self.contact_law.exponent != 0.0,
                Law::FrictionSlope => load = true,
                Law::LateralFriction => (load, speed) = (true, true),
                Law::DiscSpeed { .. } | Law::DiscSpeedInContact { .. } | Law::DiscSpeedChebyshev { .. } => speed = true,
                Law::Custom(custom) => {
                    load |= custom.depends_on_load;
                    speed |= custom.depends_on_speed;
                }
            }
        }
        (load, speed)
    }

    /// Whether the model depends on load and speed through their ratio only.
    pub fn depends_on_load_over_speed_only(&self) -> bool {
        let exponent = self.contact_law.exponent;
        let constant = |law: &Law| match law {
            Law::Constant | Law::ContactDamping | Law::FrictionDamping | Law::FrictionChebyshev { .. } => true,
            Law::ContactStiffness | Law::FrictionStiffness => exponent == 0.0,
            Law::FrictionSlope | Law::LateralFriction => false,
            Law::DiscSpeed { .. } | Law::DiscSpeedInContact { .. } | Law::DiscSpeedChebyshev { .. } => false,
            Law::Custom(custom) => !custom.depends_on_load && !custom.depends_on_speed,
        };
        let rest = || self.stiffness.iter().chain(&self.damping).filter(|known| !constant(&known.term.law));
        self.steady.is_none()
            && rest().count() > 0
            && rest().all(|known| matches!(known.term.law, Law::LateralFriction))
    }
}

/// Derivative of `Ω^p` with respect to `Ω`.
fn power_slope(speed: f64, power: u8) -> f64 {
    match power {
        0 => 0.0,
        power => f64::from(power) * speed.powi(i32::from(power) - 1),
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

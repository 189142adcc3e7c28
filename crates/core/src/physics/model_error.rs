//! Why a model could not be built or evaluated.

use crate::contact::StaticsError;

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
        /// [`ContactLaw::exponent`](crate::physics::ContactLaw::exponent).
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
    /// A contact pair has no lever arm, which friction that depends on the sliding speed needs.
    #[error(
        "contact pair {pair}: radius_m is {radius_m}, expected more than 0 for lateral damping and for friction that \
         falls with speed"
    )]
    Radius {
        /// Index of the pair.
        pair: usize,
        /// Its distance from the axis, m.
        radius_m: f64,
    },
    /// The radii of the contact pairs are too many and too different for the slope of the Stribeck law.
    #[error(
        "{found} contact pairs at different radii from {low_m} to {high_m} m, expected at most {limit}, or a range that \
         as many polynomials cover: the sliding speed of a pair, and with it the slope of stribeck_drop, follows its \
         radius"
    )]
    StribeckRadii {
        /// Number of different radii.
        found: usize,
        /// Smallest radius, m.
        low_m: f64,
        /// Largest radius, m.
        high_m: f64,
        /// Largest number of radii.
        limit: usize,
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
        /// [`ContactLaw::exponent`](crate::physics::ContactLaw::exponent).
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

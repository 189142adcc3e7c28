//! Statics of steady sliding: closures and forces of contact pairs that can open, by semi-smooth Newton steps.

use std::sync::{Mutex, OnceLock, PoisonError};

use faer::Mat;

use super::anchors::{self, Anchor, Work};
use super::law::{LawError, LawValue, PressureLaw};
use super::path;
use super::response::StaticResponse;
use super::shape::{ShapeError, check_shape};

/// Which force a rig measures as its normal load.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum MeasuredLoad {
    /// The force `F` on the back of the pad. Where other springs share it, `Σ N < F`.
    Back,
    /// The sum of the contact forces, `Σ N`. The force on the back is then an unknown.
    Contact,
}

/// Input of the statics of `c` contact pairs.
#[derive(Clone, Debug)]
pub struct StaticsParts {
    /// Contact law of all pairs.
    pub law: PressureLaw,
    /// `A`, `c`: area of each pair in m², or a factor; force = area × pressure. Positive.
    pub area: Vec<f64>,
    /// `h`, `c`, m: initial gaps, pad minus disc along the normal; negative for interference.
    pub gap_m: Vec<f64>,
    /// Static response of the parts.
    pub response: StaticResponse,
    /// Which force the load is.
    pub measured: MeasuredLoad,
}

/// Statics of steady sliding of `c` contact pairs.
#[derive(Clone, Debug)]
pub struct Statics {
    pub(super) parts: StaticsParts,
    pub(super) total_area: f64,
    /// Loads (N) and `s_mu` at which anchors are computed.
    anchored_at: [Vec<f64>; 2],
    /// Computed with the first state.
    anchors: OnceLock<Vec<Anchor>>,
    spare: Spare,
}

/// Work arrays that wait for the next state; a copy has none.
#[derive(Debug, Default)]
struct Spare(Mutex<Vec<Work>>);

impl Clone for Spare {
    fn clone(&self) -> Self {
        Self::default()
    }
}

impl Spare {
    /// What `solve` returns with work arrays of its own.
    fn with<T>(&self, solve: impl FnOnce(&mut Work) -> T) -> T {
        let mut work = self.0.lock().unwrap_or_else(PoisonError::into_inner).pop().unwrap_or_default();
        let found = solve(&mut work);
        self.0.lock().unwrap_or_else(PoisonError::into_inner).push(work);
        found
    }
}

/// Why the states that continue frictionless contact end at some friction coefficient.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PathEnd {
    /// At a given force on the back, the contact forces grow without limit; at a given contact force, the force on the
    /// back vanishes.
    Jams,
    /// A turning point: from it the states continue towards smaller friction coefficients. Just below it there are two
    /// states, just above it there is none nearby.
    Turns,
    /// The closed pairs no longer support a free-floating part.
    Tips,
}

impl std::fmt::Display for PathEnd {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Self::Jams => "the pad jams",
            Self::Turns => "the state turns back and is not unique",
            Self::Tips => "the closed pairs no longer support a free-floating part",
        })
    }
}

/// Why there is no state.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum StaticsError {
    /// The contact law is invalid.
    #[error("contact law: {0}")]
    Law(#[from] LawError),
    /// A matrix or list has the wrong shape.
    #[error(transparent)]
    Shape(#[from] ShapeError),
    /// An entry is outside its range.
    #[error("{what}, entry ({row}, {column}), is {value}, expected {limit}")]
    Value {
        /// Which matrix or list.
        what: &'static str,
        /// Row of the entry, from 0.
        row: usize,
        /// Column of the entry, from 0.
        column: usize,
        /// The entry.
        value: f64,
        /// The range expected.
        limit: &'static str,
    },
    /// A condition is outside its range.
    #[error("{what} is {value}, expected {limit}")]
    Condition {
        /// The condition.
        what: &'static str,
        /// Its value.
        value: f64,
        /// The range expected.
        limit: &'static str,
    },
    /// No state without friction was found, from which states with friction are followed.
    #[error(
        "no steady sliding without friction at a load of {load_n} N: Newton steps leave {residual:.1e} of the forces, limit \
         {limit:.1e}; the load does not press free-floating parts together, or nothing supports them"
    )]
    NoStateAtRest {
        /// The load, N.
        load_n: f64,
        /// Residual of the forces, relative.
        residual: f64,
        /// Largest residual accepted.
        limit: f64,
    },
    /// There is no steady sliding at a friction coefficient.
    #[error(
        "no steady sliding at a load of {load_n} N and friction coefficient {}{}: {end} at {:.6}",
        asked.abs(), if *asked < 0.0 { " in reverse" } else { "" }, friction_coefficient.abs()
    )]
    NoEquilibrium {
        /// The load, N.
        load_n: f64,
        /// The friction coefficient requested, with the sign of the disc speed.
        asked: f64,
        /// The friction coefficient at which the states end, with the sign of the disc speed.
        friction_coefficient: f64,
        /// How they end.
        end: PathEnd,
    },
    /// A pair is closed further than the table of the law reaches.
    #[error("contact pair {pair} is closed by {closure_m:e} m, beyond the last closure of the table, {limit_m:e} m")]
    BeyondTable {
        /// Index of the pair.
        pair: usize,
        /// Its closure, m.
        closure_m: f64,
        /// Last closure of the table, m.
        limit_m: f64,
    },
}

/// Derivatives of a state with respect to one parameter.
#[derive(Clone, Debug, PartialEq)]
pub struct StateSlope {
    /// `dδ`, `c`.
    pub closure: Vec<f64>,
    /// `dN`, `c`.
    pub force: Vec<f64>,
    /// `dk`, `c`: of the tangent stiffness.
    pub tangent: Vec<f64>,
    /// `dρ`, `r`.
    pub rigid: Vec<f64>,
    /// `dF`.
    pub back_force: f64,
}

/// A state of steady sliding. Where a pair with a sharp onset is exactly at it, derivatives are those of the open side.
#[derive(Clone, Debug, PartialEq)]
pub struct SteadyState {
    /// The measured load, N.
    pub load_n: f64,
    /// `s μ`: friction coefficient times the sign of the disc speed.
    pub friction: f64,
    /// `F`, N: force on the back of the pad.
    pub back_force_n: f64,
    /// `δ`, `c`, m: closures; negative where a pair is apart.
    pub closure_m: Vec<f64>,
    /// `N`, `c`, N: contact forces.
    pub force_n: Vec<f64>,
    /// `k = dN/dδ`, `c`, N/m; 0 where a pair with a sharp onset is open.
    pub tangent_n_per_m: Vec<f64>,
    /// `dk/dδ`, `c`, N/m².
    pub curvature_n_per_m2: Vec<f64>,
    /// `ρ`, `r`: amplitudes of rigid motions.
    pub rigid: Vec<f64>,
    /// Residual of the equations, relative to the largest of their terms.
    pub residual: f64,
    /// Per N of the measured load.
    pub per_load: StateSlope,
    /// Per unit of `s μ`.
    pub per_friction: StateSlope,
    /// Per relative change of the contact law's stiffness, `d/d ln κ` for `N = κ A p(δ)`.
    pub per_stiffness: StateSlope,
}

impl SteadyState {
    /// Number of pairs that carry a force.
    pub fn pairs_closed(&self) -> usize {
        self.force_n.iter().filter(|force| **force > 0.0).count()
    }

    /// `Σ N`, N.
    pub fn contact_force_n(&self) -> f64 {
        self.force_n.iter().sum()
    }
}

impl Statics {
    /// Checks shapes, signs and finiteness.
    ///
    /// # Errors
    /// [`StaticsError`]: `Law`, `Shape`, `Value`.
    pub fn new(parts: StaticsParts) -> Result<Self, StaticsError> {
        parts.law.check()?;
        let c = parts.area.len();
        let StaticResponse { normal_flexibility, sliding_flexibility, gap_per_load, rigid } = &parts.response;
        let r = rigid.load.len();
        let column = |values: &[f64]| Mat::from_fn(values.len(), 1, |k, _| values[k]);
        let [area, gaps, load, rigid_load] =
            [&parts.area, &parts.gap_m, gap_per_load, &rigid.load].map(|values| column(values));
        for (what, matrix, rows, columns) in [
            ("area", &area, c, 1),
            ("initial gap", &gaps, c, 1),
            ("gap per load", &load, c, 1),
            ("normal flexibility", normal_flexibility, c, c),
            ("sliding flexibility", sliding_flexibility, c, c),
            ("gap per rigid motion", &rigid.normal, c, r),
            ("sliding per rigid motion", &rigid.sliding, c, r),
            ("load on rigid motions", &rigid_load, r, 1),
        ] {
            check_shape(what, matrix.shape(), (rows, columns))?;
            for j in 0..columns {
                for i in 0..rows {
                    let value = matrix[(i, j)];
                    let limit = match what {
                        "area" if value <= 0.0 => "more than 0",
                        "normal flexibility" if i == j && value < 0.0 => "at least 0",
                        _ if !value.is_finite() => "a finite number",
                        _ => continue,
                    };
                    return Err(StaticsError::Value { what, row: i, column: j, value, limit });
                }
            }
        }
        if c == 0 {
            return Err(StaticsError::Condition { what: "number of contact pairs", value: 0.0, limit: "at least 1" });
        }
        let total_area = parts.area.iter().sum();
        Ok(Self { parts, total_area, anchored_at: [vec![], vec![]], anchors: OnceLock::new(), spare: Spare::default() })
    }

    /// Adds anchors: the states at all combinations of `loads_n` (N, positive) and `s_mus`. Solutions start at the nearest
    /// anchor: a few solves with its factors replace the path from `s_mu = 0`. This changes states by rounding errors only,
    /// and they remain pure functions of statics, load and friction coefficient. Combinations without a state are omitted.
    /// All anchors are computed together, when the first state or [`Self::anchors`] needs them.
    #[must_use]
    pub fn with_anchors(mut self, loads_n: &[f64], s_mus: &[f64]) -> Self {
        let loads: Vec<f64> = loads_n.iter().copied().filter(|load| load.is_finite() && *load > 0.0).collect();
        let s_mus: Vec<f64> = s_mus.iter().copied().filter(|s_mu| s_mu.is_finite()).collect();
        self.anchored_at = [loads, s_mus];
        self.anchors = OnceLock::new();
        self
    }

    /// Number of anchors, see [`Self::with_anchors`]. Computes them if they are not known yet.
    pub fn anchors(&self) -> usize {
        self.known_anchors().len()
    }

    fn known_anchors(&self) -> &[Anchor] {
        let [loads_n, s_mus] = &self.anchored_at;
        self.anchors.get_or_init(|| anchors::anchors(self, loads_n, s_mus))
    }

    /// Number of contact pairs, `c`.
    pub fn pairs(&self) -> usize {
        self.parts.area.len()
    }

    /// Input of the statics.
    pub fn parts(&self) -> &StaticsParts {
        &self.parts
    }

    /// The state at the measured load `load_n` (N) and `s_mu`, friction coefficient times the sign of the disc speed: the
    /// one that follows continuously from `s_mu = 0`. A pure function of its arguments.
    ///
    /// # Errors
    /// [`StaticsError`]: `Condition` if an argument is not finite, or the load is not positive although it alone holds
    /// free-floating parts or is the contact force; `NoStateAtRest`; `NoEquilibrium` where the states end before `s_mu`;
    /// `BeyondTable`.
    pub fn state(&self, load_n: f64, s_mu: f64) -> Result<SteadyState, StaticsError> {
        for (what, value) in [("load", load_n), ("friction coefficient", s_mu)] {
            if !value.is_finite() {
                return Err(StaticsError::Condition { what, value, limit: "a finite number" });
            }
        }
        let needs_load = !self.parts.response.rigid.load.is_empty() || self.parts.measured == MeasuredLoad::Contact;
        if needs_load && load_n <= 0.0 {
            return Err(StaticsError::Condition { what: "load", value: load_n, limit: "more than 0" });
        }
        let anchors = if load_n > 0.0 { self.known_anchors() } else { &[] };
        let near = self.spare.with(|work| anchors::from_anchor(self, anchors, load_n, s_mu, work));
        let found = near.map_or_else(|| path::follow(self, load_n, s_mu), Ok)?;
        if let PressureLaw::Table(table) = &self.parts.law {
            let limit_m = table.last_closure_m();
            if let Some(pair) = found.closure_m.iter().position(|closure| *closure > limit_m) {
                return Err(StaticsError::BeyondTable { pair, closure_m: found.closure_m[pair], limit_m });
            }
        }
        Ok(found)
    }

    /// Value of the contact law of `pair`, times its area.
    pub(super) fn law_at(&self, pair: usize, closure_m: f64) -> LawValue {
        let LawValue { pressure, tangent, curvature } = self.parts.law.at(closure_m);
        let area = self.parts.area[pair];
        LawValue { pressure: area * pressure, tangent: area * tangent, curvature: area * curvature }
    }

    /// Number of unknowns beside the closures: rigid motions, and the force on the back if it is not measured.
    pub(super) fn others(&self) -> usize {
        self.parts.response.rigid.load.len() + usize::from(self.parts.measured == MeasuredLoad::Contact)
    }
}

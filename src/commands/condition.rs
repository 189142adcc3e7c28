//! One condition of an operating point as the variable of a command: friction coefficient, load or speed.

use std::panic::resume_unwind;

use crate::physics::{OperatingPoint, Solver};

/// An edge between two operating points is located to this share of their distance.
const EDGE_TOLERANCE: f64 = 1e-6;

/// A condition.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Condition {
    Friction,
    Load,
    Speed,
}

impl Condition {
    /// Name with unit, for axes.
    pub(super) fn label(self) -> &'static str {
        match self {
            Self::Friction => "friction coefficient",
            Self::Load => "normal load, N",
            Self::Speed => "disc speed, rad/s",
        }
    }

    /// `point` with this condition at `value`.
    pub(super) fn set(self, point: OperatingPoint, value: f64) -> OperatingPoint {
        match self {
            Self::Friction => point.with_friction(value),
            Self::Load => OperatingPoint { normal_load_n: value, ..point },
            Self::Speed => OperatingPoint { disc_speed_rad_s: value, ..point },
        }
    }

    /// The value of this condition at `point`.
    pub(super) fn of(self, point: &OperatingPoint) -> f64 {
        match self {
            Self::Friction => point.friction_coefficient,
            Self::Load => point.normal_load_n,
            Self::Speed => point.disc_speed_rad_s,
        }
    }
}

/// Where `holds` changes between `low`, where it is `before`, and `high`, where it is not, by bisection. An unknown state
/// counts as changed.
pub(super) fn change_between(
    mut low: f64,
    mut high: f64,
    before: bool,
    mut holds: impl FnMut(f64) -> Option<bool>,
) -> f64 {
    let least = EDGE_TOLERANCE * (high - low);
    while high - low > least {
        let middle = 0.5 * (low + high);
        match holds(middle) {
            Some(state) if state == before => low = middle,
            Some(_) | None => high = middle,
        }
    }
    high
}

/// `task` for every value, on all cores: each is computed by one thread and does not depend on the others.
pub(super) fn in_parallel<T: Send>(
    values: &[f64],
    dimension: usize,
    task: impl Fn(f64, &mut Solver) -> T + Sync,
) -> Vec<T> {
    let threads = std::thread::available_parallelism().map_or(1, usize::from).min(values.len());
    let part = |first: usize| {
        let mut solver = Solver::new(dimension);
        let own = values.iter().enumerate().skip(first).step_by(threads);
        own.map(|(index, &value)| (index, task(value, &mut solver))).collect::<Vec<_>>()
    };
    let mut found: Vec<(usize, T)> = std::thread::scope(|scope| {
        let part = &part;
        let workers: Vec<_> = (0..threads).map(|first| scope.spawn(move || part(first))).collect();
        workers.into_iter().flat_map(|worker| worker.join().unwrap_or_else(|panic| resume_unwind(panic))).collect()
    });
    found.sort_by_key(|(index, _)| *index);
    found.into_iter().map(|(_, found)| found).collect()
}

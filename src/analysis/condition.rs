//! One condition as a variable: friction coefficient, load, speed or temperature.

use std::borrow::Cow;
use std::panic::resume_unwind;

use super::AnalysisError;
use crate::msgs::listed;
use crate::physics::{OperatingPoint, Solver};
use crate::rig::{Rig, RigError};

/// An edge between two operating points is located to this share of their distance.
const EDGE_TOLERANCE: f64 = 1e-6;

/// An operating point, with the temperature of a rig that has one, °C.
#[derive(Clone, Copy, Debug)]
pub struct Place {
    pub point: OperatingPoint,
    pub temperature_c: Option<f64>,
}

impl Place {
    /// The conditions that every table of places begins with.
    pub const COLUMNS: [&str; 3] = ["normal_load_n", "disc_speed_rad_s", "friction_coefficient"];
    /// The column after them, of a rig with a temperature.
    pub const TEMPERATURE_COLUMN: &str = "temperature_c";

    /// The values of these columns.
    pub fn cells(&self) -> impl Iterator<Item = String> {
        let OperatingPoint { normal_load_n, disc_speed_rad_s, friction_coefficient } = self.point;
        let conditions = [normal_load_n, disc_speed_rad_s, friction_coefficient];
        conditions.into_iter().chain(self.temperature_c).map(|value| value.to_string())
    }

    /// The columns of a table of places of `rig`.
    pub fn columns(rig: &Rig) -> impl Iterator<Item = &'static str> {
        Self::COLUMNS.into_iter().chain(rig.temperature_c().map(|_| Self::TEMPERATURE_COLUMN))
    }

    /// The rig at the temperature of this place.
    ///
    /// # Errors
    /// [`RigError`] if the rig has no such temperature.
    pub fn rig<'a>(&self, rig: &'a Rig) -> Result<Cow<'a, Rig>, RigError> {
        match self.temperature_c {
            Some(celsius) if rig.temperature_c() != Some(celsius) => rig.at_temperature(celsius).map(Cow::Owned),
            Some(_) | None => Ok(Cow::Borrowed(rig)),
        }
    }

    /// Checks that `rig` accepts the conditions.
    ///
    /// # Errors
    /// The condition that is out of range.
    pub fn check(&self, rig: &Rig) -> Result<(), AnalysisError> {
        super::check(rig, &self.point)?;
        Ok(self.temperature_c.map_or(Ok(()), |celsius| rig.accepts_temperature(celsius))?)
    }

    /// The conditions that are not `varied`, in words.
    pub fn fixed(&self, varied: &[Condition]) -> String {
        let words =
            Condition::ALL.into_iter().filter(|condition| !varied.contains(condition)).filter_map(|condition| {
                Some(condition.of(self)).filter(|value| !value.is_nan()).map(|value| match condition {
                    Condition::Friction => format!("friction coefficient {value}"),
                    Condition::Load => format!("{value} N"),
                    Condition::Speed => format!("{value} rad/s"),
                    Condition::Temperature => format!("{value} °C"),
                })
            });
        words.collect::<Vec<_>>().join(", ")
    }
}

listed! {
    /// A condition.
    pub enum Condition {
        Friction,
        Load,
        Speed,
        Temperature,
    }
}

impl Condition {
    /// Name with unit, as in tables and rig files.
    pub fn key(self) -> &'static str {
        match self {
            Self::Friction => "friction_coefficient",
            Self::Load => "normal_load_n",
            Self::Speed => "disc_speed_rad_s",
            Self::Temperature => "temperature_c",
        }
    }

    /// Name with unit, for axes.
    pub fn label(self) -> &'static str {
        match self {
            Self::Friction => "friction coefficient",
            Self::Load => "normal load, N",
            Self::Speed => "disc speed, rad/s",
            Self::Temperature => "temperature, °C",
        }
    }

    /// `place` with this condition at `value`.
    pub fn set(self, place: Place, value: f64) -> Place {
        let point = place.point;
        match self {
            Self::Friction => Place { point: point.with_friction(value), ..place },
            Self::Load => Place { point: OperatingPoint { normal_load_n: value, ..point }, ..place },
            Self::Speed => Place { point: OperatingPoint { disc_speed_rad_s: value, ..point }, ..place },
            Self::Temperature => Place { temperature_c: Some(value), ..place },
        }
    }

    /// The value of this condition at `place`; NaN for the temperature of a rig without one.
    pub fn of(self, place: &Place) -> f64 {
        match self {
            Self::Friction => place.point.friction_coefficient,
            Self::Load => place.point.normal_load_n,
            Self::Speed => place.point.disc_speed_rad_s,
            Self::Temperature => place.temperature_c.unwrap_or(f64::NAN),
        }
    }
}

/// Where `holds` changes between `low`, where it is `before`, and `high`, where it is not, by bisection. An unknown state
/// counts as changed.
pub fn change_between(mut low: f64, mut high: f64, before: bool, mut holds: impl FnMut(f64) -> Option<bool>) -> f64 {
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
pub fn in_parallel<V: Copy + Sync, T: Send>(
    values: &[V],
    dimension: usize,
    task: impl Fn(V, &mut Solver) -> T + Sync,
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

//! What a session uses and somebody else computes: stability maps, window ends, charts and rigs at other temperatures.
//! Live operation, offline prediction and verification all compute them here, and record them by the same session events.

use std::sync::Arc;

use sha2::{Digest, Sha256};

use super::{Event, chart_options, map_options};
use crate::msgs::{Header, SessionEvent, SessionEventKind};
use crate::physics::chart::build::{ChartOptions, build};
use crate::physics::{Chart, Ends, OperatingPoint, Solver, StabilityMap};
use crate::rig::Rig;
use crate::text::hex::hex;

/// A result that later predictions would use and the session does not compute itself.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Request {
    /// A stability map at this load and speed.
    Map(OperatingPoint),
    /// The window ends of the map in force, at this load and speed.
    Ends(OperatingPoint),
}

impl Request {
    /// The load and speed; the friction coefficient is not used.
    pub fn point(&self) -> &OperatingPoint {
        match self {
            Self::Map(point) | Self::Ends(point) => point,
        }
    }
}

/// Computes a request; `map` is the stability map in force. Returns the event that hands the result to the session, or
/// `None` if window ends cannot be followed to that load and speed, so that a new map is needed there.
///
/// # Errors
/// Why it cannot be computed, as text.
pub fn compute(
    rig: &Rig,
    solver: &mut Solver,
    map: Option<&StabilityMap>,
    request: &Request,
) -> Result<Option<Event>, String> {
    match request {
        Request::Map(point) => Ok(Some(Event::MapReady(Arc::new(session_map(rig, solver, point)?)))),
        Request::Ends(point) => {
            let map = map.ok_or("window ends are requested before any map")?;
            Ok(session_ends(rig, solver, map, point)?.map(|ends| Event::EndsReady(Arc::new(ends))))
        }
    }
}

/// The session event that records `event`; `None` for an input, which is recorded itself.
pub fn record_of(event: &Event, header: Header) -> Option<SessionEvent> {
    let at = |kind: SessionEventKind, point: &OperatingPoint, hash: String| SessionEvent {
        kind: kind.number(),
        normal_load_n: point.normal_load_n,
        disc_speed_rad_s: point.disc_speed_rad_s,
        hash,
        ..Default::default()
    };
    let record = match event {
        Event::Input(_) => return None,
        Event::Parameter { name, value } => return Some(parameter_record(header, name, *value)),
        Event::Silence { .. } => SessionEvent { kind: SessionEventKind::Silence.number(), ..Default::default() },
        Event::MapReady(map) => at(SessionEventKind::StabilityMap, &map.point, hash(map.words().into_iter())),
        Event::EndsReady(ends) => at(SessionEventKind::WindowEnds, &ends.point, hash(ends.words())),
        Event::ChartReady(chart) => {
            SessionEvent { kind: SessionEventKind::Chart.number(), hash: chart_hash(chart), ..Default::default() }
        }
        Event::RigReady(rig) => {
            let value = rig.temperature_c().unwrap_or(f64::NAN);
            SessionEvent { kind: SessionEventKind::Temperature.number(), value, ..Default::default() }
        }
    };
    Some(SessionEvent { header, ..record })
}

/// The session event that records the value of a setting.
pub fn parameter_record(header: Header, name: &str, value: f64) -> SessionEvent {
    let kind = SessionEventKind::Parameter.number();
    SessionEvent { header, kind, name: name.to_owned(), value, ..Default::default() }
}

/// `rig` at a temperature, °C, as a session uses it.
///
/// # Errors
/// Why it cannot be built, as text.
pub fn session_rig(rig: &Rig, celsius: f64) -> Result<Arc<Rig>, String> {
    rig.at_temperature(celsius).map(Arc::new).map_err(|error| error.to_string())
}

/// The stability map that a session uses at the load and speed of `point`.
///
/// # Errors
/// Why it cannot be computed, as text.
pub fn session_map(rig: &Rig, solver: &mut Solver, point: &OperatingPoint) -> Result<StabilityMap, String> {
    StabilityMap::build(&rig.model, solver, point, &map_options(rig)).map_err(|error| error.to_string())
}

/// The window ends of `map` that a session uses at the load and speed of `point`; `None` if a new map is needed there.
///
/// # Errors
/// Why they cannot be computed, as text.
pub fn session_ends(
    rig: &Rig,
    solver: &mut Solver,
    map: &StabilityMap,
    point: &OperatingPoint,
) -> Result<Option<Ends>, String> {
    Ends::carried(&rig.model, solver, map, point).map_err(|error| error.to_string())
}

/// The chart that a session uses. It does not depend on the number of threads. The build stops when `go_on` returns
/// false.
///
/// # Errors
/// Why it cannot be built, as text.
pub fn session_chart(rig: &Rig, threads: usize, go_on: &dyn Fn() -> bool) -> Result<Chart, String> {
    let options = ChartOptions { threads, ..chart_options(rig) };
    build(&rig.model, &options, &|_| go_on()).map_err(|error| error.to_string())
}

/// SHA-256 of all numbers of a chart that can affect predictions, hexadecimal.
pub fn chart_hash(chart: &Chart) -> String {
    hash(chart.words().into_iter())
}

/// SHA-256 of numbers, hexadecimal.
fn hash(words: impl Iterator<Item = u64>) -> String {
    let mut hasher = Sha256::new();
    for word in words {
        hasher.update(word.to_le_bytes());
    }
    hex(&hasher.finalize())
}

//! The assessment of a node, which all displays show first: its status, the fastest growing mode, the window its margin
//! refers to, and one sentence. Page, terminal, log, events and reports take it from here.

use std::fmt::Write;

use serde::Serialize;

use super::watch::{UnstableMode, fastest_modes};
use crate::bus::lifecycle::State;
use crate::msgs::{OperatingPoint, Prediction, level, listed};
use crate::physics::{Ends, OperatingPoint as Point, StabilityMap};
use crate::session::conditions;
use crate::text::number::significant;

listed! {
    /// The status of a node.
    #[derive(Serialize)]
    #[serde(rename_all = "snake_case")]
    pub enum Status {
        /// No input has been received yet.
        Waiting,
        Ok,
        Warn,
        Squeal,
        Fault,
        /// Inputs were received and have stopped.
        NoData,
        /// A managed node that is not active: it receives nothing.
        Inactive,
    }
}

/// Whether inputs arrive.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Inputs {
    received: bool,
    silent: bool,
}

impl Inputs {
    /// Takes note of an input.
    pub fn came(&mut self) {
        *self = Self { received: true, silent: false };
    }

    /// Takes note of a silence.
    pub fn silence(&mut self) {
        self.silent = true;
    }

    /// Takes note of a prediction. Unless a silence was noted, it implies an input, even if that was not seen.
    pub fn predicted(&mut self) {
        self.received |= !self.silent;
    }
}

impl Status {
    /// The status of a node in `state` for the latest prediction's `level`; `None` before the first prediction.
    pub fn new(state: State, level: Option<u8>, inputs: Inputs) -> Self {
        match (state, level, inputs) {
            (State::Unconfigured | State::Inactive | State::Finalized, _, _) => Self::Inactive,
            (State::Active, None, _) | (State::Active, _, Inputs { received: false, silent: true }) => Self::Waiting,
            (State::Active, _, Inputs { received: true, silent: true }) => Self::NoData,
            (State::Active, Some(level::OK), _) => Self::Ok,
            (State::Active, Some(level::WARN), _) => Self::Warn,
            (State::Active, Some(level::SQUEAL), _) => Self::Squeal,
            (State::Active, Some(_), _) => Self::Fault,
        }
    }

    /// The status as displays show it.
    pub fn name(self) -> &'static str {
        match self {
            Self::Waiting => "WAITING",
            Self::Ok => "OK",
            Self::Warn => "WARN",
            Self::Squeal => "SQUEAL",
            Self::Fault => "FAULT",
            Self::NoData => "NO DATA",
            Self::Inactive => "INACTIVE",
        }
    }

    /// The level of messages with this status; `None` without data.
    pub fn level(self) -> Option<u8> {
        match self {
            Self::Waiting | Self::NoData | Self::Inactive => None,
            Self::Ok => Some(level::OK),
            Self::Warn => Some(level::WARN),
            Self::Squeal => Some(level::SQUEAL),
            Self::Fault => Some(level::FAULT),
        }
    }

    /// Whether the stability of the rig is known.
    pub fn is_known(self) -> bool {
        match self {
            Self::Ok | Self::Warn | Self::Squeal => true,
            Self::Waiting | Self::Fault | Self::NoData | Self::Inactive => false,
        }
    }
}

/// The end of a window of instability that the margin refers to.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct NextSqueal {
    /// The two modes that merge, or the mode that becomes unstable; empty for a static divergence.
    pub ids: Vec<u32>,
    /// Frequency at the end, Hz; 0 for a static divergence.
    pub frequency_hz: f64,
    /// Friction coefficient of the end.
    pub mu: f64,
    /// The published margin: the distance to this end, negative inside the window.
    pub margin: f64,
    /// Error bound of `mu` and `margin`; NaN if unknown.
    pub error: f64,
    /// Whether the friction coefficient is inside the window.
    pub inside: bool,
}

impl NextSqueal {
    /// The end that the margin of `prediction` refers to. The prediction was made at `point` while `map` and `ends`
    /// were in force.
    pub fn new(prediction: &Prediction, point: &Point, map: &StabilityMap, ends: &Ends) -> Option<Self> {
        let margin = Some(prediction.friction_margin).filter(|margin| margin.is_finite())?;
        let next = map.next_window(ends, point)?;
        Some(Self {
            ids: next.window.mode_ids.clone(),
            frequency_hz: next.frequency_hz,
            mu: next.end.mu,
            margin,
            error: prediction.friction_margin_error,
            inside: next.end.inside,
        })
    }

    /// The modes and their frequency, as text.
    pub fn modes(&self) -> String {
        let ids: Vec<String> = self.ids.iter().map(u32::to_string).collect();
        match ids.as_slice() {
            [] => "static divergence".to_owned(),
            [one] => format!("mode {one} at {} Hz", significant(self.frequency_hz, 5)),
            several => format!("modes {} at {} Hz", several.join(" and "), significant(self.frequency_hz, 5)),
        }
    }

    /// The friction coefficient of the end and the distance to it, as text.
    pub fn place(&self) -> String {
        let what = if self.inside { "ends at" } else { "at" };
        format!("{what} friction coefficient {:.4}, {:.4} away", self.mu, self.margin.abs())
    }
}

/// The assessment of a node, which all displays show first.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Assessment {
    pub status: Status,
    /// One sentence for people, without values that become outdated.
    pub message: String,
    /// The fastest growing mode; `None` if no mode grows.
    pub fastest: Option<UnstableMode>,
    /// `None` where no margin is known.
    pub next: Option<NextSqueal>,
}

impl Assessment {
    /// The assessment before the first input.
    pub fn waiting() -> Self {
        let message = "no input was received yet".to_owned();
        Self { status: Status::Waiting, message, fastest: None, next: None }
    }

    /// The assessment of a managed node that is not active.
    pub fn inactive(state: State) -> Self {
        Self { status: Status::Inactive, message: state.sentence().to_owned(), fastest: None, next: None }
    }

    /// The assessment of `prediction`, made for `input` while `windows` were in force.
    pub fn new(
        status: Status,
        prediction: &Prediction,
        input: Option<&OperatingPoint>,
        windows: Option<(&StabilityMap, &Ends)>,
    ) -> Self {
        let [fastest, ..] = fastest_modes(prediction);
        let input = input.filter(|input| input.seq == prediction.input_seq);
        let next = input.zip(windows).and_then(|(input, (map, ends))| {
            NextSqueal::new(prediction, &conditions(input), map, ends).filter(|_| status.is_known())
        });
        let fastest = fastest.filter(|_| status.is_known());
        let message = match status {
            Status::Waiting => return Self::waiting(),
            Status::Inactive => return Self::inactive(State::Inactive),
            Status::NoData => "inputs have stopped".to_owned(),
            Status::Fault => prediction.reason.clone(),
            Status::Squeal => growing(fastest, prediction.unstable_modes),
            Status::Ok | Status::Warn if fastest.is_some() => {
                format!("{}, too slowly to squeal", growing(fastest, prediction.unstable_modes))
            }
            Status::Warn => match &next {
                Some(next) => format!("squeal is near: {} {}", next.modes(), next.place()),
                None => prediction.reason.clone(),
            },
            Status::Ok => "no mode grows".to_owned(),
        };
        Self { status, message, fastest, next }
    }
}

impl Assessment {
    /// The same assessment, of a rig whose temperature is stale.
    pub fn with_stale_temperature(mut self) -> Self {
        if self.status.is_known() {
            self.message += "; the temperature is stale";
        }
        self
    }
}

/// A sentence about what grows: `unstable` counts modes and static roots.
fn growing(fastest: Option<UnstableMode>, unstable: u32) -> String {
    let Some(mode) = fastest else { return "static divergence: a root that does not oscillate grows".to_owned() };
    let (hz, growth) = (significant(mode.frequency_hz, 5), significant(mode.growth_rate_per_s, 3));
    let mut text = format!("mode {} at {hz} Hz grows by {growth} 1/s", mode.id);
    if unstable > 1 {
        let _ = write!(text, ", the fastest of {unstable}"); // writing to a String cannot fail
    }
    text
}

/// Where a node expects its inputs, and how to simulate them.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct InputSources {
    /// The topics and services that it listens to, each with its bus in parentheses.
    pub places: Vec<String>,
    /// The command that publishes simulated operating points there.
    pub start: Option<String>,
}

impl InputSources {
    /// A sentence for a user whose node waits for the first input.
    pub fn sentence(&self) -> String {
        let mut text = match self.places.as_slice() {
            [] => "it listens to no bus".to_owned(),
            places => format!("it listens to {}", places.join(" and ")),
        };
        if let Some(start) = &self.start {
            text += &format!("; without a rig, start: {start}");
        }
        text
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::msgs::Mode;
    use crate::physics::Solver;
    use crate::rig::Rig;
    use crate::session::map_options;

    fn inputs(received: bool, silent: bool) -> Inputs {
        Inputs { received, silent }
    }

    #[test]
    fn silence_is_not_a_fault_and_each_level_has_its_own_status() {
        let received = inputs(true, false);
        let of = |level| Status::new(State::Active, Some(level), received);
        let levels = [level::OK, level::WARN, level::SQUEAL, level::FAULT];
        assert_eq!(levels.map(of), [Status::Ok, Status::Warn, Status::Squeal, Status::Fault]);
        assert_eq!(Status::new(State::Active, None, Inputs::default()), Status::Waiting);
        assert_eq!(Status::new(State::Active, None, received), Status::Waiting, "received, not predicted yet");
        assert_eq!(Status::new(State::Active, Some(level::FAULT), inputs(false, true)), Status::Waiting);
        assert_eq!(Status::new(State::Active, Some(level::FAULT), inputs(true, true)), Status::NoData);
    }

    #[test]
    fn inputs_stop_and_come_back() {
        let mut inputs = Inputs::default();
        inputs.silence();
        inputs.predicted();
        assert_eq!(Status::new(State::Active, Some(level::FAULT), inputs), Status::Waiting, "the silence at the start");
        inputs.came();
        inputs.predicted();
        assert_eq!(Status::new(State::Active, Some(level::OK), inputs), Status::Ok);
        inputs.silence();
        assert_eq!(Status::new(State::Active, Some(level::FAULT), inputs), Status::NoData);
        let mut cut_off = Inputs::default();
        cut_off.predicted();
        assert_eq!(
            Status::new(State::Active, Some(level::FAULT), cut_off),
            Status::Fault,
            "a fault whose input was not recorded"
        );
    }

    fn squeal() -> Prediction {
        let mode =
            |id, frequency_hz, growth_rate_per_s| Mode { id, frequency_hz, growth_rate_per_s, ..Mode::default() };
        Prediction {
            level: level::SQUEAL,
            unstable_modes: 2,
            friction_margin: -0.1,
            modes: vec![mode(1, 727.712647, 20.0), mode(15, 3114.6, 636.0)],
            reason: "mode 1 at 727.712647 Hz: damping ratio -0.004 below -0.0005".to_owned(),
            ..Prediction::default()
        }
    }

    #[test]
    fn the_banner_names_the_fastest_growing_mode_for_every_reason() {
        let said = Assessment::new(Status::Squeal, &squeal(), None, None);
        assert_eq!(said.fastest.map(|mode| mode.id), Some(15));
        assert_eq!(said.message, "mode 15 at 3114.6 Hz grows by 636 1/s, the fastest of 2");
        let divergence = Prediction { modes: vec![], unstable_modes: 1, ..squeal() };
        let said = Assessment::new(Status::Squeal, &divergence, None, None);
        assert!(said.fastest.is_none() && said.message.starts_with("static divergence"), "{}", said.message);
    }

    #[test]
    fn without_data_nothing_is_asserted() {
        for status in [Status::Waiting, Status::Fault, Status::NoData] {
            let said = Assessment::new(status, &squeal(), None, None);
            assert_eq!((said.fastest, said.next), (None, None), "{status:?}");
            assert!(!said.message.contains("grows"), "{status:?}: {}", said.message);
        }
    }

    /// The window shown is the one the margin refers to: both come from the same map.
    #[test]
    fn the_window_named_is_the_one_the_margin_is_measured_to() {
        let rig = Rig::load("nine-dof-case-2").expect("embedded");
        let mut solver = Solver::new(rig.model.dimension());
        let map = StabilityMap::build(&rig.model, &mut solver, &rig.reference, &map_options(&rig)).expect("a map");
        let at = |mu: f64| {
            let point = rig.reference.with_friction(mu);
            let margin = map.ends.nearest(&point).expect("it has windows").margin;
            let prediction = Prediction { friction_margin: margin, ..Prediction::default() };
            NextSqueal::new(&prediction, &point, &map, &map.ends).expect("a next one")
        };
        let [first, second] = &map.windows[..] else { panic!("{:?}", map.windows) };
        let (middle, above) = (at(0.5 * (first.mu_from + 1.0)), at(second.mu_from + 1e-3));
        let below = at(first.mu_from - 0.03);
        assert!((below.mu - first.mu_from).abs() < 1e-12 && (below.margin - 0.03).abs() < 1e-12 && !below.inside);
        assert_eq!((&below.ids, below.frequency_hz), (&first.mode_ids, first.frequency_hz));
        assert!(middle.inside && middle.margin < 0.0, "{middle:?}");
        assert!(above.inside, "{above:?}");
        for next in [&below, &middle, &above] {
            let ends = map.windows.iter().flat_map(|window| [Some(window.mu_from), window.mu_to]).flatten();
            assert!(ends.map(|end| (end - next.mu).abs()).fold(1.0, f64::min) < 1e-12, "an end of a window: {next:?}");
        }
    }

    #[test]
    fn waiting_names_topic_domain_and_command_to_start() {
        let sources = InputSources {
            places: ["/rig/operating_point (ROS 2, domain 7)", "rig/operating_point (shared memory)"]
                .map(str::to_owned)
                .into(),
            start: Some("squealcast simulate --domain 7".to_owned()),
        };
        assert_eq!(
            sources.sentence(),
            "it listens to /rig/operating_point (ROS 2, domain 7) and rig/operating_point (shared memory); without a \
             rig, start: squealcast simulate --domain 7"
        );
        assert_eq!(InputSources::default().sentence(), "it listens to no bus");
    }
}

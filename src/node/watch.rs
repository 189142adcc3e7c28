//! The latest state of a node for displays and terminals. The node never waits for them longer than a copy takes.

use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use serde::Serialize;

use super::sound_view::SoundView;
use super::status::{Assessment, Inputs, Status};
use crate::bus::lifecycle::State;
use crate::msgs::{DiagnosticArray, Heard, OperatingPoint, Prediction, Vibration, heard_state, level};
use crate::physics::{Ends, NextWindow, StabilityMap};
use crate::rig::Rig;
use crate::session::settings::Settings;
use crate::session::{Counters, conditions};
use crate::system::clock;

/// The state of a node as displays show it.
#[derive(Clone, Debug, Default)]
pub struct Snapshot {
    /// The input of [`Snapshot::prediction`].
    pub input: Option<OperatingPoint>,
    pub prediction: Option<Prediction>,
    /// When the last input was received.
    pub received: Option<Instant>,
    /// Whether inputs arrive.
    pub inputs: Inputs,
    /// The lifecycle state of the node.
    pub state: State,
    pub map: Option<Arc<StabilityMap>>,
    /// Window ends of the map at a load and speed other than the map's own.
    pub ends: Option<Arc<Ends>>,
    /// The settings in force; `None` before the node started.
    pub settings: Option<Settings>,
    /// The latest diagnostics, and their number so far. The node's thread makes them, one a second, so it hangs if they
    /// stop.
    pub diagnostics: Option<Arc<DiagnosticArray>>,
    pub reports: u64,
    /// The rig at its present temperature; `None` while that is the reference.
    pub rig: Option<Arc<Rig>>,
    /// The latest temperature of the contact.
    pub temperature: Option<TemperatureSeen>,
    pub counters: Counters,
    pub passed_over: u64,
    /// Number of restarts of the ROS 2 side.
    pub bus_restarts: u64,
    /// Number of squeals found in received samples.
    pub squeals_in_sound: u64,
    /// Why some messages are not recorded.
    pub recording_problem: Option<String>,
}

/// A temperature of the contact, as displays show it.
#[derive(Clone, Copy, Debug)]
pub struct TemperatureSeen {
    pub celsius: f64,
    pub received: Instant,
    /// Age from which on it is stale.
    pub timeout: Duration,
}

impl TemperatureSeen {
    /// Whether it is too old.
    pub fn is_stale(&self) -> bool {
        self.received.elapsed() > self.timeout
    }
}

impl Snapshot {
    /// Status, message, fastest mode and next window of this state.
    pub fn assessment(&self) -> Assessment {
        if self.state != State::Active {
            return Assessment::inactive(self.state);
        }
        let Some(prediction) = &self.prediction else { return Assessment::waiting() };
        let status = Status::new(self.state, Some(prediction.level), self.inputs);
        let map = self.map.as_deref();
        let windows = map.map(|map| (map, self.ends.as_deref().unwrap_or(&map.ends)));
        let assessment = Assessment::new(status, prediction, self.input.as_ref(), windows);
        let stale = self.temperature.is_some_and(|temperature| temperature.is_stale());
        if stale { assessment.with_stale_temperature() } else { assessment }
    }

    /// The window whose end the margin of the prediction refers to; `None` without a margin.
    pub fn next_window(&self) -> Option<NextWindow<'_>> {
        let prediction = self.prediction.as_ref().filter(|prediction| !prediction.friction_margin.is_nan())?;
        let input = self.input.as_ref().filter(|input| input.seq == prediction.input_seq)?;
        let map = self.map.as_deref()?;
        map.next_window(self.ends.as_deref().unwrap_or(&map.ends), &conditions(input))
    }
}

/// Number of unstable modes kept in a [`Sample`].
pub const SAMPLE_MODES: usize = 4;
/// Capacity for samples that the follower has not taken yet. Samples beyond it are lost to the follower only.
const MOST_SAMPLES: usize = 1 << 16;

/// The outcome of one input, compact enough to keep many.
#[derive(Clone, Debug, PartialEq)]
pub struct Sample {
    /// Time of the prediction, ns since the epoch.
    pub time_ns: i64,
    /// Stamp of the prediction, ns since the epoch.
    pub stamp_ns: i64,
    pub input_seq: u64,
    /// The operating point; NaN where unknown.
    pub normal_load_n: f64,
    pub disc_speed_rad_s: f64,
    pub friction_coefficient: f64,
    pub status: Status,
    pub unstable_modes: u32,
    pub max_growth_rate_per_s: f64,
    pub critical_friction: f64,
    pub friction_margin: f64,
    /// The fastest growing unstable modes, in descending order of growth rate.
    pub unstable: [Option<UnstableMode>; SAMPLE_MODES],
    /// Why there is no prediction; `None` unless the level is FAULT.
    pub fault: Option<Box<str>>,
}

/// An unstable mode.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct UnstableMode {
    pub id: u32,
    pub frequency_hz: f64,
    pub growth_rate_per_s: f64,
}

/// The fastest growing unstable modes of a prediction, in descending order of growth rate.
pub fn fastest_modes(prediction: &Prediction) -> [Option<UnstableMode>; SAMPLE_MODES] {
    let mut unstable = [None; SAMPLE_MODES];
    // Static roots count as unstable too but are not among the modes.
    let kept = SAMPLE_MODES.min(prediction.unstable_modes as usize);
    for mode in prediction.modes.iter().filter(|mode| mode.growth_rate_per_s > 0.0) {
        let mut candidate = Some(UnstableMode {
            id: mode.id,
            frequency_hz: mode.frequency_hz,
            growth_rate_per_s: mode.growth_rate_per_s,
        });
        for place in &mut unstable[..kept] {
            let growth = |mode: &Option<UnstableMode>| mode.map_or(0.0, |mode| mode.growth_rate_per_s);
            if growth(&candidate) > growth(place) {
                std::mem::swap(place, &mut candidate);
            }
        }
    }
    unstable
}

impl Sample {
    /// The sample of a prediction made at `time_ns` for `input`.
    pub fn new(time_ns: i64, input: Option<&OperatingPoint>, prediction: &Prediction, inputs: Inputs) -> Self {
        let value = |of: fn(&OperatingPoint) -> f64| input.map_or(f64::NAN, of);
        Self {
            time_ns,
            stamp_ns: prediction.header.stamp.as_ns(),
            input_seq: prediction.input_seq,
            normal_load_n: value(|input| input.normal_load_n),
            disc_speed_rad_s: value(|input| input.disc_speed_rad_s),
            friction_coefficient: value(|input| input.friction_coefficient),
            status: Status::new(State::Active, Some(prediction.level), inputs),
            unstable_modes: prediction.unstable_modes,
            max_growth_rate_per_s: prediction.max_growth_rate_per_s,
            critical_friction: prediction.critical_friction,
            friction_margin: prediction.friction_margin,
            unstable: fastest_modes(prediction),
            fault: (prediction.level == level::FAULT).then(|| prediction.reason.as_str().into()),
        }
    }
}

/// A measured vibration, compact enough to keep many.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct VibrationSample {
    /// When it was received, ns since the epoch.
    pub time_ns: i64,
    pub frequency_hz: f64,
    pub level_db: f64,
}

impl VibrationSample {
    /// The sample of a vibration received at `time_ns`.
    pub fn new(time_ns: i64, vibration: &Vibration) -> Self {
        Self { time_ns, frequency_hz: vibration.frequency_hz, level_db: vibration.level_db }
    }
}

/// Shared access to the latest state, and to the samples since a follower began to take them.
#[derive(Clone, Default)]
pub struct Watch(Arc<Mutex<Watched>>);

#[derive(Default)]
struct Watched {
    snapshot: Snapshot,
    /// The latest input; it may not be predicted yet.
    input: Option<OperatingPoint>,
    /// Whether that input came after the latest prediction.
    is_new: bool,
    /// `None` without a follower.
    samples: Option<Vec<Sample>>,
    /// The measured vibrations for the same follower.
    vibrations: Vec<VibrationSample>,
    /// The temperatures for the same follower, each with the time of reception, ns since the epoch.
    temperatures: Vec<(i64, f64)>,
    /// The squeals found in samples, for the same follower.
    heard: Vec<Heard>,
    lost: u64,
    sound: Arc<SoundView>,
    temperature_timeout: Duration,
}

impl Watch {
    /// A copy of the latest state.
    pub fn snapshot(&self) -> Snapshot {
        self.with(|watched| watched.snapshot.clone())
    }

    /// Replaces the content of `samples` by the samples since the last call, oldest first. Returns how many were lost
    /// so far because they were not taken in time. The first call starts the collection.
    pub fn take_samples(&self, samples: &mut Vec<Sample>) -> u64 {
        samples.clear();
        self.with(|watched| {
            std::mem::swap(watched.samples.get_or_insert_with(Vec::new), samples);
            watched.lost
        })
    }

    /// As [`Watch::take_samples`], for measured vibrations. The first call of [`Watch::take_samples`] starts their
    /// collection too.
    pub fn take_vibrations(&self, vibrations: &mut Vec<VibrationSample>) {
        vibrations.clear();
        self.with(|watched| std::mem::swap(&mut watched.vibrations, vibrations));
    }

    /// As [`Watch::take_samples`], for temperatures: time of reception, ns since the epoch, and °C.
    pub fn take_temperatures(&self, temperatures: &mut Vec<(i64, f64)>) {
        temperatures.clear();
        self.with(|watched| std::mem::swap(&mut watched.temperatures, temperatures));
    }

    /// As [`Watch::take_samples`], for squeals found in samples.
    pub fn take_heard(&self, heard: &mut Vec<Heard>) {
        heard.clear();
        self.with(|watched| std::mem::swap(&mut watched.heard, heard));
    }

    /// Spectrograms of the received samples.
    pub fn sound(&self) -> Arc<SoundView> {
        self.with(|watched| watched.sound.clone())
    }

    fn with<T>(&self, action: impl FnOnce(&mut Watched) -> T) -> T {
        action(&mut self.0.lock().unwrap_or_else(PoisonError::into_inner))
    }

    /// Takes note of an input.
    pub fn input(&self, input: &OperatingPoint) {
        self.with(|watched| {
            watched.snapshot.received = Some(Instant::now());
            watched.input = Some(input.clone());
            watched.is_new = true;
        });
    }

    /// Takes note of the state of the node. What was predicted before is no longer shown.
    pub fn state(&self, state: State) {
        self.with(|Watched { snapshot, input, is_new, .. }| {
            snapshot.state = state;
            (snapshot.input, snapshot.prediction, snapshot.received) = (None, None, None);
            (snapshot.inputs, *input, *is_new) = (Inputs::default(), None, false);
        });
    }

    /// Takes note of a silence; its prediction follows.
    pub fn silence(&self) {
        self.with(|watched| watched.snapshot.inputs.silence());
    }

    /// Takes note of a prediction.
    pub fn prediction(&self, prediction: &Prediction) {
        self.with(|watched| {
            let Watched { snapshot, input, is_new, samples, lost, .. } = watched;
            match std::mem::take(is_new) {
                true => snapshot.inputs.came(),
                false => snapshot.inputs.predicted(),
            }
            if let Some(samples) = samples {
                if samples.len() < MOST_SAMPLES {
                    samples.push(Sample::new(clock::now_ns(), input.as_ref(), prediction, snapshot.inputs));
                } else {
                    *lost += 1;
                }
            }
            snapshot.input.clone_from(input);
            // Reuses the memory of the previous prediction.
            snapshot.prediction.get_or_insert_default().clone_from(prediction);
        });
    }

    pub(super) fn vibration(&self, time_ns: i64, vibration: &Vibration) {
        self.with(|watched| {
            if watched.samples.is_some() && watched.vibrations.len() < MOST_SAMPLES {
                watched.vibrations.push(VibrationSample::new(time_ns, vibration));
            }
        });
    }

    pub(super) fn heard(&self, heard: &Heard) {
        self.with(|watched| {
            watched.snapshot.squeals_in_sound += u64::from(heard.state == heard_state::BEGAN);
            if watched.samples.is_some() && watched.heard.len() < MOST_SAMPLES {
                watched.heard.push(heard.clone());
            }
        });
    }

    pub(super) fn map(&self, map: &Arc<StabilityMap>) {
        self.with(|watched| (watched.snapshot.map, watched.snapshot.ends) = (Some(map.clone()), None));
    }

    pub(super) fn ends(&self, ends: &Arc<Ends>) {
        self.with(|watched| watched.snapshot.ends = Some(ends.clone()));
    }

    pub(super) fn rig(&self, rig: &Arc<Rig>) {
        self.with(|Watched { snapshot, .. }| {
            (snapshot.rig, snapshot.map, snapshot.ends) = (Some(rig.clone()), None, None);
        });
    }

    pub(super) fn temperature(&self, time_ns: i64, celsius: f64) {
        self.with(|Watched { snapshot, samples, temperatures, temperature_timeout: timeout, .. }| {
            let seen = TemperatureSeen { celsius, received: Instant::now(), timeout: *timeout };
            snapshot.temperature = Some(seen);
            if samples.is_some() && temperatures.len() < MOST_SAMPLES {
                temperatures.push((time_ns, celsius));
            }
        });
    }

    /// Takes note of the settings in force.
    pub(super) fn settings(&self, settings: &Settings) {
        let timeout = Duration::try_from_secs_f64(settings.temperature_timeout_s).unwrap_or(Duration::MAX);
        self.with(|Watched { snapshot, temperature_timeout, .. }| {
            snapshot.settings = Some(*settings);
            *temperature_timeout = timeout;
            if let Some(temperature) = &mut snapshot.temperature {
                temperature.timeout = timeout;
            }
        });
    }

    pub(super) fn recording_problem(&self, problem: Option<String>) {
        self.with(|watched| watched.snapshot.recording_problem = problem);
    }

    /// Takes note of the diagnostics, and of counters they contain.
    pub(super) fn diagnostics(
        &self,
        diagnostics: &DiagnosticArray,
        counters: Counters,
        passed_over: u64,
        bus_restarts: u64,
    ) {
        let diagnostics = Some(Arc::new(diagnostics.clone()));
        self.with(|Watched { snapshot, .. }| {
            (snapshot.counters, snapshot.passed_over, snapshot.bus_restarts) = (counters, passed_over, bus_restarts);
            snapshot.diagnostics = diagnostics;
            snapshot.reports += 1;
        });
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::msgs::Mode;

    fn prediction(growth: &[f64], unstable_modes: u32) -> Prediction {
        let mode =
            |(id, &growth_rate_per_s): (usize, &f64)| Mode { id: id as u32, growth_rate_per_s, ..Default::default() };
        Prediction { unstable_modes, modes: growth.iter().enumerate().map(mode).collect(), ..Default::default() }
    }

    #[test]
    fn samples_keep_the_fastest_growing_modes_in_order() {
        let sample = Sample::new(0, None, &prediction(&[0.5, -1.0, 2.0, 0.1, 3.0, 0.7], 5), Inputs::default());
        assert_eq!(sample.unstable.map(|mode| mode.map(|mode| mode.id)), [Some(4), Some(2), Some(5), Some(0)]);
        let sample = Sample::new(0, None, &prediction(&[1e-12, 2.0], 1), Inputs::default());
        assert_eq!(
            sample.unstable.map(|mode| mode.map(|mode| mode.id)),
            [Some(1), None, None, None],
            "one is unstable"
        );
        assert!(sample.normal_load_n.is_nan());
        assert_eq!(sample.fault, None);
        let reason = "normal_load_n is -5, expected 0 to 1e6".to_owned();
        let faulty = Prediction { level: level::FAULT, reason, ..Prediction::default() };
        let sample = Sample::new(0, None, &faulty, Inputs::default());
        assert_eq!(sample.fault.as_deref(), Some("normal_load_n is -5, expected 0 to 1e6"));
    }

    /// A node without inputs is WAITING before the first and NO DATA after the last, never FAULT.
    #[test]
    fn the_status_follows_inputs_and_silence() {
        let watch = Watch::default();
        let status = || watch.snapshot().assessment().status;
        let faulty = Prediction { level: level::FAULT, ..Prediction::default() };
        assert_eq!(status(), Status::Waiting);
        watch.silence();
        watch.prediction(&faulty);
        assert_eq!(status(), Status::Waiting);
        watch.input(&OperatingPoint::default());
        for (level, expected) in [(level::OK, Status::Ok), (level::WARN, Status::Warn), (level::SQUEAL, Status::Squeal)]
        {
            watch.prediction(&Prediction { level, ..Prediction::default() });
            assert_eq!(status(), expected);
        }
        watch.prediction(&faulty);
        assert_eq!(status(), Status::Fault);
        watch.silence();
        watch.prediction(&faulty);
        assert_eq!(status(), Status::NoData);
    }

    #[test]
    fn samples_are_kept_only_for_a_follower_and_never_more_than_may_wait() {
        let watch = Watch::default();
        let mut samples = vec![];
        watch.prediction(&prediction(&[], 0));
        assert_eq!((watch.take_samples(&mut samples), samples.len()), (0, 0), "without a follower");
        for _ in 0..MOST_SAMPLES + 3 {
            watch.prediction(&prediction(&[], 0));
        }
        assert_eq!((watch.take_samples(&mut samples), samples.len()), (3, MOST_SAMPLES));
        assert_eq!((watch.take_samples(&mut samples), samples.len()), (3, 0));
    }
}

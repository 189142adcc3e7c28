//! The node's counters and prediction times, reported as diagnostics.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use super::Outputs;
use super::detection::SoundReport;
use super::status::{Inputs, Status};
use crate::bus::lifecycle::State as NodeState;
use crate::bus::{Bus, Counts, Report};
use crate::msgs::{DiagnosticArray, DiagnosticStatus, Header, KeyValue};
use crate::physics::Chart;
use crate::recording::recorder::State;
use crate::rig::Rig;
use crate::session::Counters;

/// Levels of `diagnostic_msgs/DiagnosticStatus`.
pub(super) mod diagnostic_level {
    pub const OK: u8 = 0;
    pub const WARN: u8 = 1;
    pub const ERROR: u8 = 2;
}

/// Counts since the start, and prediction times since the last report.
#[derive(Default)]
pub struct Statistics {
    /// Inputs by the bus that delivered them first, as [`Bus::ALL`] lists them.
    received: [u64; Bus::ALL.len()],
    /// Inputs and vibrations lost because the queue was full.
    lost: Arc<AtomicU64>,
    /// How often buses were started again, at the last report.
    pub restarts: u64,
    pub duplicates: u64,
    pub passed_over: u64,
    pub maps: u64,
    pub ends: u64,
    pub sensitivities: u64,
    pub sensitivity_failure: Option<String>,
    chart: Option<(usize, usize)>,
    pub map_failure: Option<String>,
    pub chart_failure: Option<String>,
    /// Why the rig could not be built for the latest temperature.
    pub temperature_failure: Option<String>,
    /// The latest temperature, °C, and when it was received.
    temperature: Option<(f64, Instant)>,
    /// Age from which on it is stale, s.
    pub temperature_timeout_s: f64,
    rigs: u64,
    pub refused: Option<String>,
    inputs: Inputs,
    level: Option<u8>,
    state: NodeState,
    /// Messages that came while the node was not active.
    pub unheard: u64,
    /// The losses counted at the last report.
    lost_before: Lost,
    sound_before: SoundReport,
    times: Vec<Duration>,
}

/// Losses since the start.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
struct Lost {
    passed_over: u64,
    /// Inputs lost because the channel was full.
    overflowed: u64,
    /// Messages that could not be published, and the latest reason.
    unpublished: u64,
    why_unpublished: Option<String>,
    /// Counts of the receiving side of each bus.
    buses: Vec<(&'static str, Counts)>,
}

impl Lost {
    fn new(statistics: &Statistics, outputs: &mut Outputs, reports: &[(Bus, Report)]) -> Self {
        Self {
            passed_over: statistics.passed_over,
            overflowed: statistics.lost.load(Ordering::Relaxed),
            unpublished: outputs.failures,
            why_unpublished: outputs.last_failure.take(),
            buses: reports.iter().filter_map(|(bus, report)| Some((bus.name(), report.counts?))).collect(),
        }
    }

    /// One warning for each kind of loss since `before`.
    fn since(&self, before: &Self) -> Vec<String> {
        let mut warnings = vec![];
        let mut warn = |count: u64, what: &str| {
            if count > 0 {
                warnings.push(format!("{what} since the last report: {count}"));
            }
        };
        warn(self.passed_over - before.passed_over, "inputs passed over");
        warn(self.overflowed - before.overflowed, "inputs lost in a full queue");
        for (bus, counts) in &self.buses {
            let of_bus = before.buses.iter().find(|(other, _)| other == bus);
            let before = of_bus.map(|(_, counts)| *counts).unwrap_or_default();
            // The counts of a bus begin at 0 after a restart.
            warn(counts.missed.saturating_sub(before.missed), &format!("inputs missed on {bus}"));
            warn(counts.malformed.saturating_sub(before.malformed), &format!("malformed inputs on {bus}"));
            warn(counts.failures.saturating_sub(before.failures), &format!("failures of {bus}"));
        }
        let unpublished = self.unpublished - before.unpublished;
        if unpublished > 0 {
            let why = self.why_unpublished.as_deref().unwrap_or("no reason given");
            warnings.push(format!("messages not published since the last report: {unpublished}, {why}"));
        }
        warnings
    }
}

impl Statistics {
    /// Statistics of a node whose queue counts what it loses in `lost`.
    pub fn new(lost: Arc<AtomicU64>) -> Self {
        Self { lost, ..Self::default() }
    }

    /// Takes note of an input received over `bus`.
    pub fn received(&mut self, bus: Bus) {
        self.inputs.came();
        self.received[bus as usize] += 1;
    }

    /// Takes note of a silence.
    pub fn silence(&mut self) {
        self.inputs.silence();
    }

    /// Takes note of the state of the node. What it received before no longer counts.
    pub fn state(&mut self, state: NodeState) {
        self.state = state;
        (self.inputs, self.level) = (Inputs::default(), None);
    }

    /// Whether the rig in force is charted.
    pub fn is_charted(&self) -> bool {
        self.chart.is_some()
    }

    pub fn charted(&mut self, chart: &Chart) {
        self.chart = Some((chart.leaf_count(), chart.size_bytes()));
    }

    /// Takes note of a temperature received now.
    pub fn temperature(&mut self, celsius: f64) {
        self.temperature = Some((celsius, Instant::now()));
    }

    /// Takes note that the rig was replaced by the same rig at another temperature; its chart goes with it.
    pub fn rig_replaced(&mut self) {
        self.rigs += 1;
        self.chart = None;
    }

    /// The values of a rig that follows the temperature, and a warning if the latest temperature is stale.
    fn temperature_values(&self, rig: &Rig) -> (Vec<KeyValue>, Option<String>) {
        let Some(of_rig) = rig.temperature_c() else { return (vec![], None) };
        let mut values = vec![pair("temperature_of_rig_c", of_rig), pair("rigs_by_temperature", self.rigs)];
        let Some((celsius, received)) = self.temperature else { return (values, None) };
        let age_s = received.elapsed().as_secs_f64();
        values.extend([pair("temperature_c", celsius), pair("temperature_age_s", format!("{age_s:.1}"))]);
        let limit_s = self.temperature_timeout_s;
        let stale = (age_s > limit_s)
            .then(|| format!("temperature stale: the last one, {celsius} °C, is {age_s:.0} s old, limit {limit_s} s"));
        (values, stale)
    }

    /// Takes note of the level of the latest prediction.
    pub fn published(&mut self, level: u8) {
        self.level = Some(level);
    }

    pub fn predicted(&mut self, took: Duration) {
        self.times.push(took);
    }

    /// The diagnostics message for the time since the last report.
    #[expect(clippy::too_many_arguments, reason = "the parts of the node that are reported")]
    pub fn report(
        &mut self,
        header: Header,
        rig: &Rig,
        counters: Counters,
        queued: usize,
        map_pending: bool,
        sound: Option<SoundReport>,
        outputs: &mut Outputs,
    ) -> DiagnosticArray {
        let mut reports = outputs.reports();
        let lost = Lost::new(self, outputs, &reports);
        self.restarts = reports.iter().map(|(_, report)| report.restarts).sum();
        let skipped: u64 = reports.iter().map(|(_, report)| report.encodings_skipped).sum();
        let mut values = self.values(counters, queued, map_pending, skipped, outputs.failures);
        for (bus, counts) in &lost.buses {
            values.push(pair(&format!("{bus}_missed"), counts.missed));
            values.push(pair(&format!("{bus}_malformed"), counts.malformed));
            values.push(pair(&format!("{bus}_failures"), counts.failures));
            values.push(pair(&format!("{bus}_incompatible_peers"), counts.incompatible));
        }
        let (of_temperature, stale) = self.temperature_values(rig);
        values.extend(of_temperature);
        let sound = sound.map(|sound| self.sound_status(rig, sound, &reports, outputs));
        for (_, report) in &mut reports {
            values.extend(report.values.drain(..).map(|(key, value)| pair(key, value)));
        }
        self.times.clear();
        let mut warnings: Vec<String> = vec![];
        warnings.extend(self.map_failure.iter().map(|why| format!("no stability map: {why}")));
        warnings.extend(self.chart_failure.iter().map(|why| format!("no chart: {why}")));
        warnings.extend(self.sensitivity_failure.iter().map(|why| format!("no sensitivities: {why}")));
        let failure = self.temperature_failure.iter();
        warnings.extend(failure.map(|why| format!("the rig does not follow the temperature: {why}")));
        warnings.extend(stale);
        warnings.extend(self.refused.take());
        warnings.extend(reports.into_iter().flat_map(|(_, report)| report.warnings));
        let incompatible = lost.buses.iter().map(|(_, counts)| counts.incompatible).sum::<u64>();
        if incompatible > 0 {
            warnings.push(format!("peers not connected, their quality of service is incompatible: {incompatible}"));
        }
        let rivals = lost.buses.iter().map(|(_, counts)| counts.rivals).sum::<u64>();
        if rivals > 0 {
            warnings.push(format!("other programs publish predictions on the same topic: {rivals}"));
        }
        warnings.extend(lost.since(&self.lost_before));
        self.lost_before = lost;
        let status = Status::new(self.state, self.level, self.inputs);
        let level = if warnings.is_empty() { level_of(status) } else { level_of(status).max(diagnostic_level::WARN) };
        let mut message = status.name().to_owned();
        if status == Status::Inactive {
            message += "; ";
            message += self.state.sentence();
        }
        for warning in &warnings {
            message += "; ";
            message += warning;
        }
        let name = outputs.node_name.as_str();
        let hardware_id = rig.name.clone();
        let predictions =
            DiagnosticStatus { level, name: format!("{name}: predictions"), message, hardware_id, values };
        let status = std::iter::once(predictions).chain(sound).chain(recorder_status(rig, outputs)).collect();
        DiagnosticArray { header, status }
    }

    /// The status of the search for squeal in received samples: every interruption since the last report is a warning.
    fn sound_status(
        &mut self,
        rig: &Rig,
        sound: SoundReport,
        reports: &[(Bus, Report)],
        outputs: &Outputs,
    ) -> DiagnosticStatus {
        let before = std::mem::replace(&mut self.sound_before, sound.clone());
        let mut values = vec![
            pair("blocks_twice", sound.duplicates),
            pair("blocks_refused", sound.refused),
            pair("blocks_lost", sound.lost),
            pair("blocks_not_recorded", sound.unrecorded),
            pair("squeals_not_published", sound.unpublished),
        ];
        for (bus, counts) in reports.iter().filter_map(|(bus, report)| Some((bus.name(), report.waveform_counts?))) {
            values.push(pair(&format!("{bus}_blocks_missed"), counts.missed));
            values.push(pair(&format!("{bus}_blocks_malformed"), counts.malformed));
        }
        for channel in &sound.channels {
            let mut push = |what: &str, value: String| values.push(pair(&format!("{}_{what}", channel.name), value));
            push("sample_rate_hz", channel.sample_rate_hz.to_string());
            push("samples", channel.samples.to_string());
            push("missing", channel.missing.to_string());
            push("repeated", channel.repeated.to_string());
            push("not_finite", channel.not_finite.to_string());
            push("squeals", channel.squeals.to_string());
        }
        let mut message = format!("channels: {}", sound.channels.len());
        let mut level = diagnostic_level::OK;
        let mut warn = |warning: &str| {
            message += "; ";
            message += warning;
            level = diagnostic_level::WARN;
        };
        sound.interruptions.iter().for_each(|interruption| warn(interruption));
        let unnamed = sound.interruption_count - sound.interruptions.len() as u64;
        for (count, what) in [
            (unnamed, "further interruptions"),
            (sound.lost - before.lost, "blocks lost in a full queue"),
            (sound.unrecorded - before.unrecorded, "blocks not recorded, because the disk is too slow,"),
            (sound.unpublished - before.unpublished, "squeals lost in a full queue"),
        ] {
            if count > 0 {
                warn(&format!("{what} since the last report: {count}"));
            }
        }
        if sound.refused > before.refused {
            let why = sound.why_refused.as_deref().unwrap_or("no reason given");
            warn(&format!("blocks refused since the last report: {}, {why}", sound.refused - before.refused));
        }
        let name = format!("{}: sound", outputs.node_name.as_str());
        DiagnosticStatus { level, name, message, hardware_id: rig.name.clone(), values }
    }

    fn values(
        &mut self,
        counters: Counters,
        queued: usize,
        map_pending: bool,
        encodings_skipped: u64,
        publish_failures: u64,
    ) -> Vec<KeyValue> {
        let Counters { solved, charted, reused, faults, zero_terms, decoupled_modes, roots_beyond_band } = counters;
        self.times.sort_unstable();
        let quantile = |q: f64| {
            let index = (q * self.times.len().saturating_sub(1) as f64).round() as usize;
            self.times.get(index).map_or(f64::NAN, |time| time.as_secs_f64() * 1e6)
        };
        let from = |bus: Bus| pair(&format!("inputs_from_{}", bus.name()), self.received[bus as usize]);
        let mut values: Vec<KeyValue> = Bus::ALL.into_iter().map(from).collect();
        values.extend([
            pair("inputs_twice", self.duplicates),
            pair("inputs_passed_over", self.passed_over),
            pair("inputs_lost", self.lost.load(Ordering::Relaxed)),
            pair("inputs_waiting", queued),
            pair("messages_while_not_active", self.unheard),
            pair("predictions_solved", solved),
            pair("predictions_from_chart", charted),
            pair("predictions_reused", reused),
            pair("faults", faults),
            pair("predictions_per_s", self.times.len()),
            pair("prediction_time_median_us", format!("{:.1}", quantile(0.5))),
            pair("prediction_time_p99_us", format!("{:.1}", quantile(0.99))),
            pair("stability_maps", self.maps),
            pair("window_ends", self.ends),
            pair("sensitivities", self.sensitivities),
            pair("stability_map_pending", map_pending),
            // Work avoided. A charted prediction also avoids a dense solve with its vectors.
            pair("skipped_zero_terms", zero_terms),
            pair("skipped_decoupled_modes", decoupled_modes),
            pair("skipped_roots_beyond_band", roots_beyond_band),
            pair("skipped_encodings", encodings_skipped),
            pair("publish_failures", publish_failures),
        ]);
        if let Some((leaves, bytes)) = self.chart {
            values.push(pair("chart_leaves", leaves));
            values.push(pair("chart_bytes", bytes));
        }
        values
    }
}

/// The diagnostic level of a status. Squeal is a warning, since the node itself works. Without usable inputs there is
/// no prediction, which is an error.
fn level_of(status: Status) -> u8 {
    match status {
        // A managed node that waits is as its manager wants it.
        Status::Ok | Status::Inactive => diagnostic_level::OK,
        Status::Waiting | Status::Warn | Status::Squeal => diagnostic_level::WARN,
        Status::Fault | Status::NoData => diagnostic_level::ERROR,
    }
}

fn recorder_status(rig: &Rig, outputs: &Outputs) -> Option<DiagnosticStatus> {
    let recorder = outputs.recorder.as_ref()?.status();
    let (level, message) = match &recorder.state {
        State::Failed(why) => (diagnostic_level::ERROR, format!("not recording: {why}")),
        State::Recording | State::Finished => match recorder.why_dropped() {
            Some(why) => (diagnostic_level::WARN, format!("messages not recorded: {why}")),
            None => (diagnostic_level::OK, "recording".to_owned()),
        },
    };
    Some(DiagnosticStatus {
        level,
        name: format!("{}: recorder", outputs.node_name.as_str()),
        message,
        hardware_id: rig.name.clone(),
        values: vec![
            pair("directory", recorder.directory.display()),
            pair("messages_written", recorder.messages_written),
            pair("bytes_written", recorder.bytes_written),
            pair("messages_waiting", recorder.queued),
            pair("messages_dropped", recorder.dropped()),
        ],
    })
}

fn pair(key: &str, value: impl ToString) -> KeyValue {
    KeyValue { key: key.to_owned(), value: value.to_string() }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::msgs::level;

    struct Reporter {
        statistics: Statistics,
        outputs: Outputs,
        rig: Rig,
    }

    impl Reporter {
        fn new() -> Self {
            let rig = Rig::load("nine-dof-case-2").expect("embedded");
            Self { statistics: Statistics::default(), outputs: Outputs::default(), rig }
        }

        /// Level and message of the next report.
        fn report(&mut self) -> (u8, String) {
            let Self { statistics, outputs, rig } = self;
            let mut array = statistics.report(Header::default(), rig, Counters::default(), 0, false, None, outputs);
            let status = array.status.remove(0);
            (status.level, status.message)
        }
    }

    #[test]
    fn the_diagnostic_level_reflects_no_input_squeal_and_silence() {
        let mut reporter = Reporter::new();
        assert_eq!(reporter.report(), (diagnostic_level::WARN, "WAITING".to_owned()), "nothing is known yet");
        reporter.statistics.silence();
        reporter.statistics.published(level::FAULT);
        assert_eq!(reporter.report(), (diagnostic_level::WARN, "WAITING".to_owned()), "a start is no fault");
        for (level, expected, name) in [
            (level::OK, diagnostic_level::OK, "OK"),
            (level::WARN, diagnostic_level::WARN, "WARN"),
            (level::SQUEAL, diagnostic_level::WARN, "SQUEAL"),
            (level::FAULT, diagnostic_level::ERROR, "FAULT"),
        ] {
            reporter.statistics.received(Bus::Shm);
            reporter.statistics.published(level);
            assert_eq!(reporter.report(), (expected, name.to_owned()));
        }
        reporter.statistics.silence();
        assert_eq!(reporter.report(), (diagnostic_level::ERROR, "NO DATA".to_owned()));
    }

    /// A loss raises the level of the next report only.
    #[test]
    fn losses_and_failures_raise_the_level_once() {
        let mut reporter = Reporter::new();
        reporter.statistics.received(Bus::Ros2);
        reporter.statistics.published(level::OK);
        let quiet = (diagnostic_level::OK, "OK".to_owned());
        assert_eq!(reporter.report(), quiet);
        reporter.statistics.passed_over += 3;
        let warns = |message: &str| (diagnostic_level::WARN, format!("OK; {message}"));
        assert_eq!(reporter.report(), warns("inputs passed over since the last report: 3"));
        assert_eq!(reporter.report(), quiet);
        reporter.statistics.lost.fetch_add(2, Ordering::Relaxed);
        assert_eq!(reporter.report(), warns("inputs lost in a full queue since the last report: 2"));
        assert_eq!(reporter.report(), quiet);
        (reporter.outputs.failures, reporter.outputs.last_failure) = (1, Some("no room".to_owned()));
        assert_eq!(reporter.report(), warns("messages not published since the last report: 1, no room"));
        assert_eq!(reporter.report(), quiet, "an old failure is not reported again");
    }

    #[test]
    fn missed_and_malformed_messages_of_a_bus_are_losses() {
        let lost = |missed, malformed, failures| Lost {
            buses: vec![("ros2", Counts { received: 9, missed, malformed, failures, incompatible: 0, rivals: 0 })],
            ..Lost::default()
        };
        let words = lost(4, 2, 1).since(&lost(1, 1, 0));
        let expected = [("inputs missed on ros2", 3), ("malformed inputs on ros2", 1), ("failures of ros2", 1)];
        assert_eq!(words, expected.map(|(what, count)| format!("{what} since the last report: {count}")));
        assert!(lost(4, 2, 1).since(&lost(4, 2, 1)).is_empty());
        assert_eq!(lost(1, 0, 0).since(&Lost::default()).len(), 1, "before the first report");
    }

    #[test]
    fn prediction_times_are_those_since_the_last_report() {
        let mut reporter = Reporter::new();
        (1..=100).for_each(|us| reporter.statistics.predicted(Duration::from_micros(us)));
        let Reporter { statistics, outputs, rig } = &mut reporter;
        let mut value = |key: &str| {
            let array = statistics.report(Header::default(), rig, Counters::default(), 0, false, None, outputs);
            let found = array.status[0].values.iter().find(|pair| pair.key == key);
            found.map(|pair| pair.value.clone()).expect("there is such a value")
        };
        assert_eq!(value("prediction_time_p99_us"), "99.0");
        assert_eq!(value("prediction_time_median_us"), "NaN", "none since");
    }

    #[test]
    fn the_node_is_named() {
        let mut reporter = Reporter::new();
        let name = |reporter: &mut Reporter| {
            let Reporter { statistics, outputs, rig } = reporter;
            let mut array = statistics.report(Header::default(), rig, Counters::default(), 0, false, None, outputs);
            array.status.remove(0).name
        };
        assert_eq!(name(&mut reporter), "squealcast: predictions");
        reporter.outputs.node_name = super::super::outputs::NodeName::new("/brake1", "left");
        assert_eq!(name(&mut reporter), "brake1/left: predictions");
    }
}

//! How the node does, as diagnostics.

use std::sync::atomic::Ordering;
use std::time::Duration;

use super::Outputs;
use crate::io::heard::Bus;
use crate::io::recorder::State;
use crate::physics::Chart;
use crate::rig::Rig;
use crate::session::Counters;
use crate::wire::{DiagnosticArray, DiagnosticStatus, Header, KeyValue, level};

/// Levels of `diagnostic_msgs/DiagnosticStatus`.
mod diagnostic_level {
    pub const OK: u8 = 0;
    pub const WARN: u8 = 1;
    pub const ERROR: u8 = 2;
}

/// What was counted since the start, and the prediction times since the last report.
#[derive(Default)]
pub struct Statistics {
    heard_shm: u64,
    heard_ros2: u64,
    heard_simulator: u64,
    pub duplicates: u64,
    pub passed_over: u64,
    pub maps: u64,
    pub ends: u64,
    pub sensitivities: u64,
    pub sensitivity_failure: Option<String>,
    chart: Option<(usize, usize)>,
    pub map_failure: Option<String>,
    pub chart_failure: Option<String>,
    /// What had been passed over at the last report.
    passed_over_before: u64,
    pub refused: Option<String>,
    pub level: u8,
    times: Vec<Duration>,
}

impl Statistics {
    pub fn heard(&mut self, bus: Bus) {
        match bus {
            Bus::Shm => self.heard_shm += 1,
            Bus::Ros2 => self.heard_ros2 += 1,
            Bus::Simulator => self.heard_simulator += 1,
        }
    }

    pub fn charted(&mut self, chart: &Chart) {
        self.chart = Some((chart.leaf_count(), chart.size_bytes()));
    }

    pub fn predicted(&mut self, took: Duration) {
        self.times.push(took);
    }

    /// The diagnostics of the time since the last report.
    pub fn report(
        &mut self,
        header: Header,
        rig: &Rig,
        counters: Counters,
        queued: usize,
        map_pending: bool,
        outputs: &mut Outputs,
    ) -> DiagnosticArray {
        self.times.sort_unstable();
        let quantile = |q: f64| {
            let index = (q * self.times.len().saturating_sub(1) as f64).round() as usize;
            self.times.get(index).map_or(f64::NAN, |time| time.as_secs_f64() * 1e6)
        };
        let mut values = vec![
            pair("inputs_from_shm", self.heard_shm),
            pair("inputs_from_ros2", self.heard_ros2),
            pair("inputs_from_simulator", self.heard_simulator),
            pair("inputs_twice", self.duplicates),
            pair("inputs_passed_over", self.passed_over),
            pair("inputs_lost", outputs.lost_inputs.load(Ordering::Relaxed)),
            pair("inputs_waiting", queued),
            pair("predictions_solved", counters.solved),
            pair("predictions_from_chart", counters.charted),
            pair("predictions_reused", counters.reused),
            pair("faults", counters.faults),
            pair("predictions_per_s", self.times.len()),
            pair("prediction_time_median_us", format!("{:.1}", quantile(0.5))),
            pair("prediction_time_p99_us", format!("{:.1}", quantile(0.99))),
            pair("stability_maps", self.maps),
            pair("window_ends", self.ends),
            pair("sensitivities", self.sensitivities),
            pair("stability_map_pending", map_pending),
            // What the situation did not need. A prediction off the chart is a dense solve and its vectors saved.
            pair("skipped_zero_terms", counters.zero_terms),
            pair("skipped_decoupled_modes", counters.decoupled_modes),
            pair("skipped_roots_beyond_band", counters.roots_beyond_band),
            pair("skipped_encodings", outputs.encodings_skipped),
            pair("publish_failures", outputs.failures),
        ];
        if let Some((leaves, bytes)) = self.chart {
            values.push(pair("chart_leaves", leaves));
            values.push(pair("chart_bytes", bytes));
        }
        let ros2 = outputs.ros2_health();
        if let Some((health, _)) = &ros2 {
            values.push(pair("ros2_side_falls", health.falls));
            values.push(pair("ros2_side_process", health.process_id));
            values.push(pair("ros2_refused", health.refused));
        }
        for (bus, counts) in outputs.counts() {
            values.push(pair(&format!("{bus}_missed"), counts.missed));
            values.push(pair(&format!("{bus}_malformed"), counts.malformed));
            values.push(pair(&format!("{bus}_failures"), counts.failures));
            values.push(pair(&format!("{bus}_incompatible_peers"), counts.incompatible));
        }
        self.times.clear();
        let mut warnings: Vec<String> = vec![];
        warnings.extend(self.map_failure.iter().map(|why| format!("no stability map: {why}")));
        warnings.extend(self.chart_failure.iter().map(|why| format!("no chart: {why}")));
        warnings.extend(self.sensitivity_failure.iter().map(|why| format!("no sensitivities: {why}")));
        warnings.extend(self.refused.take());
        warnings.extend(outputs.last_failure.take());
        warnings.extend(ros2.into_iter().flat_map(|(_, wrong)| wrong));
        warnings.extend(outputs.other_nodes());
        let incompatible = outputs.counts().iter().map(|(_, counts)| counts.incompatible).sum::<u64>();
        if incompatible > 0 {
            warnings.push(format!("peers not connected, their quality of service is incompatible: {incompatible}"));
        }
        let passed_over = self.passed_over - self.passed_over_before;
        self.passed_over_before = self.passed_over;
        if passed_over > 0 {
            warnings.push(format!("{passed_over} inputs passed over since the last report"));
        }
        let node_level = match (self.level, warnings.is_empty()) {
            (level::FAULT, _) => diagnostic_level::ERROR,
            (_, false) => diagnostic_level::WARN,
            (_, true) => diagnostic_level::OK,
        };
        let message = if warnings.is_empty() { level::name(self.level).to_owned() } else { warnings.join("; ") };
        let mut status = vec![DiagnosticStatus {
            level: node_level,
            name: "squealcast: predictions".to_owned(),
            message,
            hardware_id: rig.name.clone(),
            values,
        }];
        status.extend(recorder_status(rig, outputs));
        DiagnosticArray { header, status }
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
        name: "squealcast: recorder".to_owned(),
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

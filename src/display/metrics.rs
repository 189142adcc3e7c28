//! The state and the counters of a node as Prometheus text, version 0.0.4 (`/metrics` on the port of the page).
//!
//! What a node counts is in its diagnostics, and what it predicts in its assessment: [`KEYS`] says what each value of the
//! diagnostics is as a metric. A value that it does not list is exported without a type.

use std::collections::BTreeMap;
use std::fmt::Write;

use super::server::About;
use crate::bus::Bus;
use crate::msgs::DiagnosticArray;
use crate::node::Snapshot;
use crate::node::status::Status;
use crate::system::memory;

/// The media type of the text.
pub const MEDIA_TYPE: &str = "text/plain; version=0.0.4; charset=utf-8";

/// What a metric means.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Kind {
    /// Only grows, until the node or one of its processes starts again.
    Counter,
    Gauge,
}

/// A value of the diagnostics as a metric.
struct Key {
    /// Its key; `BUS` stands for the name of a bus, `CHANNEL` for that of a channel of sound.
    key: &'static str,
    /// Name of the metric without prefix, and a label if several keys share it.
    name: &'static str,
    label: &'static str,
    kind: Kind,
    /// The unit of the metric in that of the diagnostics.
    divisor: f64,
    help: &'static str,
}

const fn counter(key: &'static str, name: &'static str, help: &'static str) -> Key {
    Key { key, name, label: "", kind: Kind::Counter, divisor: 1.0, help }
}

const fn gauge(key: &'static str, name: &'static str, help: &'static str) -> Key {
    Key { key, name, label: "", kind: Kind::Gauge, divisor: 1.0, help }
}

const fn labelled(key: Key, label: &'static str) -> Key {
    Key { label, ..key }
}

const fn microseconds(key: Key) -> Key {
    Key { divisor: 1e6, ..key }
}

const PREDICTIONS: &str = "Predictions, by the route that led to them.";
const TIMES: &str = "Time from an input to its prediction, over the last second.";
const SKIPPED: &str = "Work that was avoided.";

/// The values of the diagnostics.
const KEYS: &[Key] = &[
    counter("inputs_from_BUS", "inputs_total", "Inputs by the bus that delivered them first."),
    counter("inputs_twice", "inputs_twice_total", "Inputs that another bus had delivered already."),
    counter("inputs_passed_over", "inputs_passed_over_total", "Inputs that were recorded but not predicted."),
    counter(
        "messages_while_not_active",
        "messages_while_not_active_total",
        "Messages that came while the node was not active.",
    ),
    counter("inputs_lost", "inputs_lost_total", "Messages lost because the queue of the node was full."),
    gauge("inputs_waiting", "inputs_waiting", "Messages in the queue of the node."),
    labelled(counter("predictions_solved", "predictions_total", PREDICTIONS), "route=\"solved\""),
    labelled(counter("predictions_from_chart", "predictions_total", PREDICTIONS), "route=\"chart\""),
    labelled(counter("predictions_reused", "predictions_total", PREDICTIONS), "route=\"reused\""),
    counter("faults", "faults_total", "Inputs without a valid prediction, and silences."),
    gauge("predictions_per_s", "predictions_per_second", "Predictions in the last second."),
    microseconds(labelled(gauge("prediction_time_median_us", "prediction_time_seconds", TIMES), "quantile=\"0.5\"")),
    microseconds(labelled(gauge("prediction_time_p99_us", "prediction_time_seconds", TIMES), "quantile=\"0.99\"")),
    counter("stability_maps", "stability_maps_total", "Stability maps computed."),
    counter("window_ends", "window_ends_total", "Ends of windows computed."),
    counter("sensitivities", "sensitivities_total", "Sensitivities computed."),
    gauge("stability_map_pending", "stability_map_pending", "Whether a stability map is being computed."),
    labelled(counter("skipped_zero_terms", "skipped_total", SKIPPED), "what=\"zero_terms\""),
    labelled(counter("skipped_decoupled_modes", "skipped_total", SKIPPED), "what=\"decoupled_modes\""),
    labelled(counter("skipped_roots_beyond_band", "skipped_total", SKIPPED), "what=\"roots_beyond_band\""),
    labelled(counter("skipped_encodings", "skipped_total", SKIPPED), "what=\"encodings\""),
    counter("publish_failures", "publish_failures_total", "Messages that a bus refused."),
    gauge("chart_leaves", "chart_leaves", "Boxes of the chart."),
    gauge("chart_bytes", "chart_bytes", "Size of the chart."),
    gauge("temperature_c", "temperature_celsius", "The latest temperature of the contact."),
    gauge("temperature_age_s", "temperature_age_seconds", "Time since the latest temperature."),
    gauge("temperature_of_rig_c", "temperature_of_rig_celsius", "The temperature that the rig has in predictions."),
    counter("rigs_by_temperature", "rigs_by_temperature_total", "Rigs computed for another temperature."),
    counter("BUS_blocks_missed", "blocks_missed_total", "Blocks of samples that a bus lost."),
    counter("BUS_blocks_malformed", "blocks_malformed_total", "Blocks of samples that could not be decoded."),
    counter("BUS_missed", "inputs_missed_total", "Sequence numbers that no input had."),
    counter("BUS_malformed", "inputs_malformed_total", "Inputs that could not be decoded."),
    counter("BUS_failures", "bus_failures_total", "Failures of a bus."),
    gauge("BUS_incompatible_peers", "incompatible_peers", "Peers whose quality of service is incompatible."),
    counter("ros2_side_falls", "ros2_restarts_total", "Restarts of the ROS 2 process."),
    gauge("ros2_side_process", "ros2_process_id", "The ROS 2 process."),
    counter("ros2_refused", "ros2_refused_total", "Messages that DDS refused to publish."),
    counter("messages_written", "recording_messages_total", "Messages in the files of the recording."),
    counter("bytes_written", "recording_bytes_total", "Bytes in the files of the recording."),
    gauge("messages_waiting", "recording_messages_waiting", "Messages in the queue of the recorder."),
    counter("messages_dropped", "recording_messages_dropped_total", "Messages that are in no file of the recording."),
    counter("blocks_twice", "blocks_twice_total", "Blocks of samples that another bus had delivered already."),
    counter("blocks_refused", "blocks_refused_total", "Blocks of samples that are not valid."),
    counter("blocks_lost", "blocks_lost_total", "Blocks of samples lost because a queue was full."),
    counter("blocks_not_recorded", "blocks_not_recorded_total", "Blocks of samples that are not in the recording."),
    counter(
        "squeals_not_published",
        "squeals_not_published_total",
        "Squeals in samples lost because a queue was full.",
    ),
    gauge("CHANNEL_sample_rate_hz", "sample_rate_hertz", "Sample rate of a channel."),
    counter("CHANNEL_samples", "samples_total", "Samples received."),
    counter("CHANNEL_missing", "samples_missing_total", "Samples missing between blocks."),
    counter("CHANNEL_repeated", "samples_repeated_total", "Samples that were received twice."),
    counter("CHANNEL_not_finite", "samples_not_finite_total", "Samples that are no number."),
    counter("CHANNEL_squeals", "squeals_in_sound_total", "Squeals found in samples."),
];

/// Metrics by name, each with its help, type and lines.
#[derive(Default)]
struct Metrics(BTreeMap<String, (String, Vec<String>)>);

impl Metrics {
    /// Adds a value; one that is unknown (NaN) is left out.
    fn push(&mut self, name: &str, kind: Option<Kind>, help: &str, labels: &str, value: f64) {
        if value.is_nan() {
            return;
        }
        let kind = match kind {
            Some(Kind::Counter) => "counter",
            Some(Kind::Gauge) => "gauge",
            None => "untyped",
        };
        // What belongs to the process has the name that every process gives it.
        let name = if name.starts_with("process_") { name.to_owned() } else { format!("squealcast_{name}") };
        let head = format!("# HELP {name} {help}\n# TYPE {name} {kind}\n");
        let labels = if labels.is_empty() { String::new() } else { format!("{{{labels}}}") };
        let line = format!("{name}{labels} {}\n", number(value));
        self.0.entry(name).or_insert((head, vec![])).1.push(line);
    }

    fn gauge(&mut self, name: &str, help: &str, value: f64) {
        self.push(name, Some(Kind::Gauge), help, "", value);
    }

    /// Adds the values of diagnostics that are numbers.
    fn diagnostics(&mut self, diagnostics: &DiagnosticArray) {
        for pair in diagnostics.status.iter().flat_map(|status| &status.values) {
            let value = match pair.value.as_str() {
                "true" => 1.0,
                "false" => 0.0,
                // What is no number is not a metric, such as the directory of a recording.
                text => match text.parse::<f64>() {
                    Ok(value) => value,
                    Err(_) => continue,
                },
            };
            match KEYS.iter().find_map(|key| Some((key, labels(key, &pair.key)?))) {
                Some((key, labels)) => self.push(key.name, Some(key.kind), key.help, &labels, value / key.divisor),
                None => self.push(&name_of(&pair.key), None, "A value of the diagnostics.", "", value),
            }
        }
    }

    fn text(&self) -> String {
        self.0.values().flat_map(|(head, lines)| std::iter::once(head).chain(lines)).map(String::as_str).collect()
    }
}

/// The labels of the metric `key` for a key of the diagnostics; `None` if that is another one.
fn labels(key: &Key, found: &str) -> Option<String> {
    // What stands for the mark in `found`, if the key has that mark.
    let named = |mark: &str| {
        let (start, end) = key.key.split_once(mark)?;
        Some(found.strip_prefix(start).and_then(|rest| rest.strip_suffix(end)))
    };
    match (named("BUS"), named("CHANNEL")) {
        (Some(bus), _) => {
            let bus = bus.filter(|bus| Bus::ALL.iter().any(|known| known.name() == *bus))?;
            Some(format!("bus=\"{bus}\""))
        }
        (None, Some(channel)) => Some(format!("channel=\"{}\"", escaped(channel?))),
        (None, None) => (key.key == found).then(|| key.label.to_owned()),
    }
}

/// A text as the value of a label.
fn escaped(text: &str) -> String {
    text.replace('\\', "\\\\").replace('"', "\\\"").replace('\n', "\\n")
}

/// A key as the name of a metric.
fn name_of(key: &str) -> String {
    key.chars().map(|c| if c.is_ascii_alphanumeric() { c.to_ascii_lowercase() } else { '_' }).collect()
}

fn number(value: f64) -> String {
    match value {
        f64::INFINITY => "+Inf".to_owned(),
        f64::NEG_INFINITY => "-Inf".to_owned(),
        _ => value.to_string(),
    }
}

/// The metrics of a node.
pub fn text(about: &About, snapshot: &Snapshot) -> String {
    let mut metrics = Metrics::default();
    let [rig, hash] = [&about.rig, &about.content_hash].map(|text| escaped(text));
    let info = format!("version=\"{}\",rig=\"{rig}\",content_hash=\"{hash}\"", about.version);
    metrics.push("info", Some(Kind::Gauge), "The node: always 1.", &info, 1.0);
    let said = snapshot.assessment();
    for status in Status::ALL {
        let mut label = String::from("status=\"");
        let _ = write!(label, "{}\"", name_of(status.name())); // writing to a String cannot fail
        let value = f64::from(u8::from(status == said.status));
        metrics.push("status", Some(Kind::Gauge), "1 for the status of the node, 0 for the others.", &label, value);
    }
    if let Some(received) = snapshot.received {
        metrics.gauge("input_age_seconds", "Time since the last input.", received.elapsed().as_secs_f64());
    }
    if let Some(input) = &snapshot.input {
        metrics.gauge("normal_load_newtons", "Normal load of the last input.", input.normal_load_n);
        metrics.gauge("disc_speed_radians_per_second", "Disc speed of the last input.", input.disc_speed_rad_s);
        metrics.gauge("friction_coefficient", "Friction coefficient of the last input.", input.friction_coefficient);
    }
    // Without data nothing is asserted.
    if let Some(prediction) = snapshot.prediction.as_ref().filter(|_| said.status.is_known()) {
        metrics.gauge(
            "friction_margin",
            "Distance to the nearest end of a window of instability, negative inside one.",
            prediction.friction_margin,
        );
        metrics.gauge(
            "critical_friction_coefficient",
            "The nearest end of a window of instability.",
            prediction.critical_friction,
        );
        let growth = prediction.max_growth_rate_per_s;
        metrics.gauge("growth_rate_per_second", "Growth rate of the fastest growing mode.", growth);
        metrics.gauge(
            "unstable_modes",
            "Number of growing modes and static roots.",
            f64::from(prediction.unstable_modes),
        );
    }
    if let Some(next) = &said.next {
        metrics.gauge("next_squeal_hertz", "Frequency at that end; 0 for a static divergence.", next.frequency_hz);
    }
    if let Some(mode) = &said.fastest {
        metrics.gauge("fastest_mode_hertz", "Frequency of the fastest growing mode.", mode.frequency_hz);
    }
    for (name, value) in snapshot.settings.iter().flat_map(|settings| settings.values()) {
        metrics.push("setting", Some(Kind::Gauge), "Settings in force.", &format!("name=\"{name}\""), value);
    }
    if let Some(bytes) = memory::resident_bytes() {
        metrics.gauge("process_resident_memory_bytes", "Resident memory of this process.", bytes as f64);
    }
    if let Some(diagnostics) = &snapshot.diagnostics {
        metrics.diagnostics(diagnostics);
    }
    metrics.text()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::msgs::{DiagnosticStatus, KeyValue};

    fn shown(pairs: &[(&str, &str)]) -> String {
        let values = pairs.iter().map(|&(key, value)| KeyValue { key: key.to_owned(), value: value.to_owned() });
        let status = vec![DiagnosticStatus { values: values.collect(), ..Default::default() }];
        let mut metrics = Metrics::default();
        metrics.diagnostics(&DiagnosticArray { status, ..Default::default() });
        metrics.text().lines().filter(|line| !line.starts_with("# HELP")).map(|line| format!("{line}\n")).collect()
    }

    #[test]
    fn values_of_the_diagnostics_become_metrics_with_type_unit_and_labels() {
        assert_eq!(
            shown(&[("inputs_from_shm", "3"), ("inputs_from_ros2", "4")]),
            "# TYPE squealcast_inputs_total counter\nsquealcast_inputs_total{bus=\"shm\"} 3\n\
             squealcast_inputs_total{bus=\"ros2\"} 4\n"
        );
        let times = shown(&[("prediction_time_median_us", "12.5"), ("prediction_time_p99_us", "NaN")]);
        assert!(
            times.ends_with("_seconds gauge\nsquealcast_prediction_time_seconds{quantile=\"0.5\"} 0.0000125\n"),
            "{times}"
        );
        assert_eq!(shown(&[("directory", "/var/lib/x")]), "");
        assert!(shown(&[("stability_map_pending", "true")]).ends_with("_pending 1\n"));
        // A bus that is none is a channel of that name.
        assert!(shown(&[("shm_blocks_missed", "1")]).contains("squealcast_blocks_missed_total{bus=\"shm\"} 1"));
        assert!(
            shown(&[("left \"mic\"_samples", "9")])
                .contains("squealcast_samples_total{channel=\"left \\\"mic\\\"\"} 9")
        );
    }

    #[test]
    fn a_value_that_is_not_listed_has_no_type() {
        assert_eq!(shown(&[("Köln_missed", "3")]), "# TYPE squealcast_k_ln_missed untyped\nsquealcast_k_ln_missed 3\n");
    }
}

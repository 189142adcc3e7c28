//! The log of a node as JSON: one object a line, statuses on standard output, notes on standard error. Its words are those
//! of the text.

use clap::ValueEnum;
use serde::Serialize;

use crate::display::events::{iso, seconds};
use crate::node::Snapshot;
use crate::node::status::Assessment;
use crate::system::clock;
use crate::text::notes;

/// The form of log lines.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum LogFormat {
    Text,
    Json,
}

impl LogFormat {
    /// Writes the notes of this process in this form from now on.
    pub fn begin(self) {
        match self {
            Self::Text => {}
            Self::Json => notes::write_as(|text| note(&now(), text)),
        }
    }
}

fn now() -> String {
    iso(seconds(clock::now_ns()))
}

#[derive(Serialize)]
struct Note<'a> {
    time: &'a str,
    event: &'static str,
    severity: &'static str,
    message: &'a str,
}

/// A note: its severity is the word that it begins with.
fn note(time: &str, text: &str) -> String {
    let of = |severity| Some((severity, text.strip_prefix(severity)?.strip_prefix(": ")?));
    let (severity, message) = of("error").or_else(|| of("warning")).unwrap_or(("info", text));
    json(&Note { time, event: "note", severity, message })
}

/// A status with the input and the prediction that it follows from; what is unknown is `null`.
#[derive(Serialize)]
struct StatusLine<'a> {
    time: &'a str,
    event: &'static str,
    #[serde(flatten)]
    said: &'a Assessment,
    seq: Option<u64>,
    stamp: Option<String>,
    normal_load_n: Option<f64>,
    disc_speed_rad_s: Option<f64>,
    friction_coefficient: Option<f64>,
    friction_margin: Option<f64>,
    growth_rate_per_s: Option<f64>,
    unstable_modes: Option<u32>,
}

/// The line of a status.
pub fn status(said: &Assessment, snapshot: &Snapshot) -> String {
    status_at(&now(), said, snapshot)
}

fn status_at(time: &str, said: &Assessment, snapshot: &Snapshot) -> String {
    let prediction = snapshot.prediction.as_ref();
    let known = prediction.filter(|_| said.status.is_known());
    let input = snapshot.input.as_ref();
    json(&StatusLine {
        time,
        event: "status",
        said,
        seq: prediction.map(|prediction| prediction.input_seq),
        stamp: prediction.map(|prediction| iso(seconds(prediction.header.stamp.as_ns()))),
        normal_load_n: input.map(|input| input.normal_load_n),
        disc_speed_rad_s: input.map(|input| input.disc_speed_rad_s),
        friction_coefficient: input.map(|input| input.friction_coefficient),
        friction_margin: known.map(|prediction| prediction.friction_margin),
        growth_rate_per_s: known.map(|prediction| prediction.max_growth_rate_per_s),
        unstable_modes: known.map(|prediction| prediction.unstable_modes),
    })
}

/// Numbers that are not finite are `null`.
fn json(line: &impl Serialize) -> String {
    serde_json::to_string(line).unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use serde_json::{Value, json};

    use super::*;
    use crate::commands::live::view::tests::snapshot;
    use crate::node::status::Status;

    #[test]
    fn a_note_has_time_severity_and_message() {
        let line = |text: &str| note("2026-01-01T00:00:00.000000Z", text);
        assert_eq!(
            line("warning: no \"page\""),
            r#"{"time":"2026-01-01T00:00:00.000000Z","event":"note","severity":"warning","message":"no \"page\""}"#
        );
        let of = |text: &str| -> Value { serde_json::from_str(&line(text)).expect("JSON") };
        assert_eq!((&of("error: x")["severity"], &of("error: x")["message"]), (&json!("error"), &json!("x")));
        assert_eq!((&of("errors: 3")["severity"], &of("errors: 3")["message"]), (&json!("info"), &json!("errors: 3")));
    }

    #[test]
    fn a_status_has_the_words_and_values_of_the_text() {
        let line = |status| -> Value {
            let snapshot = snapshot(status);
            serde_json::from_str(&status_at("now", &snapshot.assessment(), &snapshot)).expect("JSON")
        };
        let squeal = line(Status::Squeal);
        assert_eq!(
            (&squeal["event"], &squeal["status"], &squeal["seq"]),
            (&json!("status"), &json!("squeal"), &json!(7))
        );
        assert_eq!(squeal["message"], "mode 15 at 3114.6 Hz grows by 636 1/s, the fastest of 2");
        assert_eq!((&squeal["friction_coefficient"], &squeal["friction_margin"]), (&json!(0.4312), &json!(-0.0557)));
        assert_eq!(squeal["fastest"]["frequency_hz"], 3114.6);
        let stopped = line(Status::NoData);
        assert!(stopped["friction_margin"].is_null() && stopped["fastest"].is_null(), "{stopped}");
        assert_eq!(line(Status::Waiting)["status"], "waiting");
    }
}

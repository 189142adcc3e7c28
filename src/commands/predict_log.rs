use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::{Context, anyhow};
use clap::Args;

use super::import::LogArgs;
use super::recordings::Recordings;
use super::{Outcome, print};
use crate::files::chart_file::ChartFile;
use crate::import::{operating_point, read_log};
use crate::msgs::schema::Topic;
use crate::node::kept_chart;
use crate::offline::{self, Measured, Predicted, Quantity};
use crate::physics::Chart;
use crate::recording::message::Payload;
use crate::recording::reader::{Recorded, is_recording};
use crate::rig::Rig;
use crate::session::computed::session_chart;
use crate::session::conditions;

/// Predict recorded conditions as fast as possible, from recordings with operating points and from tribometer logs. For
/// each, a recording with predictions is written, with the rig's own settings and the original stamps
#[derive(Debug, Args)]
pub struct Options {
    #[command(flatten)]
    recordings: Recordings,
    /// Rig file, or the name of an embedded rig
    #[arg(long, value_name = "RIG")]
    rig: String,
    /// Directory for the recordings, each in its own subdirectory; created if missing
    #[arg(short, long, value_name = "DIR")]
    output: PathBuf,
    /// Build the chart of the rig first, or load a stored one. Predictions then take microseconds, which pays for long
    /// recordings
    #[arg(long)]
    chart: bool,
    #[command(flatten)]
    log: LogArgs,
}

impl Options {
    pub fn run(self) -> anyhow::Result<Outcome> {
        let paths = self.recordings.paths()?;
        let rig = Arc::new(Rig::load(&self.rig)?);
        let chart = if self.chart { Some(Arc::new(chart(&rig)?)) } else { None };
        let mut outcome = Outcome::Done;
        for path in &paths {
            outcome = outcome.max(self.predict(path, &rig, chart.clone())?);
        }
        Ok(outcome)
    }

    fn predict(&self, path: &Path, rig: &Arc<Rig>, chart: Option<Arc<Chart>>) -> anyhow::Result<Outcome> {
        if path.is_dir() || is_recording(path)? { self.recording(path, rig, chart) } else { self.log(path, rig, chart) }
    }

    fn recording(&self, path: &Path, rig: &Arc<Rig>, chart: Option<Arc<Chart>>) -> anyhow::Result<Outcome> {
        let recording = self.recordings.open(path)?;
        if recording.topics().name_of(Topic::OperatingPoint).is_none() {
            return Err(anyhow!("{}: holds no operating points to predict", path.display()));
        }
        let points = recording.messages().filter_map(|entry| match entry.message {
            Recorded::Known(Payload::OperatingPoint(input)) => Some(conditions(&input)),
            _ => None,
        });
        let mut messages = recording.messages();
        let measured = messages.by_ref().filter_map(|entry| {
            let quantity = match entry.message {
                Recorded::Known(Payload::OperatingPoint(input)) => Quantity::Conditions(input),
                Recorded::Known(Payload::Vibration(vibration)) => Quantity::Vibration(vibration),
                // Of the rig's messages only these are predicted or recorded again; the node's own are made anew.
                Recorded::Known(
                    Payload::Prediction(_)
                    | Payload::SessionEvent(_)
                    | Payload::RigInfo(_)
                    | Payload::Sensitivity(_)
                    | Payload::Diagnostics(_)
                    | Payload::Waveform(_)
                    | Payload::Heard(_),
                )
                | Recorded::Unreadable(_)
                | Recorded::Other => return None,
            };
            Some(Measured { log_time_ns: entry.log_time_ns, publish_time_ns: entry.publish_time_ns, quantity })
        });
        let predicted =
            offline::record(rig, chart, points, measured, &self.output).with_context(|| path.display().to_string())?;
        let found = messages.damage().iter().filter(|damage| !recording.damage().contains(damage));
        for damage in found {
            note!("damaged: {damage}");
        }
        report(path, &predicted)?;
        let lost = recording.damage().iter().chain(messages.damage()).any(|damage| damage.damage.loses_data);
        Ok(if lost { Outcome::Differences } else { Outcome::Done })
    }

    fn log(&self, path: &Path, rig: &Arc<Rig>, chart: Option<Arc<Chart>>) -> anyhow::Result<Outcome> {
        let (_, log) = read_log(path, &self.log.options())?;
        let outcome = super::import::describe(&log);
        let points = log.samples.iter().zip(0..).map(|(sample, seq)| conditions(&operating_point(seq, sample)));
        let measured = log
            .samples
            .iter()
            .zip(0..)
            .map(|(sample, seq)| Measured::at_its_stamp(Quantity::Conditions(operating_point(seq, sample))));
        let predicted =
            offline::record(rig, chart, points, measured, &self.output).with_context(|| path.display().to_string())?;
        report(path, &predicted)?;
        Ok(outcome)
    }
}

/// The chart of a rig, stored on disk for later runs.
fn chart(rig: &Rig) -> anyhow::Result<Chart> {
    let kept = ChartFile::locate(&rig.name, rig.path.as_deref(), &rig.content_hash);
    let threads = std::thread::available_parallelism().map_or(1, usize::from);
    let chart = match kept {
        Some(kept) => kept_chart(rig, &kept, threads, &|| true),
        None => session_chart(rig, threads, &|| true),
    };
    chart.map_err(|reason| anyhow!("{}: cannot be charted: {reason}", rig.name))
}

fn report(path: &Path, predicted: &Predicted) -> anyhow::Result<()> {
    let Predicted { directory, inputs, levels: [ok, warn, squeal, fault], map_failure } = predicted;
    let path = path.display();
    note!("{path}: {inputs} operating points predicted: OK {ok}, WARN {warn}, SQUEAL {squeal}, FAULT {fault}");
    if let Some(reason) = map_failure {
        note!("{path}: no stability map for some of them: {reason}");
    }
    print(&format!("{}\n", directory.display()))
}

use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::{Context, anyhow, ensure};
use clap::Args;

use super::hear::DetectionArgs;
use super::import::LogArgs;
use super::recordings::Recordings;
use super::sound_files::SoundFileArgs;
use super::{Outcome, print};
use crate::files::chart_file::ChartFile;
use crate::import::sound_blocks::{Beside, join};
use crate::import::{operating_point, read_log, temperature};
use crate::msgs::schema::Topic;
use crate::node::kept_chart;
use crate::offline::{self, Measured, Predicted, Quantity, SoundFound};
use crate::physics::Chart;
use crate::recording::message::Payload;
use crate::recording::reader::{Recorded, Recording, is_recording};
use crate::rig::Rig;
use crate::session::computed::session_chart;
use crate::session::conditions;
use crate::sound::search::end_ns;

const EXAMPLES: &str = "\
Examples:
  squealcast predict-log recordings/ramp --rig nine-dof -o predicted               another rig
  squealcast predict-log test.csv --rig my-rig.toml -o predicted --sound test.wav  a log and sound";

/// Predict recorded conditions as fast as possible, from recordings with operating points and from tribometer logs. For
/// each, a recording with predictions is written, with the rig's own settings and the original stamps. Sound and
/// acceleration, recorded or in files beside the log, are searched for squeal, which is compared with the predictions
#[derive(Debug, Args)]
#[command(after_help = EXAMPLES)]
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
    #[command(flatten)]
    sound: SoundFileArgs,
    #[command(flatten)]
    detection: DetectionArgs,
}

impl Options {
    pub fn run(self) -> anyhow::Result<Outcome> {
        let paths = self.recordings.paths()?;
        self.sound.check(paths.len())?;
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
        let points = offline::points(&recording);
        let mut messages = recording.messages();
        let measured = messages.by_ref().filter_map(offline::measured);
        let (first_ns, ahead_ns) = first(&recording);
        let with_sound = recording.topics().name_of(Topic::Waveform).is_some();
        ensure!(
            !(with_sound && self.sound.is_given()),
            "{}: already holds samples, and --sound is given",
            path.display()
        );
        let settings = (with_sound || self.sound.is_given()).then(|| self.detection.settings());
        let mut sound = self.sound.open(path, first_ns, settings)?;
        let timed = measured.map(|measured| (measured.log_time_ns as i64 - ahead_ns, measured));
        let measured = join(timed, &mut sound.blocks).map(|beside| match beside {
            Beside::Other(measured) => measured,
            Beside::Samples(block) => {
                let time_ns = u64::try_from(end_ns(&block).saturating_add(ahead_ns)).unwrap_or(0);
                let quantity = Quantity::Samples(block);
                Measured { log_time_ns: time_ns, publish_time_ns: time_ns, quantity }
            }
        });
        let predicted = offline::record(rig, chart, points, measured, settings, &self.output);
        let predicted = predicted.with_context(|| path.display().to_string())?;
        let found = messages.damage().iter().filter(|damage| !recording.damage().contains(damage));
        for damage in found {
            note!("damaged: {damage}");
        }
        report(path, &predicted)?;
        sound.blocks.take_error().map_or(Ok(()), Err)?;
        let lost = recording.damage().iter().chain(messages.damage()).any(|damage| damage.damage.loses_data);
        Ok(if lost { Outcome::Differences } else { sound.outcome })
    }

    fn log(&self, path: &Path, rig: &Arc<Rig>, chart: Option<Arc<Chart>>) -> anyhow::Result<Outcome> {
        let (_, log) = read_log(path, &self.log.options())?;
        let outcome = super::import::describe(&log);
        let settings = self.sound.is_given().then(|| self.detection.settings());
        let mut sound = self.sound.open(path, log.samples.first().map_or(0, |first| first.stamp_ns), settings)?;
        let inputs = || log.samples.iter().zip(0..).map(|(sample, seq)| operating_point(seq, sample));
        let timed = inputs().zip(&log.samples).flat_map(|(input, sample)| {
            let heat = temperature(sample).map(Quantity::Temperature);
            let quantities = heat.into_iter().chain([Quantity::Conditions(input)]);
            quantities.map(|quantity| (sample.stamp_ns, quantity))
        });
        let measured = join(timed, &mut sound.blocks).map(|beside| match beside {
            Beside::Other(quantity) => Measured::at_its_stamp(quantity),
            Beside::Samples(block) => Measured::at_its_stamp(Quantity::Samples(block)),
        });
        let points = inputs().map(|input| conditions(&input));
        let predicted = offline::record(rig, chart, points, measured, settings, &self.output);
        let predicted = predicted.with_context(|| path.display().to_string())?;
        report(path, &predicted)?;
        sound.blocks.take_error().map_or(Ok(()), Err)?;
        Ok(outcome.max(sound.outcome))
    }
}

/// Stamp of the first operating point of a recording, and by how much its log time is ahead of it.
fn first(recording: &Recording) -> (i64, i64) {
    let first = recording.messages().find_map(|entry| match entry.message {
        Recorded::Known(Payload::OperatingPoint(input)) => Some((input.header.stamp.as_ns(), entry.log_time_ns as i64)),
        _ => None,
    });
    first.map_or((0, 0), |(stamp_ns, log_ns)| (stamp_ns, log_ns.saturating_sub(stamp_ns)))
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
    let Predicted { directory, inputs, levels: [ok, warn, squeal, fault], map_failure, sound } = predicted;
    let path = path.display();
    note!("{path}: {inputs} operating points predicted: OK {ok}, WARN {warn}, SQUEAL {squeal}, FAULT {fault}");
    if let Some(reason) = map_failure {
        note!("{path}: no stability map for some of them: {reason}");
    }
    if let Some(SoundFound { channels, samples, missing_samples, squeals, refused, why_refused }) = sound {
        note!("{path}: {samples} samples of {channels} channels, {missing_samples} missing: {squeals} squeals");
        if let Some(why) = why_refused {
            note!("{path}: {refused} blocks of samples not searched: {why}");
        }
    }
    print(&format!("{}\n", directory.display()))
}

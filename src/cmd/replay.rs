use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::{Duration, Instant};

use anyhow::{Context, bail, ensure};
use clap::Args;

use super::buses::BusOptions;
use super::{Outcome, live, not_negative, positive, print, signals};
use crate::io::message::Payload;
use crate::io::pace::{Due, Pacer, Pacing};
use crate::io::recording::{Recorded, Recording};
use crate::io::ros_args::RosArgs;
use crate::io::ros2::{Parameters, Ros2, Ros2Options, Ros2Source};
use crate::io::shm::{ShmOptions, ShmOutput, ShmSource, ShmVibrationSource};
use crate::node::Watch;
use crate::rig::{Rig, RigFile};
use crate::verify::{Verification, verify};
use crate::wire::topic;

/// Play a recording on live buses, or predict it again and compare
#[derive(Debug, Args)]
pub struct Options {
    /// A recording: a file, or the directory of all its files
    file: PathBuf,
    /// Predict again as fast as possible and compare with what was recorded; exit code 3 where it differs
    #[arg(long)]
    verify: bool,
    /// With --verify: predict with this rig instead of the recorded one
    #[arg(long, value_name = "RIG", requires = "verify")]
    rig: Option<String>,
    /// Playback speed; 2 plays twice as fast
    #[arg(long, value_name = "R", value_parser = positive, default_value = "1")]
    rate: f64,
    /// Begin again at the end, until stopped
    #[arg(long = "loop")]
    repeat: bool,
    /// Recorded seconds to skip at the start
    #[arg(long, value_name = "S", value_parser = not_negative, default_value = "0")]
    start_offset: f64,
    /// Recorded seconds to play [default: to the end]
    #[arg(long, value_name = "S", value_parser = positive)]
    playback_duration: Option<f64>,
    /// Topics to play [default: all of the node's]
    #[arg(long, value_name = "TOPIC", num_args = 1.., value_parser = KNOWN_TOPICS)]
    topics: Vec<String>,
    /// Print log lines instead of a live table, on a terminal too
    #[arg(long)]
    plain: bool,
    #[command(flatten)]
    buses: BusOptions,
}

const KNOWN_TOPICS: [&str; 6] =
    [topic::OPERATING_POINT, topic::PREDICTION, topic::RIG, topic::SESSION_EVENT, topic::DIAGNOSTICS, topic::VIBRATION];

impl Options {
    pub fn run(self, ros_args: RosArgs) -> anyhow::Result<Outcome> {
        let recording = Recording::open(&self.file)?;
        for damage in recording.damage() {
            note!("damaged: {damage}");
        }
        if self.verify { self.verify(&recording) } else { self.play(&recording, ros_args) }
    }

    fn verify(&self, recording: &Recording) -> anyhow::Result<Outcome> {
        let rig = match &self.rig {
            Some(rig) => Rig::load(rig)?,
            None => recorded_rig(recording)?,
        };
        let started = Instant::now();
        let found = verify(recording, &Arc::new(rig))?;
        print(&report(&found, started.elapsed()))?;
        let lost = recording.damage().iter().any(|damage| damage.damage.loses_data);
        Ok(if found.agrees() && !lost { Outcome::Done } else { Outcome::Differences })
    }

    fn play(&self, recording: &Recording, ros_args: RosArgs) -> anyhow::Result<Outcome> {
        let player = Player::join(self.buses.shm(), self.buses.ros2(ros_args)?)?;
        let first = recording.messages().next().context("the recording is empty")?;
        let stopped = Arc::new(AtomicBool::new(false));
        let stop = stopped.clone();
        signals::on_stop(move || stop.store(true, Ordering::Relaxed))?;
        let watch = Watch::default();
        let played = Arc::new(AtomicU64::new(0));
        let shown = live::show(self.frame(recording, &played, &stopped), watch.clone(), self.plain);
        let done = self.play_rounds(recording, first.log_time_ns, &player, &watch, &played, &stopped);
        shown.stop();
        done?;
        note!("played {} messages", played.load(Ordering::Relaxed));
        Ok(Outcome::Done)
    }

    /// What is around the table of what is played.
    fn frame(&self, recording: &Recording, played: &Arc<AtomicU64>, stopped: &Arc<AtomicBool>) -> live::Frame {
        let file = self.file.file_name().unwrap_or(self.file.as_os_str()).to_string_lossy().into_owned();
        // A recording that was imported carries no rig: then every damping below zero grows.
        let rig = recorded_rig(recording).ok();
        let title = rig.as_ref().map_or_else(|| file.clone(), |rig| format!("{}, {file}", rig.name));
        let (played, stopped) = (played.clone(), stopped.clone());
        live::Frame {
            title,
            instability_threshold: rig.map_or(0.0, |rig| rig.instability_threshold),
            foot: Box::new(move |_| format!("played {} messages", played.load(Ordering::Relaxed))),
            quit: Box::new(move || stopped.store(true, Ordering::Relaxed)),
        }
    }

    fn play_rounds(
        &self,
        recording: &Recording,
        first_ns: u64,
        player: &Player,
        watch: &Watch,
        played: &AtomicU64,
        stopped: &AtomicBool,
    ) -> anyhow::Result<()> {
        let wanted = |payload: &Payload| {
            self.topics.is_empty() || self.topics.iter().any(|topic| topic == payload.topic().name())
        };
        let pacing = Pacing {
            rate: self.rate,
            start_offset_s: self.start_offset,
            playback_duration_s: self.playback_duration,
            repeat: self.repeat,
        };
        let pacer = Pacer::new(pacing, first_ns)?;
        let started = Instant::now();
        let mut round_start_ns = Some(0);
        while let Some(start_ns) = round_start_ns {
            let mut last_ns = first_ns;
            for entry in recording.messages() {
                let Recorded::Known(payload) = entry.message else { continue };
                if !wanted(&payload) {
                    continue;
                }
                match pacer.due(start_ns, entry.log_time_ns) {
                    Due::Skip => continue,
                    Due::End => break,
                    Due::After(ns) => {
                        signals::wait_until(started + Duration::from_nanos(ns), stopped);
                    }
                }
                if stopped.load(Ordering::Relaxed) {
                    return Ok(());
                }
                last_ns = entry.log_time_ns;
                player.publish(&payload)?;
                played.fetch_add(1, Ordering::Relaxed);
                match payload {
                    Payload::OperatingPoint(input) => watch.input(&input),
                    Payload::Prediction(prediction) => watch.prediction(&prediction),
                    _ => {}
                }
            }
            let nothing = played.load(Ordering::Relaxed) == 0;
            ensure!(!nothing, "nothing to play: no such messages in that part of the recording");
            round_start_ns = pacer.next_round(start_ns, last_ns, 10_000_000);
        }
        Ok(())
    }
}

/// The rig a recording carries.
pub fn recorded_rig(recording: &Recording) -> anyhow::Result<Rig> {
    let hash = recording.session_metadata("rig_content_hash");
    let hash = hash.context("the recording names no rig; say which with --rig")?;
    let files: Vec<RigFile> = recording
        .attachments()
        .iter()
        .map(|attachment| RigFile { name: attachment.name.clone(), bytes: attachment.data.clone() })
        .collect();
    ensure!(!files.is_empty(), "the recording carries no rig file; say which with --rig");
    let rig = Rig::from_files(&files)?;
    if rig.content_hash != hash {
        bail!("the recorded rig has hash {}, expected {hash} of the metadata", rig.content_hash);
    }
    Ok(rig)
}

fn report(found: &Verification, took: Duration) -> String {
    let mut text = format!(
        "{} inputs, {} of them predicted; {} predictions identical, {} different, {} missing, {} extra ({:.2} s)\n",
        found.inputs,
        found.predicted,
        found.identical,
        found.different,
        found.missing,
        found.extra,
        took.as_secs_f64(),
    );
    if found.different_maps > 0 {
        text += &format!("{} stability maps or charts differ\n", found.different_maps);
    }
    if found.different > 0 {
        text += &format!(
            "largest differences: frequency {:.3e} relative, growth rate {:.3e} 1/s\n",
            found.frequency_difference, found.growth_rate_difference_per_s
        );
    }
    for difference in &found.described {
        text += &format!("  {difference}\n");
    }
    text
}

/// Publishes what was recorded.
struct Player {
    shm: Option<(ShmSource, ShmOutput, ShmVibrationSource)>,
    ros2: Option<(Ros2Source, Ros2)>,
}

impl Player {
    fn join(shm: Option<ShmOptions>, ros2: Option<Ros2Options>) -> anyhow::Result<Self> {
        ensure!(shm.is_some() || ros2.is_some(), "nothing to play to: both --no-shm and --no-ros are given");
        let ports = |shm| anyhow::Ok((ShmSource::new(shm)?, ShmOutput::new(shm)?, ShmVibrationSource::new(shm)?));
        let shm = shm.as_ref().map(ports).transpose();
        let ros2 = ros2.map(|mut ros2| {
            let source = Ros2Source::start(&ros2, |_| {})?;
            // The node's own name stays free for a node that listens.
            ros2.args = ros2.args.renamed("squealcast_replay");
            anyhow::Ok((source, Ros2::start(&ros2, Parameters::none(), |_| {}, |_| {})?))
        });
        Ok(Self {
            shm: shm.context("shared memory; --no-shm stays off it")?,
            ros2: ros2.transpose().context("ROS 2; --no-ros stays off it")?,
        })
    }

    fn publish(&self, payload: &Payload) -> anyhow::Result<()> {
        if let Some((inputs, predictions, vibrations)) = &self.shm {
            match payload {
                Payload::OperatingPoint(message) => drop(inputs.publish(message)?),
                Payload::Prediction(message) => drop(predictions.publish(message)?),
                Payload::Vibration(message) => drop(vibrations.publish(message)?),
                _ => {}
            }
        }
        if let Some((inputs, others)) = &self.ros2 {
            match payload {
                Payload::OperatingPoint(message) => inputs.publish(message)?,
                Payload::Prediction(message) => others.publish_prediction(message)?,
                Payload::SessionEvent(message) => others.publish_session_event(message)?,
                Payload::RigInfo(message) => others.publish_rig(message)?,
                Payload::Sensitivity(message) => others.publish_sensitivity(message)?,
                Payload::Diagnostics(message) => others.publish_diagnostics(message)?,
                Payload::Vibration(message) => inputs.publish_vibration(message)?,
            }
        }
        Ok(())
    }
}

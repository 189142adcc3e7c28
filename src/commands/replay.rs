use std::net::SocketAddr;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::{Duration, Instant};

use anyhow::{Context, ensure};
use clap::Args;
use clap::builder::PossibleValuesParser;

use super::buses::BusOptions;
use super::foxglove::{FoxgloveOption, announce};
use super::player::Player;
use super::recordings::{Recordings, without_predictions};
use super::{Outcome, failure, live, not_negative, positive, print, signals};
use crate::bus::ros_args::RosArgs;
use crate::foxglove::Playback;
use crate::msgs::schema::Topic;
use crate::msgs::{SessionEventKind, Time};
use crate::node::Watch;
use crate::offline::verify::{Charts, Verification, verify};
use crate::offline::verify_sound::{SoundVerification, recorded_settings, verify_sound};
use crate::recording::message::Payload;
use crate::recording::pace::{Due, Pacer, Pacing};
use crate::recording::reader::{Recorded, Recording};
use crate::recording::recorded_rig;
use crate::rig::Rig;

const EXAMPLES: &str = "\
Examples:
  squealcast replay recordings/ramp --rate 2  play it at double speed
  squealcast replay sessions --verify         predict all recordings again and compare";

/// Play a recording on live buses, or predict recordings again and compare
#[derive(Debug, Args)]
#[command(after_help = super::with_ros_args(EXAMPLES))]
pub struct Options {
    #[command(flatten)]
    recordings: Recordings,
    /// Predict again as fast as possible and compare with the recorded predictions; exit code 3 if they differ
    #[arg(long)]
    verify: bool,
    /// With --verify: predict with this rig instead of the recorded one
    #[arg(long, value_name = "RIG", requires = "verify")]
    rig: Option<String>,
    /// With --verify: build the chart anew instead of loading a stored one
    #[arg(long, requires = "verify")]
    no_chart_cache: bool,
    /// Seconds to wait for a first reader; after it, playing begins once no new one appears for half a second; 0 plays
    /// at once
    #[arg(long, value_name = "S", value_parser = not_negative, default_value = "5")]
    wait: f64,
    /// Playback speed; 2 plays twice as fast
    #[arg(long, value_name = "R", value_parser = positive, default_value = "1")]
    rate: f64,
    /// Start again at the end, until stopped. Stamps keep increasing: each round adds the length of the previous ones
    #[arg(long = "loop")]
    repeat: bool,
    /// Recorded seconds to skip at the start
    #[arg(long, value_name = "S", value_parser = not_negative, default_value = "0")]
    start_offset: f64,
    /// Recorded seconds to play [default: to the end]
    #[arg(long, value_name = "S", value_parser = positive)]
    playback_duration: Option<f64>,
    /// Topics to play [default: all of the node's]
    #[arg(long, value_name = "TOPIC", num_args = 1.., value_parser = topics())]
    topics: Vec<String>,
    #[command(flatten)]
    foxglove: FoxgloveOption,
    /// Print log lines instead of a live table, even on a terminal
    #[arg(long)]
    plain: bool,
    #[command(flatten)]
    buses: BusOptions,
}

/// Recorded time between two rounds of a repeated recording.
const BETWEEN_ROUNDS_NS: u64 = 10_000_000;

/// The names of all topics, for clap.
fn topics() -> PossibleValuesParser {
    PossibleValuesParser::new(Topic::ALL.map(Topic::name))
}

impl Options {
    pub fn run(self, ros_args: RosArgs) -> anyhow::Result<Outcome> {
        match self.foxglove.foxglove {
            _ if self.verify => self.verify_all(),
            Some(address) => self.serve(address),
            None => self.play(ros_args),
        }
    }

    /// Verifies all recordings; one that cannot be verified does not prevent the others.
    fn verify_all(&self) -> anyhow::Result<Outcome> {
        let paths = self.recordings.paths()?;
        if let [path] = &paths[..] {
            return self.verify(path);
        }
        let (mut outcome, mut failed) = (Outcome::Done, 0);
        for path in &paths {
            print(&format!("{}: ", path.display()))?;
            match self.verify(path) {
                Ok(found) => outcome = outcome.max(found),
                Err(error) => {
                    print("not verified\n")?;
                    note!("error: {}", failure(&error));
                    failed += 1;
                }
            }
        }
        ensure!(failed == 0, "{failed} of {} recordings could not be verified", paths.len());
        Ok(outcome)
    }

    fn verify(&self, path: &Path) -> anyhow::Result<Outcome> {
        let recording = self.recordings.open(path)?;
        if recording.topics().name_of(Topic::Prediction).is_none() {
            return Err(without_predictions(path, &recording));
        }
        let rig = match &self.rig {
            Some(rig) => Rig::load(rig)?,
            None => recorded_rig(&recording)?,
        };
        if let Some(split) = recording.session_metadata("split_index").filter(|&split| split != "0") {
            note!(
                "begins in the middle of a session (file {split}): reuse and the hysteresis of SQUEAL begin anew; give the \
                 directory of all its files for the whole"
            );
        }
        let charts = if self.no_chart_cache { Charts::Anew } else { Charts::Kept };
        let started = Instant::now();
        let found = verify(&recording, &Arc::new(rig), charts)?;
        for damage in found.damage.iter().filter(|damage| !recording.damage().contains(damage)) {
            note!("damaged: {damage}");
        }
        print(&report(&found, started.elapsed()))?;
        let sound = verify_sound(&recording, recorded_settings(&recording));
        if let Some(sound) = &sound {
            print(&report_sound(sound))?;
        }
        let agrees = found.agrees() && sound.is_none_or(|sound| sound.agrees());
        let lost = recording.damage().iter().chain(&found.damage).any(|damage| damage.damage.loses_data);
        Ok(if agrees && !lost { Outcome::Done } else { Outcome::Differences })
    }

    /// Plays for Foxglove alone, as its playback bar says.
    fn serve(&self, address: SocketAddr) -> anyhow::Result<Outcome> {
        let (path, recording) = self.recordings.only()?;
        let name = format!("squealcast {}", path.file_name().unwrap_or_default().display());
        let playback = Playback::start(address, &name, &recording)?;
        let stopped = Arc::new(AtomicBool::new(false));
        let stop = stopped.clone();
        signals::on_stop(move || stop.store(true, Ordering::Relaxed))?;
        announce(address, playback.port());
        playback.run(&recording, &stopped);
        Ok(Outcome::Done)
    }

    fn play(&self, ros_args: RosArgs) -> anyhow::Result<Outcome> {
        let (path, recording) = self.recordings.only()?;
        let recording = &recording;
        let mut player = Player::join(&self.buses.resolve(ros_args)?)?;
        let first = recording.messages().next().context("the recording is empty")?;
        let stopped = Arc::new(AtomicBool::new(false));
        let stop = stopped.clone();
        signals::on_stop(move || stop.store(true, Ordering::Relaxed))?;
        self.wait(recording, &player, &stopped);
        let watch = Watch::default();
        let played = Arc::new(AtomicU64::new(0));
        let form = if self.plain { live::Form::Lines } else { live::Form::Table };
        let shown = live::show(frame(&path, recording, &played, &stopped), watch.clone(), form);
        let done = self.play_rounds(recording, first.log_time_ns, &mut player, &watch, &played, &stopped);
        shown.stop();
        done?;
        note!("played {} messages", played.load(Ordering::Relaxed));
        Ok(Outcome::Done)
    }

    /// Whether the messages of a topic are played.
    fn wants(&self, topic: Topic) -> bool {
        self.topics.is_empty() || self.topics.iter().any(|wanted| wanted == topic.name())
    }

    fn wait(&self, recording: &Recording, player: &Player, stopped: &AtomicBool) {
        if self.wait == 0.0 {
            return;
        }
        let played = |topic: &Topic| self.wants(*topic) && recording.topics().name_of(*topic).is_some();
        let topics: Vec<Topic> = Topic::ALL.into_iter().filter(played).collect();
        if topics.is_empty() {
            return;
        }
        note!("waiting up to {} s for a reader; --wait 0 plays at once", self.wait);
        // A time that exceeds `Duration` means no limit.
        let limit = Duration::try_from_secs_f64(self.wait).unwrap_or(Duration::MAX);
        if !player.wait_for_readers(&topics, limit, stopped) && !stopped.load(Ordering::Relaxed) {
            note!("no reader within {} s: playing all the same", self.wait);
        }
    }

    fn play_rounds(
        &self,
        recording: &Recording,
        first_ns: u64,
        player: &mut Player,
        watch: &Watch,
        played: &AtomicU64,
        stopped: &AtomicBool,
    ) -> anyhow::Result<()> {
        let pacing = Pacing {
            rate: self.rate,
            start_offset_s: self.start_offset,
            playback_duration_s: self.playback_duration,
            repeat: self.repeat,
        };
        let pacer = Pacer::new(pacing, first_ns)?;
        let started = Instant::now();
        let mut round_start_ns = Some(0);
        let mut shift_ns = 0;
        while let Some(start_ns) = round_start_ns {
            let mut last_ns = first_ns;
            let mut stamps = Span::default();
            for entry in recording.messages() {
                let Recorded::Known(mut payload) = entry.message else { continue };
                if !self.wants(payload.topic()) {
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
                if let Payload::OperatingPoint(input) = &payload {
                    stamps.take(input.header.stamp.as_ns());
                }
                if let Some(stamp) = payload.stamp_mut().filter(|_| shift_ns != 0) {
                    *stamp = Time::from_ns(stamp.as_ns().saturating_add(shift_ns));
                }
                player.publish(&payload)?;
                played.fetch_add(1, Ordering::Relaxed);
                match payload {
                    Payload::OperatingPoint(input) => watch.input(&input),
                    Payload::Prediction(prediction) => watch.prediction(&prediction),
                    Payload::SessionEvent(event) => match SessionEventKind::of(&event) {
                        Some(SessionEventKind::Silence) => watch.silence(),
                        Some(
                            SessionEventKind::Parameter
                            | SessionEventKind::StabilityMap
                            | SessionEventKind::Chart
                            | SessionEventKind::WindowEnds
                            | SessionEventKind::Temperature,
                        )
                        | None => {}
                    },
                    Payload::RigInfo(_)
                    | Payload::Sensitivity(_)
                    | Payload::Diagnostics(_)
                    | Payload::Vibration(_)
                    | Payload::Waveform(_)
                    | Payload::Heard(_)
                    | Payload::Temperature(_) => {}
                }
            }
            let nothing = played.load(Ordering::Relaxed) == 0;
            ensure!(!nothing, "nothing to play: no such messages in that part of the recording");
            // A node treats stamps that run backward as a fault, so each round continues where the previous one ended.
            let length_ns = stamps.length_ns().unwrap_or(last_ns.saturating_sub(first_ns));
            shift_ns = shift_ns.saturating_add_unsigned(length_ns.saturating_add(BETWEEN_ROUNDS_NS));
            round_start_ns = pacer.next_round(start_ns, last_ns, BETWEEN_ROUNDS_NS);
        }
        Ok(())
    }
}

/// Smallest and largest stamp of a round.
#[derive(Default)]
struct Span(Option<(i64, i64)>);

impl Span {
    fn take(&mut self, ns: i64) {
        let (low, high) = self.0.unwrap_or((ns, ns));
        self.0 = Some((low.min(ns), high.max(ns)));
    }

    fn length_ns(&self) -> Option<u64> {
        self.0.map(|(low, high)| high.abs_diff(low))
    }
}

/// Title, keys and footer of the live table of a replay.
fn frame(path: &Path, recording: &Recording, played: &Arc<AtomicU64>, stopped: &Arc<AtomicBool>) -> live::Frame {
    let file = path.file_name().unwrap_or(path.as_os_str()).to_string_lossy().into_owned();
    // Imported recordings contain no rig: every mode with negative damping then counts as unstable.
    let rig = recorded_rig(recording).ok();
    let title = rig.as_ref().map_or_else(|| file.clone(), |rig| format!("{}, {file}", rig.name));
    let (played, stopped) = (played.clone(), stopped.clone());
    live::Frame {
        title: vec!["squealcast replay".to_owned(), title],
        instability_threshold: rig.map_or(0.0, |rig| rig.instability_threshold),
        inputs: None,
        foot: Box::new(move |_| vec![format!("played {} messages", played.load(Ordering::Relaxed))]),
        quit: Box::new(move || stopped.store(true, Ordering::Relaxed)),
    }
}

fn report_sound(found: &SoundVerification) -> String {
    let SoundVerification { channels, samples, missing_samples, identical, different, missing, extra, described } =
        found;
    let mut text = format!(
        "sound: {samples} samples of {channels} channels, {missing_samples} missing; messages about squeals: {identical} \
         identical, {different} different, {missing} missing, {extra} extra\n"
    );
    for difference in described {
        text += &format!("  {difference}\n");
    }
    text
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

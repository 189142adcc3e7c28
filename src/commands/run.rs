use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use anyhow::Context;
use clap::Args;
use crossbeam_channel::{Receiver, Sender};

use super::buses::BusOptions;
use super::display::{DisplayOptions, ThresholdOption};
use super::{Outcome, live, signals};
use crate::bus::received::Received;
use crate::bus::ros_args::RosArgs;
use crate::bus::ros2::NODE_NAME;
use crate::bus::ros2::process::{Ros2Process, Sinks};
use crate::bus::shm::{ShmInput, ShmOutput, ShmSensitivity, ShmVibrationInput};
use crate::display::server::{About, Server};
use crate::files::chart_file::ChartFile;
use crate::node::status::InputSources;
use crate::node::{self, Incoming, Node, NodeName, Outputs, Shortcut, Watch};
use crate::recording::recorder::{Recorder, RecorderConfig, State};
use crate::rig::{EMBEDDED, Rig};
use crate::session::Counters;
use crate::session::settings::Settings;

/// Run the node on live buses
#[derive(Debug, Args)]
#[command(after_help = super::ROS_ARGS_HELP)]
pub struct Options {
    /// Rig file, or the name of an embedded rig
    #[arg(default_value = EMBEDDED[0].name, value_parser = super::RigName, hide_possible_values = true)]
    rig: String,
    #[command(flatten)]
    buses: BusOptions,
    #[command(flatten)]
    shown: NodeOptions,
}

/// Options shared by `run` and `demo`.
#[derive(Clone, Debug, Args)]
pub struct NodeOptions {
    /// Record the session into a new directory in this one
    #[arg(long, value_name = "DIR")]
    record: Option<PathBuf>,
    /// Solve for every condition instead of building a chart in the background
    #[arg(long)]
    no_chart: bool,
    /// Neither load nor store a chart on disk
    #[arg(long)]
    no_chart_cache: bool,
    /// Print log lines instead of a live table, even on a terminal
    #[arg(long)]
    plain: bool,
    #[command(flatten)]
    display: DisplayOptions,
    #[command(flatten)]
    threshold: ThresholdOption,
}

/// Time limit for the recorder to finish its files, so that a signal ends the program within 2 s.
const FINISH_WITHIN: Duration = Duration::from_millis(1500);

impl Options {
    pub fn run(self, ros_args: RosArgs) -> anyhow::Result<Outcome> {
        let rig = Arc::new(Rig::load(&self.rig)?);
        let (sender, receiver) = node::channel();
        serve(&rig, &self.buses, &self.shown, ros_args, Listening::ToTheBuses, (sender, receiver))
    }
}

/// Source of a node's inputs.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Listening {
    ToTheBuses,
    /// Inputs come from this process only.
    ToNobody,
}

/// Runs a node for `rig` until it is stopped.
pub fn serve(
    rig: &Arc<Rig>,
    buses: &BusOptions,
    options: &NodeOptions,
    ros_args: RosArgs,
    listening: Listening,
    (sender, receiver): (Sender<Incoming>, Receiver<Incoming>),
) -> anyhow::Result<Outcome> {
    if let Some(known) = &rig.reduction {
        note!("{}", known.summary());
    }
    // Before the recording begins, so that it is always finished when a signal arrives.
    let stop = sender.clone();
    signals::on_stop(move || drop(stop.send(Incoming::Stop)))?;
    let mut initial = Settings::for_rig(rig);
    let ros2 = buses.ros2(ros_args)?;
    let inputs = match listening {
        Listening::ToTheBuses => Some(buses.sources(ros2.as_ref())),
        Listening::ToNobody => None,
    };
    let watch = Watch::default();
    let about = About {
        simulated: listening == Listening::ToNobody,
        inputs: inputs.clone(),
        ..About::new(rig, "live", options.threshold.db())
    };
    // Before the recording begins: if the address is taken, no recording is left behind.
    let display = options.display.of_node(rig, &watch, about)?;
    let mut outputs = Outputs::default();
    let shortcut = Shortcut::new(sender.clone());
    if let Some(shm) = buses.shm() {
        outputs.shm = Some(ShmOutput::new(&shm).context("shared memory; --no-shm stays off it")?);
        if let Some(others) = outputs.other_nodes() {
            note!("warning: {others}");
        }
        outputs.shm_sensitivity = Some(ShmSensitivity::new(&shm)?);
        if listening == Listening::ToTheBuses {
            let lost = &outputs.lost_inputs;
            let (inputs, lost_inputs) = (shortcut.clone(), lost.clone());
            outputs.shm_input = Some(ShmInput::spawn_with_backlog(&shm, move |heard, more_waits| {
                lost_inputs.fetch_add(u64::from(!inputs.input(heard, more_waits)), Ordering::Relaxed);
            })?);
            let vibration = hear(listening, &sender, lost, Incoming::Vibration);
            outputs.shm_vibration = Some(ShmVibrationInput::spawn(&shm, vibration)?);
        }
    }
    if let Some(ros2) = ros2 {
        let declared: Vec<(&str, f64)> = initial.values().collect();
        let name = ros2.args.node_name(NODE_NAME);
        let namespace = ros2.args.namespace(&name, "/");
        outputs.node_name = NodeName::new(&namespace, &name);
        let (values, ignored) = ros2.args.parameters(&declared, &namespace, &name)?;
        for what in ignored {
            note!("ROS 2: {what}");
        }
        for (name, value) in &values {
            initial.set(name, *value)?;
        }
        let changes = sender.clone();
        let lost = &outputs.lost_inputs;
        let sinks = Sinks {
            input: Box::new(hear(listening, &sender, lost, Incoming::Input)),
            vibration: Box::new(hear(listening, &sender, lost, Incoming::Vibration)),
            parameter: Box::new(move |name, value| {
                // Does not block, because it runs on the thread that receives from the bus.
                if changes.try_send(Incoming::Parameter { name: name.to_owned(), value }).is_err() {
                    note!("parameter {name} = {value} is ignored: the node's queue is full");
                }
            }),
            fell: Box::new(|why| note!("the ROS 2 side fell and is started again: {why}")),
        };
        let started = Ros2Process::start(&ros2, values, sinks);
        outputs.ros2 = Some(started.context("ROS 2; --no-ros stays off it")?);
    }

    // The last step that can fail, so that a failed start leaves no recording.
    let recorder = options.record.as_ref().map(|directory| start_recorder(rig, directory)).transpose()?;
    outputs.recorder = recorder.as_ref().map(Recorder::handle);
    let shown = live::show(frame(rig, inputs, display.as_ref(), sender.clone()), watch.clone(), options.plain);
    let node = Node::new(rig.clone(), initial, outputs, sender.clone(), watch).with_shortcut(&shortcut);
    let kept = || ChartFile::locate(&rig.name, rig.path.as_deref(), &rig.content_hash);
    let kept = if options.no_chart_cache { None } else { kept() };
    let node = if options.no_chart { node } else { node.with_chart(kept, sender) };
    let outputs = node.run(&receiver);
    // The recording first: the view may be blocked by a reader that does not read.
    let outcome = recorder.map_or(Ok(Outcome::Done), finish);
    shown.stop();
    drop(display);
    drop(outputs);
    outcome
}

/// Title, keys and footer of the live table of a node for `rig`. `inputs` is `None` with a simulator. The title names
/// the page again, because the table covers earlier output.
fn frame(rig: &Rig, inputs: Option<InputSources>, display: Option<&Server>, node: Sender<Incoming>) -> live::Frame {
    let name = if inputs.is_some() { "squealcast" } else { "squealcast (simulated)" };
    let page = display.map(|display| format!("http://{}/", display.address()));
    live::Frame {
        title: [name.to_owned(), rig.name.clone()].into_iter().chain(page).collect(),
        instability_threshold: rig.instability_threshold,
        inputs,
        foot: Box::new(|snapshot| {
            let Counters { solved, charted, reused, faults, .. } = snapshot.counters;
            let passed_over = snapshot.passed_over;
            let mut counts = vec![
                format!("solved {solved}"),
                format!("from the chart {charted}"),
                format!("reused {reused}"),
                format!("faults {faults}"),
                format!("passed over {passed_over}"),
            ];
            let falls = snapshot.ros2_falls;
            counts.extend((falls > 0).then(|| format!("ROS 2 started again {falls}")));
            counts
        }),
        quit: Box::new(move || drop(node.send(Incoming::Stop))),
    }
}

/// Passes received messages to the node without blocking; messages that do not fit are lost and counted.
fn hear<M>(
    listening: Listening,
    sender: &Sender<Incoming>,
    lost: &Arc<AtomicU64>,
    incoming: fn(Received<M>) -> Incoming,
) -> impl FnMut(Received<M>) + Send + use<M> {
    let (sender, lost) = (sender.clone(), lost.clone());
    move |heard| {
        if listening == Listening::ToTheBuses && sender.try_send(incoming(heard)).is_err() {
            lost.fetch_add(1, Ordering::Relaxed);
        }
    }
}

fn start_recorder(rig: &Rig, directory: &std::path::Path) -> anyhow::Result<Recorder> {
    let config = RecorderConfig {
        rig_name: rig.name.clone(),
        rig_content_hash: rig.content_hash.clone(),
        rig_files: rig.files.clone(),
        ..RecorderConfig::new(directory)
    };
    let recorder = Recorder::start_when_possible(config)?;
    let status = recorder.status();
    match &status.state {
        State::Failed(why) => note!("not recording yet, trying again: {why}"),
        State::Recording | State::Finished => note!("recording into {}", status.directory.display()),
    }
    Ok(recorder)
}

fn finish(recorder: Recorder) -> anyhow::Result<Outcome> {
    let handle = recorder.handle();
    let finished = recorder.finish(FINISH_WITHIN);
    let status = handle.status();
    for recovered in &status.recovered {
        note!("recovered: {}", super::recover::describe(recovered));
    }
    for problem in &status.unrecovered {
        note!("not recovered: {problem}");
    }
    for interrupted in &status.interrupted {
        note!(
            "{} was cut short by a failure: the next start in this directory repairs it, or squealcast recover",
            interrupted.display()
        );
    }
    let finished = finished?;
    note!("recorded {} messages into {}", status.messages_written, finished.directory.display());
    match status.why_dropped() {
        Some(why) => {
            note!("{} messages were not recorded: {why}", status.dropped());
            Ok(Outcome::Differences)
        }
        None => Ok(Outcome::Done),
    }
}

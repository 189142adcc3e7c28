use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use anyhow::Context;
use clap::Args;

use super::buses::{BusOptions, NodeStart};
use super::config::{Config, Given};
use super::display::{DisplayOptions, ThresholdOption};
use super::foxglove::{FoxgloveOption, announce};
use super::hear::DetectionArgs;
use super::log::LogFormat;
use super::reload::Reload;
use super::service::Service;
use super::{Outcome, live, print, signals};
use crate::bus::Sink;
use crate::bus::lifecycle;
use crate::bus::ros_args::RosArgs;
use crate::display::server::{About, Server};
use crate::files::chart_file::ChartFile;
use crate::foxglove::LiveView;
use crate::node::status::InputSources;
use crate::node::{Inlet, Node, Outputs, SoundOptions, Watch};
use crate::offline::verify_sound::settings_metadata;
use crate::recording::recorder::{Recorder, RecorderConfig, State};
use crate::rig::{EMBEDDED, Rig};
use crate::session::Counters;
use crate::session::settings::{SettingError, Settings, validate};

const EXAMPLES: &str = "\
Examples:
  squealcast run my-rig.toml --record sessions              predict and record
  squealcast run --config /etc/squealcast/squealcast.toml   as a service does
  squealcast run tribometer --set warn_margin=0.1 --no-ros  warn earlier, on shared memory only
  squealcast run left.toml --ros-args -r __ns:=/left        one of several nodes";

/// Run the node on live buses
#[derive(Debug, Args)]
#[command(after_help = super::with_ros_args(EXAMPLES))]
pub struct Options {
    /// Rig file, or the name of an embedded rig
    #[arg(default_value = EMBEDDED[0].name, value_parser = super::RigName, hide_possible_values = true)]
    rig: String,
    /// Read options from this TOML file: each key is an option below with _ for -. Options given here win. SIGHUP reads it
    /// again
    #[arg(long, value_name = "FILE.toml")]
    config: Option<PathBuf>,
    /// Leave this key of the configuration file out, such as a flag that it sets; may be repeated
    #[arg(long, value_name = "KEY", requires = "config")]
    unset: Vec<String>,
    /// Read the configuration file and the rig, print the command line that they amount to, and exit
    #[arg(long)]
    check_config: bool,
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
    /// Start unconfigured, as a managed node of ROS 2: it waits for configure and activate (`ros2 lifecycle set`)
    #[arg(long)]
    managed: bool,
    /// Print log lines instead of a live table, even on a terminal
    #[arg(long)]
    plain: bool,
    /// How log lines are written: as text, or as JSON objects
    #[arg(long, value_enum, default_value = "text")]
    log_format: LogFormat,
    /// Start with this setting, such as warn_margin=0.1; may be repeated. Parameters of ROS 2 override it
    #[arg(long, value_name = "NAME=VALUE", value_parser = setting)]
    set: Vec<(String, f64)>,
    #[command(flatten)]
    foxglove: FoxgloveOption,
    #[command(flatten)]
    display: DisplayOptions,
    #[command(flatten)]
    threshold: ThresholdOption,
    #[command(flatten)]
    sound: SoundArgs,
}

/// The search for squeal in the samples that are received on /rig/waveform
#[derive(Clone, Copy, Debug, Args)]
struct SoundArgs {
    #[command(flatten)]
    detection: DetectionArgs,
    /// Record the received samples too
    #[arg(long, requires = "record")]
    record_sound: bool,
}

impl SoundArgs {
    fn options(&self) -> SoundOptions {
        SoundOptions { settings: self.detection.settings(), record_samples: self.record_sound }
    }
}

/// Time limit for the recorder to finish its files, so that a signal ends the program within 2 s.
const FINISH_WITHIN: Duration = Duration::from_millis(1500);

/// A setting of the session with its value, for clap.
fn setting(text: &str) -> Result<(String, f64), String> {
    let (name, value) = text.split_once('=').ok_or("expected NAME=VALUE")?;
    let value = value.parse().map_err(|_| format!("{value:?} is no number"))?;
    validate(name, value).map_err(|error| error.to_string())?;
    Ok((name.to_owned(), value))
}

impl Options {
    pub fn run(self, ros_args: RosArgs, file: Option<(Given, Config)>) -> anyhow::Result<Outcome> {
        let rig = Arc::new(Rig::load(&self.rig)?);
        if self.check_config {
            return self.check(&rig, ros_args, file);
        }
        let reload = file.map(|(given, config)| Reload::new(given, config, &rig));
        serve(&rig, &self.buses, &self.shown, ros_args, Inputs::Buses, reload)
    }

    /// Prints the command line that the configuration file and the present one amount to, if a node can start with it.
    fn check(&self, rig: &Rig, ros_args: RosArgs, file: Option<(Given, Config)>) -> anyhow::Result<Outcome> {
        let (given, config) = file.context("--check-config needs --config FILE")?;
        self.start(rig, ros_args)?;
        self.shown.display.addresses()?;
        let own = given.arguments.iter().skip(2).map(String::as_str).filter(|argument| *argument != "--check-config");
        let all: Vec<&str> = ["squealcast", "run"].into_iter().chain(own).chain(config.arguments()).collect();
        print(&format!("{}\n", all.join(" ")))?;
        Ok(Outcome::Done)
    }

    /// How a node starts for `rig` with these options.
    ///
    /// # Errors
    /// A parameter or an option of a bus that is not valid.
    pub fn start(&self, rig: &Rig, ros_args: RosArgs) -> anyhow::Result<NodeStart> {
        self.buses.resolve(ros_args)?.node(self.shown.settings(rig)?)
    }
}

impl NodeOptions {
    /// What is shown on standard output.
    fn form(&self) -> live::Form {
        match self.log_format {
            LogFormat::Json => live::Form::Json,
            LogFormat::Text if self.plain => live::Form::Lines,
            LogFormat::Text => live::Form::Table,
        }
    }

    /// The settings of a session for `rig`.
    ///
    /// # Errors
    /// A setting that is not valid.
    fn settings(&self, rig: &Rig) -> Result<Settings, SettingError> {
        let mut settings = Settings::for_rig(rig);
        for (name, value) in &self.set {
            settings.set(name, *value)?;
        }
        Ok(settings)
    }
}

/// Source of a node's inputs.
pub enum Inputs {
    Buses,
    /// This process: the function hands inputs to the node, whose state it can watch, on a thread of its own.
    Simulator(Box<dyn FnOnce(Inlet, Watch) + Send>),
}

/// Runs a node for `rig` until it is stopped. With `reload`, SIGHUP reads its configuration file again.
pub fn serve(
    rig: &Arc<Rig>,
    buses: &BusOptions,
    options: &NodeOptions,
    ros_args: RosArgs,
    inputs: Inputs,
    reload: Option<Reload>,
) -> anyhow::Result<Outcome> {
    options.log_format.begin();
    if let Some(known) = &rig.reduction {
        note!("{}", known.summary());
    }
    let buses = buses.resolve(ros_args)?;
    let NodeStart { name: node_name, settings, parameters } = buses.node(options.settings(rig)?)?;
    let watch = Watch::default();
    let (node, inlet) = Node::new(rig.clone(), settings, watch.clone());
    let state = if options.managed { lifecycle::State::Unconfigured } else { lifecycle::State::Active };
    let mut node = node.with_sound(options.sound.options()).starting_as(state);
    // Before the recording begins, so that it is always finished when a signal arrives.
    let stop = inlet.clone();
    let hangup = Reload::at_hangup(reload, settings, &watch, &inlet);
    signals::on_signals(hangup, move || stop.stop())?;
    let (sources, sink, simulate) = match inputs {
        Inputs::Buses => (Some(buses.sources()), inlet.clone(), None),
        Inputs::Simulator(simulate) => (None, inlet.for_parameters(), Some(simulate)),
    };
    let about = About {
        simulated: simulate.is_some(),
        inputs: sources.clone(),
        ..About::new(rig, "live", options.threshold.db())
    };
    // Before the recording begins: if the address is taken, no recording is left behind.
    let display = options.display.of_node(rig, &watch, about)?;
    let sink: Arc<dyn Sink> = Arc::new(sink);
    let foxglove = options.foxglove.foxglove.map(|address| {
        let view = LiveView::start(address, &format!("squealcast {}", rig.name), settings, sink.clone())?;
        announce(address, view.port());
        anyhow::Ok(view)
    });
    let foxglove = foxglove.transpose()?;
    let mut joined = buses.join_as_node(&parameters, state, &sink)?;
    for warning in joined.iter_mut().flat_map(|bus| bus.report().warnings) {
        note!("warning: {warning}");
    }

    // The last step that can fail, so that a failed start leaves no recording.
    let recorder =
        options.record.as_ref().map(|directory| start_recorder(rig, directory, options.sound.options())).transpose()?;
    let outputs = Outputs {
        buses: joined,
        recorder: recorder.as_ref().map(Recorder::handle),
        node_name,
        foxglove,
        ..Outputs::default()
    };
    let shown = live::show(frame(rig, sources, display.as_ref(), inlet.clone()), watch.clone(), options.form());
    if !options.no_chart {
        let kept = || ChartFile::locate(&rig.name, rig.path.as_deref(), &rig.content_hash);
        node = node.with_chart(if options.no_chart_cache { None } else { kept() });
    }
    if let Some(simulate) = simulate {
        let watch = watch.clone();
        std::thread::spawn(move || simulate(inlet, watch));
    }
    let service = Service::start(watch);
    let outputs = node.run(outputs);
    drop(service);
    // The recording first: the view may be blocked by a reader that does not read.
    let outcome = recorder.map_or(Ok(Outcome::Done), finish);
    shown.stop();
    drop(display);
    drop(outputs);
    outcome
}

/// Title, keys and footer of the live table of a node for `rig`. `inputs` is `None` with a simulator. The title names
/// the page again, because the table covers earlier output.
fn frame(rig: &Rig, inputs: Option<InputSources>, display: Option<&Server>, node: Inlet) -> live::Frame {
    let name = if inputs.is_some() { "squealcast" } else { "squealcast (simulated)" };
    let page = display.map(|display| format!("http://{}/", display.address()));
    live::Frame {
        title: [name.to_owned(), rig.name.clone()].into_iter().chain(page).collect(),
        instability_threshold: rig.instability_threshold,
        inputs,
        foot: Box::new(|snapshot| {
            let Counters { solved, charted, reused, faults, zero_terms: _, decoupled_modes: _, roots_beyond_band: _ } =
                snapshot.counters;
            let passed_over = snapshot.passed_over;
            let mut counts = vec![
                format!("solved {solved}"),
                format!("from the chart {charted}"),
                format!("reused {reused}"),
                format!("faults {faults}"),
                format!("passed over {passed_over}"),
            ];
            let restarts = snapshot.bus_restarts;
            let squeals = snapshot.squeals_in_sound;
            counts.extend((squeals > 0).then(|| format!("squeals in sound {squeals}")));
            counts.extend((restarts > 0).then(|| format!("ROS 2 started again {restarts}")));
            counts
        }),
        quit: Box::new(move || node.stop()),
    }
}

fn start_recorder(rig: &Rig, directory: &std::path::Path, sound: SoundOptions) -> anyhow::Result<Recorder> {
    let config = RecorderConfig {
        rig_name: rig.name.clone(),
        rig_content_hash: rig.content_hash.clone(),
        rig_files: rig.files.clone(),
        metadata: settings_metadata(sound.settings),
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

//! The commands, one per file. Exit codes and output are handled here.

mod against;
mod bench;
mod buses;
mod check;
mod completions;
mod config;
mod critical;
mod demo;
mod display;
mod engine;
mod format;
mod foxglove;
mod full;
mod hear;
mod identify;
mod import;
mod live;
mod log;
mod man;
mod map;
mod memory;
mod on_basis;
mod player;
mod predict;
mod predict_log;
mod recordings;
mod recover;
mod reduce;
mod reload;
mod replay;
mod report;
mod reproduce;
mod rigs;
mod ros2_side;
mod run;
mod score;
mod service;
mod signals;
mod simulate;
mod simulated_modes;
mod simulated_sound;
mod sound_files;
mod steps;
mod study;
mod sweep;
mod tribometer;
mod verify;
mod view;

pub use reduce::reduce_quietly;
pub use steps::Stopped;

use std::io::Write;
use std::path::Path;
use std::process::ExitCode;

use anyhow::Context;
use clap::builder::{PossibleValue, TypedValueParser};
use clap::{Args, Parser, Subcommand};

use crate::bus::ros_args::RosArgs;
use crate::files::whole_file::write_whole;
use crate::physics::OperatingPoint;
use crate::rig::{EMBEDDED, Limits, Rig};
use crate::text::terminal::printable;
use config::Given;

/// Shown below the options of commands that join ROS 2.
const ROS_ARGS_HELP: &str = "\
ROS 2 arguments follow --ros-args:
  -r, --remap FROM:=TO         Remap a topic, the node (__node) or its namespace (__ns)
  -p, --param NAME:=VALUE      Set a parameter
      --params-file FILE       Read parameters from a YAML file
      --log-level LEVEL        Set the level of the log";

/// The help of a command that joins ROS 2, above its examples.
fn with_ros_args(examples: &str) -> String {
    format!("{ROS_ARGS_HELP}\n\n{examples}")
}

const EXAMPLES: &str = "\
Examples:
  squealcast demo                                       a simulated session, with a page and a table
  squealcast rigs                                       the embedded rigs
  squealcast critical tribometer                        where it becomes unstable
  squealcast predict nine-dof-case-2 --mu 0.4           its modes at one operating point
  squealcast run my-rig.toml --record sessions          run the node and record";

/// Predicts friction-induced vibration of a pad-on-disc tribometer, live, from its operating conditions.
#[derive(Debug, Parser)]
#[command(name = "squealcast", version, propagate_version = true, max_term_width = 100, after_help = EXAMPLES)]
pub struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    Demo(demo::Options),
    Run(run::Options),
    Simulate(simulate::Options),
    Predict(predict::Options),
    Sweep(sweep::Options),
    Critical(critical::Options),
    Map(map::Options),
    Replay(replay::Options),
    View(view::Options),
    Report(report::Options),
    Import(import::Options),
    PredictLog(predict_log::Options),
    Hear(hear::Options),
    Score(score::Options),
    Recover(recover::Options),
    Rigs(rigs::Options),
    Check(check::Options),
    Study(study::Options),
    Identify(identify::Options),
    Bench(bench::Options),
    Tribometer(tribometer::Options),
    Reduce(reduce::Options),
    Full(full::Options),
    Verify(verify::Options),
    Reproduce(reproduce::Options),
    Completions(completions::Options),
    Man(man::Options),
    #[command(name = crate::bus::ros2::process::COMMAND, hide = true)]
    Ros2Side(ros2_side::Options),
}

/// Result of a command that did not fail.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Outcome {
    /// Exit code 0.
    Done,
    /// Finished, with differences or data loss: exit code 3.
    Differences,
}

/// Reads a configuration file of `run`, as at the start of a node and on SIGHUP.
///
/// # Errors
/// A file with which a node would not start.
pub fn read_config(file: &Path) -> anyhow::Result<()> {
    let arguments = ["squealcast", "run"].map(str::to_owned).to_vec();
    Given { arguments, ros_args: RosArgs::default() }.with_file(file)?;
    Ok(())
}

/// Runs the command line of this process. Exit codes: 0 done, 1 failure, 2 usage, 3 differences or data loss.
pub fn main() -> ExitCode {
    // Ends the process if it was started for that.
    completions::complete();
    let (ros_args, arguments) = match RosArgs::split(std::env::args()) {
        Ok(split) => split,
        Err(error) => {
            note!("error: {error}");
            return ExitCode::from(2);
        }
    };
    let given = Given { arguments, ros_args };
    // Exits with code 2 on wrong usage.
    let (cli, ros_args, config) = match given.parse() {
        Ok(parsed) => parsed,
        Err(error) => {
            note!("error: {error}");
            return ExitCode::from(2);
        }
    };
    if let Err(error) = signals::survive_file_size_limit() {
        note!("a file that grows beyond its limit will end this: {error}");
    }
    let result = match cli.command {
        Command::Demo(options) => options.run(ros_args),
        Command::Run(options) => options.run(ros_args, config.map(|config| (given, config))),
        Command::Simulate(options) => options.run(ros_args),
        Command::Replay(options) => options.run(ros_args),
        Command::View(options) => options.run(),
        Command::Report(options) => options.run(),
        Command::Import(options) => options.run(),
        Command::PredictLog(options) => options.run(),
        Command::Hear(options) => options.run(),
        Command::Score(options) => options.run(),
        Command::Recover(options) => options.run(),
        Command::Predict(options) => options.run(),
        Command::Sweep(options) => options.run(),
        Command::Critical(options) => options.run(),
        Command::Map(options) => options.run(),
        Command::Rigs(options) => options.run(),
        Command::Check(options) => options.run(),
        Command::Study(options) => options.run(),
        Command::Identify(options) => options.run(),
        Command::Bench(options) => options.run(),
        Command::Tribometer(options) => options.run(),
        Command::Reduce(options) => options.run(),
        Command::Full(options) => options.run(),
        Command::Verify(options) => options.run(),
        Command::Reproduce(options) => options.run(),
        Command::Completions(options) => options.run(),
        Command::Man(options) => options.run(),
        Command::Ros2Side(options) => options.run(),
    };
    match result {
        Ok(Outcome::Done) => ExitCode::SUCCESS,
        Ok(Outcome::Differences) => ExitCode::from(3),
        Err(error) => {
            note!("error: {}", failure(&error));
            ExitCode::FAILURE
        }
    }
}

/// The message of an error with those of its causes; a cause with which the previous message ends is not repeated.
fn failure(error: &anyhow::Error) -> String {
    let mut text = String::new();
    for cause in error.chain().map(ToString::to_string).filter(|cause| !cause.is_empty()) {
        if !text.ends_with(&cause) {
            text += if text.is_empty() { "" } else { ": " };
            text += &cause;
        }
    }
    text
}

/// The operating point: each condition by option, else the reference of the rig or full model.
#[derive(Clone, Copy, Debug, Args)]
struct Conditions {
    /// Friction coefficient [default: the reference of RIG]
    #[arg(long, value_name = "MU", value_parser = finite, allow_negative_numbers = true)]
    mu: Option<f64>,
    #[command(flatten)]
    load_and_speed: LoadAndSpeed,
}

#[derive(Clone, Copy, Debug, Args)]
struct LoadAndSpeed {
    /// Normal load in N [default: the reference of RIG]
    #[arg(long, value_name = "N", value_parser = finite, allow_negative_numbers = true)]
    load: Option<f64>,
    /// Disc speed in rad/s; negative turns the other way [default: the reference of RIG]
    #[arg(long, value_name = "RAD_S", value_parser = finite, allow_negative_numbers = true)]
    speed: Option<f64>,
}

/// The temperature at which a rig is predicted.
#[derive(Clone, Copy, Debug, Args)]
struct AtTemperature {
    /// Temperature of the contact in °C, of a rig with [temperature] [default: the reference of RIG]
    #[arg(long = "temperature", value_name = "C", value_parser = finite, allow_negative_numbers = true)]
    temperature_c: Option<f64>,
}

impl AtTemperature {
    /// `rig` at this temperature.
    ///
    /// # Errors
    /// A rig that does not follow the temperature, or a temperature out of range.
    fn of(self, rig: Rig) -> anyhow::Result<Rig> {
        Ok(match self.temperature_c {
            Some(celsius) => rig.at_temperature(celsius)?,
            None => rig,
        })
    }
}

impl Conditions {
    /// The operating point; an error if it is outside the `limits` of the rig or model called `name`.
    ///
    /// # Errors
    /// A condition outside the limits.
    fn point(&self, name: &str, reference: &OperatingPoint, limits: &Limits) -> anyhow::Result<OperatingPoint> {
        let LoadAndSpeed { load, speed } = self.load_and_speed;
        let point = OperatingPoint {
            normal_load_n: load.unwrap_or(reference.normal_load_n),
            disc_speed_rad_s: speed.unwrap_or(reference.disc_speed_rad_s),
            friction_coefficient: self.mu.unwrap_or(reference.friction_coefficient),
        };
        limits.check(&point).with_context(|| name.to_owned())?;
        Ok(point)
    }
}

impl LoadAndSpeed {
    /// The load and speed at which friction coefficients are searched; an error if they are outside the limits of
    /// `rig`.
    ///
    /// # Errors
    /// A condition outside the limits.
    fn point(self, rig: &Rig) -> anyhow::Result<OperatingPoint> {
        Conditions { mu: None, load_and_speed: self }.point(&rig.name, &rig.reference, &rig.limits)
    }
}

/// Parser for a rig: accepts any text, and offers the names of the embedded rigs to completion scripts.
#[derive(Clone, Copy, Debug)]
struct RigName;

impl TypedValueParser for RigName {
    type Value = String;

    fn parse_ref(
        &self,
        command: &clap::Command,
        argument: Option<&clap::Arg>,
        value: &std::ffi::OsStr,
    ) -> Result<String, clap::Error> {
        clap::builder::StringValueParser::new().parse_ref(command, argument, value)
    }

    fn possible_values(&self) -> Option<Box<dyn Iterator<Item = PossibleValue> + '_>> {
        Some(Box::new(EMBEDDED.iter().map(|rig| PossibleValue::new(rig.name).help(rig.about))))
    }
}

/// A finite number, for clap.
fn finite(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(value) if value.is_finite() => Ok(value),
        Ok(value) => Err(format!("{value} is not finite")),
        Err(error) => Err(error.to_string()),
    }
}

/// A finite number of at least 0, for clap.
fn not_negative(text: &str) -> Result<f64, String> {
    let value = finite(text)?;
    if value >= 0.0 { Ok(value) } else { Err(format!("{value} is less than 0")) }
}

/// A finite number of more than 0, for clap.
fn positive(text: &str) -> Result<f64, String> {
    let value = finite(text)?;
    if value > 0.0 { Ok(value) } else { Err(format!("{value} is not more than 0")) }
}

/// Writes to standard output with control characters escaped. A closed reader is not an error.
fn print(text: &str) -> anyhow::Result<()> {
    print_bytes(printable(text).as_bytes())
}

fn print_bytes(bytes: &[u8]) -> anyhow::Result<()> {
    let mut stdout = std::io::stdout().lock();
    match stdout.write_all(bytes).and_then(|()| stdout.flush()) {
        Err(error) if error.kind() != std::io::ErrorKind::BrokenPipe => Err(error.into()),
        _ => Ok(()),
    }
}

/// Writes a file completely or not at all; `-` is standard output.
fn write_file(path: &std::path::Path, bytes: &[u8]) -> anyhow::Result<()> {
    if path == std::path::Path::new("-") {
        return print_bytes(bytes);
    }
    Ok(write_whole(path, |out| out.write_all(bytes))?)
}

#[cfg(test)]
mod tests {
    use clap::CommandFactory;

    use super::*;

    /// The words of a command line; quotes hold some together.
    fn words(line: &str) -> Vec<String> {
        let parts = line.split('\'').enumerate();
        parts
            .flat_map(|(k, part)| if k % 2 == 1 { vec![part] } else { part.split_whitespace().collect() })
            .map(str::to_owned)
            .collect()
    }

    /// Every command, those added later included, ends its help with examples of itself that its options allow.
    #[test]
    fn the_help_of_every_command_ends_with_valid_examples() {
        let mut cli = Cli::command();
        cli.build();
        let commands = cli.get_subcommands().filter(|command| !command.is_hide_set() && command.get_name() != "help");
        for command in commands {
            let name = command.get_name();
            let help = command.clone().render_help().to_string();
            let (_, examples) =
                help.split_once("\nExamples:\n").unwrap_or_else(|| panic!("{name}: no examples\n{help}"));
            assert!(!examples.trim().is_empty(), "{name}");
            for line in examples.lines() {
                assert!(line.chars().count() < 99, "{name}: longer than a line of help: {line:?}");
                let line = line.trim_start();
                let (example, said) = line.split_once("  ").unwrap_or_else(|| panic!("{name}: {line:?} says nothing"));
                assert!(
                    example.starts_with(&format!("squealcast {name}")) && !said.trim().is_empty(),
                    "{name}: {line:?}"
                );
                let shell = example.split(" > ").next().unwrap_or_default();
                let (_, arguments) = RosArgs::split(words(shell)).unwrap_or_else(|error| panic!("{example}: {error}"));
                Cli::try_parse_from(arguments).unwrap_or_else(|error| panic!("{example}: {error}"));
            }
        }
    }
}

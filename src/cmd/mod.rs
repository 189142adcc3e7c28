//! The commands, one file each; exit codes and output in one place.

mod bench;
mod buses;
mod check;
mod completions;
mod critical;
mod demo;
mod display;
mod format;
mod full;
mod identify;
mod import;
mod live;
mod memory;
mod on_basis;
mod player;
mod predict;
mod predict_log;
mod recordings;
mod recover;
mod reduce;
mod replay;
mod report;
mod reproduce;
mod ros2_side;
mod run;
mod signals;
mod simulate;
mod steps;
mod sweep;
mod tribometer;
mod verify;
mod view;

use std::io::Write;
use std::process::ExitCode;

use clap::{Args, Parser, Subcommand};

use crate::io::ros_args::RosArgs;
use crate::io::whole_file::write_whole;
use crate::physics::OperatingPoint;
use crate::rig::Rig;
use crate::terminal::printable;

/// Predicts friction-induced vibration of a pad-on-disc tribometer, live, from its operating conditions.
#[derive(Debug, Parser)]
#[command(name = "squealcast", version, max_term_width = 100)]
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
    Replay(replay::Options),
    View(view::Options),
    Report(report::Options),
    Import(import::Options),
    PredictLog(predict_log::Options),
    Recover(recover::Options),
    Check(check::Options),
    Identify(identify::Options),
    Bench(bench::Options),
    Tribometer(tribometer::Options),
    Reduce(reduce::Options),
    Full(full::Options),
    Verify(verify::Options),
    Reproduce(reproduce::Options),
    Completions(completions::Options),
    #[command(name = crate::io::ros2::process::COMMAND, hide = true)]
    Ros2Side(ros2_side::Options),
}

/// What became of a command that did not fail.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Outcome {
    /// Exit code 0.
    Done,
    /// Finished, with differences or data loss: exit code 3.
    Differences,
}

/// Runs the command line of this process. Exit codes: 0 done, 1 failure, 2 usage, 3 differences or data loss.
pub fn main() -> ExitCode {
    let (ros_args, args) = match RosArgs::split(std::env::args()) {
        Ok(split) => split,
        Err(error) => {
            note!("error: {error}");
            return ExitCode::from(2);
        }
    };
    let cli = Cli::parse_from(args); // leaves with code 2 on wrong usage
    if let Err(error) = signals::survive_file_size_limit() {
        note!("a file that grows beyond its limit will end this: {error}");
    }
    let result = match cli.command {
        Command::Demo(options) => options.run(ros_args),
        Command::Run(options) => options.run(ros_args),
        Command::Simulate(options) => options.run(ros_args),
        Command::Replay(options) => options.run(ros_args),
        Command::View(options) => options.run(),
        Command::Report(options) => options.run(),
        Command::Import(options) => options.run(),
        Command::PredictLog(options) => options.run(),
        Command::Recover(options) => options.run(),
        Command::Predict(options) => options.run(),
        Command::Sweep(options) => options.run(),
        Command::Critical(options) => options.run(),
        Command::Check(options) => options.run(),
        Command::Identify(options) => options.run(),
        Command::Bench(options) => options.run(),
        Command::Tribometer(options) => options.run(),
        Command::Reduce(options) => options.run(),
        Command::Full(options) => options.run(),
        Command::Verify(options) => options.run(),
        Command::Reproduce(options) => options.run(),
        Command::Completions(options) => options.run(),
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

/// An error with its causes; a cause that the message before already ends with is not repeated.
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

/// Where on the rig's map: each value by option, else the rig's reference.
#[derive(Clone, Copy, Debug, Args)]
struct Conditions {
    /// Friction coefficient [default: the rig's reference]
    #[arg(long, value_name = "MU", value_parser = finite, allow_negative_numbers = true)]
    mu: Option<f64>,
    #[command(flatten)]
    load_and_speed: LoadAndSpeed,
}

#[derive(Clone, Copy, Debug, Args)]
struct LoadAndSpeed {
    /// Normal load in N [default: the rig's reference]
    #[arg(long, value_name = "N", value_parser = finite, allow_negative_numbers = true)]
    load: Option<f64>,
    /// Disc speed in rad/s; negative turns the other way [default: the rig's reference]
    #[arg(long, value_name = "RAD_S", value_parser = finite, allow_negative_numbers = true)]
    speed: Option<f64>,
}

impl Conditions {
    fn point(&self, rig: &Rig) -> OperatingPoint {
        let point = self.load_and_speed.point(rig);
        point.with_friction(self.mu.unwrap_or(rig.reference.friction_coefficient))
    }
}

impl LoadAndSpeed {
    fn point(&self, rig: &Rig) -> OperatingPoint {
        OperatingPoint {
            normal_load_n: self.load.unwrap_or(rig.reference.normal_load_n),
            disc_speed_rad_s: self.speed.unwrap_or(rig.reference.disc_speed_rad_s),
            friction_coefficient: rig.reference.friction_coefficient,
        }
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

/// Writes to standard output, control characters as escapes; a reader that has gone away is no error.
fn print(text: &str) -> anyhow::Result<()> {
    let mut stdout = std::io::stdout().lock();
    match stdout.write_all(printable(text).as_bytes()).and_then(|()| stdout.flush()) {
        Err(error) if error.kind() != std::io::ErrorKind::BrokenPipe => Err(error.into()),
        _ => Ok(()),
    }
}

/// Writes a file, whole or not at all.
fn write_file(path: &std::path::Path, bytes: &[u8]) -> anyhow::Result<()> {
    Ok(write_whole(path, |out| out.write_all(bytes))?)
}

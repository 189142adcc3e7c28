use std::path::PathBuf;

use clap::Args;

use super::sound_files::SoundFileArgs;
use super::{Outcome, finite, positive};
use crate::import::tribometer_log::{Field, LogOptions, TribometerLog};
use crate::import::{ReadLog, import_with_sound, read_log};

const EXAMPLES: &str = "\
Examples:
  squealcast import test.csv -o test.mcap                               a log with named columns
  squealcast import test.csv -o test.mcap --column normal_load_n=Kraft  another column";

/// Convert a tribometer log, and samples taken beside it, to a recording
#[derive(Debug, Args)]
#[command(after_help = EXAMPLES)]
pub struct Options {
    /// Delimited text with named columns, units in their names
    session: PathBuf,
    /// The recording to write
    #[arg(short, long, value_name = "FILE")]
    output: PathBuf,
    #[command(flatten)]
    log: LogArgs,
    #[command(flatten)]
    sound: SoundFileArgs,
    /// Replace an existing recording
    #[arg(long)]
    overwrite: bool,
}

/// How a tribometer's log is read
#[derive(Clone, Debug, Args)]
pub struct LogArgs {
    /// Take a quantity from a column by its name: time_s, normal_load_n, disc_speed_rad_s, friction_coefficient,
    /// friction_force_n or temperature_c. `-NAME` reverses the sign, as of a load that is negative where it presses
    #[arg(long = "column", value_name = "QUANTITY=NAME", value_parser = column)]
    columns: Vec<(Field, String)>,
    /// A quantity that is not in the log, of the same value in every line: normal_load_n, disc_speed_rad_s,
    /// friction_coefficient or temperature_c
    #[arg(long = "constant", value_name = "QUANTITY=VALUE", value_parser = constant)]
    constants: Vec<(Field, f64)>,
    /// Distance from the disc's axis at which a sliding speed in m/s was measured, m
    #[arg(long, value_name = "M", value_parser = positive)]
    radius_m: Option<f64>,
    /// Join the steps of a test whose times begin again with each step: one interval after the line before
    #[arg(long)]
    times_restart: bool,
    /// The decimal sign, instead of detecting it
    #[arg(long, value_name = ", or .", value_parser = decimal)]
    decimal: Option<char>,
    /// Skip invalid lines instead of refusing the log
    #[arg(long)]
    skip_bad_lines: bool,
}

fn field(quantity: &str) -> Result<Field, String> {
    let known: Vec<&str> = Field::ALL.iter().map(|field| field.name()).collect();
    Field::from_name(quantity).ok_or_else(|| format!("no quantity `{quantity}`; there are {}", known.join(", ")))
}

fn column(text: &str) -> Result<(Field, String), String> {
    let (quantity, name) = text.split_once('=').ok_or("expected QUANTITY=NAME")?;
    Ok((field(quantity)?, name.to_owned()))
}

fn constant(text: &str) -> Result<(Field, f64), String> {
    let (quantity, value) = text.split_once('=').ok_or("expected QUANTITY=VALUE")?;
    Ok((field(quantity)?, finite(value)?))
}

fn decimal(text: &str) -> Result<char, String> {
    match text {
        "," => Ok(','),
        "." => Ok('.'),
        _ => Err("expected , or .".to_owned()),
    }
}

impl LogArgs {
    /// The options of the log reader.
    pub fn options(&self) -> LogOptions {
        LogOptions {
            columns: self.columns.clone(),
            constants: self.constants.clone(),
            radius_m: self.radius_m,
            times_restart: self.times_restart,
            decimal: self.decimal,
            skip_bad_lines: self.skip_bad_lines,
            ..Default::default()
        }
    }
}

impl Options {
    pub fn run(self) -> anyhow::Result<Outcome> {
        let (bytes, log) = read_log(&self.session, &self.log.options())?;
        let mut sound = self.sound.open(&self.session, log.samples.first().map_or(0, |first| first.stamp_ns), None)?;
        let read = ReadLog { path: self.session.clone(), bytes, log };
        let imported = import_with_sound(read, &mut sound.blocks, &self.output, self.overwrite)?;
        let outcome = describe(&imported.log).max(sound.outcome);
        let path = imported.path.display();
        let points = imported.log.samples.len() as u64;
        note!("{path}: {points} operating points");
        let temperatures = imported.log.samples.iter().filter(|sample| sample.temperature_c.is_some()).count() as u64;
        if temperatures > 0 {
            note!("{path}: {temperatures} temperatures");
        }
        if imported.messages > points + temperatures {
            note!("{path}: {} blocks of samples", imported.messages - points - temperatures);
        }
        note!("to predict them: squealcast predict-log {path} --rig RIG -o DIR");
        Ok(outcome)
    }
}

/// Reports what was read from a log and what was skipped.
pub fn describe(log: &TribometerLog) -> Outcome {
    for column in &log.columns {
        let unit = match column.unit.as_str() {
            "" | "-" | "1" => String::new(),
            unit => format!(" in {unit}"),
        };
        let sign = if column.reversed { ", with the opposite sign" } else { "" };
        note!("{} from column {:?}{unit}{sign}", column.field, column.header);
    }
    for (field, value) in &log.constants {
        note!("{field} = {value} in every line");
    }
    if !log.left_out.is_empty() {
        let names: Vec<String> = log.left_out.iter().map(|name| format!("{name:?}")).collect();
        note!("left out: {}", names.join(", "));
    }
    if log.skipped == 0 {
        return Outcome::Done;
    }
    let first = log.first_skipped.as_ref().map(|error| format!(", the first: {error}")).unwrap_or_default();
    note!("{} {} left out{first}", log.skipped, if log.skipped == 1 { "line" } else { "lines" });
    Outcome::Differences
}

use std::path::PathBuf;

use clap::Args;

use super::Outcome;
use crate::io::import::{ImportOptions, import};
use crate::io::tribometer_log::{Field, LogOptions};

/// Make a recording of a tribometer's log
#[derive(Debug, Args)]
pub struct Options {
    /// Delimited text with named columns, units in their names
    session: PathBuf,
    /// The recording to write
    #[arg(short, long, value_name = "FILE")]
    output: PathBuf,
    /// Take a quantity from a column by its name: time_s, normal_load_n, disc_speed_rad_s, friction_coefficient or
    /// friction_force_n
    #[arg(long = "column", value_name = "QUANTITY=NAME", value_parser = column)]
    columns: Vec<(Field, String)>,
    /// The decimal sign, instead of finding out
    #[arg(long, value_name = ", or .", value_parser = decimal)]
    decimal: Option<char>,
    /// Leave bad lines out instead of refusing the log
    #[arg(long)]
    skip_bad_lines: bool,
    /// Replace a recording of that name
    #[arg(long)]
    overwrite: bool,
}

fn column(text: &str) -> Result<(Field, String), String> {
    let (quantity, name) = text.split_once('=').ok_or("expected QUANTITY=NAME")?;
    let known: Vec<&str> = Field::ALL.iter().map(|field| field.name()).collect();
    let field = Field::from_name(quantity)
        .ok_or_else(|| format!("no quantity `{quantity}`; there are {}", known.join(", ")))?;
    Ok((field, name.to_owned()))
}

fn decimal(text: &str) -> Result<char, String> {
    match text {
        "," => Ok(','),
        "." => Ok('.'),
        _ => Err("expected , or .".to_owned()),
    }
}

impl Options {
    pub fn run(self) -> anyhow::Result<Outcome> {
        let log = LogOptions {
            columns: self.columns,
            decimal: self.decimal,
            skip_bad_lines: self.skip_bad_lines,
            ..Default::default()
        };
        let imported = import(&self.session, &self.output, &ImportOptions { log, overwrite: self.overwrite })?;
        note!("{}: {} operating points", imported.path.display(), imported.messages);
        if imported.log.skipped == 0 {
            return Ok(Outcome::Done);
        }
        let first = imported.log.first_skipped.map(|error| format!(", the first: {error}")).unwrap_or_default();
        note!("{} lines left out{first}", imported.log.skipped);
        Ok(Outcome::Differences)
    }
}

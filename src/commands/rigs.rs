use clap::Args;

use super::{Outcome, print};
use crate::rig::EMBEDDED;

const EXAMPLES: &str = "\
Examples:
  squealcast rigs  names and descriptions";

/// List the embedded rigs
#[derive(Debug, Args)]
#[command(after_help = EXAMPLES)]
pub struct Options {}

impl Options {
    pub fn run(self) -> anyhow::Result<Outcome> {
        let width = EMBEDDED.iter().map(|rig| rig.name.len()).max().unwrap_or(0);
        let lines: String = EMBEDDED.iter().map(|rig| format!("{:width$}  {}\n", rig.name, rig.about)).collect();
        print(&lines)?;
        Ok(Outcome::Done)
    }
}

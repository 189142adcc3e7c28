use clap::Args;

use super::{Outcome, RigName, print};
use crate::full_model::FullModelFile;
use crate::rig::{Rig, RigError};

const EXAMPLES: &str = "\
Examples:
  squealcast check my-rig.toml  what a rig file contains
  squealcast check tribometer   an embedded rig";

/// Validate a rig file or a full model and describe its content
#[derive(Debug, Args)]
#[command(after_help = EXAMPLES)]
pub struct Options {
    /// Rig file, full model, or the name of an embedded rig
    #[arg(value_parser = RigName, hide_possible_values = true)]
    rig: String,
}

impl Options {
    pub fn run(self) -> anyhow::Result<Outcome> {
        let path = std::path::Path::new(&self.rig);
        let described = if FullModelFile::is_one(path) {
            FullModelFile::load(path)?.describe()
        } else {
            match Rig::load(&self.rig) {
                // A system too large for a rig is checked as a full model.
                Err(RigError::Range { field, .. }) if field == "system.modes" => FullModelFile::load(path)?.describe(),
                rig => rig?.describe(),
            }
        };
        print(&format!("{described}\n"))?;
        Ok(Outcome::Done)
    }
}

use clap::Args;

use super::{Outcome, print};
use crate::rig::Rig;

/// Validate a rig file and say what it holds
#[derive(Debug, Args)]
pub struct Options {
    /// Rig file, or the name of an embedded rig
    rig: String,
}

impl Options {
    pub fn run(self) -> anyhow::Result<Outcome> {
        print(&format!("{}\n", Rig::load(&self.rig)?.describe()))?;
        Ok(Outcome::Done)
    }
}

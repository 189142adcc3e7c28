use std::path::PathBuf;

use clap::Args;

use super::{Outcome, print};
use crate::recording::recover::{self, Recovery, recover};

const EXAMPLES: &str = "\
Examples:
  squealcast recover sessions  what an interruption left in a folder";

/// Repair an interrupted recording
#[derive(Debug, Args)]
#[command(after_help = EXAMPLES)]
pub struct Options {
    /// A file, or a directory of recordings
    #[arg(value_name = "RECORDING")]
    path: PathBuf,
}

impl Options {
    pub fn run(self) -> anyhow::Result<Outcome> {
        let report = recover(&self.path)?;
        for recovery in &report.recoveries {
            print(&format!("{}\n", describe(recovery)))?;
        }
        for error in &report.errors {
            note!("not recovered: {error}");
        }
        anyhow::ensure!(report.errors.is_empty(), "{} files could not be recovered", report.errors.len());
        Ok(if report.loses_data() { Outcome::Differences } else { Outcome::Done })
    }
}

/// The result of repairing a file, as text.
pub fn describe(recovery: &Recovery) -> String {
    let original = recovery.original.display();
    match &recovery.outcome {
        recover::Outcome::Complete { path, messages } => format!("{}: complete, {messages} messages", path.display()),
        recover::Outcome::Empty => format!("{original}: held nothing, removed"),
        recover::Outcome::SetAside { path } => format!("{original}: no recording, kept as {}", path.display()),
        recover::Outcome::InUse => format!("{original}: being written, left alone"),
        recover::Outcome::Restored(restored) => {
            let mut text = format!("{}: restored {} messages", restored.path.display(), restored.messages);
            for damage in &restored.damage {
                text += &format!("; {damage}");
            }
            if let Some(kept) = &restored.kept_original {
                text += &format!("; the damaged original is kept as {}", kept.display());
            }
            text
        }
    }
}

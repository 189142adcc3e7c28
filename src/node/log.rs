//! What a node writes to the logs of its buses (`/rosout`): its notes, and every change of a status in its diagnostics.

use std::collections::HashMap;

use super::Outputs;
use super::statistics::diagnostic_level;
use crate::bus::log::Severity;
use crate::msgs::DiagnosticArray;
use crate::text::notes;

/// What notes about problems begin with.
const WARNING: &str = "warning: ";

/// The log of a node.
pub(super) struct NodeLog {
    /// Level and message of each status at the last report.
    before: HashMap<String, (u8, String)>,
}

impl NodeLog {
    /// Begins to collect the notes of this program.
    pub(super) fn new() -> Self {
        notes::collect();
        Self { before: HashMap::new() }
    }

    /// Writes the notes since the last report, and the statuses that have changed.
    pub(super) fn write(&mut self, diagnostics: &DiagnosticArray, outputs: &mut Outputs) {
        for note in notes::take() {
            match note.strip_prefix(WARNING) {
                Some(warning) => outputs.log(Severity::Warn, warning),
                None => outputs.log(Severity::Info, &note),
            }
        }
        for status in &diagnostics.status {
            let now = (status.level, status.message.clone());
            if self.before.get(&status.name) != Some(&now) {
                outputs.log(severity(status.level), &format!("{}: {}", status.name, status.message));
                self.before.insert(status.name.clone(), now);
            }
        }
    }
}

fn severity(level: u8) -> Severity {
    match level {
        diagnostic_level::OK => Severity::Info,
        diagnostic_level::WARN => Severity::Warn,
        _ => Severity::Error,
    }
}

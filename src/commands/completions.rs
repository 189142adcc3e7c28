use clap::{Args, CommandFactory};
use clap_complete::Shell;

use super::{Cli, Outcome, print};
use crate::rig::EMBEDDED;

/// Print the completion script for a shell
#[derive(Debug, Args)]
pub struct Options {
    shell: Shell,
}

impl Options {
    pub fn run(self) -> anyhow::Result<Outcome> {
        let mut script = vec![];
        clap_complete::generate(self.shell, &mut Cli::command(), "squealcast", &mut script);
        let script = String::from_utf8_lossy(&script);
        print(&match self.shell {
            Shell::Zsh => with_rig_files(&script),
            _ => script.into_owned(),
        })?;
        Ok(Outcome::Done)
    }
}

/// The script for zsh, which offers files too where it offers the embedded rigs: both are valid there, but the generator
/// knows values or files only.
fn with_rig_files(script: &str) -> String {
    let begin = format!("(({}\\:", EMBEDDED[0].name);
    let Some(from) = script.find(&begin) else { return script.to_owned() };
    let Some(to) = script[from..].find("))'").map(|length| from + length + 2) else { return script.to_owned() };
    let rigs = &script[from..to];
    let function =
        format!("_squealcast_rigs() {{\n    _alternative 'rigs:embedded rig:{rigs}' 'files:rig file:_files'\n}}\n\n");
    script.replace(rigs, "_squealcast_rigs").replacen("_squealcast() {", &(function + "_squealcast() {"), 1)
}

use std::ffi::OsStr;
use std::path::Path;

use anyhow::Context;
use clap::{Arg, Args, Command, CommandFactory};
use clap_complete::engine::{ArgValueCompleter, CompletionCandidate, PathCompleter, ValueCompleter};
use clap_complete::env::Shells;
use clap_complete::{CompleteEnv, Shell};

use super::{Cli, Outcome, print};
use crate::rig::EMBEDDED;

const EXAMPLES: &str = "\
Examples:
  squealcast completions bash > ~/.local/share/bash-completion/completions/squealcast  for bash
  squealcast completions zsh > ~/.zfunc/_squealcast                                    for zsh
  squealcast completions fish > ~/.config/fish/completions/squealcast.fish             for fish";

/// Print the completion script for a shell
///
/// The script asks this program what can follow on a command line. So it completes commands, options and their values:
/// names of embedded rigs, rig files and recordings.
#[derive(Debug, Args)]
#[command(after_help = EXAMPLES)]
pub struct Options {
    shell: Shell,
}

/// The environment variable by which a script asks.
const VARIABLE: &str = "SQUEALCAST_COMPLETE";
const PROGRAM: &str = "squealcast";

impl Options {
    pub fn run(self) -> anyhow::Result<Outcome> {
        let shells = Shells::builtins();
        let shell = shells.completer(&self.shell.to_string()).context("no completions for this shell")?;
        let mut script = vec![];
        shell.write_registration(VARIABLE, PROGRAM, PROGRAM, PROGRAM, &mut script)?;
        print(&String::from_utf8_lossy(&script))?;
        Ok(Outcome::Done)
    }
}

/// If a completion script started this process, prints what can follow and ends it.
pub fn complete() {
    CompleteEnv::with_factory(command).var(VARIABLE).complete();
}

/// The command line with what completes its values.
fn command() -> Command {
    Cli::command().mut_subcommands(|command| command.mut_args(with_completer))
}

/// What completes the value of an argument follows from its name in the help.
fn with_completer(arg: Arg) -> Arg {
    // One of a few other words.
    let has_words =
        arg.get_value_parser().possible_values().is_some_and(|mut words| words.all(|word| !is_rig(word.get_name())));
    let name = arg.get_value_names().and_then(|names| names.first()).map(ToString::to_string);
    match name.unwrap_or_else(|| arg.get_id().as_str().to_uppercase()).as_str() {
        _ if has_words => arg,
        "RIG" => arg.add(ArgValueCompleter::new(rigs)),
        "RECORDING" => arg.add(ArgValueCompleter::new(|typed: &OsStr| files("mcap", typed))),
        name if name.ends_with(".toml") => arg.add(ArgValueCompleter::new(|typed: &OsStr| files("toml", typed))),
        _ => arg,
    }
}

fn is_rig(name: &str) -> bool {
    EMBEDDED.iter().any(|rig| rig.name == name)
}

/// Files with this extension, and folders that may contain some, that begin with `typed`.
fn files(extension: &'static str, typed: &OsStr) -> Vec<CompletionCandidate> {
    let wanted = move |path: &Path| path.is_dir() || path.extension() == Some(OsStr::new(extension));
    let mut found = PathCompleter::any().filter(wanted).complete(typed);
    // The folder itself is offered first, where nothing is typed.
    found.retain(|candidate| candidate.get_value() != ".");
    found
}

/// The embedded rigs and rig files that begin with `typed`.
fn rigs(typed: &OsStr) -> Vec<CompletionCandidate> {
    let begins = |name: &str| typed.to_str().is_some_and(|typed| name.starts_with(typed));
    let embedded = EMBEDDED.iter().filter(|rig| begins(rig.name));
    let embedded = embedded.map(|rig| CompletionCandidate::new(rig.name).help(Some(rig.about.into())));
    embedded.chain(files("toml", typed)).collect()
}

use clap::{Args, CommandFactory};

use super::{Cli, Outcome, print};

/// Print the completion script for a shell
#[derive(Debug, Args)]
pub struct Options {
    shell: clap_complete::Shell,
}

impl Options {
    pub fn run(self) -> anyhow::Result<Outcome> {
        let mut script = vec![];
        clap_complete::generate(self.shell, &mut Cli::command(), "squealcast", &mut script);
        print(&String::from_utf8_lossy(&script))?;
        Ok(Outcome::Done)
    }
}

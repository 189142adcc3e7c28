use std::io::Write;
use std::path::PathBuf;

use anyhow::Context;
use clap::{Args, Command, CommandFactory};
use clap_mangen::Man;
use clap_mangen::roff::{Roff, bold, roman};

use super::{Cli, Outcome};
use crate::files::whole_file::write_whole;

const EXAMPLES: &str = "\
Examples:
  squealcast man -o ~/.local/share/man/man1  for man squealcast, man squealcast-run and so on";

/// Write a manual page for the program and for each of its commands
#[derive(Debug, Args)]
#[command(after_help = EXAMPLES)]
pub struct Options {
    /// Folder to write into, created if missing
    #[arg(short, long, value_name = "DIR")]
    output: PathBuf,
}

impl Options {
    pub fn run(self) -> anyhow::Result<Outcome> {
        std::fs::create_dir_all(&self.output).with_context(|| self.output.display().to_string())?;
        let mut cli = Cli::command().disable_help_subcommand(true);
        cli.build();
        let commands = cli.get_subcommands().filter(|command| !command.is_hide_set());
        for command in std::iter::once(&cli).chain(commands) {
            let page = page(command)?;
            let name = command.get_display_name().unwrap_or(command.get_name());
            write_whole(&self.output.join(format!("{name}.1")), |out| out.write_all(&page))?;
        }
        Ok(Outcome::Done)
    }
}

/// The page of a command.
fn page(command: &Command) -> std::io::Result<Vec<u8>> {
    let page = Man::new(command.clone()).manual("squealcast").source(concat!("squealcast ", env!("CARGO_PKG_VERSION")));
    let mut text = vec![];
    page.render_title(&mut text)?;
    page.render_name_section(&mut text)?;
    page.render_synopsis_section(&mut text)?;
    page.render_description_section(&mut text)?;
    page.render_options_section(&mut text)?;
    if command.has_subcommands() {
        page.render_subcommands_section(&mut text)?;
    }
    let after = command.get_after_help().map(ToString::to_string).unwrap_or_default();
    sections(&after).to_writer(&mut text)?;
    page.render_version_section(&mut text)?;
    Ok(text)
}

/// What follows the options in the help of a command: headings, and indented lines of a term and its meaning.
fn sections(text: &str) -> Roff {
    let mut sections = Roff::new();
    for line in text.lines().filter(|line| !line.is_empty()) {
        match line.trim_start().split_once("  ") {
            _ if !line.starts_with(' ') => {
                sections.control("SH", [line.trim_end_matches(':').to_uppercase().as_str()]);
            }
            Some((term, meaning)) => {
                sections.control("TP", []).text([bold(term)]).text([roman(meaning.trim_start())]);
            }
            None => {
                sections.text([roman(line.trim_start())]);
            }
        }
    }
    sections
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_lines_after_the_options_become_sections_of_terms() {
        let text = "ROS 2 arguments:\n  -r, --remap FROM:=TO   Remap\n\nExamples:\n  squealcast run  on all buses";
        assert_eq!(
            sections(text).to_roff(),
            ".SH \"ROS 2 ARGUMENTS\"\n.TP\n\\fB\\-r, \\-\\-remap FROM:=TO\\fR\nRemap\n.SH EXAMPLES\n.TP\n\\fBsquealcast run\\fR\non all buses\n"
        );
    }
}

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use anyhow::{Context, bail};
use clap::{Args, Subcommand};

use super::format::count;
use super::signals::on_stop;
use super::steps::ProgressOptions;
use super::{Outcome, positive, print, write_file};
use crate::reduction::GIB;
use crate::study::{Ended, Merged, Running, Shard, Study, figure, merge, run};
use crate::system::memory::available_bytes;

const EXAMPLES: &str = "\
Examples:
  squealcast study study.toml -o results                  all cases, on all cores
  squealcast study study.toml -o results --shard 3/8      a share of them
  squealcast study merge results -o table.parquet         one table of all shards
  squealcast study figure table.parquet --x case --y windows -o f.svg  one column over another";

/// Compute many cases of a rig, a full model or the tribometer, or treat many recordings: one table, a row for each
///
/// A study file (launch/study/README.md) says what varies and what is computed. Started again, a study goes on with the cases
/// that are not there yet; shards need no coordination and may share the folder. A case that fails is a row with the reason.
#[derive(Debug, Args)]
#[command(after_help = EXAMPLES, args_conflicts_with_subcommands = true, subcommand_negates_reqs = true)]
pub struct Options {
    #[command(subcommand)]
    action: Option<Action>,
    /// Study file (TOML)
    #[arg(value_name = "STUDY.toml", required = true)]
    study: Option<PathBuf>,
    /// Folder for the results, created if missing: a file for every few cases; of a study without shards also table.parquet
    #[arg(short, long, value_name = "DIR", required = true)]
    output: Option<PathBuf>,
    /// Compute only the i-th of n shares of the cases
    #[arg(long, value_name = "I/N", default_value = "1/1")]
    shard: Shard,
    /// Cases computed at a time [default: the number of processors]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=1024))]
    threads: Option<u16>,
    /// Memory that full models may take together [default: the memory available on the machine]
    #[arg(long, value_name = "GIB", value_parser = positive)]
    memory_gib: Option<f64>,
    /// Compute the cases that failed again, with those in the same file
    #[arg(long)]
    retry_failed: bool,
    /// Print the cases with their parameters as CSV, and compute nothing
    #[arg(long)]
    list: bool,
    #[command(flatten)]
    progress: ProgressOptions,
}

#[derive(Debug, Subcommand)]
enum Action {
    Merge(Merge),
    Figure(Figure),
}

/// Join the files of a study in one table
///
/// The table is the same to the last byte, whatever the shards and interruptions were.
#[derive(Debug, Args)]
struct Merge {
    /// Folders of the study
    #[arg(value_name = "DIR", required = true)]
    folders: Vec<PathBuf>,
    /// File for the table (Parquet)
    #[arg(short, long, value_name = "FILE")]
    output: PathBuf,
    /// Write the time that each case took to this file; it is not in the table
    #[arg(long, value_name = "FILE")]
    times: Option<PathBuf>,
}

/// Draw a column of a table over another, or over two
#[derive(Debug, Args)]
struct Figure {
    /// Folder of a study, finished or not, or a table
    #[arg(value_name = "DIR|FILE")]
    table: PathBuf,
    /// Column along x
    #[arg(long, value_name = "COLUMN")]
    x: String,
    /// Column along y
    #[arg(long, value_name = "COLUMN")]
    y: String,
    /// Column shown by colour
    #[arg(long, value_name = "COLUMN")]
    colour: Option<String>,
    /// File for the figure (SVG)
    #[arg(short, long, value_name = "FILE")]
    output: PathBuf,
}

impl Options {
    pub fn run(mut self) -> anyhow::Result<Outcome> {
        match self.action.take() {
            Some(Action::Merge(merge)) => merge.run(),
            Some(Action::Figure(figure)) => figure.run(),
            None => self.compute(),
        }
    }

    fn compute(self) -> anyhow::Result<Outcome> {
        // The parser requires both where there is no other action.
        let (Some(study), Some(output)) = (&self.study, &self.output) else { bail!("no study file is given") };
        let study = Study::load(study)?;
        if self.list {
            print(&study.list()?)?;
            return Ok(Outcome::Done);
        }
        let stopped = Arc::new(AtomicBool::new(false));
        let stop = stopped.clone();
        on_stop(move || stop.store(true, Ordering::Relaxed))?;
        let processors = std::thread::available_parallelism().map_or(1, usize::from);
        let memory = self.memory_gib.map(|gib| (gib * GIB) as usize).or_else(available_bytes);
        let running = Running {
            shard: self.shard,
            threads: self.threads.map_or(processors, usize::from),
            memory,
            retry_failed: self.retry_failed,
        };
        let mut steps = self.progress.steps(1);
        let ended = run(&study, output, running, &stopped, &mut |done, of| {
            steps.at(0, &study.name, done as usize, of as usize);
        });
        drop(steps);
        let ended = ended.with_context(|| match stopped.load(Ordering::Relaxed) {
            true => format!("{}: started again, it goes on with the other cases", output.display()),
            false => String::new(),
        })?;
        if !self.progress.quiet {
            report(output, &ended);
        }
        Ok(Outcome::Done)
    }
}

fn report(output: &Path, ended: &Ended) {
    let Ended { cases, there, failed, table } = ended;
    let cases = count(*cases as usize, "case");
    note!("{}: {cases}, {there} of them there before; {failed} failed now", output.display());
    if let Some((path, merged)) = table {
        say(path, merged);
    }
}

fn say(path: &Path, merged: &Merged) {
    let Merged { cases, failed } = merged;
    note!("{}: {}, {failed} of them failed", path.display(), count(*cases as usize, "case"));
}

impl Merge {
    fn run(self) -> anyhow::Result<Outcome> {
        let merged = merge(&self.folders, &self.output, self.times.as_deref())?;
        say(&self.output, &merged);
        Ok(Outcome::Done)
    }
}

impl Figure {
    fn run(self) -> anyhow::Result<Outcome> {
        let svg = figure(&self.table, &self.x, &self.y, self.colour.as_deref())?;
        write_file(&self.output, svg.as_bytes())?;
        Ok(Outcome::Done)
    }
}

use std::path::PathBuf;

use anyhow::Context;
use clap::Args;

use super::memory::{keep_freed_unless, return_freed_by, room, solver};
use super::on_basis::{Ranges, TOLERANCE, basis_of};
use super::signals::on_stop;
use super::steps::ProgressOptions;
use super::{Outcome, positive, write_file};
use crate::evidence::reproduce::{Item, MODES, PartModes, Step, Study, index, nine_dof};
use crate::export::{Besides, write_full_model};
use crate::fem::tribometer::{Properties, Tribometer};
use crate::files::whole_file::remove_begun;
use crate::full_model::FullModelFile;
use crate::reduction::{OwnEngine, Wanted};

const EXAMPLES: &str = "\
Examples:
  squealcast reproduce -o paper  tables, figures and a page";

/// Reproduce the paper's tables and figures: CSV, SVG and one page that compares them with the paper's numbers
///
/// The results of its nine-degree-of-freedom models take a second. Those of its tribometer, with a full model of this
/// project, take some minutes. The full model is written to the folder too.
#[derive(Debug, Args)]
#[command(after_help = EXAMPLES)]
pub struct Options {
    /// Degrees of freedom of the tribometer, at least; the paper's model has 904968
    #[arg(long, value_name = "N", default_value_t = 20_000, value_parser = clap::value_parser!(u32).range(5_000..=4_000_000))]
    dof: u32,
    /// Memory that may be used [default: the memory available on the machine]
    #[arg(long, value_name = "GIB", value_parser = positive)]
    memory_gib: Option<f64>,
    /// Folder to write into
    #[arg(short, long, value_name = "DIR")]
    output: PathBuf,
    #[command(flatten)]
    progress: ProgressOptions,
}

impl Options {
    pub fn run(self) -> anyhow::Result<Outcome> {
        keep_freed_unless(self.memory_gib);
        on_stop(|| {
            remove_begun();
            note!("\nstopped: not all files were written");
            std::process::exit(130);
        })?;
        std::fs::create_dir_all(&self.output)
            .with_context(|| format!("{}: the folder cannot be created", self.output.display()))?;
        let mut items = nine_dof()?;
        items.iter().try_for_each(|item| self.write(item))?;
        let of_tribometer = self.tribometer()?;
        of_tribometer.iter().try_for_each(|item| self.write(item))?;
        items.extend(of_tribometer);
        // Written last: if the page exists, everything it shows exists.
        self.file("index.html", &index(&items))?;
        Ok(Outcome::Done)
    }

    /// Section 4 of the paper.
    fn tribometer(&self) -> anyhow::Result<Vec<Item>> {
        let mut steps = self.progress.steps(2);
        let folder = self.output.join("tribometer");
        let tribometer = Tribometer::with_dof(&Properties::default(), self.dof as usize)?;
        write_full_model(&tribometer, Besides::default(), &folder, |_| ())?;
        steps.say(&format!("{} written", folder.display()));
        let full = FullModelFile::load(&folder.join("tribometer.toml"))?;
        steps.say(&format!("{} degrees of freedom read", full.model.dimension()));
        let toml = folder.join("tribometer.toml");
        let names: Vec<&str> = full.model.parts.iter().map(|part| part.name.as_str()).collect();
        let most = Wanted::Lowest(MODES.into_iter().max().unwrap_or(0));
        let kept = full.keep_modes(
            &OwnEngine,
            &vec![most; names.len()],
            true,
            room(self.memory_gib, &toml)?,
            &mut |part, what| {
                return_freed_by(&what);
                steps.modes(part, names[part], what);
            },
        )?;
        // The modes on all coordinates of the parts are no longer needed.
        let modes = PartModes::new(&full, &kept)?;
        drop(kept);
        steps.say("ordering and analysing");
        let mut solver =
            solver(&OwnEngine, &full, room(self.memory_gib, &toml)?, &mut |step| steps.full("full model", step))?;
        let (_, basis) = basis_of(&full, TOLERANCE, Ranges::default(), &mut solver, &mut steps)?;
        let mut report = |event: Step<'_>| match event {
            Step::Said(text) => steps.say(text),
            Step::Solving(what, step) => steps.full(what, step),
        };
        Ok(Study { full: &full, modes: &modes, basis: &basis }.items(&mut solver, &mut report)?)
    }

    fn write(&self, item: &Item) -> anyhow::Result<()> {
        self.file(&format!("{}.csv", item.name), &item.csv)?;
        match &item.svg {
            Some(svg) => self.file(&format!("{}.svg", item.name), svg),
            None => Ok(()),
        }
    }

    fn file(&self, name: &str, content: &str) -> anyhow::Result<()> {
        let path = self.output.join(name);
        write_file(&path, content.as_bytes())?;
        if !self.progress.quiet {
            note!("{}", path.display());
        }
        Ok(())
    }
}

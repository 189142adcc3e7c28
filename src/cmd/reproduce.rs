use std::path::PathBuf;

use anyhow::Context;
use clap::Args;

use super::{Outcome, write_file};
use crate::reproduce::{Item, index, nine_dof};

/// Make the paper's tables and figures again: CSV, SVG and one page beside the paper's numbers
#[derive(Debug, Args)]
pub struct Options {
    /// Folder to write into
    #[arg(short, long, value_name = "DIR")]
    output: PathBuf,
}

impl Options {
    pub fn run(self) -> anyhow::Result<Outcome> {
        std::fs::create_dir_all(&self.output)
            .with_context(|| format!("{}: cannot make the folder", self.output.display()))?;
        let items = nine_dof()?;
        for item in &items {
            self.write(item)?;
        }
        // Last: where the page is, all of it is.
        self.file("index.html", &index(&items))?;
        Ok(Outcome::Done)
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
        eprintln!("{}", path.display());
        Ok(())
    }
}

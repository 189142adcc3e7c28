use std::path::PathBuf;

use clap::Args;

use super::Outcome;
use super::signals::on_stop;
use crate::export::{Besides, write_full_model};
use crate::fem::tribometer::{Properties, Tribometer};
use crate::files::whole_file::remove_begun;

const EXAMPLES: &str = "\
Examples:
  squealcast tribometer -o model  matrices, decks and the file that names them";

/// Write the reference tribometer as a full finite-element model
///
/// A pad-on-disc rig of the paper's kind with dimensions of this project, not the paper's mesh: matrices (Matrix Market),
/// `tribometer.toml` that names them, a CalculiX deck of each part, and the mesh as VTK.
#[derive(Debug, Args)]
#[command(after_help = EXAMPLES)]
pub struct Options {
    /// Degrees of freedom, at least; the 294 contact pairs are the same at any size
    #[arg(long, value_name = "N", default_value_t = 20_000, value_parser = clap::value_parser!(u32).range(5_000..=4_000_000))]
    dof: u32,
    /// Also write the matrices of the disc that turns in the frame of the pad: gyroscopic, spin and stress-stiffening terms
    #[arg(long)]
    rotation: bool,
    /// Let the contact pairs follow the state of steady sliding by the law of a friction lining, under a load on the top of
    /// the spring holder; without it their springs are always closed
    #[arg(long)]
    lining: bool,
    /// Folder to write into
    #[arg(short, long, value_name = "DIR")]
    output: PathBuf,
}

impl Options {
    pub fn run(self) -> anyhow::Result<Outcome> {
        on_stop(|| {
            remove_begun();
            note!("\nstopped: not all files were written");
            std::process::exit(130);
        })?;
        let tribometer = Tribometer::with_dof(&Properties::default(), self.dof as usize)?;
        let (pad, disc) = (tribometer.pad.structure.dof(), tribometer.disc.structure.dof());
        note!("{} degrees of freedom: {pad} of the upper part, {disc} of the lower", tribometer.dof());
        let besides = Besides { rotation: self.rotation, lining: self.lining };
        write_full_model(&tribometer, besides, &self.output, |file| note!("{}", self.output.join(file).display()))?;
        Ok(Outcome::Done)
    }
}

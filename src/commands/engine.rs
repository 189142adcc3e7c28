//! Which sparse solver a command uses, and how its ranks are started.

use std::path::{Path, PathBuf};

use anyhow::bail;
use clap::{Args, ValueEnum};

use super::signals::on_stop;
use crate::full_model::slepc::{Launch, Slepc, end_all};
use crate::reduction::{Engine, OwnEngine};

/// Debian's petsc4py and slepc4py belong to this Python.
const PYTHON: &str = "/usr/bin/python3";

#[derive(Clone, Debug, Args)]
#[command(next_help_heading = "Sparse solver (launch/SLEPC.md)")]
pub struct EngineOptions {
    /// Sparse solver
    #[arg(long, value_enum, default_value_t = Choice::Own)]
    engine: Choice,
    /// Number of ranks of --engine slepc, started by `mpiexec -n N` [default: 1]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..), conflicts_with = "launch")]
    ranks: Option<u16>,
    /// Launcher with its arguments instead of mpiexec, separated by spaces, such as "srun -n 64"
    #[arg(long, value_name = "COMMAND", value_parser = words)]
    launch: Option<Words>,
    /// Folder for the files of the ranks, which all hosts see [default: that for temporary files]
    #[arg(long, value_name = "DIR")]
    scratch: Option<PathBuf>,
    /// Python with petsc4py and slepc4py, for real and for complex numbers [default: /usr/bin/python3]
    #[arg(long, value_name = "FILE")]
    python: Option<PathBuf>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum Choice {
    /// This program's own, in this process
    Own,
    /// PETSc, SLEPc and MUMPS on several ranks
    Slepc,
}

#[derive(Clone, Debug)]
struct Words(Vec<String>);

/// The words of a launcher, for clap.
fn words(text: &str) -> Result<Words, String> {
    let words: Vec<String> = text.split_whitespace().map(str::to_owned).collect();
    if words.is_empty() { Err("expected a command such as srun -n 64".to_owned()) } else { Ok(Words(words)) }
}

/// The sparse solver of a command.
pub enum Chosen {
    Own(OwnEngine),
    Slepc(Slepc),
}

impl EngineOptions {
    /// The solver chosen. Its ranks start when they are needed.
    ///
    /// # Errors
    /// Options that the chosen solver does not have.
    pub fn choose(&self) -> anyhow::Result<Chosen> {
        let Self { engine, ranks, launch, scratch, python } = self;
        match engine {
            Choice::Own => {
                let given = [
                    ("--ranks", ranks.is_some()),
                    ("--launch", launch.is_some()),
                    ("--scratch", scratch.is_some()),
                    ("--python", python.is_some()),
                ];
                if let Some((name, _)) = given.into_iter().find(|(_, given)| *given) {
                    bail!("{name} is for --engine slepc");
                }
                Ok(Chosen::Own(OwnEngine))
            }
            Choice::Slepc => Ok(Chosen::Slepc(Slepc::new(Launch {
                ranks: ranks.unwrap_or(1).into(),
                launcher: launch.clone().map(|Words(words)| words),
                scratch: scratch.clone(),
                python: python.clone().unwrap_or_else(default_python),
            }))),
        }
    }
}

fn default_python() -> PathBuf {
    if Path::new(PYTHON).exists() { PYTHON.into() } else { "python3".into() }
}

impl Chosen {
    /// The solver itself.
    pub fn engine(&self) -> &dyn Engine {
        match self {
            Self::Own(own) => own,
            Self::Slepc(slepc) => slepc,
        }
    }

    /// Ends ranks at signals that end this program, for a command that has nothing else to end.
    ///
    /// # Errors
    /// Signal handlers cannot be installed.
    pub fn end_at_signals(&self) -> anyhow::Result<()> {
        match self {
            Self::Own(_) => Ok(()),
            Self::Slepc(_) => on_stop(|| {
                end_all();
                std::process::exit(130);
            }),
        }
    }

    /// Who solved, if that was not this program.
    pub fn remark(&self) -> Option<String> {
        match self {
            Self::Own(_) => None,
            Self::Slepc(slepc) => slepc.worked(),
        }
    }
}

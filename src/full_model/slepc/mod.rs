//! The engine that solves by PETSc, SLEPc and MUMPS on any number of processes (ranks), on one host or several.
//!
//! Factors, solves and modes are made by the ranks (`ranks.py`); the iteration for complex roots, all checks and all
//! counts of modes that memory allows are ours. Ranks start with the first task that needs them: one set for real numbers
//! and one for complex ones, because PETSc is built for either.

mod files;
mod ranks;

use std::path::PathBuf;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};

use faer::sparse::SparseColMat;
use faer::{Mat, c64};
use serde_json::{Value, json};

use crate::reduction::{
    ComplexSparseMatrix, Eigenpairs, Engine, Factor, Lowest, Pencil, Progress, ReductionError, SparseMatrix,
};
use files::{Number, read_block, write_block, write_rows, write_upper};
use ranks::Ranks;
pub use ranks::end_all;

/// Modes asked for beyond the wanted ones, so that a gap follows; twice as many in each further attempt.
const BEYOND: usize = 6;

/// How ranks are started.
#[derive(Clone, Debug)]
pub struct Launch {
    /// Number of ranks of `mpiexec`.
    pub ranks: usize,
    /// A launcher with its arguments, instead of `mpiexec -n RANKS`.
    pub launcher: Option<Vec<String>>,
    /// A folder that all ranks see; that for temporary files if `None`.
    pub scratch: Option<PathBuf>,
    /// A Python with petsc4py and slepc4py.
    pub python: PathBuf,
}

impl Launch {
    fn words(&self) -> Vec<String> {
        let ours = || vec!["mpiexec".to_owned(), "-n".to_owned(), self.ranks.to_string()];
        self.launcher.clone().unwrap_or_else(ours)
    }
}

/// Solves by SLEPc.
pub struct Slepc {
    launch: Launch,
    real: Mutex<Option<Arc<Ranks>>>,
    complex: Mutex<Option<Arc<Ranks>>>,
    /// Number of files and factors named so far.
    named: AtomicU64,
}

impl Slepc {
    /// An engine whose ranks start when they are needed.
    pub fn new(launch: Launch) -> Self {
        Self { launch, real: Mutex::default(), complex: Mutex::default(), named: AtomicU64::new(0) }
    }

    /// The ranks that have worked so far, in words; `None` if there was nothing for them to do.
    pub fn worked(&self) -> Option<String> {
        let sets =
            [&self.real, &self.complex].map(|ranks| ranks.lock().unwrap_or_else(PoisonError::into_inner).clone());
        let ready = sets.into_iter().flatten().map(|ranks| ranks.ready.clone()).next()?;
        let ranks = if ready.ranks == 1 { "1 rank".to_owned() } else { format!("{} ranks", ready.ranks) };
        Some(format!("SLEPc {} and PETSc {} with MUMPS, {}", ready.slepc, ready.petsc, ranks))
    }

    /// The ranks for numbers of a kind, started if this is the first task for them.
    fn ranks<T: Number>(&self) -> Result<Arc<Ranks>, String> {
        let set = if T::WORDS == 1 { &self.real } else { &self.complex };
        let mut set = set.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(ranks) = &*set {
            return Ok(ranks.clone());
        }
        let ranks = Arc::new(Ranks::start(&self.launch, T::SCALAR)?);
        *set = Some(ranks.clone());
        Ok(ranks)
    }

    /// A name that no other file or factor has.
    fn name(&self, what: &str) -> String {
        format!("{what}-{}", self.named.fetch_add(1, Ordering::Relaxed))
    }

    /// Gives a command with both matrices of a system, whose files are removed afterwards.
    fn with_system(&self, ranks: &Ranks, pencil: &Pencil<'_>, mut command: Value) -> Result<Value, String> {
        let names = [self.name("stiffness"), self.name("mass")];
        let of = [(pencil.stiffness, pencil.mass), (pencil.mass, pencil.stiffness)];
        let mut written = Ok(());
        for ((one, other), name) in of.into_iter().zip(&names) {
            let path = ranks.file(name);
            written = written
                .and_then(|()| write_upper(&path, one, other).map_err(|error| format!("{}: {error}", path.display())));
        }
        command["stiffness"] = json!(names[0]);
        command["mass"] = json!(names[1]);
        let answer = written.and_then(|()| ranks.command(&command));
        names.iter().for_each(|name| drop(std::fs::remove_file(ranks.file(name))));
        answer
    }

    /// A factor of `K + s M`, kept or not, and the number of its negative pivots.
    fn symmetric(
        &self,
        pencil: &Pencil<'_>,
        shift: f64,
        keep: bool,
    ) -> Result<(MumpsFactor<'_>, usize), ReductionError> {
        let failed = |reason: String| ReductionError::Engine { what: pencil.what.to_owned(), reason };
        let (ranks, name) = (self.ranks::<f64>().map_err(failed)?, self.name("factor"));
        let command = json!({ "do": "factor", "symmetric": true, "shift": shift, "keep": keep, "name": name });
        let answer = self.with_system(&ranks, pencil, command).map_err(failed)?;
        let negative = answer.get("negative").and_then(Value::as_u64);
        let negative = negative.ok_or_else(|| failed(format!("the ranks answered {answer}, expected `negative`")))?;
        let (what, rows) = (pencil.what.to_owned(), pencil.dimension());
        Ok((MumpsFactor { engine: self, ranks, name, kept: keep, what, rows }, negative as usize))
    }

    /// A factor of a matrix of any symmetry.
    fn general<T: Number + faer::traits::ComplexField>(
        &self,
        what: &str,
        matrix: &SparseColMat<usize, T>,
    ) -> Result<MumpsFactor<'_>, ReductionError> {
        let failed = |reason: String| ReductionError::Engine { what: what.to_owned(), reason };
        let ranks = self.ranks::<T>().map_err(failed)?;
        let (file, name) = (self.name("matrix"), self.name("factor"));
        let path = ranks.file(&file);
        let by_rows = matrix.to_row_major().map_err(|error| failed(format!("{error:?}")))?;
        write_rows(&path, &by_rows).map_err(|error| failed(format!("{}: {error}", path.display())))?;
        drop(by_rows);
        let command = json!({ "do": "factor", "symmetric": false, "matrix": file, "keep": true, "name": name });
        let answer = ranks.command(&command).map_err(failed);
        let _ = std::fs::remove_file(path);
        answer?;
        Ok(MumpsFactor { engine: self, ranks, name, kept: true, what: what.to_owned(), rows: matrix.nrows() })
    }
}

impl Engine for Slepc {
    fn foreign(&self) -> bool {
        true
    }

    fn lowest<'p>(
        &self,
        pencil: &'p Pencil<'_>,
        wanted: &Lowest,
        progress: &mut dyn FnMut(Progress),
    ) -> Result<Eigenpairs<'p>, ReductionError> {
        let failed = |reason: String| ReductionError::Engine { what: pencil.what.to_owned(), reason };
        let (ranks, n) = (self.ranks::<f64>().map_err(failed)?, pencil.dimension());
        let count = (wanted.count + (BEYOND << wanted.attempt.min(10))).min(n);
        for shift in pencil.shifts(wanted.first_shift) {
            let out = self.name("modes");
            let command = json!({ "do": "modes", "shift": shift, "count": count, "seed": wanted.attempt, "out": out });
            let answer = self.with_system(&ranks, pencil, command).map_err(failed)?;
            let unexpected = || failed(format!("the ranks answered {answer}, expected modes"));
            if answer.get("negative").and_then(Value::as_u64).ok_or_else(unexpected)? > 0 {
                continue;
            }
            let numbers = |key: &str| answer.get(key).and_then(Value::as_array).ok_or_else(unexpected);
            let omega_squared: Option<Vec<f64>> = numbers("squares")?.iter().map(Value::as_f64).collect();
            let omega_squared = omega_squared.ok_or_else(unexpected)?;
            if omega_squared.len() < wanted.count || omega_squared.len() > n {
                let reason = format!("the ranks found {} modes, expected {count}", omega_squared.len());
                return Err(failed(reason));
            }
            let mut phi = Mat::zeros(n, omega_squared.len());
            self.take_block(&ranks, &answer, &out, &mut phi).map_err(failed)?;
            progress(Progress::Factored { shift });
            let converged = omega_squared.len();
            progress(Progress::Iterated { vectors: converged, converged, wanted: wanted.count });
            return Ok(Eigenpairs::foreign(omega_squared, phi, shift));
        }
        Err(pencil.no_shift())
    }

    fn count_below(&self, pencil: &Pencil<'_>, square: f64) -> Result<usize, ReductionError> {
        Ok(self.symmetric(pencil, -square, false)?.1)
    }

    fn definite<'a>(
        &'a self,
        pencil: &'a Pencil<'_>,
        shift: f64,
    ) -> Result<Option<Box<dyn Factor<f64> + 'a>>, ReductionError> {
        let (factor, negative) = self.symmetric(pencil, shift, true)?;
        Ok((negative == 0).then(|| Box::new(factor) as Box<dyn Factor<f64>>))
    }

    fn real<'a>(&'a self, what: &str, matrix: &SparseMatrix) -> Result<Box<dyn Factor<f64> + 'a>, ReductionError> {
        Ok(Box::new(self.general(what, matrix)?))
    }

    fn complex<'a>(
        &'a self,
        what: &str,
        matrix: &ComplexSparseMatrix,
    ) -> Result<Box<dyn Factor<c64> + 'a>, ReductionError> {
        Ok(Box::new(self.general(what, matrix)?))
    }
}

impl Slepc {
    /// Reads the rows that the ranks have written to the files `out`, and removes these.
    fn take_block<T: Number>(
        &self,
        ranks: &Ranks,
        answer: &Value,
        out: &str,
        block: &mut Mat<T>,
    ) -> Result<(), String> {
        let rows = answer.get("ranges").and_then(Value::as_array);
        let rows: Option<Vec<usize>> =
            rows.and_then(|rows| rows.iter().map(|row| Some(row.as_u64()? as usize)).collect());
        let rows = rows.ok_or_else(|| format!("the ranks answered {answer}, expected `ranges`"))?;
        let part = |rank: usize| ranks.file(&format!("{out}.{rank}"));
        let read = read_block(block.nrows(), block.ncols(), &rows, &part, block);
        (1..rows.len()).for_each(|rank| drop(std::fs::remove_file(part(rank - 1))));
        read
    }
}

/// A factor that the ranks hold until this is dropped.
struct MumpsFactor<'a> {
    engine: &'a Slepc,
    ranks: Arc<Ranks>,
    name: String,
    kept: bool,
    what: String,
    rows: usize,
}

impl<T: Number> Factor<T> for MumpsFactor<'_> {
    fn solve(&self, rhs: &mut Mat<T>, transposed: bool) -> Result<(), ReductionError> {
        let failed = |reason: String| ReductionError::Engine { what: self.what.clone(), reason };
        assert_eq!(rhs.nrows(), self.rows, "rows of right sides");
        let [given, out] = ["given", "solved"].map(|what| self.engine.name(what));
        let path = self.ranks.file(&given);
        let solved = write_block(&path, rhs).map_err(|error| format!("{}: {error}", path.display())).and_then(|()| {
            let columns = rhs.ncols();
            let command = json!({
                "do": "solve", "name": self.name, "in": given, "out": out, "columns": columns, "transposed": transposed,
            });
            let answer = self.ranks.command(&command)?;
            self.engine.take_block(&self.ranks, &answer, &out, rhs)
        });
        let _ = std::fs::remove_file(path);
        solved.map_err(failed)
    }
}

impl Drop for MumpsFactor<'_> {
    fn drop(&mut self) {
        if self.kept {
            // Ranks that failed hold nothing any more.
            let _ = self.ranks.command(&json!({ "do": "drop", "name": self.name }));
        }
    }
}

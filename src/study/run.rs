//! Computes the cases of a study on all cores. Each thread takes the next part, computes its cases and writes them as one file,
//! which appears whole or not at all. A study that was stopped, however, goes on with the parts that are not there.

use std::fs;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::time::Instant;

use super::file::Study;
use super::merge::{Merged, merge};
use super::parquet_file::{Reader, Writer};
use super::plan::{Plan, Shard};
use super::table::{Cell, Column, Kind, Table};
use super::{CASE, DONE, FAILED, Identity, REASON, STATUS, StudyError, TIME};
use crate::files::whole_file::write_whole;
use crate::system::panics::caught;

/// The table that a whole study ends with.
pub const TABLE: &str = "table.parquet";

/// How a study is computed.
#[derive(Clone, Copy, Debug)]
pub struct Running {
    pub shard: Shard,
    pub threads: usize,
    /// Memory that full models may take, of all threads together, bytes.
    pub memory: Option<usize>,
    /// Computes the parts with failed cases again.
    pub retry_failed: bool,
}

/// What was computed.
#[derive(Clone, Debug)]
pub struct Ended {
    /// Cases of this shard, those that were there already, and those that failed now.
    pub cases: u64,
    pub there: u64,
    pub failed: u64,
    /// The table of all cases, if this was not a shard.
    pub table: Option<(PathBuf, Merged)>,
}

/// Computes the cases of a shard that are not yet in `folder`. `progress` receives how many of its cases are there, and of how
/// many. Once `stopped` is set no further case is begun.
///
/// # Errors
/// [`StudyError`]: `folder` holds another study, a file cannot be written, or `stopped` was set.
pub fn run(
    study: &Study,
    folder: &Path,
    running: Running,
    stopped: &AtomicBool,
    progress: &mut (dyn FnMut(u64, u64) + Send),
) -> Result<Ended, StudyError> {
    let refused = |source| StudyError::Folder { folder: folder.display().to_string(), source };
    fs::create_dir_all(folder).map_err(refused)?;
    let plan = study.plan();
    let (mut cases, mut there, mut pending) = (0, 0, vec![]);
    for part in plan.of_shard(running.shard) {
        let count = plan.part(part).end - plan.part(part).start;
        cases += count;
        if is_there(&folder.join(plan.file(part)), &study.identity, running.retry_failed)? {
            there += count;
        } else {
            pending.push(part);
        }
    }
    progress(there, cases);
    let failed = compute(study, folder, &pending, running, stopped, &mut |done| progress(there + done, cases))?;
    let table = if running.shard == Shard::WHOLE {
        let path = folder.join(TABLE);
        let merged = merge(&[folder.to_owned()], &path, None)?;
        Some((path, merged))
    } else {
        None
    };
    Ok(Ended { cases, there, failed, table })
}

impl Study {
    pub fn plan(&self) -> Plan {
        Plan { cases: self.cases, cases_per_file: self.cases_per_file }
    }

    /// The columns of a part.
    pub fn columns(&self) -> Vec<Column> {
        let parameters = self.parameters.iter().map(|parameter| Column::new(&parameter.column, Kind::Number));
        [Column::new(CASE, Kind::Whole)]
            .into_iter()
            .chain(self.subject.own_columns())
            .chain(parameters)
            .chain(self.subject.result_columns())
            .chain([Column::new(STATUS, Kind::Text), Column::new(REASON, Kind::Text), Column::new(TIME, Kind::Number)])
            .collect()
    }

    /// The row of a case, and whether it failed.
    fn row(&self, case: u64, folder: &Path, memory: Option<usize>) -> (Vec<Cell>, bool) {
        let begun = Instant::now();
        let values = self.values(case);
        let work = || self.subject.compute(case, &self.parameters, &values, folder, memory);
        let computed = caught(work).unwrap_or_else(|panic| Err(format!("the computation broke off: {panic}")));
        let mut row = vec![Cell::Whole(case as i64)];
        row.extend(self.subject.own_cells(case));
        row.extend(values.iter().map(|value| Cell::Number(value.value())));
        let failed = computed.is_err();
        match computed {
            Ok(results) => {
                row.extend(results);
                row.extend([Cell::Text(DONE.to_owned()), Cell::Missing]);
            }
            Err(reason) => {
                row.extend(self.subject.result_columns().iter().map(|_| Cell::Missing));
                row.extend([Cell::Text(FAILED.to_owned()), Cell::Text(reason)]);
            }
        }
        row.push(Cell::Number(begun.elapsed().as_secs_f64()));
        (row, failed)
    }
}

/// Whether the file of a part is there. One that cannot be read is not: it is written again.
fn is_there(path: &Path, identity: &Identity, retry_failed: bool) -> Result<bool, StudyError> {
    if !path.exists() {
        return Ok(false);
    }
    let Ok(reader) = Reader::open(path) else { return Ok(false) };
    let Some(own) = Identity::of(&reader) else { return Ok(false) };
    if let Some(difference) = own.difference(identity) {
        let advice = "choose another folder, or empty this one";
        return Err(StudyError::AnotherStudy { file: path.display().to_string(), difference, advice });
    }
    if !retry_failed {
        return Ok(true);
    }
    let table = reader.read(&[STATUS])?;
    Ok(super::merge::failed(&table) == 0)
}

/// Computes parts; the number of failed cases.
fn compute(
    study: &Study,
    folder: &Path,
    parts: &[u64],
    running: Running,
    stopped: &AtomicBool,
    progress: &mut (dyn FnMut(u64) + Send),
) -> Result<u64, StudyError> {
    let threads = running.threads.clamp(1, parts.len().max(1));
    let memory = running.memory.map(|bytes| bytes / threads);
    let (next, wrong) = (AtomicUsize::new(0), AtomicBool::new(false));
    let counted = Mutex::new((0_u64, 0_u64, progress));
    let plan = study.plan();
    let columns = study.columns();
    let metadata = study.identity.metadata(&study.text);
    let ends = || stopped.load(Ordering::Relaxed) || wrong.load(Ordering::Relaxed);
    let part = |part: u64| -> Result<(), StudyError> {
        let mut table = Table::new(&columns);
        for case in plan.part(part) {
            if ends() {
                return Err(StudyError::Stopped);
            }
            let (row, failed) = study.row(case, folder, memory);
            table.push(row);
            // Counting cannot leave anything inconsistent behind.
            let mut counted = counted.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
            counted.0 += 1;
            counted.1 += u64::from(failed);
            let done = counted.0;
            (counted.2)(done);
        }
        let mut writer = Writer::new(&columns, &metadata)?;
        writer.write(&table)?;
        let bytes = writer.finish()?;
        Ok(write_whole(&folder.join(plan.file(part)), |out| out.write_all(&bytes))?)
    };
    let work = || {
        while let Some(&number) = parts.get(next.fetch_add(1, Ordering::Relaxed)) {
            if let Err(error) = part(number) {
                wrong.store(true, Ordering::Relaxed);
                return Err(error);
            }
        }
        Ok(())
    };
    let ended: Vec<Result<(), StudyError>> = std::thread::scope(|scope| {
        let workers: Vec<_> = (0..threads).map(|_| scope.spawn(work)).collect();
        workers.into_iter().map(|worker| worker.join().unwrap_or(Err(StudyError::Stopped))).collect()
    });
    // A thread that was stopped by the error of another has nothing to say.
    let mut errors: Vec<StudyError> = ended.into_iter().filter_map(Result::err).collect();
    errors.sort_by_key(|error| matches!(error, StudyError::Stopped));
    match errors.into_iter().next() {
        Some(error) => Err(error),
        None => Ok(counted.into_inner().unwrap_or_else(std::sync::PoisonError::into_inner).1),
    }
}

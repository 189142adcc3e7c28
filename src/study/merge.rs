//! One table of the files of a study. It is the same to the last byte, whatever the shards and interruptions were: times are
//! left out of it.

use std::collections::BTreeMap;
use std::fs;
use std::io::Write;
use std::ops::Range;
use std::path::{Path, PathBuf};

use super::parquet_file::{Reader, Writer};
use super::plan::{Plan, in_words};
use super::table::{Cells, Column, Table};
use super::{CASE, FAILED, Identity, STATUS, StudyError, TIME, metadata_key};
use crate::files::whole_file::write_whole;

/// Rows of a group: parts are joined until there are as many.
const GROUP: usize = 1 << 16;

/// A merged table.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Merged {
    pub cases: u64,
    pub failed: u64,
}

/// The files of a study, in the order of their cases.
#[derive(Debug)]
pub struct Parts {
    identity: Identity,
    study: String,
    plan: Plan,
    files: BTreeMap<u64, PathBuf>,
}

/// The files of the study in `folders`.
///
/// # Errors
/// [`StudyError`]: they are not of one study, two of them hold the same cases, or there are none.
pub fn parts_in(folders: &[PathBuf]) -> Result<Parts, StudyError> {
    let mut found: Option<Parts> = None;
    for folder in folders {
        let refused = |source| StudyError::Folder { folder: folder.display().to_string(), source };
        let names = fs::read_dir(folder).map_err(refused)?.map(|entry| entry.map(|entry| entry.file_name()));
        let mut names: Vec<String> = names
            .collect::<Result<Vec<_>, _>>()
            .map_err(refused)?
            .into_iter()
            .filter_map(|name| name.into_string().ok())
            .filter(|name| name.starts_with("cases-") && name.ends_with(".parquet"))
            .collect();
        names.sort();
        for name in &names {
            take(&mut found, &folder.join(name), name)?;
        }
        if names.is_empty() && folders.len() == 1 {
            return Err(StudyError::NoCases { folder: folder.display().to_string() });
        }
    }
    let folder = || folders.first().map(|folder| folder.display().to_string()).unwrap_or_default();
    found.ok_or_else(|| StudyError::NoCases { folder: folder() })
}

/// Adds a file to those found.
fn take(found: &mut Option<Parts>, path: &Path, name: &str) -> Result<(), StudyError> {
    let reader = Reader::open(path)?;
    let no_study =
        |reason: &str| super::TableError::Unreadable { file: path.display().to_string(), reason: reason.to_owned() };
    let identity = Identity::of(&reader).ok_or_else(|| no_study("its metadata are not a study's"))?;
    let plan = Plan { cases: identity.cases, cases_per_file: identity.cases_per_file.max(1) };
    let study = reader.metadata(&metadata_key("study")).unwrap_or_default().to_owned();
    let own = || Parts { identity: identity.clone(), study, plan, files: BTreeMap::new() };
    let parts = found.get_or_insert_with(own);
    if let Some(difference) = identity.difference(&parts.identity) {
        let advice = "merge files of one study";
        return Err(StudyError::AnotherStudy { file: path.display().to_string(), difference, advice });
    }
    let part = plan.part_of(name).ok_or_else(|| no_study("its name is not that of its cases"))?;
    let rows = plan.part(part).end - plan.part(part).start;
    if reader.rows() as u64 != rows {
        return Err(no_study(&format!("it has {} rows, expected {rows}", reader.rows())).into());
    }
    if let Some(first) = parts.files.insert(part, path.to_owned()) {
        let named = in_words(&[plan.part(part)]);
        let (first, second) = (first.display().to_string(), path.display().to_string());
        return Err(StudyError::Double { named, first, second });
    }
    Ok(())
}

impl Parts {
    /// The cases that no file holds.
    fn missing(&self) -> Vec<Range<u64>> {
        (0..self.plan.parts()).filter(|part| !self.files.contains_key(part)).map(|part| self.plan.part(part)).collect()
    }

    /// Refuses a study whose cases are not all there.
    fn complete(&self) -> Result<(), StudyError> {
        let missing = self.missing();
        if missing.is_empty() {
            return Ok(());
        }
        let count = missing.iter().map(|range| range.end - range.start).sum();
        Err(StudyError::Missing { missing: count, cases: self.plan.cases, named: in_words(&missing) })
    }

    /// Reads the file of a part, whose cases must be those of its name.
    fn read(&self, part: u64, path: &Path) -> Result<Table, StudyError> {
        let table = Reader::open(path)?.read_all()?;
        let cases: Vec<Option<i64>> = self.plan.part(part).map(|case| Some(case as i64)).collect();
        if table.column(CASE) == Some(&Cells::Whole(cases)) {
            return Ok(table);
        }
        let reason = "its cases are not those of its name".to_owned();
        Err(super::TableError::Unreadable { file: path.display().to_string(), reason }.into())
    }
}

/// Number of failed cases in a table.
pub fn failed(table: &Table) -> u64 {
    match table.column(STATUS) {
        Some(Cells::Text(cells)) => cells.iter().filter(|cell| cell.as_deref() == Some(FAILED)).count() as u64,
        Some(Cells::Whole(_) | Cells::Number(_) | Cells::List(_)) | None => 0,
    }
}

/// Writes the table of all cases in `folders` to `output`, without the time that each took; those go to `times` if it is given.
///
/// # Errors
/// [`StudyError`]: the files are not of one study, hold cases twice or lack some; a file cannot be written.
pub fn merge(folders: &[PathBuf], output: &Path, times: Option<&Path>) -> Result<Merged, StudyError> {
    let parts = parts_in(folders)?;
    parts.complete()?;
    let Some((&first, path)) = parts.files.first_key_value() else {
        return Err(StudyError::NoCases { folder: output.display().to_string() });
    };
    let columns = parts.read(first, path)?.columns();
    let names = |with_times: bool| -> Vec<&str> {
        let own = |column: &&Column| {
            if with_times { [CASE, TIME].contains(&column.name.as_str()) } else { column.name != TIME }
        };
        columns.iter().filter(own).map(|column| column.name.as_str()).collect()
    };
    let failed = joined(&parts, &columns, &names(false), output)?;
    if let Some(times) = times {
        joined(&parts, &columns, &names(true), times)?;
    }
    Ok(Merged { cases: parts.plan.cases, failed })
}

/// Writes the columns with these names of all parts; the number of failed cases in them.
fn joined(parts: &Parts, columns: &[Column], names: &[&str], output: &Path) -> Result<u64, StudyError> {
    let of = |table: Table| table.only(names);
    let empty = || of(Table::new(columns));
    let mut writer = Writer::new(&empty().columns(), &parts.identity.metadata(&parts.study))?;
    let (mut group, mut failed_cases) = (empty(), 0);
    for (&part, path) in &parts.files {
        let table = parts.read(part, path)?;
        if table.columns() != columns {
            let reason = "it has other columns than the first file".to_owned();
            return Err(super::TableError::Unreadable { file: path.display().to_string(), reason }.into());
        }
        failed_cases += failed(&table);
        group.append(of(table));
        if group.rows() >= GROUP {
            writer.write(&std::mem::replace(&mut group, empty()))?;
        }
    }
    if group.rows() > 0 {
        writer.write(&group)?;
    }
    let bytes = writer.finish()?;
    write_whole(output, |out| out.write_all(&bytes))?;
    Ok(failed_cases)
}

/// The columns with these names of a table, or of all files that a folder holds of a study, finished or not; with the names of
/// all columns.
///
/// # Errors
/// [`StudyError`].
pub fn table_of(path: &Path, names: &[&str]) -> Result<(Table, Vec<Column>), StudyError> {
    if !path.is_dir() {
        let reader = Reader::open(path)?;
        return Ok((reader.read(names)?, reader.columns().to_vec()));
    }
    let parts = parts_in(&[path.to_owned()])?;
    let mut whole: Option<(Table, Vec<Column>)> = None;
    for file in parts.files.values() {
        let reader = Reader::open(file)?;
        let table = reader.read(names)?;
        match &mut whole {
            None => whole = Some((table, reader.columns().to_vec())),
            Some((whole, _)) if whole.columns() == table.columns() => whole.append(table),
            Some(_) => {
                let reason = "it has other columns than the first file".to_owned();
                return Err(super::TableError::Unreadable { file: file.display().to_string(), reason }.into());
            }
        }
    }
    whole.ok_or_else(|| StudyError::NoCases { folder: path.display().to_string() })
}

//! Studies of many recordings: one case, and so one row, for each.

use std::fs;
use std::io::{self, Read};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use serde::Deserialize;
use sha2::{Digest, Sha256};

use super::StudyError;
use super::subject::words;
use super::table::{Cell, Column, Kind};
use crate::display::recorded::Recorded;
use crate::display::report::{Origin, report};
use crate::files::input_file;
use crate::files::whole_file::write_whole;
use crate::import::tribometer_log::LogOptions;
use crate::import::{operating_point, read_log, temperature};
use crate::msgs::listed;
use crate::msgs::schema::Topic;
use crate::offline::score_table::{Sum, met};
use crate::offline::verify::{Charts, verify};
use crate::offline::verify_sound::{recorded_settings, verify_sound};
use crate::offline::{self, Measured, Predicted, Quantity};
use crate::recording::reader::{Recording, is_recording, recordings_at};
use crate::recording::recorded_rig;
use crate::rig::{Embedded, Rig, RigError};
use crate::session::conditions;
use crate::sound::Settings;
use crate::sound::matching::Criteria;
use crate::text::hex::hex;

listed! {
    /// What is done with each recording.
    #[derive(Deserialize)]
    #[serde(rename_all = "kebab-case")]
    enum What {
        /// As `replay --verify`.
        Verify,
        /// As `predict-log`.
        Predict,
        /// As `report`.
        Report,
        /// As `score`.
        Score,
    }
}

/// `[recordings]` of a study file.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RawRecordings {
    paths: Vec<String>,
    what: What,
    rig: Option<String>,
}

/// Recordings, and what is done with each.
#[derive(Debug, Default)]
pub struct Recordings {
    /// Name and path of each.
    recordings: Vec<(String, PathBuf)>,
    what: Option<What>,
    rig: Option<Arc<Rig>>,
    inputs_sha256: String,
}

impl Recordings {
    /// The recordings that a study file in `folder` names.
    ///
    /// # Errors
    /// [`StudyError`]: a path without a recording, or a rig that cannot be read.
    pub fn read(file: &str, raw: &RawRecordings, folder: &Path) -> Result<Self, StudyError> {
        let RawRecordings { paths, what, rig } = raw;
        let missing = |field: &str, limit: &str| RigError::MissingKey {
            file: file.to_owned(),
            field: format!("recordings.{field}"),
            limit: limit.to_owned(),
        };
        if paths.is_empty() {
            return Err(missing("paths", "at least one recording, or a folder of some").into());
        }
        match (what, rig) {
            (What::Predict, None) => return Err(missing("rig", "the rig to predict with").into()),
            (What::Score, Some(_)) => {
                let (file, field) = (file.to_owned(), "recordings.rig".to_owned());
                let (value, limit) = ("is given".to_owned(), "no rig: scores are of recorded predictions".to_owned());
                return Err(RigError::Kind { file, field, value, limit }.into());
            }
            (What::Predict, Some(_)) | (What::Verify | What::Report, _) | (What::Score, None) => {}
        }
        let rig = match rig.as_deref() {
            None => None,
            Some(name) => Some(match Embedded::named(name) {
                Some(embedded) => Rig::from_files(&embedded.files())?,
                None => Rig::load(&folder.join(name).to_string_lossy())?,
            }),
        };
        let mut recordings = vec![];
        for path in paths {
            for found in recordings_at(&folder.join(path))? {
                let name = found.strip_prefix(folder).unwrap_or(&found).display().to_string();
                recordings.push((name, found));
            }
        }
        let mut hasher = Sha256::new();
        hasher.update(rig.as_ref().map_or("", |rig| rig.content_hash.as_str()));
        for (name, path) in &recordings {
            hasher.update((name.len() as u64).to_le_bytes());
            hasher.update(name);
            for (file, bytes) in files_of(path).map_err(|source| folder_error(path, source))? {
                hasher.update(file.display().to_string().strip_prefix(&path.display().to_string()).unwrap_or_default());
                hasher.update(bytes.to_le_bytes());
            }
        }
        let inputs_sha256 = hex(&hasher.finalize());
        Ok(Self { recordings, what: Some(*what), rig: rig.map(Arc::new), inputs_sha256 })
    }

    pub fn count(&self) -> usize {
        self.recordings.len()
    }

    pub fn inputs_sha256(&self) -> String {
        self.inputs_sha256.clone()
    }

    pub fn own_columns() -> Vec<Column> {
        vec![Column::new("recording", Kind::Text)]
    }

    pub fn own_cells(&self, case: u64) -> Vec<Cell> {
        let name = self.recordings.get(case as usize).map(|(name, _)| name.clone());
        vec![name.map_or(Cell::Missing, Cell::Text)]
    }

    pub fn result_columns(&self) -> Vec<Column> {
        let own: &[(&str, Kind)] = match self.what {
            None => &[],
            Some(What::Verify) => &[
                ("inputs", Kind::Whole),
                ("predicted", Kind::Whole),
                ("identical", Kind::Whole),
                ("different", Kind::Whole),
                ("missing", Kind::Whole),
                ("extra", Kind::Whole),
                ("different_maps", Kind::Whole),
                ("frequency_difference_relative", Kind::Number),
                ("growth_rate_difference_per_s", Kind::Number),
                ("squeals_identical", Kind::Whole),
                ("squeals_differing", Kind::Whole),
                ("agrees", Kind::Whole),
            ],
            Some(What::Predict) => &[
                ("inputs", Kind::Whole),
                ("ok", Kind::Whole),
                ("warn", Kind::Whole),
                ("squeal", Kind::Whole),
                ("fault", Kind::Whole),
                ("squeals_heard", Kind::Whole),
                ("output", Kind::Text),
            ],
            Some(What::Report) => &[
                ("inputs", Kind::Whole),
                ("predicted", Kind::Whole),
                ("events", Kind::Whole),
                ("span_s", Kind::Number),
                ("output", Kind::Text),
            ],
            Some(What::Score) => &[
                ("channels", Kind::Whole),
                ("judged_s", Kind::Number),
                ("hits", Kind::Whole),
                ("misses", Kind::Whole),
                ("harmonics", Kind::Whole),
                ("squeals_not_judged", Kind::Whole),
                ("confirmed", Kind::Whole),
                ("false_alarms", Kind::Whole),
                ("predictions_not_judged", Kind::Whole),
                ("recall", Kind::Number),
                ("precision", Kind::Number),
                ("mcc", Kind::Number),
                ("slot_s", Kind::Number),
                ("slots_hit", Kind::Whole),
                ("slots_missed", Kind::Whole),
                ("slots_false_alarm", Kind::Whole),
                ("slots_quiet", Kind::Whole),
                ("least_lead_s", Kind::Number),
                ("median_lead_s", Kind::Number),
                ("longest_lead_s", Kind::Number),
            ],
        };
        let shared = [("recording_bytes", Kind::Whole), ("recording_sha256", Kind::Text), ("damaged", Kind::Whole)];
        shared.iter().chain(own).map(|(name, kind)| Column::new(name, *kind)).collect()
    }

    /// The results of a recording; `output` is the folder of the study.
    ///
    /// # Errors
    /// The reason in words.
    pub fn compute(&self, case: u64, output: &Path) -> Result<Vec<Cell>, String> {
        let (Some((_, path)), Some(what)) = (self.recordings.get(case as usize), self.what) else {
            return Err("there is no such recording".to_owned());
        };
        let (bytes, sha256) = content(path).map_err(|error| error.to_string())?;
        let mut cells = vec![Cell::count(bytes), Cell::Text(sha256)];
        let (damaged, own) = match what {
            What::Verify => self.verify(path),
            What::Predict => self.predict(path, &place(output, case, path)),
            What::Report => self.report(path, &place(output, case, path)),
            What::Score => score(path),
        }?;
        cells.push(Cell::Whole(damaged.into()));
        cells.extend(own);
        Ok(cells)
    }

    /// The rig of the study, else that of the recording.
    fn rig(&self, recording: &Recording) -> Result<Arc<Rig>, String> {
        match &self.rig {
            Some(rig) => Ok(rig.clone()),
            None => recorded_rig(recording).map(Arc::new).map_err(words),
        }
    }

    fn verify(&self, path: &Path) -> Result<(bool, Vec<Cell>), String> {
        let recording = with_predictions(path)?;
        let found = verify(&recording, &self.rig(&recording)?, Charts::Anew).map_err(words)?;
        let sound = verify_sound(&recording, recorded_settings(&recording));
        let agrees = found.agrees() && sound.as_ref().is_none_or(|sound| sound.agrees());
        let lost = recording.damage().iter().chain(&found.damage).any(|damage| damage.damage.loses_data);
        let whole = |count: u64| Cell::Whole(count as i64);
        let cells = vec![
            whole(found.inputs),
            whole(found.predicted),
            whole(found.identical),
            whole(found.different),
            whole(found.missing),
            whole(found.extra),
            whole(found.different_maps),
            Cell::Number(found.frequency_difference),
            Cell::Number(found.growth_rate_difference_per_s),
            sound.as_ref().map_or(Cell::Missing, |sound| whole(sound.identical)),
            sound.as_ref().map_or(Cell::Missing, |sound| whole(sound.different + sound.missing + sound.extra)),
            Cell::Whole(agrees.into()),
        ];
        Ok((lost, cells))
    }

    fn predict(&self, path: &Path, place: &Path) -> Result<(bool, Vec<Cell>), String> {
        let rig = self.rig.clone().ok_or("no rig to predict with")?;
        empty(place)?;
        let (lost, predicted) = if path.is_dir() || is_recording(path).map_err(words)? {
            let recording = Recording::open(path).map_err(words)?;
            if recording.topics().name_of(Topic::OperatingPoint).is_none() {
                return Err("holds no operating points to predict".to_owned());
            }
            let settings = recording.topics().name_of(Topic::Waveform).map(|_| Settings::default());
            let mut messages = recording.messages();
            let measured = messages.by_ref().filter_map(offline::measured);
            let predicted = offline::record(&rig, None, offline::points(&recording), measured, settings, place);
            (recording.damage().iter().chain(messages.damage()).any(|damage| damage.damage.loses_data), predicted)
        } else {
            let (_, log) = read_log(path, &LogOptions::default()).map_err(words)?;
            let inputs = || log.samples.iter().zip(0..).map(|(sample, seq)| operating_point(seq, sample));
            let measured = inputs().zip(&log.samples).flat_map(|(input, sample)| {
                let heat = temperature(sample).map(Quantity::Temperature);
                heat.into_iter().chain([Quantity::Conditions(input)]).map(Measured::at_its_stamp)
            });
            let points = inputs().map(|input| conditions(&input));
            (false, offline::record(&rig, None, points, measured, None, place))
        };
        let Predicted { inputs, levels, sound, .. } = predicted.map_err(words)?;
        let mut cells = vec![Cell::Whole(inputs as i64)];
        cells.extend(levels.map(|count| Cell::Whole(count as i64)));
        cells.push(sound.map_or(Cell::Missing, |sound| Cell::Whole(sound.squeals as i64)));
        cells.push(named(place));
        Ok((lost, cells))
    }

    fn report(&self, path: &Path, place: &Path) -> Result<(bool, Vec<Cell>), String> {
        let recording = Arc::new(with_predictions(path)?);
        let recorded =
            Recorded::read(&recording, self.rig(&recording)?, crate::display::comparison::Criteria::default());
        if recorded.moments.is_empty() {
            return Err("holds no prediction that can be read".to_owned());
        }
        let origin = Origin {
            file: path.file_name().unwrap_or(path.as_os_str()).to_string_lossy().into_owned(),
            version: recording.session_metadata("squealcast_version").map(str::to_owned),
        };
        let html = report(&recorded, &origin).map_err(words)?;
        empty(place)?;
        let write = |name: &str, bytes: &[u8]| write_whole(&place.join(name), |out| io::Write::write_all(out, bytes));
        write("report.html", html.as_bytes()).map_err(words)?;
        write("events.csv", recorded.events.to_csv().as_bytes()).map_err(words)?;
        let lost = recording.damage().iter().chain(&recorded.damage).any(|damage| damage.damage.loses_data);
        let cells = vec![
            Cell::Whole(recorded.inputs as i64),
            Cell::Whole(recorded.answered as i64),
            Cell::Whole(recorded.events.count() as i64),
            Cell::maybe(recorded.span_s().map(|(from_s, to_s)| to_s - from_s)),
            named(place),
        ];
        Ok((lost, cells))
    }
}

fn score(path: &Path) -> Result<(bool, Vec<Cell>), String> {
    let recording = with_predictions(path)?;
    let (met, lost) = met(&recording, &Criteria::default());
    let mut sum = Sum::default();
    met.iter().for_each(|met| sum.add(met));
    let row = sum.row();
    let whole = |count: u64| Cell::Whole(count as i64);
    let cells = vec![
        Cell::count(met.len()),
        Cell::Number(row.judged_s),
        whole(row.hits),
        whole(row.misses),
        whole(row.harmonics),
        whole(row.squeals_not_judged),
        whole(row.confirmed),
        whole(row.false_alarms),
        whole(row.predictions_not_judged),
        Cell::maybe(row.recall),
        Cell::maybe(row.precision),
        Cell::maybe(row.mcc),
        Cell::Number(row.slot_s),
        whole(row.slots_hit),
        whole(row.slots_missed),
        whole(row.slots_false_alarm),
        whole(row.slots_quiet),
        Cell::maybe(row.least_lead_s),
        Cell::maybe(row.median_lead_s),
        Cell::maybe(row.longest_lead_s),
    ];
    Ok((lost, cells))
}

fn with_predictions(path: &Path) -> Result<Recording, String> {
    let recording = Recording::open(path).map_err(words)?;
    match recording.topics().name_of(Topic::Prediction) {
        Some(_) => Ok(recording),
        None => Err("holds no predictions".to_owned()),
    }
}

/// Where the files of a case go.
fn place(output: &Path, case: u64, path: &Path) -> PathBuf {
    let name = path.file_stem().unwrap_or(path.as_os_str()).to_string_lossy();
    output.join("recordings").join(format!("{case:06}-{name}"))
}

/// A folder with nothing in it: what an earlier attempt left there is removed.
fn empty(place: &Path) -> Result<(), String> {
    let removed = if place.exists() { fs::remove_dir_all(place) } else { Ok(()) };
    removed.and_then(|()| fs::create_dir_all(place)).map_err(|error| format!("{}: {error}", place.display()))
}

/// The folder of a case, as it is called in the folder of the study.
fn named(place: &Path) -> Cell {
    let name = place.file_name().unwrap_or_default().to_string_lossy();
    Cell::Text(format!("recordings/{name}"))
}

/// The files of a recording in order of name, with their sizes.
fn files_of(path: &Path) -> io::Result<Vec<(PathBuf, u64)>> {
    if !path.is_dir() {
        return Ok(vec![(path.to_owned(), fs::metadata(path)?.len())]);
    }
    let mut files = vec![];
    for entry in fs::read_dir(path)? {
        let (path, metadata) = entry.and_then(|entry| Ok((entry.path(), fs::metadata(entry.path())?)))?;
        if metadata.is_file() {
            files.push((path, metadata.len()));
        }
    }
    files.sort();
    Ok(files)
}

/// Size and hash of the files of a recording.
fn content(path: &Path) -> io::Result<(usize, String)> {
    let (mut hasher, mut bytes) = (Sha256::new(), 0);
    let mut buffer = vec![0; 1 << 16];
    for (path, _) in files_of(path)? {
        let mut file = input_file::open(&path, input_file::ANY_SIZE)?;
        loop {
            let count = file.read(&mut buffer)?;
            if count == 0 {
                break;
            }
            hasher.update(&buffer[..count]);
            bytes += count;
        }
    }
    Ok((bytes, hex(&hasher.finalize())))
}

fn folder_error(path: &Path, source: io::Error) -> StudyError {
    StudyError::Folder { folder: path.display().to_string(), source }
}

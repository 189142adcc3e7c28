//! What a study is of, and what a case of it computes.

use std::f64::consts::TAU;
use std::path::{Path, PathBuf};

use serde::Deserialize;
use sha2::{Digest, Sha256};

use super::StudyError;
use super::key::Number;
use super::parameter::{Parameter, Target};
use super::recordings::Recordings;
use super::table::{Cell, Column, Kind};
use crate::analysis::condition::{Condition, Place};
use crate::export::{Besides, write_full_model};
use crate::fem::tribometer::{Properties, Tribometer};
use crate::full_model::FullModelFile;
use crate::full_model::verification::DEFAULT_BAND_HZ;
use crate::msgs::listed;
use crate::physics::{MapOptions, Solver, StabilityMap, Summary, Vectors};
use crate::reduction::{FullSolver, FullVectors, OwnEngine};
use crate::rig::{Embedded, Rig, RigError};
use crate::session::map_options;
use crate::text::hex::hex;

listed! {
    /// Results of a case, as study files name them.
    #[derive(Deserialize)]
    #[serde(rename_all = "kebab-case")]
    pub enum Results {
        /// Number of unstable modes, largest growth rate and its frequency.
        Spectrum,
        /// Frequencies and growth rates of all modes of the band.
        Modes,
        /// Windows of instability over the friction coefficient.
        Windows,
    }
}

/// Which results a study computes.
#[derive(Clone, Copy, Debug, Default)]
pub struct Wanted {
    pub spectrum: bool,
    pub modes: bool,
    pub windows: bool,
    /// Largest friction coefficient searched, instead of the rig's own.
    pub mu_max: Option<f64>,
    /// Upper end of the band of a full model, Hz, instead of its own.
    pub band_hz: Option<f64>,
}

/// `[tribometer]` of a study file.
#[derive(Clone, Debug, Default, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct RawTribometer {
    dof: Option<usize>,
    rotation: bool,
    lining: bool,
}

/// Degrees of freedom of a tribometer unless the study says otherwise, and the range.
const DOF: usize = 5_000;
const DOF_RANGE: [usize; 2] = [5_000, 4_000_000];

/// What a study is of.
#[derive(Debug)]
pub enum Subject {
    Rig(Box<StudiedRig>),
    Full(StudiedFull),
    Recordings(Recordings),
}

/// A rig whose file is changed.
#[derive(Debug)]
pub struct StudiedRig {
    rig: Rig,
    table: toml::Table,
    wanted: Wanted,
}

/// A full model whose file is changed.
#[derive(Debug)]
pub struct StudiedFull {
    source: Source,
    wanted: Wanted,
    inputs_sha256: String,
}

/// Where a full model comes from.
#[derive(Debug)]
enum Source {
    File(PathBuf),
    /// Made anew for each case.
    Tribometer {
        dof: usize,
        besides: Besides,
    },
}

impl StudiedFull {
    pub fn is_tribometer(&self) -> bool {
        match self.source {
            Source::File(_) => false,
            Source::Tribometer { .. } => true,
        }
    }
}

impl Subject {
    /// The embedded rig of that name, otherwise the rig file at that path relative to `folder`.
    ///
    /// # Errors
    /// [`StudyError::File`].
    pub fn rig(name: &str, folder: &Path, wanted: Wanted) -> Result<Self, StudyError> {
        let rig = match Embedded::named(name) {
            Some(embedded) => Rig::from_files(&embedded.files())?,
            None => Rig::load(&folder.join(name).to_string_lossy())?,
        };
        let text = rig.files.first().map(|file| String::from_utf8_lossy(&file.bytes)).unwrap_or_default();
        let table = parsed(&rig.name, text.as_bytes())?;
        Ok(Self::Rig(Box::new(StudiedRig { rig, table, wanted })))
    }

    /// The full model at `path`, which is read once to learn that it can be.
    ///
    /// # Errors
    /// [`StudyError::File`].
    pub fn full_model(path: PathBuf, wanted: Wanted) -> Result<Self, StudyError> {
        let inputs_sha256 = FullModelFile::load(&path)?.content_hash;
        Ok(Self::Full(StudiedFull { source: Source::File(path), wanted, inputs_sha256 }))
    }

    /// The reference tribometer.
    ///
    /// # Errors
    /// [`StudyError::File`].
    pub fn tribometer(file: &str, raw: RawTribometer, wanted: Wanted) -> Result<Self, StudyError> {
        let [least, most] = DOF_RANGE;
        let dof = raw.dof.unwrap_or(DOF);
        if !(least..=most).contains(&dof) {
            let (file, field) = (file.to_owned(), "tribometer.dof".to_owned());
            return Err(
                RigError::Range { file, field, value: dof.to_string(), limit: format!("{least} to {most}") }.into()
            );
        }
        let besides = Besides { rotation: raw.rotation, lining: raw.lining };
        // The program is its only input.
        let inputs_sha256 = hex(&Sha256::digest(b"reference tribometer"));
        Ok(Self::Full(StudiedFull { source: Source::Tribometer { dof, besides }, wanted, inputs_sha256 }))
    }

    /// Hash of the files that the study reads.
    pub fn inputs_sha256(&self) -> String {
        match self {
            Self::Rig(studied) => studied.rig.content_hash.clone(),
            Self::Full(full) => full.inputs_sha256.clone(),
            Self::Recordings(recordings) => recordings.inputs_sha256(),
        }
    }

    /// The columns that say which case it is, other than its parameters.
    pub fn own_columns(&self) -> Vec<Column> {
        match self {
            Self::Rig(_) | Self::Full(_) => vec![],
            Self::Recordings(_) => Recordings::own_columns(),
        }
    }

    /// Their cells in a case.
    pub fn own_cells(&self, case: u64) -> Vec<Cell> {
        match self {
            Self::Rig(_) | Self::Full(_) => vec![],
            Self::Recordings(recordings) => recordings.own_cells(case),
        }
    }

    /// The columns of results.
    pub fn result_columns(&self) -> Vec<Column> {
        let (wanted, full) = match self {
            Self::Rig(studied) => (studied.wanted, false),
            Self::Full(full) => (full.wanted, true),
            Self::Recordings(recordings) => return recordings.result_columns(),
        };
        let mut columns = vec![];
        if full {
            columns.push(("degrees_of_freedom", Kind::Whole));
            columns.push(("covered_growth_per_s", Kind::Number));
        }
        if wanted.spectrum {
            columns.push(("unstable_modes", Kind::Whole));
            columns.push(("max_growth_rate_per_s", Kind::Number));
            columns.push(("fastest_frequency_hz", Kind::Number));
        }
        if wanted.modes {
            columns.push(("mode_frequencies_hz", Kind::List));
            columns.push(("mode_growth_rates_per_s", Kind::List));
        }
        if wanted.windows {
            columns.push(("critical_friction", Kind::Number));
            columns.push(("critical_frequency_hz", Kind::Number));
            columns.push(("windows", Kind::Whole));
            columns.push(("windows_mu_from", Kind::List));
            columns.push(("windows_mu_to", Kind::List));
            columns.push(("narrowest_window_mu", Kind::Number));
            columns.push(("searched_to_mu", Kind::Number));
        }
        columns.into_iter().map(|(name, kind)| Column::new(name, kind)).collect()
    }

    /// The results of a case, a cell for each of [`Self::result_columns`]; on failure the reason. `output` is the folder of
    /// the study, `memory` what a full model may take in addition, bytes.
    ///
    /// # Errors
    /// The reason in words.
    pub fn compute(
        &self,
        case: u64,
        parameters: &[Parameter],
        values: &[Number],
        output: &Path,
        memory: Option<usize>,
    ) -> Result<Vec<Cell>, String> {
        match self {
            Self::Rig(studied) => studied.compute(parameters, values),
            Self::Full(full) => full.compute(parameters, values, &output.join(format!(".case-{case}")), memory),
            Self::Recordings(recordings) => recordings.compute(case, output),
        }
    }
}

fn parsed(name: &str, text: &[u8]) -> Result<toml::Table, RigError> {
    crate::rig::raw::parse(name, text)
}

/// Changes the keys that parameters name; whether any did.
fn change_keys(table: &mut toml::Table, parameters: &[Parameter], values: &[Number]) -> Result<bool, String> {
    let mut changed = false;
    for (parameter, &value) in parameters.iter().zip(values) {
        if let Target::Key { path, relative } = &parameter.target {
            let told = |error| format!("`{}` {error}", path.as_str());
            path.change(table, Target::change(*relative, value)).map_err(told)?;
            changed = true;
        }
    }
    Ok(changed)
}

/// A place with the conditions that parameters name.
fn with_conditions(place: Place, parameters: &[Parameter], values: &[Number]) -> Place {
    parameters.iter().zip(values).fold(place, |place, (parameter, value)| match &parameter.target {
        Target::Condition(condition) => condition.set(place, value.value()),
        Target::Key { .. } | Target::Tribometer { .. } => place,
    })
}

pub fn words(error: impl std::error::Error) -> String {
    let mut text = error.to_string();
    let mut cause = error.source();
    while let Some(next) = cause {
        let next_text = next.to_string();
        if !text.ends_with(&next_text) {
            text += &format!(": {next_text}");
        }
        cause = next.source();
    }
    text
}

impl StudiedRig {
    fn compute(&self, parameters: &[Parameter], values: &[Number]) -> Result<Vec<Cell>, String> {
        let mut table = self.table.clone();
        let changed = change_keys(&mut table, parameters, values)?.then(|| {
            let mut files = self.rig.files.clone();
            if let Some(first) = files.first_mut() {
                first.bytes = table.to_string().into_bytes();
            }
            Rig::from_files(&files)
        });
        let changed = changed.transpose().map_err(words)?;
        let rig = changed.as_ref().unwrap_or(&self.rig);
        let place = Place { point: rig.reference, temperature_c: rig.temperature_c() };
        let place = with_conditions(place, parameters, values);
        place.check(rig).map_err(words)?;
        let rig = place.rig(rig).map_err(words)?;
        let mut solver = Solver::new(rig.model.dimension());
        let mut cells = vec![];
        if self.wanted.spectrum || self.wanted.modes {
            let spectrum = solver.solve(&rig.model, &place.point, Vectors::Right).map_err(words)?;
            let summary = Summary::of_spectrum(&spectrum, None, rig.band_max_hz, rig.instability_threshold);
            if self.wanted.spectrum {
                cells.push(Cell::Whole(summary.unstable_modes.into()));
                cells.push(Cell::maybe(summary.max_growth_rate_per_s));
                cells.push(Cell::maybe(summary.worst_frequency_hz));
            }
            if self.wanted.modes {
                cells.push(Cell::List(summary.modes.iter().map(|mode| mode.root.frequency_hz()).collect()));
                cells.push(Cell::List(summary.modes.iter().map(|mode| mode.root.growth_rate_per_s()).collect()));
            }
        }
        if self.wanted.windows {
            let mu_max = self.wanted.mu_max.unwrap_or(rig.mu_max);
            let options = MapOptions { mu_max, ..map_options(&rig) };
            let map = StabilityMap::build(&rig.model, &mut solver, &place.point, &options).map_err(words)?;
            if !map.complete {
                return Err("the windows could not be resolved: the stability map has too many nodes".to_owned());
            }
            cells.extend(windows(&map, mu_max));
        }
        Ok(cells)
    }
}

fn windows(map: &StabilityMap, mu_max: f64) -> [Cell; 7] {
    let critical = map.critical_friction();
    let first = map.windows.iter().find(|window| Some(window.mu_from) == critical);
    [
        Cell::maybe(critical),
        Cell::maybe(first.map(|window| window.frequency_hz)),
        Cell::count(map.windows.len()),
        Cell::List(map.windows.iter().map(|window| window.mu_from).collect()),
        Cell::List(map.windows.iter().map(|window| window.mu_to.unwrap_or(f64::NAN)).collect()),
        Cell::Number(map.resolution),
        Cell::Number(map.sliding_ends.as_ref().map_or(mu_max, |end| end.mu)),
    ]
}

impl StudiedFull {
    fn compute(
        &self,
        parameters: &[Parameter],
        values: &[Number],
        work: &Path,
        memory: Option<usize>,
    ) -> Result<Vec<Cell>, String> {
        match &self.source {
            Source::File(path) => self.solve(path, parameters, values, memory),
            Source::Tribometer { dof, besides } => {
                let mut properties = Properties::default();
                for (parameter, value) in parameters.iter().zip(values) {
                    if let Target::Tribometer { property, relative } = &parameter.target {
                        let number = (property.of)(&mut properties);
                        *number = if *relative { *number * value.value() } else { value.value() };
                    }
                }
                let tribometer = Tribometer::with_dof(&properties, *dof).map_err(words)?;
                // Left behind if this was killed before.
                let removed = || if work.exists() { std::fs::remove_dir_all(work) } else { Ok(()) };
                removed().map_err(words)?;
                let told = write_full_model(&tribometer, *besides, work, |_| ())
                    .map_err(words)
                    .and_then(|()| self.solve(&work.join("tribometer.toml"), parameters, values, memory));
                removed().map_err(words)?;
                // The folder is another wherever the study is computed.
                told.map_err(|reason| reason.replace(&format!("{}/", work.display()), ""))
            }
        }
    }

    fn solve(
        &self,
        path: &Path,
        parameters: &[Parameter],
        values: &[Number],
        memory: Option<usize>,
    ) -> Result<Vec<Cell>, String> {
        let name = path.display().to_string();
        let mut table = parsed(&name, &FullModelFile::toml(path).map_err(words)?).map_err(words)?;
        change_keys(&mut table, parameters, values)?;
        let mut full = FullModelFile::load_as(path, table.to_string().as_bytes()).map_err(words)?;
        let heated = |parameter: &Parameter| matches!(parameter.target, Target::Condition(Condition::Temperature));
        if parameters.iter().any(heated) {
            return Err("`temperature_c`: a full model does not follow the temperature".to_owned());
        }
        let reference = Place { point: full.settings.reference, temperature_c: None };
        let point = with_conditions(reference, parameters, values).point;
        full.settings.limits.check(&point).map_err(words)?;
        let band_hz = self.wanted.band_hz.or(full.settings.band_max_hz).unwrap_or(DEFAULT_BAND_HZ);
        full.damp_modes(&OwnEngine, memory, &mut |_, _| {}).map_err(words)?;
        full.find_statics(&OwnEngine, memory).map_err(words)?;
        let mut solver = FullSolver::new(&full.name, &full.model, memory, &mut |_| {}).map_err(words)?;
        let found = solver.roots(&point, TAU * band_hz, FullVectors::None, &mut |_| {}).map_err(words)?;
        let threshold = full.settings.instability_threshold;
        let mut cells = vec![Cell::count(full.model.dimension()), Cell::Number(found.covered_growth_per_s)];
        let roots: Vec<_> = found.roots.iter().map(|root| root.lambda).collect();
        if self.wanted.spectrum {
            let fastest = roots.iter().max_by(|a, b| a.re.total_cmp(&b.re));
            let unstable = |lambda: &&faer::c64| lambda.re > threshold * lambda.norm();
            cells.push(Cell::count(roots.iter().filter(unstable).count()));
            cells.push(Cell::maybe(fastest.map(|lambda| lambda.re)));
            cells.push(Cell::maybe(fastest.filter(unstable).map(|lambda| lambda.im / TAU)));
        }
        if self.wanted.modes {
            cells.push(Cell::List(roots.iter().map(|lambda| lambda.im / TAU).collect()));
            cells.push(Cell::List(roots.iter().map(|lambda| lambda.re).collect()));
        }
        Ok(cells)
    }
}

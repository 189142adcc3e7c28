//! Study files: raw form and validation.

use std::collections::BTreeSet;
use std::path::Path;

use serde::Deserialize;
use sha2::{Digest, Sha256};

use super::design::{Design, DesignKind, MOST_CASES, MOST_PARAMETERS, MOST_PLACES};
use super::key::Number;
use super::parameter::{Parameter, RawParameter, Target};
use super::recordings::{RawRecordings, Recordings};
use super::subject::{RawTribometer, Results, Subject, Wanted};
use super::table::Cell;
use super::{CASE, Identity, StudyError};
use crate::files::input_file;
use crate::msgs::listed;
use crate::rig::{RigError, raw};
use crate::text::hex::hex;

/// Cases of a rig that are computed together and written as one file, unless the study says otherwise.
const CASES_PER_FILE: u64 = 100;

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct RawStudy {
    name: String,
    /// [`raw::parse`] has checked it.
    #[serde(rename = "format")]
    _format: Option<i64>,
    rig: Option<String>,
    full_model: Option<String>,
    tribometer: Option<RawTribometer>,
    recordings: Option<RawRecordings>,
    #[serde(default)]
    design: RawDesign,
    compute: Option<RawCompute>,
    #[serde(default)]
    parameter: Vec<RawParameter>,
    cases_per_file: Option<u64>,
}

#[derive(Debug, Default, Deserialize)]
#[serde(deny_unknown_fields)]
struct RawDesign {
    kind: Option<DesignKind>,
    cases: Option<u64>,
    seed: Option<u64>,
}

#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct RawCompute {
    what: Vec<Results>,
    mu_max: Option<f64>,
    band_hz: Option<f64>,
}

listed! {
    /// What a study is of: the key or table of its file that says so.
    enum Of {
        Rig,
        FullModel,
        Tribometer,
        Recordings,
    }
}

impl Of {
    fn key(self) -> &'static str {
        match self {
            Self::Rig => "rig",
            Self::FullModel => "full_model",
            Self::Tribometer => "tribometer",
            Self::Recordings => "recordings",
        }
    }
}

/// A study: its cases, and what each of them computes.
#[derive(Debug)]
pub struct Study {
    pub name: String,
    pub parameters: Vec<Parameter>,
    pub subject: Subject,
    pub cases: u64,
    pub cases_per_file: u64,
    design: Design,
    /// The text of the study file.
    pub text: String,
    pub identity: Identity,
}

impl Study {
    /// Reads the study file at `path`, and the files of what it is of, which it names relative to itself.
    ///
    /// # Errors
    /// [`StudyError`], naming file, field, value and limit.
    pub fn load(path: &Path) -> Result<Self, StudyError> {
        let file = path.display().to_string();
        let bytes = input_file::read(path, input_file::TOML).map_err(|error| RigError::NoSuchFile {
            value: file.clone(),
            reason: error.to_string(),
            limit: "a study file".to_owned(),
        })?;
        Self::read(&file, &bytes, path.parent().unwrap_or(Path::new("")))
    }

    /// As [`Self::load`], with the content of the study file, which is in `folder`.
    ///
    /// # Errors
    /// As [`Self::load`].
    pub fn read(file: &str, bytes: &[u8], folder: &Path) -> Result<Self, StudyError> {
        let study: RawStudy = raw::parse(file, bytes)?;
        let parameters = read_parameters(file, &study)?;
        let subject = read_subject(file, &study, folder)?;
        check_targets(file, &parameters, &subject)?;
        let design = read_design(file, &study.design, &parameters, &subject)?;
        let cases = design.cases();
        let default = if matches!(subject, Subject::Rig(_)) { CASES_PER_FILE } else { 1 };
        let cases_per_file = study.cases_per_file.unwrap_or(default);
        if !(1..=MOST_CASES).contains(&cases_per_file) {
            return Err(out_of_range(file, "cases_per_file", cases_per_file.to_string(), format!("1 to {MOST_CASES}")));
        }
        let identity = Identity {
            study_sha256: hex(&Sha256::digest(bytes)),
            inputs_sha256: subject.inputs_sha256(),
            version: env!("CARGO_PKG_VERSION").to_owned(),
            cases,
            cases_per_file,
        };
        let text = String::from_utf8_lossy(bytes).into_owned();
        Ok(Self { name: study.name, parameters, subject, cases, cases_per_file, design, text, identity })
    }

    /// The values of the parameters in a case.
    pub fn values(&self, case: u64) -> Vec<Number> {
        self.parameters.iter().zip(self.design.point(case)).map(|(parameter, at)| parameter.value(at)).collect()
    }

    /// The cases with their parameters, and of recordings their names, as comma-separated values.
    ///
    /// # Errors
    /// The text cannot be made.
    pub fn list(&self) -> Result<String, csv::Error> {
        let mut writer = csv::Writer::from_writer(vec![]);
        let own = self.subject.own_columns();
        let names = own.iter().map(|column| column.name.as_str());
        let parameters = self.parameters.iter().map(|parameter| parameter.column.as_str());
        writer.write_record([CASE].into_iter().chain(names).chain(parameters))?;
        for case in 0..self.cases {
            let own = self.subject.own_cells(case).into_iter().map(|cell| match cell {
                Cell::Text(text) => text,
                Cell::Whole(_) | Cell::Number(_) | Cell::List(_) | Cell::Missing => String::new(),
            });
            let values = self.values(case).into_iter().map(|value| value.value().to_string());
            writer.write_record([case.to_string()].into_iter().chain(own).chain(values))?;
        }
        let bytes = writer.into_inner().map_err(|error| csv::Error::from(error.into_error()))?;
        Ok(String::from_utf8_lossy(&bytes).into_owned())
    }
}

fn out_of_range(file: &str, field: &str, value: String, limit: String) -> StudyError {
    RigError::Range { file: file.to_owned(), field: field.to_owned(), value, limit }.into()
}

fn read_parameters(file: &str, study: &RawStudy) -> Result<Vec<Parameter>, StudyError> {
    if study.parameter.len() > MOST_PARAMETERS {
        let given = format!("a list of {}", study.parameter.len());
        return Err(out_of_range(file, "parameter", given, format!("at most {MOST_PARAMETERS}")));
    }
    let read = |(index, raw)| Parameter::read(file, index, raw);
    let parameters = study.parameter.iter().enumerate().map(read).collect::<Result<Vec<_>, _>>()?;
    let mut columns = BTreeSet::new();
    for (index, parameter) in parameters.iter().enumerate() {
        if !columns.insert(&parameter.column) {
            let limit = "another name for each column".to_owned();
            return Err(out_of_range(file, &format!("parameter[{index}].column"), parameter.column.clone(), limit));
        }
    }
    Ok(parameters)
}

/// What the study is of, with the results it wants.
fn read_subject(file: &str, study: &RawStudy, folder: &Path) -> Result<Subject, StudyError> {
    let given = |of: Of| match of {
        Of::Rig => study.rig.is_some(),
        Of::FullModel => study.full_model.is_some(),
        Of::Tribometer => study.tribometer.is_some(),
        Of::Recordings => study.recordings.is_some(),
    };
    let of: Vec<Of> = Of::ALL.into_iter().filter(|of| given(*of)).collect();
    let names = || Of::ALL.map(Of::key).join(", ");
    let [of] = of[..] else {
        let limit = format!("one of {}", names());
        return Err(RigError::MissingKey { file: file.to_owned(), field: "rig".to_owned(), limit }.into());
    };
    let wanted = read_compute(file, study.compute.as_ref(), of)?;
    let at = |name: &String| folder.join(name);
    let subject = match of {
        Of::Rig => Subject::rig(study.rig.as_deref().unwrap_or_default(), folder, wanted)?,
        Of::FullModel => Subject::full_model(study.full_model.as_ref().map(at).unwrap_or_default(), wanted)?,
        Of::Tribometer => Subject::tribometer(file, study.tribometer.clone().unwrap_or_default(), wanted)?,
        Of::Recordings => {
            let recordings: Option<Recordings> =
                study.recordings.as_ref().map(|raw| Recordings::read(file, raw, folder)).transpose()?;
            Subject::Recordings(recordings.unwrap_or_default())
        }
    };
    Ok(subject)
}

fn read_compute(file: &str, raw: Option<&RawCompute>, of: Of) -> Result<Wanted, StudyError> {
    let Some(RawCompute { what, mu_max, band_hz }) = raw else {
        return match of {
            Of::Recordings => Ok(Wanted::default()),
            Of::Rig | Of::FullModel | Of::Tribometer => Ok(Wanted { spectrum: true, ..Wanted::default() }),
        };
    };
    let refuse = |field: &str, limit: &str| {
        let value = "is given".to_owned();
        let (file, field, limit) = (file.to_owned(), format!("compute.{field}"), limit.to_owned());
        Err(RigError::Kind { file, field, value, limit }.into())
    };
    let windows = what.contains(&Results::Windows);
    match of {
        Of::Recordings => return refuse("what", "recordings.what"),
        Of::FullModel | Of::Tribometer if windows => {
            return refuse("what", "spectrum and modes: windows are of rigs; `reduce` makes a rig of a full model");
        }
        Of::Rig if band_hz.is_some() => return refuse("band_hz", "band.max_hz of the rig, which can be a parameter"),
        Of::Rig | Of::FullModel | Of::Tribometer => {}
    }
    if mu_max.is_some() && !windows {
        return refuse("mu_max", "it where windows are computed");
    }
    for (field, value) in [("compute.mu_max", mu_max), ("compute.band_hz", band_hz)] {
        if let Some(value) = value.filter(|value| !(value.is_finite() && *value > 0.0)) {
            return Err(out_of_range(file, field, value.to_string(), "more than 0".to_owned()));
        }
    }
    if what.is_empty() {
        return Err(out_of_range(file, "compute.what", "[]".to_owned(), "at least one result".to_owned()));
    }
    let has = |result: Results| what.contains(&result);
    Ok(Wanted {
        spectrum: has(Results::Spectrum),
        modes: has(Results::Modes),
        windows,
        mu_max: *mu_max,
        band_hz: *band_hz,
    })
}

/// Refuses parameters of what the study is not of.
fn check_targets(file: &str, parameters: &[Parameter], subject: &Subject) -> Result<(), StudyError> {
    for (index, parameter) in parameters.iter().enumerate() {
        let refused = match (&parameter.target, subject) {
            (_, Subject::Recordings(_)) => Some("no parameters: recordings are the cases"),
            (Target::Tribometer { .. }, Subject::Rig(_)) => Some("a study of [tribometer]"),
            (Target::Tribometer { .. }, Subject::Full(full)) if !full.is_tribometer() => {
                Some("a study of [tribometer]")
            }
            (Target::Key { .. } | Target::Condition(_) | Target::Tribometer { .. }, _) => None,
        };
        if let Some(limit) = refused {
            let (file, field) = (file.to_owned(), format!("parameter[{index}]"));
            let value = "is of something else".to_owned();
            return Err(RigError::Kind { file, field, value, limit: limit.to_owned() }.into());
        }
    }
    Ok(())
}

fn read_design(file: &str, raw: &RawDesign, parameters: &[Parameter], subject: &Subject) -> Result<Design, StudyError> {
    let kind = raw.kind.unwrap_or(DesignKind::Grid);
    let refuse = |field: &str, limit: &str| {
        let (value, limit) = ("is given".to_owned(), limit.to_owned());
        Err(RigError::Kind { file: file.to_owned(), field: format!("design.{field}"), value, limit }.into())
    };
    if let Subject::Recordings(recordings) = subject {
        return match raw.kind {
            Some(_) => refuse("kind", "no design: recordings are the cases"),
            None => Ok(Design::Grid(vec![recordings.count()])),
        };
    }
    let checked = |cases: u64, field: &str| {
        if (1..=MOST_CASES).contains(&cases) {
            return Ok(cases);
        }
        Err(out_of_range(file, field, format!("{cases} cases"), format!("1 to {MOST_CASES}")))
    };
    match kind {
        DesignKind::Grid => {
            if raw.cases.is_some() || raw.seed.is_some() {
                return refuse("cases", "neither cases nor seed for a grid: it has every combination");
            }
            let count = |(index, parameter): (usize, &Parameter)| {
                parameter.points().ok_or_else(|| RigError::MissingKey {
                    file: file.to_owned(),
                    field: format!("parameter[{index}].points"),
                    limit: "the number of values in a grid".to_owned(),
                })
            };
            let grid = Design::Grid(parameters.iter().enumerate().map(count).collect::<Result<_, _>>()?);
            checked(grid.cases(), "parameter")?;
            Ok(grid)
        }
        DesignKind::LatinHypercube | DesignKind::Sobol => {
            let missing = |field: &str, limit: &str| RigError::MissingKey {
                file: file.to_owned(),
                field: field.to_owned(),
                limit: limit.to_owned(),
            };
            let cases = raw.cases.ok_or_else(|| missing("design.cases", "the number of cases"))?;
            let cases = checked(cases, "design.cases")?;
            if parameters.is_empty() {
                return Err(missing("parameter", "at least one [[parameter]]").into());
            }
            if let Some(index) = parameters.iter().position(|parameter| parameter.has_points_of_a_range()) {
                let field = format!("parameter[{index}].points");
                return Err(out_of_range(file, &field, "given".to_owned(), "no such key but in a grid".to_owned()));
            }
            let places = cases.saturating_mul(parameters.len() as u64);
            if kind == DesignKind::LatinHypercube && places > MOST_PLACES {
                let given = format!("{cases} cases of {} parameters", parameters.len());
                let limit = format!("at most {MOST_PLACES} values; a Sobol sequence may have more");
                return Err(out_of_range(file, "design.cases", given, limit));
            }
            Ok(match kind {
                DesignKind::LatinHypercube => {
                    Design::latin_hypercube(cases, parameters.len(), raw.seed.unwrap_or_default())
                }
                DesignKind::Grid | DesignKind::Sobol => Design::sobol(cases, parameters.len(), raw.seed),
            })
        }
    }
}

//! Parameters of a study: what varies, and over which values.

use serde::Deserialize;

use super::design::Coordinate;
use super::key::{Change, KeyPath, Number};
use super::properties::{PROPERTIES, Property};
use crate::analysis::condition::Condition;
use crate::rig::RigError;

/// Most values of a parameter that are listed.
const MOST_VALUES: usize = 100_000;

/// `[[parameter]]` of a study file.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RawParameter {
    key: Option<String>,
    condition: Option<String>,
    tribometer: Option<String>,
    column: Option<String>,
    values: Option<Vec<Number>>,
    from: Option<f64>,
    to: Option<f64>,
    points: Option<usize>,
    #[serde(default)]
    scale: Scale,
    #[serde(default)]
    relative: bool,
}

/// How a range is divided.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "kebab-case")]
enum Scale {
    #[default]
    Linear,
    Log,
}

/// What a parameter is.
#[derive(Clone, Debug)]
pub enum Target {
    /// Numbers of the rig file or full model; if relative, values multiply what is there.
    Key {
        path: KeyPath,
        relative: bool,
    },
    Condition(Condition),
    /// A number of the reference tribometer; if relative, values multiply its default.
    Tribometer {
        property: Property,
        relative: bool,
    },
}

#[derive(Clone, Debug)]
enum Range {
    Values(Vec<Number>),
    Between { from: f64, to: f64, points: Option<usize>, scale: Scale },
}

/// A parameter.
#[derive(Clone, Debug)]
pub struct Parameter {
    pub target: Target,
    /// Name of its column.
    pub column: String,
    range: Range,
}

impl Parameter {
    /// Checks the `index`-th parameter of the study file `file`.
    ///
    /// # Errors
    /// [`RigError`], naming file, field, value and limit.
    pub fn read(file: &str, index: usize, raw: &RawParameter) -> Result<Self, RigError> {
        let field = |key: &str| format!("parameter[{index}].{key}");
        let target = target(file, &field, raw)?;
        let own = match &target {
            Target::Key { path, relative } => relative_name(path.column(), *relative),
            Target::Condition(condition) => condition.key().to_owned(),
            Target::Tribometer { property, relative } => relative_name(property.name.to_owned(), *relative),
        };
        let column = raw.column.clone().unwrap_or(own);
        let plain = |c: char| c.is_ascii_alphanumeric() || c == '_';
        if column.is_empty() || column.len() > 200 || !column.chars().all(plain) {
            let limit = "at most 200 letters, digits and underscores".to_owned();
            return Err(range(file, field("column"), column, limit));
        }
        Ok(Self { target, column, range: read_range(file, &field, raw)? })
    }

    /// Number of values in a grid; `None` if it has not been given.
    pub fn points(&self) -> Option<usize> {
        match &self.range {
            Range::Values(values) => Some(values.len()),
            Range::Between { points, .. } => *points,
        }
    }

    /// Whether a number of points was given for a range.
    pub fn has_points_of_a_range(&self) -> bool {
        matches!(self.range, Range::Between { points: Some(_), .. })
    }

    /// The value at a place of a design.
    pub fn value(&self, at: Coordinate) -> Number {
        match (&self.range, at) {
            (Range::Values(values), Coordinate::Listed(index)) => values[index],
            (Range::Values(values), Coordinate::Share(share)) => values[(share * values.len() as f64) as usize],
            (Range::Between { from, to, scale, .. }, Coordinate::Share(share)) => {
                Number::Real(between(*from, *to, *scale, share))
            }
            (Range::Between { from, to, points, scale }, Coordinate::Listed(index)) => {
                let last = points.map_or(1, |points| points - 1);
                let value = if index == last && last > 0 {
                    *to
                } else {
                    between(*from, *to, *scale, index as f64 / last.max(1) as f64)
                };
                Number::Real(value)
            }
        }
    }
}

impl Target {
    /// What a value of a key is changed to.
    pub fn change(relative: bool, number: Number) -> Change {
        if relative { Change::Times(number.value()) } else { Change::To(number) }
    }
}

fn between(from: f64, to: f64, scale: Scale, share: f64) -> f64 {
    match scale {
        Scale::Linear => from + (to - from) * share,
        Scale::Log => from * (to / from).powf(share),
    }
}

fn relative_name(name: String, relative: bool) -> String {
    if relative { format!("{name}_times") } else { name }
}

fn range(file: &str, field: String, value: String, limit: String) -> RigError {
    RigError::Range { file: file.to_owned(), field, value, limit }
}

fn target(file: &str, field: &impl Fn(&str) -> String, raw: &RawParameter) -> Result<Target, RigError> {
    let relative = raw.relative;
    match (&raw.key, &raw.condition, &raw.tribometer) {
        (Some(key), None, None) => {
            let path = KeyPath::parse(key).map_err(|error| RigError::Kind {
                file: file.to_owned(),
                field: field("key"),
                value: format!("= \"{key}\" {error}"),
                limit: "a path such as contact[0].stiffness_n_per_m".to_owned(),
            })?;
            Ok(Target::Key { path, relative })
        }
        (None, Some(name), None) => {
            let known = Condition::ALL.into_iter().find(|condition| condition.key() == name);
            let names = || format!("one of {}", Condition::ALL.map(Condition::key).join(", "));
            match known {
                Some(_) if relative => {
                    let limit = "false for a condition".to_owned();
                    Err(range(file, field("relative"), "true".to_owned(), limit))
                }
                Some(condition) => Ok(Target::Condition(condition)),
                None => Err(range(file, field("condition"), format!("\"{name}\""), names())),
            }
        }
        (None, None, Some(name)) => match Property::named(name) {
            Some(property) => Ok(Target::Tribometer { property, relative }),
            None => {
                let names: Vec<&str> = PROPERTIES.iter().map(|property| property.name).collect();
                let limit = format!("one of {}", names.join(", "));
                Err(range(file, field("tribometer"), format!("\"{name}\""), limit))
            }
        },
        (None, None, None) | (_, Some(_), Some(_)) | (Some(_), _, Some(_)) | (Some(_), Some(_), None) => {
            let limit = "one of key, condition and tribometer".to_owned();
            Err(RigError::MissingKey { file: file.to_owned(), field: field("key"), limit })
        }
    }
}

fn read_range(file: &str, field: &impl Fn(&str) -> String, raw: &RawParameter) -> Result<Range, RigError> {
    let limit = || "values, or from and to".to_owned();
    match (&raw.values, raw.from, raw.to) {
        (Some(values), None, None) => {
            if values.is_empty() || values.len() > MOST_VALUES {
                let limit = format!("1 to {MOST_VALUES} numbers");
                return Err(range(file, field("values"), format!("a list of {}", values.len()), limit));
            }
            if let Some(wrong) = values.iter().find(|value| !value.value().is_finite()) {
                return Err(RigError::NotFinite {
                    file: file.to_owned(),
                    field: field("values"),
                    value: wrong.value(),
                });
            }
            if raw.points.is_some() {
                return Err(range(file, field("points"), "given".to_owned(), "no such key beside values".to_owned()));
            }
            Ok(Range::Values(values.clone()))
        }
        (None, Some(from), Some(to)) => {
            for (key, value) in [("from", from), ("to", to)] {
                if !value.is_finite() {
                    return Err(RigError::NotFinite { file: file.to_owned(), field: field(key), value });
                }
            }
            if raw.scale == Scale::Log && (from <= 0.0 || to <= 0.0) {
                let least = from.min(to).to_string();
                return Err(range(file, field("from"), least, "more than 0 at both ends of a log scale".to_owned()));
            }
            if let Some(points) = raw.points.filter(|points| !(2..=MOST_VALUES).contains(points)) {
                return Err(range(file, field("points"), points.to_string(), format!("2 to {MOST_VALUES}")));
            }
            Ok(Range::Between { from, to, points: raw.points, scale: raw.scale })
        }
        (Some(_), Some(_), _) | (Some(_), None, Some(_)) | (None, None, _) | (None, Some(_), None) => {
            Err(RigError::MissingKey { file: file.to_owned(), field: field("values"), limit: limit() })
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(toml: &str) -> Result<Parameter, String> {
        let raw: RawParameter = toml::from_str(toml).map_err(|error| error.to_string())?;
        Parameter::read("study.toml", 2, &raw).map_err(|error| error.to_string())
    }

    fn values(parameter: &Parameter) -> Vec<f64> {
        let points = parameter.points().unwrap();
        (0..points).map(|index| parameter.value(Coordinate::Listed(index)).value()).collect()
    }

    #[test]
    fn ranges_end_where_they_say() {
        let linear = read("key = 'friction.slope_s_per_m'\nfrom = 0.1\nto = 0.7\npoints = 4").unwrap();
        assert_eq!((values(&linear)[0], values(&linear)[3]), (0.1, 0.7));
        let log = read("condition = 'normal_load_n'\nfrom = 10.0\nto = 1000.0\npoints = 3\nscale = 'log'").unwrap();
        assert_eq!((values(&log), log.column.as_str()), (vec![10.0, 100.0, 1000.0], "normal_load_n"));
        assert_eq!(log.value(Coordinate::Share(0.5)), Number::Real(100.0));
        let listed = read("tribometer = 'disc_thickness_m'\nvalues = [1, 2.5]\nrelative = true").unwrap();
        assert_eq!(listed.column, "disc_thickness_m_times");
        assert_eq!(listed.value(Coordinate::Share(0.49)), Number::Whole(1));
        assert_eq!(listed.value(Coordinate::Share(0.5)), Number::Real(2.5));
    }

    #[test]
    fn errors_name_file_field_value_and_limit() {
        let why = |toml: &str| read(toml).err().unwrap();
        assert_eq!(
            why("condition = 'load'\nvalues = [1]"),
            "study.toml: `parameter[2].condition` is \"load\", expected one of friction_coefficient, normal_load_n, \
             disc_speed_rad_s, temperature_c"
        );
        assert!(why("values = [1]").contains("expected one of key, condition and tribometer"));
        assert!(why("key = 'a'\ncondition = 'temperature_c'\nvalues = [1]").contains("one of key, condition"));
        assert!(why("key = 'a'\nfrom = 1").contains("expected values, or from and to"));
        assert!(why("key = 'a'\nfrom = -1.0\nto = 1.0\nscale = 'log'").contains("is -1, expected more than 0"));
        assert!(why("key = 'a'\nvalues = []").contains("a list of 0"));
        assert!(why("key = 'a'\nvalues = [nan]").contains("expected a finite number"));
        assert!(why("key = 'a..b'\nvalues = [1]").contains("is no key path"));
        assert!(why("tribometer = 'x'\nvalues = [1]").contains("one of pad_x_from_m, "));
        assert!(why("key = 'a'\nfrom = 0.0\nto = 1.0\npoints = 1").contains("expected 2 to 100000"));
    }
}

//! Places in a TOML file by dotted key path, and numbers put there.

use toml::{Table, Value};

/// A number as a study file writes it. TOML distinguishes whole numbers, and so do keys that count something.
#[derive(Clone, Copy, Debug, PartialEq, serde::Deserialize)]
#[serde(untagged, expecting = "expected a number")]
pub enum Number {
    Whole(i64),
    Real(f64),
}

impl Number {
    pub fn value(self) -> f64 {
        match self {
            Self::Whole(whole) => whole as f64,
            Self::Real(real) => real,
        }
    }

    fn to_toml(self) -> Value {
        match self {
            Self::Whole(whole) => Value::Integer(whole),
            Self::Real(real) => Value::Float(real),
        }
    }
}

/// Longest path, in steps.
const MOST_STEPS: usize = 16;

/// A path such as `contact[0].stiffness_n_per_m`. `[*]` is every entry of a list.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct KeyPath {
    text: String,
    steps: Vec<Step>,
}

#[derive(Clone, Debug, PartialEq, Eq)]
enum Step {
    Key(String),
    Entry(usize),
    Every,
}

/// What is put at a path.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Change {
    /// This number, also in place of every number of a list.
    To(Number),
    /// What is there, a number or a list of numbers, times this.
    Times(f64),
}

/// Why a path cannot be changed.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum KeyError {
    #[error("is no key path; expected names joined by dots, with [0] or [*] for entries of lists")]
    Path,
    #[error("has {steps} steps, expected at most {MOST_STEPS}")]
    Long { steps: usize },
    #[error("is not in the file, so it cannot be multiplied")]
    Absent,
    #[error("has no {at}: there is {there}")]
    Step { at: String, there: &'static str },
    #[error("is {there}, expected a number or a list of numbers")]
    NotANumber { there: &'static str },
}

impl KeyPath {
    /// # Errors
    /// [`KeyError::Path`], [`KeyError::Long`].
    pub fn parse(text: &str) -> Result<Self, KeyError> {
        let mut steps = vec![];
        for part in text.split('.') {
            let (name, mut rest) = part.split_at(part.find('[').unwrap_or(part.len()));
            let plain = |c: char| c.is_ascii_alphanumeric() || c == '_' || c == '-';
            if name.is_empty() || !name.chars().all(plain) {
                return Err(KeyError::Path);
            }
            steps.push(Step::Key(name.to_owned()));
            while !rest.is_empty() {
                let (index, after) =
                    rest.strip_prefix('[').and_then(|rest| rest.split_once(']')).ok_or(KeyError::Path)?;
                steps.push(match index {
                    "*" => Step::Every,
                    digits => Step::Entry(digits.parse().map_err(|_| KeyError::Path)?),
                });
                rest = after;
            }
        }
        if steps.len() > MOST_STEPS {
            return Err(KeyError::Long { steps: steps.len() });
        }
        Ok(Self { text: text.to_owned(), steps })
    }

    pub fn as_str(&self) -> &str {
        &self.text
    }

    /// The path as the name of a column: what is no letter or digit becomes an underscore.
    pub fn column(&self) -> String {
        let plain: String = self.text.chars().map(|c| if c.is_ascii_alphanumeric() { c } else { ' ' }).collect();
        plain.split_whitespace().collect::<Vec<_>>().join("_")
    }

    /// Changes the numbers at this path. A key that is absent is added, with its tables: the parser of the file decides
    /// whether it may have it.
    ///
    /// # Errors
    /// [`KeyError`]; the table may then be changed in part.
    pub fn change(&self, table: &mut Table, change: Change) -> Result<(), KeyError> {
        // The first step is always a key.
        let Some((Step::Key(first), rest)) = self.steps.split_first() else { return Err(KeyError::Path) };
        change_key(table, first, rest, change)
    }
}

fn change_key(table: &mut Table, key: &str, rest: &[Step], change: Change) -> Result<(), KeyError> {
    if !table.contains_key(key) {
        let Change::To(number) = change else { return Err(KeyError::Absent) };
        let added = match rest.first() {
            None => number.to_toml(),
            Some(Step::Key(_)) => Value::Table(Table::new()),
            Some(Step::Entry(_) | Step::Every) => {
                return Err(KeyError::Step { at: key.to_owned(), there: "no such list" });
            }
        };
        table.insert(key.to_owned(), added);
    }
    table.get_mut(key).map_or(Err(KeyError::Absent), |value| change_value(value, rest, change))
}

fn change_value(value: &mut Value, steps: &[Step], change: Change) -> Result<(), KeyError> {
    let there = kind(value);
    match (steps.split_first(), value) {
        (None, value) => put(value, change),
        (Some((Step::Key(key), rest)), Value::Table(table)) => change_key(table, key, rest, change),
        (Some((Step::Entry(index), rest)), Value::Array(entries)) => match entries.get_mut(*index) {
            Some(entry) => change_value(entry, rest, change),
            None => Err(KeyError::Step { at: format!("entry [{index}]"), there: "a shorter list" }),
        },
        (Some((Step::Every, rest)), Value::Array(entries)) => {
            entries.iter_mut().try_for_each(|entry| change_value(entry, rest, change))
        }
        (Some((Step::Key(key), _)), _) => Err(KeyError::Step { at: format!("key `{key}`"), there }),
        (Some((Step::Entry(index), _)), _) => Err(KeyError::Step { at: format!("entry [{index}]"), there }),
        (Some((Step::Every, _)), _) => Err(KeyError::Step { at: "entries [*]".to_owned(), there }),
    }
}

fn put(value: &mut Value, change: Change) -> Result<(), KeyError> {
    let there = kind(value);
    match value {
        Value::Integer(_) | Value::Float(_) => {
            *value = match (change, &*value) {
                (Change::To(number), _) => number.to_toml(),
                (Change::Times(factor), Value::Integer(whole)) => Value::Float(*whole as f64 * factor),
                (Change::Times(factor), other) => Value::Float(other.as_float().unwrap_or(f64::NAN) * factor),
            };
            Ok(())
        }
        Value::Array(entries) if !entries.is_empty() => entries.iter_mut().try_for_each(|entry| put(entry, change)),
        Value::Array(_) | Value::String(_) | Value::Boolean(_) | Value::Datetime(_) | Value::Table(_) => {
            Err(KeyError::NotANumber { there })
        }
    }
}

fn kind(value: &Value) -> &'static str {
    match value {
        Value::String(_) => "a text",
        Value::Integer(_) | Value::Float(_) => "a number",
        Value::Boolean(_) => "true or false",
        Value::Datetime(_) => "a date",
        Value::Array(_) => "a list",
        Value::Table(_) => "a table",
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const RIG: &str = "name = 'a'\n[[contact]]\nstiffness_n_per_m = 2.0\n[[contact]]\nstiffness_n_per_m = 3\n\
                       [pad]\nmass = [[1.0, 0.0], [0.0, 4.0]]\nmodes = 5\n";

    fn changed(path: &str, change: Change) -> Result<Table, KeyError> {
        let mut table: Table = RIG.parse().unwrap();
        KeyPath::parse(path)?.change(&mut table, change).map(|()| table)
    }

    #[test]
    fn numbers_are_put_where_the_path_leads() {
        let to = |value| Change::To(Number::Real(value));
        let table = changed("pad.mass[1][1]", to(9.0)).unwrap();
        assert_eq!(table["pad"]["mass"].to_string(), "[[1.0, 0.0], [0.0, 9.0]]");
        let table = changed("contact[*].stiffness_n_per_m", Change::Times(2.0)).unwrap();
        let stiffness = |k: usize| table["contact"][k]["stiffness_n_per_m"].as_float().unwrap();
        assert_eq!([stiffness(0), stiffness(1)], [4.0, 6.0]);
        assert_eq!(changed("pad.modes", Change::To(Number::Whole(3))).unwrap()["pad"]["modes"], Value::Integer(3));
        let table = changed("pad.mass", Change::Times(0.5)).unwrap();
        assert_eq!(table["pad"]["mass"].to_string(), "[[0.5, 0.0], [0.0, 2.0]]");
        let table = changed("friction.slope_s_per_m", to(0.1)).unwrap();
        assert_eq!(table["friction"]["slope_s_per_m"].as_float(), Some(0.1), "a table that was absent");
    }

    #[test]
    fn paths_that_lead_nowhere_are_refused_with_the_reason() {
        let to = Change::To(Number::Real(1.0));
        let why = |path: &str, change| changed(path, change).unwrap_err().to_string();
        assert_eq!(why("contact[2].stiffness_n_per_m", to), "has no entry [2]: there is a shorter list");
        assert_eq!(why("name", to), "is a text, expected a number or a list of numbers");
        assert_eq!(why("pad.modes.lowest", to), "has no key `lowest`: there is a number");
        assert_eq!(why("friction.slope_s_per_m", Change::Times(2.0)), "is not in the file, so it cannot be multiplied");
        for path in ["", "a..b", "a[", "a[x]", "a b", "[0]", "a]"] {
            assert_eq!(KeyPath::parse(path), Err(KeyError::Path), "{path}");
        }
        assert_eq!(
            KeyPath::parse("contact_patch[0].stiffness_n_per_m").unwrap().column(),
            "contact_patch_0_stiffness_n_per_m"
        );
    }
}

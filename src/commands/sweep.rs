use std::path::PathBuf;
use std::sync::atomic::AtomicBool;

use anyhow::bail;
use clap::Args;

use super::{Outcome, RigName, finite, format, print, write_file};
use crate::analysis::condition::{Condition, Place};
use crate::analysis::sweep::{Sweep, sweep};
use crate::figures::plot;
use crate::rig::Rig;

const EXAMPLES: &str = "\
Examples:
  squealcast sweep tribometer --csv modes.csv --svg modes.svg  over friction, as table and figure
  squealcast sweep tribometer --mu 0.7 --load 50:2000:50       over the load";

/// Sweep friction coefficient, load, speed or temperature, following modes through crossings and merging points
#[derive(Debug, Args)]
#[command(after_help = EXAMPLES)]
pub struct Options {
    /// Rig file, or the name of an embedded rig
    #[arg(value_parser = RigName, hide_possible_values = true)]
    rig: String,
    /// Friction coefficients as FROM:TO:STEP, or one of them to sweep another condition [default: 0:1:0.01, or the reference
    /// of RIG]
    #[arg(long, value_name = "FROM:TO:STEP", allow_hyphen_values = true)]
    mu: Option<Values>,
    /// Normal load in N, or loads as FROM:TO:STEP [default: the reference of RIG]
    #[arg(long, value_name = "N", allow_hyphen_values = true)]
    load: Option<Values>,
    /// Disc speed in rad/s, or speeds as FROM:TO:STEP; negative turns the other way [default: the reference of RIG]
    #[arg(long, value_name = "RAD_S", allow_hyphen_values = true)]
    speed: Option<Values>,
    /// Temperature in °C, or temperatures as FROM:TO:STEP, of a rig with [temperature] [default: the reference of RIG]
    #[arg(long, value_name = "C", allow_hyphen_values = true)]
    temperature: Option<Values>,
    /// Write the modes as CSV to this file, - for standard output [default: -, unless --svg is given]
    #[arg(long, value_name = "FILE")]
    csv: Option<PathBuf>,
    /// Draw frequencies and growth rates to this file
    #[arg(long, value_name = "FILE")]
    svg: Option<PathBuf>,
}

/// One value of a condition, or a range of them.
#[derive(Clone, Copy, Debug)]
enum Values {
    One(f64),
    Range(Range),
}

impl std::str::FromStr for Values {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        if text.contains(':') { text.parse().map(Self::Range) } else { finite(text).map(Self::One) }
    }
}

/// An inclusive range of a condition.
#[derive(Clone, Copy, Debug)]
struct Range {
    from: f64,
    to: f64,
    step: f64,
}

/// Largest number of steps of a sweep.
const MAX_STEPS: f64 = 1e6;

impl std::str::FromStr for Range {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let parts: Vec<f64> = text.split(':').map(finite).collect::<Result<_, _>>()?;
        let &[from, to, step] = parts.as_slice() else {
            return Err("expected three numbers, FROM:TO:STEP".to_owned());
        };
        if step <= 0.0 || to < from {
            return Err("expected FROM up to TO and a STEP of more than 0".to_owned());
        }
        if (to - from) / step > MAX_STEPS {
            return Err(format!("{:.0} steps, expected at most {MAX_STEPS:.0}", (to - from) / step));
        }
        Ok(Self { from, to, step })
    }
}

impl Range {
    /// Each value is computed independently, so that rounding errors do not accumulate.
    fn values(self) -> impl Iterator<Item = f64> {
        let count = ((self.to - self.from) / self.step + 1e-9).floor() as usize;
        (0..=count).map(move |k| self.from + k as f64 * self.step)
    }
}

/// Friction coefficients that are swept if no condition is given as a range.
const FRICTION: Range = Range { from: 0.0, to: 1.0, step: 0.01 };

impl Options {
    pub fn run(self) -> anyhow::Result<Outcome> {
        let rig = Rig::load(&self.rig)?;
        let (condition, range, place) = self.swept(&rig)?;
        let values: Vec<f64> = range.values().collect();
        let swept = sweep(&rig, &place, condition, &values, self.svg.is_some(), &AtomicBool::new(false))?;
        notes(&swept, condition);
        let csv = swept.to_csv(&rig)?;
        match (&self.csv, &self.svg) {
            (Some(path), _) => write_file(path, csv.as_bytes())?,
            (None, None) => print(&csv)?,
            (None, Some(_)) => {}
        }
        if let Some(path) = &self.svg {
            let title = format!("{}, {}", rig.name, place.fixed(&[condition]));
            let svg = plot::sweep(&title, condition.label(), &plot::swept(&swept, condition), &swept.windows)?;
            write_file(path, svg.as_bytes())?;
            note!("{}: {}", path.display(), format::count(swept.windows.len(), "window") + " of instability");
        }
        Ok(Outcome::Done)
    }

    /// The condition that is swept, its range, and the others.
    ///
    /// # Errors
    /// More than one range, no range, or a condition that the rig does not accept.
    fn swept(&self, rig: &Rig) -> anyhow::Result<(Condition, Range, Place)> {
        let given = [
            (Condition::Friction, self.mu),
            (Condition::Load, self.load),
            (Condition::Speed, self.speed),
            (Condition::Temperature, self.temperature),
        ];
        let (mut ranges, mut place) = (vec![], Place { point: rig.reference, temperature_c: rig.temperature_c() });
        for (condition, values) in given {
            match values {
                Some(Values::Range(range)) => ranges.push((condition, range)),
                Some(Values::One(value)) => place = condition.set(place, value),
                None => {}
            }
        }
        let (condition, range) = match (ranges.as_slice(), self.mu) {
            (&[one], _) => one,
            ([], None) => (Condition::Friction, FRICTION),
            ([], Some(_)) => bail!(
                "--mu is one friction coefficient: expected a range FROM:TO:STEP of --load, --speed or --temperature"
            ),
            (several, _) => bail!(
                "{} ranges, expected one of --mu, --load, --speed and --temperature as FROM:TO:STEP",
                several.len()
            ),
        };
        match condition {
            // Friction coefficients may be swept beyond the limits of inputs.
            Condition::Friction => condition.set(place, rig.reference.friction_coefficient).check(rig)?,
            Condition::Load | Condition::Speed | Condition::Temperature => {
                condition.set(place, range.from).check(rig)?;
                condition.set(place, range.to).check(rig)?;
            }
        }
        Ok((condition, range, place))
    }
}

/// Reports where the sweep ends early and which values have no prediction.
fn notes(swept: &Sweep, condition: Condition) {
    if let Some(end) = &swept.sliding_ends {
        note!("the sweep ends at friction coefficient {:.6}: {}", end.mu, end.reason);
    }
    if let Some((value, error)) = swept.missing.first() {
        let count = format::count(swept.missing.len(), "value");
        note!("no prediction at {count} of the {}, the first at {value}: {error}", condition.label());
    }
}

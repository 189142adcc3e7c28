use std::path::PathBuf;

use anyhow::bail;
use clap::Args;

use super::condition::{Condition, Place, change_between, in_parallel};
use super::{Outcome, RigName, finite, format, print, write_file};
use crate::figures::plot::{self, Point, Shaded};
use crate::physics::{MapOptions, Mode, Solver, StabilityMap, Summary, Vectors, Window};
use crate::rig::Rig;
use crate::session::map_options;

/// Sweep friction coefficient, load, speed or temperature, following modes through crossings and merging points
#[derive(Debug, Args)]
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
        let swept = match condition {
            Condition::Friction => over_friction(place.rig(&rig)?.as_ref(), &place, range, self.svg.is_some())?,
            Condition::Load | Condition::Speed | Condition::Temperature => over_other(&rig, &place, condition, range),
        };
        let csv = to_csv(&rig, &swept.modes)?;
        match (&self.csv, &self.svg) {
            (Some(path), _) => write_file(path, csv.as_bytes())?,
            (None, None) => print(&csv)?,
            (None, Some(_)) => {}
        }
        if let Some(path) = &self.svg {
            let mut points: Vec<Point> =
                swept.modes.iter().chain(&swept.beside_ends).map(|s| s.drawn(condition)).collect();
            points.sort_by(|a, b| a.x.total_cmp(&b.x));
            let title = format!("{}, {}", rig.name, place.fixed(&[condition]));
            write_file(path, plot::sweep(&title, condition.label(), &points, &swept.windows)?.as_bytes())?;
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

/// A mode at a place.
#[derive(Clone, Copy, Debug)]
struct Swept {
    place: Place,
    mode: Mode,
}

impl Swept {
    /// The mode as a point of a curve over `condition`.
    fn drawn(&self, condition: Condition) -> Point {
        Point {
            x: condition.of(&self.place),
            id: self.mode.id,
            frequency_hz: self.mode.root.frequency_hz(),
            growth_rate_per_s: self.mode.root.growth_rate_per_s(),
        }
    }
}

/// Distance from a window at which the stable side of its end is drawn.
const OFFSET: f64 = 1e-6;

/// Result of a sweep.
struct Sweep {
    modes: Vec<Swept>,
    /// The modes just outside the windows, where they are still stable. Without them a coarse line would rise too
    /// early.
    beside_ends: Vec<Swept>,
    windows: Vec<Shaded>,
}

/// All modes of the band at every friction coefficient of the range, and the windows of instability if requested.
fn over_friction(rig: &Rig, place: &Place, range: Range, windows: bool) -> anyhow::Result<Sweep> {
    let mut solver = Solver::new(rig.model.dimension());
    // At least the range that a session searches, so that identities are the same.
    let searched = map_options(rig);
    let (mu_min, mu_max) = (range.from.min(searched.mu_min), range.to.max(searched.mu_max));
    let followed = MapOptions { mu_min, mu_max, windows, ..searched };
    let map = StabilityMap::build(&rig.model, &mut solver, &place.point, &followed)?;
    let mut values: Vec<f64> = range.values().collect();
    if let Some(end) = &map.sliding_ends {
        values.retain(|&mu| mu <= end.mu);
        note!("the sweep ends at friction coefficient {:.6}: {}", end.mu, end.reason);
    }
    let at = |mu: f64, solver: &mut Solver| modes_at(rig, solver, Condition::Friction.set(*place, mu), &map);
    let mut modes = vec![];
    for found in in_parallel(&values, rig.model.dimension(), at) {
        modes.extend(found?);
    }
    let mut windows: Vec<Window> = map.windows.clone();
    windows.retain(|window| window.mu_from <= range.to);
    windows.iter_mut().for_each(|window| window.mu_to = window.mu_to.filter(|&mu| mu <= range.to));
    let mut beside_ends = vec![];
    for window in &windows {
        let outside = [Some(window.mu_from - OFFSET), window.mu_to.map(|mu| mu + OFFSET)];
        for mu in outside.into_iter().flatten().filter(|mu| (range.from..=range.to).contains(mu)) {
            beside_ends.extend(at(mu, &mut solver)?);
        }
    }
    let windows = windows.iter().map(|window| (window.mu_from, window.mu_to)).collect();
    Ok(Sweep { modes, beside_ends, windows })
}

/// All modes of the band at `place`, at whose temperature `rig` is, with the identities that `map` gives.
fn modes_at(rig: &Rig, solver: &mut Solver, place: Place, map: &StabilityMap) -> anyhow::Result<Vec<Swept>> {
    let spectrum = solver.solve(&rig.model, &place.point, Vectors::Right)?;
    let summary = Summary::of_spectrum(&spectrum, Some(map), rig.band_max_hz, rig.instability_threshold);
    Ok(summary.modes.into_iter().map(|mode| Swept { place, mode }).collect())
}

/// All modes of the band at every value of a condition other than friction, with the ranges of it in which one is unstable.
/// Identities at each of them are those of its own stability map. Values without a prediction are named in a note.
fn over_other(rig: &Rig, place: &Place, condition: Condition, range: Range) -> Sweep {
    let searched = map_options(rig);
    let mu = place.point.friction_coefficient;
    let followed =
        MapOptions { mu_min: mu.min(searched.mu_min), mu_max: mu.max(searched.mu_max), windows: false, ..searched };
    let at = |value: f64, solver: &mut Solver| -> anyhow::Result<Vec<Swept>> {
        let place = condition.set(*place, value);
        let rig = place.rig(rig)?;
        let map = StabilityMap::build(&rig.model, solver, &place.point, &followed)?;
        modes_at(&rig, solver, place, &map)
    };
    let values: Vec<f64> = range.values().collect();
    let (mut modes, mut stable, mut missing) = (vec![], vec![], vec![]);
    for (&value, found) in values.iter().zip(in_parallel(&values, rig.model.dimension(), at)) {
        match found {
            Ok(found) => {
                stable.push((value, Some(is_unstable(rig, &found))));
                modes.extend(found);
            }
            Err(error) => {
                stable.push((value, None));
                missing.push((value, error));
            }
        }
    }
    if let Some((value, error)) = missing.first() {
        let count = format::count(missing.len(), "value");
        note!("no prediction at {count} of the {}, the first at {value}: {error:#}", condition.label());
    }
    let mut sweep = Sweep { modes, beside_ends: vec![], windows: vec![] };
    sweep.find_windows(rig, &stable, at);
    sweep
}

/// Whether any of the modes is unstable.
fn is_unstable(rig: &Rig, modes: &[Swept]) -> bool {
    modes.iter().any(|swept| swept.mode.root.is_unstable(rig.instability_threshold))
}

impl Sweep {
    /// Finds where the modes become stable and unstable between neighbours in `unstable`, and the modes just outside.
    fn find_windows(
        &mut self,
        rig: &Rig,
        unstable: &[(f64, Option<bool>)],
        at: impl Fn(f64, &mut Solver) -> anyhow::Result<Vec<Swept>>,
    ) {
        let mut solver = Solver::new(rig.model.dimension());
        let mut open = None;
        for (k, &(value, state)) in unstable.iter().enumerate() {
            let before =
                k.checked_sub(1).and_then(|before| unstable[before].1.map(|state| (unstable[before].0, state)));
            let edge = match (before, state) {
                (Some((from, before)), Some(state)) if before != state => {
                    let grows = |value| at(value, &mut solver).ok().map(|modes| is_unstable(rig, &modes));
                    change_between(from, value, before, grows)
                }
                (Some((from, _)), None) => from,
                _ => value,
            };
            match (open, state) {
                (None, Some(true)) => open = Some(edge),
                (Some(from), Some(false) | None) => {
                    self.windows.push((from, Some(edge)));
                    open = None;
                }
                _ => {}
            }
        }
        self.windows.extend(open.map(|from| (from, None)));
        let (first, last) = (unstable.first(), unstable.last());
        let Some((first, last)) = first.zip(last).map(|(first, last)| (first.0, last.0)) else { return };
        let away = OFFSET * (last - first);
        for (from, to) in self.windows.clone() {
            let outside = [Some(from - away), to.map(|to| to + away)];
            for value in outside.into_iter().flatten().filter(|value| (first..=last).contains(value)) {
                self.beside_ends.extend(at(value, &mut solver).into_iter().flatten());
            }
        }
    }
}

fn to_csv(rig: &Rig, modes: &[Swept]) -> anyhow::Result<String> {
    let mut writer = csv::Writer::from_writer(vec![]);
    let own = ["mode_id", "frequency_hz", "growth_rate_per_s", "damping_ratio"];
    writer.write_record(Place::columns(rig).chain(own))?;
    for Swept { place, mode } in modes {
        let root = &mode.root;
        let values = [root.frequency_hz(), root.growth_rate_per_s(), root.damping_ratio()].map(|v| v.to_string());
        writer.write_record(place.cells().chain([mode.id.to_string()]).chain(values))?;
    }
    Ok(String::from_utf8(writer.into_inner()?)?)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_coarse_sweep_does_not_grow_before_its_window() {
        let rig = Rig::load("nine-dof-case-2").unwrap();
        let range = "0:1.6:0.2".parse().unwrap();
        let place = Place { point: rig.reference, temperature_c: None };
        let Sweep { modes, beside_ends, windows } = over_friction(&rig, &place, range, true).unwrap();
        assert!(!windows.is_empty());
        let mu = |swept: &Swept| swept.place.point.friction_coefficient;
        for &(from, _) in &windows {
            // Check between the last step before a window and its beginning: no visible growth is drawn there.
            let nearest = beside_ends.iter().map(mu).filter(|mu| *mu < from).fold(0.0, f64::max);
            assert!(from - nearest < 2.0 * OFFSET, "{nearest}, the window begins at {from}");
            let outside: Vec<&Swept> = beside_ends.iter().filter(|swept| mu(swept) == nearest).collect();
            assert_eq!(outside.len(), 9, "every mode is drawn there");
            let grows = |swept: &&Swept| swept.mode.root.growth_rate_per_s() / swept.mode.root.lambda.norm();
            let growing = outside.iter().filter(|swept| grows(swept) >= 1e-6).count();
            let open = windows.iter().filter(|(other, to)| *other < from && to.is_none_or(|to| to > from)).count();
            assert_eq!(growing, open, "one mode of every window that is open already, none of this one");
        }
        assert!(
            modes.iter().map(mu).all(|mu| ((mu / 0.2).round() * 0.2 - mu).abs() < 1e-12),
            "the table keeps its steps"
        );
    }
}

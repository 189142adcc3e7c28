//! Sweeps: the modes at every value of one condition, followed through crossings and merging points.

use std::sync::atomic::{AtomicBool, Ordering};

use super::condition::{Condition, Place, change_between, in_parallel};
use super::{AnalysisError, including};
use crate::physics::stability_map::SlidingEnd;
use crate::physics::{Mode, Solver, StabilityMap, Summary, Vectors, Window};
use crate::rig::Rig;

/// A mode at a place.
#[derive(Clone, Copy, Debug)]
pub struct Swept {
    pub place: Place,
    pub mode: Mode,
}

/// Distance from a window at which the stable side of its end is drawn.
const OFFSET: f64 = 1e-6;

/// A range of a condition in which a mode is unstable; its end is `None` beyond the sweep.
pub type Unstable = (f64, Option<f64>);

/// Result of a sweep.
#[derive(Debug)]
pub struct Sweep {
    /// The modes of the band, value by value, ascending in frequency.
    pub modes: Vec<Swept>,
    /// The modes just outside the windows, where they are still stable. Without them a coarse line would rise too
    /// early.
    pub beside_ends: Vec<Swept>,
    /// The ranges of the condition in which a mode is unstable; over friction coefficients, only if requested.
    pub windows: Vec<Unstable>,
    /// Of a sweep over friction coefficients: where steady sliding ends, and the sweep with it.
    pub sliding_ends: Option<SlidingEnd>,
    /// Of a sweep over another condition: values without a prediction, and why.
    pub missing: Vec<(f64, AnalysisError)>,
}

/// Sweeps `condition` over ascending `values`, with the other conditions as in `place`. Over friction coefficients the
/// windows are computed only if requested. Once `stopped` is set, no further value is computed.
///
/// # Errors
/// [`AnalysisError`]: a rig without that temperature; over friction coefficients also a solve or map that failed.
pub fn sweep(
    rig: &Rig,
    place: &Place,
    condition: Condition,
    values: &[f64],
    windows: bool,
    stopped: &AtomicBool,
) -> Result<Sweep, AnalysisError> {
    match condition {
        Condition::Friction => over_friction(place.rig(rig)?.as_ref(), place, values, windows, stopped),
        Condition::Load | Condition::Speed | Condition::Temperature => {
            over_other(rig, place, condition, values, stopped)
        }
    }
}

/// All modes of the band at every friction coefficient, and the windows of instability if requested.
fn over_friction(
    rig: &Rig,
    place: &Place,
    values: &[f64],
    windows: bool,
    stopped: &AtomicBool,
) -> Result<Sweep, AnalysisError> {
    let mut solver = Solver::new(rig.model.dimension());
    let (from, to) = (values.first().copied().unwrap_or(0.0), values.last().copied().unwrap_or(0.0));
    // At least the range that a session searches, so that identities are the same.
    let followed = including(rig, from, to, windows);
    let map = StabilityMap::build(&rig.model, &mut solver, &place.point, &followed)?;
    let mut values = values.to_vec();
    if let Some(end) = &map.sliding_ends {
        values.retain(|&mu| mu <= end.mu);
    }
    let at = |mu: f64, solver: &mut Solver| modes_at(rig, solver, Condition::Friction.set(*place, mu), &map, stopped);
    let mut modes = vec![];
    for found in in_parallel(&values, rig.model.dimension(), at) {
        modes.extend(found?);
    }
    let mut windows: Vec<Window> = map.windows.clone();
    windows.retain(|window| window.mu_from <= to);
    windows.iter_mut().for_each(|window| window.mu_to = window.mu_to.filter(|&mu| mu <= to));
    let mut beside_ends = vec![];
    for window in &windows {
        let outside = [Some(window.mu_from - OFFSET), window.mu_to.map(|mu| mu + OFFSET)];
        for mu in outside.into_iter().flatten().filter(|mu| (from..=to).contains(mu)) {
            beside_ends.extend(at(mu, &mut solver)?);
        }
    }
    let windows = windows.iter().map(|window| (window.mu_from, window.mu_to)).collect();
    Ok(Sweep { modes, beside_ends, windows, sliding_ends: map.sliding_ends, missing: vec![] })
}

/// All modes of the band at `place`, at whose temperature `rig` is, with the identities that `map` gives.
fn modes_at(
    rig: &Rig,
    solver: &mut Solver,
    place: Place,
    map: &StabilityMap,
    stopped: &AtomicBool,
) -> Result<Vec<Swept>, AnalysisError> {
    if stopped.load(Ordering::Relaxed) {
        return Err(AnalysisError::Stopped);
    }
    let spectrum = solver.solve(&rig.model, &place.point, Vectors::Right)?;
    let summary = Summary::of_spectrum(&spectrum, Some(map), rig.band_max_hz, rig.instability_threshold);
    Ok(summary.modes.into_iter().map(|mode| Swept { place, mode }).collect())
}

/// All modes of the band at every value of a condition other than friction, with the ranges of it in which one is unstable.
/// Identities at each of them are those of its own stability map.
fn over_other(
    rig: &Rig,
    place: &Place,
    condition: Condition,
    values: &[f64],
    stopped: &AtomicBool,
) -> Result<Sweep, AnalysisError> {
    let mu = place.point.friction_coefficient;
    let followed = including(rig, mu, mu, false);
    let at = |value: f64, solver: &mut Solver| -> Result<Vec<Swept>, AnalysisError> {
        if stopped.load(Ordering::Relaxed) {
            return Err(AnalysisError::Stopped);
        }
        let place = condition.set(*place, value);
        let rig = place.rig(rig)?;
        let map = StabilityMap::build(&rig.model, solver, &place.point, &followed)?;
        modes_at(&rig, solver, place, &map, stopped)
    };
    let (mut modes, mut stable, mut missing) = (vec![], vec![], vec![]);
    for (&value, found) in values.iter().zip(in_parallel(values, rig.model.dimension(), at)) {
        match found {
            Ok(found) => {
                stable.push((value, Some(is_unstable(rig, &found))));
                modes.extend(found);
            }
            Err(AnalysisError::Stopped) => return Err(AnalysisError::Stopped),
            Err(error) => {
                stable.push((value, None));
                missing.push((value, error));
            }
        }
    }
    let mut sweep = Sweep { modes, beside_ends: vec![], windows: vec![], sliding_ends: None, missing };
    sweep.find_windows(rig, &stable, at);
    Ok(sweep)
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
        at: impl Fn(f64, &mut Solver) -> Result<Vec<Swept>, AnalysisError>,
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

    /// The modes as comma-separated values: conditions, identity, frequency, growth rate and damping ratio.
    ///
    /// # Errors
    /// The text cannot be made.
    pub fn to_csv(&self, rig: &Rig) -> Result<String, csv::Error> {
        let mut writer = csv::Writer::from_writer(vec![]);
        let own = ["mode_id", "frequency_hz", "growth_rate_per_s", "damping_ratio"];
        writer.write_record(Place::columns(rig).chain(own))?;
        for Swept { place, mode } in &self.modes {
            let root = &mode.root;
            let values = [root.frequency_hz(), root.growth_rate_per_s(), root.damping_ratio()].map(|v| v.to_string());
            writer.write_record(place.cells().chain([mode.id.to_string()]).chain(values))?;
        }
        let bytes = writer.into_inner().map_err(|error| csv::Error::from(error.into_error()))?;
        Ok(String::from_utf8_lossy(&bytes).into_owned())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_coarse_sweep_does_not_grow_before_its_window() {
        let rig = Rig::load("nine-dof-case-2").unwrap();
        let values: Vec<f64> = (0..=8).map(|k| f64::from(k) * 0.2).collect();
        let place = Place { point: rig.reference, temperature_c: None };
        let stopped = AtomicBool::new(false);
        let found = sweep(&rig, &place, Condition::Friction, &values, true, &stopped).unwrap();
        let Sweep { modes, beside_ends, windows, .. } = found;
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

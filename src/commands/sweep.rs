use std::panic::resume_unwind;
use std::path::PathBuf;

use clap::Args;

use super::{LoadAndSpeed, Outcome, RigName, finite, format, print, write_file};
use crate::figures::plot::{self, Point};
use crate::physics::{MapOptions, Mode, OperatingPoint, Solver, StabilityMap, Summary, Vectors, Window};
use crate::rig::Rig;
use crate::session::map_options;

/// Sweep the friction coefficient, following modes through crossings and merging points
#[derive(Debug, Args)]
pub struct Options {
    /// Rig file, or the name of an embedded rig
    #[arg(value_parser = RigName, hide_possible_values = true)]
    rig: String,
    /// Friction coefficients, as FROM:TO:STEP
    #[arg(long, value_name = "FROM:TO:STEP", default_value = "0:1:0.01", allow_hyphen_values = true)]
    mu: Range,
    #[command(flatten)]
    load_and_speed: LoadAndSpeed,
    /// Write the modes as CSV to this file, - for standard output [default: -, unless --svg is given]
    #[arg(long, value_name = "FILE")]
    csv: Option<PathBuf>,
    /// Draw frequencies and growth rates to this file
    #[arg(long, value_name = "FILE")]
    svg: Option<PathBuf>,
}

/// An inclusive range of friction coefficients.
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

impl Options {
    pub fn run(self) -> anyhow::Result<Outcome> {
        let rig = Rig::load(&self.rig)?;
        let point = self.load_and_speed.point(&rig)?;
        let Sweep { modes, beside_ends, windows } = sweep(&rig, &point, self.mu, self.svg.is_some())?;
        let csv = to_csv(&point, &modes)?;
        match (&self.csv, &self.svg) {
            (Some(path), _) => write_file(path, csv.as_bytes())?,
            (None, None) => print(&csv)?,
            (None, Some(_)) => {}
        }
        if let Some(path) = &self.svg {
            let mut points: Vec<Point> = modes
                .iter()
                .chain(&beside_ends)
                .map(|(mu, mode)| Point {
                    mu: *mu,
                    id: mode.id,
                    frequency_hz: mode.root.frequency_hz(),
                    growth_rate_per_s: mode.root.growth_rate_per_s(),
                })
                .collect();
            points.sort_by(|a, b| a.mu.total_cmp(&b.mu));
            let title = format!("{}, {} N, {} rad/s", rig.name, point.normal_load_n, point.disc_speed_rad_s);
            write_file(path, plot::sweep(&title, &points, &windows)?.as_bytes())?;
            note!("{}: {}", path.display(), format::count(windows.len(), "window") + " of instability");
        }
        Ok(Outcome::Done)
    }
}

/// A mode at a friction coefficient.
type Swept = (f64, Mode);

/// Distance from a window at which the stable side of its end is drawn.
const OFFSET: f64 = 1e-6;

/// Result of a sweep.
struct Sweep {
    modes: Vec<Swept>,
    /// The modes just outside the windows, where they are still stable. Without them a coarse line would rise too
    /// early.
    beside_ends: Vec<Swept>,
    windows: Vec<Window>,
}

/// All modes of the band at every friction coefficient of the range, and the windows of instability if requested.
fn sweep(rig: &Rig, point: &OperatingPoint, range: Range, windows: bool) -> anyhow::Result<Sweep> {
    let mut solver = Solver::new(rig.model.dimension());
    // At least the range that a session searches, so that identities are the same.
    let searched = map_options(rig);
    let (mu_min, mu_max) = (range.from.min(searched.mu_min), range.to.max(searched.mu_max));
    let followed = MapOptions { mu_min, mu_max, windows, ..searched };
    let map = StabilityMap::build(&rig.model, &mut solver, point, &followed)?;
    let mut values: Vec<f64> = range.values().collect();
    if let Some(end) = &map.sliding_ends {
        values.retain(|&mu| mu <= end.mu);
        note!("the sweep ends at friction coefficient {:.6}: {}", end.mu, end.reason);
    }
    let modes_at = |solver: &mut Solver, mu: f64| -> anyhow::Result<Vec<Swept>> {
        let spectrum = solver.solve(&rig.model, &point.with_friction(mu), Vectors::Right)?;
        let summary = Summary::of_spectrum(&spectrum, Some(&map), rig.band_max_hz, rig.instability_threshold);
        Ok(summary.modes.into_iter().map(|mode| (mu, mode)).collect())
    };
    // Each solve uses one thread and many run at once: the result at one friction coefficient does not depend on the
    // others.
    let threads = std::thread::available_parallelism().map_or(1, usize::from);
    let share = values.len().div_ceil(threads).max(1);
    let sweep_part = |part: &[f64]| {
        let mut solver = Solver::new(rig.model.dimension());
        let mut modes = vec![];
        for &mu in part {
            modes.extend(modes_at(&mut solver, mu)?);
        }
        Ok(modes)
    };
    let parts: Vec<anyhow::Result<Vec<Swept>>> = std::thread::scope(|scope| {
        let workers: Vec<_> = values.chunks(share).map(|part| scope.spawn(|| sweep_part(part))).collect();
        workers.into_iter().map(|worker| worker.join().unwrap_or_else(|panic| resume_unwind(panic))).collect()
    });
    let mut modes = vec![];
    for part in parts {
        modes.extend(part?);
    }
    let mut windows = map.windows.clone();
    windows.retain(|window| window.mu_from <= range.to);
    windows.iter_mut().for_each(|window| window.mu_to = window.mu_to.filter(|&mu| mu <= range.to));
    let mut beside_ends = vec![];
    for window in &windows {
        let outside = [Some(window.mu_from - OFFSET), window.mu_to.map(|mu| mu + OFFSET)];
        for mu in outside.into_iter().flatten().filter(|mu| (range.from..=range.to).contains(mu)) {
            beside_ends.extend(modes_at(&mut solver, mu)?);
        }
    }
    Ok(Sweep { modes, beside_ends, windows })
}

fn to_csv(at: &OperatingPoint, modes: &[Swept]) -> anyhow::Result<String> {
    let mut writer = csv::Writer::from_writer(vec![]);
    writer.write_record([
        "normal_load_n",
        "disc_speed_rad_s",
        "friction_coefficient",
        "mode_id",
        "frequency_hz",
        "growth_rate_per_s",
        "damping_ratio",
    ])?;
    let (load, speed) = (at.normal_load_n.to_string(), at.disc_speed_rad_s.to_string());
    for (mu, mode) in modes {
        let root = &mode.root;
        let values = [root.frequency_hz(), root.growth_rate_per_s(), root.damping_ratio()].map(|v| v.to_string());
        let [hz, growth, damping] = &values;
        writer.write_record([&load, &speed, &mu.to_string(), &mode.id.to_string(), hz, growth, damping])?;
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
        let Sweep { modes, beside_ends, windows } = sweep(&rig, &rig.reference, range, true).unwrap();
        assert!(!windows.is_empty());
        for window in &windows {
            // Check between the last step before a window and its beginning: no visible growth is drawn there.
            let last = |swept: &&Swept| swept.0 < window.mu_from;
            let grows = |swept: &Swept| swept.1.root.growth_rate_per_s() / swept.1.root.lambda.norm();
            let before: Vec<&Swept> = beside_ends.iter().filter(last).collect();
            let nearest = before.iter().map(|swept| swept.0).fold(0.0, f64::max);
            assert!(window.mu_from - nearest < 2.0 * OFFSET, "{nearest}, the window begins at {}", window.mu_from);
            let ids: Vec<u32> = before.iter().filter(|swept| swept.0 == nearest).map(|swept| swept.1.id).collect();
            assert!(window.mode_ids.iter().all(|id| ids.contains(id)), "the pair has ids there: {ids:?}");
            let pair = before.iter().filter(|swept| swept.0 == nearest && window.mode_ids.contains(&swept.1.id));
            assert!(pair.into_iter().all(|swept| grows(swept) < 1e-6));
        }
        assert!(modes.iter().all(|(mu, _)| ((mu / 0.2).round() * 0.2 - mu).abs() < 1e-12), "the table keeps its steps");
    }
}

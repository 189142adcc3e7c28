use std::path::PathBuf;
use std::sync::Mutex;

use anyhow::bail;
use clap::Args;

use super::steps::ProgressOptions;
use super::{AtTemperature, Conditions, Outcome, RigName, finite, print, write_file};
use crate::analysis::condition::{Condition, Place, change_between, in_parallel};
use crate::figures::plane::{self, Axis, Cell, Edge, Plane};
use crate::physics::{MapOptions, Solver, StabilityMap, Summary, Vectors};
use crate::rig::Rig;
use crate::session::map_options;

/// Largest number of operating points of a map.
const MOST_POINTS: usize = 1_000_000;

const EXAMPLES: &str = "\
Examples:
  squealcast map tribometer --svg map.svg                            over friction and load
  squealcast map tribometer --x speed=1:60 --y mu=0:1 --csv map.csv  over speed and friction";

/// Map the largest growth rate over two conditions, with the edges of the windows of instability
#[derive(Debug, Args)]
#[command(after_help = EXAMPLES)]
pub struct Options {
    /// Rig file, or the name of an embedded rig
    #[arg(value_parser = RigName, hide_possible_values = true)]
    rig: String,
    /// Condition along x with its range: mu, load (N), speed (rad/s) or temperature (°C)
    #[arg(long, value_name = "CONDITION=FROM:TO", default_value = "mu=0:1", allow_hyphen_values = true)]
    x: Span,
    /// Condition along y with its range
    #[arg(long, value_name = "CONDITION=FROM:TO", default_value = "load=50:2000", allow_hyphen_values = true)]
    y: Span,
    /// Operating points along x and y
    #[arg(long, value_name = "NXxNY", default_value = "81x41")]
    points: Grid,
    #[command(flatten)]
    conditions: Conditions,
    #[command(flatten)]
    temperature: AtTemperature,
    /// Write the map as CSV to this file, - for standard output [default: -, unless --svg is given]
    #[arg(long, value_name = "FILE")]
    csv: Option<PathBuf>,
    /// Write the edges of the windows as CSV to this file
    #[arg(long, value_name = "FILE")]
    edges: Option<PathBuf>,
    /// Draw the map to this file
    #[arg(long, value_name = "FILE")]
    svg: Option<PathBuf>,
    #[command(flatten)]
    progress: ProgressOptions,
}

/// A condition with its range.
#[derive(Clone, Copy, Debug)]
struct Span {
    condition: Condition,
    from: f64,
    to: f64,
}

/// Number of operating points along x and y.
#[derive(Clone, Copy, Debug)]
struct Grid([usize; 2]);

impl std::str::FromStr for Span {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let Some((name, range)) = text.split_once('=') else { return Err("expected CONDITION=FROM:TO".to_owned()) };
        let condition = match name {
            "mu" => Condition::Friction,
            "load" => Condition::Load,
            "speed" => Condition::Speed,
            "temperature" => Condition::Temperature,
            other => return Err(format!("`{other}` is no condition, expected mu, load, speed or temperature")),
        };
        let Some((from, to)) = range.split_once(':') else { return Err("expected a range FROM:TO".to_owned()) };
        let (from, to) = (finite(from)?, finite(to)?);
        if to <= from {
            return Err(format!("the range ends at {to}, expected more than {from}"));
        }
        Ok(Self { condition, from, to })
    }
}

impl std::str::FromStr for Grid {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let Some((x, y)) = text.split_once('x') else { return Err("expected two numbers, NXxNY".to_owned()) };
        let count = |text: &str| match text.parse::<usize>() {
            Ok(count) if count >= 2 => Ok(count),
            _ => Err(format!("`{text}` is no number of points, expected at least 2")),
        };
        let counts = [count(x)?, count(y)?];
        match counts[0].checked_mul(counts[1]) {
            Some(all) if all <= MOST_POINTS => Ok(Self(counts)),
            _ => Err(format!("expected at most {MOST_POINTS} points in all")),
        }
    }
}

impl Span {
    /// `count` values over the range, each computed independently.
    fn values(&self, count: usize) -> Vec<f64> {
        (0..count).map(|k| self.from + (self.to - self.from) * k as f64 / (count - 1) as f64).collect()
    }
}

impl Options {
    pub fn run(self) -> anyhow::Result<Outcome> {
        let rig = self.temperature.of(Rig::load(&self.rig)?)?;
        if self.x.condition == self.y.condition {
            bail!(
                "--x and --y are the same condition, {}: expected two of mu, load, speed and temperature",
                self.x.condition.label()
            );
        }
        let point = self.conditions.point(&rig.name, &rig.reference, &rig.limits)?;
        let fixed = Place { point, temperature_c: rig.temperature_c() };
        for (x, y) in [(self.x.from, self.y.from), (self.x.to, self.y.to)] {
            self.y.condition.set(self.x.condition.set(fixed, x), y).check(&rig)?;
        }
        let Grid([nx, ny]) = self.points;
        let (xs, ys) = (self.x.values(nx), self.y.values(ny));
        // Along the friction coefficient a stability map finds every window, so it lies along the lines that are computed.
        let across = self.y.condition == Condition::Friction;
        let (along, over) = if across { (self.y, self.x) } else { (self.x, self.y) };
        let (values, lines) = if across { (&ys, &xs) } else { (&xs, &ys) };
        let steps = Mutex::new((self.progress.steps(1), 0));
        let one = |at: f64, solver: &mut Solver| {
            let found = line(&rig, solver, over.condition.set(fixed, at), along, values);
            if let Ok(mut steps) = steps.lock() {
                steps.1 += 1;
                let done = steps.1;
                steps.0.at(0, "lines", done, lines.len());
            }
            found
        };
        let found = in_parallel(lines, rig.model.dimension(), one);
        drop(steps);
        let (mut cells, mut edges) = (vec![], vec![]);
        for line in found {
            let line = line?;
            cells.push(line.cells);
            edges.extend(line.edges);
        }
        if across {
            cells = (0..ny).map(|y| (0..nx).map(|x| cells[x][y].clone()).collect()).collect();
        }
        let csv = to_csv(&rig, &cells)?;
        match (&self.csv, &self.svg) {
            (Some(path), _) => write_file(path, csv.as_bytes())?,
            (None, None) => print(&csv)?,
            (None, Some(_)) => {}
        }
        if let Some(path) = &self.edges {
            write_file(path, edges_to_csv(&rig, &edges)?.as_bytes())?;
        }
        if let Some(path) = &self.svg {
            let axis = |span: &Span, values: Vec<f64>| Axis { label: span.condition.label(), values };
            let (x, y) = (self.x.condition, self.y.condition);
            let plane = Plane {
                x: axis(&self.x, xs),
                y: axis(&self.y, ys),
                rows: cells
                    .iter()
                    .map(|row| row.iter().map(|(_, cell)| cell.clone().map_or(Cell::Fault, Cell::from)).collect())
                    .collect(),
                edges: edges.iter().map(|(place, edge)| (x.of(place), y.of(place), *edge)).collect(),
            };
            let title = format!("{}: largest growth rate, {}", rig.name, fixed.fixed(&[x, y]));
            write_file(path, plane::draw(&title, &plane)?.as_bytes())?;
        }
        Ok(Outcome::Done)
    }
}

/// The largest growth rate at an operating point.
#[derive(Clone, Debug)]
struct Growth {
    max_growth_rate_per_s: f64,
    frequency_hz: f64,
    unstable_modes: u32,
    /// Contact pairs that carry a force; for a rig with a contact state.
    pairs_closed: Option<usize>,
}

impl From<Growth> for Cell {
    fn from(growth: Growth) -> Self {
        if growth.unstable_modes == 0 { Self::Stable } else { Self::Growing(growth.max_growth_rate_per_s) }
    }
}

/// The growth rate at each place, or why there is none, and the edges of windows.
struct Line {
    cells: Vec<(Place, Result<Growth, String>)>,
    edges: Vec<(Place, Edge)>,
}

/// The places of one line: `fixed` with `along` at each of `values`.
fn line(rig: &Rig, solver: &mut Solver, fixed: Place, along: Span, values: &[f64]) -> anyhow::Result<Line> {
    let rig = fixed.rig(rig)?;
    let mut cells = vec![];
    for &value in values {
        let place = along.condition.set(fixed, value);
        cells.push((place, growth(&rig, solver, &place)));
    }
    let mut edges = vec![];
    match along.condition {
        Condition::Friction => {
            // A map is followed from 0.
            let (mu_min, mu_max) = (along.from.min(0.0), along.to.max(0.0));
            let options = MapOptions { mu_min, mu_max, ..map_options(&rig) };
            let map = StabilityMap::build(&rig.model, solver, &fixed.point, &options)?;
            for window in &map.windows {
                let ends = [Some((window.mu_from, Edge::Begins)), window.mu_to.map(|mu| (mu, Edge::Ends))];
                let inside = |(mu, _): &(f64, Edge)| *mu > along.from && *mu < along.to;
                edges.extend(
                    ends.into_iter().flatten().filter(inside).map(|(mu, edge)| (along.condition.set(fixed, mu), edge)),
                );
            }
        }
        Condition::Load | Condition::Speed | Condition::Temperature => {
            let unstable = |cell: &Result<Growth, String>| cell.as_ref().ok().map(|growth| growth.unstable_modes > 0);
            for pair in cells.windows(2) {
                let [(from, left), (to, right)] = pair else { continue };
                let (Some(before), Some(after)) = (unstable(left), unstable(right)) else { continue };
                if before == after {
                    continue;
                }
                let [low, high] = [from, to].map(|place| along.condition.of(place));
                let grows = |value| unstable(&growth(&rig, solver, &along.condition.set(fixed, value)));
                let at = change_between(low, high, before, grows);
                let edge = if after { Edge::Begins } else { Edge::Ends };
                edges.push((along.condition.set(fixed, at), edge));
            }
        }
    }
    Ok(Line { cells, edges })
}

/// The largest growth rate in the band at `place`, or why there is no prediction.
fn growth(rig: &Rig, solver: &mut Solver, place: &Place) -> Result<Growth, String> {
    let rig = place.rig(rig).map_err(|error| error.to_string())?;
    let spectrum = solver.solve(&rig.model, &place.point, Vectors::Right).map_err(|error| error.to_string())?;
    let summary = Summary::of_spectrum(&spectrum, None, rig.band_max_hz, rig.instability_threshold);
    Ok(Growth {
        max_growth_rate_per_s: summary.max_growth_rate_per_s.unwrap_or(f64::NAN),
        frequency_hz: summary.worst_frequency_hz.unwrap_or(f64::NAN),
        unstable_modes: summary.unstable_modes,
        pairs_closed: spectrum.state.as_ref().map(|state| state.pairs_closed()),
    })
}

fn to_csv(rig: &Rig, rows: &[Vec<(Place, Result<Growth, String>)>]) -> anyhow::Result<String> {
    let mut writer = csv::Writer::from_writer(vec![]);
    let own = ["unstable_modes", "max_growth_rate_per_s", "frequency_hz", "pairs_closed", "fault"];
    writer.write_record(Place::columns(rig).chain(own))?;
    for (place, cell) in rows.iter().flatten() {
        let values = match cell {
            Ok(growth) => [
                growth.unstable_modes.to_string(),
                growth.max_growth_rate_per_s.to_string(),
                growth.frequency_hz.to_string(),
                growth.pairs_closed.map_or_else(String::new, |closed| closed.to_string()),
                String::new(),
            ],
            Err(reason) => [String::new(), String::new(), String::new(), String::new(), reason.clone()],
        };
        writer.write_record(place.cells().chain(values))?;
    }
    Ok(String::from_utf8(writer.into_inner()?)?)
}

fn edges_to_csv(rig: &Rig, edges: &[(Place, Edge)]) -> anyhow::Result<String> {
    let mut writer = csv::Writer::from_writer(vec![]);
    writer.write_record(Place::columns(rig).chain(["instability"]))?;
    for (place, edge) in edges {
        let name = match edge {
            Edge::Begins => "begins",
            Edge::Ends => "ends",
        };
        writer.write_record(place.cells().chain([name.to_owned()]))?;
    }
    Ok(String::from_utf8(writer.into_inner()?)?)
}

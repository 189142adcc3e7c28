use std::path::PathBuf;

use clap::Args;
use serde::Serialize;

use super::{AtTemperature, LoadAndSpeed, Outcome, RigName, format, not_negative, print, write_file};
use crate::display::curves::Curves;
use crate::figures::plot;
use crate::physics::stability_map::SlidingEnd;
use crate::physics::{End, MapOptions, Solver, StabilityMap, Window};
use crate::rig::Rig;
use crate::session::map_options;

const EXAMPLES: &str = "\
Examples:
  squealcast critical tribometer                     every window of instability
  squealcast critical my-rig.toml --load 800 --json  at another load, as JSON";

/// Find every window of instability in the friction coefficient, its ends to within 1e-10
#[derive(Debug, Args)]
#[command(after_help = EXAMPLES)]
pub struct Options {
    /// Rig file, or the name of an embedded rig
    #[arg(value_parser = RigName, hide_possible_values = true)]
    rig: String,
    /// Search friction coefficients from 0 to this [default: the rig's mu_max]
    #[arg(long, value_name = "MU", value_parser = not_negative)]
    mu_max: Option<f64>,
    #[command(flatten)]
    load_and_speed: LoadAndSpeed,
    #[command(flatten)]
    temperature: AtTemperature,
    /// Draw growth rates and frequencies over the friction coefficient into this file, with shaded windows
    #[arg(long, value_name = "FILE")]
    svg: Option<PathBuf>,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

/// The output of `critical --json`.
#[derive(Serialize)]
struct Report<'a> {
    critical_friction: Option<f64>,
    windows: Vec<WindowReport<'a>>,
    /// Windows narrower than this may have been missed.
    narrowest_window: f64,
    complete: bool,
    /// Only where a contact state ends inside the searched range.
    #[serde(skip_serializing_if = "Option::is_none")]
    sliding_ends: Option<SlidingEndReport>,
}

#[derive(Serialize)]
struct SlidingEndReport {
    mu: f64,
    reason: String,
}

impl From<&SlidingEnd> for SlidingEndReport {
    fn from(end: &SlidingEnd) -> Self {
        Self { mu: end.mu, reason: end.reason.to_string() }
    }
}

#[derive(Serialize)]
struct WindowReport<'a> {
    mode_ids: &'a [u32],
    mu_from: f64,
    mu_to: Option<f64>,
    frequency_hz: f64,
    kind: &'static str,
    /// Whether the window begins or ends where a contact pair opens or closes and the roots jump.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    at_jump: bool,
}

impl<'a> WindowReport<'a> {
    fn new(window: &'a Window, (from, to): &(End, Option<End>)) -> Self {
        Self {
            at_jump: from.is_jump() || to.is_some_and(|to| to.is_jump()),
            mode_ids: &window.mode_ids,
            mu_from: window.mu_from,
            mu_to: window.mu_to,
            frequency_hz: window.frequency_hz,
            kind: window.kind.name(),
        }
    }
}

impl Options {
    pub fn run(self) -> anyhow::Result<Outcome> {
        let rig = self.temperature.of(Rig::load(&self.rig)?)?;
        let point = self.load_and_speed.point(&rig)?;
        let mu_max = self.mu_max.unwrap_or(rig.mu_max);
        let options = MapOptions { mu_max, ..map_options(&rig) };
        let mut solver = Solver::new(rig.model.dimension());
        let map = StabilityMap::build(&rig.model, &mut solver, &point, &options)?;
        if let Some(path) = &self.svg {
            let (load, speed) = (point.normal_load_n, point.disc_speed_rad_s);
            let title = format!("{}, {load} N, {speed} rad/s{}", rig.name, format::temperature(&rig));
            let curves = Curves::new(&map, rig.band_max_hz);
            write_file(path, plot::map(&title, &curves, mu_max, map.critical_friction())?.as_bytes())?;
        }
        if self.json {
            let report = Report {
                critical_friction: map.critical_friction(),
                windows: map
                    .windows
                    .iter()
                    .zip(&map.ends.windows)
                    .map(|(w, ends)| WindowReport::new(w, ends))
                    .collect(),
                narrowest_window: map.resolution,
                complete: map.complete,
                sliding_ends: map.sliding_ends.as_ref().map(SlidingEndReport::from),
            };
            print(&(serde_json::to_string(&report)? + "\n"))?;
        } else {
            print(&format::windows(&rig, &map, mu_max))?;
        }
        Ok(Outcome::Done)
    }
}

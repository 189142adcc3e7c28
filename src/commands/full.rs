use std::path::PathBuf;

use anyhow::Context;
use clap::Args;
use serde::Serialize;

use super::engine::EngineOptions;
use super::format::{self, significant};
use super::memory::{keep_freed_unless, room, solver};
use super::predict::ContactReport;
use super::steps::ProgressOptions;
use super::{Conditions, Outcome, positive, print};
use crate::full_model::FullModelFile;
use crate::full_model::verification::DEFAULT_BAND_HZ;
use crate::physics::OperatingPoint;
use crate::reduction::{FullSpectrum, FullVectors};

const EXAMPLES: &str = "\
Examples:
  squealcast full model/tribometer.toml --mu 0.7 --band-hz 3000             the roots up to 3 kHz
  squealcast full model/tribometer.toml --mu 0.7 --engine slepc --ranks 2  by PETSc and SLEPc";

/// Find the complex eigenvalues of a full model under one set of conditions
///
/// Finds every root of the band within discs around shifts on the imaginary axis, each with its residual; with
/// `[contact_state]` about the state of steady sliding there.
#[derive(Debug, Args)]
#[command(after_help = EXAMPLES)]
pub struct Options {
    /// Full model (TOML)
    #[arg(value_name = "FULL.toml")]
    full: PathBuf,
    #[command(flatten)]
    conditions: Conditions,
    /// Highest frequency in Hz [default: the model's band, else 5000]
    #[arg(long, value_name = "HZ", value_parser = positive)]
    band_hz: Option<f64>,
    /// Memory that may be used [default: the memory available on the machine]
    #[arg(long, value_name = "GIB", value_parser = positive)]
    memory_gib: Option<f64>,
    #[command(flatten)]
    engine: EngineOptions,
    /// Print JSON
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    progress: ProgressOptions,
}

/// Rounding error of a growth rate, relative to the magnitude of its root.
const ROUNDING: f64 = 1e-12;

/// The output of `full --json`.
#[derive(Serialize)]
struct Report<'a> {
    full_model: &'a str,
    content_hash: &'a str,
    degrees_of_freedom: usize,
    normal_load_n: f64,
    disc_speed_rad_s: f64,
    friction_coefficient: f64,
    band_hz: f64,
    /// Roots with growth rates between plus and minus this value were found at every frequency of the band; `null` if
    /// all roots were.
    covered_growth_per_s: f64,
    /// Only for a model with a contact state.
    #[serde(skip_serializing_if = "Option::is_none")]
    contact: Option<ContactReport>,
    discs: Vec<DiscReport>,
    roots: Vec<RootReport>,
}

#[derive(Serialize)]
struct DiscReport {
    shift_hz: f64,
    from_hz: f64,
    to_hz: f64,
}

#[derive(Serialize)]
struct RootReport {
    growth_rate_per_s: f64,
    omega_rad_s: f64,
    frequency_hz: f64,
    damping_ratio: f64,
    residual: f64,
}

impl Options {
    pub fn run(self) -> anyhow::Result<Outcome> {
        keep_freed_unless(self.memory_gib);
        let chosen = self.engine.choose()?;
        chosen.end_at_signals()?;
        let engine = chosen.engine();
        let mut steps = self.progress.steps(1);
        let mut full = FullModelFile::load(&self.full)?;
        steps.say(&format!("{} degrees of freedom read", full.model.dimension()));
        let settings = &full.settings;
        let p = self.conditions.point(&full.name, &settings.reference, &settings.limits)?;
        let band_hz = self.band_hz.or(full.settings.band_max_hz).unwrap_or(DEFAULT_BAND_HZ);
        let room = room(self.memory_gib, &self.full)?;
        full.damp_modes(engine, room, &mut |_, _| {})?;
        full.find_statics(engine, room)?;
        let mut said = |step| steps.full("full model", step);
        let mut solver = solver(engine, &full, room, &mut said)?;
        let found = solver
            .roots(&p, std::f64::consts::TAU * band_hz, FullVectors::None, &mut said)
            .with_context(|| self.full.display().to_string())?;
        chosen.remark().into_iter().for_each(|by| steps.say(&format!("solved by {by}")));
        drop(steps);
        if self.json {
            print(&(serde_json::to_string(&report(&full, &p, band_hz, &found))? + "\n"))?;
        } else {
            print(&table(&full, &p, band_hz, &found))?;
        }
        Ok(Outcome::Done)
    }
}

fn report<'a>(full: &'a FullModelFile, p: &OperatingPoint, band_hz: f64, found: &FullSpectrum) -> Report<'a> {
    let hz = |omega: f64| omega / std::f64::consts::TAU;
    Report {
        full_model: &full.name,
        content_hash: &full.content_hash,
        degrees_of_freedom: full.model.dimension(),
        normal_load_n: p.normal_load_n,
        disc_speed_rad_s: p.disc_speed_rad_s,
        friction_coefficient: p.friction_coefficient,
        band_hz,
        covered_growth_per_s: found.covered_growth_per_s,
        contact: found.here.state().map(|state| ContactReport::from(&**state)),
        discs: found
            .discs
            .iter()
            .map(|disc| {
                let [from, to] = disc.stretch_rad_s();
                DiscReport { shift_hz: hz(disc.shift_rad_s), from_hz: hz(from), to_hz: hz(to) }
            })
            .collect(),
        roots: found
            .roots
            .iter()
            .map(|root| RootReport {
                growth_rate_per_s: root.lambda.re,
                omega_rad_s: root.lambda.im,
                frequency_hz: hz(root.lambda.im),
                damping_ratio: -root.lambda.re / root.lambda.norm(),
                residual: root.residual,
            })
            .collect(),
    }
}

fn table(full: &FullModelFile, p: &OperatingPoint, band_hz: f64, found: &FullSpectrum) -> String {
    let mut text = format!(
        "{}: {} degrees of freedom, {} N, {} rad/s, friction coefficient {}\n",
        full.name,
        full.model.dimension(),
        p.normal_load_n,
        p.disc_speed_rad_s,
        p.friction_coefficient
    );
    text += &found.here.state().map(|state| format::contact(state)).unwrap_or_default();
    text += "\n   frequency     growth rate  damping ratio  residual\n          Hz             1/s\n";
    for root in &found.roots {
        let lambda = root.lambda;
        let mark = if lambda.re > full.settings.instability_threshold * lambda.norm() { "  unstable" } else { "" };
        // A growth rate below the rounding error of its root is shown as 0.
        let growth = if lambda.re.abs() < ROUNDING * lambda.norm() { 0.0 } else { lambda.re };
        text += &format!(
            "{:>12.4}  {:>14}  {:>13}  {:>8.1e}{mark}\n",
            lambda.im / std::f64::consts::TAU,
            significant(growth, 6),
            significant(0.0 - growth / lambda.norm(), 4),
            root.residual
        );
    }
    let growth = found.covered_growth_per_s;
    text += &if growth.is_finite() {
        let discs = found.discs.len();
        format!(
            "\n{}; covered: 0 to {band_hz} Hz, growth rates from -{growth:.0} to {growth:.0} 1/s, by {}\n",
            format::count(found.roots.len(), "root"),
            format::count(discs, "disc")
        )
    } else {
        format!("\n{}: all up to {band_hz} Hz\n", format::count(found.roots.len(), "root"))
    };
    text
}

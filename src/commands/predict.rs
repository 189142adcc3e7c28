use clap::Args;
use serde::Serialize;

use super::{AtTemperature, Conditions, Outcome, RigName, format, print};
use crate::analysis;
use crate::contact::SteadyState;
use crate::physics::Mode;
use crate::rig::Rig;

const EXAMPLES: &str = "\
Examples:
  squealcast predict nine-dof-case-2 --mu 0.4                  at one friction coefficient
  squealcast predict my-rig.toml --load 800 --speed 20 --json  at other conditions, as JSON";

/// Predict the vibration modes of a rig under one set of conditions
#[derive(Debug, Args)]
#[command(after_help = EXAMPLES)]
pub struct Options {
    /// Rig file, or the name of an embedded rig
    #[arg(value_parser = RigName, hide_possible_values = true)]
    rig: String,
    #[command(flatten)]
    conditions: Conditions,
    #[command(flatten)]
    temperature: AtTemperature,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

/// The output of `predict --json`; NaN becomes `null`.
#[derive(Serialize)]
struct Report<'a> {
    rig: &'a str,
    normal_load_n: f64,
    disc_speed_rad_s: f64,
    friction_coefficient: f64,
    /// Only for a rig that follows the temperature.
    #[serde(skip_serializing_if = "Option::is_none")]
    temperature_c: Option<f64>,
    unstable_modes: u32,
    max_growth_rate_per_s: Option<f64>,
    nonoscillatory_growth_per_s: &'a [f64],
    /// Only for a rig whose contact follows a state.
    #[serde(skip_serializing_if = "Option::is_none")]
    contact: Option<ContactReport>,
    modes: Vec<ModeReport>,
}

/// The state of steady sliding.
#[derive(Serialize)]
pub struct ContactReport {
    pairs: usize,
    /// Pairs that carry a force.
    pairs_closed: usize,
    /// Sum of the contact forces.
    contact_force_n: f64,
    /// Force on the back of the pad.
    back_force_n: f64,
    /// Force of each pair.
    force_n: Vec<f64>,
}

impl From<&SteadyState> for ContactReport {
    fn from(state: &SteadyState) -> Self {
        Self {
            pairs: state.force_n.len(),
            pairs_closed: state.pairs_closed(),
            contact_force_n: state.contact_force_n(),
            back_force_n: state.back_force_n,
            force_n: state.force_n.clone(),
        }
    }
}

#[derive(Serialize)]
struct ModeReport {
    id: u32,
    frequency_hz: f64,
    growth_rate_per_s: f64,
    damping_ratio: f64,
    pad_participation: f64,
    residual: f64,
}

impl From<&Mode> for ModeReport {
    fn from(mode: &Mode) -> Self {
        Self {
            id: mode.id,
            frequency_hz: mode.root.frequency_hz(),
            growth_rate_per_s: mode.root.growth_rate_per_s(),
            damping_ratio: mode.root.damping_ratio(),
            pad_participation: mode.root.pad_participation,
            residual: mode.root.residual,
        }
    }
}

impl Options {
    pub fn run(self) -> anyhow::Result<Outcome> {
        let rig = self.temperature.of(Rig::load(&self.rig)?)?;
        let point = self.conditions.point(&rig.name, &rig.reference, &rig.limits)?;
        let (summary, state) = analysis::predict(&rig, &point)?;
        let state = state.as_deref();
        if self.json {
            let report = Report {
                rig: &rig.name,
                normal_load_n: point.normal_load_n,
                disc_speed_rad_s: point.disc_speed_rad_s,
                friction_coefficient: point.friction_coefficient,
                temperature_c: rig.temperature_c(),
                unstable_modes: summary.unstable_modes,
                max_growth_rate_per_s: summary.max_growth_rate_per_s,
                nonoscillatory_growth_per_s: &summary.nonoscillatory_growth_per_s,
                contact: state.map(ContactReport::from),
                modes: summary.modes.iter().map(ModeReport::from).collect(),
            };
            print(&(serde_json::to_string(&report)? + "\n"))?;
        } else {
            print(&format::prediction(&rig, &point, &summary, state))?;
        }
        Ok(Outcome::Done)
    }
}

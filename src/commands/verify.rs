use std::fmt::Write;
use std::path::PathBuf;

use clap::Args;

use super::engine::EngineOptions;
use super::memory::{keep_freed_unless, room, solver};
use super::steps::ProgressOptions;
use super::{Outcome, RigName, positive, print};
use crate::full_model::FullModelFile;
use crate::full_model::verification::{Against, Verified, WindowEnds, verify_against};
use crate::rig::Rig;

/// Default tolerance: relative error of an eigenvalue up to which rig and full model agree.
const TOLERANCE: f64 = 0.01;
/// Default difference up to which window ends of rig and full model agree.
const FRICTION_TOLERANCE: f64 = 0.003;

const EXAMPLES: &str = "\
Examples:
  squealcast verify rig.toml --against model/tribometer.toml  at ten held-out operating points";

/// Compare a reduced rig with its full model
///
/// Compares frequencies and growth rates at operating points drawn from the rig's chart range, and windows of
/// instability at its reference and at the corners of that range. Exit code 3 if an unstable mode is missed or
/// invented, or if an error exceeds the tolerance.
#[derive(Debug, Args)]
#[command(after_help = EXAMPLES)]
pub struct Options {
    /// Rig file, or the name of an embedded rig
    #[arg(value_parser = RigName, hide_possible_values = true)]
    rig: String,
    /// Full model (TOML) to compare with
    #[arg(long, value_name = "FULL.toml")]
    against: PathBuf,
    /// Held-out operating points
    #[arg(long, value_name = "N", default_value_t = 10)]
    points: usize,
    /// Seed of the points; `reduce` uses seed 1
    #[arg(long, value_name = "SEED", default_value_t = 2)]
    seed: u64,
    /// Largest relative error of an eigenvalue [default: the tolerance of the rig's basis, else 0.01]
    #[arg(long, value_name = "R", value_parser = positive)]
    tolerance: Option<f64>,
    /// Highest frequency in Hz [default: the rig's band, else the full model's, else 5000]
    #[arg(long, value_name = "HZ", value_parser = positive)]
    band_hz: Option<f64>,
    /// Compare roots only, since the windows of a large damped model take long
    #[arg(long)]
    no_windows: bool,
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

impl Options {
    pub fn run(self) -> anyhow::Result<Outcome> {
        keep_freed_unless(self.memory_gib);
        let chosen = self.engine.choose()?;
        chosen.end_at_signals()?;
        let engine = chosen.engine();
        let mut steps = self.progress.steps(1);
        let rig = Rig::load(&self.rig)?;
        let mut full = FullModelFile::load(&self.against)?;
        if let Some(known) = rig.reduction.as_ref().filter(|known| known.full_model_hash != full.content_hash) {
            steps.say(&format!(
                "the rig was reduced from another full model: {}, this one is {}",
                known.full_model_hash, full.content_hash
            ));
        }
        let against =
            Against { points: self.points, seed: self.seed, band_hz: self.band_hz, windows: !self.no_windows };
        let room = room(self.memory_gib, &self.against)?;
        full.damp_modes(engine, room, &mut |_, _| {})?;
        full.find_statics(engine, room)?;
        let mut solver = solver(engine, &full, room, &mut |step| steps.full("full model", step))?;
        let found = verify_against(&rig, &full, &mut solver, &against, &mut |what, step| steps.full(what, step))?;
        chosen.remark().into_iter().for_each(|by| steps.say(&format!("solved by {by}")));
        drop(steps);
        print(&if self.json { serde_json::to_string(&found)? + "\n" } else { text(&rig, &full, &found) })?;
        let certificate = &found.certificate;
        let tolerance = self.tolerance.or(rig.basis_tolerance).unwrap_or(TOLERANCE);
        let agrees = certificate.is_complete()
            && certificate.max_relative_error <= tolerance
            && certificate.max_force_error.is_none_or(|error| error <= tolerance)
            && certificate.critical_friction_error.is_none_or(|error| error <= tolerance.max(FRICTION_TOLERANCE));
        Ok(if agrees { Outcome::Done } else { Outcome::Differences })
    }
}

fn text(rig: &Rig, full: &FullModelFile, found: &Verified) -> String {
    let mut text = format!(
        "{} against {} ({} degrees of freedom)\n\n      load     speed  friction  modes  frequency error  growth error  |error|\n         N     rad/s                          relative           1/s  relative\n",
        rig.name,
        full.name,
        full.model.dimension()
    );
    for point in &found.points {
        let _ = writeln!(
            text,
            "{:>10.3}{:>10.4}{:>10.5}{:>7}{:>17.2e}{:>14.2e}{:>9.1e}",
            point.normal_load_n,
            point.disc_speed_rad_s,
            point.friction_coefficient,
            point.modes,
            point.max_frequency_error,
            point.max_growth_error_per_s,
            point.max_relative_error
        );
        for (what, roots) in [("missed", &point.missed), ("invented", &point.invented)] {
            for [growth, hz] in roots {
                let _ = writeln!(text, "            {what}: {hz:.3} Hz growing at {growth:.4} 1/s");
            }
        }
        if let Some(contact) = &point.contact {
            let [full, rig] = contact.pairs_closed;
            let _ = writeln!(
                text,
                "            {full} pairs closed, {rig} in the rig; contact forces differ by {:.1e} of the largest",
                contact.max_force_error
            );
        }
        if point.unpaired > 0 {
            let _ = writeln!(text, "            {} modes of the full model have no partner", point.unpaired);
        }
    }
    if !found.windows.is_empty() {
        text += "\nwindows of instability\n";
    }
    let ends_in_words = |ends: &Option<WindowEnds>| match ends {
        None => "none".to_owned(),
        Some(WindowEnds { mu_from, mu_to: Some(to), frequency_hz }) => {
            format!("{mu_from:.8} to {to:.8} at {frequency_hz:.3} Hz")
        }
        Some(WindowEnds { mu_from, mu_to: None, frequency_hz }) => {
            format!("from {mu_from:.8} at {frequency_hz:.3} Hz")
        }
    };
    for window in &found.windows {
        let _ = writeln!(
            text,
            "  {} N, {} rad/s, {}: full {}, rig {}",
            window.normal_load_n,
            window.disc_speed_rad_s,
            window.kind,
            ends_in_words(&window.full),
            ends_in_words(&window.rig)
        );
    }
    text += &format!("\n{}\n", found.certificate.summary());
    text
}

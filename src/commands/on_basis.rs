//! Reduction of a full model on a parametric basis: options.

use std::f64::consts::TAU;

use anyhow::bail;

use super::steps::Steps;
use crate::full_model::FullModelFile;
use crate::full_model::verification::DECAY_PER_S;
use crate::reduction::{Counted, FullSolver, OperatingBox, ParametricBasis, ParametricRequest, parametric_basis};

/// Default tolerance: largest `|Δλ|/|λ|`.
pub const TOLERANCE: f64 = 1e-6;
/// Operating points for estimating the error, in addition to corners and centre, for each varying condition.
const TRAINING: usize = 8;
/// Points at which a smaller basis must hold the roots of the sampled vectors, for each of those.
const CUTTING: usize = 8;
/// Held-out operating points for each varying condition.
const HELD_OUT: usize = 3;
/// As many times more of both if contact pairs open and close: the contact then changes faster with load and friction
/// coefficient, fastest where few pairs are left.
const OF_STATES: usize = 4;
/// Number of operating points at which the full model is solved before the attempt is given up.
const MOST_SAMPLES: usize = 40;
/// Number of basis vectors at which the attempt is given up: modes of the parts would serve as well.
const MOST_VECTORS: usize = 500;

/// Ranges of the conditions as given.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Ranges {
    friction_coefficient: Option<[f64; 2]>,
    normal_load_n: Option<[f64; 2]>,
    disc_speed_rad_s: Option<[f64; 2]>,
}

/// Parses `mu=0:1,speed=6:60,load=50:2000`, for clap.
pub fn ranges(text: &str) -> Result<Ranges, String> {
    let mut ranges = Ranges::default();
    for item in text.split(',') {
        let wrong = |reason: String| Err(format!("`{item}`: {reason}; expected ranges such as mu=0:1,load=50:2000"));
        let Some((name, range)) = item.split_once('=') else { return wrong("no `=`".to_owned()) };
        let ends: Vec<f64> = match range.split(':').map(|end| end.trim().parse::<f64>()).collect() {
            Ok(ends) => ends,
            Err(error) => return wrong(format!("{error}")),
        };
        let (low, high) = match *ends.as_slice() {
            [only] => (only, only),
            [low, high] => (low, high),
            _ => return wrong(format!("{} numbers", ends.len())),
        };
        let slot = match name.trim() {
            "mu" => &mut ranges.friction_coefficient,
            "load" => &mut ranges.normal_load_n,
            "speed" => &mut ranges.disc_speed_rad_s,
            other => return wrong(format!("`{other}` is not mu, load or speed")),
        };
        if slot.replace([low, high]).is_some() {
            return wrong(format!("`{}` twice", name.trim()));
        }
    }
    Ok(ranges)
}

/// Builds a parametric basis of `full`, solved by `solver`; returns it with the request it satisfies.
///
/// # Errors
/// The full model is not suitable, or the tolerance cannot be met.
pub fn basis_of(
    full: &FullModelFile,
    tolerance: f64,
    ranges: Ranges,
    solver: &mut FullSolver<'_>,
    steps: &mut Steps,
) -> anyhow::Result<(ParametricRequest, ParametricBasis)> {
    let path = full.path.display();
    let Some(band_hz) = full.settings.band_max_hz else {
        bail!("{path}: `band.max_hz` is missing; expected it: a basis holds the roots of a band");
    };
    let settings = &full.settings;
    let friction = [settings.limits.friction_coefficient[0].max(0.0), settings.limits.friction_coefficient[1]];
    let default = OperatingBox {
        friction_coefficient: [friction[0], friction[1].min(settings.mu_max)],
        normal_load_n: settings.chart.normal_load_n,
        disc_speed_rad_s: settings.chart.disc_speed_rad_s,
    };
    let asked = OperatingBox {
        friction_coefficient: ranges.friction_coefficient.unwrap_or(default.friction_coefficient),
        normal_load_n: ranges.normal_load_n.unwrap_or(default.normal_load_n),
        disc_speed_rad_s: ranges.disc_speed_rad_s.unwrap_or(default.disc_speed_rad_s),
    };
    asked.check()?;
    let (load, speed) = full.model.depends_on_load_and_speed();
    let range = asked.without(!load, !speed);
    // A single value is not a range: there is nothing to train on or to hold out.
    let matters = range.widths();
    if matters == 0 {
        bail!(
            "{path}: the range is a single operating point; expected two values of mu, load or speed where they matter"
        );
    }
    let lowest = range.friction_coefficient[0];
    if lowest > 0.0 {
        bail!("{path}: the range of mu begins at {lowest}; expected 0: windows of instability are searched from there");
    }
    let points = if full.model.statics().is_some() { OF_STATES * matters } else { matters };
    let request = ParametricRequest {
        range,
        counted: Counted { band_rad_s: TAU * band_hz, growth_floor_per_s: -DECAY_PER_S },
        tolerance,
        training: TRAINING * points,
        cutting: CUTTING * TRAINING * points,
        held_out: HELD_OUT * points,
        most_samples: MOST_SAMPLES,
        most_vectors: MOST_VECTORS,
    };
    let basis = parametric_basis(&full.model, solver, &request, &mut |step| steps.basis(step))?;
    let vectors = &basis.projected.basis;
    solver.held_elsewhere(size_of::<f64>() * vectors.nrows() * vectors.ncols());
    // For conditions on which the model does not depend, the basis is valid over the whole given range.
    Ok((ParametricRequest { range: asked, ..request }, basis))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ranges_as_text() {
        let all = ranges("mu=0:1, speed=6:60,load=500").unwrap();
        assert_eq!(all.friction_coefficient, Some([0.0, 1.0]));
        assert_eq!(all.disc_speed_rad_s, Some([6.0, 60.0]));
        assert_eq!(all.normal_load_n, Some([500.0, 500.0]));
        for (text, expected) in [
            ("mu", "no `=`"),
            ("mu=a", "invalid float"),
            ("mu=0:1:2", "3 numbers"),
            ("mass=1", "not mu, load or speed"),
            ("mu=0,mu=1", "`mu` twice"),
        ] {
            assert!(ranges(text).unwrap_err().contains(expected), "{text}: {}", ranges(text).unwrap_err());
        }
    }
}

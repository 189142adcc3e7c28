//! How small changes of the conditions and of the contact change the growth rate of a mode.
//!
//! A simple root moves along its tangent. Two roots close to merging move as `z = m ± √d`, whose mean `m` and
//! discriminant `d` change linearly (`physics::sensitivity`).

use faer::c64;
use serde::Serialize;

use super::curves::root;
use crate::physics::sensitivity::{Change, SensitivityError, of_roots};
use crate::physics::{Model, Spectrum};

/// Relative change of each parameter. The linear laws hold over it.
const SHARE: f64 = 0.01;

/// Change of a mode's growth rate, 1/s, when one parameter increases by 1 %; `null` if unknown.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct GrowthChange {
    pub friction: Option<f64>,
    pub load: Option<f64>,
    pub speed: Option<f64>,
    pub contact_stiffness: Option<f64>,
    pub contact_damping: Option<f64>,
}

impl GrowthChange {
    /// For the mode at `index` of `spectrum`.
    ///
    /// # Errors
    /// [`SensitivityError`].
    pub fn new(model: &Model, spectrum: &Spectrum, index: usize) -> Result<Self, SensitivityError> {
        let found = of_roots(model, spectrum, &[index])?;
        let change = found.first().map(|found| found.change).ok_or(SensitivityError::Singular { root: index })?;
        let now = spectrum.roots[index].lambda;
        let p = &spectrum.point;
        let steps = [
            SHARE * p.friction_coefficient,
            SHARE * p.normal_load_n,
            SHARE * p.disc_speed_rad_s,
            // Contact stiffness and damping are parametrised by the logarithm of a factor.
            SHARE.ln_1p(),
            SHARE.ln_1p(),
        ];
        let after = |k: usize| match change {
            Change::Linear(slope) => now + slope[k] * steps[k],
            Change::SquareRoot { pair, .. } => {
                let mean = pair.mean + pair.mean_slope[k] * steps[k];
                let half = (pair.discriminant + pair.discriminant_slope[k] * steps[k]).sqrt();
                let lambda = |z: c64| if spectrum.undamped { root(z) } else { z };
                let (a, b) = (lambda(mean + half), lambda(mean - half));
                // Of a merged pair, follow the growing root; of two stable roots, the one nearest to the present root.
                let first = if now.re > 0.0 { a.re > b.re } else { (a - now).norm() < (b - now).norm() };
                if first { a } else { b }
            }
        };
        let known = |k: usize| Some(after(k).re - now.re).filter(|change| change.is_finite());
        let contact = |k: usize| model.is_linear_in_contact().then(|| known(k)).flatten();
        Ok(Self {
            friction: known(0),
            load: known(1),
            speed: known(2),
            contact_stiffness: contact(3),
            contact_damping: contact(4),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::physics::{OperatingPoint, Solver, Vectors};
    use crate::rig::Rig;

    /// Compared with solves at the changed conditions, in the middle of a window and close to its beginning (0.3559).
    #[test]
    fn changes_of_growth_are_those_of_spectra_at_the_changed_conditions() {
        let rig = Rig::load("nine-dof-case-2").unwrap();
        let mut solver = Solver::new(rig.model.dimension());
        let mut growth = |p: &OperatingPoint| {
            let spectrum = solver.solve(&rig.model, p, Vectors::Right).unwrap();
            let fastest = (0..spectrum.mode_count)
                .max_by(|&a, &b| spectrum.roots[a].lambda.re.total_cmp(&spectrum.roots[b].lambda.re));
            let fastest = fastest.unwrap();
            let change = GrowthChange::new(&rig.model, &spectrum, fastest).unwrap();
            (spectrum.roots[fastest].lambda.re, change)
        };
        for mu in [0.37, 0.6] {
            let p = rig.reference.with_friction(mu);
            let (now, change) = growth(&p);
            assert!(now > 0.0);
            let (more_friction, _) = growth(&p.with_friction(1.01 * mu));
            let (more_load, _) = growth(&OperatingPoint { normal_load_n: 1.01 * p.normal_load_n, ..p });
            for (solved, found) in [(more_friction, change.friction), (more_load, change.load)] {
                let (solved, found) = (solved - now, found.unwrap());
                // The growth rate rises approximately as the square root of the distance from the beginning of the
                // window. For a step of x times that distance, √(1 + x) - 1 differs from x / 2 by a fraction x / 4.
                let share = 0.25 * SHARE * mu / (mu - 0.3559);
                let tolerance = (1.2 * share + 0.01) * solved.abs() + 1e-9;
                assert!((solved - found).abs() < tolerance, "at {mu}: {found}, solved {solved}");
            }
            assert!(change.friction.unwrap() > 0.0 && change.contact_stiffness.is_some());
        }
    }
}

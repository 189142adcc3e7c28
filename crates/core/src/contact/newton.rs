//! Newton's method for one state of steady sliding.
//!
//! Newton's direction is computed for the closures. The step along it is taken in other variables, `u_k = δ_k + f_k N_k`:
//! the approach of a pair in series with a spring of typical flexibility `f_k`. The force is nearly linear in `u_k` for an
//! exponential law as for a law with a sharp onset, so long steps neither overflow nor open every pair.

use faer::Mat;

use super::equations::{Equations, Evaluated, Jacobian, Point};

/// Largest residual of a state, relative to the largest terms of the equations.
pub(super) const LIMIT: f64 = 1e-11;
/// Residual at the level of rounding errors, at which Newton's method stops.
const ROUNDING: f64 = 1e-15;
/// Below this residual the steps have full length and are taken in the closures.
const POLISH: f64 = 1e-9;
/// Below this residual the Jacobian is not computed again.
const SETTLED: f64 = 1e-12;
/// A Jacobian whose step reduces the residual by this factor is kept for the next one, if it may be.
const FAST: f64 = 0.05;
/// Largest number of Newton steps, and of halvings of one step.
const MOST_STEPS: usize = 60;
const MOST_HALVINGS: usize = 25;

impl Equations<'_> {
    /// Newton's direction.
    pub(super) fn direction(&self, at: &Evaluated, jacobian: &Jacobian) -> Vec<f64> {
        let mut right = Mat::from_fn(at.residual.len(), 1, |row, _| -at.residual[row]);
        self.solve(jacobian, &mut right);
        right.col(0).iter().copied().collect()
    }

    /// The point a step of length `t` along `direction` leads to.
    pub(super) fn step(&self, at: &Evaluated, direction: &[f64], t: f64, polish: bool) -> Point {
        let c = self.statics.pairs();
        let closure = (0..c)
            .map(|k| {
                let (delta, value) = (at.point.closure[k], at.law[k]);
                if polish {
                    return delta + t * direction[k];
                }
                let f = self.scales.flexibility[k];
                let support = self.support * self.scales.stiffness[k];
                // The additional spring adds its force to that of the pair: u = δ (1 + f k_s) + f N.
                let stretch = 1.0 + f * support;
                let approach = delta + f * value.pressure + t * (1.0 + f * value.tangent) * direction[k];
                let flexibility = f * self.statics.parts.area[k] / stretch;
                self.statics.parts.law.shared_closure(approach / stretch, flexibility)
            })
            .collect();
        let others = at.point.others.iter().zip(&direction[c..]).map(|(value, step)| value + t * step).collect();
        Point { closure, others }
    }

    /// Newton steps from `start`; the state with its Jacobian, or the residual where they ended. `full` takes every step at
    /// full length: where pairs open and close, the residual may have to grow before it vanishes.
    pub(super) fn newton(&self, start: Point, full: bool) -> Result<(Evaluated, Jacobian), f64> {
        self.newton_from(self.evaluate(start), full, None)
    }

    /// The same from where the equations are evaluated already. With `arrays`, which take the Jacobian, it is kept from step
    /// to step while these are fast.
    pub(super) fn newton_from(
        &self,
        mut at: Evaluated,
        full: bool,
        arrays: Option<Jacobian>,
    ) -> Result<(Evaluated, Jacobian), f64> {
        let keeps = arrays.is_some();
        let mut jacobian = self.jacobian(&at, arrays.unwrap_or_default());
        for _ in 0..MOST_STEPS {
            if at.accuracy <= ROUNDING {
                return Ok((at, jacobian));
            }
            let direction = self.direction(&at, &jacobian);
            if direction.iter().any(|value| !value.is_finite()) {
                return Err(at.accuracy);
            }
            let polish = at.accuracy < POLISH;
            let mut better = None;
            let mut t = 1.0;
            for _ in 0..MOST_HALVINGS {
                let tried = self.evaluate(self.step(&at, &direction, t, polish));
                let improves =
                    if polish { tried.accuracy < 0.5 * at.accuracy } else { tried.norm <= (1.0 - 1e-4 * t) * at.norm };
                if improves || (!polish && (tried.accuracy <= ROUNDING || (full && tried.norm.is_finite()))) {
                    better = Some(tried);
                    break;
                }
                if polish {
                    break;
                }
                t *= 0.5;
            }
            match better {
                Some(tried) => {
                    // A step that only removes rounding errors leaves the Jacobian as it is.
                    let fast = keeps && tried.accuracy < FAST * at.accuracy;
                    let settled = (fast || at.accuracy < SETTLED) && tried.closed == jacobian.closed;
                    at = tried;
                    if !settled {
                        jacobian = self.jacobian(&at, jacobian);
                    }
                }
                None if at.accuracy <= LIMIT => return Ok((at, jacobian)),
                None => return Err(at.accuracy),
            }
        }
        if at.accuracy <= LIMIT { Ok((at, jacobian)) } else { Err(at.accuracy) }
    }
}

//! Known states, from which the solution of nearby states starts: a few solves with the factors of the nearest one replace the
//! path from `μ = 0`.

use faer::Mat;

use super::equations::{Equations, Evaluated, Jacobian, Scales};
use super::path::Path;
use super::statics::{Statics, SteadyState};

/// Steps with the Jacobian of an anchor: the residual below which they end, the largest number of them, and the factor by
/// which each must reduce the residual.
const NEAR: f64 = 1e-3;
const MOST_CHORDS: usize = 12;
const CONTRACTION: f64 = 0.3;
/// Derivatives are refined until the next step would change them by less than this, relative, and in at most so many steps.
/// Each must change them less than the one before, by the factor of a step with the Jacobian of an anchor.
const REFINED: f64 = 1e-15;
const MOST_REFINEMENTS: usize = 8;
/// Change of the friction coefficient that counts as much as a change of the load by a factor of e.
const FRICTION_SCALE: f64 = 0.1;

/// A known state, at which the solution of nearby states starts.
#[derive(Clone, Debug)]
pub(super) struct Anchor {
    state: SteadyState,
    jacobian: Jacobian,
}

/// Arrays of the size of the matrices, which serve one state after the other.
#[derive(Debug)]
pub(super) struct Work {
    flexibility: Mat<f64>,
    jacobian: Jacobian,
}

impl Default for Work {
    fn default() -> Self {
        Self { flexibility: Mat::new(), jacobian: Jacobian::default() }
    }
}

/// Anchors at the given conditions; conditions without a state are omitted. At each load, one path leads through all friction
/// coefficients of a sign.
pub(super) fn anchors(statics: &Statics, loads_n: &[f64], s_mus: &[f64]) -> Vec<Anchor> {
    let mut anchors = vec![];
    let side = |forward: bool| {
        let mut side: Vec<f64> = s_mus.iter().copied().filter(|s_mu| (*s_mu >= 0.0) == forward).collect();
        side.sort_by(|a, b| a.abs().total_cmp(&b.abs()));
        side
    };
    let sides = [side(true), side(false)];
    for &load in loads_n {
        let scales = Scales::new(statics, load);
        for side in sides.iter().filter(|side| !side.is_empty()) {
            let Ok(mut path) = Path::at_rest(statics, load, &scales) else { continue };
            for &s_mu in side {
                if path.advance(s_mu).is_err() {
                    break;
                }
                let equations = Equations::new(statics, load, s_mu, 0.0, &scales);
                let at = equations.evaluate(equations.predicted(&path.state, [0.0; 2]));
                let jacobian = equations.jacobian(&at, Jacobian::default());
                anchors.push(Anchor { state: path.state.clone(), jacobian });
            }
        }
    }
    anchors
}

/// The state, started from the nearest of `anchors`; `None` if it is not certain to be the one continued from `μ = 0`.
pub(super) fn from_anchor(
    statics: &Statics,
    anchors: &[Anchor],
    load: f64,
    s_mu: f64,
    work: &mut Work,
) -> Option<SteadyState> {
    let away = |anchor: &Anchor| {
        let [by_load, by_friction] =
            [(load / anchor.state.load_n).ln(), (s_mu - anchor.state.friction) / FRICTION_SCALE];
        by_load * by_load + by_friction * by_friction
    };
    let anchor = anchors.iter().min_by(|one, other| away(one).total_cmp(&away(other)))?;
    let scales = Scales::new(statics, load);
    let flexibility = std::mem::replace(&mut work.flexibility, Mat::new());
    let equations = Equations::within(flexibility, statics, load, s_mu, 0.0, &scales);
    let state = equations.continued_from(anchor, work);
    work.flexibility = equations.flexibility;
    state
}

impl Equations<'_> {
    /// The state, started from `anchor`; `None` if it is not certain to be its continuation.
    fn continued_from(&self, anchor: &Anchor, work: &mut Work) -> Option<SteadyState> {
        let along = [self.load - anchor.state.load_n, self.x - anchor.state.friction];
        let mut at = self.evaluate(self.predicted(&anchor.state, along));
        for _ in 0..MOST_CHORDS {
            if at.accuracy < NEAR {
                break;
            }
            let direction = self.direction(&at, &anchor.jacobian);
            let tried = self.evaluate(self.step(&at, &direction, 1.0, true));
            let contracts = tried.accuracy < CONTRACTION * at.accuracy;
            if tried.accuracy < at.accuracy {
                at = tried;
            }
            if !contracts {
                break;
            }
        }
        let found = self.newton_from(at, false, Some(std::mem::take(&mut work.jacobian))).ok()?;
        let near = self.is_near(&anchor.state, along, anchor.jacobian.sign, &found);
        let (at, jacobian) = found;
        let state = near.then(|| match self.slopes(&at, &jacobian) {
            Some(slopes) => self.state_with(&at, &slopes),
            None => self.state(&at, &self.jacobian(&at, Jacobian::default())),
        });
        work.jacobian = jacobian;
        state
    }

    /// The derivatives of all unknowns with respect to the load, `s μ` and `ln κ`. If the Jacobian is that of another point,
    /// they are refined; `None` if that does not converge.
    fn slopes(&self, at: &Evaluated, jacobian: &Jacobian) -> Option<Mat<f64>> {
        let right = self.parameters(at);
        let mut slopes = right.clone();
        self.solve(jacobian, &mut slopes);
        let same = at.law.iter().zip(&jacobian.tangent).all(|(value, tangent)| value.tangent == *tangent);
        let mut last = 1.0;
        for _ in 0..if same { 0 } else { MOST_REFINEMENTS } {
            let mut rest = &right - self.times(at, &slopes);
            self.solve(jacobian, &mut rest);
            slopes += &rest;
            let change = (0..3).map(|k| rest.col(k).norm_max() / slopes.col(k).norm_max()).fold(0.0, f64::max);
            if change * change < REFINED * last {
                break;
            }
            if change.is_nan() || change > CONTRACTION * last {
                // Rounding errors remain.
                return (change < 1e3 * REFINED).then_some(slopes);
            }
            last = change;
        }
        Some(slopes)
    }
}

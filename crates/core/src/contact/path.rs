//! Continuation of states of steady sliding from `μ = 0`.

use super::equations::{Equations, Evaluated, Jacobian, Point, Scales};
use super::newton::LIMIT;
use super::statics::{MeasuredLoad, PathEnd, Statics, StaticsError, SteadyState};

/// Stiffness, relative to that of the pairs, of additional bilateral springs. The state without friction is solved with
/// each of them in turn, from the state before; the last entry, 0, is the problem itself.
const SUPPORTS: [&[f64]; 2] = [&[1.0, 0.0], &[1.0, 0.3, 0.1, 0.03, 0.01, 3e-3, 1e-3, 1e-4, 1e-5, 1e-7, 0.0]];
/// Longest step in the friction coefficient, and the step below which the states are considered to end.
const LONGEST: f64 = 0.1;
const SHORTEST: f64 = 1e-13;
/// Largest difference between predicted and found forces of a step, relative to their sum: larger ones could lead to
/// another branch.
const DEVIATION: f64 = 0.1;
/// Share of the load below which forces are too small to be compared: the first pair may just have closed.
const BARELY: f64 = 1e-3;
/// Growth of the forces that counts as unlimited.
const GROWTH: f64 = 1e6;

impl Equations<'_> {
    /// First-order prediction from `state`, `along` steps of load and friction coefficient.
    pub(super) fn predicted(&self, state: &SteadyState, [load, friction]: [f64; 2]) -> Point {
        let moved = |value: f64, per_load: f64, per_friction: f64| value + load * per_load + friction * per_friction;
        let (by_load, by_friction) = (&state.per_load, &state.per_friction);
        let pairs = state.closure_m.iter().zip(&by_load.closure).zip(&by_friction.closure);
        let motions = state.rigid.iter().zip(&by_load.rigid).zip(&by_friction.rigid);
        let mut others: Vec<f64> = motions.map(|((value, load), friction)| moved(*value, *load, *friction)).collect();
        if self.statics.parts.measured == MeasuredLoad::Contact {
            others.push(moved(state.back_force_n, by_load.back_force, by_friction.back_force));
        }
        let closure = pairs.map(|((value, load), friction)| moved(*value, *load, *friction)).collect();
        Point { closure, others }
    }

    /// Whether a solution is the continuation of `state`: the determinant has the sign it had without friction, the force
    /// on the back presses the pad on the disc, and the contact forces are close to the predicted ones.
    pub(super) fn is_near(
        &self,
        state: &SteadyState,
        [load, friction]: [f64; 2],
        sign: i8,
        (at, jacobian): &(Evaluated, Jacobian),
    ) -> bool {
        let slopes = state.per_load.force.iter().zip(&state.per_friction.force);
        let (mut difference, mut total) = (0.0, 0.0);
        for ((before, (by_load, by_friction)), value) in state.force_n.iter().zip(slopes).zip(&at.law) {
            let predicted = (before + load * by_load + friction * by_friction).max(0.0);
            difference += (predicted - value.pressure).abs();
            total += value.pressure;
        }
        jacobian.sign == sign
            && self.pushes(&at.point)
            && difference <= DEVIATION * f64::max(total, BARELY * self.scales.force)
    }
}

/// The state at `load` and `s_mu`, continued from `s_mu = 0`.
pub(super) fn follow(statics: &Statics, load: f64, s_mu: f64) -> Result<SteadyState, StaticsError> {
    let scales = Scales::new(statics, load);
    let mut path = Path::at_rest(statics, load, &scales)?;
    path.advance(s_mu)?;
    Ok(path.state)
}

/// A path of states at one load, from the one without friction on.
pub(super) struct Path<'a> {
    pub(super) statics: &'a Statics,
    pub(super) scales: &'a Scales,
    /// The last state, and the sign of the determinant on the path.
    pub(super) state: SteadyState,
    pub(super) sign: i8,
}

impl<'a> Path<'a> {
    pub(super) fn at_rest(statics: &'a Statics, load: f64, scales: &'a Scales) -> Result<Self, StaticsError> {
        let (at, jacobian) = at_rest(statics, load, scales)?;
        let sign = jacobian.sign;
        let equations = Equations::new(statics, load, 0.0, 0.0, scales);
        if !equations.pushes(&at.point) {
            let end = PathEnd::Jams;
            return Err(StaticsError::NoEquilibrium { load_n: load, asked: 0.0, friction_coefficient: 0.0, end });
        }
        Ok(Self { statics, scales, state: equations.state(&at, &jacobian), sign })
    }

    /// Continues the path to `s_mu`.
    pub(super) fn advance(&mut self, s_mu: f64) -> Result<(), StaticsError> {
        let Self { statics, scales, sign, .. } = *self;
        let (load, mut x) = (self.state.load_n, self.state.friction);
        let mut step = (s_mu - x).clamp(-LONGEST, LONGEST);
        while x != s_mu {
            let rest = s_mu - x;
            let next = if step.abs() >= rest.abs() { s_mu } else { x + step };
            let equations = Equations::new(statics, load, next, 0.0, scales);
            let along = next - x;
            let predicted = equations.predicted(&self.state, [0.0, along]);
            let accepted = equations
                .newton(predicted, false)
                .ok()
                .filter(|found| equations.is_near(&self.state, [0.0, along], sign, found));
            match accepted {
                Some((at, jacobian)) => {
                    self.state = equations.state(&at, &jacobian);
                    x = next;
                    step = (2.0 * step).clamp(-LONGEST, LONGEST);
                }
                None => {
                    step = 0.5 * along;
                    if step.abs() < SHORTEST * x.abs().max(1.0) {
                        let end = classify(&equations, &self.state, step.signum(), sign);
                        return Err(StaticsError::NoEquilibrium {
                            load_n: load,
                            asked: s_mu,
                            friction_coefficient: x,
                            end,
                        });
                    }
                }
            }
        }
        Ok(())
    }
}

/// The state without friction, the minimum of a convex energy.
fn at_rest(statics: &Statics, load: f64, scales: &Scales) -> Result<(Evaluated, Jacobian), StaticsError> {
    let mut residual = f64::INFINITY;
    let ways = [false, true].into_iter().flat_map(|full| SUPPORTS.map(|supports| (supports, full)));
    for (supports, full) in ways {
        let others = vec![0.0; statics.others()];
        let mut point = Point { closure: vec![0.0; statics.pairs()], others };
        for &support in supports {
            match Equations::new(statics, load, 0.0, support, scales).newton(point, full) {
                Ok((at, jacobian)) if support == 0.0 && jacobian.sign != 0 => return Ok((at, jacobian)),
                Ok((at, _)) => point = at.point,
                Err(left) => {
                    residual = left;
                    break;
                }
            }
        }
    }
    Err(StaticsError::NoStateAtRest { load_n: load, residual, limit: LIMIT })
}

/// How the path ends just beyond `state`, in the direction `toward`.
fn classify(near: &Equations<'_>, state: &SteadyState, toward: f64, sign: i8) -> PathEnd {
    let (statics, scales) = (near.statics, near.scales);
    let back_vanishes = statics.parts.measured == MeasuredLoad::Contact
        && state.back_force_n.abs() <= 1e-9 * scales.force * (1.0 + state.per_friction.back_force.abs());
    if back_vanishes || state.contact_force_n() > GROWTH * scales.force {
        return PathEnd::Jams;
    }
    if state.rigid.is_empty() {
        return PathEnd::Turns;
    }
    // A part tips if the Jacobian is singular beyond the last kink, or becomes singular at bounded forces.
    let beyond = 1e3 * SHORTEST * toward;
    let equations = Equations::new(statics, state.load_n, state.friction + beyond, 0.0, scales);
    let at = equations.evaluate(equations.predicted(state, [0.0, beyond]));
    let jacobian = equations.jacobian(&at, Jacobian::default());
    let largest = state.per_friction.force.iter().fold(0.0f64, |most, value| most.max(value.abs()));
    if jacobian.sign == -sign && largest > GROWTH * scales.force {
        return PathEnd::Turns;
    }
    let pivots = jacobian.factors.pivots().map(f64::abs);
    let (least, most) =
        pivots.fold((f64::INFINITY, 0.0f64), |(least, most), pivot| (least.min(pivot), most.max(pivot)));
    if least <= 1e-9 * most { PathEnd::Tips } else { PathEnd::Turns }
}

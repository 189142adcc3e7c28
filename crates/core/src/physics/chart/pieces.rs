//! Boxes over which a contact law that is not analytic stays on one of its pieces.
//!
//! Such a law is analytic between its breaks: the closure at which a pair opens, or the points of a table. Where the
//! closure of a pair passes a break, roots jump or bend. Roots and totals are therefore expanded only over boxes
//! throughout which the closure of every pair stays between two breaks. To find out, closures are expanded first: they
//! take a state at each point, but no eigenvalues.

use super::{Axis, MAX_AXES};
use crate::chebyshev::{nodes, transform};
use crate::contact::SteadyState;
use crate::physics::law::Parameter;
use crate::physics::model::Model;
use crate::physics::operating_point::OperatingPoint;

/// Number of points along each axis.
const NODES: usize = 5;
/// Factor by which the bound of the error of a closure exceeds its estimate.
const SAFETY: f64 = 4.0;
/// Error of a closure, relative to the largest one over a box: the residual of a state is at most 1e-11.
const ROUNDING: f64 = 1e-11;

/// The pieces of the contact law of a model.
pub(super) struct Pieces<'a> {
    model: &'a Model,
    breaks: &'a [f64],
    /// The axes that move the state, with their places among all axes.
    axes: Vec<(usize, Axis)>,
    /// The conditions that have no axis are those of this point.
    base: OperatingPoint,
}

impl<'a> Pieces<'a> {
    /// The pieces of the law of `model`; `None` if its roots are analytic everywhere.
    pub fn new(model: &'a Model, axes: &[Axis], base: OperatingPoint) -> Option<Self> {
        let breaks = model.statics().map(|statics| statics.parts().law.breaks()).filter(|breaks| !breaks.is_empty())?;
        let moves = |axis: &Axis| match axis {
            Axis::Friction | Axis::Load | Axis::LoadOverSpeed => true,
            Axis::Speed | Axis::LateralDamping => false,
        };
        let axes = axes.iter().copied().enumerate().filter(|(_, axis)| moves(axis)).collect();
        Some(Self { model, breaks, axes, base })
    }

    /// Whether the closures of all pairs lie on the same pieces in both states.
    pub fn agree(&self, one: &SteadyState, other: &SteadyState) -> bool {
        self.moved(one, other).is_none()
    }

    /// The first pair whose closures in two states lie on different pieces.
    fn moved(&self, one: &SteadyState, other: &SteadyState) -> Option<usize> {
        let piece = |closure: f64| self.breaks.partition_point(|at| *at < closure);
        (0..one.closure_m.len()).find(|&pair| piece(one.closure_m[pair]) != piece(other.closure_m[pair]))
    }

    /// The axis to split a box along because in a part of it the closure of a pair may pass a break; the `longest` one if
    /// there is no state somewhere.
    pub fn broken(&self, low: &[f64; MAX_AXES], high: &[f64; MAX_AXES], longest: usize) -> Option<usize> {
        let (count, points) = (self.axes.len(), nodes(NODES));
        let all = NODES.pow(count as u32);
        let mut closures: Vec<f64> = vec![];
        let mut first: Option<SteadyState> = None;
        // Along the diagonal first.
        for index in (0..all).map(|k| k * (NODES + 1) % all) {
            let mut p = self.base;
            for (k, &(place, axis)) in self.axes.iter().enumerate() {
                let unit = points[index / NODES.pow(k as u32) % NODES];
                axis.place(&mut p, low[place] + 0.5 * (unit + 1.0) * (high[place] - low[place]));
            }
            let Ok(here) = self.model.at(&p) else { return Some(longest) };
            // Without a load on the contact there is no state that could change.
            let state = here.state()?;
            let first = first.get_or_insert_with(|| (**state).clone());
            if let Some(pair) = self.moved(first, state) {
                return Some(self.steepest(state, pair, &p, low, high));
            }
            closures.resize(all * state.closure_m.len(), 0.0);
            for (pair, closure) in state.closure_m.iter().enumerate() {
                closures[pair * all + index] = *closure;
            }
        }
        let largest = closures.iter().fold(0.0f64, |most, closure| most.max(closure.abs()));
        transform(&mut closures, NODES, count);
        closures.chunks_exact(all).find_map(|coefficients| self.passes(coefficients, ROUNDING * largest))
    }

    /// The axis along which a closure varies most, if it may pass a break; `rounding` is its error at the points.
    fn passes(&self, coefficients: &[f64], rounding: f64) -> Option<usize> {
        let degree = |index: usize, k: usize| index / NODES.pow(k as u32) % NODES;
        let sum = |of: &dyn Fn(usize) -> bool| -> f64 {
            (1..coefficients.len()).filter(|&index| of(index)).map(|index| coefficients[index].abs()).sum()
        };
        let high = |index: usize| (0..self.axes.len()).any(|k| degree(index, k) >= NODES - 2);
        let reach = sum(&|_| true) + SAFETY * sum(&high) + rounding;
        let [low, high] = [coefficients[0] - reach, coefficients[0] + reach];
        let passes = low.is_nan() || high.is_nan() || self.breaks.iter().any(|at| (low..=high).contains(at));
        let along = |k: &usize| sum(&|index| degree(index, *k) > 0);
        let axis = (0..self.axes.len()).max_by(|a, b| along(a).total_cmp(&along(b)));
        axis.filter(|_| passes).map(|k| self.axes[k].0)
    }

    /// The axis along which the closure of `pair` changes most over a box, by its slopes at `state`.
    fn steepest(
        &self,
        state: &SteadyState,
        pair: usize,
        p: &OperatingPoint,
        low: &[f64; MAX_AXES],
        high: &[f64; MAX_AXES],
    ) -> usize {
        let change = |&(place, axis): &(usize, Axis)| {
            let (parameter, per) = axis.derivative(p);
            let slope = match parameter {
                Parameter::Friction => state.per_friction.closure[pair],
                Parameter::Load => state.per_load.closure[pair],
                Parameter::Speed | Parameter::ContactStiffness | Parameter::ContactDamping => 0.0,
            };
            (slope * per * (high[place] - low[place])).abs()
        };
        let steepest = self.axes.iter().max_by(|a, b| change(a).total_cmp(&change(b)));
        steepest.map_or(0, |(place, _)| *place)
    }
}

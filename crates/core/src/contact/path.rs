//! Newton's method for one state of steady sliding, and continuation of states from `μ = 0`.
//!
//! Newton's direction is computed for the closures. The step along it is taken in other variables, `u_k = δ_k + f_k N_k`:
//! the approach of a pair in series with a spring of typical flexibility `f_k`. The force is nearly linear in `u_k` for an
//! exponential law as for a law with a sharp onset, so long steps neither overflow nor open every pair.

use faer::linalg::matmul::matmul;
use faer::{Accum, Mat, MatMut, Par};

use super::factors::Factors;
use super::law::LawValue;
use super::statics::{MeasuredLoad, PathEnd, StateSlope, Statics, StaticsError, SteadyState};

/// Largest residual of a state, relative to the largest terms of the equations.
const LIMIT: f64 = 1e-11;
/// Residual at the level of rounding errors, at which Newton's method stops.
const ROUNDING: f64 = 1e-15;
/// Below this residual the steps have full length and are taken in the closures.
const POLISH: f64 = 1e-9;
/// Below this residual the Jacobian is not computed again.
const SETTLED: f64 = 1e-12;
/// Steps with the Jacobian of an anchor: the residual below which they end, the largest number of them, and the factor by
/// which each must reduce the residual.
const NEAR: f64 = 1e-3;
const MOST_CHORDS: usize = 12;
const CONTRACTION: f64 = 0.3;
/// A Jacobian whose step reduces the residual by this factor is kept for the next one, if it may be.
const FAST: f64 = 0.05;
/// Derivatives are refined until the next step would change them by less than this, relative, and in at most so many steps.
/// Each must change them less than the one before, by the factor of a step with the Jacobian of an anchor.
const REFINED: f64 = 1e-15;
const MOST_REFINEMENTS: usize = 8;
/// Change of the friction coefficient that counts as much as a change of the load by a factor of e.
const FRICTION_SCALE: f64 = 0.1;
/// Largest number of Newton steps, and of halvings of one step.
const MOST_STEPS: usize = 60;
const MOST_HALVINGS: usize = 25;
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

/// Unknowns: closures, then rigid motions, then the force on the back if it is not measured.
#[derive(Clone, Debug)]
struct Point {
    closure: Vec<f64>,
    others: Vec<f64>,
}

/// The equations at one load and friction coefficient.
struct Equations<'a> {
    statics: &'a Statics,
    load: f64,
    x: f64,
    /// `G_nn + x G_nt`.
    flexibility: Mat<f64>,
    /// `B_n Φ_r + x B_t Φ_r`, `c×r`.
    pushed: Mat<f64>,
    /// Stiffness of additional bilateral springs per pair.
    support: f64,
    scales: &'a Scales,
}

/// Typical sizes at a load.
struct Scales {
    /// m.
    length: f64,
    /// N.
    force: f64,
    /// Tangent stiffness of each pair at the mean pressure.
    stiffness: Vec<f64>,
    /// `f`, m/N.
    flexibility: Vec<f64>,
}

/// The equations evaluated at a point.
struct Evaluated {
    point: Point,
    law: Vec<LawValue>,
    /// Pairs with a tangent stiffness.
    closed: Vec<usize>,
    /// Residual, m: of the pairs, then of the other equations times `length / force`.
    residual: Vec<f64>,
    /// Norm of the residual.
    norm: f64,
    /// Largest residual relative to the largest term of its kind of equation.
    accuracy: f64,
}

/// Factorised Jacobian over closed pairs and other unknowns.
#[derive(Clone, Debug, Default)]
struct Jacobian {
    factors: Factors,
    /// Pairs with a tangent stiffness, and the tangent stiffness of every pair.
    closed: Vec<usize>,
    tangent: Vec<f64>,
    /// Sign of the determinant; 0 where the matrix is singular to working precision.
    sign: i8,
}

impl Scales {
    fn new(statics: &Statics, load: f64) -> Self {
        let parts = &statics.parts;
        let force = if load == 0.0 { 1.0 } else { load.abs() };
        let pressure = force / statics.total_area;
        let tangent = parts.law.at(parts.law.closure_at(pressure)).tangent;
        let stiffness: Vec<f64> = parts.area.iter().map(|area| area * tangent).collect();
        let own = |k: usize| parts.response.normal_flexibility[(k, k)];
        let c = statics.pairs();
        let largest =
            |values: &mut dyn Iterator<Item = f64>| values.fold(0.0, |most: f64, value| most.max(value.abs()));
        let length = [
            pressure / tangent,
            largest(&mut parts.gap_m.iter().copied()),
            largest(&mut parts.response.gap_per_load.iter().map(|a| a * force)),
            largest(&mut (0..c).map(own)) * force / c as f64,
        ]
        .into_iter()
        .fold(0.0, f64::max);
        let flexibility = (0..c).map(|k| own(k) + 1.0 / stiffness[k]).collect();
        Self { length, force, stiffness, flexibility }
    }
}

/// `a b`, on the calling thread only.
fn product(a: &Mat<f64>, b: &Mat<f64>) -> Mat<f64> {
    let mut out = Mat::zeros(a.nrows(), b.ncols());
    matmul(&mut out, Accum::Replace, a, b, 1.0, Par::Seq);
    out
}

/// `Σ_j G_kj N_j` and `Σ_j |G_kj N_j|` over the pairs `loaded`, `c` each.
fn sums(flexibility: &Mat<f64>, forces: &[f64], loaded: &[usize]) -> [Vec<f64>; 2] {
    let mut sums = [vec![0.0; forces.len()], vec![0.0; forces.len()]];
    let [values, sizes] = &mut sums;
    let column = |pair: usize| (forces[pair], flexibility.col_as_slice(pair));
    // Uses the widest vector registers available, which does not change the result.
    pulp::Arch::new().dispatch(
        #[inline(always)]
        || {
            let mut pairs = loaded.chunks_exact(2);
            for two in &mut pairs {
                let [(n, a), (m, b)] = [column(two[0]), column(two[1])];
                for (((value, size), a), b) in values.iter_mut().zip(sizes.iter_mut()).zip(a).zip(b) {
                    let (a, b) = (n * a, m * b);
                    *value = *value + a + b;
                    *size = *size + a.abs() + b.abs();
                }
            }
            for &pair in pairs.remainder() {
                let (n, a) = column(pair);
                for ((value, size), a) in values.iter_mut().zip(sizes.iter_mut()).zip(a) {
                    *value += n * a;
                    *size += (n * a).abs();
                }
            }
        },
    );
    sums
}

impl<'a> Equations<'a> {
    fn new(statics: &'a Statics, load: f64, x: f64, support: f64, scales: &'a Scales) -> Self {
        Self::within(Mat::new(), statics, load, x, support, scales)
    }

    /// The equations, with the matrix of flexibilities in the array `flexibility`.
    fn within(
        mut flexibility: Mat<f64>,
        statics: &'a Statics,
        load: f64,
        x: f64,
        support: f64,
        scales: &'a Scales,
    ) -> Self {
        let parts = &statics.parts;
        let (normal, sliding) = (&parts.response.normal_flexibility, &parts.response.sliding_flexibility);
        if flexibility.shape() != normal.shape() {
            flexibility = Mat::zeros(normal.nrows(), normal.ncols());
        }
        faer::zip!(&mut flexibility, normal, sliding).for_each(|faer::unzip!(out, nn, nt)| *out = nn + x * nt);
        let pushed = &parts.response.rigid.normal + faer::Scale(x) * &parts.response.rigid.sliding;
        Self { statics, load, x, flexibility, pushed, support, scales }
    }

    fn rigid(&self) -> usize {
        self.pushed.ncols()
    }

    fn back_force(&self, point: &Point) -> f64 {
        match self.statics.parts.measured {
            MeasuredLoad::Back => self.load,
            MeasuredLoad::Contact => point.others[self.rigid()],
        }
    }

    /// Whether the force on the back presses the pad on the disc; without a load, any force is accepted.
    fn pushes(&self, point: &Point) -> bool {
        self.load <= 0.0 || self.back_force(point) > 0.0
    }

    /// Factor of the equations of balance, which makes them lengths.
    fn weight(&self) -> f64 {
        self.scales.length / self.scales.force
    }

    /// Law of `pair` at `closure`, with the additional spring.
    fn law_at(&self, pair: usize, closure: f64) -> LawValue {
        let mut value = self.statics.law_at(pair, closure);
        if self.support > 0.0 {
            let stiffness = self.support * self.scales.stiffness[pair];
            value.pressure += stiffness * closure;
            value.tangent += stiffness;
        }
        value
    }

    fn evaluate(&self, point: Point) -> Evaluated {
        let parts = &self.statics.parts;
        let c = self.statics.pairs();
        let law: Vec<LawValue> = (0..c).map(|k| self.law_at(k, point.closure[k])).collect();
        let forces: Vec<f64> = law.iter().map(|value| value.pressure).collect();
        let loaded: Vec<usize> = (0..c).filter(|&k| forces[k] != 0.0).collect();
        let closed: Vec<usize> = (0..c).filter(|&k| law[k].tangent != 0.0).collect();
        let [moved, size] = sums(&self.flexibility, &forces, &loaded);
        let back = self.back_force(&point);
        let mut residual = Vec::with_capacity(c + point.others.len());
        let mut largest = 0.0f64;
        for k in 0..c {
            let terms = [point.closure[k], parts.gap_m[k], back * parts.response.gap_per_load[k]];
            let (mut sum, mut most) = (terms.iter().sum::<f64>(), terms.iter().map(|term| term.abs()).sum::<f64>());
            for j in 0..self.rigid() {
                let term = parts.response.rigid.normal[(k, j)] * point.others[j];
                sum += term;
                most += term.abs();
            }
            residual.push(sum + moved[k]);
            largest = largest.max(most + size[k]);
        }
        let worst = residual.iter().fold(0.0f64, |worst, value| worst.max(value.abs()));
        let mut accuracy = if largest > 0.0 { worst / largest } else { 0.0 };
        if residual.iter().any(|value| !value.is_finite()) {
            accuracy = f64::INFINITY;
        }
        let mut balance = |sum: f64, most: f64| {
            residual.push(self.weight() * sum);
            let share = if most > 0.0 { sum.abs() / most } else { 0.0 };
            accuracy = if share.is_finite() { accuracy.max(share) } else { f64::INFINITY };
        };
        for j in 0..self.rigid() {
            let load = back * parts.response.rigid.load[j];
            let (mut sum, mut most) = (load, load.abs());
            for &k in &loaded {
                let term = self.pushed[(k, j)] * forces[k];
                sum += term;
                most += term.abs();
            }
            balance(sum, most);
        }
        if parts.measured == MeasuredLoad::Contact {
            let total: f64 = forces.iter().sum();
            balance(total - self.load, forces.iter().map(|force| force.abs()).sum::<f64>() + self.load.abs());
        }
        let norm = residual.iter().map(|value| value * value).sum::<f64>().sqrt();
        Evaluated { point, law, closed, residual, norm, accuracy }
    }

    /// The Jacobian over the closed pairs and the other unknowns:
    ///
    /// ```text
    /// I + G_cc k_c     B_n Φ_r    a
    /// w (B Φ_r)ᵀ k_c   0          w p_r
    /// w 1ᵀ k_c         0          0
    /// ```
    fn jacobian(&self, at: &Evaluated, mut arrays: Jacobian) -> Jacobian {
        let size = at.closed.len() + at.point.others.len();
        arrays.factors.factorise(size, |matrix| self.fill(at, matrix));
        arrays.sign = arrays.factors.sign();
        arrays.closed.clone_from(&at.closed);
        arrays.tangent.clear();
        arrays.tangent.extend(at.law.iter().map(|value| value.tangent));
        arrays
    }

    /// Writes the Jacobian.
    fn fill(&self, at: &Evaluated, mut matrix: MatMut<'_, f64>) {
        let parts = &self.statics.parts;
        let (closed, others, rigid) = (&at.closed, at.point.others.len(), self.rigid());
        let m = closed.len();
        let weight = self.weight();
        matrix.as_mut().get_mut(.., m..).fill(0.0);
        for (column, &j) in closed.iter().enumerate() {
            let tangent = at.law[j].tangent;
            let of_pair = self.flexibility.col(j);
            let out = matrix.as_mut().col_mut(column);
            for (row, entry) in out.iter_mut().enumerate() {
                *entry = match closed.get(row) {
                    Some(&k) => of_pair[k] * tangent,
                    None if row - m < rigid => weight * self.pushed[(j, row - m)] * tangent,
                    None => weight * tangent,
                };
            }
            matrix[(column, column)] += 1.0;
        }
        for other in 0..others {
            for (row, &k) in closed.iter().enumerate() {
                matrix[(row, m + other)] = self.per_other(k, other);
            }
            if other == rigid {
                for (j, load) in parts.response.rigid.load.iter().enumerate() {
                    matrix[(m + j, m + other)] = weight * load;
                }
            }
        }
    }

    /// The Jacobian at `at`, over all pairs, times several vectors.
    fn times(&self, at: &Evaluated, vectors: &Mat<f64>) -> Mat<f64> {
        let parts = &self.statics.parts;
        let (c, rigid, weight) = (self.statics.pairs(), self.rigid(), self.weight());
        let mut forces = Mat::zeros(c, vectors.ncols());
        for column in 0..vectors.ncols() {
            for &k in &at.closed {
                forces[(k, column)] = at.law[k].tangent * vectors[(k, column)];
            }
        }
        let moved = product(&self.flexibility, &forces);
        let mut out = Mat::zeros(vectors.nrows(), vectors.ncols());
        for column in 0..vectors.ncols() {
            for k in 0..c {
                out[(k, column)] = vectors[(k, column)] + moved[(k, column)];
            }
            for other in 0..vectors.nrows() - c {
                let value = vectors[(c + other, column)];
                for k in 0..c {
                    out[(k, column)] += value * self.per_other(k, other);
                }
                let along = |k: usize| if other < rigid { self.pushed[(k, other)] } else { 1.0 };
                let mut balance = at.closed.iter().map(|&k| along(k) * forces[(k, column)]).sum::<f64>();
                if other < rigid && vectors.nrows() > c + rigid {
                    balance += parts.response.rigid.load[other] * vectors[(c + rigid, column)];
                }
                out[(c + other, column)] = weight * balance;
            }
        }
        out
    }

    /// Derivative of the gap of a pair with respect to an unknown beside the closures.
    fn per_other(&self, pair: usize, other: usize) -> f64 {
        let response = &self.statics.parts.response;
        if other < self.rigid() { response.rigid.normal[(pair, other)] } else { response.gap_per_load[pair] }
    }

    /// Solves `J d = right` for several right-hand sides, `(c + others)×n`, in place.
    fn solve(&self, jacobian: &Jacobian, right: &mut Mat<f64>) {
        let (c, m) = (self.statics.pairs(), jacobian.closed.len());
        let others = right.nrows() - c;
        let mut reduced = Mat::from_fn(m + others, right.ncols(), |row, column| match jacobian.closed.get(row) {
            Some(&k) => right[(k, column)],
            None => right[(c + row - m, column)],
        });
        jacobian.factors.solve(reduced.as_mut());
        let open: Vec<usize> = (0..c).filter(|&k| jacobian.tangent[k] == 0.0).collect();
        let moved = if open.is_empty() {
            Mat::new()
        } else {
            let mut increments = Mat::zeros(c, right.ncols());
            for column in 0..right.ncols() {
                for (row, &k) in jacobian.closed.iter().enumerate() {
                    increments[(k, column)] = jacobian.tangent[k] * reduced[(row, column)];
                }
            }
            product(&self.flexibility, &increments)
        };
        for column in 0..right.ncols() {
            for &k in &open {
                // The closure of an open pair follows from the other unknowns.
                let mut value = right[(k, column)] - moved[(k, column)];
                for other in 0..others {
                    value -= self.per_other(k, other) * reduced[(m + other, column)];
                }
                right[(k, column)] = value;
            }
            for (row, &k) in jacobian.closed.iter().enumerate() {
                right[(k, column)] = reduced[(row, column)];
            }
            for other in 0..others {
                right[(c + other, column)] = reduced[(m + other, column)];
            }
        }
    }

    /// Newton's direction.
    fn direction(&self, at: &Evaluated, jacobian: &Jacobian) -> Vec<f64> {
        let mut right = Mat::from_fn(at.residual.len(), 1, |row, _| -at.residual[row]);
        self.solve(jacobian, &mut right);
        right.col(0).iter().copied().collect()
    }

    /// The point a step of length `t` along `direction` leads to.
    fn step(&self, at: &Evaluated, direction: &[f64], t: f64, polish: bool) -> Point {
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
    fn newton(&self, start: Point, full: bool) -> Result<(Evaluated, Jacobian), f64> {
        self.newton_from(self.evaluate(start), full, None)
    }

    /// The same from where the equations are evaluated already. With `arrays`, which take the Jacobian, it is kept from step
    /// to step while these are fast.
    fn newton_from(
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

    /// First-order prediction from `state`, `along` steps of load and friction coefficient.
    fn predicted(&self, state: &SteadyState, [load, friction]: [f64; 2]) -> Point {
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
    fn is_near(
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

    /// The negative derivatives of the equations with respect to the load, `s μ` and `ln κ`, `(c + others)×3`.
    fn parameters(&self, at: &Evaluated) -> Mat<f64> {
        let parts = &self.statics.parts;
        let (c, rigid, weight) = (self.statics.pairs(), self.rigid(), self.weight());
        let forces = Mat::from_fn(c, 1, |k, _| at.law[k].pressure);
        let [by_friction, by_stiffness] =
            [&parts.response.sliding_flexibility, &self.flexibility].map(|flexibility| product(flexibility, &forces));
        let back = parts.measured == MeasuredLoad::Back;
        let work = |rows: &Mat<f64>, j: usize| (0..c).map(|k| rows[(k, j)] * forces[(k, 0)]).sum::<f64>();
        Mat::from_fn(at.residual.len(), 3, |row, parameter| {
            let of_pair = row < c;
            let of_motion = (!of_pair && row - c < rigid).then(|| row - c);
            match (parameter, of_motion) {
                (0, _) if of_pair => -if back { parts.response.gap_per_load[row] } else { 0.0 },
                (0, Some(j)) => -weight * if back { parts.response.rigid.load[j] } else { 0.0 },
                (0, None) => weight,
                (1, _) if of_pair => -by_friction[(row, 0)],
                (1, Some(j)) => -weight * work(&parts.response.rigid.sliding, j),
                (1, None) => 0.0,
                (_, _) if of_pair => -by_stiffness[(row, 0)],
                (_, Some(j)) => -weight * work(&self.pushed, j),
                (_, None) => -weight * at.law.iter().map(|value| value.pressure).sum::<f64>(),
            }
        })
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

    fn state(&self, at: &Evaluated, jacobian: &Jacobian) -> SteadyState {
        let mut slopes = self.parameters(at);
        self.solve(jacobian, &mut slopes);
        self.state_with(at, &slopes)
    }

    fn state_with(&self, at: &Evaluated, slopes: &Mat<f64>) -> SteadyState {
        let c = self.statics.pairs();
        let slope = |parameter: usize| {
            let direct = if parameter == 2 { 1.0 } else { 0.0 };
            let closure: Vec<f64> = (0..c).map(|k| slopes[(k, parameter)]).collect();
            let along = |k: usize, value: f64, rate: f64| {
                direct * value + if closure[k] == 0.0 { 0.0 } else { rate * closure[k] }
            };
            StateSlope {
                force: (0..c).map(|k| along(k, at.law[k].pressure, at.law[k].tangent)).collect(),
                tangent: (0..c).map(|k| along(k, at.law[k].tangent, at.law[k].curvature)).collect(),
                rigid: (0..self.rigid()).map(|j| slopes[(c + j, parameter)]).collect(),
                back_force: match (self.statics.parts.measured, parameter) {
                    (MeasuredLoad::Contact, _) => slopes[(c + self.rigid(), parameter)],
                    (MeasuredLoad::Back, 0) => 1.0,
                    (MeasuredLoad::Back, _) => 0.0,
                },
                closure,
            }
        };
        SteadyState {
            load_n: self.load,
            friction: self.x,
            back_force_n: self.back_force(&at.point),
            closure_m: at.point.closure.clone(),
            force_n: at.law.iter().map(|value| value.pressure).collect(),
            tangent_n_per_m: at.law.iter().map(|value| value.tangent).collect(),
            curvature_n_per_m2: at.law.iter().map(|value| value.curvature).collect(),
            rigid: at.point.others[..self.rigid()].to_vec(),
            residual: at.accuracy,
            per_load: slope(0),
            per_friction: slope(1),
            per_stiffness: slope(2),
        }
    }

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
}

/// The state at `load` and `s_mu`, continued from `s_mu = 0`.
pub(super) fn follow(statics: &Statics, load: f64, s_mu: f64) -> Result<SteadyState, StaticsError> {
    let scales = Scales::new(statics, load);
    let mut path = Path::at_rest(statics, load, &scales)?;
    path.advance(s_mu)?;
    Ok(path.state)
}

/// A path of states at one load, from the one without friction on.
struct Path<'a> {
    statics: &'a Statics,
    scales: &'a Scales,
    /// The last state, and the sign of the determinant on the path.
    state: SteadyState,
    sign: i8,
}

impl<'a> Path<'a> {
    fn at_rest(statics: &'a Statics, load: f64, scales: &'a Scales) -> Result<Self, StaticsError> {
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
    fn advance(&mut self, s_mu: f64) -> Result<(), StaticsError> {
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

/// A known state, at which the solution of nearby states starts.
#[derive(Clone, Debug)]
pub(super) struct Anchor {
    state: SteadyState,
    jacobian: Jacobian,
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

//! The equations of steady sliding at one load and friction coefficient: residuals, Jacobian, and derivatives of a solution.

use faer::{Mat, MatMut};

use super::factors::Factors;
use super::law::LawValue;
use super::statics::{MeasuredLoad, StateSlope, Statics, SteadyState};
use crate::product::product;

/// Unknowns: closures, then rigid motions, then the force on the back if it is not measured.
#[derive(Clone, Debug)]
pub(super) struct Point {
    pub(super) closure: Vec<f64>,
    pub(super) others: Vec<f64>,
}

/// The equations at one load and friction coefficient.
pub(super) struct Equations<'a> {
    pub(super) statics: &'a Statics,
    pub(super) load: f64,
    pub(super) x: f64,
    /// `G_nn + x G_nt`.
    pub(super) flexibility: Mat<f64>,
    /// `B_n Φ_r + x B_t Φ_r`, `c×r`.
    pub(super) pushed: Mat<f64>,
    /// Stiffness of additional bilateral springs per pair.
    pub(super) support: f64,
    pub(super) scales: &'a Scales,
}

/// Typical sizes at a load.
pub(super) struct Scales {
    /// m.
    pub(super) length: f64,
    /// N.
    pub(super) force: f64,
    /// Tangent stiffness of each pair at the mean pressure.
    pub(super) stiffness: Vec<f64>,
    /// `f`, m/N.
    pub(super) flexibility: Vec<f64>,
}

/// The equations evaluated at a point.
pub(super) struct Evaluated {
    pub(super) point: Point,
    pub(super) law: Vec<LawValue>,
    /// Pairs with a tangent stiffness.
    pub(super) closed: Vec<usize>,
    /// Residual, m: of the pairs, then of the other equations times `length / force`.
    pub(super) residual: Vec<f64>,
    /// Norm of the residual.
    pub(super) norm: f64,
    /// Largest residual relative to the largest term of its kind of equation.
    pub(super) accuracy: f64,
}

/// Factorised Jacobian over closed pairs and other unknowns.
#[derive(Clone, Debug, Default)]
pub(super) struct Jacobian {
    pub(super) factors: Factors,
    /// Pairs with a tangent stiffness, and the tangent stiffness of every pair.
    pub(super) closed: Vec<usize>,
    pub(super) tangent: Vec<f64>,
    /// Sign of the determinant; 0 where the matrix is singular to working precision.
    pub(super) sign: i8,
}

impl Scales {
    pub(super) fn new(statics: &Statics, load: f64) -> Self {
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
    pub(super) fn new(statics: &'a Statics, load: f64, x: f64, support: f64, scales: &'a Scales) -> Self {
        Self::within(Mat::new(), statics, load, x, support, scales)
    }

    /// The equations, with the matrix of flexibilities in the array `flexibility`.
    pub(super) fn within(
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

    pub(super) fn rigid(&self) -> usize {
        self.pushed.ncols()
    }

    pub(super) fn back_force(&self, point: &Point) -> f64 {
        match self.statics.parts.measured {
            MeasuredLoad::Back => self.load,
            MeasuredLoad::Contact => point.others[self.rigid()],
        }
    }

    /// Whether the force on the back presses the pad on the disc; without a load, any force is accepted.
    pub(super) fn pushes(&self, point: &Point) -> bool {
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

    pub(super) fn evaluate(&self, point: Point) -> Evaluated {
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
    pub(super) fn jacobian(&self, at: &Evaluated, mut arrays: Jacobian) -> Jacobian {
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
    pub(super) fn times(&self, at: &Evaluated, vectors: &Mat<f64>) -> Mat<f64> {
        let parts = &self.statics.parts;
        let (c, rigid, weight) = (self.statics.pairs(), self.rigid(), self.weight());
        let mut forces = Mat::zeros(c, vectors.ncols());
        for column in 0..vectors.ncols() {
            for &k in &at.closed {
                forces[(k, column)] = at.law[k].tangent * vectors[(k, column)];
            }
        }
        let moved = product(self.flexibility.as_ref(), forces.as_ref());
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
    pub(super) fn solve(&self, jacobian: &Jacobian, right: &mut Mat<f64>) {
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
            product(self.flexibility.as_ref(), increments.as_ref())
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

    /// The negative derivatives of the equations with respect to the load, `s μ` and `ln κ`, `(c + others)×3`.
    pub(super) fn parameters(&self, at: &Evaluated) -> Mat<f64> {
        let parts = &self.statics.parts;
        let (c, rigid, weight) = (self.statics.pairs(), self.rigid(), self.weight());
        let forces = Mat::from_fn(c, 1, |k, _| at.law[k].pressure);
        let [by_friction, by_stiffness] = [&parts.response.sliding_flexibility, &self.flexibility]
            .map(|flexibility| product(flexibility.as_ref(), forces.as_ref()));
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

    pub(super) fn state(&self, at: &Evaluated, jacobian: &Jacobian) -> SteadyState {
        let mut slopes = self.parameters(at);
        self.solve(jacobian, &mut slopes);
        self.state_with(at, &slopes)
    }

    pub(super) fn state_with(&self, at: &Evaluated, slopes: &Mat<f64>) -> SteadyState {
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
}

//! Contact that vibrates about a state of steady sliding.
//!
//! The statics of steady sliding ([`Statics`]) give the normal force `N_k` of each pair and its tangent stiffness
//! `k_k = dN_k/dδ_k`, which is 0 where the pair is open. With `x = s μ`, `F = B_n + x B_t`, `D = diag(k)` and the
//! residual flexibility `R = R_nn + x R_nt`:
//!
//! ```text
//! K(p) = K_0 + Fᵀ X,      X = A D B_n,  A = (I + D R)⁻¹
//! C(p) = C_0 + Fᵀ Y + μ'(v) B_tᵀ diag(N) B_t + μ B_bᵀ diag(N / v) B_b
//!                         Y = A C_c W,  W = (I + R D)⁻¹ B_n = B_n - R X
//! ```
//!
//! An open pair has `k = 0`: its row and column of `A D` are zero, so only closed pairs act. The damping coefficient
//! of a pair is proportional to its tangent stiffness, `C_c = diag(k c_ref / k_ref)`: a damper
//! vanishes with the spring of its pair, and the ratio of both is a property of the material.
//!
//! Derivatives follow from those of `N`, `k` and `x`:
//!
//! ```text
//! X' = A (D' W - D R' X)      W' = -(I + R D)⁻¹ (R' D + R D') W
//! Y' = A (C_c' W + C_c W' - (D' R + D R') Y)
//! ```

use std::sync::Arc;

use faer::linalg::solvers::{PartialPivLu, Solve};
use faer::{Mat, c64};

use super::flexible_contact::ResidualFlexibility;
use super::law::{ContactLaw, Parameter};
use super::model::{ContactPairs, Model};
use super::model_error::ModelError;
use super::operating_point::{ContactState, OperatingPoint};
use super::spectrum::Spectrum;
use super::stribeck::Stribeck;
use crate::contact::{Smoothness, Statics, SteadyState};
use crate::product::product;

/// The contact of a model whose springs follow the state of steady sliding.
#[derive(Clone, Debug)]
pub(super) struct SteadyContact {
    statics: Arc<Statics>,
    /// `B_n`, `B_t`, `B_b`, all `c×n`.
    normal: Mat<f64>,
    sliding: Mat<f64>,
    lateral: Mat<f64>,
    /// `c_ref / k_ref` of each pair, s.
    relaxation_s: Vec<f64>,
    /// `1 / r` of each pair, 1/m; empty without lateral damping.
    inverse_radius: Vec<f64>,
    /// `dμ/dv` at every speed, s/m.
    slope_s_per_m: f64,
    /// Friction that falls with the sliding speed, and the radius of each pair, m.
    falling: Option<(Stribeck, Vec<f64>)>,
    /// `R_nn` and `R_nt`.
    residual: Option<[Mat<f64>; 2]>,
}

/// An operating point, with the contact state there if the model has one.
#[derive(Clone, Debug)]
pub struct Situation {
    pub(super) point: OperatingPoint,
    /// `None` for a model without a contact state, and where the contact carries no load.
    pub(super) state: Option<Arc<SteadyState>>,
}

impl Situation {
    /// The situation at `p` of a model with contact pairs; its springs follow the states of `statics` if there are any, and
    /// are always closed otherwise.
    ///
    /// # Errors
    /// [`ModelError::State`] if there is no state of steady sliding.
    pub(crate) fn of_contact(p: &OperatingPoint, statics: Option<&Statics>) -> Result<Self, ModelError> {
        let statics = statics.filter(|_| p.contact_state() != ContactState::Open);
        let state = statics.map(|statics| statics.state(p.normal_load_n, signed_friction(p)).map(Arc::new)).transpose();
        Ok(Self { point: *p, state: state.map_err(ModelError::State)? })
    }

    /// The operating point.
    pub fn point(&self) -> &OperatingPoint {
        &self.point
    }

    /// The state of steady sliding; `None` for a model without one, and where the contact carries no load.
    pub fn state(&self) -> Option<&Arc<SteadyState>> {
        self.state.as_ref()
    }
}

impl Model {
    /// Adds a contact whose springs follow the state of steady sliding given by `statics`, with the residual
    /// flexibility of truncated modes if there is one. `pairs` are those of the statics, in the same order.
    ///
    /// # Errors
    /// [`ModelError::Shape`], [`ModelError::NotFinite`], [`ModelError::PairCount`], [`ModelError::Radius`];
    /// [`ModelError::StateDamping`] for a damped pair without stiffness; [`ModelError::StateInertia`] for residual
    /// inertia; [`ModelError::StateLoadExponent`].
    pub fn with_steady_contact(
        mut self,
        pairs: &ContactPairs,
        statics: Arc<Statics>,
        residual: Option<&ResidualFlexibility>,
    ) -> Result<Self, ModelError> {
        self.check_pairs(pairs)?;
        let count = pairs.normal.nrows();
        if statics.pairs() != count {
            return Err(ModelError::PairCount { what: "statics", found: statics.pairs(), expected: count });
        }
        let ContactLaw { exponent: _, reference_n: _, slope_s_per_m, stribeck, lateral_damping } = self.contact_law;
        let relaxation_s = relaxation_s(&self.contact_law, &pairs.stiffness_n_per_m, &pairs.damping_n_s_per_m)?;
        for (what, rows) in [("normal", &pairs.normal), ("sliding", &pairs.sliding), ("lateral", &pairs.lateral)] {
            finite(&format!("contact rows `{what}`"), rows)?;
        }
        let inverse_radius = if lateral_damping { pairs.inverse_radius()? } else { vec![] };
        let falling = match stribeck {
            Some(stribeck) => {
                pairs.check_radius()?;
                Some((stribeck, pairs.radius_m.clone()))
            }
            None => None,
        };
        let residual = match residual {
            None => None,
            Some(ResidualFlexibility { inertia: Some(_), .. }) => return Err(ModelError::StateInertia),
            Some(ResidualFlexibility { normal, sliding, inertia: None }) => {
                for matrix in [normal, sliding] {
                    let (rows, columns) = matrix.shape();
                    if (rows, columns) != (count, count) {
                        let what = "residual flexibility".to_owned();
                        return Err(ModelError::Shape { what, rows, columns, expected: count });
                    }
                    finite("residual flexibility", matrix)?;
                }
                Some([normal.clone(), sliding.clone()])
            }
        };
        let [normal, sliding, lateral] = [&pairs.normal, &pairs.sliding, &pairs.lateral].map(Mat::clone);
        let contact = SteadyContact {
            statics,
            normal,
            sliding,
            lateral,
            relaxation_s,
            inverse_radius,
            slope_s_per_m,
            falling,
            residual,
        };
        self.steady = Some(Box::new(contact));
        self.has_contact = true;
        Ok(self.finished())
    }

    /// The statics of steady sliding, if the contact springs follow its state.
    pub fn statics(&self) -> Option<&Arc<Statics>> {
        self.steady.as_ref().map(|contact| &contact.statics)
    }

    /// The contact state at `p`, from which the matrices there follow.
    ///
    /// # Errors
    /// [`ModelError::PointNotFinite`]; [`ModelError::State`] if there is no state of steady sliding.
    pub fn at(&self, p: &OperatingPoint) -> Result<Situation, ModelError> {
        if !p.is_finite() {
            return Err(ModelError::PointNotFinite {
                normal_load_n: p.normal_load_n,
                disc_speed_rad_s: p.disc_speed_rad_s,
                friction_coefficient: p.friction_coefficient,
            });
        }
        Situation::of_contact(p, self.steady.as_ref().map(|contact| &*contact.statics))
    }
}

/// `c_ref / k_ref` of each pair, s: the damping coefficient of a pair is this times its tangent stiffness.
///
/// # Errors
/// [`ModelError::StateLoadExponent`]; [`ModelError::StateDamping`] for a damped pair without stiffness.
pub(crate) fn relaxation_s(
    law: &ContactLaw,
    stiffness_n_per_m: &[f64],
    damping_n_s_per_m: &[f64],
) -> Result<Vec<f64>, ModelError> {
    if law.exponent != 0.0 {
        return Err(ModelError::StateLoadExponent { exponent: law.exponent });
    }
    let of_pair = |(pair, (&stiffness, &damping)): (usize, (&f64, &f64))| {
        let relaxation_s = if damping == 0.0 { 0.0 } else { damping / stiffness };
        let valid = relaxation_s.is_finite();
        valid.then_some(relaxation_s).ok_or(ModelError::StateDamping { pair, stiffness, damping })
    };
    stiffness_n_per_m.iter().zip(damping_n_s_per_m).enumerate().map(of_pair).collect()
}

/// `s μ` where the contact slides, else 0.
pub(super) fn signed_friction(p: &OperatingPoint) -> f64 {
    match p.contact_state() {
        ContactState::Sliding => p.disc_speed_rad_s.signum() * p.friction_coefficient,
        ContactState::NotSliding | ContactState::Open => 0.0,
    }
}

fn finite(what: &str, matrix: &Mat<f64>) -> Result<(), ModelError> {
    for column in 0..matrix.ncols() {
        for row in 0..matrix.nrows() {
            let value = matrix[(row, column)];
            if !value.is_finite() {
                return Err(ModelError::NotFinite { what: what.to_owned(), row, column, value });
            }
        }
    }
    Ok(())
}

/// Residual flexibility at one operating point.
struct Flexible<'a> {
    /// `R_nt`.
    sliding: &'a Mat<f64>,
    /// `R`.
    flexibility: Mat<f64>,
    /// Factors of `I + D R`.
    factors: PartialPivLu<f64>,
}

impl Flexible<'_> {
    /// `A m`.
    fn solve(&self, m: &Mat<f64>) -> Mat<f64> {
        self.factors.solve(m)
    }
}

/// Quantities that the contact terms and their derivatives share.
pub(super) struct Response<'a> {
    contact: &'a SteadyContact,
    state: &'a SteadyState,
    stiffness: &'a [f64],
    x: f64,
    /// `F`, `c×n`.
    forces: Mat<f64>,
    /// `X`, `c×n`.
    springs: Mat<f64>,
    /// `W`, `c×n`; `None` without residual flexibility, where it is `B_n`.
    seen: Option<Mat<f64>>,
    flexible: Option<Flexible<'a>>,
}

impl SteadyContact {
    /// The contact restricted to the coordinates `places`. The statics are not restricted.
    pub(super) fn part(&self, places: &[usize]) -> Self {
        let columns = |m: &Mat<f64>| Mat::from_fn(m.nrows(), places.len(), |i, j| m[(i, places[j])]);
        Self {
            normal: columns(&self.normal),
            sliding: columns(&self.sliding),
            lateral: columns(&self.lateral),
            ..self.clone()
        }
    }

    /// Whether coordinate `k` moves no contact pair.
    pub(super) fn is_free_of(&self, k: usize) -> bool {
        [&self.normal, &self.sliding, &self.lateral].iter().all(|rows| (0..rows.nrows()).all(|i| rows[(i, k)] == 0.0))
    }

    /// Whether dampers or friction damp any pair at `p`.
    pub(super) fn is_damped(&self, p: &OperatingPoint) -> bool {
        let (closed, sliding) = match p.contact_state() {
            ContactState::Open => (false, false),
            ContactState::NotSliding => (true, false),
            ContactState::Sliding => (true, true),
        };
        closed && self.relaxation_s.iter().any(|&s| s != 0.0)
            || sliding && (self.slope_s_per_m != 0.0 || self.falling.is_some())
            || sliding && !self.inverse_radius.is_empty() && p.friction_coefficient != 0.0
    }

    /// Whether damping depends on the disc speed.
    pub(super) fn depends_on_speed(&self) -> bool {
        !self.inverse_radius.is_empty() || self.falling.is_some()
    }

    /// Whether any pair has a damper.
    fn has_dampers(&self) -> bool {
        self.relaxation_s.iter().any(|&s| s != 0.0)
    }

    /// Quantities from which the contact terms at `p` and their derivatives follow.
    pub(super) fn response<'a>(&'a self, p: &OperatingPoint, state: &'a SteadyState) -> Response<'a> {
        let x = signed_friction(p);
        let stiffness = &state.tangent_n_per_m;
        let c = stiffness.len();
        let forces = if x == 0.0 { self.normal.clone() } else { &self.normal + faer::Scale(x) * &self.sliding };
        let scaled = by_row(stiffness, &self.normal);
        let Some([normal, sliding]) = &self.residual else {
            return Response {
                contact: self,
                state,
                stiffness,
                x,
                forces,
                springs: scaled,
                seen: None,
                flexible: None,
            };
        };
        let flexibility = if x == 0.0 { normal.clone() } else { normal + faer::Scale(x) * sliding };
        let coupled = Mat::from_fn(c, c, |i, j| stiffness[i] * flexibility[(i, j)] + f64::from(u8::from(i == j)));
        let flexible = Flexible { sliding, factors: coupled.partial_piv_lu(), flexibility };
        let springs = flexible.solve(&scaled);
        let seen = &self.normal - product(flexible.flexibility.as_ref(), springs.as_ref());
        let (seen, flexible) = (Some(seen), Some(flexible));
        Response { contact: self, state, stiffness, x, forces, springs, seen, flexible }
    }

    /// Adds the contact terms at `p` to `K` and `C`.
    pub(super) fn add(&self, p: &OperatingPoint, response: &Response<'_>, k: &mut Mat<f64>, c: &mut Mat<f64>) {
        let state = response.state;
        let symmetric = response.x == 0.0;
        add(k, &product(response.forces.transpose(), response.springs.as_ref()), symmetric);
        if self.has_dampers() {
            add(c, &product(response.forces.transpose(), response.dampers().as_ref()), symmetric);
        }
        self.add_friction_damping(p, &state.force_n, c);
        let across = lateral_factor(p);
        self.add_lateral_damping(across, &state.force_n, c);
    }

    /// Adds the derivatives of the contact terms at `p` to those of `K` and `C`.
    pub(super) fn add_derivative(
        &self,
        p: &OperatingPoint,
        response: &Response<'_>,
        parameter: Parameter,
        k: &mut Mat<f64>,
        c: &mut Mat<f64>,
    ) {
        let state = response.state;
        let sliding = p.contact_state() == ContactState::Sliding;
        let sign = p.disc_speed_rad_s.signum();
        let across = lateral_factor(p);
        let (dx, stiffness, force): (f64, Vec<f64>, Vec<f64>) = match parameter {
            Parameter::Friction if sliding => {
                let signed = |values: &[f64]| values.iter().map(|value| sign * value).collect();
                (sign, signed(&state.per_friction.tangent), signed(&state.per_friction.force))
            }
            Parameter::Load => (0.0, state.per_load.tangent.clone(), state.per_load.force.clone()),
            Parameter::ContactStiffness => {
                (0.0, state.per_stiffness.tangent.clone(), state.per_stiffness.force.clone())
            }
            Parameter::ContactDamping if self.has_dampers() => {
                let dampers = product(response.forces.transpose(), response.dampers().as_ref());
                return add(c, &dampers, response.x == 0.0);
            }
            Parameter::Speed if sliding => {
                self.add_speed_derivative(p, &state.force_n, c);
                return self.add_lateral_damping(-across / p.disc_speed_rad_s, &state.force_n, c);
            }
            Parameter::Friction | Parameter::Speed | Parameter::ContactDamping => return,
        };
        let slope = if response.flexible.is_some() {
            let springs = response.springs_slope(dx, &stiffness);
            let slope = product(response.forces.transpose(), springs.as_ref());
            if dx == 0.0 {
                slope
            } else {
                slope + faer::Scale(dx) * product(self.sliding.transpose(), response.springs.as_ref())
            }
        } else {
            // `(D' F + dx D B_t)ᵀ B_n`.
            let mut pushed = by_row(&stiffness, &response.forces);
            if dx != 0.0 {
                let turned: Vec<f64> = response.stiffness.iter().map(|k| dx * k).collect();
                pushed += by_row(&turned, &self.sliding);
            }
            product(pushed.transpose(), self.normal.as_ref())
        };
        let symmetric = response.x == 0.0 && dx == 0.0;
        add(k, &slope, symmetric);
        if self.has_dampers() {
            let dampers = response.dampers();
            let mut damping = response.damping(&stiffness);
            if parameter == Parameter::ContactStiffness {
                // The damping does not change, because `k_ref` changes in proportion to `k`.
                damping.iter_mut().zip(response.damping(response.stiffness)).for_each(|(slope, value)| *slope -= value);
            }
            let slopes = response.dampers_slope(dx, &stiffness, &damping, &dampers);
            let mut slope = product(response.forces.transpose(), slopes.as_ref());
            if dx != 0.0 {
                slope += faer::Scale(dx) * product(self.sliding.transpose(), dampers.as_ref());
            }
            add(c, &slope, symmetric);
        }
        self.add_friction_damping(p, &force, c);
        self.add_lateral_damping(across, &force, c);
        if parameter == Parameter::Friction {
            self.add_lateral_damping(lateral_factor(&p.with_friction(1.0)), &state.force_n, c);
        }
    }

    /// Adds `μ'(v) B_tᵀ diag(N) B_t`, if the contact slides.
    fn add_friction_damping(&self, p: &OperatingPoint, force_n: &[f64], c: &mut Mat<f64>) {
        if p.contact_state() != ContactState::Sliding {
            return;
        }
        let constant = self.slope_s_per_m;
        let slopes = match &self.falling {
            Some((stribeck, radius_m)) => {
                let speed = p.disc_speed_rad_s.abs();
                radius_m.iter().map(|radius| constant + stribeck.slope(speed * radius)).collect()
            }
            None if constant != 0.0 => vec![constant; force_n.len()],
            None => return,
        };
        self.add_along(&slopes, force_n, c);
    }

    /// Adds the derivative `B_tᵀ diag(N ∂μ'(v)/∂Ω) B_t` of that damping by the disc speed, of a contact that slides.
    fn add_speed_derivative(&self, p: &OperatingPoint, force_n: &[f64], c: &mut Mat<f64>) {
        let Some((stribeck, radius_m)) = &self.falling else { return };
        let (speed, sign) = (p.disc_speed_rad_s.abs(), p.disc_speed_rad_s.signum());
        let slopes: Vec<f64> =
            radius_m.iter().map(|radius| sign * radius * stribeck.slope_per_speed(speed * radius)).collect();
        self.add_along(&slopes, force_n, c);
    }

    /// Adds `B_tᵀ diag(s N) B_t` for the slopes `s`.
    fn add_along(&self, slopes: &[f64], force_n: &[f64], c: &mut Mat<f64>) {
        let weights: Vec<f64> = slopes.iter().zip(force_n).map(|(slope, force)| slope * force).collect();
        let rows = by_row(&weights, &self.sliding);
        add(c, &product(self.sliding.transpose(), rows.as_ref()), true);
    }

    /// Adds `factor · B_bᵀ diag(N / r) B_b`.
    fn add_lateral_damping(&self, factor: f64, force_n: &[f64], c: &mut Mat<f64>) {
        if factor != 0.0 && !self.inverse_radius.is_empty() {
            let weights: Vec<f64> = force_n.iter().zip(&self.inverse_radius).map(|(n, r)| factor * n * r).collect();
            let rows = by_row(&weights, &self.lateral);
            add(c, &product(self.lateral.transpose(), rows.as_ref()), true);
        }
    }
}

/// `μ / |ω|` where the contact slides, else 0.
fn lateral_factor(p: &OperatingPoint) -> f64 {
    match p.contact_state() {
        ContactState::Sliding => p.friction_coefficient / p.disc_speed_rad_s.abs(),
        ContactState::NotSliding | ContactState::Open => 0.0,
    }
}

impl Response<'_> {
    /// `W`.
    fn seen(&self) -> &Mat<f64> {
        self.seen.as_ref().unwrap_or(&self.contact.normal)
    }

    /// `C_c` for the tangent stiffnesses `stiffness`, or its derivative for theirs.
    fn damping(&self, stiffness: &[f64]) -> Vec<f64> {
        stiffness.iter().zip(&self.contact.relaxation_s).map(|(k, s)| k * s).collect()
    }

    /// `A m`; `m` without residual flexibility.
    fn relaxed(&self, m: Mat<f64>) -> Mat<f64> {
        match &self.flexible {
            Some(flexible) => flexible.solve(&m),
            None => m,
        }
    }

    /// `Y`.
    fn dampers(&self) -> Mat<f64> {
        self.relaxed(by_row(&self.damping(self.stiffness), self.seen()))
    }

    /// `X'` for the derivatives `dx` of `x` and `slope` of `k`.
    fn springs_slope(&self, dx: f64, slope: &[f64]) -> Mat<f64> {
        let mut change = by_row(slope, self.seen());
        if let Some(flexible) = self.flexible.as_ref().filter(|_| dx != 0.0) {
            let moved = product(flexible.sliding.as_ref(), self.springs.as_ref());
            change -= faer::Scale(dx) * by_row(self.stiffness, &moved);
        }
        self.relaxed(change)
    }

    /// `Y'` for the derivatives `dx` of `x`, `slope` of `k` and `damping` of `C_c`; `dampers` is `Y`.
    fn dampers_slope(&self, dx: f64, slope: &[f64], damping: &[f64], dampers: &Mat<f64>) -> Mat<f64> {
        let mut change = by_row(damping, self.seen());
        if let Some(flexible) = &self.flexible {
            let Flexible { sliding, flexibility, .. } = flexible;
            // `R' m` and `R m`.
            let turned = |m: &Mat<f64>| faer::Scale(dx) * product(sliding.as_ref(), m.as_ref());
            let bent = |m: &Mat<f64>| product(flexibility.as_ref(), m.as_ref());
            let pushed = turned(&by_row(self.stiffness, self.seen())) + bent(&by_row(slope, self.seen()));
            let relaxed = flexible.solve(&by_row(self.stiffness, &pushed));
            let seen_slope = bent(&relaxed) - pushed;
            change += by_row(&self.damping(self.stiffness), &seen_slope);
            change -= by_row(slope, &bent(dampers)) + by_row(self.stiffness, &turned(dampers));
        }
        self.relaxed(change)
    }
}

/// `diag(d) m`.
fn by_row(d: &[f64], m: &Mat<f64>) -> Mat<f64> {
    let mut out = m.clone();
    for j in 0..out.ncols() {
        out.col_as_slice_mut(j).iter_mut().zip(d).for_each(|(entry, d)| *entry *= d);
    }
    out
}

/// Adds `m` to `out`, its upper triangle mirrored if it is known to be symmetric: exactly, because the choice of the
/// solver depends on it.
fn add(out: &mut Mat<f64>, m: &Mat<f64>, symmetric: bool) {
    if !symmetric {
        *out += m;
        return;
    }
    for j in 0..out.ncols() {
        for i in 0..out.nrows() {
            out[(i, j)] += m[(i.min(j), i.max(j))];
        }
    }
}

/// How far roots may jump between two spectra of a map, because contact pairs open or close in between.
///
/// If pair `i` with stiffness `k_i` opens or closes, `K` changes by `F_iᵀ k_i B_n,i`. To first order this moves `λ²` by
/// `|yᴴ F_iᵀ| k_i |B_n,i x|`. The sum over all pairs that change bounds every jump in the interval, and also several jumps
/// that cancel.
#[derive(Clone, Debug, Default)]
pub(super) struct Jumps {
    pairs: usize,
    /// For each root of the left and of the right spectrum.
    reach: [Vec<f64>; 2],
}

impl Jumps {
    /// The jumps between `left` and `right`, both with left vectors. There are none if the law of the contact is
    /// analytic.
    pub fn between(model: &Model, left: &Spectrum, right: &Spectrum) -> Self {
        let (Some(contact), Some(from), Some(to)) = (&model.steady, &left.state, &right.state) else {
            return Self::default();
        };
        if contact.is_analytic() {
            return Self::default();
        }
        let changed: Vec<(usize, f64)> = changed_pairs(from, to)
            .map(|pair| (pair, from.tangent_n_per_m[pair].max(to.tangent_n_per_m[pair])))
            .collect();
        if changed.is_empty() {
            return Self::default();
        }
        Self { pairs: changed.len(), reach: [left, right].map(|spectrum| contact.reach(spectrum, &changed)) }
    }

    /// Number of pairs that open or close.
    pub fn pairs(&self) -> usize {
        self.pairs
    }

    /// Bound of the jumps of `λ²` of root `i` of the left spectrum, which root `j` of the right one continues.
    pub fn of(&self, i: usize, j: usize) -> f64 {
        let [left, right] = &self.reach;
        left.get(i).copied().unwrap_or(0.0).max(right.get(j).copied().unwrap_or(0.0))
    }
}

/// The pairs that are closed in one of two states and open in the other.
pub(super) fn changed_pairs<'a>(from: &'a SteadyState, to: &'a SteadyState) -> impl Iterator<Item = usize> + 'a {
    let closed = |state: &SteadyState, pair: usize| state.tangent_n_per_m[pair] > 0.0;
    (0..from.tangent_n_per_m.len()).filter(move |&pair| closed(from, pair) != closed(to, pair))
}

impl SteadyContact {
    /// Whether the state is an analytic function of load and friction coefficient.
    pub(super) fn is_analytic(&self) -> bool {
        self.statics.parts().law.smoothness() == Smoothness::Analytic
    }

    /// For each root, the sum of its changes of `λ²` over the `changed` pairs, each given with its stiffness.
    fn reach(&self, spectrum: &Spectrum, changed: &[(usize, f64)]) -> Vec<f64> {
        let x = signed_friction(&spectrum.point);
        let n = self.normal.ncols();
        let along = |row: &dyn Fn(usize) -> f64, vector: &dyn Fn(usize) -> c64| {
            (0..n).map(|k| vector(k) * row(k)).sum::<c64>().norm()
        };
        let of_root = |root: usize| {
            let lambda = spectrum.roots[root].lambda.norm();
            let to_square = if spectrum.undamped { 1.0 } else { 2.0 * lambda };
            let moved = changed.iter().map(|&(pair, stiffness)| {
                let normal = |k: usize| self.normal[(pair, k)];
                let force = |k: usize| self.normal[(pair, k)] + x * self.sliding[(pair, k)];
                let damped = 1.0 + lambda * self.relaxation_s[pair];
                let shares =
                    along(&force, &|k| spectrum.left[(k, root)]) * along(&normal, &|k| spectrum.shapes[(k, root)]);
                stiffness * damped * shares
            });
            to_square * moved.sum::<f64>()
        };
        (0..spectrum.left.ncols()).map(of_root).collect()
    }
}

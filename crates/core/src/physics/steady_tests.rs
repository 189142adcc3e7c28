//! Tests of vibration about a state of steady sliding, from the matrices to charts.

use std::sync::Arc;

use faer::Mat;

use super::chart::Chart;
use super::chart::Scratch;
use super::chart::build::{ChartOptions, build};
use super::chart::pairing::within_bounds;
use super::ends::{Bounded, Ends};
use super::flexible_contact::ResidualFlexibility;
use super::law::{ContactLaw, Law, Parameter};
use super::model::{ContactPairs, Model, Term};
use super::model_error::ModelError;
use super::operating_point::OperatingPoint;
use super::solver::Solver;
use super::spectrum::{SolveError, Vectors};
use super::stability_map::{MapOptions, StabilityMap};
use super::stribeck::Stribeck;
use super::traces::Traces;
use crate::contact::{
    FreeModes, MeasuredLoad, PressureLaw, PressureTable, StaticResponse, Statics, StaticsParts, TruncatedResponse,
};
use crate::proof::held_out::hold_out;
use crate::proof::identities::compare;
use crate::proof::synthetic::Uniform;

const MODES: usize = 8;
const PAIRS: usize = 6;
/// Springs that only push.
const LINEAR: PressureLaw = PressureLaw::Linear { stiffness: 0.3 };
/// Rough surfaces.
const ROUGH: PressureLaw = PressureLaw::Exponential { pressure: 20.0, roughness_m: 150.0 };

/// A random pad and disc before they are joined, with the statics of the contact.
struct Rig {
    free: Model,
    pairs: ContactPairs,
    omega: Vec<f64>,
    /// Generalised force of a load of 1 N.
    pressed: Vec<f64>,
    gaps_m: Vec<f64>,
    residual: ResidualFlexibility,
}

impl Rig {
    /// The rig of `seed`; gaps are random, up to `gap_m`.
    fn new(seed: u64, damping: f64, contact_law: ContactLaw, gap_m: f64) -> Self {
        let mut uniform = Uniform::new(seed);
        let omega: Vec<f64> = (0..MODES).map(|_| 1.0 + 4.0 * uniform.draw().abs()).collect();
        let mut rows = || Mat::from_fn(PAIRS, MODES, |_, _| uniform.draw());
        let [normal, sliding, lateral] = [rows(), rows(), rows()];
        let diagonal = |value: &dyn Fn(f64) -> f64| Term {
            matrix: Mat::from_fn(MODES, MODES, |i, j| if i == j { value(omega[i]) } else { 0.0 }),
            law: Law::Constant,
        };
        let structural = diagonal(&|omega| 2.0 * damping * omega);
        let free = Model::new(MODES, vec![diagonal(&|omega| omega * omega)], vec![structural], contact_law, Some(4));
        let pressed = (0..MODES).map(|k| -(0..PAIRS).map(|i| normal[(i, k)]).sum::<f64>()).collect();
        let flexible = Mat::from_fn(PAIRS, 3, |_, _| 0.3 * uniform.draw());
        let skewed = Mat::from_fn(PAIRS, 3, |_, _| 0.3 * uniform.draw());
        let residual = ResidualFlexibility {
            normal: &flexible * flexible.transpose(),
            sliding: &flexible * skewed.transpose(),
            inertia: None,
        };
        let pairs = ContactPairs {
            normal,
            sliding,
            lateral,
            stiffness_n_per_m: vec![0.3; PAIRS],
            damping_n_s_per_m: vec![0.06 * damping; PAIRS],
            // Far from the axis, so that lateral damping is small beside these soft springs.
            radius_m: (0..PAIRS).map(|_| 1e3 + 200.0 * uniform.draw()).collect(),
        };
        let gaps_m = (0..PAIRS).map(|_| gap_m * uniform.draw().abs()).collect();
        Self { free: free.expect("well formed"), pairs, omega, pressed, gaps_m, residual }
    }

    /// The statics with contact law `law`: `K_0 = diag(Ω²)`, and the residual flexibility if it is `flexible`.
    fn statics(&self, law: &PressureLaw, flexible: bool) -> Arc<Statics> {
        let omega_squared: Vec<f64> = self.omega.iter().map(|omega| omega * omega).collect();
        let [normal, sliding] = [&self.pairs.normal, &self.pairs.sliding].map(|rows| rows.as_ref());
        let modes = FreeModes { omega_squared: &omega_squared, normal, sliding, load: &self.pressed };
        let [normal, sliding] = [&self.residual.normal, &self.residual.sliding].map(|matrix| matrix.as_ref());
        let truncated = TruncatedResponse { normal, sliding, gap_per_load: &[0.0; PAIRS] };
        let response = StaticResponse::from_modes(&modes, flexible.then_some(&truncated)).expect("well formed");
        let parts = StaticsParts {
            law: law.clone(),
            area: vec![1.0; PAIRS],
            gap_m: self.gaps_m.clone(),
            response,
            measured: MeasuredLoad::Back,
        };
        Arc::new(Statics::new(parts).expect("well formed"))
    }

    fn model(&self, law: &PressureLaw, flexible: bool) -> Model {
        let residual = flexible.then_some(&self.residual);
        let model = self.free.clone().with_steady_contact(&self.pairs, self.statics(law, flexible), residual);
        model.expect("well formed")
    }
}

const FRICTION: ContactLaw =
    ContactLaw { exponent: 0.0, reference_n: 500.0, slope_s_per_m: -1e-4, stribeck: None, lateral_damping: true };
/// Pairs are 1 km from the axis: they slide with some 10 km/s.
const FALLING: ContactLaw =
    ContactLaw { stribeck: Some(Stribeck { drop: 1.0, speed_m_s: 1e4, exponent: 2.0 }), ..FRICTION };

fn point(normal_load_n: f64, disc_speed_rad_s: f64, friction_coefficient: f64) -> OperatingPoint {
    OperatingPoint { normal_load_n, disc_speed_rad_s, friction_coefficient }
}

const REFERENCE: OperatingPoint =
    OperatingPoint { normal_load_n: 500.0, disc_speed_rad_s: 13.0, friction_coefficient: 0.35 };

fn matrices(model: &Model, p: &OperatingPoint) -> [Mat<f64>; 2] {
    let n = model.dimension();
    let (mut k, mut c) = (Mat::zeros(n, n), Mat::zeros(n, n));
    model.assemble(p, &mut k, &mut c).expect("there is a state");
    [k, c]
}

fn options(mu_max: f64) -> MapOptions {
    MapOptions { mu_min: 0.0, mu_max, band_max_hz: None, instability_threshold: 1e-6, windows: true }
}

fn map(model: &Model, p: &OperatingPoint, mu_max: f64) -> StabilityMap {
    StabilityMap::build(model, &mut Solver::new(model.dimension()), p, &options(mu_max)).expect("it can be mapped")
}

/// With the linear law the state only decides which pairs are closed: the matrices are those of springs that are
/// always closed, with the open pairs left out. Tolerance with residual flexibility: the expansion of that model is
/// truncated at 1e-9.
#[test]
fn open_pairs_act_like_absent_pairs() {
    let (mut open, mut closed) = (0, 0);
    for seed in 0..20 {
        let rig = Rig::new(seed, 1e-2, ContactLaw::default(), 30.0);
        for flexible in [false, true] {
            let model = rig.model(&LINEAR, flexible);
            for p in [point(500.0, 13.0, 0.3), point(500.0, -13.0, 0.2), point(900.0, 0.0, 0.3)] {
                let here = model.at(&p).expect("there is a state");
                let state = here.state().expect("the contact is loaded");
                let mut pairs = rig.pairs.clone();
                for (pair, _) in state.tangent_n_per_m.iter().enumerate().filter(|(_, k)| **k == 0.0) {
                    (pairs.stiffness_n_per_m[pair], pairs.damping_n_s_per_m[pair]) = (0.0, 0.0);
                    open += 1;
                }
                closed += state.pairs_closed();
                let expected = match flexible {
                    false => rig.free.clone().with_contact(&pairs),
                    true => rig.free.clone().with_flexible_contact(&pairs, &rig.residual, 1.0),
                };
                let expected = matrices(&expected.expect("well formed"), &p);
                for (found, expected) in matrices(&model, &p).iter().zip(&expected) {
                    let off = (found - expected).norm_max() / expected.norm_max();
                    assert!(off < if flexible { 1e-8 } else { 1e-14 }, "seed {seed}, {p:?}: {off:e}");
                }
                assert!(model.is_damped(&p));
            }
        }
    }
    assert!(open > 50 && closed > 200, "worth testing: {open} open, {closed} closed");
}

/// Slope and lateral friction act with the forces of the state, by the formula.
#[test]
fn friction_damps_with_the_forces_of_the_state() {
    let rig = Rig::new(3, 0.0, FRICTION, 0.0);
    let model = rig.model(&ROUGH, false);
    for p in [point(500.0, 13.0, 0.3), point(300.0, -7.0, 0.5)] {
        let here = model.at(&p).expect("there is a state");
        let force = &here.state().expect("the contact is loaded").force_n;
        let [_, found] = matrices(&model, &p);
        let ContactPairs { sliding, lateral, radius_m, .. } = &rig.pairs;
        let expected = Mat::from_fn(MODES, MODES, |i, j| {
            let along = |k: usize| -1e-4 * force[k] * sliding[(k, i)] * sliding[(k, j)];
            let across = |k: usize| {
                let damping = p.friction_coefficient * force[k] / (p.disc_speed_rad_s.abs() * radius_m[k]);
                damping * lateral[(k, i)] * lateral[(k, j)]
            };
            (0..PAIRS).map(|k| along(k) + across(k)).sum::<f64>()
        });
        assert!((&found - &expected).norm_max() < 1e-13 * expected.norm_max(), "{p:?}");
    }
    assert!(!model.is_damped(&point(0.0, 13.0, 0.3)) && !model.is_damped(&point(500.0, 0.0, 0.3)));
}

/// Derivatives of `K` and `C` through the state agree with central differences. A relative step of 1e-5 leaves
/// truncation near 1e-10 and, with states known to 1e-13, rounding near 1e-8.
#[test]
fn matrices_follow_load_friction_and_speed() {
    let mut checked = 0;
    for (seed, law) in (0..6).zip([FRICTION, FALLING].into_iter().cycle()) {
        let rig = Rig::new(seed, 1e-2, law, 20.0);
        for flexible in [false, true] {
            let model = rig.model(&ROUGH, flexible);
            for p in
                [point(500.0, 13.0, 0.3), point(200.0, -13.0, 0.4), point(500.0, 13.0, 0.0), point(500.0, 0.0, 0.3)]
            {
                for (parameter, step) in
                    [(Parameter::Friction, 1e-5), (Parameter::Load, 1e-5 * p.normal_load_n), (Parameter::Speed, 1e-4)]
                {
                    let moved = |by: f64| {
                        let mut moved = p;
                        *parameter.condition(&mut moved).expect("a condition") += by;
                        moved
                    };
                    let (mut k, mut c) = (Mat::zeros(MODES, MODES), Mat::zeros(MODES, MODES));
                    model.assemble_derivative(&p, parameter, &mut k, &mut c).expect("there is a state");
                    let (up, down) = (matrices(&model, &moved(step)), matrices(&model, &moved(-step)));
                    for (part, found) in [k, c].iter().enumerate() {
                        let difference = (&up[part] - &down[part]) * faer::Scale(0.5 / step);
                        let size = difference.norm_max() + 1e-3 * up[part].norm_max() / step * 1e-5;
                        let off = (found - &difference).norm_max() / size;
                        assert!(off < 1e-6, "seed {seed}, {parameter:?} at {p:?}, part {part}: {off:e}");
                        checked += usize::from(difference.norm_max() > 1e-6);
                    }
                }
            }
        }
    }
    assert!(checked > 100, "{checked} derivatives other than zero");
}

/// Derivatives with respect to the stiffness and the damping of the contact agree with central differences over rigs
/// whose contact law or dampers are scaled. Tolerance: truncation of a relative step of 1e-4 is near 1e-8.
#[test]
fn matrices_follow_the_contact() {
    let step = 1e-4;
    for flexible in [false, true] {
        let model = |stiffer: f64, damper: f64| {
            let mut rig = Rig::new(2, 1e-2, FRICTION, 20.0);
            rig.pairs.stiffness_n_per_m.iter_mut().for_each(|k| *k *= stiffer);
            rig.pairs.damping_n_s_per_m.iter_mut().for_each(|c| *c *= damper);
            rig.model(&PressureLaw::Exponential { pressure: 20.0 * stiffer, roughness_m: 150.0 }, flexible)
        };
        for (parameter, up, down) in [
            (Parameter::ContactStiffness, model(1.0 + step, 1.0), model(1.0 - step, 1.0)),
            (Parameter::ContactDamping, model(1.0, 1.0 + step), model(1.0, 1.0 - step)),
        ] {
            let p = point(500.0, 13.0, 0.3);
            let (mut k, mut c) = (Mat::zeros(MODES, MODES), Mat::zeros(MODES, MODES));
            let here = model(1.0, 1.0);
            assert!(here.is_linear_in_contact());
            here.assemble_derivative(&p, parameter, &mut k, &mut c).expect("there is a state");
            let (up, down) = (matrices(&up, &p), matrices(&down, &p));
            for (part, found) in [k, c].iter().enumerate() {
                let difference = (&up[part] - &down[part]) * faer::Scale(0.5 / step);
                let off = (found - &difference).norm_max();
                let size = difference.norm_max() + 1e-6 * up[part].norm_max();
                assert!(off < 1e-6 * size, "{parameter:?}, part {part}: {off:e} of {size:e}");
                assert!(difference.norm_max() > 0.0 || (part, parameter) == (0, Parameter::ContactDamping));
            }
        }
    }
}

/// The friction sensitivity of every root contains the motion of the state.
#[test]
fn roots_follow_the_state() {
    let model = Rig::new(1, 1e-2, FRICTION, 0.0).model(&ROUGH, false);
    let mut solver = Solver::new(MODES);
    let (p, step) = (point(500.0, 13.0, 0.3), 1e-5);
    let spectrum = solver.solve(&model, &p, Vectors::Both).expect("it solves");
    let mut beside = |mu| solver.solve(&model, &p.with_friction(mu), Vectors::Right).expect("it solves");
    let (up, down) = (beside(0.3 + step), beside(0.3 - step));
    for (k, found) in spectrum.friction_sensitivity.iter().enumerate() {
        let difference = (up.roots[k].square - down.roots[k].square) / (2.0 * step);
        assert!((found - difference).norm() < 1e-6 * (1.0 + difference.norm()), "root {k}: {found} {difference}");
    }
}

/// Points of a fine scan grow exactly in the windows, for a linear law whose pairs open and close.
#[test]
fn windows_hold_where_roots_jump() {
    let (mut windows, mut jumps, mut changes) = (0, 0, 0);
    for seed in 0..30 {
        let damping = [0.0, 2e-2][seed as usize % 2];
        let model = Rig::new(seed, damping, ContactLaw::default(), 300.0).model(&LINEAR, false);
        let map = map(&model, &REFERENCE, 2.0);
        assert!(map.complete, "seed {seed}");
        windows += map.windows.len();
        let ends = map.ends.windows.iter().flat_map(|(from, to)| std::iter::once(from).chain(to));
        let ends: Vec<_> = ends.collect();
        jumps += ends.iter().filter(|end| end.is_jump()).count();
        assert!(ends.iter().all(|end| end.error < 1e-9), "seed {seed}: {ends:?}");
        let last = map.sliding_ends.as_ref().map_or(2.0, |end| end.mu);
        let mut solver = Solver::new(MODES);
        let mut before: Option<Vec<bool>> = None;
        for mu in (0..500).map(|k| 4e-3 * f64::from(k) + 3.7e-5).take_while(|&mu| mu < last) {
            let spectrum = solver.solve(&model, &REFERENCE.with_friction(mu), Vectors::Right).expect("it solves");
            let unstable = spectrum.roots.iter().any(|root| root.is_unstable(1e-6));
            let inside = |slack: f64| {
                map.windows.iter().any(|w| mu > w.mu_from + slack && w.mu_to.is_none_or(|to| mu < to - slack))
            };
            assert!(!unstable || inside(-1e-9), "seed {seed}: {mu} grows in none of {:?}", map.windows);
            let grows = spectrum.roots.iter().any(|root| root.is_unstable(1e-11));
            assert!(grows || !inside(1e-5), "seed {seed}: {mu} does not grow in {:?}", map.windows);
            let closed = spectrum.state.as_ref().map(|state| state.force_n.iter().map(|force| *force > 0.0).collect());
            changes += usize::from(before.is_some() && before != closed);
            before = closed;
        }
    }
    eprintln!("{windows} windows, {jumps} jumps, {changes} changes");
    assert!(windows > 15 && jumps > 0 && changes > 3, "{windows} windows, {jumps} jumps, {changes} changes");
}

/// Ends carried to another load agree with those of a map there, whether roots move smoothly or jump.
#[test]
fn ends_follow_the_load_through_the_state() {
    let (mut carried_ends, mut jumps, mut moved) = (0, 0, 0.0f64);
    for seed in 0..40 {
        let (law, limit) = [(&LINEAR, 1e-9), (&ROUGH, 1e-9)][seed as usize % 2];
        let model = Rig::new(seed, 0.0, ContactLaw::default(), 200.0).model(law, false);
        let here = map(&model, &REFERENCE, 2.0);
        let p = point(503.0, 13.0, 0.0);
        let there = map(&model, &p, 2.0);
        let Some(carried) = Ends::carried(&model, &mut Solver::new(MODES), &here, &p).expect("it solves") else {
            continue;
        };
        if there.windows.len() != here.windows.len() {
            continue; // a window came or went
        }
        let both = |ends: &Ends, at: &OperatingPoint| -> Vec<Bounded> {
            ends.at(at).flat_map(|(from, to)| std::iter::once(from).chain(to)).collect()
        };
        let (exact, found, guessed) = (both(&there.ends, &p), both(&carried, &p), both(&here.ends, &p));
        for k in 0..exact.len() {
            let off = (found[k].value - exact[k].value).abs();
            assert!(off < limit, "seed {seed}: {:?} {:?}", found[k], exact[k]);
            let bound = guessed[k].error + exact[k].error;
            assert!((guessed[k].value - exact[k].value).abs() <= bound, "seed {seed}: {:?} {:?}", guessed[k], exact[k]);
            carried_ends += 1;
            moved = moved.max((guessed[k].value - both(&here.ends, &REFERENCE)[k].value).abs());
        }
        let all = here.ends.windows.iter().flat_map(|(from, to)| std::iter::once(from).chain(to));
        jumps += all.filter(|end| end.is_jump()).count();
    }
    eprintln!("{carried_ends} ends, {jumps} jumps, moved by {moved}");
    assert!(carried_ends > 20 && jumps > 0 && moved > 1e-5, "{carried_ends} ends, {jumps} jumps, moved by {moved}");
}

/// Where there is no contact state, a solve fails with the reason, and the stability map ends.
#[test]
fn nothing_is_predicted_without_a_state() {
    let mut ended = 0;
    for seed in 0..30 {
        let model = Rig::new(seed, 0.0, ContactLaw::default(), 0.0).model(&LINEAR, false);
        let map = map(&model, &REFERENCE, 8.0);
        let Some(end) = &map.sliding_ends else { continue };
        assert_eq!(map.nodes.last().map(|node| node.mu()), Some(end.mu), "seed {seed}");
        assert!(matches!(end.reason, ModelError::State(_)), "{:?}", end.reason);
        let beyond = REFERENCE.with_friction(end.mu + 2.0 * map.resolution);
        let refused = Solver::new(MODES).solve(&model, &beyond, Vectors::Both);
        assert!(matches!(refused, Err(SolveError::Model(ModelError::State(_)))), "seed {seed}: {refused:?}");
        assert!(map.windows.iter().all(|window| window.mu_to.is_none_or(|to| to <= end.mu)), "{:?}", map.windows);
        ended += 1;
    }
    assert!(ended > 2, "{ended} maps ended");
}

fn chart_options(high_speed: f64) -> ChartOptions {
    ChartOptions {
        low: point(200.0, 10.0, 0.0),
        high: point(1000.0, high_speed, 0.6),
        band_max_hz: None,
        tolerance: 1e-8,
        smallest_share: 1e-3,
        max_solves: 4000,
        threads: 1,
    }
}

/// A chart of a model with an analytic contact law holds at held-out loads and friction coefficients: no bound is
/// broken and no root missing. Its words give the same chart.
#[test]
fn charts_hold_through_the_state() {
    // Without friction that depends on the speed, the chart has no axis of the speed.
    for (seed, damping, law, high_speed) in [
        (1, 0.0, ContactLaw::default(), 20.0),
        (4, 2e-2, ContactLaw::default(), 20.0),
        (7, 2e-2, FRICTION, 12.0),
        (7, 2e-2, FALLING, 10.5),
    ] {
        let model = Rig::new(seed, damping, law, 20.0).model(&ROUGH, seed == 4);
        let options = chart_options(high_speed);
        let chart = build(&model, &options, &|_| true).expect("it can be charted");
        let found = hold_out(&model, &options, &chart, 1000, seed).expect("it solves");
        assert_eq!((found.violations, found.incomplete), (0, 0), "{found:?}");
        assert!(found.charted > 950, "{} leaves, {} solves: {found:?}", chart.leaf_count(), chart.solve_count());
        assert!(found.largest_error < 1e-7, "{found:?}");
        let words = chart.words();
        let again = Chart::from_words(&words).expect("words of a chart");
        assert!(again.words() == words);
        assert!(Chart::from_words(&words[..words.len() - 1]).is_none());
        eprintln!("{} leaves, {} solves: {found:?}", chart.leaf_count(), chart.solve_count());
    }
}

/// A lost root violates the chart's own traces.
#[test]
fn a_lost_root_violates_the_traces_of_the_chart() {
    let model = Rig::new(1, 0.0, ContactLaw::default(), 20.0).model(&ROUGH, false);
    let options = chart_options(20.0);
    let chart = build(&model, &options, &|_| true).expect("it can be charted");
    let lost = chart.without_a_root();
    let found = hold_out(&model, &options, &lost, 100, 1).expect("it solves");
    assert_eq!(found.charted, 0, "{found:?}");
    assert!(found.incomplete > 90, "{found:?}");
}

/// Laws that are not analytic: roots jump with the first, bend with the others. The last has a break at every point of its
/// table.
fn laws_with_breaks() -> [PressureLaw; 4] {
    let power = |exponent| PressureLaw::Power { stiffness: 0.3, reference_m: 500.0, exponent, roughness_m: 0.0 };
    let table = PressureTable::new(&[0.0, 300.0, 700.0, 2000.0, 1e4], &[5.0, 60.0, 200.0, 900.0, 1e4]);
    [LINEAR, power(1.5), power(2.0), PressureLaw::Table(table.expect("a table"))]
}

/// Charts of laws with breaks hold at held-out points, and their leaves end where a closure passes a break.
#[test]
fn leaves_end_where_a_closure_passes_a_break() {
    let mut uniform = Uniform::new(3);
    let (mut passed, mut beside) = (0, [0, 0]);
    for (seed, law) in (0..8).zip(laws_with_breaks().into_iter().cycle()) {
        let model = Rig::new(seed, [0.0, 2e-2][seed as usize / 4], ContactLaw::default(), 300.0).model(&law, false);
        let options = chart_options(20.0);
        let chart = build(&model, &options, &|_| true).expect("it can be charted");
        let found = hold_out(&model, &options, &chart, 500, seed).expect("it solves");
        eprintln!("{law:?}: {} leaves, {} solves: {found:?}", chart.leaf_count(), chart.solve_count());
        assert_eq!((found.violations, found.incomplete), (0, 0), "seed {seed}: {found:?}");
        assert!(found.charted > 250 && found.largest_error < 1e-7, "seed {seed}: {found:?}");

        // Points within 1e-12 to 1e-3 of a break, found by bisection between two states.
        let pieces = |p: &OperatingPoint| -> Option<Vec<usize>> {
            let here = model.at(p).ok()?;
            let closures = here.state()?.closure_m.clone();
            Some(closures.iter().map(|closure| law.breaks().partition_point(|at| at < closure)).collect())
        };
        let (mut solver, mut scratch, traces) = (Solver::new(MODES), Scratch::default(), Traces::new(&model));
        for _ in 0..40 {
            let [from, to] = [0, 1].map(|_| point(600.0 + 400.0 * uniform.draw(), 13.0, 0.3 + 0.3 * uniform.draw()));
            let between = |share: f64| {
                let along = |from: f64, to: f64| from + share * (to - from);
                let load = along(from.normal_load_n, to.normal_load_n);
                point(load, 13.0, along(from.friction_coefficient, to.friction_coefficient))
            };
            let Some(first) = pieces(&from).filter(|first| pieces(&to).is_some_and(|last| last != *first)) else {
                continue;
            };
            let (mut low, mut high) = (0.0, 1.0);
            for _ in 0..50 {
                let middle = 0.5 * (low + high);
                let same = pieces(&between(middle)).is_some_and(|there| there == first);
                *if same { &mut low } else { &mut high } = middle;
            }
            passed += 1;
            for off in [-0.03, -1e-3, -1e-6, -1e-9, -1e-12, 1e-12, 1e-9, 1e-6, 1e-3, 0.03] {
                let p = between((low + off).clamp(0.0, 1.0));
                let mut modes = vec![];
                let charted = chart.evaluate(&p, traces.at(&model, &p), &mut scratch, &mut modes).is_ok();
                beside[usize::from(charted)] += 1;
                if charted {
                    let spectrum = solver.solve(&model, &p, Vectors::Both).expect("it solves");
                    assert!(within_bounds(&modes, &spectrum), "seed {seed}, {off:e} beside a break: {p:?}");
                }
            }
        }
    }
    eprintln!("{passed} breaks; beside them {beside:?} points solved and charted");
    assert!(passed > 20 && beside[0] > 100 && beside[1] > 20, "{passed} breaks, {beside:?}");
}

/// Charted modes have the identities of solved ones.
#[test]
fn identities_hold_through_the_state() {
    let model = Rig::new(4, 0.0, ContactLaw::default(), 20.0).model(&ROUGH, false);
    let charted = chart_options(20.0);
    let chart = build(&model, &charted, &|_| true).expect("it can be charted");
    let mapped = MapOptions { windows: false, ..options(0.6) };
    let found = compare(&model, &mapped, &charted, &chart, [4, 50], 3).expect("it solves");
    assert_eq!(found.different, 0, "{found:?}");
    assert!(found.charted > 190, "{found:?}");
}

#[test]
fn inconsistent_input_is_refused() {
    let rig = Rig::new(1, 1e-2, ContactLaw::default(), 0.0);
    let with = |change: &dyn Fn(&mut ContactPairs, &mut ResidualFlexibility)| {
        let (mut pairs, mut residual) = (rig.pairs.clone(), rig.residual.clone());
        change(&mut pairs, &mut residual);
        let model = rig.free.clone().with_steady_contact(&pairs, rig.statics(&LINEAR, true), Some(&residual));
        model.map(|_| ()).unwrap_err()
    };
    assert!(matches!(with(&|pairs, _| pairs.stiffness_n_per_m[2] = 0.0), ModelError::StateDamping { pair: 2, .. }));
    let zero = Mat::<f64>::zeros(PAIRS, PAIRS);
    let inertia = |residual: &mut ResidualFlexibility| residual.inertia = Some([zero.clone(), zero.clone()]);
    assert_eq!(with(&|_, residual| inertia(residual)), ModelError::StateInertia);
    assert!(matches!(with(&|_, residual| residual.normal = Mat::zeros(2, 2)), ModelError::Shape { .. }));
    assert!(matches!(with(&|_, residual| residual.sliding[(1, 2)] = f64::NAN), ModelError::NotFinite { .. }));
    let hertzian = Rig::new(1, 1e-2, ContactLaw { exponent: 0.3, ..ContactLaw::default() }, 0.0);
    let refused = hertzian.free.clone().with_steady_contact(&rig.pairs, rig.statics(&LINEAR, false), None);
    assert_eq!(refused.map(|_| ()).unwrap_err(), ModelError::StateLoadExponent { exponent: 0.3 });
}

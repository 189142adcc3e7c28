//! Time of a prediction by each route, answers checked first: `cargo bench --bench predict`.
//!
//! Synthetic undamped rigs over the friction coefficient, 48 contact pairs, band 5 kHz, one thread. 490 modes take minutes more:
//! they are measured with SQUEALCAST_MEASURE=1. `squealcast bench` measures the same routes against their error, and LAPACK.

use std::hint::black_box;
use std::sync::Arc;

use criterion::{Criterion, criterion_group, criterion_main};
use squealcast::contact::PressureLaw;
use squealcast::physics::chart::Scratch;
use squealcast::physics::chart::build::{ChartOptions, build};
use squealcast::physics::{Chart, ContactLaw, Model, OperatingPoint, Root, Solver, Summary, Traces, Vectors};
use squealcast::proof::synthetic::{STIFFNESS_N_PER_M, Synthetic, Uniform, parts, rig, statics};

const BAND_MAX_HZ: f64 = 5000.0;
/// More than caches keep of one condition for the next.
const CONDITIONS: usize = 64;

fn point(friction_coefficient: f64) -> OperatingPoint {
    OperatingPoint { normal_load_n: 500.0, disc_speed_rad_s: 13.0, friction_coefficient }
}

fn charted(model: &Model) -> Chart {
    let options = ChartOptions {
        low: point(0.0),
        high: point(1.0),
        band_max_hz: Some(BAND_MAX_HZ),
        tolerance: 1e-8,
        smallest_share: 1e-4,
        max_solves: 100_000,
        threads: 1,
    };
    build(model, &options, &|_| true).expect("the rig can be charted")
}

/// Every charted root has a dense one within its bound.
fn check(model: &Model, chart: &Chart, traces: &Traces, points: &[OperatingPoint]) {
    let (mut solver, mut scratch, mut modes) = (Solver::new(model.dimension()), Scratch::default(), vec![]);
    for p in points {
        let spectrum = solver.solve(model, p, Vectors::Both).expect("it solves");
        modes.clear();
        chart.evaluate(p, traces.at(model, p), &mut scratch, &mut modes).expect("it is charted");
        for charted in &modes {
            let off = |root: &Root| (root.square - charted.square).norm();
            let nearest = spectrum.roots.iter().min_by(|a, b| off(a).total_cmp(&off(b))).expect("there are roots");
            assert!(off(nearest) <= charted.error.square + nearest.error.square, "{charted:?} is not {nearest:?}");
        }
    }
}

fn routes(criterion: &mut Criterion) {
    let mut sizes = vec![20, 80, 160];
    sizes.extend(std::env::var_os("SQUEALCAST_MEASURE").map(|_| 490));
    for modes in sizes {
        let contact_law = ContactLaw::default();
        let synthetic = Synthetic { modes, pairs: 48, damping_ratio: 0.0, contact_law, seed: 1 };
        let model = rig(&synthetic).expect("the rig is well formed");
        let (chart, traces) = (charted(&model), Traces::new(&model));
        let mut uniform = Uniform::new(3);
        let points: Vec<OperatingPoint> = (0..CONDITIONS).map(|_| point(0.5 * (uniform.draw() + 1.0))).collect();
        check(&model, &chart, &traces, &points[..8]);

        let mut group = criterion.benchmark_group(format!("{modes} modes"));
        let mut solver = Solver::new(modes);
        for (route, vectors) in [("dense values", Vectors::None), ("dense both vectors", Vectors::Both)] {
            let mut next = points.iter().cycle();
            group.sample_size(10).bench_function(route, |bencher| {
                bencher.iter(|| next.next().map(|p| black_box(solver.solve(&model, p, vectors))));
            });
        }
        let (mut scratch, mut values, mut roots): (_, _, Vec<Root>) = (Scratch::default(), vec![], vec![]);
        let mut next = points.iter().cycle();
        group.sample_size(100).bench_function("chart values", |bencher| {
            bencher.iter(|| {
                values.clear();
                next.next().map(|p| black_box(chart.values(p, &mut scratch, &mut values)))
            });
        });
        let mut summary = Summary::default();
        let mut next = points.iter().cycle();
        group.bench_function("chart + certificate", |bencher| {
            bencher.iter(|| {
                let Some(p) = next.next() else { return };
                roots.clear();
                let answer = chart.evaluate(p, traces.at(&model, p), &mut scratch, &mut roots);
                let all = answer.expect("it is charted");
                summary.take_chart(&roots, p.friction_coefficient, all, None, Some(BAND_MAX_HZ), 1e-6);
                let _ = black_box((answer, &summary));
            });
        });
        group.finish();
    }
}

/// A dense prediction with a contact state beside one with springs that are always closed, 160 modes and 294 pairs.
fn states(criterion: &mut Criterion) {
    let contact_law = ContactLaw::default();
    let synthetic = Synthetic { modes: 160, pairs: 294, damping_ratio: 0.0, contact_law, seed: 1 };
    let parts = parts(&synthetic).expect("the rig is well formed");
    let stiffness = STIFFNESS_N_PER_M / synthetic.pairs as f64;
    // Equally stiff where a pair carries its share of 500 N.
    let share = 500.0 / synthetic.pairs as f64;
    let laws = [
        ("linear law", PressureLaw::Linear { stiffness }),
        ("exponential law", PressureLaw::Exponential { pressure: 0.1 * share, roughness_m: share / stiffness }),
    ];
    let mut uniform = Uniform::new(3);
    let points: Vec<OperatingPoint> = (0..CONDITIONS)
        .map(|_| OperatingPoint { normal_load_n: 500.0 + 200.0 * uniform.draw(), ..point(0.3 + 0.3 * uniform.draw()) })
        .collect();
    let mut group = criterion.benchmark_group("160 modes, 294 pairs");
    let closed = parts.free.clone().with_contact(&parts.pairs).expect("the rig is well formed");
    let mut models = vec![("always closed", closed)];
    for (name, law) in laws {
        // With as many anchors as a rig has.
        let loads: Vec<f64> = (0..6).map(|k| 50.0 * 40f64.powf(f64::from(k) / 5.0)).collect();
        let frictions: Vec<f64> = (0..=8).map(|k| 0.125 * f64::from(k)).collect();
        let statics = statics(&parts, law, 1e-6).expect("the statics are well formed");
        let statics = Arc::new(statics.with_anchors(&loads, &frictions));
        let model = parts.free.clone().with_steady_contact(&parts.pairs, statics.clone(), None);
        models.push((name, model.expect("the rig is well formed")));
        let mut next = points.iter().cycle();
        group.sample_size(10).bench_function(format!("state, {name}"), |bencher| {
            bencher.iter(|| next.next().map(|p| black_box(statics.state(p.normal_load_n, p.friction_coefficient))));
        });
    }
    let mut solver = Solver::new(synthetic.modes);
    for (name, model) in &models {
        for p in &points[..4] {
            let spectrum = solver.solve(model, p, Vectors::Both).expect("it solves");
            assert!(spectrum.roots.iter().all(|root| root.residual < 1e-12));
        }
        let mut next = points.iter().cycle();
        group.sample_size(10).bench_function(format!("dense, {name}"), |bencher| {
            bencher.iter(|| next.next().map(|p| black_box(solver.solve(model, p, Vectors::Both))));
        });
    }
    group.finish();
}

criterion_group!(benches, routes, states);
criterion_main!(benches);

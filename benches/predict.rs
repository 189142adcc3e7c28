//! Time of one prediction by a dense solve and off a chart, answers checked first: `cargo bench --bench predict`.
//!
//! Synthetic undamped rigs over the friction coefficient, 48 contact pairs, band 5 kHz. One thread; medians.

use std::time::Instant;

use squealcast::physics::chart::Scratch;
use squealcast::physics::chart::build::{ChartOptions, build};
use squealcast::physics::synthetic::{Synthetic, Uniform, rig};
use squealcast::physics::{ContactLaw, OperatingPoint, Solver, Traces, Vectors};

const CONDITIONS: usize = 200;

fn main() {
    println!("{:>4}  {:>14}  {:>17}  {:>9}  {:>7}", "n", "dense, us", "chart, us", "ratio", "leaves");
    for modes in [20, 80, 160] {
        let contact_law = ContactLaw::default();
        let synthetic = Synthetic { modes, pairs: 48, damping_ratio: 0.0, contact_law, seed: 1 };
        let model = rig(&synthetic).expect("the rig is well formed");
        let point = |friction_coefficient| OperatingPoint {
            normal_load_n: 500.0,
            disc_speed_rad_s: 13.0,
            friction_coefficient,
        };
        let options = ChartOptions {
            low: point(0.0),
            high: point(1.0),
            band_max_hz: Some(5000.0),
            tolerance: 1e-8,
            smallest_share: 1e-4,
            max_solves: 100_000,
            threads: 1,
        };
        let chart = build(&model, &options, &|_| true).expect("the rig can be charted");
        let traces = Traces::new(&model);
        let mut solver = Solver::new(modes);
        let (mut scratch, mut charted) = (Scratch::default(), vec![]);
        let (mut dense, mut fast) = (vec![], vec![]);
        let mut uniform = Uniform::new(3);
        for _ in 0..CONDITIONS {
            let p = point(0.5 * (uniform.draw() + 1.0));
            let begun = Instant::now();
            let spectrum = solver.solve(&model, &p, Vectors::Both).expect("it solves");
            dense.push(begun.elapsed().as_secs_f64() * 1e6);
            charted.clear();
            let begun = Instant::now();
            chart.evaluate(&p, traces.at(&model, &p), &mut scratch, &mut charted).expect("it is charted");
            fast.push(begun.elapsed().as_secs_f64() * 1e6);
            for mode in &charted {
                let off = |root: &squealcast::physics::Root| (root.square - mode.root.square).norm();
                let nearest = spectrum.roots.iter().map(off).fold(f64::INFINITY, f64::min);
                assert!(nearest <= 2.0 * mode.root.error.square, "n {modes}: {mode:?} is off by {nearest:e}");
            }
        }
        let median = |times: &mut Vec<f64>| {
            times.sort_by(f64::total_cmp);
            times[times.len() / 2]
        };
        let (dense, fast) = (median(&mut dense), median(&mut fast));
        println!("{modes:>4}  {dense:>14.1}  {fast:>17.2}  {:>9.0}  {:>7}", dense / fast, chart.leaf_count());
    }
}

//! Predicts a charted rig at many operating points and times it, for comparison with the Python package:
//!
//! ```sh
//! cargo run --release --example predict_many -- tribometer 1000000
//! ```
//!
//! Arguments: the rig, the number of operating points, and optionally a file for the eigenvalues as pairs of 64-bit numbers,
//! little-endian, a row of modes for each point. The points fill the box of the chart by Weyl's sequence: coordinate `k` is
//! the fraction of `k` times an irrational number.

use std::error::Error;
use std::fs;
use std::hint::black_box;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::time::Instant;

use squealcast::analysis::many::{Maps, Options, predict};
use squealcast::files::chart_file::ChartFile;
use squealcast::node::kept_chart;
use squealcast::physics::chart::Scratch;
use squealcast::physics::{OperatingPoint, Solver, StabilityMap, Summary, Traces};
use squealcast::rig::Rig;
use squealcast::session::{chart_options, map_options};

/// Inverses of the golden ratio's relatives: irrational, and independent of each other.
const STEPS: [f64; 3] = [0.819_172_513_396_164_5, 0.671_043_606_703_789_3, 0.549_700_477_901_970_7];

fn main() -> Result<(), Box<dyn Error>> {
    let mut arguments = std::env::args().skip(1);
    let rig = Arc::new(Rig::load(&arguments.next().unwrap_or_else(|| "tribometer".to_owned()))?);
    let count: usize = arguments.next().map_or(Ok(1_000_000), |text| text.parse())?;
    let file = ChartFile::locate(&rig.name, rig.path.as_deref(), &rig.content_hash).ok_or("no folder for the chart")?;
    let chart = Arc::new(kept_chart(&rig, &file, 2, &|| true)?);

    let (low, high) = (chart_options(&rig).low, chart_options(&rig).high);
    let along = |k: usize, axis: usize, low: f64, high: f64| low + (high - low) * (k as f64 * STEPS[axis]).fract();
    let points: Vec<OperatingPoint> = (0..count)
        .map(|k| OperatingPoint {
            friction_coefficient: along(k, 0, low.friction_coefficient, high.friction_coefficient),
            normal_load_n: along(k, 1, low.normal_load_n, high.normal_load_n),
            disc_speed_rad_s: along(k, 2, low.disc_speed_rad_s, high.disc_speed_rad_s),
        })
        .collect();

    // One after the other, with bounds, trace check and identities; nothing is kept.
    let map =
        StabilityMap::build(&rig.model, &mut Solver::new(rig.model.dimension()), &rig.reference, &map_options(&rig))?;
    let (traces, mut scratch, mut roots) = (Traces::new(&rig.model), Scratch::default(), vec![]);
    let mut summary = Summary::default();
    let began = Instant::now();
    for p in &points {
        roots.clear();
        let all = chart.evaluate(p, traces.at(&rig.model, p), &mut scratch, &mut roots)?;
        let mu = p.friction_coefficient;
        summary.take_chart(&roots, mu, all, Some(&map), rig.band_max_hz, rig.instability_threshold);
        black_box(&summary);
    }
    println!("evaluated:       {:.2} us each, one thread", began.elapsed().as_secs_f64() * 1e6 / count as f64);

    let options = Options { chart: Some(&chart), maps: Maps::Reference, modes: true, threads: 1 };
    let began = Instant::now();
    let found = predict(&rig, &points, options, &AtomicBool::new(false))?;
    println!("analysis::many:  {:.2} us each, one thread", began.elapsed().as_secs_f64() * 1e6 / count as f64);
    if let Some(file) = arguments.next() {
        let numbers = found.modes.eigenvalue_per_s.iter().flat_map(|lambda| [lambda.re, lambda.im]);
        fs::write(file, numbers.flat_map(f64::to_le_bytes).collect::<Vec<u8>>())?;
    }
    Ok(())
}

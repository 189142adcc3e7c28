//! Identities of charted modes against those of solved ones: every embedded rig and a hundred random ones, at a thousand
//! conditions each. Ends with an error where any differs. A rig whose chart takes longer than [`PATIENCE`] is named and left out;
//! `SQUEALCAST_MEASURE` waits for it.

use std::time::{Duration, Instant};

use squealcast::physics::{Chart, ContactLaw, MapOptions};
use squealcast::proof::identities::{Agreement, compare};
use squealcast::proof::synthetic::{Synthetic, rig};
use squealcast::rig::{EMBEDDED, Rig};
use squealcast::session::computed::session_chart;
use squealcast::session::{chart_options, map_options};

const CONDITIONS: usize = 1000;
const RANDOM_RIGS: u64 = 100;
/// The longest time that a chart may take. That of the largest embedded rig takes an hour.
const PATIENCE: Duration = Duration::from_secs(60);

fn main() {
    let mut all = Agreement::default();
    let mut rigs = 0;
    for embedded in EMBEDDED {
        let rig = Rig::load(embedded.name).expect("an embedded rig");
        let begun = Instant::now();
        rigs += u32::from(add(&mut all, &rig, embedded.name, begun));
    }
    let like = Rig::load("nine-dof-case-2").expect("an embedded rig");
    for seed in 0..RANDOM_RIGS {
        // Without damping, with contact that stiffens with the load, damped.
        let kind = seed as usize % 3;
        let contact_law = ContactLaw { exponent: [0.0, 0.3, 0.3][kind], ..Default::default() };
        let damping_ratio = [0.0, 0.0, 2e-3][kind];
        let modes = [40, 20, 12][kind];
        let model = rig(&Synthetic { modes, pairs: 48, damping_ratio, contact_law, seed }).expect("well formed");
        let rig = Rig { model, band_max_hz: Some(5000.0), mu_max: 1.0, ..like.clone() };
        let begun = Instant::now();
        rigs += u32::from(add(&mut all, &rig, &format!("random {seed}, {modes} modes, kind {kind}"), begun));
    }
    println!("{rigs} rigs: {all:?}");
    assert_eq!(all.different, 0, "identities differ");
}

/// Charts a rig and compares; false where the chart takes too long.
fn add(all: &mut Agreement, rig: &Rig, name: &str, begun: Instant) -> bool {
    let patient = std::env::var_os("SQUEALCAST_MEASURE").is_some();
    let chart: Chart = match session_chart(rig, threads(), &|| patient || begun.elapsed() < PATIENCE) {
        Ok(chart) => chart,
        Err(error) => {
            println!("{name}: left out: {error}");
            return false;
        }
    };
    let charted_s = begun.elapsed().as_secs_f64();
    let (load, speed) = rig.model.depends_on_load_and_speed();
    let places = if load || speed { [20, CONDITIONS / 20] } else { [1, CONDITIONS] };
    let mapped = MapOptions { windows: false, ..map_options(rig) };
    let found = compare(&rig.model, &mapped, &chart_options(rig), &chart, places, 7).expect("it is solved");
    println!("{name}: charted in {charted_s:.1} s, compared after {:.1} s, {found:?}", begun.elapsed().as_secs_f64());
    all.charted += found.charted;
    all.solved += found.solved;
    all.modes += found.modes;
    all.different += found.different;
    all.by_shape += found.by_shape;
    true
}

fn threads() -> usize {
    std::thread::available_parallelism().map_or(1, usize::from)
}

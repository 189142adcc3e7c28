//! States of sliding contact of 294 pairs at 200 conditions: from anchors, and continued from frictionless contact. Every state
//! is checked against the equations before it is timed. With `SQUEALCAST_MEASURE=1` a state from anchors must take at most 2 ms.

use std::hint::black_box;
use std::time::{Duration, Instant};

use faer::Mat;
use squealcast::contact::{
    MeasuredLoad, PressureLaw, RigidMotions, StaticResponse, Statics, StaticsParts, SteadyState,
};

const ACROSS: usize = 14;
const ALONG: usize = 21;
/// Distance of neighbouring pairs, m.
const PITCH_M: f64 = 2e-3;
/// Contact modulus of the pad, Pa.
const MODULUS: f64 = 2e9;
/// Stiffness of a pair, N/m.
const STIFFNESS: f64 = 1.25e7;
const CONDITIONS: usize = 200;
/// Median of a state from anchors.
const PROMISED: Duration = Duration::from_millis(2);

fn place(k: usize) -> [f64; 2] {
    [(k % ACROSS) as f64 - 0.5 * (ACROSS - 1) as f64, (k / ACROSS) as f64 - 0.5 * (ALONG - 1) as f64]
        .map(|x| PITCH_M * x)
}

/// A pad that floats on its contact: translation and two tilts, elastic half-space between the pairs, friction that tilts it
/// and, through Poisson's ratio, moves the surface along the normal. The pad is crowned by 2 micrometres.
fn pad(law: PressureLaw, area: f64) -> Statics {
    let c = ACROSS * ALONG;
    let between = |i: usize, j: usize| {
        let [[x, y], [u, v]] = [place(i), place(j)];
        ([u - x, v - y], (u - x).hypot(v - y))
    };
    let normal_flexibility = Mat::from_fn(c, c, |i, j| {
        let distance = if i == j { 0.28 * PITCH_M } else { between(i, j).1 };
        1.0 / (std::f64::consts::PI * MODULUS * distance)
    });
    let sliding_flexibility = Mat::from_fn(c, c, |i, j| {
        let ([_, along], distance) = between(i, j);
        if i == j { 0.0 } else { 0.2 * along / (std::f64::consts::PI * MODULUS * distance * distance) }
    });
    let gap_m = (0..c).map(|k| 2e-6 * (place(k)[1] / (0.5 * ALONG as f64 * PITCH_M)).powi(2)).collect();
    let rigid = RigidMotions {
        normal: Mat::from_fn(c, 3, |k, motion| if motion == 0 { 1.0 } else { place(k)[motion - 1] / PITCH_M }),
        // Friction acts 8 mm from the axis of the tilt.
        sliding: Mat::from_fn(c, 3, |_, motion| if motion == 2 { 8e-3 / PITCH_M } else { 0.0 }),
        load: vec![-1.0, 0.0, 0.0],
    };
    let response = StaticResponse { normal_flexibility, sliding_flexibility, gap_per_load: vec![0.0; c], rigid };
    Statics::new(StaticsParts { law, area: vec![area; c], gap_m, response, measured: MeasuredLoad::Back })
        .expect("well formed")
}

/// The largest imbalance of a state, relative to the largest terms, by loops over the equations.
fn imbalance(statics: &Statics, state: &SteadyState) -> f64 {
    let StaticsParts { law, area, gap_m, response, .. } = statics.parts();
    let c = statics.pairs();
    let (mut left, mut largest) = (0.0f64, 0.0f64);
    for k in 0..c {
        let forces = (0..c).map(|j| {
            let sliding = state.friction * response.sliding_flexibility[(k, j)];
            (response.normal_flexibility[(k, j)] + sliding) * state.force_n[j]
        });
        let motions = (0..3).map(|j| response.rigid.normal[(k, j)] * state.rigid[j]);
        let terms: Vec<f64> = forces.chain(motions).chain([state.closure_m[k], gap_m[k]]).collect();
        left = left.max(terms.iter().sum::<f64>().abs());
        largest = largest.max(terms.iter().map(|term| term.abs()).sum());
        assert_eq!(state.force_n[k], area[k] * law.at(state.closure_m[k]).pressure);
    }
    let mut worst = left / largest;
    for j in 0..3 {
        let work = |k: usize| response.rigid.normal[(k, j)] + state.friction * response.rigid.sliding[(k, j)];
        let terms = (0..c).map(|k| work(k) * state.force_n[k]).chain([state.back_force_n * response.rigid.load[j]]);
        let (sum, size) = terms.fold((0.0, 0.0f64), |(sum, size), term| (sum + term, size + term.abs()));
        worst = worst.max(sum.abs() / size);
    }
    worst
}

/// Median and 95th percentile.
fn spread(mut times: Vec<Duration>) -> [Duration; 2] {
    times.sort_unstable();
    [times[times.len() / 2], times[times.len() * 95 / 100]]
}

fn main() {
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    println!("{} pairs, {CONDITIONS} conditions, {cores} cores", ACROSS * ALONG);
    let exponential = PressureLaw::Exponential { pressure: 1e4, roughness_m: 2e-6 };
    for (name, law, area) in
        [("linear", PressureLaw::Linear { stiffness: STIFFNESS }, 1.0), ("exponential", exponential, PITCH_M * PITCH_M)]
    {
        let plain = pad(law, area);
        let begun = Instant::now();
        let loads: Vec<f64> = (0..12).map(|k| 50.0 * 40f64.powf(f64::from(k) / 11.0)).collect();
        let frictions: Vec<f64> = (0..=12).map(|k| 0.05 * f64::from(k)).collect();
        let anchored = plain.clone().with_anchors(&loads, &frictions);
        println!("{name}: {} anchors in {:.1?}", anchored.anchors(), begun.elapsed());
        let conditions: Vec<[f64; 2]> = (1..=CONDITIONS)
            .map(|k| [0.618_033_988_749_895, 0.754_877_666_246_693].map(|step| (k as f64 * step).fract()))
            .map(|[load, mu]| [50.0 * 40f64.powf(load), 0.6 * mu])
            .collect();
        let (mut fewest, mut most, mut worst) = (usize::MAX, 0, 0.0f64);
        for [load, mu] in &conditions {
            let state = anchored.state(*load, *mu).expect("a state");
            worst = worst.max(imbalance(&anchored, &state));
            fewest = fewest.min(state.pairs_closed());
            most = most.max(state.pairs_closed());
        }
        assert!(worst < 1e-11, "a state leaves {worst:e} of its equations");
        println!("{name}: {fewest} to {most} pairs closed, equations hold to {worst:.1e}");
        for (way, statics, among) in [("from anchors", &anchored, CONDITIONS), ("continued", &plain, 20)] {
            let timed = |[load, mu]: &[f64; 2]| {
                let begun = Instant::now();
                black_box(statics.state(black_box(*load), black_box(*mu))).expect("a state");
                begun.elapsed()
            };
            let [median, high] = spread(conditions.iter().take(among).map(timed).collect());
            println!("{name}, {way}: median {median:.2?}, 95 % {high:.2?}");
            if way == "from anchors" && std::env::var_os("SQUEALCAST_MEASURE").is_some() {
                assert!(median <= PROMISED, "{median:?}, promised {PROMISED:?}");
            }
        }
    }
}

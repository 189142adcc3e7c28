//! Results and output of the binary: exit codes, output, closed forms, the published nine-degree-of-freedom model.
//! Sessions are in `sessions.rs`.

use std::collections::BTreeMap;
use std::f64::consts::TAU;
use std::path::Path;

use crate::program::{self, command, files_below, folder, json, launch, number, run, text, write};
use faer::c64;
use serde_json::Value;

/// `f`, `σ` of every mode of a prediction, in its order.
fn modes(prediction: &Value) -> Vec<c64> {
    let modes = prediction["modes"].as_array().expect("modes");
    modes.iter().map(|mode| c64::new(number(mode, "growth_rate_per_s"), TAU * number(mode, "frequency_hz"))).collect()
}

// --- predict ---------------------------------------------------------------------------------------------------------

/// One coordinate, `λ² = -k`, written as kind 3 so that a test knows the exact result.
fn one_coordinate(directory: &Path, stiffness: f64) -> String {
    let entry = |value: f64| format!("%%MatrixMarket matrix coordinate real general\n1 1 1\n1 1 {value:e}\n");
    write(directory, "m.mtx", &entry(1.0));
    write(directory, "k.mtx", &entry(stiffness));
    let toml = "name = \"one\"\n[reference]\nnormal_load_n = 80.0\ndisc_speed_rad_s = -7.5\n\
                friction_coefficient = 0.125\n[system]\nmass = \"m.mtx\"\n[[system.stiffness]]\nmatrix = \"k.mtx\"\n";
    write(directory, "one.toml", toml)
}

#[test]
fn prediction_has_the_keys_of_its_description_in_their_order() {
    let run = run(["predict", "nine-dof", "--mu", "1", "--json"]).exits(0);
    let keys = |names: &[&str], text: &str| {
        let at: Vec<usize> = names.iter().map(|name| text.find(&format!("\"{name}\":")).expect(name)).collect();
        assert!(at.is_sorted(), "{names:?} in {text}");
    };
    let top = [
        "rig",
        "normal_load_n",
        "disc_speed_rad_s",
        "friction_coefficient",
        "unstable_modes",
        "max_growth_rate_per_s",
        "nonoscillatory_growth_per_s",
        "modes",
    ];
    let mode = ["id", "frequency_hz", "growth_rate_per_s", "damping_ratio", "pad_participation", "residual"];
    let names = |value: &Value| value.as_object().expect("an object").len();
    keys(&top, &run.stdout);
    let prediction = run.json();
    assert_eq!(names(&prediction), top.len());
    let modes = prediction["modes"].as_array().expect("modes");
    assert_eq!(modes.len(), 9);
    for each in modes {
        assert_eq!(names(each), mode.len(), "{each}");
    }
    keys(&mode, run.stdout.split_once("\"modes\":").expect("modes").1);
    assert!(run.stdout.ends_with("}\n") && run.stdout.lines().count() == 1, "one line of JSON");
}

#[test]
fn both_modes_of_a_flutter_pair_are_listed() {
    // Case 1 at μ = 1, 40-digit arithmetic on the layout of the published model: the pair 2+3 grows and decays with
    // ±0.014963798524463. Both halves come from one complex square root, so their sum is exactly 0.
    let prediction = json(["predict", "nine-dof", "--mu", "1", "--json"]);
    let pair = modes(&prediction);
    let (growing, decaying) = (pair[1], pair[2]);
    assert!((growing.re - 0.014963798524463069).abs() < 1e-12, "{growing}");
    assert_eq!((growing.re + decaying.re, growing.im - decaying.im), (0.0, 0.0));
    assert_eq!(prediction["unstable_modes"], 1);
    assert_eq!(number(&prediction, "max_growth_rate_per_s"), growing.re);
    for (index, mode) in prediction["modes"].as_array().expect("modes").iter().enumerate() {
        assert_eq!(mode["id"], index);
        let (root, share) = (pair[index], number(mode, "pad_participation"));
        let expected = -root.re / root.norm();
        assert!((number(mode, "damping_ratio") - expected).abs() <= 1e-15, "-σ/|λ| is {expected}: {mode}");
        assert!((0.0..=1.0).contains(&share), "{mode}");
        assert!((0.0..1e-9).contains(&number(mode, "residual")), "{mode}");
    }
}

#[test]
fn conditions_default_to_the_reference_of_the_rig() {
    let folder = folder();
    let rig = one_coordinate(folder.path(), 39.47841760435743); // (2π)²: 1 Hz
    let conditions = |prediction: &Value| {
        ["normal_load_n", "disc_speed_rad_s", "friction_coefficient"].map(|key| number(prediction, key))
    };
    let prediction = json(["predict", &rig, "--json"]);
    assert_eq!(prediction["rig"], "one");
    assert_eq!(conditions(&prediction), [80.0, -7.5, 0.125]);
    // Kind 3 does not distinguish pad and disc; JSON has no NaN.
    assert_eq!(prediction["modes"][0]["pad_participation"], Value::Null);
    // √((2π)²)/2π: two roundings.
    assert!((number(&prediction["modes"][0], "frequency_hz") - 1.0).abs() < 4.0 * f64::EPSILON);
    let given = json(["predict", &rig, "--json", "--mu", "0.5", "--load", "3", "--speed", "-1e3"]);
    assert_eq!(conditions(&given), [3.0, -1e3, 0.5]);
    // Without [reference]: the conditions of the paper's test.
    assert_eq!(conditions(&json(["predict", "nine-dof", "--json"])), [500.0, 13.0, 0.35]);
}

#[test]
fn static_divergence_is_reported_apart() {
    // λ² = 4: roots ±2, no mode.
    let folder = folder();
    let rig = one_coordinate(folder.path(), -4.0);
    let prediction = json(["predict", &rig, "--json"]);
    assert_eq!(prediction["modes"], serde_json::json!([]));
    assert_eq!(prediction["nonoscillatory_growth_per_s"], serde_json::json!([2.0, -2.0]));
    assert_eq!(prediction["unstable_modes"], 1);
    assert_eq!(number(&prediction, "max_growth_rate_per_s"), 2.0);
    run(["predict", &rig]).exits(0).says("do not oscillate").says("2.00000").says("1 unstable");
    let windows = json(["critical", &rig, "--json"]);
    assert_eq!(windows["critical_friction"], 0.0);
    assert_eq!(windows["windows"][0]["kind"], "divergence");
    assert_eq!(windows["windows"][0]["mu_to"], Value::Null);
}

#[test]
fn a_contact_that_does_not_slide_or_is_open_is_said() {
    let frequencies = |args: &[&str]| modes(&json(args.iter().chain(&["--json"])));
    // Slower than 0.01 rad/s μ counts as 0, for any given value.
    for speed in ["0", "0.0099", "-0.0099"] {
        let at_rest = ["predict", "nine-dof", "--mu", "1", "--speed", speed];
        run(at_rest).exits(0).says("not sliding: friction coefficient taken as 0").says("stable");
        assert_eq!(frequencies(&at_rest), frequencies(&["predict", "nine-dof", "--mu", "0"]));
    }
    assert!(!run(["predict", "nine-dof", "--speed", "0.01"]).exits(0).stdout.contains("not sliding"));
    // Without load there is no contact: pad and belt by themselves, every frequency known.
    // The belt of mass 1 and inertia J = 1/12 on unit springs, two of them at distance 1 from its centre:
    // ω² = 1 along, 2 up and down, 2/J = 24 in rotation.
    let open = ["predict", "nine-dof", "--mu", "1", "--load", "0"];
    run(open).exits(0).says("contact open: no normal load").says("stable");
    let squares: Vec<f64> = frequencies(&open).iter().map(|root| root.im * root.im).collect();
    for belt in [1.0, 2.0, 24.0] {
        let nearest = squares.iter().map(|square| (square - belt).abs()).fold(f64::INFINITY, f64::min);
        assert!(nearest < 1e-13, "{belt} among {squares:?}");
    }
    // The slider's stiffness has the trace 2+3+2+2.5+1.5+2 = 13 over unit masses. A few roundings of numbers up to 24.
    let sum: f64 = squares.iter().sum();
    assert!((sum - (13.0 + 27.0)).abs() < 1e-12, "{sum}");
    run(["critical", "nine-dof", "--load", "0"]).exits(0).says("contact open").says("stable for friction");
    run(["critical", "nine-dof", "--speed", "0"]).exits(0).says("not sliding").says("stable for friction");
}

#[test]
fn tables_are_readable() {
    let table = run(["predict", "nine-dof", "--mu", "1"]).exits(0);
    table.stdout.lines().for_each(|line| assert!(line.len() <= 100, "{line:?} is too wide for a terminal"));
    let table = table.says("nine-dof: 500 N, 13 rad/s, friction coefficient 1").says("Hz").says("1/s");
    let rows: Vec<Vec<&str>> = table.stdout.lines().map(|line| line.split_whitespace().collect()).collect();
    let row = rows.iter().find(|row| row.first() == Some(&"1")).expect("the row of mode 1");
    // 1.0720480358/2π = 0.17062174, of the growth rate 0.0149638 six digits.
    assert_eq!((row[1], row[2], row.last()), ("0.1706217", "0.0149638", Some(&"unstable")));
    assert_eq!(rows.iter().filter(|row| row.last() == Some(&"unstable")).count(), 1);
    table.says("1 unstable, growth up to 0.0149638 1/s");
    run(["critical", "nine-dof"]).exits(0).says("0.820014959382").says("> 20").says("coalescence").says("1 + 2");
    run(["critical", "nine-dof", "--mu-max", "0.5"]).exits(0).says("stable for friction coefficients 0 to 0.5");
    let check = run(["check", "nine-dof"]).exits(0).says("rig        nine-dof").says("inline substructures");
    check.says("reference  500 N, 13 rad/s, friction coefficient 0.35").says("hash");
}

// --- the published nine-degree-of-freedom model ----------------------------------------------------------------------

/// Roots `(σ, ω)` in rad/s, ascending in `ω`.
type Roots = &'static [(f64, f64)];

/// 40-digit arithmetic (mpmath) on the matrices of the published layout, written out from the forces of its two
/// contacts; rounds to every digit of the table of 30-digit values.
const NINE_DOF: [(&str, &str, Roots); 6] = [
    (
        "nine-dof",
        "0",
        &[
            (0.0, 1.0),
            (0.0, 1.0306861767630295),
            (0.0, 1.1013203230296684),
            (0.0, 1.3246755709716438),
            (0.0, 1.563283353418398),
            (0.0, 1.7812803146713165),
            (0.0, 2.0304365931028787),
            (0.0, 2.2387270725082846),
            (0.0, 5.497147270764995),
        ],
    ),
    (
        "nine-dof",
        "1",
        &[
            (0.0, 1.0),
            (0.014963798524463069, 1.0720480358282287),
            (-0.014963798524463069, 1.0720480358282287),
            (0.0, 1.3808511286776002),
            (0.0, 1.56976814436112),
            (0.0, 1.7717879299574766),
            (0.0, 1.999133465175448),
            (0.0, 2.231286550252419),
            (0.0, 5.496957816101588),
        ],
    ),
    (
        "nine-dof-case-2",
        "0",
        &[
            (0.0, std::f64::consts::FRAC_1_SQRT_2),
            (0.0, 1.0457777300238584),
            (0.0, 1.1742300588269627),
            (0.0, 1.4409235316516786),
            (0.0, 1.5686258315992319),
            (0.0, 2.0189225310442978),
            (0.0, 2.195947959195934),
            (0.0, 3.451513584584888),
            (0.0, 6.417125792305798),
        ],
    ),
    (
        "nine-dof-case-2",
        "1",
        &[
            (0.0, std::f64::consts::FRAC_1_SQRT_2),
            (0.0, 1.0896446964235529),
            (0.0, 1.1458810777882786),
            (0.0, 1.5087781368435127),
            (0.0, 1.5883495459682402),
            (0.1278043018290705, 2.093837252702476),
            (-0.1278043018290705, 2.093837252702476),
            (0.0, 3.4352070315777103),
            (0.0, 6.415923697524003),
        ],
    ),
    (
        "nine-dof-3+2",
        "1",
        &[
            (0.0, 1.0),
            (0.0072418787299962095, 1.07945537174139),
            (-0.0072418787299962095, 1.07945537174139),
            (0.0, 1.4528582385923043),
            (0.0, 2.160562175965508),
        ],
    ),
    (
        "nine-dof-4+2",
        "1",
        &[
            (0.0, 1.0),
            (0.011083507083587038, 1.0795918317539737),
            (-0.011083507083587038, 1.0795918317539737),
            (0.0, 1.4623978682498044),
            (0.0, 1.5595915445617359),
            (0.0, 2.124456580785755),
        ],
    ),
];

#[test]
fn nine_degrees_of_freedom_have_the_published_modes() {
    let mut worst = 0.0_f64;
    for (rig, mu, expected) in NINE_DOF {
        let found = modes(&json(["predict", rig, "--mu", mu, "--json"]));
        assert_eq!(found.len(), expected.len(), "{rig} at {mu}");
        for (found, &(sigma, omega)) in found.iter().zip(expected) {
            // The documented accuracy is 1e-9, relative. λ² rather than λ: the pairs are near their merging, where a backward
            // error ε moves λ by ε/|λ₁-λ₂|, and λ² = -κ is what is computed. Growth rates by themselves too: they
            // are 1e-2 of |λ| here, so 1e-9 of them is 1e-11 of |λ|, still far above ε/|λ₁-λ₂| = 1e-14.
            let (square, root) = (*found * *found, c64::new(sigma, omega));
            let off = (square - root * root).norm() / (omega * omega);
            let growth_off = (found.re - sigma).abs();
            worst = worst.max(off);
            assert!(off < 1e-9, "{rig} at {mu}: {found} instead of {root}");
            assert!(growth_off <= 1e-9 * sigma.abs(), "{rig} at {mu}: {found} instead of {root}");
        }
    }
    eprintln!("largest relative difference of λ²: {worst:.1e}");
}

#[test]
fn nine_degrees_of_freedom_have_the_published_critical_friction() {
    // 40-digit arithmetic: zeros of the discriminant of the merging pair; mode numbers from the same roots followed
    // from μ = 0, counted from 0. Every window is open at μ = 20, where the search ends.
    type Windows = &'static [(f64, [u32; 2])];
    let expected: [(&str, Windows); 6] = [
        ("nine-dof", &[(0.8200149593818505, [1, 2]), (2.8222527641081405, [4, 5])]),
        ("nine-dof-case-2", &[(0.35592805826057616, [5, 6]), (1.3372333350282244, [1, 2])]),
        ("nine-dof-3+2", &[(0.9676788485100156, [1, 2])]),
        ("nine-dof-4+2", &[(0.9298247003444502, [1, 2]), (1.2617465623040662, [3, 4])]),
        ("nine-dof-case-2-3+2", &[(1.7798814844071926, [1, 2])]),
        ("nine-dof-case-2-4+2", &[(1.6334209295657367, [1, 2]), (5.918481998361862, [4, 5])]),
    ];
    let mut worst = 0.0_f64;
    for (rig, expected) in expected {
        let found = json(["critical", rig, "--json"]);
        let windows = found["windows"].as_array().expect("windows");
        assert_eq!(windows.len(), expected.len(), "{rig}: {found}");
        assert_eq!(found["critical_friction"], windows[0]["mu_from"]);
        for (window, (mu, ids)) in windows.iter().zip(expected) {
            let keys: Vec<&String> = window.as_object().expect("an object").keys().collect();
            assert_eq!(keys, ["frequency_hz", "kind", "mode_ids", "mu_from", "mu_to"], "sorted by the reader");
            let off = (number(window, "mu_from") - mu).abs();
            worst = worst.max(off);
            // The documented accuracy is 1e-10.
            assert!(off < 1e-10, "{rig}: {window} instead of {mu}");
            assert_eq!(window["mode_ids"], serde_json::json!(ids), "{rig}: {window}");
            assert_eq!(window["mu_to"], Value::Null, "{rig}: open at 20: {window}");
            assert_eq!(window["kind"], "coalescence", "{rig}: {window}");
        }
        // At a merging point the frequency itself is good to √ε only; here the pair's mean is reported.
        let (from, hz) = (number(&windows[0], "mu_from"), number(&windows[0], "frequency_hz"));
        let near = modes(&json(["predict", rig, "--json", "--mu", &(from + 1e-7).to_string()]));
        let pair = near[expected[0].1[0] as usize];
        // dω/dμ of the mean is of the order of ω, so 1e-7 in μ leaves 1e-7 in ω.
        assert!((TAU * hz / pair.im - 1.0).abs() < 1e-6, "{rig}: {hz} Hz at {from}, {pair} near it");
    }
    eprintln!("largest difference of a critical friction coefficient: {worst:.1e}");
    // The search ends at the given limit.
    let short = json(["critical", "nine-dof", "--mu-max", "2", "--json"]);
    assert_eq!(short["windows"].as_array().expect("windows").len(), 1);
    assert_eq!(json(["critical", "nine-dof", "--mu-max", "0.8", "--json"])["critical_friction"], Value::Null);
    // The stated resolution: twenty halvings of the range.
    assert!(number(&short, "narrowest_window") <= 2.0 / 1e6, "{short}");
    assert_eq!(short["complete"], true);
}

// --- sweep -----------------------------------------------------------------------------------------------------------

/// `λ²` of each identity along a sweep, a map for every friction coefficient.
type Sweep = Vec<(f64, BTreeMap<u32, c64>)>;

fn read_sweep(csv: &str) -> Sweep {
    let mut lines = csv.lines();
    let header =
        "normal_load_n,disc_speed_rad_s,friction_coefficient,mode_id,frequency_hz,growth_rate_per_s,damping_ratio";
    assert_eq!(lines.next(), Some(header));
    let mut sweep: Sweep = vec![];
    for line in lines {
        let cells: Vec<f64> = line.split(',').map(|cell| cell.parse().expect(line)).collect();
        let &[load, speed, mu, id, hz, growth, damping] = cells.as_slice() else { panic!("seven cells: {line}") };
        assert_eq!((load, speed), (500.0, 13.0), "the reference of the rig");
        if sweep.last().is_none_or(|(last, _)| *last != mu) {
            sweep.push((mu, BTreeMap::new()));
        }
        let root = c64::new(growth, TAU * hz);
        assert!((damping + growth / root.norm()).abs() <= 1e-15, "-σ/|λ|: {line}");
        let modes = &mut sweep.last_mut().expect("just pushed").1;
        assert!(modes.insert(id as u32, root * root).is_none(), "identity twice: {line}");
    }
    sweep
}

/// Where two identities fit better the other way round: each extrapolated from two steps before, the next step
/// compared with both assignments. On the very step of a merging both fit equally well, and that is no swap.
fn swaps(sweep: &Sweep) -> Vec<(f64, u32, u32)> {
    let mut found = vec![];
    for steps in sweep.windows(3) {
        let [(_, before), (_, now), (mu, next)] = steps else { continue };
        let off = |as_id: u32, id: u32| Some((next.get(&id)? - (2.0 * now.get(&as_id)? - before.get(&as_id)?)).norm());
        for &a in next.keys() {
            for &b in next.keys().filter(|&&b| b > a) {
                let both = |x: Option<f64>, y: Option<f64>| Some(x? + y?);
                let (Some(kept), Some(swapped)) = (both(off(a, a), off(b, b)), both(off(a, b), off(b, a))) else {
                    continue;
                };
                if kept > swapped * (1.0 + 1e-9) + 1e-9 {
                    found.push((*mu, a, b));
                }
            }
        }
    }
    found
}

fn exchange(sweep: &Sweep, from: f64, a: u32, b: u32) -> Sweep {
    let mut sweep = sweep.clone();
    for (_, modes) in sweep.iter_mut().filter(|(mu, _)| *mu >= from) {
        let (at_a, at_b) = (modes[&a], modes[&b]);
        modes.extend([(a, at_b), (b, at_a)]);
    }
    sweep
}

#[test]
fn the_sweep_of_case_1_keeps_every_identity() {
    let folder = folder();
    let (csv, svg) = (text(&folder.path().join("sweep.csv")), text(&folder.path().join("sweep.svg")));
    run(["sweep", "nine-dof", "--mu", "0:20:0.01", "--csv", &csv, "--svg", &svg]).exits(0);
    let sweep = read_sweep(&std::fs::read_to_string(&csv).expect("the CSV file"));
    assert_eq!(sweep.len(), 2001);
    assert!(sweep.iter().all(|(_, modes)| modes.keys().copied().eq(0..9)), "nine modes at every step");
    assert!(sweep.iter().enumerate().all(|(k, (mu, _))| (mu - 0.01 * k as f64).abs() < 1e-12));

    // Continuity: λ² of a mode, and mean and discriminant ((z₁-z₂)/2)² of a merging pair, are analytic in μ, right
    // through the mergings. Second differences are h² times a second derivative: with h = 0.01, 1e-4 of the quantity
    // where the derivative is as large as the quantity. A jump to another mode is 6e-2 of λ² at least, the smallest
    // distance of two modes that never merge (modes 0 and 1 at μ = 0: 1 and 1.0307 rad/s).
    let pairs = [(1, 2), (4, 5)]; // those of the two windows
    type Of<'a> = &'a dyn Fn(&BTreeMap<u32, c64>) -> c64;
    let smooth = |name: &str, value: Of<'_>, scale: Of<'_>| {
        for steps in sweep.windows(3) {
            let [a, b, c] = [0, 1, 2].map(|k| value(&steps[k].1));
            let bend = (a - 2.0 * b + c).norm() / scale(&steps[1].1).norm();
            assert!(bend < 1e-4, "{name} bends by {bend:e} at {}", steps[1].0);
        }
    };
    for id in [0, 3, 6, 7, 8] {
        smooth(&format!("mode {id}"), &|modes| modes[&id], &|modes| modes[&id]);
    }
    for (a, b) in pairs {
        let mean = |modes: &BTreeMap<u32, c64>| 0.5 * (modes[&a] + modes[&b]);
        let half = |modes: &BTreeMap<u32, c64>| 0.5 * (modes[&a] - modes[&b]);
        smooth(&format!("mean of {a} and {b}"), &mean, &mean);
        let square_of = |of: c64| of * of;
        smooth(&format!("discriminant of {a} and {b}"), &|m| square_of(half(m)), &|m| square_of(mean(m)));
    }
    assert_eq!(swaps(&sweep), [], "identities swapped");

    // The published third "bifurcation" at 14.6 is a crossing of the pair 5+6 with mode 7 (40-digit arithmetic:
    // 14.5984045): identities 4+5 and 6. Between two steps frequencies are straight to h²/8 ω'' = 1e-7.
    let omega = |modes: &BTreeMap<u32, c64>, id: u32| {
        let square = modes[&id];
        (0.5 * (square.norm() - square.re)).sqrt() // Im √z
    };
    let above = |modes: &BTreeMap<u32, c64>| omega(modes, 6) - omega(modes, 4);
    let crossings: Vec<f64> = sweep
        .windows(2)
        .filter(|steps| above(&steps[0].1) * above(&steps[1].1) < 0.0)
        .map(|steps| {
            let (left, right) = (above(&steps[0].1), above(&steps[1].1));
            steps[0].0 + (steps[1].0 - steps[0].0) * left / (left - right)
        })
        .collect();
    assert_eq!(crossings.len(), 1, "{crossings:?}");
    assert!((crossings[0] - 14.5984045).abs() < 1e-5, "{crossings:?}");
    for (mu, modes) in &sweep {
        // Beyond its critical friction each pair stays coupled, the lower number growing; all others are neutral.
        for ((a, b), critical) in pairs.into_iter().zip([0.82001495938185, 2.8222527641081]) {
            let coupled = modes[&a].im > 0.0 && modes[&b] == modes[&a].conj();
            assert_eq!(coupled, *mu > critical, "{a} and {b} at {mu}");
        }
        assert!([0, 3, 6, 7, 8].iter().all(|id| modes[id].im == 0.0), "at {mu}");
    }

    // The check above would see a swap: at the crossing, in the open, and of two halves of a pair.
    for (from, a, b) in [(14.595, 4, 6), (14.595, 5, 6), (14.605, 4, 6), (7.005, 6, 7), (7.005, 0, 3), (9.005, 1, 2)] {
        let found = swaps(&exchange(&sweep, from, a, b));
        let expected = (from + 0.005, a, b);
        let seen = found.iter().any(|&(mu, x, y)| (x, y) == (a, b) && (mu - expected.0).abs() < 1e-9);
        assert!(seen, "exchanged {a} and {b} from {from}: {found:?}");
    }

    let svg = std::fs::read_to_string(&svg).expect("the SVG file");
    let elements = well_formed(&svg);
    assert!(svg.contains("frequency, Hz") && svg.contains("growth rate, 1/s") && svg.contains("friction coefficient"));
    assert!(svg.contains("nine-dof, 500 N, 13 rad/s"), "the title says what was swept");
    assert!(elements["polyline"] >= 18, "a curve for each mode in both panels: {elements:?}");
}

/// Checks that elements of an XML document nest and attributes are quoted; how often each element occurs.
fn well_formed(xml: &str) -> BTreeMap<String, usize> {
    let (mut open, mut count, mut roots) = (vec![], BTreeMap::new(), 0);
    let mut rest = xml;
    while let Some(start) = rest.find('<') {
        let (before, after) = rest.split_at(start);
        assert!(!before.contains('>'), "a stray > in {before:?}");
        assert!(before.split('&').skip(1).all(|e| e.find(';').is_some_and(|end| end < 8)), "a bare & in {before:?}");
        let end = after.find('>').expect("a tag is closed");
        let tag = &after[1..end];
        rest = &after[end + 1..];
        if tag.starts_with(['?', '!']) {
            continue;
        }
        if let Some(name) = tag.strip_prefix('/') {
            assert_eq!(open.pop().as_deref(), Some(name.trim()), "nesting");
            continue;
        }
        let name = tag.split([' ', '\n', '\t', '/']).next().expect("a name").to_owned();
        assert_eq!(tag.matches('"').count() % 2, 0, "quotes of <{tag}>");
        assert!(!name.is_empty() && tag.matches('=').count() <= tag.matches('"').count() / 2, "attributes of <{tag}>");
        roots += usize::from(open.is_empty());
        *count.entry(name.clone()).or_insert(0) += 1;
        if !tag.ends_with('/') {
            open.push(name);
        }
    }
    assert_eq!((open, roots), (vec![], 1), "one root, everything closed");
    assert!(xml.trim_start().starts_with("<svg") || xml.starts_with("<?xml"));
    count
}

#[test]
fn a_sweep_prints_csv_or_writes_the_requested_files() {
    let printed = run(["sweep", "nine-dof", "--mu", "0.3:0.4:0.05"]).exits(0);
    let sweep = read_sweep(&printed.stdout);
    let steps: Vec<f64> = sweep.iter().map(|(mu, _)| *mu).collect();
    assert_eq!(steps, [0.3, 0.35, 0.4], "both ends, each step by itself");
    // A sweep and a prediction are the same solve: the same bits.
    let predicted = modes(&json(["predict", "nine-dof", "--mu", "0.35", "--json"]));
    let swept: Vec<c64> = sweep[1].1.values().copied().collect();
    assert_eq!(swept, predicted.iter().map(|root| *root * *root).collect::<Vec<_>>());

    let folder = folder();
    let svg = text(&folder.path().join("only.svg"));
    let drawn = run(["sweep", "nine-dof", "--mu", "-1:1:0.1", "--svg", &svg]).exits(0);
    assert_eq!(drawn.stdout, "", "a figure was asked for, no table");
    drawn.complains("only.svg: 1 window of instability");
    well_formed(&std::fs::read_to_string(&svg).expect("the SVG file"));
    assert_eq!(files_below(folder.path()).len(), 1, "no other file is left");
    run(["sweep", "nine-dof", "--csv", "/nowhere/at/all.csv"]).exits(1).complains("/nowhere/at/");
}

// --- closed forms ----------------------------------------------------------------------------------------------------

/// Hultén's two modes as kind 3: `K = [[ω1², -μω2²], [μω1², ω2²]]`, `C = diag(η1 ω1, η2 ω2)`.
fn hulten(directory: &Path, omega: [f64; 2], eta: [f64; 2]) -> String {
    let matrix = |name: &str, entries: &[(usize, usize, f64)]| {
        let mut text = format!("%%MatrixMarket matrix coordinate real general\n2 2 {}\n", entries.len());
        entries.iter().for_each(|(row, column, value)| text += &format!("{row} {column} {value:e}\n"));
        write(directory, name, &text);
    };
    let squares = omega.map(|omega| omega * omega);
    matrix("m.mtx", &[(1, 1, 1.0), (2, 2, 1.0)]);
    matrix("k.mtx", &[(1, 1, squares[0]), (2, 2, squares[1])]);
    matrix("friction.mtx", &[(1, 2, -squares[1]), (2, 1, squares[0])]);
    matrix("c.mtx", &[(1, 1, eta[0] * omega[0]), (2, 2, eta[1] * omega[1])]);
    let toml = "name = \"hulten\"\n[system]\nmass = \"m.mtx\"\n[[system.stiffness]]\nmatrix = \"k.mtx\"\n\
                [[system.stiffness]]\nmatrix = \"friction.mtx\"\nscale = \"friction_coefficient\"\n\
                [[system.damping]]\nmatrix = \"c.mtx\"\n";
    write(directory, "hulten.toml", toml)
}

#[test]
fn hulten_modes_merge_at_the_closed_form() {
    // Undamped, with a = ω1², b = ω2²: κ² - (a+b)κ + ab(1+μ²) = 0 has a double root at μ = (a-b)/(2√(ab));
    // 100 and 75 Hz: 4375/15000. The double root is (a+b)/2: 88.3883 Hz.
    let folder = folder();
    let rig = hulten(folder.path(), [TAU * 100.0, TAU * 75.0], [0.0, 0.0]);
    for rig in [rig, launch("hulten.toml")] {
        let found = json(["critical", &rig, "--json"]);
        assert!((number(&found, "critical_friction") - 4375.0 / 15000.0).abs() < 1e-10, "{found}");
        let window = &found["windows"][0];
        assert_eq!((&window["kind"], &window["mu_to"]), (&"coalescence".into(), &Value::Null));
        let expected = 0.5_f64.sqrt() * 100.0_f64.hypot(75.0);
        // The mean of a merging pair has full accuracy: 1e-10 as for the place itself.
        assert!((number(window, "frequency_hz") / expected - 1.0).abs() < 1e-10, "{found}");
    }
}

#[test]
fn damping_destabilises_hulten_modes_as_routh_and_hurwitz_say() {
    // (s² + c1 s + a)(s² + c2 s + b) + μ² a b = s⁴ + A s³ + B s² + C s + D, stable while A B C > C² + A² D, where
    // A = c1 + c2, B = a + b + c1 c2, C = c1 b + c2 a, D = a b (1 + μ²). On the limit s² = -C/A.
    for (eta, printed, file) in [
        ([0.02, 0.02], 0.289367125523, "hulten-damped.toml"),
        ([0.02, 0.10], 0.242851633666, "hulten-unequally-damped.toml"),
        ([0.10, 0.02], f64::NAN, ""),
    ] {
        let omega = [TAU * 100.0, TAU * 75.0];
        let (a, b) = (omega[0] * omega[0], omega[1] * omega[1]);
        let [c1, c2] = [eta[0] * omega[0], eta[1] * omega[1]];
        let (sum, middle, cross) = (c1 + c2, a + b + c1 * c2, c1 * b + c2 * a);
        let last = (sum * middle * cross - cross * cross) / (sum * sum);
        let expected = (last / (a * b) - 1.0).sqrt();
        let expected_hz = (cross / sum).sqrt() / TAU;
        assert!(printed.is_nan() || (expected - printed).abs() < 1e-12, "{expected}");
        // Below the undamped 0.2916667: damping destabilises.
        assert!(expected < 4375.0 / 15000.0);
        let folder = folder();
        let mut rigs = vec![hulten(folder.path(), omega, eta)];
        rigs.extend((!file.is_empty()).then(|| launch(file)));
        for rig in rigs {
            let found = json(["critical", &rig, "--json"]);
            // The documented accuracy of every end of a window is 1e-10.
            assert!((number(&found, "critical_friction") - expected).abs() < 1e-10, "{found} instead of {expected}");
            let window = &found["windows"][0];
            assert_eq!(window["kind"], "zero_growth");
            assert!((number(window, "frequency_hz") / expected_hz - 1.0).abs() < 1e-9, "{found}");
            // The growth rate changes its sign there; at a distance of 1e-4 |σ| is about 0.01 1/s, far above rounding.
            for (near, unstable) in [(-1e-4, 0), (1e-4, 1)] {
                let mu = (expected + near).to_string();
                assert_eq!(json(["predict", &rig, "--mu", &mu, "--json"])["unstable_modes"], unstable);
            }
        }
    }
}

#[test]
fn hoffmann_modes_merge_at_the_closed_form() {
    // One mass on a rigid belt: k11 = 1.5, k12 = 0.75, k22 = 0.5 plus the contact 4/3. The belt lies towards +y, so
    // N = 4/3 y and the friction μN on x makes K = [[3/2, 3/4 - 4μ/3], [3/4, 11/6]]. Its eigenvalues merge where
    // ((3/2 - 11/6)/2)² + 3/4 (3/4 - 4μ/3) = 0: μ = 1/36 + 9/16 = 0.5902777778, at λ² = -(3/2 + 11/6)/2 = -5/3.
    let expected = 1.0 / 36.0 + 9.0 / 16.0;
    let folder = folder();
    let toml = "name = \"hoffmann\"\n[pad]\nmass = [[1.0, 0.0], [0.0, 1.0]]\nstiffness = [[1.5, 0.75], [0.75, 0.5]]\n\
                [[contact]]\npad_normal = [0.0, -1.0]\npad_sliding = [1.0, 0.0]\n\
                stiffness_n_per_m = 1.3333333333333333\n";
    for rig in [write(folder.path(), "hoffmann.toml", toml), launch("hoffmann.toml")] {
        let found = json(["critical", &rig, "--json"]);
        assert!((number(&found, "critical_friction") - expected).abs() < 1e-10, "{found}");
        let omega = TAU * number(&found["windows"][0], "frequency_hz");
        assert!((omega * omega - 5.0 / 3.0).abs() < 1e-10, "{found}");
        // Turning the other way reverses the sliding direction: K12 = 3/4 + 4μ/3 > 0, real for every μ.
        let reversed = json(["critical", &rig, "--speed", "-13", "--json"]);
        assert_eq!(reversed["critical_friction"], Value::Null, "{reversed}");
        // λ² at μ = 1/2 by hand: -(5/3 ∓ √(1/36 + 3/4 (3/4 - 2/3))) = -(5/3 ∓ √13/12); a few roundings of numbers near 2.
        let found = modes(&json(["predict", &rig, "--mu", "0.5", "--json"]));
        let half_gap = 13.0_f64.sqrt() / 12.0;
        for (root, expected) in found.iter().zip([5.0 / 3.0 - half_gap, 5.0 / 3.0 + half_gap]) {
            assert!((root.im * root.im - expected).abs() < 1e-14, "{root}: {expected}");
        }
    }
}

#[test]
fn a_mode_that_grows_out_of_the_band_ends_its_window_there_or_not_at_all() {
    // One coordinate, C = -2 (μ - 0.1), K = k (1 + μ), k = (2π 100)²: σ = μ - 0.1 grows for all μ > 0.1, and
    // ω² = k (1 + μ) - σ² passes the band's 120 Hz where σ² - k σ + (ω² - 1.1 k) = 0.
    let folder = folder();
    let entry = |value: f64| format!("%%MatrixMarket matrix coordinate real general\n1 1 1\n1 1 {value:e}\n");
    let (k, limit) = ((TAU * 100.0).powi(2), (TAU * 120.0).powi(2));
    for (name, value) in [("m.mtx", 1.0), ("k.mtx", k), ("c.mtx", -2.0)] {
        write(folder.path(), name, &entry(value));
    }
    let toml = "name = \"band\"\n[band]\nmax_hz = 120.0\n[system]\nmass = \"m.mtx\"\n\
                [[system.stiffness]]\nmatrix = \"k.mtx\"\nscale = \"1 + friction_coefficient\"\n\
                [[system.damping]]\nmatrix = \"c.mtx\"\nscale = \"friction_coefficient - 0.1\"\n";
    let found = json(["critical", &write(folder.path(), "band.toml", toml), "--json"]);
    assert_eq!(found["windows"].as_array().map(Vec::len), Some(1), "{found}");
    // The documented accuracy of both ends is 1e-10.
    assert!((number(&found, "critical_friction") - 0.1).abs() < 1e-10, "{found}");
    // The smaller root, written without cancellation.
    let rest = limit - 1.1 * k;
    let leaves = 0.1 + 2.0 * rest / (k + (k * k - 4.0 * rest).sqrt());
    let end = found["windows"][0]["mu_to"].as_f64();
    assert!(end.is_none_or(|end| (end - leaves).abs() < 1e-10), "ends at {end:?}, leaves the band at {leaves}");
}

// --- exit codes ------------------------------------------------------------------------------------------------------

#[test]
fn failures_end_with_1_and_name_the_file() {
    let folder = folder();
    let missing = text(&folder.path().join("missing.toml"));
    let broken = write(folder.path(), "broken.toml", "name = \"broken\"\nsurprise = 1\n");
    for command in ["predict", "sweep", "critical", "check", "run", "demo"] {
        let failed = run([command, &missing]).exits(1).complains("missing.toml");
        assert_eq!(failed.stdout, "", "{command}");
        assert_eq!(failed.stderr.matches("os error").count(), 1, "the reason appears once: {}", failed.stderr);
        run([command, &broken]).exits(1).complains("broken.toml").complains("surprise");
        // A name that is neither a file nor embedded: the message says which names there are.
        run([command, "nine-dofs"]).exits(1).complains("nine-dofs").complains("nine-dof-case-2");
    }
    run(["predict", "nine-dof", "--load", "1e999"]).exits(2);
    for command in [&["replay", "--verify"][..], &["recover"], &["import", "-o", "x.mcap"]] {
        let failed = run(command.iter().copied().chain([missing.as_str()])).exits(1).complains("missing.toml");
        assert_eq!(failed.stderr.matches("os error").count(), 1, "the reason appears once: {}", failed.stderr);
    }
    run(["replay", "--verify", &broken]).exits(1).complains("broken.toml").complains("MCAP");
    run(["simulate", "--profile", &missing, "--no-ros", "--no-shm"]).exits(1).complains("missing.toml");
    let empty = text(folder.path().join("empty").as_path());
    std::fs::create_dir(&empty).expect("a folder");
    run(["replay", "--verify", &empty]).exits(1).complains("empty");
    // Nothing to work with, where something is needed.
    run(["simulate", "--no-ros", "--no-shm"]).exits(1).complains("--no-shm").complains("--no-ros");
}

#[test]
fn wrong_usage_ends_with_2() {
    let record = ["simulate", "--record", "somewhere"];
    for args in [
        &[][..],
        &["predicts"],
        &["predict"],
        &["predict", "nine-dof", "--friction", "0.3"],
        &["predict", "nine-dof", "--mu"],
        &["predict", "nine-dof", "--mu", "NaN"],
        &["predict", "nine-dof", "--mu", "inf"],
        &["predict", "nine-dof", "--load", "-inf"],
        &["predict", "nine-dof", "--speed", "fast"],
        &["sweep", "nine-dof", "--mu", "0:1"],
        &["sweep", "nine-dof", "--mu", "0:1:0"],
        &["sweep", "nine-dof", "--mu", "1:0:0.1"],
        &["sweep", "nine-dof", "--mu", "0:1:-0.1"],
        &["sweep", "nine-dof", "--mu", "0:NaN:0.1"],
        &["sweep", "nine-dof", "--mu", "0:1:1e-9"],
        &["critical", "nine-dof", "--mu-max", "nan"],
        &["critical", "nine-dof", "--mu-max=-1"],
        &["simulate", "--rate", "0"],
        &["simulate", "--rate", "NaN"],
        &["simulate", "--rate", "1e6"],
        &["simulate", "--seed", "-1"],
        &["simulate", "--duration=-1"],
        &record,
        &["demo", "--rate=-5"],
        &["demo", "--duration=-1"],
        &["run", "nine-dof", "--domain", "233"],
        &["run", "nine-dof", "--domain", "-1"],
        &["replay", "x", "--rig", "nine-dof"],
        &["replay", "x", "--rate", "0"],
        &["replay", "x", "--start-offset=-1"],
        &["replay", "x", "--playback-duration=-1"],
        &["replay", "x", "--topics", "/other"],
        &["import", "x"],
        &["import", "x", "-o", "y", "--decimal", ";"],
        &["import", "x", "-o", "y", "--column", "time_s"],
        &["import", "x", "-o", "y", "--column", "temperature=T"],
        &["completions", "tcsh"],
        &["study"],
        &["study", "x"],
        &["study", "x", "-o", "y", "--shard", "0/3"],
        &["study", "x", "-o", "y", "--threads", "0"],
        &["study", "merge", "-o", "y"],
        &["study", "figure", "x", "--x", "case", "-o", "y"],
        &["run", "nine-dof", "--ros-args", "-r"],
    ] {
        let failed = run(args);
        assert_eq!(failed.code, 2, "{args:?}: {}{}", failed.stdout, failed.stderr);
        assert_eq!(failed.stdout, "", "{args:?}");
        assert!(!failed.stderr.is_empty(), "{args:?}");
    }
    run(["predict", "nine-dof", "--mu", "NaN"]).exits(2).complains("--mu").complains("not finite");
    run(["sweep", "nine-dof", "--mu", "1:0:0.1"]).exits(2).complains("FROM").complains("STEP");
}

#[test]
fn a_reader_that_has_gone_away_is_no_error() {
    for args in [
        &["sweep", "nine-dof", "--mu", "0:20:0.01"][..], // 850 kB, far more than a pipe holds
        &["predict", "nine-dof", "--json"],
        &["check", "nine-dof"],
        &["completions", "bash"],
        &["--help"],
    ] {
        let mut command = command(args);
        let mut child = command
            .stdout(std::process::Stdio::piped())
            .stderr(std::process::Stdio::piped())
            .spawn()
            .expect("it starts");
        drop(child.stdout.take());
        let ended = program::ended(child.wait_with_output().expect("it ends"));
        assert_eq!(ended.exits(0).stderr, "", "{args:?}");
    }
}

#[test]
fn help_states_units() {
    run(["--version"]).exits(0).says("squealcast ");
    let flat = |command: &str| {
        let help = run([command, "--help"]).exits(0).stdout;
        help.split_whitespace().collect::<Vec<_>>().join(" ")
    };
    let conditions = ["--load <N> Normal load in N", "--speed <RAD_S> Disc speed in rad/s"];
    let friction = "--mu <MU> Friction coefficient";
    let seconds = ["--rate <HZ> Measurements per second", "--duration <S> Stop after this many seconds"];
    for (command, expected) in [
        ("predict", &[conditions[0], conditions[1], friction][..]),
        ("sweep", &[conditions[0], conditions[1], "--mu <FROM:TO:STEP> Friction coefficients"]),
        ("critical", &[conditions[0], conditions[1], "--mu-max <MU> Search friction coefficients from 0"]),
        ("simulate", &seconds),
        ("demo", &seconds),
        ("run", &["--domain <N> ROS 2 domain, 0 to 232", "--loopback"]),
        (
            "replay",
            &["--start-offset <S> Recorded seconds", "--playback-duration <S> Recorded seconds", "2 plays twice"],
        ),
        ("import", &["normal_load_n", "disc_speed_rad_s", "friction_coefficient", "time_s", "units in their names"]),
        ("recover", &["Repair an interrupted recording"]),
        ("check", &["Rig file, full model, or the name of an embedded rig"]),
        ("identify", &["--targets <FREQ.csv>", "`frequency_hz`", "--load <N> Normal load in N"]),
        ("full", &["--load <N> Normal load in N", "--speed <RAD_S> Disc speed in rad/s", "--band-hz <HZ>"]),
        ("verify", &["--against <FULL.toml>", "Highest frequency in Hz"]),
        ("reduce", &["--modes <I+J>", "--cutoff-hz [<HZ>]", "--range <mu=A:B,speed=A:B,load=A:B>"]),
        ("tribometer", &["--dof <N> Degrees of freedom"]),
        ("study", &["--shard <I/N>", "merge", "figure", "--memory-gib <GIB>", "launch/study/README.md"]),
        ("reproduce", &["--dof <N> Degrees of freedom of the tribometer", "--output <DIR>"]),
        ("completions", &["bash", "fish", "zsh"]),
    ] {
        let help = flat(command);
        for text in expected {
            assert!(help.contains(text), "{command} --help says no {text:?}: {help}");
        }
    }
    // Every command of the overview was looked at.
    run(["--help"]).exits(0).says("demo").says("Usage: squealcast <COMMAND>");
}

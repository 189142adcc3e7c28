//! Rigs of kind 2: residual flexibility of the truncated modes, and modes from Universal Files.

use std::path::Path;
use std::process::Command;

use crate::program::side::{Side, archive};
use crate::program::{self, python, rig_file as file};
use faer::Mat;
use faer::linalg::solvers::Solve;
use squealcast::physics::chart::Scratch;
use squealcast::physics::chart::build::build;
use squealcast::physics::{OperatingPoint, Solver, StabilityMap, Traces, Vectors, sensitivity};
use squealcast::rig::{ModalData, Rig, npz, uff};
use squealcast::session::{chart_options, map_options};

fn matrices(rig: &Rig, mu: f64) -> [Mat<f64>; 2] {
    let n = rig.model.dimension();
    let (mut stiffness, mut damping) = (Mat::zeros(n, n), Mat::zeros(n, n));
    let p = OperatingPoint { disc_speed_rad_s: mu.signum(), ..rig.reference.with_friction(mu.abs()) };
    rig.model.assemble(&p, &mut stiffness, &mut damping).unwrap();
    [stiffness, damping]
}

/// The same side with its nodes in another order.
fn permuted(side: &Side) -> Side {
    let count = side.nodes.len();
    let order: Vec<usize> = (0..count).map(|k| (7 * k + 3) % count).collect();
    Side {
        nodes: order.iter().map(|&node| side.nodes[node]).collect(),
        omega: side.omega.clone(),
        phi: order.iter().flat_map(|&node| (0..3).map(move |axis| side.phi[3 * node + axis].clone())).collect(),
    }
}

const ALL: [usize; 2] = [9, 8];
const KEPT: [usize; 2] = [5, 4];

/// A pad whose nodes lie between those of the disc, but for one that coincides.
fn pad() -> Side {
    let nodes = vec![
        [0.10, 0.0, 0.01],
        [0.108, 0.001, 0.01],
        [0.102, 0.009, 0.01],
        [0.109, 0.0105, 0.01],
        [0.111, 0.006, 0.01],
    ];
    Side::new(nodes, ALL[0], 1000.0, 0.3)
}

fn disc() -> Side {
    let at = |i: usize, j: usize| [0.09 + 0.01 * i as f64, -0.008 + 0.008 * j as f64, 0.01];
    // 11 nodes: coprime with the step of the permutation.
    let nodes = (0..4).flat_map(|i| (0..3).map(move |j| at(i, j))).take(11).collect();
    Side::new(nodes, ALL[1], 1300.0, 1.1)
}

fn toml(more: &str) -> String {
    format!(
        "name = \"modal\"\n{more}\n[[contact_patch]]\naxis_point_m = [0.0, 0.0, 0.0]\naxis_direction = [0.0, 0.1, 2.0]\n\
         normal = [0.1, 0.0, 1.0]\nstiffness_n_per_m = 2e6\ndamping_n_s_per_m = 30.0\n"
    )
}

const SIDES: &str = "[pad]\nmodal = \"pad.npz\"\n[disc]\nmodal = \"disc.npz\"";

fn rig(more: &str, pad: Vec<u8>, disc: Vec<u8>) -> Rig {
    let files = [file("modal.toml", toml(&format!("{SIDES}\n{more}"))), file("pad.npz", pad), file("disc.npz", disc)];
    Rig::from_files(&files).unwrap_or_else(|error| panic!("{error}"))
}

/// The rig of [`KEPT`] modes and the residual of the others.
fn reduced(more: &str, inertia: bool) -> Rig {
    rig(more, pad().archive(KEPT[0], true, inertia), disc().archive(KEPT[1], true, inertia))
}

/// `K`, `M` and `C` of the rig of all modes when those beyond [`KEPT`] follow the others statically, by block elimination.
fn condensed(mu: f64) -> [Mat<f64>; 3] {
    let all = rig("", pad().archive(ALL[0], false, false), disc().archive(ALL[1], false, false));
    let [stiffness, damping] = matrices(&all, mu);
    let is_kept = |k: usize| if k < ALL[0] { k < KEPT[0] } else { k - ALL[0] < KEPT[1] };
    let (kept, rest): (Vec<usize>, Vec<usize>) = (0..ALL[0] + ALL[1]).partition(|&k| is_kept(k));
    let part = |m: &Mat<f64>, rows: &[usize], columns: &[usize]| {
        Mat::from_fn(rows.len(), columns.len(), |i, j| m[(rows[i], columns[j])])
    };
    let inverse = part(&stiffness, &rest, &rest).partial_piv_lu().solve(Mat::<f64>::identity(rest.len(), rest.len()));
    let right = -(&inverse * part(&stiffness, &rest, &kept));
    let left = -(part(&stiffness, &kept, &rest) * &inverse);
    let seen = |m: &Mat<f64>| {
        part(m, &kept, &kept)
            + part(m, &kept, &rest) * &right
            + &left * part(m, &rest, &kept)
            + &left * part(m, &rest, &rest) * &right
    };
    let mass = Mat::<f64>::identity(kept.len(), kept.len()) + &left * &right;
    [part(&stiffness, &kept, &kept) + part(&stiffness, &kept, &rest) * &right, mass, seen(&damping)]
}

fn assert_same(found: &Mat<f64>, expected: &Mat<f64>, tolerance: f64, what: &str) {
    let error = (found - expected).norm_max() / expected.norm_max();
    assert!(error < tolerance, "{what}: {error:e}");
}

#[test]
fn modes_left_out_follow_statically_through_triads_and_interpolation() {
    // The lower cut-off is 4 * 1300 rad/s, 827.6 Hz, but the pad's fifth mode is lower: 795.8 Hz.
    let half = reduced("[band]\nmax_hz = 390.0", true);
    let above_half = reduced("[band]\nmax_hz = 410.0", true);
    let without = reduced("[band]\nmax_hz = 390.0", false);
    assert!(
        half.describe().contains("of pad and disc, with the inertial term; cut-off 795.8 Hz"),
        "{}",
        half.describe()
    );
    assert!(above_half.describe().contains("without the inertial term (the band is above 0.5 of the cut-off)"));
    assert!(without.describe().contains("no inertial term given"), "{}", without.describe());
    assert_eq!((half.band_max_hz, above_half.band_max_hz), (Some(390.0), Some(410.0)));
    for mu in [0.0, 0.3, 1.1, 2.0, -0.7] {
        let [stiffness, mass, damping] = condensed(mu);
        let solver = mass.partial_piv_lu();
        let [k, c] = matrices(&half, mu);
        // The expansion over friction is cut where its last coefficients fall below 1e-9.
        assert_same(&k, &solver.solve(&stiffness), 1e-8, "M^-1 K");
        assert_same(&c, &solver.solve(&damping), 1e-8, "M^-1 C");
        for rig in [&above_half, &without] {
            let [k, c] = matrices(rig, mu);
            assert_same(&k, &stiffness, 1e-8, "K");
            assert_same(&c, &damping, 1e-8, "C");
        }
    }
    // Without residual flexibility the contact is much too stiff: the test can fail.
    let plain = rig("", pad().archive(KEPT[0], false, false), disc().archive(KEPT[1], false, false));
    let [plain, _] = matrices(&plain, 0.3);
    assert!((&plain - &condensed(0.3)[0]).norm_max() > 0.01 * plain.norm_max());
}

#[test]
fn a_selection_puts_the_other_modes_into_the_residual() {
    let archive = |kept: [usize; 2]| [pad().archive(kept[0], true, true), disc().archive(kept[1], true, true)];
    let [pad_more, disc_more] = archive([7, 8]);
    let sides = "[pad]\nmodal = \"pad.npz\"\nmodes = 5\n[disc]\nmodal = \"disc.npz\"\nmodes = [0, 1, 2, 3]\n[band]\nmax_hz = 300.0";
    let selected =
        Rig::from_files(&[file("modal.toml", toml(sides)), file("pad.npz", pad_more), file("disc.npz", disc_more)])
            .unwrap();
    let direct = reduced("[band]\nmax_hz = 300.0", true);
    for mu in [0.0, 0.8] {
        for (found, expected) in matrices(&selected, mu).iter().zip(matrices(&direct, mu)) {
            assert_same(found, &expected, 1e-12, "selected");
        }
    }
}

#[test]
fn the_order_of_nodes_means_nothing() {
    let band = "[band]\nmax_hz = 300.0";
    let permuted =
        rig(band, permuted(&pad()).archive(KEPT[0], true, true), permuted(&disc()).archive(KEPT[1], true, true));
    let direct = reduced(band, true);
    for mu in [0.0, 0.8] {
        for (found, expected) in matrices(&permuted, mu).iter().zip(matrices(&direct, mu)) {
            assert_same(found, &expected, 1e-12, "permuted");
        }
    }
}

/// The stability map of a session at the rig's reference.
fn mapped(rig: &Rig, solver: &mut Solver) -> StabilityMap {
    StabilityMap::build(&rig.model, solver, &rig.reference, &map_options(rig)).unwrap()
}

#[test]
fn nothing_above_the_cut_off_is_shown() {
    for more in ["", "[band]\nmax_hz = 5000.0"] {
        let rig = reduced(more, true);
        let cutoff_hz = 5000.0 / std::f64::consts::TAU;
        assert!((rig.band_max_hz.unwrap() - cutoff_hz).abs() < 1e-9);
        let expected = rig.describe();
        assert_eq!(expected.contains("to which the band of 5000 Hz is cut"), !more.is_empty(), "{expected}");
        let map = mapped(&rig, &mut Solver::new(rig.model.dimension()));
        assert!(map.windows.iter().all(|window| window.frequency_hz <= cutoff_hz), "{:?}", map.windows);
    }
}

/// Maps, their ends, sensitivities and charts of a rig whose friction terms are Chebyshev polynomials.
#[test]
fn everything_that_is_derived_from_a_rig_works_with_residuals() {
    let rig = reduced("[band]\nmax_hz = 390.0\n[search]\nmu_max = 2.0\n[chart]\ntolerance = 1e-8", true);
    let mut solver = Solver::new(rig.model.dimension());
    let map = mapped(&rig, &mut solver);
    assert!(map.complete && map_options(&rig).band_max_hz == Some(390.0));
    // Ends of windows are where the growth rate of a dense solve passes zero.
    assert!(!map.windows.is_empty());
    for window in &map.windows {
        let growth = |solver: &mut Solver, mu: f64| {
            let spectrum = solver.solve(&rig.model, &rig.reference.with_friction(mu), Vectors::Right).unwrap();
            let in_band = spectrum.roots.iter().filter(|root| root.frequency_hz() <= 390.0);
            in_band.map(|root| root.lambda.re / root.lambda.norm()).fold(f64::NEG_INFINITY, f64::max)
        };
        let (before, after) = (growth(&mut solver, window.mu_from - 1e-4), growth(&mut solver, window.mu_from + 1e-4));
        assert!(before < 0.0 && 0.0 < after, "{window:?}: {before} {after}");
    }
    assert_eq!(map.ends.windows.len(), map.windows.len());
    // Sensitivities to friction against differences.
    let (mu, step) = (0.4, 1e-5);
    let at = |solver: &mut Solver, mu: f64| {
        solver.solve(&rig.model, &rig.reference.with_friction(mu), Vectors::Both).unwrap()
    };
    let spectrum = at(&mut solver, mu);
    let chosen: Vec<usize> = (0..3).collect();
    let slopes = sensitivity::of_roots(&rig.model, &spectrum, &chosen).unwrap();
    let (above, below) = (at(&mut solver, mu + step), at(&mut solver, mu - step));
    for slope in slopes {
        let lambda = spectrum.roots[slope.root].lambda;
        let nearest = |other: &squealcast::physics::Spectrum| {
            let distance = |root: &&squealcast::physics::Root| (root.lambda - lambda).norm();
            other.roots.iter().min_by(|a, b| distance(a).total_cmp(&distance(b))).unwrap().lambda
        };
        let expected = (nearest(&above) - nearest(&below)) * (0.5 / step);
        // Of `λ²` where no damping takes part.
        let found = if spectrum.undamped { slope.slope[0] / (lambda * 2.0) } else { slope.slope[0] };
        assert!((found - expected).norm() < 1e-4 * (expected.norm() + 1.0), "{found} {expected}");
    }
    // A chart against dense solves it was not made from.
    let chart = build(&rig.model, &chart_options(&rig), &|_| true).unwrap();
    assert!(chart.dense_share() < 0.05, "{}", chart.dense_share());
    let traces = Traces::new(&rig.model);
    let mut scratch = Scratch::default();
    let mut compared = 0;
    for k in 0..40 {
        let p = rig.reference.with_friction(0.013 + 0.036 * f64::from(k));
        let mut modes = vec![];
        if chart.evaluate(&p, traces.at(&rig.model, &p), &mut scratch, &mut modes).is_err() {
            continue;
        }
        let spectrum = solver.solve(&rig.model, &p, Vectors::Right).unwrap();
        for charted in modes.iter().filter(|root| root.frequency_hz() <= 390.0) {
            let nearest = spectrum.roots.iter().map(|root| (root.lambda - charted.lambda).norm());
            let error = nearest.fold(f64::INFINITY, f64::min) / charted.lambda.norm();
            // Near merging points a root has half the digits.
            assert!(error < 1e-5, "{p:?}: {error:e}");
            compared += 1;
        }
    }
    assert!(compared > 40, "{compared}");
}

#[test]
fn wrong_residuals_are_refused_by_name() {
    let nodes = [[0.1, 0.0, 0.0], [0.11, 0.0, 0.0]];
    let good = |flexibility: Vec<f64>, inertia: Option<Vec<f64>>, shape: Vec<u64>| {
        let mut arrays = vec![
            ("omega_rad_s", vec![1], vec![100.0]),
            ("phi", vec![2, 3, 1], vec![1.0; 6]),
            ("nodes_m", vec![2, 3], nodes.iter().flatten().copied().collect()),
        ];
        if !flexibility.is_empty() {
            arrays.push(("residual_flexibility", shape.clone(), flexibility));
        }
        if let Some(inertia) = inertia {
            arrays.push(("residual_inertia", shape, inertia));
        }
        npz::read("a.npz", &archive(&arrays)).map_err(|error| error.to_string())
    };
    let diagonal: Vec<f64> = (0..36).map(|k| if k % 7 == 0 { 1e-9 } else { 0.0 }).collect();
    assert!(good(diagonal.clone(), Some(diagonal.clone()), vec![6, 6]).unwrap().residual.is_some());
    let changed = |at: usize, value: f64| {
        let mut changed = diagonal.clone();
        changed[at] = value;
        changed
    };
    let refused = |flexibility, inertia, shape| good(flexibility, inertia, shape).unwrap_err();
    assert_eq!(
        refused(diagonal.clone(), None, vec![4, 9]),
        "a.npz: array `residual_flexibility` has shape (4, 9); expected (6, 6), by nodes_m"
    );
    assert_eq!(
        refused(changed(8, 1e-12), None, vec![6, 6]),
        "a.npz: array `residual_flexibility[2, 1]` is 0, its mirror image 0.000000000001; expected a difference of at most \
         1.000e-18: a symmetric matrix"
    );
    assert_eq!(
        refused(diagonal.clone(), Some(changed(14, -1.0)), vec![6, 6]),
        "a.npz: array `residual_inertia[2, 2]` is -1; expected at least 0"
    );
    assert_eq!(
        refused(vec![], Some(diagonal.clone()), vec![6, 6]),
        "a.npz: array `residual_inertia` is given without residual_flexibility; expected both, or neither"
    );
    let archives = || [file("pad.npz", pad().archive(5, true, true)), file("disc.npz", disc().archive(4, true, true))];
    let load = |text: String| {
        let [pad, disc] = archives();
        Rig::from_files(&[file("x.toml", text), pad, disc]).unwrap_err().to_string()
    };
    let hertzian = load(toml(&format!("{SIDES}\n[load]\nexponent = 0.5")));
    assert!(hertzian.starts_with("x.toml: residual flexibility with [load] exponent 0.5, expected 0"), "{hertzian}");
    // A rigid-body motion cannot be omitted: it has no flexibility.
    let mut floating = pad();
    floating.omega[0] = 0.0;
    let text = toml(&SIDES.replacen("\"pad.npz\"", "\"pad.npz\"\nmodes = [1, 2]", 1));
    let [_, disc] = archives();
    let refused =
        Rig::from_files(&[file("x.toml", text), file("pad.npz", floating.archive(5, true, true)), disc]).unwrap_err();
    assert_eq!(
        refused.to_string(),
        "x.toml: `pad.modes` is a selection without mode 0 of 0 rad/s, expected one with every rigid-body motion: they have \
         no residual flexibility"
    );
}

/// Two nodes of three and two modes; the third node does not move in the second mode, the first line is 1.
const UFF: &str = "    -1
  2411
         7         1         1        11
   1.0000000000000000D-01   0.0000000000000000D+00   2.0000000000000000D-02
         9         0         0         0
   1.1000000000000000D-01   0.0000000000000000D+00   2.0000000000000000D-02
        12         0         0         0
   1.2000000000000000D-01   0.0000000000000000D+00   2.0000000000000000D-02
    -1
    -1
   151
something else
    -1
    -1
    55
NONE
NONE
NONE
NONE
NONE
         1         2         2         8         2         3
         2         4         1         1
  1.00000E+02  4.00000E+00  1.00000E-02  2.00000E-02
         9
  2.00000E+00 -4.00000E+00  6.00000E+00
         7
 -1.00000E+00 -2.00000E+00-3.00000E-100
    -1
    -1
    55
NONE
NONE
NONE
NONE
NONE
         1         2         3         8         2         6
         2         2         1         2
  2.00000E+02  1.00000E+00
         9
  1.50000E+00  2.50000E+00  3.50000E+00  9.00000E+00  9.00000E+00  9.00000E+00
    -1
";

#[test]
fn a_universal_file_becomes_modal_data() {
    let data = ModalData::read("a.UNV", UFF.as_bytes()).unwrap();
    assert_eq!(data.omega_rad_s, [100.0, 200.0].map(|hz| std::f64::consts::TAU * hz));
    // Nodes that move, in the order of their own dataset.
    assert_eq!(data.nodes_m, [[0.1, 0.0, 0.02], [0.11, 0.0, 0.02]]);
    // Divided by the root of the modal mass of 4.
    assert_eq!(data.shape(0, 0), [-0.5, -1.0, -1.5e-100]);
    assert_eq!((data.shape(1, 0), data.shape(1, 1), data.shape(0, 1)), ([1.0, -2.0, 3.0], [1.5, 2.5, 3.5], [0.0; 3]));
    // Half of the loss factor of 0.02 besides the viscous 0.01.
    assert_eq!(data.damping_ratio, Some(vec![0.02, 0.0]));
}

#[test]
fn wrong_universal_files_are_refused_with_line_and_value() {
    let refused = |text: &str| uff::read("a.unv", text.as_bytes()).unwrap_err().to_string();
    for (from, to, expected) in [
        (
            "  4.00000E+00  1.00000E-02",
            "  0.00000E+00  1.00000E-02",
            "a.unv, line 23: dataset 55: modal mass is 0; expected more than 0 (1 where shapes are mass-normalised)",
        ),
        (
            "  2.00000E+00 -4.00000E+00",
            "  2.00000E+00 -4.0zz00E+00",
            "a.unv, line 25: dataset 55: values at a node is `-4.0zz00E+00`; expected a finite number",
        ),
        (
            "  6.00000E+00\n",
            "\n",
            "a.unv, line 25: dataset 55: values at a node has 2 numbers (`  2.00000E+00 -4.00000E+00`); expected at least 3",
        ),
        (
            "         9\n  2.0",
            "         8\n  2.0",
            "a.unv, line 41: node 8 has a mode shape only; expected a place for it in a dataset 15 or 2411",
        ),
        (
            "         9\n  2.0",
            "         7\n  2.0",
            "a.unv, line 27: dataset 55: node of a shape is 7 again; expected every node at most once",
        ),
        (
            "         7         1         1",
            "         7         1         4",
            "a.unv, line 4: dataset 2411: displacement coordinate system of node 7 is 4; expected 0 or 1, the global one",
        ),
        (
            "         1         2         2         8         2",
            "         1         2         2         8         5",
            "a.unv, line 21: dataset 55: type of data is 5; expected 2, real values",
        ),
        (
            "         1         2         2         8",
            "         1         2         2        12",
            "a.unv, line 21: dataset 55: quantity is 12; expected 8, displacements",
        ),
        (
            "        12         0",
            "         7         0",
            "a.unv, line 41: node 7 is there twice; expected every node once",
        ),
        (
            "  1.00000E+02  4",
            " -1.00000E+02  4",
            "a.unv, line 23: dataset 55: frequency is -100; expected at least 0 Hz",
        ),
        (
            "    -1\n  2411",
            "garbage\n  2411",
            "a.unv, line 1: line between datasets is `garbage`; expected -1, as in a Universal File",
        ),
        ("    -1\n  2411", "    -1\n  24xx", "a.unv, line 9: nodes are missing; expected"),
    ] {
        let text = refused(&UFF.replacen(from, to, 1));
        if to.contains("24xx") {
            // An unknown dataset is passed over.
            assert!(text.contains("nodes are missing; expected a dataset 15 or 2411"), "{text}");
        } else {
            assert_eq!(text, expected);
        }
    }
    let complex = UFF.replace("         1         2         ", "         1         3         ");
    assert!(refused(&complex).contains("modes are missing; expected a dataset 55 of analysis type 2, normal modes"));
    // Cut anywhere, it says in which line; where a dataset is cut, that it has no end.
    for end in 0..UFF.len() - 1 {
        if let Err(error) = uff::read("a.unv", &UFF.as_bytes()[..end]) {
            assert!(error.to_string().starts_with("a.unv, line "), "{end}: {error}");
        } else {
            // Only whole datasets, and at least one mode, make a file; blanks at the end mean nothing.
            assert!(UFF[..end].trim_end().ends_with("-1"), "{end}");
        }
    }
    for garbage in [&b"\xff\xfe\x00"[..], b"", b"-1", b"-1\n55\n-1", b"-1\n164\n1\n0 0 0\n-1", b"PK\x03\x04"] {
        uff::read("a.unv", garbage).unwrap_err();
    }
}

#[test]
fn files_of_pyuff_give_the_same_rig_as_npz() {
    let python = python();
    if !program::python_has(&python, "numpy, pyuff") {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/peers/pyuff_rig.py");
    let output = Command::new(&python).arg(script).arg(folder.path()).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    eprintln!("written by {}", String::from_utf8_lossy(&output.stdout).trim());
    let load = |pad: &str, disc: &str| {
        let path = folder.path().join("rig.toml");
        std::fs::write(&path, toml(&format!("[pad]\nmodal = \"{pad}\"\n[disc]\nmodal = \"{disc}\""))).unwrap();
        Rig::load(path.to_str().unwrap()).unwrap_or_else(|error| panic!("{error}"))
    };
    let (universal, arrays) = (load("pad.unv", "disc.uff"), load("pad.npz", "disc.npz"));
    assert_eq!(universal.model.dimension(), 11);
    for mu in [0.0, 0.6, -0.2] {
        for (found, expected) in matrices(&universal, mu).iter().zip(matrices(&arrays, mu)) {
            // The digits are the same; division by 1000 and roots of modal masses round in other places.
            assert_same(found, &expected, 1e-12, "Universal File");
        }
    }
}

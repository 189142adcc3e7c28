//! Rigs on a basis of a whole full model: pad and disc on shared coordinates, systems of small matrices, and
//! `squealcast reduce --tolerance`, which writes both.

use std::f64::consts::TAU;
use std::fs;

use crate::program::{run, text, tribometer};
use faer::{Mat, c64};
use squealcast::export::{ModalSide, modal_rig};
use squealcast::full_model::FullModelFile;
use squealcast::physics::{OperatingPoint, Solver, Spectrum, Vectors};
use squealcast::reduction::{Counted, FullSolver, FullVectors, PartMatrices, match_roots};
use squealcast::rig::{Rig, RigFile};

const NODES_M: [[f64; 3]; 4] = [[0.1, 0.0, 0.0], [0.12, 0.0, 0.01], [0.1, 0.0, 0.02], [0.09, 0.0, -0.01]];

fn shape(rows: usize, columns: usize, seed: f64) -> Mat<f64> {
    Mat::from_fn(rows, columns, |i, j| (seed + 1.3 * i as f64 + 2.9 * j as f64 + 0.7 * (i * j) as f64).sin())
}

fn side(name: &str, omega_rad_s: Vec<f64>, phi: Mat<f64>) -> ModalSide<'_> {
    let nodes_m = NODES_M.to_vec();
    let matrices = PartMatrices::default();
    ModalSide { name, nodes_m, omega_rad_s, phi, residual: None, damping_ratio: None, mass_share: None, matrices }
}

/// A rig of two sides with the tables `more` in addition to the patch.
fn rig_of(more: &str, sides: &[ModalSide<'_>]) -> Vec<RigFile> {
    let patch = "[[contact_patch]]\naxis_point_m = [0.0, 0.0, 0.0]\naxis_direction = [0.0, 1.0, 0.0]\n\
                 normal = [0.0, 1.0, 0.0]\nstiffness_n_per_m = 2e5\n";
    let patches: toml::Table = patch.parse().unwrap();
    modal_rig("rig.toml", &[], &more.parse().unwrap(), patches.get("contact_patch"), None, sides, None).unwrap()
}

fn spectrum(rig: &Rig, p: &OperatingPoint) -> Spectrum {
    Solver::new(rig.model.dimension()).solve(&rig.model, p, Vectors::Right).unwrap()
}

fn modes(rig: &Rig, p: &OperatingPoint) -> Vec<c64> {
    spectrum(rig, p).modes().iter().map(|root| root.lambda).collect()
}

/// Sides with separate modes are a special case of a shared basis: `[Φ_p 0]` and `[0 Φ_d]`.
#[test]
fn a_shared_basis_of_both_sides_modes_is_the_same_rig() {
    let law = "[load]\nexponent = 0.3\n[friction]\nlateral_damping = true\nslope_s_per_m = -0.01\n";
    let (pad, disc) = (shape(12, 3, 0.2), shape(12, 2, 1.1));
    let (of_pad, of_disc) = (vec![300.0, 900.0, 1500.0], vec![500.0, 1100.0]);
    let mut sides = [side("pad", of_pad.clone(), pad.clone()), side("disc", of_disc.clone(), disc.clone())];
    let symmetric = |n: usize, size: f64| Mat::from_fn(n, n, |i, j| size * (1.0 + (i + j) as f64).sin());
    let gyroscopic = Mat::from_fn(2, 2, |i, j| 1.5 * (i as f64 - j as f64));
    sides[0].matrices.damping = Some(symmetric(3, 4.0));
    sides[1].matrices = PartMatrices {
        damping: Some(symmetric(2, 3.0)),
        gyroscopic: Some(gyroscopic.clone()),
        spin: Some(symmetric(2, 2.0)),
    };
    let of_sides = sides.each_ref().map(|side| side.matrices.clone());
    let apart = Rig::from_files(&rig_of(law, &sides)).unwrap();
    let all = [of_pad, of_disc].concat();
    let wide = |phi: &Mat<f64>, first: usize| {
        let inside = |j: usize| j.checked_sub(first).filter(|j| *j < phi.ncols());
        Mat::from_fn(12, 5, |i, j| inside(j).map_or(0.0, |j| phi[(i, j)]))
    };
    let mut sides = [side("pad", all.clone(), wide(&pad, 0)), side("disc", all, wide(&disc, 3))];
    for (side, (matrices, first)) in sides.iter_mut().zip(of_sides.iter().zip([0, 3])) {
        let wide = |matrix: &Option<Mat<f64>>| {
            matrix.as_ref().map(|matrix| {
                let inside = |i: usize| i.checked_sub(first).filter(|i| *i < matrix.nrows());
                Mat::from_fn(5, 5, |i, j| inside(i).zip(inside(j)).map_or(0.0, |(i, j)| matrix[(i, j)]))
            })
        };
        let PartMatrices { damping, gyroscopic, spin } = matrices;
        side.matrices = PartMatrices { damping: wide(damping), gyroscopic: wide(gyroscopic), spin: wide(spin) };
    }
    sides[0].mass_share = Some(Mat::from_fn(5, 5, |i, j| f64::from(u8::from(i == j && i < 3))));
    let shared = Rig::from_files(&rig_of(&format!("{law}[basis]\nshared = true\n"), &sides)).unwrap();
    assert!(shared.describe().contains("shared basis (kind 2)"), "{}", shared.describe());
    for (normal_load_n, disc_speed_rad_s, friction_coefficient) in [(500.0, 13.0, 0.0), (900.0, -4.0, 0.8)] {
        let p = OperatingPoint { normal_load_n, disc_speed_rad_s, friction_coefficient };
        let (expected, found) = (spectrum(&apart, &p), spectrum(&shared, &p));
        assert_eq!(expected.modes().len(), 5);
        for (a, b) in expected.modes().iter().zip(found.modes()) {
            // The same sums in another order.
            assert!((a.lambda - b.lambda).norm() < 1e-11 * a.lambda.norm(), "{p:?}: {a:?} {b:?}");
            let shares = [a.pad_participation, b.pad_participation];
            assert!((shares[0] - shares[1]).abs() < 1e-9 && (0.0..=1.0).contains(&shares[1]), "{p:?}: {shares:?}");
        }
    }
    // The disc alone, contact open: `2 Ω H` couples its two modes, `-Ω² L` and the damping act on them.
    let p = OperatingPoint { normal_load_n: 0.0, disc_speed_rad_s: 40.0, friction_coefficient: 0.0 };
    let with_speed = modes(&apart, &p);
    let at_rest = modes(&apart, &OperatingPoint { disc_speed_rad_s: 0.0, ..p });
    assert!((with_speed[1] - at_rest[1]).norm() > 1.0, "{with_speed:?} {at_rest:?}");
    let mut of_pad = [side("pad", vec![300.0], shape(12, 1, 0.2)), side("disc", vec![300.0], shape(12, 1, 1.0))];
    of_pad[0].matrices.spin = Some(symmetric(1, 1.0));
    let told = Rig::from_files(&rig_of("", &of_pad)).map(|_| ()).unwrap_err().to_string();
    assert!(told.contains("pad.modal") && told.contains("does not turn"), "{told}");
    of_pad[0].matrices = PartMatrices { gyroscopic: Some(symmetric(1, 1.0)), ..PartMatrices::default() };
    let told = Rig::from_files(&rig_of("", &of_pad)).map(|_| ()).unwrap_err().to_string();
    assert!(told.contains("`gyroscopic[0, 0]`") && told.contains("a skew-symmetric matrix"), "{told}");
    assert_eq!(shared.shapes.len(), 2);
    assert!(shared.shapes.iter().all(|shapes| shapes.first_coordinate == 0 && shapes.phi.ncols() == 5));
    assert_eq!(shared.model.pad_modes(), None);
}

#[test]
fn an_invalid_shared_basis_is_refused() {
    let both = |more: &str, omega: f64| {
        let sides = [side("pad", vec![300.0], shape(12, 1, 0.2)), side("disc", vec![omega], shape(12, 1, 1.0))];
        Rig::from_files(&rig_of(more, &sides)).map(|_| ()).unwrap_err().to_string()
    };
    let message = both("[basis]\nshared = true\n", 301.0);
    assert!(message.contains("disc.modal") && message.contains("the same coordinates"), "{message}");
    let message = both("[basis]\nshared = true\nlargest_error = -1.0\n", 300.0);
    assert!(message.contains("basis.largest_error"), "{message}");
    let alone = [side("pad", vec![300.0], shape(12, 1, 0.2))];
    let message = Rig::from_files(&rig_of("[basis]\nshared = true\n", &alone)).map(|_| ()).unwrap_err().to_string();
    assert!(message.contains("basis.shared") && message.contains("rigid disc"), "{message}");
}

/// Writes the matrix `n×n` of `entries`, counted from 0.
fn write_matrix(path: &std::path::Path, n: usize, entries: &[(usize, usize, f64)]) {
    let mut out = format!("%%MatrixMarket matrix coordinate real general\n{n} {n} {}\n", entries.len());
    entries.iter().for_each(|(i, j, value)| out += &format!("{} {} {value:e}\n", i + 1, j + 1));
    fs::write(path, out).unwrap();
}

/// A system is a full model and, being small, a rig as well: on its basis it has the same roots.
#[test]
fn a_system_on_its_basis_has_the_roots_it_has() {
    let temp = tempfile::tempdir().unwrap();
    let n = 60;
    let at = |name: &str| temp.path().join(name);
    let mass: Vec<_> = (0..n).map(|i| (i, i, 1.0 + 0.2 * (i as f64).sin())).collect();
    let mut chain = vec![];
    for i in 0..n {
        let k = 4e6 * (1.0 + 0.3 * (2.1 * i as f64).cos());
        chain.extend([(i, i, 2.2 * k)]);
        if i + 1 < n {
            chain.extend([(i, i + 1, -4e6), (i + 1, i, -4e6)]);
        }
    }
    let friction: Vec<_> = (0..20).map(|k| (3 * k % n, (7 * k + 2) % n, 6e5)).collect();
    let damping: Vec<_> = (0..n).map(|i| (i, i, 8.0)).collect();
    for (name, entries) in [("M", &mass), ("K", &chain), ("KR", &friction), ("D", &damping)] {
        write_matrix(&at(&format!("{name}.mtx")), n, entries);
    }
    let full = at("full.toml");
    fs::write(
        &full,
        "name = \"chain\"\n[band]\nmax_hz = 320.0\n[system]\nmass = \"M.mtx\"\n\
         [[system.stiffness]]\nmatrix = \"K.mtx\"\n\
         [[system.stiffness]]\nmatrix = \"KR.mtx\"\nscale = \"friction_coefficient / 0.5\"\n\
         [[system.damping]]\nmatrix = \"D.mtx\"\nscale = \"1 + 2 / disc_speed_rad_s\"\n",
    )
    .unwrap();
    let to = at("rig.toml");
    let message =
        run(["reduce", &text(&full), "--tolerance", "1e-7", "--range", "mu=0:0.8,speed=2:20", "-o", &text(&to)])
            .exits(0)
            .says("held-out points")
            .complains("cut to");
    eprintln!("{}", message.stdout);
    let (whole, rig) = (Rig::load(&text(&full)).unwrap(), Rig::load(&text(&to)).unwrap());
    assert!(rig.model.dimension() < n, "{}", rig.model.dimension());
    let counted = Counted { band_rad_s: 320.0 * TAU, growth_floor_per_s: -20.0 };
    for (disc_speed_rad_s, friction_coefficient) in [(2.0, 0.8), (5.0, 0.33), (20.0, 0.0), (11.0, 0.61)] {
        let p = OperatingPoint { normal_load_n: 500.0, disc_speed_rad_s, friction_coefficient };
        let found = match_roots(&modes(&whole, &p), &modes(&rig, &p), counted);
        // Not one of the held-out points: the tolerance was verified at those and is not a bound elsewhere.
        assert!(found.errors.len() > 5 && found.worst() < 1e-6, "{p:?}: {} {:e}", found.errors.len(), found.worst());
    }
    for (wrong, message) in [
        (["--range", "mu=1:0"], "ascending order"),
        (["--range", "load=0:5"], "more than 0"),
        (["--range", "mu=0.3:0.6"], "begins at 0.3"),
    ] {
        run([&["reduce", &text(&full), "-o", &text(&at("no.toml"))], &wrong[..]].concat()).exits(1).complains(message);
    }
    run(["reduce", &text(&full), "--range", "rpm=1:2", "-o", &text(&at("no.toml"))])
        .exits(2)
        .complains("not mu, load or speed");
    assert!(!at("no.toml").exists());
}

/// Pad and disc by the command: the rig has the roots of the full model at conditions it was not made from, flutter too.
#[test]
fn the_tribometer_on_a_basis_has_the_roots_of_its_full_model() {
    let temp = tempfile::tempdir().unwrap();
    let folder = temp.path().join("full");
    let path = tribometer(&folder, 5000);
    let banded = folder.join("banded.toml");
    let band_hz = 2700.0;
    let written = fs::read_to_string(&path).unwrap();
    let narrower = written.replace("max_hz = 4000.0", &format!("max_hz = {band_hz}"));
    assert_ne!(narrower, written);
    fs::write(&banded, narrower).unwrap();
    let to = temp.path().join("rig.toml");
    // Compared with the full model below, at points of this test.
    let message = run(["reduce", &text(&banded), "--range", "mu=0:1", "--points", "0", "-o", &text(&to)]).exits(0);
    eprintln!("{}{}", message.stderr, message.stdout);
    run(["check", &text(&to)]).exits(0).says("held-out points").says("shared basis");
    let rig = Rig::load(&text(&to)).unwrap();
    assert!(rig.model.dimension() <= 60, "{}", rig.model.dimension());
    let full = FullModelFile::load(&banded).unwrap();
    let mut solver = FullSolver::new("tribometer", &full.model, None, &mut |_| {}).unwrap();
    let counted = Counted { band_rad_s: TAU * band_hz, growth_floor_per_s: -20.0 };
    let mut growing = 0;
    for mu in [0.0, 0.21, 0.58, 0.77] {
        let p = OperatingPoint { normal_load_n: 500.0, disc_speed_rad_s: 13.0, friction_coefficient: mu };
        let found = solver.roots(&p, 1.1 * TAU * band_hz, FullVectors::None, &mut |_| {}).unwrap();
        let truth: Vec<c64> = found.roots.iter().map(|root| root.lambda).collect();
        growing += truth.iter().filter(|root| root.re > 1.0).count();
        let found = match_roots(&truth, &modes(&rig, &p), counted);
        assert!(found.errors.len() > 8 && found.worst() < 1e-6, "{mu}: {} {:e}", found.errors.len(), found.worst());
    }
    assert!(growing > 0, "no flutter among the conditions of this test");
}

/// The tribometer whose disc turns: without friction its roots are imaginary and the same for both directions, and a basis
/// over 0.01 to 60 rad/s has the roots of the full model, at rest too.
#[test]
fn the_turning_tribometer_on_a_basis_has_the_roots_of_its_full_model() {
    let temp = tempfile::tempdir().unwrap();
    let folder = temp.path().join("full");
    run(["tribometer", "--rotation", "--dof", "5000", "-o", &text(&folder)]).exits(0).complains("disc-gyroscopic.mtx");
    let path = folder.join("tribometer.toml");
    let band_hz = 2700.0;
    let written = fs::read_to_string(&path).unwrap();
    fs::write(&path, written.replace("max_hz = 4000.0", &format!("max_hz = {band_hz}"))).unwrap();
    let to = temp.path().join("rig.toml");
    let range = "mu=0:1,speed=0.01:60";
    let message = run(["reduce", &text(&path), "--range", range, "--points", "0", "-o", &text(&to)]).exits(0);
    eprintln!("{}{}", message.stderr, message.stdout);
    let rig = Rig::load(&text(&to)).unwrap();
    assert!(rig.describe().contains("rotation   gyroscopic and spin terms of the disc"), "{}", rig.describe());
    let full = FullModelFile::load(&path).unwrap();
    let mut solver = FullSolver::new("tribometer", &full.model, None, &mut |_| {}).unwrap();
    let counted = Counted { band_rad_s: TAU * band_hz, growth_floor_per_s: -20.0 };
    let mut roots = |disc_speed_rad_s: f64, friction_coefficient: f64| -> Vec<c64> {
        let p = OperatingPoint { normal_load_n: 500.0, disc_speed_rad_s, friction_coefficient };
        let found = solver.roots(&p, 1.1 * TAU * band_hz, FullVectors::None, &mut |_| {}).unwrap();
        let truth: Vec<c64> = found.roots.iter().map(|root| root.lambda).collect();
        if disc_speed_rad_s >= 0.0 {
            let found = match_roots(&truth, &modes(&rig, &p), counted);
            let (count, worst) = (found.errors.len(), found.worst());
            eprintln!("{disc_speed_rad_s} rad/s, {friction_coefficient}: {count} roots, off by {worst:.1e}");
            assert!(count > 8 && worst < 1e-6, "{p:?}: {count} {worst:e}");
        }
        truth
    };
    let at_rest = roots(0.0, 0.0);
    roots(13.0, 0.35);
    roots(60.0, 0.77);
    let (forward, backward) = (roots(60.0, 0.0), roots(-60.0, 0.0));
    assert_eq!(forward.len(), backward.len());
    for (a, b) in forward.iter().zip(&backward) {
        // Residuals of 4e-12, and a gap to the next root of more than 1e-3.
        assert!((a - b).norm() < 1e-9 * a.norm() && a.re.abs() < 1e-9 * a.norm(), "{a} {b}");
    }
    // The pair nearest to a disc's own pair of one nodal diameter or more moves apart.
    let moved = at_rest.iter().zip(&forward).map(|(a, b)| (a - b).norm()).fold(0.0, f64::max);
    assert!(moved > 1.0, "{moved} rad/s");
}

/// Contact that stiffens with the load: a basis made at one load is found out by `verify` at others, and only there.
#[test]
fn a_rig_made_at_one_load_and_used_at_another_is_caught() {
    let temp = tempfile::tempdir().unwrap();
    let folder = temp.path().join("full");
    let path = tribometer(&folder, 5000);
    let hertzian = folder.join("hertzian.toml");
    let written = fs::read_to_string(&path).unwrap().replace("max_hz = 4000.0", "max_hz = 2700.0");
    fs::write(&hertzian, written + "\n[load]\nexponent = 0.3333333333333333\nreference_n = 500.0\n").unwrap();
    let to = temp.path().join("at-500-n.toml");
    run(["reduce", &text(&hertzian), "--range", "mu=0:1,load=500", "--points", "0", "-o", &text(&to)]).exits(0);
    // The prediction carries a note.
    let beyond = "beyond the conditions that the basis was made for";
    let predict = |load: &str| run(["predict", &text(&to), "--mu", "0.3", "--load", load]).exits(0).stdout;
    assert!(predict("900").contains(beyond) && !predict("500").contains(beyond));
    let verify = |rig: &std::path::Path, code: i32| {
        // To the 1e-6 that the basis was made for.
        let options = ["--points", "2", "--no-windows", "--json"];
        let message = run([&["verify", &text(rig), "--against", &text(&hertzian)][..], &options].concat()).exits(code);
        let found = message.json();
        eprintln!("{}", found["certificate"]);
        found["certificate"]["max_relative_error"].as_f64().unwrap()
    };
    // 50 to 2000 N, a range the basis was not sampled over: the error exceeds the 1e-6 that holds at 500 N.
    let elsewhere = verify(&to, 3);
    // The same rig at its own load: the range that points are drawn from is the rig's chart.
    let mut near: toml::Table = fs::read_to_string(&to).unwrap().parse().unwrap();
    let chart = near.entry("chart").or_insert_with(|| toml::Table::new().into()).as_table_mut().unwrap();
    chart.insert("normal_load_n".to_owned(), vec![499.999, 500.001].into());
    let own = temp.path().join("own-load.toml");
    fs::write(&own, near.to_string()).unwrap();
    let own = verify(&own, 0);
    assert!(own < 1e-6 && elsewhere > 1e-6, "{own:e} {elsewhere:e}");
}

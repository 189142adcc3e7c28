//! What rig files become: closed forms, the published nine-degree-of-freedom table, the real brake, modal substructures.

use std::path::PathBuf;

use crate::program::{self, launch, npz_bytes, rig_file as file};
use faer::{Mat, c64};
use squealcast::physics::OperatingPoint;
use squealcast::rig::{EMBEDDED, Rig, RigFile};

fn matrices(rig: &Rig, p: &OperatingPoint) -> (Mat<f64>, Mat<f64>) {
    let n = rig.model.dimension();
    let (mut stiffness, mut damping) = (Mat::zeros(n, n), Mat::zeros(n, n));
    rig.model.assemble(p, &mut stiffness, &mut damping).unwrap();
    (stiffness, damping)
}

/// Eigenvalues with `Im λ > 0` of the state space, displacements scaled by `sqrt(diag K)`.
fn roots(stiffness: &Mat<f64>, damping: &Mat<f64>) -> Vec<c64> {
    let n = stiffness.nrows();
    let s: Vec<f64> = (0..n).map(|k| stiffness[(k, k)].abs().sqrt()).collect();
    let state = Mat::from_fn(2 * n, 2 * n, |i, j| match (i < n, j < n) {
        (true, false) if i == j - n => s[i],
        (true, _) => 0.0,
        (false, true) => -stiffness[(i - n, j)] / s[j],
        (false, false) => -damping[(i - n, j - n)],
    });
    state.eigenvalues().unwrap().into_iter().filter(|root| root.im > 0.0).collect()
}

#[test]
fn nine_degrees_of_freedom_match_the_table() {
    // Growth rate and angular frequency computed from the published layout with 30-digit arithmetic, to the digits
    // printed; compared in λ², which merging modes keep accurate.
    type Row = (f64, f64);
    let tables: [(&str, f64, &[Row]); 4] = [
        (
            "nine-dof",
            0.0,
            &[
                (0.0, 1.0),
                (0.0, 1.030686177),
                (0.0, 1.101320323),
                (0.0, 1.324675571),
                (0.0, 1.563283353),
                (0.0, 1.781280315),
                (0.0, 2.030436593),
                (0.0, 2.238727073),
                (0.0, 5.497147271),
            ],
        ),
        (
            "nine-dof",
            1.0,
            &[
                (0.0, 1.0),
                (0.0149638, 1.072048036),
                (-0.0149638, 1.072048036),
                (0.0, 1.380851129),
                (0.0, 1.569768144),
                (0.0, 1.77178793),
                (0.0, 1.999133465),
                (0.0, 2.23128655),
                (0.0, 5.496957816),
            ],
        ),
        (
            "nine-dof-3+2",
            1.0,
            &[
                (0.0, 1.0),
                (0.00724188, 1.079455372),
                (-0.00724188, 1.079455372),
                (0.0, 1.452858239),
                (0.0, 2.160562176),
            ],
        ),
        (
            "nine-dof-4+2",
            1.0,
            &[
                (0.0, 1.0),
                (0.0110835, 1.079591832),
                (-0.0110835, 1.079591832),
                (0.0, 1.462397868),
                (0.0, 1.559591545),
                (0.0, 2.124456581),
            ],
        ),
    ];
    let mut worst = 0.0_f64;
    for (name, mu, table) in tables {
        let rig = Rig::load(name).unwrap();
        let (stiffness, damping) = matrices(&rig, &rig.reference.with_friction(mu));
        assert_eq!(damping.norm_max(), 0.0);
        let squares = stiffness.eigenvalues().unwrap();
        assert_eq!(squares.len(), table.len());
        for (sigma, omega) in table {
            // λ² = -eigenvalue of K.
            let expected = -(c64::new(*sigma, *omega) * c64::new(*sigma, *omega));
            let distance = |square: &c64| (square.re - expected.re).hypot(square.im - expected.im);
            let nearest = squares.iter().map(distance).fold(f64::INFINITY, f64::min);
            // Frequencies are printed to 5e-10, growth rates to 5e-8.
            let tolerance = if *sigma == 0.0 { 1.1e-9 * omega } else { 1.2e-7 };
            worst = worst.max(nearest / tolerance);
            assert!(nearest < tolerance, "{name} at {mu}: {sigma} {omega} off by {nearest:e}");
        }
    }
    eprintln!("largest difference: {worst:.2} of what printing leaves");
}

#[test]
fn nine_degrees_of_freedom_match_the_matrices() {
    // K(μ) written out over the nine coordinates from the forces of the two contacts. A change of coordinates keeps
    // the characteristic polynomial, which is compared at a few points.
    let slider = [
        [2.0, -1.0, 0.0, 0.0, 0.0, 0.0],
        [-1.0, 3.0, 0.0, -1.0, 0.0, 0.0],
        [0.0, 0.0, 2.0, 0.0, 0.0, -1.0],
        [0.0, -1.0, 0.0, 2.5, 0.5, 0.0],
        [0.0, 0.0, 0.0, 0.5, 1.5, 0.0],
        [0.0, 0.0, -1.0, 0.0, 0.0, 2.0],
    ];
    for (name, m, ky, kc) in [("nine-dof", 1.0, 1.0, 1.0), ("nine-dof-case-2", 2.0, 2.0, 5.0)] {
        let mu = 0.7;
        let (mut stiffness, mut mass) = (Mat::<f64>::zeros(9, 9), Mat::<f64>::identity(9, 9));
        for (i, row) in slider.iter().enumerate() {
            for (j, value) in row.iter().enumerate() {
                stiffness[(i, j)] = *value;
            }
        }
        for (k, value) in [(6, 1.0), (7, ky), (8, ky)] {
            stiffness[(k, k)] = value;
        }
        let inertia = m / 12.0;
        mass[(6, 6)] = m;
        for (i, j) in [(7, 7), (7, 8), (8, 7), (8, 8)] {
            mass[(i, j)] = m / 4.0 + if i == j { inertia / 4.0 } else { -inertia / 4.0 };
        }
        for (x, y, l) in [(1, 2, 0.5), (3, 4, -0.5)] {
            // d = y_slider - ((1 + l) y5 + (1 - l) y6) / 2, N = kc d; friction +μN on the slider, -μN on x5.
            let d = [(y, 1.0), (7, -(1.0 + l) / 2.0), (8, -(1.0 - l) / 2.0)];
            for (column, weight) in d {
                for (row, share) in d {
                    stiffness[(row, column)] += kc * share * weight;
                }
                stiffness[(x, column)] -= mu * kc * weight;
                stiffness[(6, column)] += mu * kc * weight;
            }
        }
        let rig = Rig::load(name).unwrap();
        let (reduced, _) = matrices(&rig, &rig.reference.with_friction(mu));
        for square in [-3.0, 0.45, 1.7, 40.0] {
            let full = Mat::from_fn(9, 9, |i, j| stiffness[(i, j)] - square * mass[(i, j)]);
            let expected = full.determinant() / mass.determinant();
            let found = Mat::from_fn(9, 9, |i, j| reduced[(i, j)] - if i == j { square } else { 0.0 }).determinant();
            assert!((found / expected - 1.0).abs() < 1e-11, "{name}: {found} {expected}");
        }
    }
}

#[test]
fn every_embedded_rig_loads_and_describes_itself() {
    for embedded in EMBEDDED {
        let rig = Rig::load(embedded.name).unwrap();
        let (mu_max, description) = match embedded.name {
            "rough-pad" => (1.0, "7 pairs"),
            "tribometer-lining" => (0.6, "294 pairs"),
            name if name.starts_with("tribometer") => (1.0, "294 pairs"),
            _ => (20.0, "2 pairs"),
        };
        assert_eq!((rig.name.as_str(), rig.mu_max), (embedded.name, mu_max));
        assert!(rig.describe().contains(description), "{}", rig.describe());
        assert_eq!(Rig::from_files(&rig.files).unwrap().content_hash, rig.content_hash);
    }
    let reduced = Rig::load("nine-dof-case-2-3+2").unwrap();
    assert_eq!((reduced.model.dimension(), reduced.model.pad_modes()), (5, Some(3)));
}

#[test]
fn belt_modes_of_the_reduced_rigs_are_x5_and_the_translation() {
    // Case 1: k/m = 1 and 2k/m = 2; case 2: 1/2 and 4/2. The rotation would be at 24.
    for (name, expected) in [("nine-dof-3+2", [1.0, 2.0]), ("nine-dof-case-2-4+2", [0.5, 2.0])] {
        let rig = Rig::load(name).unwrap();
        let pad = rig.model.pad_modes().unwrap();
        let (open, _) = matrices(&rig, &OperatingPoint { normal_load_n: 0.0, ..rig.reference });
        for (k, expected) in expected.iter().enumerate() {
            assert!((open[(pad + k, pad + k)] - expected).abs() < 1e-14, "{name}");
        }
    }
}

#[test]
fn hoffmann_coalesces_at_the_closed_form_value() {
    // In physical coordinates (k11 - k22 - kc)²/4 + k12 (k12 - μ kc) = 0; the discriminant of the characteristic
    // polynomial does not depend on the coordinates.
    let rig = Rig::load(&launch("hoffmann.toml")).unwrap();
    let discriminant = |mu: f64| {
        let (k, _) = matrices(&rig, &rig.reference.with_friction(mu));
        (k[(0, 0)] - k[(1, 1)]).powi(2) / 4.0 + k[(0, 1)] * k[(1, 0)]
    };
    let slope = (discriminant(0.7) - discriminant(0.5)) / 0.2;
    let critical = 0.5 - discriminant(0.5) / slope;
    assert!((critical - 0.590_277_777_777_777_8).abs() < 1e-14, "{critical}");
}

#[test]
fn hulten_is_written_out_as_published() {
    let (w1, w2) = (200.0 * std::f64::consts::PI, 150.0 * std::f64::consts::PI);
    for (name, eta1, eta2) in
        [("hulten", 0.0, 0.0), ("hulten-damped", 0.02, 0.02), ("hulten-unequally-damped", 0.02, 0.10)]
    {
        let rig = Rig::load(&launch(&format!("{name}.toml"))).unwrap();
        let (k, c) = matrices(&rig, &rig.reference.with_friction(0.25));
        let expected = faer::mat![[w1 * w1, -0.25 * w2 * w2], [0.25 * w1 * w1, w2 * w2]];
        assert!((&k - &expected).norm_max() < 1e-15 * expected.norm_max());
        assert!((&c - faer::mat![[eta1 * w1, 0.0], [0.0, eta2 * w2]]).norm_max() < 1e-13);
    }
}

/// The rig of the real brake with its matrices, if they are there.
fn brake() -> Option<Vec<RigFile>> {
    let shared = std::env::var_os("SQUEALCAST_SHARED")
        .map_or_else(|| PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../shared"), PathBuf::from);
    let directory = shared.join("data/brake4669");
    if !directory.join("M.mtx").exists() {
        program::aloud(&format!("skipped: no matrices at {}", directory.display()));
        return None;
    }
    let mut files = vec![file("brake4669.toml", std::fs::read(launch("brake4669.toml")).unwrap())];
    for name in ["M", "D1", "DG", "DR", "D4", "K1", "KGeo", "KR"] {
        let name = format!("{name}.mtx");
        files.push(file(&name, std::fs::read(directory.join(&name)).unwrap()));
    }
    Some(files)
}

#[test]
fn the_real_brake_in_150_modes() {
    let Some(files) = brake() else { return };
    let start = std::time::Instant::now();
    let rig = Rig::from_files(&files).unwrap();
    eprintln!("150 modes of 4669 degrees of freedom: {:?}\n{}", start.elapsed(), rig.describe());
    let (stiffness, damping) = matrices(&rig, &rig.reference);
    let roots = roots(&stiffness, &damping);
    // Growth rate and frequency by scipy 1.17 (eigsh, then dense), from the README of the data, as printed there.
    for (sigma, hz) in [(1.499, 782.55), (70.134, 2775.71), (111.972, 4190.19), (110.389, 5799.21)] {
        let distance = |root: &&c64| (root.re - sigma).hypot(root.im / std::f64::consts::TAU - hz);
        let nearest = roots.iter().min_by(|a, b| distance(a).total_cmp(&distance(b))).unwrap();
        eprintln!("{:.6} 1/s at {:.6} Hz for {sigma} at {hz}", nearest.re, nearest.im / std::f64::consts::TAU);
        assert!((nearest.re - sigma).abs() < 6e-4, "{nearest:?} {sigma} {hz}");
        assert!((nearest.im / std::f64::consts::TAU - hz).abs() < 6e-3, "{nearest:?} {sigma} {hz}");
    }
}

/// A mode shape linear in position: every interpolation that is exact for linear fields gives the same contact rows.
fn shape(node: &[f64; 3], mode: usize, sign: f64) -> [f64; 3] {
    let m = mode as f64 + 1.0;
    [0.3 * m + 2.0 * sign * node[0], -0.2 + 3.0 * m * node[1], sign * 0.7 + 5.0 * node[0] - 4.0 * m * node[1]]
}

fn side(nodes: &[[f64; 3]], omega: [f64; 2], sign: f64) -> Vec<u8> {
    let count = nodes.len() as u64;
    let phi: Vec<f64> = nodes
        .iter()
        .flat_map(|node| (0..3).flat_map(move |axis| (0..2).map(move |mode| shape(node, mode, sign)[axis])))
        .collect();
    npz_bytes(&[
        ("omega_rad_s", &[2], &omega),
        ("phi", &[count, 3, 2], &phi),
        ("nodes_m", &[count, 3], nodes.as_flattened()),
    ])
}

const PATCH: &str = r#"
name = "modal"
[pad]
modal = "pad.npz"
[disc]
modal = "disc.npz"
damping_ratio = 0.01
[[contact_patch]]
axis_point_m = [0.0, 0.0, 0.0]
axis_direction = [0.0, 0.0, 2.0]
normal = [0.0, 0.0, 1.0]
stiffness_n_per_m = 1e5
damping_n_s_per_m = 3.0
"#;

#[test]
fn modal_substructures_touch_at_matching_and_other_nodes_in_both_directions() {
    let pad_nodes: [[f64; 3]; 4] = [[0.10, 0.00, 0.01], [0.11, 0.00, 0.01], [0.10, 0.01, 0.01], [0.113, 0.0125, 0.01]];
    let omega = [1000.0, 2000.0, 1500.0, 1800.0];
    // K and C from the definitions, node by node, disc and pad displacement from the linear shapes.
    let expected = |mu: f64| {
        let mut k = Mat::from_fn(4, 4, |i, j| if i == j { f64::powi(omega[i], 2) } else { 0.0 });
        let mut c = Mat::from_fn(4, 4, |i, j| if i == j && i >= 2 { 2.0 * 0.01 * omega[i] } else { 0.0 });
        for node in pad_nodes {
            let r = node[0].hypot(node[1]);
            let t = [-node[1] / r, node[0] / r];
            let u = [
                shape(&node, 0, 1.0),
                shape(&node, 1, 1.0),
                shape(&node, 0, -1.0).map(|v| -v),
                shape(&node, 1, -1.0).map(|v| -v),
            ];
            for i in 0..4 {
                for j in 0..4 {
                    let along = u[i][2] + mu * (t[0] * u[i][0] + t[1] * u[i][1]);
                    k[(i, j)] += 1e5 * along * u[j][2];
                    c[(i, j)] += 3.0 * along * u[j][2];
                }
            }
        }
        (k, c)
    };
    let grid: Vec<[f64; 3]> =
        (0..4).flat_map(|i| (0..4).map(move |j| [0.095 + 0.007 * i as f64, -0.004 + 0.007 * j as f64, 0.01])).collect();
    let matching: Vec<[f64; 3]> = grid.iter().chain(&pad_nodes).copied().collect();
    for disc in [matching, grid] {
        let rig = Rig::from_files(&[
            file("modal.toml", PATCH),
            file("pad.npz", side(&pad_nodes, [1000.0, 2000.0], 1.0)),
            file("disc.npz", side(&disc, [1500.0, 1800.0], -1.0)),
        ])
        .unwrap();
        eprintln!("{}", rig.describe());
        assert_eq!(rig.model.pad_modes(), Some(2));
        for speed in [13.0, -13.0_f64] {
            let p = OperatingPoint { normal_load_n: 500.0, disc_speed_rad_s: speed, friction_coefficient: 0.4 };
            let (k, c) = matrices(&rig, &p);
            let (expected_k, expected_c) = expected(0.4 * speed.signum());
            assert!((&k - &expected_k).norm_max() < 1e-13 * expected_k.norm_max());
            assert!((&c - &expected_c).norm_max() < 1e-13 * expected_c.norm_max());
        }
        let (k, _) = matrices(&rig, &rig.reference.with_friction(0.0));
        assert_eq!(k, k.transpose().to_owned(), "exactly symmetric without friction");
    }
}

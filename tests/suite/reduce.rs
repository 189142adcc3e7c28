//! `squealcast reduce`: the tribometer in its modes against its own full model, and what becomes of work that cannot be done.

use std::f64::consts::TAU;
use std::path::Path;

use crate::program::{self, command, files_below, run, text, write};
use squealcast::full_model::FullModelFile;
use squealcast::physics::{OperatingPoint, Solver, Vectors, WindowKind};
use squealcast::reduction::{FullSolver, FullVectors, lowest_modes};
use squealcast::rig::Rig;
use squealcast::session::computed::session_map;

/// The band that is judged, Hz.
const BAND_HZ: f64 = 4000.0;
const BAND: &str = "[band]\nmax_hz = 4000.0\n";

/// The tribometer's full model, whose band is the one judged here.
fn tribometer(folder: &Path, dof: usize) -> String {
    let path = program::tribometer(folder, dof);
    let written = std::fs::read_to_string(&path).unwrap();
    assert!(written.contains(BAND), "{written}");
    text(&path)
}

fn reduced(full: &str, modes: &str, to: &Path) -> Rig {
    let run = run(["reduce", full, "--modes", modes, "--points", "1", "-o", &text(to)]).exits(0);
    eprintln!("{}{}", run.stderr, run.stdout);
    Rig::load(to.to_str().unwrap()).unwrap_or_else(|error| panic!("{error}"))
}

/// Frequencies at rest, ascending, Hz.
fn at_rest(rig: &Rig) -> Vec<f64> {
    let mut solver = Solver::new(rig.model.dimension());
    let spectrum = solver.solve(&rig.model, &rig.reference.with_friction(0.0), Vectors::Right).unwrap();
    let mut hz: Vec<f64> = spectrum.roots.iter().map(|root| root.frequency_hz()).collect();
    hz.sort_by(f64::total_cmp);
    hz
}

/// Roots of the full model in the band at a friction coefficient, `λ²`.
fn full_squares(full: &FullModelFile, solver: &mut FullSolver<'_>, mu: f64) -> Vec<faer::c64> {
    let point = OperatingPoint { friction_coefficient: mu, ..full.settings.reference };
    let found = solver.roots(&point, TAU * BAND_HZ, FullVectors::None, &mut |_| {}).unwrap();
    found.roots.iter().map(|root| root.lambda * root.lambda).collect()
}

/// Mean and discriminant of the two roots nearest to `at`: both are smooth where the two merge.
fn pair(squares: &[faer::c64], at: faer::c64) -> [faer::c64; 2] {
    let mut near = squares.to_vec();
    near.sort_by(|a, b| (*a - at).norm().total_cmp(&(*b - at).norm()));
    let half = (near[0] - near[1]) * 0.5;
    [(near[0] + near[1]) * 0.5, half * half]
}

/// One contact stiffness serves every number of modes, as theory.md's measurements on another rig have it: frequencies at
/// rest within a mean of 0.0713 % (the published best, of 245 + 245 modes) with 40 + 40 and 0.005 % with 80 + 80, and every
/// critical friction coefficient within 0.5 % or 0.003 with 80 + 80.
#[test]
fn the_tribometer_in_modes_with_residuals_against_its_full_model() {
    let folder = tempfile::tempdir().unwrap();
    let path = tribometer(folder.path(), 5000);
    let full = FullModelFile::load(Path::new(&path)).unwrap();
    let rest = OperatingPoint { friction_coefficient: 0.0, ..full.settings.reference };
    let [mass, _, stiffness] = full.model.matrices_at(&rest).unwrap();
    let exact = lowest_modes("full", &mass, &stiffness, 18).unwrap();
    let exact: Vec<f64> = exact.omega_squared.iter().map(|square| square.sqrt() / TAU).collect();
    let mut last = None;
    for (modes, limit_percent) in [("40+40", 0.0713), ("80+80", 0.005)] {
        let rig = reduced(&path, modes, &folder.path().join(format!("rig-{modes}.toml")));
        let found = at_rest(&rig);
        let errors: Vec<f64> =
            exact.iter().zip(&found).map(|(exact, found)| 100.0 * (found / exact - 1.0).abs()).collect();
        // What reduce itself found at a held-out point is in the rig file.
        let known = rig.reduction.clone().unwrap();
        assert!(
            known.full_model_hash == full.content_hash && known.points == 1 && known.band_hz == BAND_HZ,
            "{known:?}"
        );
        assert!(known.missed == 0 && known.invented == 0 && known.max_frequency_error < 1e-4, "{known:?}");
        let mean = errors.iter().sum::<f64>() / errors.len() as f64;
        eprintln!("{modes}: mean {mean:.2e} %, largest {:.2e} %", errors.iter().fold(0.0, |a: f64, b| a.max(*b)));
        assert!(mean < limit_percent, "{modes}: {errors:?}");
        last = Some(rig);
    }
    let rig = last.unwrap();
    let mut solver = Solver::new(rig.model.dimension());
    let map = session_map(&rig, &mut solver, &rig.reference).unwrap();
    assert!(map.complete && !map.windows.is_empty());
    let mut exact_solver = FullSolver::new("full", &full.model, None, &mut |_| {}).unwrap();
    for window in &map.windows {
        assert_eq!(window.kind, WindowKind::Coalescence);
        for mu in [Some(window.mu_from), window.mu_to].into_iter().flatten() {
            let spectrum = solver.solve(&rig.model, &rig.reference.with_friction(mu), Vectors::Right).unwrap();
            let hz = |root: &&squealcast::physics::Root| (root.frequency_hz() - window.frequency_hz).abs();
            let merged = spectrum.roots.iter().min_by(|a, b| hz(a).total_cmp(&hz(b))).unwrap().square;
            // The discriminant of the full model's pair on both sides, and where the line through them is zero.
            let step = 0.003;
            let [low, high] =
                [mu - step, mu + step].map(|mu| pair(&full_squares(&full, &mut exact_solver, mu), merged)[1].re);
            let exact = mu - step + 2.0 * step * low / (low - high);
            eprintln!("merging at {:.1} Hz: {mu:.6}, of the full model {exact:.6}", window.frequency_hz);
            assert!((mu - exact).abs() < (0.005 * exact).max(0.003), "{mu} {exact}");
        }
    }
    // None missed, none invented.
    for mu in [0.15, 0.5, 0.9] {
        let growing = |squares: &[faer::c64]| {
            let mut hz: Vec<f64> = squares
                .iter()
                .map(|square| square.sqrt())
                .filter(|lambda| lambda.re.abs() > 1e-6 * lambda.norm() && lambda.im.abs() < TAU * BAND_HZ)
                .map(|lambda| lambda.im.abs() / TAU)
                .collect();
            hz.sort_by(f64::total_cmp);
            hz
        };
        let exact = growing(&full_squares(&full, &mut exact_solver, mu));
        let spectrum = solver.solve(&rig.model, &rig.reference.with_friction(mu), Vectors::Right).unwrap();
        let found = growing(&spectrum.roots.iter().map(|root| root.square).collect::<Vec<_>>());
        eprintln!("growing or decaying at {mu}: {found:?} Hz, of the full model {exact:?} Hz");
        assert_eq!(exact.len(), found.len());
        assert!(exact.iter().zip(&found).all(|(exact, found)| (exact / found - 1.0).abs() < 1e-4));
    }
}

#[test]
fn the_rig_file_names_archives_by_their_hash_and_hands_on_the_tables() {
    let folder = tempfile::tempdir().unwrap();
    let path = tribometer(folder.path(), 5000);
    let to = folder.path().join("out.toml");
    let first = run(["reduce", &path, "--modes", "12+9", "--points", "0", "-o", &text(&to)]).exits(0);
    // Plain lines without a terminal: the steps, with time and memory.
    for expected in
        ["degrees of freedom read", "pad: ordering and analysing", "disc: factored", "GiB]", "out.toml written"]
    {
        assert!(first.stderr.contains(expected), "no {expected:?} in {}", first.stderr);
    }
    assert!(first.stderr.lines().all(|line| line.starts_with('[') && !line.contains('\r')), "{}", first.stderr);
    assert!(
        first.stdout.contains("12 of the pad, 9 of the disc") && first.stdout.contains("294 pairs"),
        "{}",
        first.stdout
    );
    let rig = Rig::load(to.to_str().unwrap()).unwrap();
    assert_eq!((rig.mu_max, rig.model.dimension()), (1.0, 21));
    let written = std::fs::read_to_string(&to).unwrap();
    let hash = FullModelFile::load(Path::new(&path)).unwrap().content_hash;
    assert!(written.contains(&hash), "{written}");
    // The same again is the same to the last bit; other modes are another archive.
    let names = |rig: &Rig| rig.files.iter().skip(1).map(|file| file.name.clone()).collect::<Vec<_>>();
    assert!(names(&rig)[0].starts_with("out-pad-") && names(&rig)[1].starts_with("out-disc-"), "{:?}", names(&rig));
    run(["reduce", &path, "--modes", "12+9", "--points", "0", "-o", &text(&to)]).exits(0);
    assert_eq!(Rig::load(to.to_str().unwrap()).unwrap().content_hash, rig.content_hash);
    // Below a cut-off, every mode and no other.
    run(["reduce", &path, "--cutoff-hz", "4000", "--no-residual", "--points", "0", "-o", &text(&to)]).exits(0);
    let below = Rig::load(to.to_str().unwrap()).unwrap();
    assert_ne!(names(&below), names(&rig));
    // Archives that the rig file named before, and no longer does, are gone; others stay.
    assert!(names(&rig).iter().all(|name| !folder.path().join(name).exists()), "{:?}", files_below(folder.path()));
    assert!(names(&below).iter().all(|name| folder.path().join(name).exists()) && Path::new(&path).exists());
    // A copy of the rig file goes on naming its archives.
    let copy = folder.path().join("copy.toml");
    std::fs::copy(&to, &copy).unwrap();
    run(["reduce", &path, "--modes", "12+9", "--points", "0", "-o", &text(&to)]).exits(0);
    assert_ne!(std::fs::read(&to).unwrap(), std::fs::read(&copy).unwrap());
    assert_eq!(names(&Rig::load(copy.to_str().unwrap()).unwrap()), names(&below));
    let omega: Vec<f64> = (0..2)
        .map(|side| {
            let phi = &below.shapes[side];
            let last = phi.first_coordinate + phi.phi.ncols() - 1;
            let n = below.model.dimension();
            let (mut k, mut c) = (faer::Mat::zeros(n, n), faer::Mat::zeros(n, n));
            below.model.assemble(&OperatingPoint { normal_load_n: 0.0, ..below.reference }, &mut k, &mut c).unwrap();
            k[(last, last)].sqrt()
        })
        .collect();
    assert!(omega.iter().all(|omega| *omega < TAU * 4000.0 && *omega > TAU * 2500.0), "{omega:?}");
}

/// The same sums of the same residuals, made before the archive or after it, differ by rounding.
#[test]
fn a_compact_rig_is_the_same_rig() {
    let folder = tempfile::tempdir().unwrap();
    let path = tribometer(folder.path(), 5000);
    let [whole, compact] = ["whole", "compact"].map(|name| folder.path().join(format!("{name}.toml")));
    let args = |to: &Path| ["reduce", &path, "--modes", "20+15", "--points", "0", "-o", &text(to)].map(str::to_owned);
    run(args(&whole)).exits(0).says("residual   of pad and disc");
    run(args(&compact).into_iter().chain(["--compact".to_owned()])).exits(0).says("residual   of the contact pairs");
    let [one, other] = [&whole, &compact].map(|path| Rig::load(path.to_str().unwrap()).unwrap());
    assert_eq!(one.band_max_hz, other.band_max_hz);
    let stiffness = |rig: &Rig, mu: f64| {
        let n = rig.model.dimension();
        let (mut k, mut c) = (faer::Mat::zeros(n, n), faer::Mat::zeros(n, n));
        rig.model.assemble(&rig.reference.with_friction(mu), &mut k, &mut c).unwrap();
        k
    };
    for mu in [0.0, 0.7] {
        let (a, b) = (stiffness(&one, mu), stiffness(&other, mu));
        assert!((&a - &b).norm_l2() < 1e-13 * a.norm_l2(), "{mu}: {:e}", (&a - &b).norm_l2() / a.norm_l2());
    }
    let bytes = |rig: &Rig| rig.files.iter().map(|file| file.bytes.len()).sum::<usize>();
    assert!(5 * bytes(&other) < bytes(&one), "{} {}", bytes(&other), bytes(&one));
    // Another contact stiffness is as good as before, other modes are not.
    let written = std::fs::read_to_string(&compact).unwrap();
    other.with_contact_stiffness_times(0.5).unwrap();
    let changed = |name: &str, from: &str, to: &str| {
        assert!(written.contains(from), "{written}");
        write(folder.path(), name, &written.replace(from, to))
    };
    let fewer = changed("fewer.toml", "[pad]", "[pad]\nmodes = 10");
    run(["check", &fewer]).exits(1).complains("`pad.modes` omits modes that [residual] does not contain");
    let pairs = other.files.iter().map(|file| file.name.as_str()).find(|name| name.contains("-residual-")).unwrap();
    let pad = other.files.iter().map(|file| file.name.as_str()).find(|name| name.contains("-pad-")).unwrap();
    run(["check", &changed("swapped.toml", pairs, pad)]).exits(1).complains("array `flexibility_normal` is missing");
    run(["check", &changed("none.toml", pairs, "none.npz")]).exits(1).complains("residual.pairs = \"none.npz\"");
    run(args(&compact).into_iter().chain(["--compact", "--no-residual"].map(str::to_owned))).exits(2);
}

#[test]
fn impossible_requests_are_refused_and_leave_no_files() {
    let folder = tempfile::tempdir().unwrap();
    let path = tribometer(folder.path(), 5000);
    let bandless = std::fs::read_to_string(&path).unwrap().replace(BAND, "");
    let bandless = write(folder.path(), "bandless.toml", &bandless);
    let before = files_below(folder.path());
    let to = text(&folder.path().join("rig.toml"));
    run(["reduce", &path, "--modes", "40+40", "--memory-gib", "0.01", "-o", &to])
        .exits(1)
        .complains("reading it took 0.")
        .complains("more than the 0.01 GiB allowed");
    // Enough to read it by, and no more: either way refuses before it factors anything.
    for way in [&["--modes", "40+40"][..], &[]] {
        let run = run(["reduce", &path, "--memory-gib", "0.05", "-o", &to].into_iter().chain(way.iter().copied()));
        run.exits(1).complains("it needs 0.").complains("in addition to what is already in use, more than the 0.0");
    }
    run(["reduce", &path, "--modes", "40", "-o", &to])
        .exits(1)
        .complains("--modes has 1 counts, expected one for each of 2");
    run(["reduce", &path, "--modes", "40+x", "-o", &to]).exits(2).complains("expected counts such as 80+80");
    run(["reduce", &path, "--modes", "0+4", "-o", &to]).exits(2).complains("expected at least 1 of each part");
    run(["reduce", &path, "--cutoff-hz", "10", "-o", &to]).exits(1).complains("there is none");
    run(["reduce", &bandless, "-o", &to]).exits(1).complains("`band.max_hz` is missing; expected it: a basis holds");
    run(["reduce", "none.toml", "-o", &to]).exits(1).complains("none.toml");
    let nowhere = text(&folder.path().join("none/rig.toml"));
    run(["reduce", &path, "--modes", "5+5", "--points", "0", "-o", &nowhere]).exits(1).complains("cannot write");
    run(["reduce", &path, "--modes", "5+5", "-o", &path]).exits(1).complains("is the full model itself");
    for way in [&["--no-residual"][..], &["--compact"]] {
        let run = run(["reduce", &path, "-o", &to].into_iter().chain(way.iter().copied()));
        run.exits(2).complains("--modes <I+J>|--cutoff-hz [<HZ>]");
    }
    run(["reduce", &path, "--cutoff-hz", "--range", "mu=0:1", "-o", &to]).exits(2).complains("--range");
    run(["reduce", &bandless, "--cutoff-hz", "-o", &to]).exits(1).complains("or a value of --cutoff-hz");
    run(["reduce", &path, "--range", "mu=0.4", "-o", &to]).exits(1).complains("a single operating point");
    let whole = std::fs::read_to_string(&path).unwrap();
    let hertzian = whole.clone() + "\n[load]\nexponent = 0.3333\nreference_n = 500.0\n";
    let hertzian = write(folder.path(), "hertzian.toml", &hertzian);
    run(["reduce", &hertzian, "--modes", "5+5", "-o", &to]).exits(1).complains("`load.exponent` is 0.3333");
    // A matrix that ends early, of a format that does not say where it should.
    let matrix = std::fs::read_to_string(folder.path().join("disc-stiffness.mtx")).unwrap();
    let entries: Vec<&str> = matrix.lines().filter(|line| !line.starts_with('%')).skip(1).collect();
    write(folder.path(), "cut.txt", &(entries[..7 * entries.len() / 10].join("\n") + "\n"));
    let cut = write(folder.path(), "cut.toml", &whole.replace("disc-stiffness.mtx", "cut.txt"));
    run(["check", &cut]).exits(1).complains(&format!("cut.txt, line {}: entry at row", 7 * entries.len() / 10));
    run(["check", &cut]).exits(1).complains("is missing up to here; expected every row on the diagonal");
    for name in ["hertzian.toml", "cut.txt", "cut.toml"] {
        std::fs::remove_file(folder.path().join(name)).unwrap();
    }
    assert_eq!(files_below(folder.path()), before);
}

/// Of 3 + 3 modes the unstable ones of the full model are missed: the rig is written, and the exit code is 3.
#[test]
fn verify_reports_modes_that_a_rig_misses() {
    let folder = tempfile::tempdir().unwrap();
    let path = tribometer(folder.path(), 5000);
    let to = text(&folder.path().join("few.toml"));
    run(["reduce", &path, "--modes", "3+3", "--no-residual", "--points", "1", "-o", &to])
        .exits(3)
        .says("modes without a partner");
    run(["check", &to]).exits(0).says("modes without a partner");
}

#[test]
fn an_interruption_leaves_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let path = tribometer(folder.path(), 20_000);
    let before = files_below(folder.path());
    let log = std::env::temp_dir().join(format!("squealcast-reduce-{}.log", std::process::id()));
    let mut reduce = command(["reduce", &path, "--modes", "80+80", "-o", &text(&folder.path().join("rig.toml"))]);
    let mut child = reduce.stderr(std::fs::File::create(&log).unwrap()).spawn().unwrap();
    // Reading and ordering take a while where others work too.
    let started = std::time::Instant::now();
    while !std::fs::read_to_string(&log).unwrap().contains("factored") {
        assert!(started.elapsed() < std::time::Duration::from_secs(200) && child.try_wait().unwrap().is_none());
        std::thread::sleep(std::time::Duration::from_millis(20));
    }
    let sent = std::process::Command::new("kill").args(["-INT", &child.id().to_string()]).status().unwrap();
    assert!(sent.success());
    assert_eq!(child.wait().unwrap().code(), Some(130));
    assert!(std::fs::read_to_string(&log).unwrap().contains("stopped: nothing was written"));
    std::fs::remove_file(&log).unwrap();
    assert_eq!(files_below(folder.path()), before);
}

//! `--engine slepc` against this program's own engine, on the tribometer at 5000 degrees of freedom with 1 and 2 ranks, and
//! what happens where ranks are missing, die, hang or answer wrongly. Wrong answers come from launchers that change the
//! program of the ranks before they start it.

use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::OnceLock;

use serde_json::Value;

use crate::program::{Run, Running, command, ended, files_below, number, skipped, text, tribometer, until};
use squealcast::rig::Rig;

/// Largest relative difference of both engines. Modes and roots of either have backward errors below 1e-12 of their
/// matrices, and no two roots merge at the friction coefficients used.
const SAME: f64 = 1e-8;

/// Whether MPI's launcher and slepc4py of Debian are there; where they are not, the test is [`skipped`].
#[track_caller]
fn installed() -> bool {
    let packages = ["real", "complex"].map(|scalar| {
        let folder = fs::read_dir("/usr/lib/slepcdir").into_iter().flatten().flatten();
        let mut builds = folder.flat_map(|version| fs::read_dir(version.path()).into_iter().flatten().flatten());
        builds.any(|build| {
            let python = build.path().join("lib/python3/dist-packages/slepc4py");
            build.file_name().to_string_lossy().ends_with(scalar) && python.exists()
        })
    });
    let launcher = Command::new("mpiexec").arg("--version").output().is_ok_and(|output| output.status.success());
    let all = launcher && packages.iter().all(|there| *there);
    if !all {
        skipped("there is no mpiexec with slepc4py (apt-get install python3-slepc4py-real python3-slepc4py-complex)");
    }
    all
}

/// The program with `--engine slepc`. Tests of CI run as root, which Open MPI wants to be told.
fn by_slepc<'a>(args: impl IntoIterator<Item = &'a str>) -> Command {
    let mut command = command(args);
    command.args(["--engine", "slepc"]).env("OMPI_ALLOW_RUN_AS_ROOT", "1").env("OMPI_ALLOW_RUN_AS_ROOT_CONFIRM", "1");
    // Two ranks on a machine with one processor.
    command.env("OMPI_MCA_rmaps_base_oversubscribe", "1");
    command
}

fn ends(mut command: Command) -> Run {
    ended(command.output().expect("the program starts"))
}

/// The tribometer, written once for all tests, as it is and with friction that damps.
fn models() -> &'static [String; 2] {
    static MODELS: OnceLock<[String; 2]> = OnceLock::new();
    MODELS.get_or_init(|| {
        let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join("slepc");
        let _ = fs::remove_dir_all(&folder);
        let plain = tribometer(&folder, 5000);
        let damped = plain.with_file_name("damped.toml");
        let friction = "\n[friction]\nslope_s_per_m = -0.01\nlateral_damping = true\n";
        fs::write(&damped, fs::read_to_string(&plain).unwrap() + friction).unwrap();
        [text(&plain), text(&damped)]
    })
}

/// Growth rate and frequency of every root in the output of `full --json`.
fn roots(run: &Run) -> Vec<faer::c64> {
    let found: Value = serde_json::from_str(&run.stdout).expect("JSON");
    let roots = found["roots"].as_array().expect("roots");
    roots.iter().map(|root| faer::c64::new(number(root, "growth_rate_per_s"), number(root, "omega_rad_s"))).collect()
}

#[test]
fn roots_are_those_of_our_own_engine() {
    if !installed() {
        return;
    }
    for full in models() {
        let args = ["full", full, "--mu", "0.4", "--band-hz", "3000", "--json", "--quiet"];
        let own = roots(&ends(command(args)).exits(0));
        for ranks in ["1", "2"] {
            let mut by = by_slepc(args);
            by.args(["--ranks", ranks]);
            let theirs = roots(&ends(by).exits(0));
            assert!(own.len() > 10 && own.len() == theirs.len(), "{} {}", own.len(), theirs.len());
            for root in &own {
                let off = theirs.iter().map(|other| (other - root).norm()).fold(f64::INFINITY, f64::min);
                assert!(off < SAME * root.norm(), "{full}, {ranks} ranks: {root} is off by {off:e}");
            }
        }
    }
}

#[test]
fn modes_and_residual_flexibility_are_those_of_our_own_engine() {
    if !installed() {
        return;
    }
    let (folder, full) = (tempfile::tempdir().unwrap(), &models()[0]);
    let made = |name: &str, command: fn(&[&str]) -> Command, more: &[&str]| {
        let to = text(&folder.path().join(name));
        let args = ["reduce", full, "--modes", "12+9", "--points", "0", "-o", &to];
        let run = ends(command(&[&args[..], more].concat())).exits(0);
        (Rig::load(&to).unwrap(), run, fs::read_to_string(&to).unwrap())
    };
    let (own, _, _) = made("own.toml", |args| command(args), &[]);
    for ranks in ["1", "2"] {
        let (rig, run, file) = made("slepc.toml", |args| by_slepc(args.iter().copied()), &["--ranks", ranks]);
        assert!(file.contains("SLEPc 3.") && file.contains(&format!("{ranks} rank")), "{file}");
        // There is memory to count the modes ourselves.
        assert!(
            run.stderr.contains("counted by the inertia") && !run.stderr.contains("of the engine"),
            "{}",
            run.stderr
        );
        let n = own.model.dimension();
        assert_eq!(rig.model.dimension(), n);
        let stiffness = |rig: &Rig| {
            let (mut k, mut c) = (faer::Mat::zeros(n, n), faer::Mat::zeros(n, n));
            rig.model.assemble(&rig.reference, &mut k, &mut c).unwrap();
            k
        };
        let [ours, theirs] = [stiffness(&own), stiffness(&rig)];
        // Contact and residual flexibility are in the stiffness of the contact; the roots hold both, and no signs.
        let values = |k: &faer::Mat<f64>| {
            let mut values: Vec<f64> =
                k.eigenvalues().unwrap().into_iter().map(|value: faer::c64| value.norm()).collect();
            values.sort_by(f64::total_cmp);
            values
        };
        for (ours, theirs) in values(&ours).into_iter().zip(values(&theirs)) {
            assert!((ours - theirs).abs() < SAME * ours, "{ranks} ranks: {ours} {theirs}");
        }
    }
}

/// The greedy choice of samples may differ by rounding; the promise of the basis may not.
#[test]
fn a_basis_holds_its_tolerance_and_verifies() {
    if !installed() {
        return;
    }
    let (folder, full) = (tempfile::tempdir().unwrap(), &models()[0]);
    let to = text(&folder.path().join("basis.toml"));
    let args = ["reduce", full, "--range", "mu=0:1", "--points", "0", "--quiet", "-o", &to];
    ends(by_slepc(args)).exits(0).says("kind");
    // Compared with the full model by our own engine, and by the ranks.
    let verify = ["verify", &to, "--against", full, "--points", "2", "--no-windows", "--json", "--quiet"];
    for command in [command(verify), by_slepc(verify)] {
        let found: Value = serde_json::from_str(&ends(command).exits(0).stdout).unwrap();
        let worst = number(&found["certificate"], "max_relative_error");
        assert!(worst < 1e-6, "{worst:e}");
    }
}

/// A launcher that replaces `from` by `to` in the program of the ranks and starts one rank with it.
fn spoiling(folder: &Path, from: &str, to: &str) -> String {
    let path = folder.join("spoiling");
    let script = format!(
        "#!/bin/sh\n\
         grep -qF '{from}' \"$2\" || {{ echo the program of the ranks has changed; exit 9; }}\n\
         /usr/bin/python3 - \"$2\" <<'END'\n\
         import sys\n\
         text = open(sys.argv[1]).read().replace({from:?}, {to:?})\n\
         open(sys.argv[1], 'w').write(text)\n\
         END\n\
         exec mpiexec -n 1 \"$@\"\n"
    );
    launcher(&path, &script)
}

fn launcher(path: &Path, script: &str) -> String {
    fs::write(path, script).unwrap();
    fs::set_permissions(path, fs::Permissions::from_mode(0o755)).unwrap();
    text(path)
}

/// Nothing but what the test put there is in a folder.
#[track_caller]
fn holds_only(folder: &Path, names: &[&str]) {
    let found: Vec<PathBuf> = files_below(folder);
    let others: Vec<&PathBuf> =
        found.iter().filter(|path| !names.iter().any(|name| path.file_name() == Some(name.as_ref()))).collect();
    assert!(others.is_empty(), "left behind: {others:?}");
}

/// Falsified answers of every kind are noticed: the program fails, says why and writes nothing.
#[test]
fn wrong_answers_are_refused() {
    if !installed() {
        return;
    }
    let (vectors, order) =
        ("write(command[\"out\"], vectors[:, order])", "order = np.argsort(squares, kind=\"stable\")");
    let cases = [
        ("a wrong mode", vectors, "vectors[5] *= 1.0 + 1e-6; write(command[\"out\"], vectors[:, order])", "limit"),
        (
            "a mode twice",
            order,
            "order = np.argsort(squares); order[3] = order[4]",
            "products of modes with the mass matrix",
        ),
        ("a missing mode", order, "order = np.delete(np.argsort(squares), 4)", "the inertia of K - shift M counts"),
        ("a short file", "(local).tobytes(", "(local[1:]).tobytes(", "bytes, expected"),
        (
            "a wrong solve",
            "answer = np.array(left.getDenseArray(), copy=True)",
            "answer = left.getDenseArray().copy(); answer[5] *= 1.0 + 1e-6",
            "a solve leaves",
        ),
        (
            "NaN",
            "answer = np.array(left.getDenseArray(), copy=True)",
            "answer = left.getDenseArray() * np.nan",
            "a solve leaves",
        ),
        ("no JSON", "json.dump(values, file)", "file.write(\"{\")", "cannot be read"),
        (
            "a dead rank",
            "answer = np.array(left.getDenseArray(), copy=True)",
            "os.kill(os.getpid(), 9)",
            "before the ranks had answered",
        ),
        ("a wrong build", "*-{SCALAR}/lib", "*-complex/lib", "PETSc is built for complex numbers, expected real ones"),
        (
            "no slepc4py",
            "from slepc4py import",
            "from slepc4py_that_is_missing import",
            "Debian: python3-petsc4py-real",
        ),
        (
            "no MUMPS",
            "hasExternalPackage(\"mumps\")",
            "hasExternalPackage(\"mumps-that-is-missing\")",
            "built without MUMPS",
        ),
    ];
    let full = &models()[0];
    for (what, from, to, expected) in cases {
        let (folder, scratch) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
        let (launch, rig) = (spoiling(folder.path(), from, to), text(&folder.path().join("rig.toml")));
        let run = ends(by_slepc([
            "reduce",
            full,
            "--modes",
            "8+6",
            "--points",
            "0",
            "-o",
            &rig,
            "--launch",
            &launch,
            "--scratch",
            &text(scratch.path()),
        ]));
        assert!(run.code == 1 && run.stderr.contains(expected), "{what}: {} {}", run.code, run.stderr);
        holds_only(folder.path(), &["spoiling"]);
        holds_only(scratch.path(), &[]);
    }
}

/// These need neither MPI nor SLEPc.
#[test]
fn launchers_that_fail_are_named_with_what_they_printed() {
    let (folder, full) = (tempfile::tempdir().unwrap(), &models()[0]);
    let rig = text(&folder.path().join("rig.toml"));
    let args = ["reduce", full, "--modes", "8+6", "--points", "0", "-q", "-o", &rig];
    let mut without = by_slepc(args);
    without.env("PATH", "");
    ends(without).exits(1).complains("cannot start `mpiexec -n 1`").complains("Debian: openmpi-bin");
    let saying = launcher(&folder.path().join("saying"), "#!/bin/sh\necho no such partition >&2\nexit 7\n");
    let mut by = by_slepc(args);
    by.args(["--launch", &saying]);
    ends(by).exits(1).complains("exit status: 7").complains("they printed:\n  no such partition");
    let mut by = by_slepc(args);
    by.args(["--scratch", "/nowhere"]);
    ends(by).exits(1).complains("/nowhere: cannot make a folder for the ranks");
    ends({
        let mut own = command(args);
        own.args(["--ranks", "2"]);
        own
    })
    .exits(1)
    .complains("--ranks is for --engine slepc");
    holds_only(folder.path(), &["saying"]);
}

/// A launcher that hangs is ended by Ctrl-C, with everything it started.
#[test]
fn ctrl_c_ends_a_launcher_that_hangs() {
    let full = &models()[0];
    for args in [
        vec!["full", full, "--mu", "0.4", "-q"],
        vec!["reduce", full, "--modes", "8+6", "--points", "0", "-q", "-o", "rig.toml"],
    ] {
        let (folder, scratch) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
        let pid = folder.path().join("pid");
        let hanging = launcher(
            &folder.path().join("hanging"),
            &format!("#!/bin/sh\nsleep 1000 &\necho $! > {}\nwait\n", text(&pid)),
        );
        let mut by = by_slepc(args);
        by.args(["--launch", &hanging, "--scratch", &text(scratch.path())]).current_dir(folder.path());
        let running = Running::start(by);
        until("the launcher starts", || fs::read_to_string(&pid).is_ok_and(|text| text.ends_with('\n')));
        assert_eq!(running.signal("INT").code, 130);
        let started = fs::read_to_string(&pid).unwrap();
        until("its process ends", || {
            let state = fs::read_to_string(format!("/proc/{}/stat", started.trim())).unwrap_or_default();
            state.is_empty() || state.contains(") Z ")
        });
        holds_only(folder.path(), &["hanging", "pid"]);
        holds_only(scratch.path(), &[]);
    }
}

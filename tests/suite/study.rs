//! Studies: shards, kills and resumption, failed cases, tables for other programs, recordings, full models, and the examples of
//! `launch/study`.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use squealcast::study::{Cells, Reader, Table};

use crate::program::{self, Run, command, files_below, folder, python, run, text, write};

/// 200 cases in 20 files; `extra` are further keys.
fn study(directory: &Path, extra: &str) -> String {
    let toml = format!(
        "name = \"nine\"\nrig = \"nine-dof-case-2\"\ncases_per_file = 10\n{extra}\n\
         [compute]\nwhat = [\"spectrum\", \"modes\", \"windows\"]\nmu_max = 1.0\n\
         [design]\nkind = \"latin-hypercube\"\ncases = 200\nseed = 5\n\
         [[parameter]]\nkey = \"contact[*].stiffness_n_per_m\"\nrelative = true\nfrom = 0.5\nto = 2.0\n\
         [[parameter]]\ncondition = \"friction_coefficient\"\nfrom = 0.0\nto = 1.5\n\
         [[parameter]]\ncondition = \"normal_load_n\"\nfrom = -50.0\nto = 2000.0\n"
    );
    write(directory, "study.toml", &toml)
}

fn compute(study: &str, output: &Path, shard: &str) -> Run {
    run(["study", study, "-o", &text(output), "--shard", shard, "--quiet"]).exits(0)
}

fn merged(folders: &[PathBuf], output: &Path) -> Vec<u8> {
    let folders = folders.iter().map(|folder| text(folder));
    let args = ["study", "merge"].map(str::to_owned).into_iter().chain(folders).chain(["-o".to_owned(), text(output)]);
    run(args.collect::<Vec<_>>()).exits(0);
    fs::read(output).expect("a table")
}

fn parts(directory: &Path) -> Vec<PathBuf> {
    let named = |path: &PathBuf| path.file_name().is_some_and(|name| name.to_string_lossy().starts_with("cases-"));
    let mut parts: Vec<PathBuf> = if directory.exists() { files_below(directory) } else { vec![] };
    parts.retain(|path| named(path) && path.extension().is_some_and(|extension| extension == "parquet"));
    parts.sort();
    parts
}

fn table(path: &Path) -> Table {
    Reader::open(path).expect("a table").read_all().expect("its columns")
}

#[test]
fn shards_and_kills_change_no_byte_of_the_table() {
    let folder = folder();
    let at = |name: &str| folder.path().join(name);
    let study = study(folder.path(), "");
    compute(&study, &at("whole"), "1/1");
    let expected = fs::read(at("whole/table.parquet")).expect("the table of a whole study");
    for of in [3, 8] {
        let folders: Vec<PathBuf> = (1..=of).map(|index| at(&format!("of-{of}-{index}"))).collect();
        for (index, output) in (1..).zip(&folders) {
            compute(&study, output, &format!("{index}/{of}"));
            assert!(!output.join("table.parquet").exists(), "a shard has no table of the whole");
        }
        assert!(merged(&folders, &at("table.parquet")) == expected, "{of} shards");
    }
    // Killed each time that some more files have appeared, whatever else it was doing then.
    let (killed, mut kills) = (at("killed"), 0);
    loop {
        let there = parts(&killed);
        let before: Vec<_> = there.iter().map(|path| fs::metadata(path).and_then(|m| m.modified()).ok()).collect();
        let args = ["study", &study, "-o", &text(&killed), "--quiet"];
        let mut child = command(args).stderr(Stdio::null()).spawn().expect("the program starts");
        let ended = loop {
            if let Some(status) = child.try_wait().expect("its status") {
                break Some(status);
            }
            if parts(&killed).len() >= there.len() + 1 + kills % 4 {
                break None;
            }
            std::thread::yield_now();
        };
        child.kill().expect("it can be killed");
        child.wait().expect("it ends");
        let after: Vec<_> = there.iter().map(|path| fs::metadata(path).and_then(|m| m.modified()).ok()).collect();
        assert_eq!(before, after, "files that were there are not written again");
        match ended {
            Some(status) => break assert!(status.success(), "{status}"),
            None => kills += 1,
        }
    }
    assert!(kills >= 4, "killed {kills} times");
    assert!(fs::read(at("killed/table.parquet")).expect("its table") == expected, "killed {kills} times");
    // Shards in one folder, and a damaged file, which is computed again.
    let shared = at("shared");
    (1..=2).for_each(|index| drop(compute(&study, &shared, &format!("{index}/2"))));
    let file = &parts(&shared)[3];
    let bytes = fs::read(file).expect("a part");
    fs::write(file, &bytes[..bytes.len() / 2]).expect("a test can damage a file");
    compute(&study, &shared, "1/1");
    assert!(fs::read(shared.join("table.parquet")).expect("a table") == expected, "in one folder");
    // Threads.
    run(["study", &study, "-o", &text(&at("one")), "--threads", "1", "-q"]).exits(0);
    assert!(fs::read(at("one/table.parquet")).expect("a table") == expected, "by one thread");
}

#[test]
fn what_does_not_belong_together_is_not_merged() {
    let folder = folder();
    let at = |name: &str| folder.path().join(name);
    let ours = study(folder.path(), "");
    let output = text(&at("table.parquet"));
    (1..=2).for_each(|index| drop(compute(&ours, &at(&format!("{index}")), &format!("{index}/3"))));
    let (one, two) = (text(&at("1")), text(&at("2")));
    run(["study", "merge", &one, &two, "-o", &output]).exits(1).complains(
        "60 of 200 cases are missing: 20 to 29, 50 to 59, 80 to 89, 110 to 119, 140 to 149, and 1 more ranges",
    );
    run(["study", "merge", &one, &one, "-o", &output]).exits(1).complains("cases 0 to 9 are in");
    assert!(!at("table.parquet").exists());
    fs::create_dir(at("elsewhere")).expect("a folder");
    let other = study(&at("elsewhere"), "# another file");
    compute(&other, &at("3"), "3/3");
    run(["study", "merge", &one, &two, &text(&at("3")), "-o", &output])
        .exits(1)
        .complains("made by another study file");
    run(["study", &other, "-o", &one]).exits(1).complains("choose another folder, or empty this one");
    run(["study", "merge", &text(&at("elsewhere")), "-o", &output]).exits(1).complains("holds no cases of a study");
    // Times are a table of their own.
    compute(&ours, &at("3b"), "3/3");
    let times = text(&at("times.parquet"));
    run(["study", "merge", &one, &two, &text(&at("3b")), "-o", &output, "--times", &times]).exits(0);
    let (whole, times) = (table(&at("table.parquet")), table(&at("times.parquet")));
    assert!(whole.column("time_s").is_none() && times.rows() == 200);
    assert_eq!(times.columns().iter().map(|column| column.name.as_str()).collect::<Vec<_>>(), ["case", "time_s"]);
}

#[test]
fn a_failed_case_is_a_row_with_its_reason_and_other_programs_read_the_table() {
    let folder = folder();
    let study = study(folder.path(), "");
    let output = folder.path().join("out");
    let said = run(["study", &study, "-o", &text(&output)]).exits(0);
    let found = table(&output.join("table.parquet"));
    let (Some(Cells::Text(status)), Some(Cells::Text(reasons)), Some(Cells::Number(loads))) =
        (found.column("status"), found.column("reason"), found.column("normal_load_n"))
    else {
        panic!("{:?}", found.columns())
    };
    let mut failed = 0;
    for ((status, reason), load) in status.iter().zip(reasons).zip(loads) {
        let outside = load.expect("a load") < 0.0;
        assert_eq!(status.as_deref(), Some(if outside { "failed" } else { "done" }));
        assert_eq!(reason.is_some(), outside);
        let told = format!("nine-dof-case-2: normal_load_n is {}, expected 0 to 1000000", load.unwrap_or_default());
        assert!(!outside || reason.as_deref() == Some(told.as_str()), "{reason:?}, expected {told}");
        failed += usize::from(outside);
    }
    assert!((1..20).contains(&failed), "{failed}");
    assert!(said.stderr.contains(&format!("{failed} failed now")), "{}", said.stderr);
    let svg = text(&folder.path().join("f.svg"));
    let figure = ["study", "figure", &text(&output), "--x", "normal_load_n", "--y", "critical_friction", "-o", &svg];
    run(figure).exits(0);
    run(figure.into_iter().chain(["--colour", "friction_coefficient"])).exits(0);
    let drawn = fs::read_to_string(&svg).expect("a figure");
    assert!(drawn.contains("friction_coefficient") && drawn.matches("<circle").count() > 100, "{drawn}");
    run(["study", "figure", &text(&output), "--x", "load", "--y", "status", "-o", &svg])
        .exits(1)
        .complains("has no column of numbers `load`; expected one of case, contact_stiffness_n_per_m_times, ");
    let python = python();
    if !program::python_has(&python, "duckdb, pandas, pyarrow") {
        return;
    }
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/peers/study_tables.py");
    let peer = Command::new(&python).arg(script).arg(output.join("table.parquet")).output().expect("Python starts");
    assert!(peer.status.success(), "{}", String::from_utf8_lossy(&peer.stderr));
    let read: serde_json::Value = serde_json::from_slice(&peer.stdout).expect("JSON");
    eprintln!("read by {}", read["versions"]);
    assert_eq!((&read["rows"], &read["case_type"]), (&200.into(), &"int64".into()));
    assert_eq!(read["failed"].as_array().expect("failed cases").len(), failed);
    let names: Vec<String> = found.columns().into_iter().map(|column| column.name).collect();
    assert_eq!(read["columns"], serde_json::json!(names));
    let metadata = &read["metadata"];
    assert_eq!(metadata["squealcast.study"], fs::read_to_string(&study).expect("the study file").as_str());
    assert_eq!(metadata["squealcast.version"], env!("CARGO_PKG_VERSION"));
    assert!(metadata["squealcast.study_sha256"].as_str().is_some_and(|hash| hash.len() == 64));
}

/// The values of a column of `--list`.
fn listed(study: &str, column: &str) -> Vec<f64> {
    let list = run(["study", study, "-o", "none", "--list"]).exits(0).stdout;
    let mut rows = csv::Reader::from_reader(list.as_bytes());
    let index = rows.headers().expect("names").iter().position(|name| name == column).expect("the column");
    rows.records().map(|row| row.expect("a row")[index].parse().expect("a number")).collect()
}

#[test]
fn sobol_points_are_those_of_scipy() {
    let python = python();
    if !program::python_has(&python, "scipy") {
        return;
    }
    let (folder, dimensions, points) = (folder(), 64, 1000);
    let mut toml = "name = \"s\"\nrig = \"nine-dof\"\n[design]\nkind = \"sobol\"\ncases = 1000\n".to_owned();
    for k in 0..dimensions {
        toml += &format!("[[parameter]]\nkey = \"search.mu_max\"\ncolumn = \"p{k}\"\nfrom = 0.0\nto = 1.0\n");
    }
    let study = write(folder.path(), "sobol.toml", &toml);
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/peers/sobol_points.py");
    let numbers = [dimensions.to_string(), points.to_string()];
    let peer = Command::new(&python).arg(script).args(numbers).output().expect("Python starts");
    assert!(peer.status.success(), "{}", String::from_utf8_lossy(&peer.stderr));
    let lines = String::from_utf8(peer.stdout).expect("text");
    let expected: Vec<Vec<f64>> =
        lines.lines().map(|line| line.split(',').map(|x| x.parse().expect("a number")).collect()).collect();
    assert_eq!(expected.len(), points);
    for k in [0, 1, 2, 17, dimensions - 1] {
        let theirs: Vec<f64> = expected.iter().map(|point| point[k]).collect();
        assert_eq!(listed(&study, &format!("p{k}")), theirs, "dimension {k}");
    }
}

#[test]
fn errors_of_a_study_file_name_field_value_and_limit() {
    let folder = folder();
    let why = |toml: &str, told: &str| {
        let study = write(folder.path(), "wrong.toml", &format!("name = \"w\"\n{toml}"));
        run(["study", &study, "-o", &text(&folder.path().join("out"))]).exits(1).complains(told);
        assert!(!folder.path().join("out").exists(), "nothing is written");
    };
    why("", "`rig` is missing; expected one of rig, full_model, tribometer, recordings");
    why("rig = \"nine-dof\"\nfull_model = \"x\"", "expected one of rig, full_model, tribometer, recordings");
    why("rig = \"nine\"", "nor one of the embedded rigs");
    why("rig = \"nine-dof\"\nthreads = 2", "unknown key `threads`");
    why("rig = \"nine-dof\"\n[[parameter]]\ntribometer = \"pad_young_pa\"\nvalues = [1]", "a study of [tribometer]");
    why("rig = \"nine-dof\"\n[[parameter]]\nkey = \"a\"\nfrom = 0\nto = 1", "`parameter[0].points` is missing");
    why("rig = \"nine-dof\"\n[design]\nkind = \"sobol\"\ncases = 20000000", "20000000 cases, expected 1 to 10000000");
    why("[tribometer]\n[compute]\nwhat = [\"windows\"]", "windows are of rigs");
    why("[tribometer]\ndof = 10", "`tribometer.dof` is 10, expected 5000 to 4000000");
    why("[recordings]\npaths = [\"none\"]\nwhat = \"verify\"", "none: ");
    why("[recordings]\npaths = [\".\"]\nwhat = \"predict\"", "`recordings.rig` is missing");
    // What a rig may not have is the case's error, with the ordinary words.
    let toml = "name = \"w\"\nrig = \"nine-dof\"\n[[parameter]]\nkey = \"friction.slop\"\nvalues = [1]\n\
                [[parameter]]\nkey = \"pad.mass[0][0]\"\nvalues = [1.0, -1.0]\n";
    let study = write(folder.path(), "odd.toml", toml);
    let output = folder.path().join("odd");
    run(["study", &study, "-o", &text(&output), "-q"]).exits(0);
    match table(&output.join("table.parquet")).column("reason") {
        Some(Cells::Text(reasons)) => {
            assert!(reasons.iter().flatten().all(|reason| reason.contains("unknown key `slop`")), "{reasons:?}");
            assert_eq!(reasons.iter().flatten().count(), 2);
        }
        other => panic!("{other:?}"),
    }
}

#[test]
fn every_recording_is_a_row() {
    let folder = folder();
    let recordings = text(&Path::new(env!("CARGO_MANIFEST_DIR")).join("recordings"));
    let computed = |what: &str, extra: &str| {
        let toml = format!("name = \"r\"\n[recordings]\npaths = [\"{recordings}\"]\nwhat = \"{what}\"\n{extra}");
        let study = write(folder.path(), &format!("{what}.toml"), &toml);
        let output = folder.path().join(what);
        run(["study", &study, "-o", &text(&output), "-q"]).exits(0);
        let found = table(&output.join("table.parquet"));
        assert_eq!(found.column("status"), Some(&Cells::Text(vec![Some("done".to_owned()); 2])), "{what}");
        (found, output)
    };
    let whole = |table: &Table, name: &str| match table.column(name) {
        Some(Cells::Whole(cells)) => cells.iter().map(|cell| cell.expect("a count")).collect::<Vec<i64>>(),
        other => panic!("{name}: {other:?}"),
    };
    let (verified, _) = computed("verify", "");
    assert_eq!((whole(&verified, "inputs"), whole(&verified, "predicted")), (vec![200; 2], vec![200; 2]));
    let (identical, different) = (whole(&verified, "identical"), whole(&verified, "different"));
    // Another processor may round differently.
    assert!(identical.iter().zip(&different).all(|(same, not)| same + not == 200), "{identical:?} {different:?}");
    let (predicted, output) = computed("predict", "rig = \"nine-dof\"\n");
    let levels: i64 =
        ["ok", "warn", "squeal", "fault"].map(|level| whole(&predicted, level).iter().sum::<i64>()).iter().sum();
    assert_eq!(levels, 400);
    let (_, reports) = computed("report", "");
    let (scores, _) = computed("score", "");
    assert_eq!(whole(&scores, "channels"), [0, 0], "they hold no sound");
    let names = |table: &Table| match table.column("output") {
        Some(Cells::Text(names)) => names.iter().flatten().cloned().collect::<Vec<String>>(),
        other => panic!("{other:?}"),
    };
    for name in names(&predicted) {
        run(["replay", "--verify", &text(&output.join(name))]).exits(0).says("200 predictions identical");
    }
    assert!(files_below(&reports).iter().filter(|path| path.ends_with("report.html")).count() == 2);
}

#[test]
fn a_full_model_and_the_tribometer_are_studied_alike() {
    let folder = folder();
    let full = program::tribometer(&folder.path().join("model"), 5_000);
    let rest = "[compute]\nwhat = [\"modes\"]\nband_hz = 1500.0\n\
                [[parameter]]\nkey = \"contact_patch[0].stiffness_n_per_m\"\nrelative = true\nvalues = [1.0, 2.0]\n\
                [[parameter]]\ncondition = \"friction_coefficient\"\nvalues = [0.4]\n";
    let of_files = format!("name = \"f\"\nfull_model = \"{}\"\n{rest}", text(&full));
    let made = format!(
        "name = \"t\"\n{rest}[[parameter]]\ntribometer = \"disc_thickness_m\"\nvalues = [0.01348, 0.012]\n[tribometer]\n"
    );
    let modes = |name: &str, toml: &str| {
        let study = write(folder.path(), &format!("{name}.toml"), toml);
        let output = folder.path().join(name);
        run(["study", &study, "-o", &text(&output), "-q"]).exits(0);
        assert!(!files_below(&output).iter().any(|path| path.extension().is_some_and(|e| e == "mtx")), "removed again");
        match table(&output.join("table.parquet")).column("mode_frequencies_hz") {
            Some(Cells::List(cells)) => cells.clone().into_iter().map(|cell| cell.expect("roots")).collect::<Vec<_>>(),
            other => panic!("{other:?}"),
        }
    };
    let (of_files, made) = (modes("files", &of_files), modes("made", &made));
    assert_eq!((of_files.len(), made.len()), (2, 4));
    // The same matrices, contact and conditions: the same bits. A thinner disc is softer.
    assert_eq!((&made[0], &made[2]), (&of_files[0], &of_files[1]));
    assert!(made[1].last() < made[0].last() && !made[0].is_empty(), "{made:?}");
    // `full` finds the same roots.
    let by_full = program::json(["full", &text(&full), "--mu", "0.4", "--band-hz", "1500", "--json", "-q"]);
    let roots = by_full["roots"].as_array().expect("roots");
    assert_eq!(roots.iter().map(|root| program::number(root, "frequency_hz")).collect::<Vec<_>>(), of_files[0]);
}

/// A launcher of `launch/study` gives the table of a study without shards; `arguments` are its command line in that folder.
fn launched(arguments: impl Fn(&str) -> Vec<String>, table: &str) {
    let folder = folder();
    let launch = Path::new(env!("CARGO_MANIFEST_DIR")).join("launch/study");
    let toml = fs::read_to_string(launch.join("nine-dof.toml")).expect("the example");
    let study = write(folder.path(), "study.toml", &toml.replace("cases = 200", "cases = 64"));
    compute(&study, &folder.path().join("whole"), "1/1");
    let expected = fs::read(folder.path().join("whole/table.parquet")).expect("a table");
    let program = Path::new(env!("CARGO_BIN_EXE_squealcast")).parent().expect("its folder");
    let path = format!("{}:{}", program.display(), std::env::var("PATH").unwrap_or_default());
    let arguments = arguments(&text(&launch));
    let (first, rest) = arguments.split_first().expect("a program");
    let ended = Command::new(first)
        .args(rest)
        .current_dir(folder.path())
        .env("PATH", path)
        .env("HOME", folder.path())
        .stdin(Stdio::null())
        .output()
        .expect("the launcher starts");
    assert!(ended.status.success(), "{}", String::from_utf8_lossy(&ended.stderr));
    assert!(fs::read(folder.path().join(table)).expect("its table") == expected, "{first}");
}

#[test]
fn gnu_parallel_gives_the_same_table() {
    let found = Command::new("parallel").arg("--version").stdin(Stdio::null()).output();
    if !found.is_ok_and(|output| output.status.success() && output.stdout.starts_with(b"GNU parallel")) {
        return program::skipped("GNU parallel is not installed");
    }
    let words = |launch: &str| [&format!("{launch}/parallel.sh"), "study.toml", "results", "3"].map(str::to_owned);
    launched(|launch| words(launch).into(), "results.parquet");
}

#[test]
fn snakemake_gives_the_same_table() {
    let python = python();
    if !program::python_has(&python, "snakemake") {
        return;
    }
    let arguments = |launch: &str| {
        let file = format!("{launch}/Snakefile");
        let own = [&text(&python), "-m", "snakemake", "-s", &file, "--cores", "2", "--quiet", "all"];
        let config =
            ["--config", "study=study.toml", "shards=3", "parameter=normal_load_n", "result=critical_friction"];
        own.into_iter().chain(config).map(str::to_owned).collect()
    };
    launched(arguments, "results/table.parquet");
}

#[test]
fn the_examples_of_launch_are_valid_studies() {
    let launch = Path::new(env!("CARGO_MANIFEST_DIR")).join("launch/study");
    for (name, cases) in [("nine-dof", 200), ("tribometer", 40), ("recordings", 2)] {
        let list = run(["study", &text(&launch.join(format!("{name}.toml"))), "-o", "none", "--list"]).exits(0).stdout;
        assert_eq!(list.lines().count(), cases + 1, "{name}");
    }
}

//! First contact of a user: inputs outside the limits, lists and completions, standard output as a file, quiet runs.

use crate::program::{self, folder, run, text, write};

/// The rig accepts loads from 0 to 1e6 N and friction coefficients from 0 to 2.
#[test]
fn conditions_outside_the_limits_are_refused_by_every_command_that_judges_them() {
    for command in ["predict", "critical", "sweep"] {
        let refused = run([command, "tribometer", "--load", "-5"]).exits(1);
        refused.complains("tribometer: normal_load_n is -5, expected 0 to 1000000");
        run([command, "tribometer", "--speed", "2e4"]).exits(1).complains("disc_speed_rad_s is 20000");
    }
    run(["predict", "nine-dof-case-2", "--mu", "-0.1"]).exits(1).complains("friction_coefficient is -0.1");
    let folder = folder();
    let full = text(&program::tribometer(folder.path(), 5000));
    let refused = run(["full", &full, "--load", "-5", "--quiet"]).exits(1);
    refused.complains("normal_load_n is -5, expected 0 to");
}

#[test]
fn a_quoted_number_is_named_with_its_line() {
    let folder = folder();
    let rig = std::fs::read_to_string(program::launch("nine-dof.toml")).expect("an example");
    // A key that takes a number or a list of them.
    let quoted = rig.replacen("[pad]", "[pad]\ndamping_ratio = \"0.01\"", 1);
    let line = 1 + quoted.lines().position(|line| line.contains("\"0.01\"")).expect("the quoted number");
    let path = write(folder.path(), "quoted.toml", &quoted);
    run(["check", &path])
        .exits(1)
        .complains(&format!("quoted.toml, line {line}: the value \"0.01\"; expected a number or a list of numbers"));
}

/// Frequencies of a part show at a glance where Hz were given for rad/s.
#[test]
fn check_prints_the_natural_frequencies_of_each_part() {
    let check = run(["check", "tribometer-80+80"]).exits(0).stdout;
    for part in ["pad ", "disc "] {
        let line = check.lines().find(|line| line.starts_with(part)).unwrap_or_else(|| panic!("{part}: {check}"));
        assert!(line.contains("natural frequencies") && line.ends_with("Hz without contact"), "{line}");
    }
}

#[test]
fn embedded_rigs_are_listed_and_completed() {
    let listed = run(["rigs"]).exits(0).stdout;
    let names: Vec<&str> = listed.lines().filter_map(|line| line.split_whitespace().next()).collect();
    assert!(names.contains(&"tribometer") && names.contains(&"nine-dof-case-2-4+2"), "{listed}");
    // The generator for fish completes no arguments by position.
    for shell in ["bash", "zsh"] {
        let script = run(["completions", shell]).exits(0).stdout;
        assert!(names.iter().all(|name| script.contains(name)), "{shell}");
    }
    // Where a rig is expected, zsh offers files as well: the list of rigs is in one function only.
    let script = run(["completions", "zsh"]).exits(0).stdout;
    assert_eq!(script.matches("((tribometer\\:").count(), 1, "{script}");
    assert!(
        script.contains("'files:rig file:_files'") && script.matches(":_squealcast_rigs'").count() >= 5,
        "{script}"
    );
}

#[test]
fn help_names_examples_ros_arguments_and_the_version() {
    run(["--help"]).exits(0).says("squealcast critical tribometer");
    for command in ["run", "demo", "simulate", "replay"] {
        run([command, "--help"]).exits(0).says("--ros-args").says("--params-file FILE");
        run([command, "--version"]).exits(0).says(env!("CARGO_PKG_VERSION"));
    }
}

#[test]
fn a_dash_is_standard_output() {
    let folder = folder();
    let mut sweep = program::command(["sweep", "nine-dof", "--mu", "0.3:0.4:0.1", "--csv", "-"]);
    let printed = program::ended(sweep.current_dir(folder.path()).output().expect("the program starts")).exits(0);
    assert_eq!(printed.stdout, run(["sweep", "nine-dof", "--mu", "0.3:0.4:0.1"]).exits(0).stdout);
    assert_eq!(program::files_below(folder.path()).len(), 0, "no file of that name");
}

/// Growth rates that are rounding are shown as 0, not as -6.1e-17.
#[test]
fn a_quiet_solution_of_a_full_model_prints_its_table_alone() {
    let folder = folder();
    let full = text(&program::tribometer(folder.path(), 5000));
    let found = run(["full", &full, "--mu", "0", "--band-hz", "2000", "--quiet"]).exits(0);
    assert_eq!(found.stderr, "");
    let rows: Vec<Vec<&str>> = found.stdout.lines().map(|line| line.split_whitespace().collect()).collect();
    let roots: Vec<&Vec<&str>> = rows.iter().filter(|row| row.len() == 4 && row[0].parse::<f64>().is_ok()).collect();
    assert!(roots.len() > 2, "{}", found.stdout);
    assert!(roots.iter().all(|row| row[1] == "0" && row[2] == "0"), "undamped, without friction:\n{}", found.stdout);
    run(["full", &full, "--mu", "0", "--band-hz", "2000"]).exits(0).complains("degrees of freedom read");
}

//! First contact of a user: inputs outside the limits, lists and completions, standard output as a file, quiet runs.

use std::path::Path;
use std::process::Command;

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
fn embedded_rigs_are_listed() {
    let listed = run(["rigs"]).exits(0).stdout;
    let names: Vec<&str> = listed.lines().filter_map(|line| line.split_whitespace().next()).collect();
    assert!(names.contains(&"tribometer") && names.contains(&"nine-dof-case-2-4+2"), "{listed}");
}

/// What shells offer for a command line, by the script that this program prints for each.
#[test]
fn shells_complete_rigs_files_and_options() {
    let folder = folder();
    for name in ["my-rig.toml", "test.csv", "session.mcap"] {
        write(folder.path(), name, "");
    }
    std::fs::create_dir(folder.path().join("sessions")).unwrap();
    let program = Path::new(env!("CARGO_BIN_EXE_squealcast"));
    let path = format!("{}:{}", program.parent().unwrap().display(), std::env::var("PATH").unwrap_or_default());
    let ask = |shell: &str, asks: &str| {
        let script = write(folder.path(), &format!("script-{shell}"), &run(["completions", shell]).exits(0).stdout);
        let mut command = Command::new(shell);
        command.args(["-c", &asks.replace("SCRIPT", &script)]).current_dir(folder.path()).env("PATH", &path);
        let answer = command.env("HOME", folder.path()).output().unwrap();
        let text = String::from_utf8_lossy(&answer.stdout).into_owned();
        assert!(answer.status.success(), "{shell}: {text}{}", String::from_utf8_lossy(&answer.stderr));
        let mut offers: Vec<String> =
            text.lines().filter_map(|line| Some(line.split('\t').next()?.trim().to_owned())).collect();
        offers.sort_unstable();
        offers
    };
    let bash = |line: &str| {
        let words: Vec<&str> = line.split(' ').collect();
        let last = words.last().unwrap();
        ask(
            "bash",
            &format!(
                "source SCRIPT; COMP_WORDS=({line}); COMP_WORDS[{0}]='{last}'; COMP_CWORD={0}; COMP_TYPE=9
                _clap_complete_squealcast squealcast '{last}'; printf '%s\\n' \"${{COMPREPLY[@]}}\"",
                words.len() - 1
            ),
        )
    };
    let fish = |line: &str| ask("fish", &format!("source SCRIPT; complete -C '{line}'"));
    // The function that zsh calls, with the builtin that takes its offers replaced by one that prints them.
    let zsh = |line: &str| {
        let words = line.split(' ').count();
        ask(
            "zsh",
            &format!(
                "compdef() {{ }}
                _describe() {{ for name in dirs other; do if [[ ${{@[(Ie)$name]}} -gt 0 ]]; then \
                    for offer in ${{(P)name}}; do print -r -- ${{offer%%:*}}; done; fi; done }}
                source SCRIPT; words=({line}); (( ${{#words}} < {words} )) && words+=(''); CURRENT={words}
                _clap_dynamic_completer_squealcast"
            ),
        )
    };
    type Offers<'a> = &'a dyn Fn(&str) -> Vec<String>;
    let shells: [(&str, Offers<'_>); 3] = [("bash", &bash), ("fish", &fish), ("zsh", &zsh)];
    for (name, offers) in shells {
        if Command::new(name).arg("--version").output().is_err() {
            program::skipped(&format!("no {name}"));
            continue;
        }
        let folder = if name == "zsh" { "sessions" } else { "sessions/" };
        assert_eq!(offers("squealcast rec"), ["recover"], "{name}");
        assert_eq!(offers("squealcast check tribometer-8"), ["tribometer-80+80"], "{name}");
        assert_eq!(offers("squealcast run my"), ["my-rig.toml"], "{name}");
        assert!(offers("squealcast run ").contains(&"nine-dof".to_owned()), "{name}");
        assert_eq!(offers("squealcast report s"), ["session.mcap", folder], "{name}");
        assert_eq!(offers("squealcast report --rig my"), ["my-rig.toml"], "{name}");
        assert_eq!(offers("squealcast run --config "), ["my-rig.toml", folder], "{name}");
        assert_eq!(offers("squealcast import t"), ["test.csv"], "{name}");
        assert_eq!(offers("squealcast run --no-chart-"), ["--no-chart-cache"], "{name}");
    }
}

#[test]
fn every_command_has_a_manual_page_with_examples() {
    let folder = folder();
    run(["man", "-o", &text(folder.path())]).exits(0);
    let pages = program::files_below(folder.path());
    assert!(pages.len() > 25, "{pages:?}");
    for page in pages {
        let text = std::fs::read_to_string(&page).unwrap();
        assert!(text.contains(".SH EXAMPLES") && text.starts_with(".ie"), "{}: {text}", page.display());
    }
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

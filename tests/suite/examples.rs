//! The examples run and print what their first lines promise.

use std::path::PathBuf;
use std::process::{Command, Output};

use crate::program::{Running, command, until};

/// The compiled example `name`, which `cargo test` builds with the tests.
fn example(name: &str) -> PathBuf {
    let test = std::env::current_exe().unwrap();
    test.parent().and_then(|deps| deps.parent()).unwrap().join("examples").join(name)
}

/// A program on shared memory that knows only `squealcast-msgs` gets a prediction for each of its inputs.
#[test]
fn a_rust_client_on_shared_memory_gets_predictions() {
    let prefix = format!("client{}/", std::process::id());
    let node = ["run", "nine-dof-case-2", "--no-ros", "--no-display", "--no-chart", "--plain", "--shm-prefix", &prefix];
    let node = Running::start(command(node));
    let mut last: Option<Output> = None;
    until("the node to answer", || {
        let output = Command::new(example("shared_memory_client")).args(["3", &prefix]).output().unwrap();
        let answered = output.status.success();
        last = Some(output);
        answered
    });
    let printed = String::from_utf8(last.unwrap().stdout).unwrap();
    let levels: Vec<&str> = printed.lines().map(|line| line.split([':', ',']).nth(1).unwrap().trim()).collect();
    assert_eq!(levels.len(), 3, "{printed}");
    // Friction coefficients 0.4, 0.5 and 0.6 of a rig that is unstable from 0.33 on.
    assert!(printed.starts_with("friction 0.400: "), "{printed}");
    assert!(levels.iter().all(|level| ["OK", "WARN", "SQUEAL"].contains(level)), "{printed}");
    node.signal("INT").exits(0);
}

/// Standard output of an example that needs no other program.
fn printed(name: &str) -> String {
    let output = Command::new(example(name)).output().unwrap();
    assert!(output.status.success(), "{name}: {output:?}");
    String::from_utf8(output.stdout).unwrap()
}

/// numpy 2.4.6 finds the first growing mode of these matrices between friction coefficients 0.27 and 0.275.
#[test]
fn a_program_predicts_from_matrices_in_memory() {
    let text = printed("predict_from_matrices");
    let critical = text.lines().find_map(|line| line.strip_prefix("squeal from mu = ")).expect(&text);
    assert!((0.27..0.275).contains(&critical.parse::<f64>().unwrap()), "{text}");
    assert!(text.lines().any(|line| line.contains("Hz") && !line.contains('-')), "a mode grows: {text}");
}

#[test]
fn a_program_reduces_its_own_sparse_matrices() {
    let text = printed("reduce_sparse_matrices");
    assert!(text.contains("degrees of freedom reduced to") && text.contains("held-out points"), "{text}");
}

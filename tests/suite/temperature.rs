//! Rigs that follow the temperature of their contact: predictions, sweeps, maps, sessions.

use std::path::Path;

use crate::program::{self, folder, json, run, text, write};

/// The rig of the paper with soft, damped contact and falling friction, whose contact softens from 20 to 220 °C.
pub fn softening(folder: &Path) -> String {
    let nine = std::fs::read_to_string(program::launch("nine-dof-case-2.toml")).expect("the rig");
    let table = "\n[temperature]\nreference_c = 20.0\ncontact_stiffness = [[20.0, 1.0], [220.0, 0.5]]\n";
    write(folder, "softening.toml", &(nine + table))
}

/// The same rig with the stiffness of every contact pair multiplied by `factor` in the file, and no table.
fn softer(folder: &Path, factor: f64) -> String {
    let nine = std::fs::read_to_string(program::launch("nine-dof-case-2.toml")).expect("the rig");
    let scaled = nine.lines().map(|line| match line.split_once("stiffness_n_per_m = ") {
        Some((before, value)) => {
            let value: f64 = value.split('#').next().unwrap_or_default().trim().parse().expect("a stiffness");
            format!("{before}stiffness_n_per_m = {:e}", factor * value)
        }
        None => line.to_owned(),
    });
    write(folder, "softer.toml", &scaled.collect::<Vec<_>>().join("\n"))
}

/// The factor is a power of two, so both rigs hold the same bits.
#[test]
fn a_factor_is_the_same_as_another_stiffness_in_the_file() {
    let folder = folder();
    let (softening, softer) = (softening(folder.path()), softer(folder.path(), 0.5));
    for mu in ["0.1", "0.4", "0.9"] {
        let hot = json(["predict", &softening, "--temperature", "220", "--mu", mu, "--json"]);
        let written = json(["predict", &softer, "--mu", mu, "--json"]);
        assert_eq!(hot["modes"], written["modes"]);
        assert_eq!(hot["temperature_c"], 220.0);
        assert!(written.get("temperature_c").is_none());
        let cold = json(["predict", &softening, "--mu", mu, "--json"]);
        assert_eq!(cold["modes"], json(["predict", "nine-dof-case-2", "--mu", mu, "--json"])["modes"], "at 20 °C");
        assert_ne!(cold["modes"], hot["modes"]);
    }
    let critical = |args: &[&str]| json(args)["critical_friction"].as_f64();
    let hot = critical(&["critical", &softening, "--temperature", "220", "--json"]);
    assert_eq!(hot, critical(&["critical", &softer, "--json"]));
    assert_ne!(hot, critical(&["critical", &softening, "--json"]));
    run(["predict", &softening, "--temperature", "300"])
        .exits(0)
        .says("300 °C")
        .says("temperature beyond the tables of the rig: factors of their ends");
    run(["check", &softening]).exits(0).says("contact stiffness times 1 at 20 °C to 0.5 at 220 °C");
}

#[test]
fn sweeps_and_maps_go_over_the_temperature() {
    let folder = folder();
    let rig = softening(folder.path());
    let at = |name: &str| text(&folder.path().join(name));
    let (csv, svg) = (at("sweep.csv"), at("sweep.svg"));
    run(["sweep", &rig, "--temperature", "20:220:100", "--mu", "0.4", "--csv", &csv, "--svg", &svg]).exits(0);
    let rows = std::fs::read_to_string(&csv).expect("the table");
    let mut rows = rows.lines();
    assert_eq!(
        rows.next(),
        Some(
            "normal_load_n,disc_speed_rad_s,friction_coefficient,temperature_c,mode_id,frequency_hz,growth_rate_per_s,\
             damping_ratio"
        )
    );
    let rows: Vec<Vec<f64>> =
        rows.map(|row| row.split(',').map(|cell| cell.parse().expect("a number")).collect()).collect();
    for celsius in [20.0, 120.0, 220.0] {
        let swept: Vec<f64> = rows.iter().filter(|row| row[3] == celsius).map(|row| row[5]).collect();
        let at = celsius.to_string();
        let predicted = json(["predict", &rig, "--temperature", &at, "--mu", "0.4", "--json"]);
        let modes = predicted["modes"].as_array().expect("modes");
        assert_eq!(swept, modes.iter().map(|mode| mode["frequency_hz"].as_f64().expect("Hz")).collect::<Vec<_>>());
    }
    assert!(std::fs::read_to_string(&svg).expect("the figure").contains("temperature, °C"));

    // Along the temperature edges are found by bisection, along friction by a stability map: the same curve.
    let (map, edges) = (at("map.csv"), at("edges.csv"));
    for (y, x) in [("mu=0.2:0.6", "temperature=20:220"), ("load=400:600", "temperature=20:220")] {
        run([
            "map", &rig, "--x", x, "--y", y, "--mu", "0.4", "--points", "5x3", "--csv", &map, "--edges", &edges,
            "--quiet",
        ])
        .exits(0);
        let table = std::fs::read_to_string(&map).expect("the table");
        assert_eq!(table.lines().count(), 1 + 15, "{table}");
        assert!(table.starts_with("normal_load_n,disc_speed_rad_s,friction_coefficient,temperature_c,unstable_modes"));
        for edge in std::fs::read_to_string(&edges).expect("the edges").lines().skip(1) {
            let edge: Vec<&str> = edge.split(',').collect();
            let found = json(["critical", &rig, "--temperature", edge[3], "--load", edge[0], "--json"]);
            let mu: f64 = edge[2].parse().expect("a friction coefficient");
            let windows = found["windows"].as_array().expect("windows");
            let ends =
                windows.iter().flat_map(|window| [window["mu_from"].as_f64(), window["mu_to"].as_f64()]).flatten();
            let nearest = ends.map(|end| (end - mu).abs()).fold(f64::INFINITY, f64::min);
            assert!(nearest < 1e-5, "{edge:?} is {nearest} from the end of a window");
        }
    }
}

#[test]
fn a_temperature_of_a_rig_without_one_is_refused() {
    for args in [
        &["predict", "nine-dof", "--temperature", "20"][..],
        &["sweep", "nine-dof", "--temperature", "20:30:1"],
        &["map", "nine-dof", "--x", "temperature=20:30", "--points", "2x2"],
        &["critical", "nine-dof", "--temperature", "20"],
    ] {
        run(args).exits(1).complains("`temperature` is missing; expected the table [temperature]");
    }
    let folder = folder();
    let rig = softening(folder.path());
    run(["predict", &rig, "--temperature", "-300"]).exits(1).complains("-273.15 to 3000 °C");
    run(["sweep", &rig, "--temperature", "20:4000:100"]).exits(1).complains("-273.15 to 3000 °C");
}

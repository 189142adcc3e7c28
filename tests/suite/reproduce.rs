//! `squealcast reproduce`: the paper's tribometer on a small one of ours.

use std::path::Path;

use crate::program::{folder, run, text};

/// The rows of a table: a map from column to cell each.
fn rows(folder: &Path, name: &str) -> Vec<std::collections::HashMap<String, String>> {
    let path = folder.join(format!("{name}.csv"));
    let mut reader = csv::Reader::from_path(&path).unwrap_or_else(|error| panic!("{name}: {error}"));
    reader.deserialize().map(|row| row.unwrap()).collect()
}

/// Natural frequencies of the tribometer of 5049 degrees of freedom, Hz, by scipy 1.17.1 (`eigsh` around 0) on the files that
/// `squealcast tribometer --dof 5000` writes: upper part, lower part, and both on 294 springs of 1.251e7 N/m.
const UPPER_HZ: f64 = 345.31598983;
const LOWER_HZ: f64 = 1416.39250327;
const AT_REST_HZ: [f64; 18] = [
    535.34601038,
    581.58274521,
    769.87063164,
    788.83312115,
    1069.28532892,
    1426.38913532,
    1435.7105816,
    1561.17212141,
    1639.41996965,
    1873.34374447,
    2041.41169205,
    2572.60262847,
    2614.92812528,
    2662.07432085,
    2991.7462156,
    3357.17301088,
    3779.62934683,
    3831.83218997,
];

#[test]
fn the_paper_s_tables_on_a_small_tribometer() {
    let folder = folder();
    let out = folder.path();
    let expected = run(["reproduce", "--dof", "5000", "-o", &text(out)]).exits(0);
    eprintln!("{}", expected.stderr);
    let number = |row: &std::collections::HashMap<String, String>, column: &str| -> f64 {
        row[column].parse().unwrap_or_else(|error| panic!("{column} of {row:?}: {error}"))
    };
    // Both programs' modes have residuals of 1e-9 and less; nine digits were written down.
    let same = |found: f64, expected: f64| assert!((found / expected - 1.0).abs() < 1e-8, "{found} {expected}");
    let first: Vec<f64> = rows(out, "table-3").iter().map(|row| number(row, "frequency_hz")).collect();
    [UPPER_HZ, LOWER_HZ, AT_REST_HZ[0]].iter().zip(&first).for_each(|(&expected, &found)| same(found, expected));

    let table_4 = rows(out, "table-4");
    let of = |model: &str| -> Vec<_> { table_4.iter().filter(|row| row["model"].starts_with(model)).collect() };
    for (row, expected) in of("full model").iter().zip(AT_REST_HZ) {
        same(number(row, "frequency_hz"), expected);
    }
    let mean = |model: &str| -> f64 {
        let errors: Vec<f64> = of(model)
            .iter()
            .zip(AT_REST_HZ)
            .map(|(row, exact)| 100.0 * (number(row, "frequency_hz") / exact - 1.0).abs())
            .collect();
        assert_eq!(errors.len(), 18, "{model}");
        errors.iter().sum::<f64>() / 18.0
    };
    // One contact stiffness: below the paper's best (of 245+245 modes) with 40+40, and below 0.005 % with 80+80.
    for (model, limit_percent) in [
        ("40+40 with residual", 0.0713),
        ("80+80 with residual", 0.005),
        ("245+245 with residual", 0.005),
        ("basis of", 1e-4),
    ] {
        let found = mean(model);
        eprintln!("{model}: mean {found:.2e} %");
        assert!(found < limit_percent, "{model}: {found} %");
    }
    // The paper's way gets better with more modes, and fits them with a stiffer contact each time.
    let paper: Vec<(f64, f64)> = ["RM 1", "RM 2", "RM 3", "RM 4"]
        .iter()
        .map(|model| (mean(model), number(of(model)[0], "contact_stiffness_n_per_m")))
        .collect();
    eprintln!("the paper's way: {paper:?}");
    assert!(paper.windows(2).all(|pair| pair[0].1 < pair[1].1), "{paper:?}");
    assert!(paper[3].0 < paper[0].0 && paper[3].1 < 1.251e7, "{paper:?}");
    let published: Vec<f64> = of("RM 4").iter().map(|row| number(row, "paper_frequency_hz")).collect();
    assert_eq!((published[0], published[17]), (510.91, 3257.8));

    // Every window of the full model, within 0.5 % or 0.003 with 80+80 and within 0.05 % on the basis.
    let critical = rows(out, "critical-friction");
    let ends = |model: &str| -> Vec<f64> {
        let of = critical.iter().filter(|row| row["model"].starts_with(model));
        of.map(|row| {
            assert_ne!(row["window"], "invented", "{row:?}");
            number(row, "mu_from")
        })
        .collect()
    };
    let full = ends("full model");
    assert!(!full.is_empty());
    for (model, relative, absolute) in [("80+80 with residual", 5e-3, 3e-3), ("basis of", 5e-4, 0.0)] {
        let found = ends(model);
        assert_eq!(found.len(), full.len(), "{model}");
        for (found, full) in found.iter().zip(&full) {
            assert!((found - full).abs() < (relative * full).max(absolute), "{model}: {found} {full}");
        }
    }
    let basis =
        table_4.iter().find_map(|row| row["model"].strip_prefix("basis of ")?.strip_suffix(" vectors")?.parse().ok());
    assert!(basis.is_some_and(|vectors: usize| vectors <= 60), "{basis:?}");

    // Fig. 13 has its least error where Table 4 says.
    let curve = rows(out, "figure-13");
    let least = curve.iter().min_by(|a, b| number(a, "rms_error_percent").total_cmp(&number(b, "rms_error_percent")));
    assert!((number(least.unwrap(), "contact_stiffness_n_per_m") / paper[1].1 - 1.0).abs() < 1e-12);
    assert!((number(least.unwrap(), "mean_error_percent") / paper[1].0 - 1.0).abs() < 1e-3);
    for (figure, axis) in [
        ("figure-4", "frequency, rad/s"),
        ("figure-13", "contact stiffness of a pair"),
        ("figure-14", "growth rate, 1/s"),
        ("figure-15", "frequency, Hz"),
    ] {
        let drawn = std::fs::read_to_string(out.join(format!("{figure}.svg"))).unwrap();
        assert!(drawn.contains("<svg") && drawn.contains(axis), "{figure}");
    }
    let page = std::fs::read_to_string(out.join("index.html")).unwrap();
    let linked: Vec<&str> = page.split("href=\"#").skip(1).filter_map(|rest| rest.split('"').next()).collect();
    assert!(linked.len() > 8 && linked.iter().all(|name| page.contains(&format!("id=\"{name}\""))), "{linked:?}");
    for expected in
        ["Table 1", "Table 3", "Table 4", "Figure 13", "Figure 14", "Figure 15", "492 Hz", "1705 Hz", "331.44", "12510"]
    {
        assert!(page.contains(expected), "{expected}");
    }
}

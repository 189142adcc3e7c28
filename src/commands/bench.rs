use std::fmt::Write as _;
use std::path::PathBuf;
use std::time::Duration;

use clap::Args;
use serde::Serialize;

use super::{Outcome, positive, print, write_file};
use crate::evidence::bench::lapack::Lapack;
use crate::evidence::bench::{HeldOut, Kind, Offline, Plan, Route, measure};
use crate::figures::plot;
use crate::proof::stress;

const EXAMPLES: &str = "\
Examples:
  squealcast bench --modes 80 --conditions 100 --svg front.svg  error against run time
  squealcast bench --stress                                     the extreme cases";

/// Measure run time and error of every route to a prediction, on synthetic rigs
#[derive(Debug, Args)]
#[command(after_help = EXAMPLES)]
pub struct Options {
    /// Numbers of modes; 490 takes minutes longer
    #[arg(long, value_name = "N,N", value_delimiter = ',', default_value = "20,80,160,490", value_parser = clap::value_parser!(u16).range(4..=2000))]
    modes: Vec<u16>,
    /// Kind of rigs
    #[arg(long, value_enum, default_value = "undamped")]
    rig: Kind,
    /// Number of conditions: friction 0 to 1, 50 to 2000 N, 1 to 60 rad/s, one in ten within 1e-6 of a merging point
    #[arg(long, value_name = "N", default_value_t = 200, value_parser = clap::value_parser!(u32).range(1..))]
    conditions: u32,
    /// Modes of each condition that are compared with roots computed to thirty digits
    #[arg(long, value_name = "N", default_value_t = 2)]
    compared: usize,
    /// Random conditions at which every root of the chart, with its error bound, is compared with a dense solve
    #[arg(long, value_name = "N", default_value_t = 0)]
    held_out: usize,
    /// Contact pairs of the rigs
    #[arg(long, value_name = "N", default_value_t = 48, value_parser = clap::value_parser!(u16).range(1..))]
    pairs: u16,
    /// Seed of rigs and conditions; rigs are drawn from it until one has merging points
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Modes up to this frequency are charted and compared
    #[arg(long, value_name = "HZ", default_value_t = 5000.0, value_parser = positive)]
    band_max_hz: f64,
    /// Relative tolerance of charts for squared eigenvalues
    #[arg(long, default_value_t = 1e-8, value_parser = positive)]
    tolerance: f64,
    /// Time limit for building a chart; conditions it does not cover by then are solved
    #[arg(long, value_name = "S", default_value_t = 30.0, value_parser = positive)]
    chart_limit_s: f64,
    /// Threads that build charts; a single prediction always uses one thread
    #[arg(long, value_name = "N", default_value_t = 2, value_parser = clap::value_parser!(u16).range(1..))]
    threads: u16,
    /// A Python with scipy, whose LAPACK solves the same matrices for comparison
    #[arg(long, value_name = "PYTHON")]
    lapack: Option<PathBuf>,
    /// Run extreme cases instead, and print their results
    #[arg(long)]
    stress: bool,
    /// Write the results as JSON to this file
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
    /// Write the results as CSV to this file
    #[arg(long, value_name = "FILE")]
    csv: Option<PathBuf>,
    /// Draw error against run time to this file
    #[arg(long, value_name = "FILE")]
    svg: Option<PathBuf>,
}

/// The output of `bench --json`.
#[derive(Serialize)]
struct Report {
    machine: String,
    lapack: Option<String>,
    conditions: String,
    routes: Vec<Route>,
    offline: Vec<Offline>,
}

impl Options {
    pub fn run(self) -> anyhow::Result<Outcome> {
        if self.stress {
            return stress_table();
        }
        let plan = Plan {
            kind: self.rig,
            conditions: self.conditions as usize,
            compared: self.compared,
            held_out: self.held_out,
            pairs: usize::from(self.pairs),
            seed: self.seed,
            band_max_hz: self.band_max_hz,
            tolerance: self.tolerance,
            chart_limit: Duration::from_secs_f64(self.chart_limit_s),
            threads: usize::from(self.threads),
        };
        let mut lapack = self.lapack.as_deref().map(Lapack::start).transpose()?;
        let mut report = Report {
            machine: machine(),
            lapack: lapack.as_ref().map(|peer| format!("{}, one thread", peer.versions)),
            conditions: format!(
                "{:?} rigs, {} contact pairs, seeds from {}; {} conditions, friction 0 to 1, 50 to 2000 N, 1 to 60 rad/s, one in ten within 1e-6 of a merging point where the rig has any; up to {} Hz",
                self.rig, self.pairs, self.seed, self.conditions, self.band_max_hz
            ),
            routes: vec![],
            offline: vec![],
        };
        for &modes in &self.modes {
            let say = |what: &str| note!("n = {modes}: {what}");
            let (routes, offline) = measure(usize::from(modes), &plan, lapack.as_mut(), &say)?;
            report.routes.extend(routes);
            report.offline.push(offline);
        }
        print(&table(&report))?;
        if let Some(path) = &self.json {
            write_file(path, (serde_json::to_string_pretty(&report)? + "\n").as_bytes())?;
        }
        if let Some(path) = &self.csv {
            let mut writer = csv::Writer::from_writer(vec![]);
            report.routes.iter().try_for_each(|route| writer.serialize(route))?;
            write_file(path, &writer.into_inner()?)?;
        }
        if let Some(path) = &self.svg {
            write_file(path, plot::front(&report.machine, &report.routes)?.as_bytes())?;
        }
        let held_out_wrong = |offline: &Offline| offline.held_out.is_some_and(|h| h.bounds_broken + h.incomplete > 0);
        let broken =
            report.routes.iter().any(|route| route.bounds_broken > 0) || report.offline.iter().any(held_out_wrong);
        Ok(if broken { Outcome::Differences } else { Outcome::Done })
    }
}

/// Processor, number of cores and load.
fn machine() -> String {
    let cpu = std::fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
    let name = cpu.lines().find_map(|line| line.strip_prefix("model name")?.split_once(": "));
    let name = name.map_or("unknown processor", |(_, name)| name);
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    let load = std::fs::read_to_string("/proc/loadavg").unwrap_or_default();
    format!("{name}, {cores} cores, load {}", load.split_whitespace().next().unwrap_or("unknown"))
}

fn table(report: &Report) -> String {
    let mut text = format!("{}\n{}\n", report.machine, report.conditions);
    if let Some(lapack) = &report.lapack {
        let _ = writeln!(text, "LAPACK: {lapack}");
    }
    let _ = writeln!(
        text,
        "\n{:>4}  {:20}{:>10}{:>12}{:>12}{:>10}  {:>9}{:>9}  {:>9}{:>9}  {:>13}",
        "n",
        "route",
        "conditions",
        "median, us",
        "p99, us",
        "x LAPACK",
        "error",
        "largest",
        "pair mean",
        "discr.",
        "bounds broken"
    );
    let optional = |value: Option<f64>| value.map_or("-".to_owned(), |value| format!("{value:.1e}"));
    for route in &report.routes {
        let ratio = route.to_lapack.map_or("-".to_owned(), |ratio| super::format::significant(ratio, 3));
        let broken = match route.bounds_checked {
            0 => "-".to_owned(),
            checked => format!("{} of {checked}", route.bounds_broken),
        };
        let _ = writeln!(
            text,
            "{:>4}  {:20}{:>10}{:>12.2}{:>12.2}{:>10}  {:>9.1e}{:>9.1e}  {:>9}{:>9}  {:>13}",
            route.modes,
            route.route,
            route.conditions,
            route.median_us,
            route.p99_us,
            ratio,
            route.median_error,
            route.largest_error,
            optional(route.largest_pair_mean_error),
            optional(route.largest_discriminant_error),
            broken
        );
    }
    let _ =
        writeln!(text, "\nerrors: relative, of the squared eigenvalue; pairs near merging by mean and discriminant");
    for offline in &report.offline {
        let Offline { modes, seed, merging_points, near_merging, decoupled_modes, .. } = offline;
        let Offline { map_s, chart_s, chart_solves, chart_leaves, chart_bytes, .. } = offline;
        let _ = write!(
            text,
            "n = {modes}, seed {seed}: {merging_points} merging points mapped in {map_s:.1} s, {near_merging} of {} conditions within 1e-6 of one; {decoupled_modes} decoupled modes left out; ",
            offline.conditions
        );
        let whole = if offline.chart_complete { "" } else { " not whole" };
        let _ = writeln!(
            text,
            "chart{whole}: {chart_s:.1} s, {chart_solves} solves, {chart_leaves} leaves, {chart_bytes} bytes, {:.1e} of the box dense; {} of {} dense solves skipped",
            offline.chart_dense_share, offline.dense_solves_skipped, offline.conditions
        );
        let (pairs, lost) = (offline.pairs_compared, offline.not_refined);
        let _ = writeln!(text, "         {pairs} merging pairs compared, {lost} roots without a reference");
        if let Some(held_out) = &offline.held_out {
            let HeldOut { charted, not_converged, incomplete, bounds_broken, .. } = held_out;
            let HeldOut { largest_share, largest_error, largest_pair_mean_error, .. } = held_out;
            let _ = writeln!(
                text,
                "         held out: {charted} conditions charted, {not_converged} dense; {bounds_broken} bounds broken, errors up to {largest_share:.2} of them, {incomplete} incomplete; largest error {largest_error:.1e}, of pair means {largest_pair_mean_error:.1e}"
            );
        }
    }
    text
}

/// Runs all stress cases and prints their results; reports differences if one fails.
fn stress_table() -> anyhow::Result<Outcome> {
    let mut outcome = Outcome::Done;
    for case in stress::cases() {
        let found = (case.run)();
        let verdict = match &found {
            Ok(said) => format!("ok    {said}"),
            Err(said) => {
                outcome = Outcome::Differences;
                format!("WRONG {said}")
            }
        };
        print(&format!("{:60} {verdict}\n", case.what))?;
    }
    Ok(outcome)
}

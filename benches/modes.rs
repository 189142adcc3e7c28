//! Time and memory of the lowest modes of a free annular disc of bricks, at several sizes, compared with SLEPc with MUMPS on the
//! same matrices:
//!
//! ```text
//! cargo bench --bench modes -- 20000 50000 100000 --repeat 3 --slepc /usr/bin/python3
//! ```
//!
//! Every solution runs in a separate process, whose memory the system reports; ours and SLEPc's alternate. Frequencies
//! are compared before a time is printed. A disc has pairs of equal frequencies and six rigid motions: none may be missed.
//! SLEPc is Debian's `python3-slepc4py`, one process, its factorisation MUMPS.

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::Instant;

use anyhow::{Context, ensure};
use clap::Parser;
use serde::{Deserialize, Serialize};
use squealcast::fem::{Assembled, Extent, Material, Mesh, Structure, stations};
use squealcast::reduction::lowest_modes;

#[derive(Parser)]
struct Options {
    /// Degrees of freedom, at least
    #[arg(default_values_t = [20_000])]
    dof: Vec<usize>,
    /// Modes wanted
    #[arg(long, default_value_t = 80)]
    modes: usize,
    /// Solutions of each program
    #[arg(long, default_value_t = 1)]
    repeat: usize,
    /// A Python with slepc4py
    #[arg(long, value_name = "PYTHON")]
    slepc: Option<PathBuf>,
    /// Solve once in this process and print it as JSON
    #[arg(long, hide = true)]
    once: bool,
    /// passed by `cargo bench`
    #[arg(long, hide = true)]
    bench: bool,
}

/// One solution.
#[derive(Serialize, Deserialize)]
struct Solution {
    seconds: f64,
    /// Largest memory of the process from when it held the matrices, MB.
    peak_mb: f64,
    #[serde(default)]
    degrees_of_freedom: usize,
    /// `ω²`, rad²/s², ascending.
    omega_squared: Vec<f64>,
}

/// A steel disc of 140 mm with a bore of 20 mm, 13.5 mm thick, free, in bricks of equal sides, of at least `dof`.
fn disc(dof: usize) -> anyhow::Result<Assembled> {
    let (bore, radius, thickness, turn) = (0.020, 0.140, 0.0135, std::f64::consts::TAU);
    let with_spacing = |spacing_m: f64| {
        let mut mesh = Mesh::default();
        let steel = Material { density_kg_per_m3: 7850.0, young_pa: 210e9, poisson: 0.3 };
        let component = mesh.add_component("disc", steel);
        let around = stations(&[0.0, turn], spacing_m / (0.5 * (bore + radius)));
        let lines = [stations(&[bore, radius], spacing_m), stations(&[0.0, thickness], spacing_m), around];
        let extent = Extent { filled: &|_| true, closed: true };
        mesh.add_block(component, lines, extent, &[], |[r, y, t]| [r * t.cos(), y, r * t.sin()]);
        Structure { mesh, ..Structure::default() }
    };
    let mut spacing_m = 0.01;
    while with_spacing(spacing_m).dof() < dof {
        spacing_m *= 0.98;
    }
    Ok(with_spacing(spacing_m).assemble()?)
}

/// From here on the system counts the largest memory of this process anew.
fn forget_peak() -> std::io::Result<()> {
    std::fs::write("/proc/self/clear_refs", "5")
}

fn peak_mb() -> anyhow::Result<f64> {
    let status = std::fs::read_to_string("/proc/self/status")?;
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:")).context("no VmHWM")?;
    Ok(line.trim().trim_end_matches(" kB").parse::<f64>()? / 1024.0)
}

fn once(dof: usize, modes: usize) -> anyhow::Result<()> {
    let Assembled { stiffness, mass, rows } = disc(dof)?;
    let degrees_of_freedom = rows.len();
    drop(rows);
    forget_peak()?;
    let began = Instant::now();
    let found = lowest_modes("disc", &mass, &stiffness, modes)?;
    let seconds = began.elapsed().as_secs_f64();
    let solution = Solution { seconds, peak_mb: peak_mb()?, degrees_of_freedom, omega_squared: found.omega_squared };
    println!("{}", serde_json::to_string(&solution)?);
    Ok(())
}

fn solution(command: &mut Command) -> anyhow::Result<Solution> {
    let output = command.stderr(Stdio::inherit()).output().with_context(|| format!("{command:?}"))?;
    ensure!(output.status.success(), "{command:?}: {}", output.status);
    Ok(serde_json::from_slice(&output.stdout)?)
}

/// Compressed columns as raw little-endian arrays: column starts and rows of 32 bits, values of 64.
fn write_raw(matrix: &squealcast::reduction::SparseMatrix, to: &Path) -> anyhow::Result<()> {
    let indices = |of: &[usize]| of.iter().flat_map(|index| (*index as u32).to_le_bytes()).collect::<Vec<u8>>();
    std::fs::write(to.with_extension("starts"), indices(matrix.col_ptr()))?;
    std::fs::write(to.with_extension("rows"), indices(matrix.row_idx()))?;
    let values: Vec<u8> = matrix.val().iter().flat_map(|value| value.to_le_bytes()).collect();
    Ok(std::fs::write(to.with_extension("values"), values)?)
}

/// Largest relative difference of `ω²`; rigid motions, whose `ω²` is rounding, count by the first elastic mode.
fn difference(ours: &[f64], theirs: &[f64]) -> f64 {
    let first_elastic = ours.get(6).copied().unwrap_or(f64::INFINITY);
    let relative = |(a, b): (&f64, &f64)| (a - b).abs() / a.abs().max(first_elastic);
    ours.iter().zip(theirs).map(relative).fold(0.0, f64::max)
}

fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

fn main() -> anyhow::Result<()> {
    let options = Options::parse();
    if options.once {
        return once(options.dof[0], options.modes);
    }
    println!("{} modes; medians of {} in turn", options.modes, options.repeat);
    println!("     dof     ours, s  ours, MB    SLEPc, s  SLEPc, MB     time  difference of the squares");
    for &dof in &options.dof {
        let folder = tempfile::tempdir()?;
        if options.slepc.is_some() {
            let Assembled { stiffness, mass, .. } = disc(dof)?;
            write_raw(&stiffness, &folder.path().join("K"))?;
            write_raw(&mass, &folder.path().join("M"))?;
        }
        let (mut ours, mut theirs) = (vec![], vec![]);
        for _ in 0..options.repeat {
            let arguments = [dof.to_string(), format!("--modes={}", options.modes), "--once".to_owned()];
            ours.push(solution(Command::new(std::env::current_exe()?).args(arguments))?);
            if let Some(python) = &options.slepc {
                // The shift is that of a tenth of the first elastic mode below zero.
                let shift = -0.1 * ours[0].omega_squared.get(6).context("no elastic mode")?;
                let script = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/peers/slepc_modes.py");
                let mut command = Command::new(python);
                command.arg(script).arg(folder.path()).args([options.modes.to_string(), shift.to_string()]);
                theirs.push(solution(&mut command)?);
            }
        }
        let largest =
            theirs.iter().map(|other| difference(&ours[0].omega_squared, &other.omega_squared)).fold(0.0, f64::max);
        let solved = ours.first().map_or(0, |one| one.degrees_of_freedom);
        ensure!(largest < 1e-9, "{solved} degrees of freedom: squares differ by {largest:e} relative");
        let seconds = |all: &[Solution]| median(all.iter().map(|one| one.seconds).collect());
        let peak = |all: &[Solution]| median(all.iter().map(|one| one.peak_mb).collect());
        print!("{solved:>8}  {:>10.1}  {:>8.0}", seconds(&ours), peak(&ours));
        if !theirs.is_empty() {
            let ratio = seconds(&ours) / seconds(&theirs);
            print!("  {:>10.1}  {:>9.0}  {ratio:>7.2}  {largest:.1e}", seconds(&theirs), peak(&theirs));
        }
        println!();
    }
    Ok(())
}

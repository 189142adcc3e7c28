use std::f64::consts::TAU;
use std::ffi::OsString;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use anyhow::{Context, bail};
use clap::{Args, Parser};

use super::engine::EngineOptions;
use super::memory::{keep_freed_unless, return_freed_by, room, solver};
use super::on_basis::{Ranges, TOLERANCE, basis_of, ranges};
use super::signals::on_stop;
use super::steps::{ProgressOptions, Steps};
use super::{Outcome, failure, positive, print};
use crate::export::{
    ExportError, HASH_DIGITS, ModalSide, basis_rig, modal_rig, modal_sides, source_remarks, state_on_modes,
};
use crate::files::input_file;
use crate::files::whole_file::{remove_begun, write_together};
use crate::full_model::FullModelFile;
use crate::full_model::slepc::end_all;
use crate::full_model::verification::{Against, Verified, verify_against};
use crate::physics::{ContactLaw, ResidualFlexibility};
use crate::reduction::{Engine, FullSolver, Kept, Residual, Wanted};
use crate::rig::{Certificate, Rig, RigFile, SideResidual, between_patches};

/// Makes the files of the rig, with the certificate if the rig has been compared.
type FilesOf<'a> = dyn Fn(Option<&Certificate>) -> Result<Vec<RigFile>, ExportError> + 'a;

/// Default cut-off of the modes kept, relative to the band, if `--cutoff-hz` has no value.
const CUTOFF: f64 = 2.5;

const EXAMPLES: &str = "\
Examples:
  squealcast reduce model/tribometer.toml -o rig.toml                on a basis of its vectors
  squealcast reduce model/tribometer.toml --modes 80+80 -o rig.toml  on modes of the parts";

/// Reduce a full model to a rig file the node can run
///
/// By default the basis consists of the full model's own vectors over a range of conditions: every root in the band
/// that grows, or decays by less than 20 1/s, is within a tolerance. With --modes or --cutoff-hz it consists of the
/// lowest free-interface modes of pad and disc, with the residual flexibility of the truncated modes. The rig is
/// compared with the full model at held-out operating points, and the rig file contains the result. The arrays are
/// written to the folder of the rig file under names with their hash, and the rig file last.
#[derive(Debug, Args)]
#[command(after_help = EXAMPLES)]
pub struct Options {
    /// Full model
    #[arg(value_name = "FULL.toml")]
    full: PathBuf,
    /// Largest relative error of a root on the basis within the range [default: 1e-6]
    #[arg(long, value_name = "ERROR", value_parser = positive, conflicts_with = "of_modes")]
    tolerance: Option<f64>,
    /// Range of conditions for which the basis is valid [default: those of [search] and [chart]]
    #[arg(long, value_name = "mu=A:B,speed=A:B,load=A:B", value_parser = ranges,
          conflicts_with = "of_modes")]
    range: Option<Ranges>,
    /// Modes of pad and disc to keep
    #[arg(long, value_name = "I+J", value_parser = mode_counts, group = "of_modes")]
    modes: Option<ModeCounts>,
    /// Keep the modes of pad and disc below this frequency [without a value: 2.5 times the band]
    #[arg(long, value_name = "HZ", value_parser = positive, num_args = 0..=1, group = "of_modes")]
    cutoff_hz: Option<Option<f64>>,
    /// Omit residual flexibility: the static response of truncated modes at the contact
    #[arg(long, requires = "of_modes")]
    no_residual: bool,
    /// Store residual flexibility between this model's contact pairs only: a twelfth of the size, but no other patches
    #[arg(long, conflicts_with = "no_residual", requires = "of_modes")]
    compact: bool,
    /// Held-out operating points at which the rig is compared with the full model; 0 omits the comparison
    #[arg(long, value_name = "N", default_value_t = 3)]
    points: usize,
    /// Memory that may be used [default: the memory available on the machine]
    #[arg(long, value_name = "GIB", value_parser = positive)]
    memory_gib: Option<f64>,
    #[command(flatten)]
    engine: EngineOptions,
    /// Rig file to write
    #[arg(short, long, value_name = "RIG.toml")]
    output: PathBuf,
    #[command(flatten)]
    progress: ProgressOptions,
}

/// Number of modes to keep of each part.
#[derive(Clone, Debug)]
struct ModeCounts(Vec<usize>);

/// Parses `80+80`, or `80` for a pad on a rigid disc, for clap.
fn mode_counts(text: &str) -> Result<ModeCounts, String> {
    let counts: Result<Vec<usize>, String> = text
        .split('+')
        .map(|count| match count.trim().parse::<usize>() {
            Ok(count) if count > 0 => Ok(count),
            Ok(_) => Err("0 modes requested, expected at least 1 of each part".to_owned()),
            Err(error) => Err(format!("`{count}`: {error}; expected counts such as 80+80")),
        })
        .collect();
    counts.map(ModeCounts)
}

/// Tasks whose progress is shown: pad and disc.
const TASKS: usize = 2;

/// The arguments of the command for other programs.
#[derive(Debug, Parser)]
#[command(name = "squealcast reduce", no_binary_name = true)]
struct Words {
    #[command(flatten)]
    options: Options,
}

/// Reduces as the command with these `words` does, without output and signal handlers. Returns the rig, and whether it was
/// compared and agrees with the full model in modes and windows. Once `stopped` is set, the next step of the work unwinds
/// with the payload [`Stopped`](super::Stopped); nothing is written then.
///
/// # Errors
/// What the command prints.
pub fn reduce_quietly(words: &[OsString], stopped: Arc<AtomicBool>) -> Result<(Rig, bool), String> {
    let Words { options } = Words::try_parse_from(words).map_err(|error| error.to_string())?;
    let reduced = options.reduce(Steps::until(stopped, TASKS));
    reduced.map(|(rig, outcome)| (rig, outcome == Outcome::Done)).map_err(|error| failure(&error))
}

impl Options {
    pub fn run(self) -> anyhow::Result<Outcome> {
        keep_freed_unless(self.memory_gib);
        on_stop(|| {
            remove_begun();
            end_all();
            note!("\nstopped: nothing was written");
            std::process::exit(130);
        })?;
        let steps = self.progress.steps(TASKS);
        let (rig, outcome) = self.reduce(steps)?;
        print(&format!("{}\n", rig.describe()))?;
        Ok(outcome)
    }

    /// Reduces the model and writes the files of the rig.
    fn reduce(&self, mut steps: Steps) -> anyhow::Result<(Rig, Outcome)> {
        let file = self.output_file()?;
        let chosen = self.engine.choose()?;
        let engine = chosen.engine();
        steps.say(&format!("reading {}", self.full.display()));
        let mut full = FullModelFile::load(&self.full)?;
        steps.say(&format!("{} degrees of freedom read", full.model.dimension()));
        let room = room(self.memory_gib, &self.full)?;
        full.damp_modes(engine, room, &mut |_, _| {})?;
        full.find_statics(engine, room)?;
        let full = full;
        if self.modes.is_none() && self.cutoff_hz.is_none() {
            if full.geometry.len() == 1 {
                bail!(
                    "{}: a pad on a rigid disc cannot be reduced on a basis; expected --modes or --cutoff-hz",
                    self.full.display()
                );
            }
            let (tolerance, range) = (self.tolerance.unwrap_or(TOLERANCE), self.range.unwrap_or_default());
            steps.say("ordering and analysing");
            let mut solver = solver(engine, &full, room, &mut |step| steps.full("full model", step))?;
            let (request, basis) = basis_of(&full, tolerance, range, &mut solver, &mut steps)?;
            let method = format!("{} vectors of the full model", basis.projected.omega_squared.len());
            let make = |known: Option<&Certificate>| basis_rig(&file, &full, &request, &basis, known);
            return self.finish(engine, steps, &full, Some(solver), method, &make);
        }
        if full.geometry.is_empty() {
            bail!("{}: a system without pad and disc has no modes of its parts to keep", self.full.display());
        }
        // Residual flexibility admits every law but stiffness that varies with the load.
        let ContactLaw { exponent, reference_n: _, slope_s_per_m: _, stribeck: _, lateral_damping: _ } =
            full.settings.contact_law;
        if exponent != 0.0 && !self.no_residual {
            bail!(
                "{}: `load.exponent` is {exponent}: residual flexibility requires contact stiffness independent of the load; \
                 expected 0, --no-residual, or a basis (neither --modes nor --cutoff-hz)",
                self.full.display()
            );
        }
        let wanted = self.wanted(&full)?;
        let names: Vec<&str> = full.model.parts.iter().map(|part| part.name.as_str()).collect();
        let kept = full.keep_modes(engine, &wanted, !self.no_residual, room, &mut |part, what| {
            return_freed_by(&what);
            steps.modes(part, names[part], what);
        })?;
        for (name, Kept { modes, .. }) in names.iter().zip(&kept) {
            let worst = modes.residuals.iter().copied().fold(0.0, f64::max);
            steps.say(&format!(
                "{name}: {} modes, residuals |K x - w^2 M x| / |K x| at most {worst:.1e}",
                modes.residuals.len()
            ));
        }
        let mut sides = modal_sides(&full, &kept)?;
        let state = state_on_modes(&full, &kept);
        let residual = if self.compact { between_pairs(&file, &full, &mut sides)? } else { None };
        let (kept, mut remarks) = (remarks(&names, &kept), source_remarks(&full));
        remarks.extend(kept.iter().cloned());
        remarks.extend(chosen.remark().map(|by| format!("modes and residual flexibility by {by}")));
        let make = |known: Option<&Certificate>| {
            let (patches, mut common) = (full.contact_patches.as_ref(), full.common_tables.clone());
            common.extend(state.iter().map(|state| ("contact_state".to_owned(), state.table.clone().into())));
            let mut files = modal_rig(&file, &remarks, &common, patches, known, &sides, residual.as_ref())?;
            files.extend(state.iter().flat_map(|state| state.files.clone()));
            Ok(files)
        };
        self.finish(engine, steps, &full, None, kept.join("; "), &make)
    }

    /// The name of the rig file; an error if it cannot be written or is the input.
    fn output_file(&self) -> anyhow::Result<String> {
        let output = self.output.display();
        let folder = self.output.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
        let Some(file) = self.output.file_name().filter(|_| folder.is_dir() && !self.output.is_dir()) else {
            bail!("{output}: cannot write; expected a file in a folder that is there");
        };
        if let (Ok(read), Ok(written)) = (self.full.canonicalize(), self.output.canonicalize())
            && read == written
        {
            bail!("{output}: is the full model itself; expected another file for the rig");
        }
        Ok(file.to_string_lossy().into_owned())
    }

    /// Compares the reduced rig with the full model and writes its files, including the errors found.
    fn finish<'a>(
        &self,
        engine: &'a dyn Engine,
        mut steps: Steps,
        full: &'a FullModelFile,
        solver: Option<FullSolver<'a>>,
        method: String,
        files_of: &FilesOf<'_>,
    ) -> anyhow::Result<(Rig, Outcome)> {
        let make = |known: Option<&Certificate>| -> anyhow::Result<(Vec<RigFile>, Rig)> {
            let files = files_of(known)?;
            let rig = Rig::from_files(&files).context("the reduced model is not a valid rig")?;
            Ok((files, rig))
        };
        let (mut files, mut rig) = make(None)?;
        let mut outcome = Outcome::Done;
        if self.points > 0 {
            let against = Against { points: self.points, seed: 1, band_hz: None, windows: true };
            let mut report = |what: &str, step| steps.full(&format!("compared with the full model, {what}"), step);
            let compare = || -> anyhow::Result<Verified> {
                let mut solver = match solver {
                    Some(solver) => solver,
                    None => self::solver(engine, full, room(self.memory_gib, &self.full)?, &mut |step| {
                        report("analysis", step)
                    })?,
                };
                verify_against(&rig, full, &mut solver, &against, &mut report).map_err(anyhow::Error::from)
            };
            let found = compare();
            match found {
                Ok(found) => {
                    if !found.certificate.is_complete() {
                        outcome = Outcome::Differences;
                    }
                    (files, rig) = make(Some(&Certificate { method, ..found.certificate }))?;
                }
                // The rig is kept: it took long to compute, and `verify --against` can repeat the comparison.
                Err(error) => {
                    steps.say(&format!("not compared with the full model: {error:#}"));
                    outcome = Outcome::Differences;
                }
            }
        }
        let replaced = replaced(&self.output, &files);
        // The rig file, which is the first, names the others.
        let folder = self.output.parent().unwrap_or(Path::new(""));
        write_together(files.iter().rev().map(|file| (folder.join(&file.name), &file.bytes[..])))?;
        // The new rig file does not name these files. One that cannot be removed does no harm.
        replaced.into_iter().for_each(|path| drop(std::fs::remove_file(path)));
        steps.say(&format!("{} written", self.output.display()));
        Ok((rig, outcome))
    }

    /// Which modes to keep of each part.
    fn wanted(&self, full: &FullModelFile) -> anyhow::Result<Vec<Wanted>> {
        let parts = full.geometry.len();
        if let Some(ModeCounts(counts)) = &self.modes {
            if counts.len() != parts {
                bail!("--modes has {} counts, expected one for each of {parts} parts", counts.len());
            }
            return Ok(counts.iter().map(|&count| Wanted::Lowest(count)).collect());
        }
        let of_band = full.settings.band_max_hz.map(|band_hz| CUTOFF * band_hz);
        let Some(cutoff_hz) = self.cutoff_hz.flatten().or(of_band) else {
            bail!("{}: `band.max_hz` is missing; expected it, or a value of --cutoff-hz", self.full.display());
        };
        Ok(vec![Wanted::Below(TAU * cutoff_hz); parts])
    }
}

/// Residual flexibility and inertia of pad and disc between the contact pairs of `full`. They are moved out of `sides`.
fn between_pairs(
    file: &str,
    full: &FullModelFile,
    sides: &mut [ModalSide<'_>],
) -> anyhow::Result<Option<ResidualFlexibility>> {
    let ([pad, disc], Some(patches)) = (sides, &full.contact_patches) else {
        bail!("{}: --compact is for a pad on a disc that is not rigid", full.path.display());
    };
    let mut known = vec![];
    for (disc, side) in [(false, &mut *pad), (true, &mut *disc)] {
        let of_side = |residual: &'_ Residual| (disc, residual.clone());
        known.extend(side.residual.take().map(of_side));
    }
    let known: Vec<SideResidual<'_>> = known
        .iter()
        .map(|(disc, residual)| SideResidual {
            disc: *disc,
            flexibility: &residual.flexibility,
            inertia: Some(&residual.inertia),
        })
        .collect();
    Ok(Some(between_patches(file, patches, [&pad.nodes_m, &disc.nodes_m], &known)?))
}

/// Comments for the head of the rig file: the modes kept of each part.
fn remarks(names: &[&str], kept: &[Kept]) -> Vec<String> {
    let mut lines = vec![];
    for (name, kept) in names.iter().zip(kept) {
        let highest = kept.modes.omega_squared.last().map_or(0.0, |square| square.max(0.0).sqrt() / TAU);
        lines.push(format!(
            "{name}: {} modes up to {highest:.1} Hz, {}",
            kept.modes.omega_squared.len(),
            if kept.residual.is_some() { "with the residual of all others" } else { "without residual of the others" }
        ));
    }
    lines
}

/// Files named by the existing rig file at `path` that this command created and that are no longer needed: neither
/// `files` nor another rig file in the folder names them.
fn replaced(path: &Path, files: &[RigFile]) -> Vec<PathBuf> {
    let text = input_file::read_text(path, input_file::TOML).unwrap_or_default();
    let Some(stem) = path.file_stem() else { return vec![] };
    let start = format!("{}-", stem.to_string_lossy());
    let named = |text: &str| -> Option<PathBuf> {
        let (rest, kind) = text.strip_prefix(&start)?.rsplit_once('.')?;
        let hash = rest.rsplit('-').next().unwrap_or_default();
        let ours = ["npz", "mtx"].contains(&kind)
            && hash.len() == HASH_DIGITS
            && hash.bytes().all(|digit| digit.is_ascii_hexdigit())
            && !text.contains(['/', '\\']);
        (ours && files.iter().all(|file| file.name != text)).then(|| path.with_file_name(text))
    };
    fn strings(value: &toml::Value, visit: &mut dyn FnMut(&str)) {
        match value {
            toml::Value::String(text) => visit(text),
            toml::Value::Array(values) => values.iter().for_each(|value| strings(value, visit)),
            toml::Value::Table(table) => table.iter().for_each(|(_, value)| strings(value, visit)),
            _ => {}
        }
    }
    let mut found = vec![];
    let table = text.parse::<toml::Table>().unwrap_or_default();
    strings(&table.into(), &mut |text| found.extend(named(text)));
    // A copy of the rig file may still name them.
    let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let others = std::fs::read_dir(folder).into_iter().flatten().flatten().map(|entry| entry.path());
    let others = others.filter(|other| other.extension().is_some_and(|kind| kind == "toml"));
    let others = others.filter(|other| other.file_name() != path.file_name());
    let text = |other: PathBuf| input_file::read_text(&other, input_file::TOML).ok();
    let texts: Vec<String> = others.filter_map(text).collect();
    let name = |path: &PathBuf| path.file_name().unwrap_or_default().to_string_lossy().into_owned();
    found.retain(|path| texts.iter().all(|text| !text.contains(&name(path))));
    found
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn counts_of_modes() {
        assert_eq!(mode_counts("80+75").unwrap().0, [80, 75]);
        assert_eq!(mode_counts("12").unwrap().0, [12]);
        for (text, expected) in [("80+", "expected counts such as 80+80"), ("0+3", "at least 1"), ("a", "`a`")] {
            assert!(mode_counts(text).unwrap_err().contains(expected), "{text}");
        }
    }
}

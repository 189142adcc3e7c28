use std::path::{Component, Path, PathBuf};

use anyhow::{Context, anyhow, bail};
use clap::Args;
use serde::Serialize;

use super::{Outcome, RigName, positive, print, write_file};
use crate::figures::plot;
use crate::files::input_file;
use crate::files::whole_file::{folder_of, write_together};
use crate::import::tribometer_log::decode_text;
use crate::physics::identification::{
    IdentificationError, Identified, IdentifiedExponent, identify, identify_exponent,
};
use crate::physics::{ModelError, OperatingPoint, SolveError, Solver, Vectors};
use crate::rig::{Rig, RigFile};

/// The stiffness counts as poorly determined if the error stays within twice its minimum over more than this factor.
const WELL_DETERMINED: f64 = 2.0;

const EXAMPLES: &str = "\
Examples:
  squealcast identify my-rig.toml --targets measured.csv -o fitted.toml  fit the contact stiffness";

/// Find the contact stiffness that fits measured or computed natural frequencies at rest
///
/// With frequencies at several loads it also finds the exponent with which the stiffness follows the load, of rigs whose
/// contact has one: `[load] exponent`, or that of a power law in `[contact_state]`.
#[derive(Debug, Args)]
#[command(after_help = EXAMPLES)]
pub struct Options {
    /// Rig file, or the name of an embedded rig
    #[arg(value_parser = RigName, hide_possible_values = true)]
    rig: String,
    /// CSV file with a column `frequency_hz`: the natural frequencies of the rig at rest; with a column `normal_load_n` if they
    /// are of several loads
    #[arg(long, value_name = "FREQ.csv")]
    targets: PathBuf,
    /// Fit this many of the lowest frequencies of each load [default: all of them]
    #[arg(long, value_name = "COUNT")]
    first: Option<usize>,
    /// Normal load in N of frequencies without a column `normal_load_n` [default: the rig's reference]
    #[arg(long, value_name = "N", value_parser = positive)]
    load: Option<f64>,
    /// Write the rig with the stiffness found, together with the archives it refers to
    #[arg(short, long, value_name = "RIG.toml")]
    output: Option<PathBuf>,
    /// Draw the error over the stiffness factor into this file
    #[arg(long, value_name = "FILE")]
    svg: Option<PathBuf>,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

/// The output of `identify --json`; errors are relative.
#[derive(Serialize)]
struct Report<'a> {
    stiffness_factor: f64,
    stiffness_n_per_m: [f64; 2],
    rms_error: f64,
    mean_error: f64,
    largest_error: f64,
    /// Range of factors over which the error is at most twice its minimum.
    factor_from: Option<f64>,
    factor_to: Option<f64>,
    /// Relative change of the frequencies (rms) per relative change of the stiffness.
    sensitivity: f64,
    frequency_hz: &'a [f64],
    target_hz: &'a [f64],
    /// Load of each frequency.
    normal_load_n: Vec<f64>,
    /// Exponent of the load, if it was fitted.
    #[serde(skip_serializing_if = "Option::is_none")]
    exponent: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    exponent_standard_error: Option<f64>,
}

/// Natural frequencies at one load, ascending.
#[derive(Clone, Debug, PartialEq)]
struct Targets {
    normal_load_n: f64,
    frequency_hz: Vec<f64>,
}

impl Options {
    pub fn run(self) -> anyhow::Result<Outcome> {
        let rig = Rig::load(&self.rig)?;
        let targets = self.targets_of(&rig)?;
        let target_hz: Vec<f64> = targets.iter().flat_map(|at| at.frequency_hz.iter().copied()).collect();
        rig.has_stiffness_to_scale()?;
        let failed = |error: IdentificationError<anyhow::Error>| match error {
            IdentificationError::Model(error) => error,
            other => anyhow!("{} and {}: {other}", rig.name, self.targets.display()),
        };
        let mut law = None;
        if let (Some(present), true) = (rig.load_exponent(), targets.len() > 1) {
            let start = identify(&target_hz, &mut |factor| at_rest_hz(&rig, &targets, factor)).map_err(failed)?;
            let mut of_exponent = rig.clone();
            let mut tried = present.value;
            let fitted = identify_exponent(
                &target_hz,
                (start.best.factor, present.value),
                present.range,
                &mut |factor, exponent| {
                    if exponent != tried {
                        (of_exponent, tried) = (rig.with_load_exponent(exponent)?, exponent);
                    }
                    at_rest_hz(&of_exponent, &targets, factor)
                },
            );
            law = Some(fitted.map_err(failed)?);
        }
        let with_law = match &law {
            Some(fitted) => rig.with_load_exponent(fitted.exponent)?,
            None => rig.clone(),
        };
        let load = targets.first().map_or(rig.reference.normal_load_n, |at| at.normal_load_n);
        let present = with_law.stiffness_to_scale(load)?;
        let Some(low) = present.iter().copied().reduce(f64::min).filter(|low| *low > 0.0) else {
            bail!("{}: has no contact stiffness above 0 to start from", rig.name);
        };
        let high = present.iter().copied().fold(low, f64::max);
        let found = identify(&target_hz, &mut |factor| at_rest_hz(&with_law, &targets, factor)).map_err(failed)?;
        if let Some(path) = &self.svg {
            let title = match targets.as_slice() {
                [_] => format!("{}, first {} natural frequencies", rig.name, target_hz.len()),
                _ => format!("{}, {} natural frequencies at {} loads", rig.name, target_hz.len(), targets.len()),
            };
            let stiffness = if low == high { Some(low) } else { None };
            write_file(path, plot::identification(&title, &found, stiffness)?.as_bytes())?;
        }
        let factor = found.best.factor;
        if let Some(path) = &self.output {
            write_rig(&with_law, factor, &self.targets, path)?;
        }
        let stiffness = [low, high].map(|k| factor * k);
        if self.json {
            let report = Report {
                stiffness_factor: factor,
                stiffness_n_per_m: stiffness,
                rms_error: found.best.rms_error,
                mean_error: found.best.mean_error,
                largest_error: found.best.largest_error,
                factor_from: found.doubled[0],
                factor_to: found.doubled[1],
                sensitivity: found.sensitivity,
                frequency_hz: &found.best.frequencies_hz,
                target_hz: &target_hz,
                normal_load_n: loads(&targets).collect(),
                exponent: law.map(|law| law.exponent),
                exponent_standard_error: law.and_then(|law| law.exponent_standard_error),
            };
            print(&(serde_json::to_string(&report)? + "\n"))?;
        } else {
            print(&text(&found, law.as_ref(), &targets, [low, high]))?;
        }
        Ok(Outcome::Done)
    }

    /// The frequencies to fit, load by load.
    fn targets_of(&self, rig: &Rig) -> anyhow::Result<Vec<Targets>> {
        let mut targets = read_targets(&self.targets, self.load.unwrap_or(rig.reference.normal_load_n))?;
        if let (Some(load), [_, _, ..]) = (self.load, targets.as_slice()) {
            bail!(
                "--load is {load}, but {} has a column `normal_load_n`; expected one of them",
                self.targets.display()
            );
        }
        if let Some(first) = self.first {
            for Targets { normal_load_n, frequency_hz } in &mut targets {
                if first == 0 || first > frequency_hz.len() {
                    let (count, file) = (frequency_hz.len(), self.targets.display());
                    bail!("--first is {first}, expected 1 to the {count} frequencies of {file} at {normal_load_n} N");
                }
                frequency_hz.truncate(first);
            }
        }
        Ok(targets)
    }
}

/// The load of every frequency.
fn loads(targets: &[Targets]) -> impl Iterator<Item = f64> {
    targets.iter().flat_map(|at| at.frequency_hz.iter().map(|_| at.normal_load_n))
}

/// Writes `rig` with the stiffness of every contact pair multiplied by `factor`. The name of the rig is that of its file. A
/// comparison with a full model (`[reduction]`) is omitted, since it was made with the former stiffness. Archives are
/// written to the folder of the rig unless they exist there.
fn write_rig(rig: &Rig, factor: f64, targets: &Path, path: &Path) -> anyhow::Result<()> {
    let fitted = rig.with_contact_stiffness_times(factor)?;
    let Some((rig_file, archives)) = fitted.files.split_first() else { bail!("{}: has no rig file", rig.name) };
    let mut table: toml::Table = std::str::from_utf8(&rig_file.bytes)?.parse()?;
    table.remove("reduction");
    if let Some(name) = path.file_stem().filter(|_| path != Path::new("-")) {
        table.insert("name".to_owned(), name.to_string_lossy().into_owned().into());
    }
    let text = format!(
        "# {} with {factor} times its contact stiffness, fitted to {} by squealcast {}\n{table}",
        rig.name.escape_debug(),
        targets.display().to_string().escape_debug(),
        env!("CARGO_PKG_VERSION")
    );
    // What cannot be read again is not written.
    let mut files = vec![RigFile { name: rig_file.name.clone(), bytes: text.into_bytes() }];
    files.extend_from_slice(archives);
    Rig::from_files(&files)?;
    if path == Path::new("-") {
        if let Some(archive) = archives.first() {
            bail!("{} refers to {}: --output needs a file, whose folder takes it", rig.name, archive.name);
        }
        return write_file(path, &files[0].bytes);
    }
    let mut written = vec![];
    for archive in archives {
        let place = folder_of(path).join(&archive.name);
        match std::fs::read(&place) {
            Ok(there) if there == archive.bytes => continue,
            Ok(_) => bail!("{}: is there with another content than {} of {}", place.display(), archive.name, rig.name),
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => {}
            Err(error) => return Err(error).with_context(|| place.display().to_string()),
        }
        if !Path::new(&archive.name).components().all(|part| matches!(part, Component::Normal(_))) {
            bail!(
                "{} refers to {}, which is outside its folder: write the rig into its own folder",
                rig.name,
                archive.name
            );
        }
        std::fs::create_dir_all(folder_of(&place)).with_context(|| place.display().to_string())?;
        written.push((place, archive.bytes.as_slice()));
    }
    // The rig file last: it refers to the others.
    written.push((path.to_owned(), files[0].bytes.as_slice()));
    Ok(write_together(written)?)
}

/// Natural frequencies without sliding, with the stiffness of every contact pair multiplied by `factor`, Hz: as many as
/// targets, load by load. Where there is no state of the contact they are infinite, unless the stiffness is the rig's own.
fn at_rest_hz(rig: &Rig, targets: &[Targets], factor: f64) -> anyhow::Result<Vec<f64>> {
    let model = rig.at_rest_with_contact_stiffness_times(factor)?;
    let mut solver = Solver::new(model.dimension());
    let mut found = vec![];
    for Targets { normal_load_n, frequency_hz } in targets {
        let at_rest =
            OperatingPoint { normal_load_n: *normal_load_n, disc_speed_rad_s: 0.0, friction_coefficient: 0.0 };
        let wanted = frequency_hz.len();
        let spectrum = match solver.solve(&model, &at_rest, Vectors::Right) {
            Err(SolveError::Model(ModelError::State(_))) if factor != 1.0 => {
                found.extend(std::iter::repeat_n(f64::INFINITY, wanted));
                continue;
            }
            other => other?,
        };
        // A contact that is soft enough leaves rigid-body motion.
        let rigid = wanted.min(spectrum.roots.len()).saturating_sub(spectrum.modes().len());
        found.extend(std::iter::repeat_n(0.0, rigid));
        found.extend(spectrum.modes().iter().map(|root| root.frequency_hz()).take(wanted - rigid));
    }
    Ok(found)
}

/// The column `frequency_hz`, ascending, for each value of the column `normal_load_n`, ascending; without that column they are
/// of `load_n`. Columns are separated by `,`, `;` or tabs; unless it is the separator, `,` may be the decimal sign.
fn read_targets(path: &Path, load_n: f64) -> anyhow::Result<Vec<Targets>> {
    let file = path.display();
    let bytes = input_file::read(path, input_file::TARGETS).with_context(|| format!("{file}: cannot be read"))?;
    let text = decode_text(&bytes);
    let header = text.lines().next().unwrap_or_default();
    let separator = [b';', b'\t'].into_iter().find(|&s| header.contains(char::from(s))).unwrap_or(b',');
    let mut reader = csv::ReaderBuilder::new().delimiter(separator).from_reader(text.as_bytes());
    let headers = reader.headers().with_context(|| format!("{file}: no header"))?;
    let place = |name: &str| headers.iter().position(|header| header.trim() == name);
    let column = place("frequency_hz")
        .ok_or_else(|| anyhow!("{file}: its columns are `{}`, expected `frequency_hz`", headers.as_slice()))?;
    let of_load = place("normal_load_n");
    let mut targets: Vec<Targets> = vec![];
    for record in reader.records() {
        let record = record.with_context(|| file.to_string())?;
        let line = record.position().map_or(0, csv::Position::line);
        let number = |name: &str, column: usize| {
            let value = record.get(column).unwrap_or_default().trim();
            // A decimal comma without points only: `1.234,5` would be ambiguous.
            let text =
                if separator == b',' || value.contains('.') { value.to_owned() } else { value.replace(',', ".") };
            match text.parse::<f64>() {
                Ok(number) if number.is_finite() && number > 0.0 => Ok(number),
                _ => bail!("{file}, line {line}: {name} is `{value}`, expected a number above 0"),
            }
        };
        let hz = number("frequency_hz", column)?;
        let normal_load_n = of_load.map_or(Ok(load_n), |column| number("normal_load_n", column))?;
        match targets.iter_mut().find(|at| at.normal_load_n == normal_load_n) {
            Some(at) => at.frequency_hz.push(hz),
            None => targets.push(Targets { normal_load_n, frequency_hz: vec![hz] }),
        }
    }
    if targets.is_empty() {
        bail!("{file}: no frequencies, expected at least one");
    }
    targets.sort_by(|a, b| a.normal_load_n.total_cmp(&b.normal_load_n));
    targets.iter_mut().for_each(|at| at.frequency_hz.sort_by(f64::total_cmp));
    Ok(targets)
}

/// A warning if the frequencies hardly depend on the stiffness; empty otherwise.
fn poorly(found: &Identified) -> String {
    match found.doubled {
        [Some(from), Some(to)] if to / from <= WELL_DETERMINED => String::new(),
        [Some(from), Some(to)] => format!(
            "\npoorly determined: stiffness over a factor of {:.1} fits within twice the error; frequencies that the contact \
             moves more are needed",
            to / from
        ),
        _ => "\npoorly determined: the frequencies do not bound the stiffness; frequencies that the contact moves more are needed"
            .to_owned(),
    }
}

/// The line of the exponent.
fn exponent(law: &IdentifiedExponent) -> String {
    let error = law.exponent_standard_error.map_or(String::new(), |error| format!(", standard error {error:.1e}"));
    format!("exponent           {:.6} of the load or the closure{error}\n", law.exponent)
}

fn text(found: &Identified, law: Option<&IdentifiedExponent>, targets: &[Targets], [low, high]: [f64; 2]) -> String {
    let best = &found.best;
    let stiffness = |factor: f64| {
        let [low, high] = [low, high].map(|k| factor * k);
        if low == high { format!("{low:.6e} N/m") } else { format!("{low:.6e} to {high:.6e} N/m") }
    };
    let end = |end: Option<f64>| end.map_or("beyond the search".to_owned(), &stiffness);
    let percent = |error: f64| format!("{:.4} %", 100.0 * error);
    let mut text = format!(
        "contact stiffness  {} a pair, {:.6} times the rig's\n\
         error              mean {}, rms {}, largest {}, of {} frequencies\n\
         determined         the rms error stays below twice that from {} to {}\n\
         sensitivity        1 % more stiffness moves the frequencies by {:.4} % (rms){}\n{}\n\
         {:>4}  {:>14}  {:>14}  {:>10}  {:>9}\n",
        stiffness(best.factor),
        best.factor,
        percent(best.mean_error),
        percent(best.rms_error),
        percent(best.largest_error),
        best.frequencies_hz.len(),
        end(found.doubled[0]),
        end(found.doubled[1]),
        found.sensitivity,
        poorly(found),
        law.map_or(String::new(), exponent),
        "mode",
        "target, Hz",
        "rig, Hz",
        "error, %",
        "load, N",
    );
    let listed = targets.iter().flat_map(|at| at.frequency_hz.iter().enumerate().map(|line| (at.normal_load_n, line)));
    for (hz, (load, (index, target))) in best.frequencies_hz.iter().zip(listed) {
        let error = 100.0 * (hz / target - 1.0);
        text += &format!("{:>4}  {target:>14.4}  {hz:>14.4}  {error:>10.4}  {load:>9.2}\n", index + 1);
    }
    text
}

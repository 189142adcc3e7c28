//! Section 4 of the paper: a pad on a disc, full and reduced, on this project's tribometer.

use std::f64::consts::TAU;

use faer::{Mat, Side};

use super::{Item, ReproduceError, table};
use crate::display::curves::Curves;
use crate::export::{modal_rig, modal_sides};
use crate::figures::plot::{self, Point, Unit};
use crate::full_model::FullModelFile;
use crate::physics::identification::{Identified, identify};
use crate::physics::{MapOptions, Model, OperatingPoint, Solver, StabilityMap, Vectors, Window};
use crate::reduction::{
    FullProgress, FullSolver, FullVectors, Kept, ParametricBasis, ReductionError, compare_windows, full_windows,
};
use crate::rig::{Rig, RigFile};

/// Number of modes of each part in the paper's reduced models RM 1 to RM 4.
pub const MODES: [usize; 4] = [10, 40, 80, 245];
/// Contact stiffness that the paper identified for each of them. The paper prints N/m, but so soft a contact would not
/// be sensitive to the number of modes. N/mm agrees with its figures and is assumed.
const PAPER_STIFFNESS_N_PER_MM: [f64; 4] = [3684.0, 8605.0, 10970.0, 12510.0];
/// Number of natural frequencies compared, as in the paper's Table 4.
const FREQUENCIES: usize = 18;
/// Table 3 of the paper, Hz: name, test, Abaqus.
const TABLE_3: [(&str, f64, f64); 3] =
    [("upper part", 314.8, 331.44), ("lower part", 1301.5, 1300.6), ("whole at rest", 474.2, 510.91)];
/// Table 4 of the paper, Hz: full model, RM 1 to RM 4.
const TABLE_4: [[f64; 5]; FREQUENCIES] = [
    [510.91, 510.88, 510.90, 510.89, 510.91],
    [550.79, 544.86, 549.74, 553.48, 552.01],
    [759.54, 759.54, 759.54, 759.54, 759.54],
    [1027.5, 1033.42, 1022.2, 1028.7, 1026.8],
    [1306.7, 1305.97, 1306.9, 1307.2, 1306.8],
    [1383.8, 1384.5, 1383.5, 1383.7, 1383.7],
    [1469.8, 1468.8, 1470.2, 1470.7, 1470.0],
    [1517.1, 1516.1, 1516.9, 1517.9, 1518.0],
    [1593.4, 1593.5, 1593.5, 1593.5, 1593.4],
    [1643.1, 1642.1, 1643.4, 1644.7, 1643.4],
    [1687.0, 1686.5, 1686.8, 1687.2, 1687.1],
    [1837.7, 1837.6, 1837.6, 1838.1, 1837.9],
    [2163.3, 2162.1, 2161.9, 2165.8, 2166.1],
    [2256.6, 2248.7, 2259.0, 2262.6, 2257.7],
    [2466.1, 2472.5, 2465.8, 2466.4, 2466.3],
    [2975.4, 3061.2, 2961.9, 3004.3, 2988.3],
    [3161.2, 3222.6, 3156.1, 3166.9, 3167.2],
    [3255.8, 3255.6, 3259.9, 3264.1, 3257.8],
];
/// Frequencies that the paper measured on its squealing rig, and those at which modes of its reduced model merge, Hz.
const PAPER_MEASURED_HZ: [f64; 2] = [492.0, 1705.0];
const PAPER_MERGING_HZ: [f64; 2] = [531.0, 1411.1];
/// Number of intervals between the friction coefficients at which the full model is solved.
const DOTS: usize = 10;
/// Largest friction coefficient, as in the paper.
const MU_MAX: f64 = 1.0;

/// Modes of pad and disc at the contact interface, as many of each as the largest entry of [`MODES`].
pub struct PartModes {
    omega_squared: Vec<Vec<f64>>,
    /// Rigs with all of these modes, without and with residual flexibility.
    plain: Vec<RigFile>,
    with_residual: Vec<RigFile>,
}

impl PartModes {
    /// The interface data of the modes in `kept`.
    ///
    /// # Errors
    /// [`ReproduceError`]: modes that cannot be exported as a rig.
    pub fn new(full: &FullModelFile, kept: &[Kept]) -> Result<Self, ReproduceError> {
        let files = |residual: bool| {
            let mut sides = modal_sides(full, kept)?;
            if !residual {
                sides.iter_mut().for_each(|side| side.residual = None);
            }
            let (common, patches) = (&full.common_tables, full.contact_patches.as_ref());
            modal_rig("tribometer.toml", &[], common, patches, None, &sides, None)
        };
        let omega_squared = kept.iter().map(|kept| kept.modes.omega_squared.clone()).collect();
        Ok(Self { omega_squared, plain: files(false)?, with_residual: files(true)? })
    }
}

/// Inputs for reproducing Section 4: a full model of the tribometer, the [`MODES`] of its parts with residual
/// flexibility, and a parametric basis of the full model.
pub struct Study<'a> {
    pub full: &'a FullModelFile,
    pub modes: &'a PartModes,
    pub basis: &'a ParametricBasis,
}

/// A progress report.
pub enum Step<'a> {
    Said(&'a str),
    /// The full model is being solved for this purpose.
    Solving(&'a str, FullProgress),
}

/// Results of the full model.
struct Truth {
    at_rest_hz: Vec<f64>,
    windows: Vec<Window>,
    dots: Vec<Point>,
    band_hz: f64,
}

/// A reduced model and its natural frequencies.
struct Reduced {
    name: String,
    stiffness_n_per_m: f64,
    at_rest_hz: Vec<f64>,
    model: Model,
    /// Upper end of the band: modes above are not shown.
    band_hz: f64,
}

/// Curves and windows of instability of one model.
struct Mapped {
    curves: Vec<Point>,
    windows: Vec<Window>,
}

impl Study<'_> {
    /// Reproduces Tables 3 and 4, Figs. 13 to 15 and the critical friction coefficients. `solver` solves the full
    /// model; `report` receives progress reports.
    ///
    /// # Errors
    /// [`ReproduceError`]: a model that cannot be solved, a figure that cannot be drawn.
    pub fn items(
        &self,
        solver: &mut FullSolver<'_>,
        report: &mut dyn FnMut(Step<'_>),
    ) -> Result<Vec<Item>, ReproduceError> {
        let truth = self.truth(solver, report)?;
        let mut say = |text: &str| report(Step::Said(text));
        say("identifying contact stiffnesses");
        let (mut paper, mut fits) = (vec![], vec![]);
        for (k, &modes) in MODES.iter().enumerate() {
            let (model, found) = self.identified(modes, &truth)?;
            paper.push(Reduced { name: format!("RM {}, {modes}+{modes}", k + 1), ..model });
            fits.push(found);
        }
        say("reducing with residual flexibility and inertia");
        let mut ours = vec![];
        for modes in MODES {
            let rig = with_modes(&self.modes.with_residual, modes, 1.0)?;
            ours.push(self.reduced(format!("{modes}+{modes} with residual"), rig.model, rig.band_max_hz, 1.0)?);
        }
        let model = self.basis.projected.model(self.full.model.contact_law)?;
        let name = format!("basis of {} vectors", model.dimension());
        let basis = self.reduced(name, model, None, 1.0)?;

        say("following the modes of the reduced models over the friction coefficient");
        // All models but the largest with residual flexibility, which would take as long as all others together.
        let followed: Vec<&Reduced> = paper.iter().chain(&ours[..3]).chain([&basis]).collect();
        let maps = self.maps(&followed)?;
        let mut items = vec![
            self.table_3(&truth),
            figure_13(&fits[1], &paper[1])?,
            table_4(&truth, &paper, &ours, &basis),
            self.figure_14(&truth, &paper, &maps[..4])?,
            self.figure_15(&truth, &basis, &maps[7])?,
        ];
        items.push(critical(&truth, &followed, &maps));
        Ok(items)
    }

    fn at_rest(&self) -> OperatingPoint {
        OperatingPoint { disc_speed_rad_s: 0.0, ..self.full.settings.reference.with_friction(0.0) }
    }

    fn stiffness_n_per_m(&self) -> f64 {
        let contact = self.full.model.contact.iter().flat_map(|contact| contact.stiffness_n_per_m.first().copied());
        contact.sum()
    }

    /// Results of the full model: natural frequencies at rest, windows of instability, and modes at `DOTS + 1` friction
    /// coefficients.
    fn truth(&self, solver: &mut FullSolver<'_>, report: &mut dyn FnMut(Step<'_>)) -> Result<Truth, ReproduceError> {
        let (full, reference) = (self.full, self.full.settings.reference);
        let no_band = || ReproduceError::NoBand { full_model: full.name.clone() };
        let band_hz = full.settings.band_max_hz.ok_or_else(no_band)?;
        let mut roots = |what: &str, p: &OperatingPoint, report: &mut dyn FnMut(Step<'_>)| {
            solver.roots(p, TAU * band_hz, FullVectors::None, &mut |step| report(Step::Solving(what, step)))
        };
        let at_rest = roots("at rest", &self.at_rest(), report)?;
        let at_rest_hz: Vec<f64> =
            at_rest.roots.iter().map(|root| root.lambda.im / TAU).filter(|hz| *hz > 0.0).take(FREQUENCIES).collect();
        check_count(&format!("{} below {band_hz} Hz", full.name), at_rest_hz.len())?;
        let mut dots = vec![];
        for k in 0..=DOTS {
            let mu = MU_MAX * k as f64 / DOTS as f64;
            let found = roots(&format!("friction coefficient {mu}"), &reference.with_friction(mu), report)?;
            dots.extend(found.roots.iter().filter(|root| root.lambda.im > 0.0).enumerate().map(|(id, root)| Point {
                x: mu,
                id: id as u32,
                frequency_hz: root.lambda.im / TAU,
                growth_rate_per_s: root.lambda.re,
            }));
        }
        let options = map_options(full.settings.instability_threshold, band_hz);
        let mut progress = |step: FullProgress| report(Step::Solving("windows of instability", step));
        let windows = full_windows(&full.model, solver, &reference, TAU * band_hz, &options, &mut progress)?;
        Ok(Truth { at_rest_hz, windows, dots, band_hz })
    }

    /// A reduced model with `modes` modes of each part, and the contact stiffness that best fits the natural
    /// frequencies of the full model at rest.
    fn identified(&self, modes: usize, truth: &Truth) -> Result<(Reduced, Identified), ReproduceError> {
        let files = &self.modes.plain;
        let rig = with_modes(files, modes, 1.0)?;
        // K = K_open + factor (K_closed - K_open): the difference is the contact springs.
        let n = rig.model.dimension();
        let [mut open, mut closed, mut damping] = [0; 3].map(|_| Mat::<f64>::zeros(n, n));
        let at_rest = self.at_rest();
        rig.model.assemble(&OperatingPoint { normal_load_n: 0.0, ..at_rest }, &mut open, &mut damping)?;
        rig.model.assemble(&at_rest, &mut closed, &mut damping)?;
        let springs = closed - &open;
        let found = identify(&truth.at_rest_hz, &mut |factor| -> Result<Vec<f64>, ReductionError> {
            let stiffness = Mat::from_fn(n, n, |i, j| open[(i, j)] + factor * springs[(i, j)]);
            let squares = stiffness.self_adjoint_eigenvalues(Side::Lower);
            let squares = squares.map_err(|error| ReductionError::Factorisation {
                what: format!("{modes}+{modes} modes at rest"),
                reason: format!("{error:?}"),
            })?;
            Ok(squares.into_iter().map(|square| square.max(0.0).sqrt() / TAU).collect())
        })?;
        let rig = with_modes(files, modes, found.best.factor)?;
        // Without residual flexibility a rig has no cut-off; it is computed here.
        let highest = self.modes.omega_squared.iter().map(|squares| squares[modes - 1].max(0.0).sqrt() / TAU);
        let cutoff_hz = highest.fold(f64::INFINITY, f64::min);
        let reduced = self.reduced(String::new(), rig.model, Some(cutoff_hz.min(truth.band_hz)), found.best.factor)?;
        Ok((reduced, found))
    }

    fn reduced(
        &self,
        name: String,
        model: Model,
        band_hz: Option<f64>,
        factor: f64,
    ) -> Result<Reduced, ReproduceError> {
        let spectrum = Solver::new(model.dimension()).solve(&model, &self.at_rest(), Vectors::Right)?;
        let at_rest_hz: Vec<f64> = spectrum.modes().iter().map(|root| root.frequency_hz()).take(FREQUENCIES).collect();
        check_count(&name, at_rest_hz.len())?;
        let band_hz = band_hz.or(self.full.settings.band_max_hz).unwrap_or(f64::INFINITY);
        Ok(Reduced { name, stiffness_n_per_m: factor * self.stiffness_n_per_m(), at_rest_hz, model, band_hz })
    }

    /// Follows the modes of every model over the friction coefficient, one thread per model.
    fn maps(&self, models: &[&Reduced]) -> Result<Vec<Mapped>, ReproduceError> {
        let settings = &self.full.settings;
        let map = |reduced: &Reduced| -> Result<Mapped, ReproduceError> {
            let options = map_options(settings.instability_threshold, reduced.band_hz);
            let mut solver = Solver::new(reduced.model.dimension());
            let map = StabilityMap::build(&reduced.model, &mut solver, &settings.reference, &options)?;
            let curves = plot::points(&Curves::new(&map, Some(reduced.band_hz)), f64::INFINITY);
            Ok(Mapped { curves, windows: map.windows })
        };
        std::thread::scope(|scope| {
            let map = &map;
            let threads: Vec<_> = models.iter().map(|&reduced| scope.spawn(move || map(reduced))).collect();
            let joined = threads.into_iter().zip(models).map(|(thread, reduced)| {
                let mapped = thread.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic));
                mapped.map_err(|error| ReproduceError::Reduced { model: reduced.name.clone(), source: error.into() })
            });
            joined.collect()
        })
    }

    fn table_3(&self, truth: &Truth) -> Item {
        let first = |part: usize| self.modes.omega_squared[part][0].max(0.0).sqrt() / TAU;
        let ours = [first(0), first(1), truth.at_rest_hz[0]];
        let mut csv = "what,frequency_hz,paper_full_model_hz,paper_measured_hz\n".to_owned();
        let mut rows = vec![];
        for ((what, test, abaqus), hz) in TABLE_3.into_iter().zip(ours) {
            csv += &format!("{what},{hz},{abaqus},{test}\n");
            let off = 100.0 * (hz / abaqus - 1.0);
            rows.push(vec![
                what.to_owned(),
                format!("{hz:.2}"),
                abaqus.to_string(),
                format!("{off:+.2}"),
                test.to_string(),
            ]);
        }
        let text = format!(
            "<p>First natural frequencies, Hz. Ours is a model of the paper's kind with {} degrees of freedom: its \
             components, materials, supports, springs and 294 contact pairs, but dimensions of this project, which were tuned to \
             these three frequencies at 22032 degrees of freedom. The paper reports 904968 for its model.</p>\n",
            self.full.model.dimension()
        ) + &table(&["", "ours", "paper, Abaqus", "ours off, %", "paper, measured"], &rows);
        let title = "Table 3: first natural frequencies of the tribometer".to_owned();
        Item { name: "table-3", title, text, csv, svg: None }
    }

    fn figure_14(&self, truth: &Truth, models: &[Reduced], maps: &[Mapped]) -> Result<Item, ReproduceError> {
        let lines: Vec<(String, Vec<Point>)> =
            models.iter().zip(maps).map(|(model, map)| (model.name.clone(), map.curves.clone())).collect();
        let title = "lines: modes of the parts, each with its own contact stiffness; dots: full model";
        let svg = plot::several(title, &lines, &truth.dots, MU_MAX)?;
        let mut csv = CURVES_HEADER.to_owned();
        for (name, points) in &lines {
            csv += &rows_of(name, points);
        }
        csv += &rows_of("full model", &truth.dots);
        let text = format!(
            "The paper's method: no residual, contact stiffness identified for each number of modes. RM 1 ends at {:.0} Hz. The paper \
             finds its four models very similar, and modes 1 and 2, then 6 and 7 merging at {} and {} Hz; the table of critical friction \
             coefficients lists where ours merge, and the errors of each number of modes.",
            models[0].band_hz, PAPER_MERGING_HZ[0], PAPER_MERGING_HZ[1]
        );
        let title = "Figure 14: the paper's reduced models over the friction coefficient".to_owned();
        Ok(Item { name: "figure-14", title, text, csv, svg: Some(svg) })
    }

    fn figure_15(&self, truth: &Truth, basis: &Reduced, map: &Mapped) -> Result<Item, ReproduceError> {
        let title = format!("lines: {}; dots: full model", basis.name);
        let svg = plot::against_full(&title, &map.curves, &truth.dots, &map.windows, MU_MAX, Unit::Hz)?;
        let csv = CURVES_HEADER.to_owned() + &rows_of(&basis.name, &map.curves) + &rows_of("full model", &truth.dots);
        let p = &self.full.settings.reference;
        let text = format!(
            "The full model of {} degrees of freedom at {} N and {} rad/s, solved at {} friction coefficients, and the parametric basis \
             through it; its windows of instability are shaded. At {} other points its roots are within {:.1e} of the full model's. \
             The paper's figure is Abaqus with surface-to-surface contact, whose area changes with load: there modes 1 and 2 unlock \
             again and modes 3 and 4 fall, which a model with springs between fixed pairs of nodes need not show. Windows of \
             instability here: {}, closing again: {}.",
            self.full.model.dimension(),
            p.normal_load_n,
            p.disc_speed_rad_s,
            DOTS + 1,
            self.basis.held_out.len(),
            self.basis.worst(),
            truth.windows.len(),
            truth.windows.iter().filter(|window| window.mu_to.is_some()).count()
        );
        let title = "Figure 15: the full model over the friction coefficient".to_owned();
        Ok(Item { name: "figure-15", title, text, csv, svg: Some(svg) })
    }
}

fn map_options(instability_threshold: f64, band_hz: f64) -> MapOptions {
    MapOptions { mu_min: 0.0, mu_max: MU_MAX, band_max_hz: Some(band_hz), instability_threshold, windows: true }
}

/// Checks that as many natural frequencies are known as are compared.
fn check_count(model: &str, found: usize) -> Result<(), ReproduceError> {
    if found == FREQUENCIES {
        return Ok(());
    }
    Err(ReproduceError::Frequencies { model: model.to_owned(), found, expected: FREQUENCIES })
}

/// A rig of kind 2 with the lowest `modes` modes of each part and its contact stiffness multiplied by `factor`.
fn with_modes(files: &[RigFile], modes: usize, factor: f64) -> Result<Rig, ReproduceError> {
    let failed = |reason: String| ReproduceError::Modes { file: files[0].name.clone(), reason };
    let text = std::str::from_utf8(&files[0].bytes).map_err(|error| failed(error.to_string()))?;
    let mut table: toml::Table = text.parse().map_err(|error: toml::de::Error| failed(error.to_string()))?;
    for part in ["pad", "disc"] {
        let found = table.get_mut(part).and_then(toml::Value::as_table_mut);
        let found = found.ok_or_else(|| failed(format!("there is no table [{part}]")))?;
        found.insert("modes".to_owned(), (modes as i64).into());
    }
    let mut files = files.to_vec();
    files[0].bytes = table.to_string().into_bytes();
    Ok(Rig::from_files(&files)?.with_contact_stiffness_times(factor)?)
}

const CURVES_HEADER: &str = "friction_coefficient,model,mode_id,frequency_hz,growth_rate_per_s\n";

fn rows_of(model: &str, points: &[Point]) -> String {
    let row = |point: &Point| {
        let Point { x: mu, id, frequency_hz, growth_rate_per_s } = point;
        format!("{mu},\"{model}\",{id},{frequency_hz},{growth_rate_per_s}\n")
    };
    points.iter().map(row).collect()
}

fn figure_13(found: &Identified, reduced: &Reduced) -> Result<Item, ReproduceError> {
    let at_one = reduced.stiffness_n_per_m / found.best.factor;
    let svg = plot::identification(
        &format!("{}: first {FREQUENCIES} natural frequencies", reduced.name),
        found,
        Some(at_one),
    )?;
    let mut trials: Vec<_> = found.curve.iter().chain([&found.best]).collect();
    trials.sort_by(|a, b| a.factor.total_cmp(&b.factor));
    let mut csv = "contact_stiffness_n_per_m,mean_error_percent,rms_error_percent,largest_error_percent\n".to_owned();
    for trial in trials {
        let [mean, rms, largest] = [trial.mean_error, trial.rms_error, trial.largest_error].map(|error| 100.0 * error);
        csv += &format!("{},{mean},{rms},{largest}\n", trial.factor * at_one);
    }
    let text = format!(
        "Errors of {} against the full model at rest. Ours are smallest at {:.0} N/mm a pair, with a mean of {:.3} %; in the shaded range the rms \
         error is below twice its minimum. The paper's are smallest at {} (printed N/m, which would be too soft for the number of modes \
         to matter). The full model has {:.0} N/mm: the fitted stiffness compensates for the flexibility of the truncated modes.",
        reduced.name,
        1e-3 * reduced.stiffness_n_per_m,
        100.0 * found.best.mean_error,
        PAPER_STIFFNESS_N_PER_MM[1],
        1e-3 * at_one
    );
    let title = "Figure 13: errors of the natural frequencies over the contact stiffness".to_owned();
    Ok(Item { name: "figure-13", title, text, csv, svg: Some(svg) })
}

/// `|f / f_full - 1|` of each frequency, in %.
fn errors_percent(found: &[f64], full: &[f64]) -> Vec<f64> {
    found.iter().zip(full).map(|(found, full)| 100.0 * (found / full - 1.0).abs()).collect()
}

fn mean(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len() as f64
}

/// Formats an error in %.
fn percent(error: f64) -> String {
    match error {
        0.0 => "0".to_owned(),
        1e-3.. => format!("{error:.4}"),
        _ => format!("{error:.1e}"),
    }
}

fn table_4(truth: &Truth, paper: &[Reduced], ours: &[Reduced], basis: &Reduced) -> Item {
    let printed = |model: usize| TABLE_4.iter().map(|row| row[model]).collect::<Vec<f64>>();
    let printed_errors: Vec<Vec<f64>> = (1..=4).map(|model| errors_percent(&printed(model), &printed(0))).collect();
    let errors = |models: &[Reduced]| -> Vec<Vec<f64>> {
        models.iter().map(|model| errors_percent(&model.at_rest_hz, &truth.at_rest_hz)).collect()
    };
    let (paper_errors, our_errors) = (errors(paper), errors(ours));
    let basis_errors = errors_percent(&basis.at_rest_hz, &truth.at_rest_hz);

    let mut csv = "mode,model,contact_stiffness_n_per_m,frequency_hz,error_percent,paper_frequency_hz\n".to_owned();
    for (mode, row) in TABLE_4.iter().enumerate() {
        csv +=
            &format!("{},full model,{},{},0,{}\n", mode + 1, basis.stiffness_n_per_m, truth.at_rest_hz[mode], row[0]);
        let all = paper.iter().zip(&paper_errors).chain(ours.iter().zip(&our_errors)).chain([(basis, &basis_errors)]);
        for (k, (model, errors)) in all.enumerate() {
            let Reduced { name, stiffness_n_per_m, at_rest_hz, .. } = model;
            let printed = row.get(k + 1).map_or(String::new(), f64::to_string);
            csv += &format!(
                "{},\"{name}\",{stiffness_n_per_m},{},{},{printed}\n",
                mode + 1,
                at_rest_hz[mode],
                errors[mode]
            );
        }
    }

    let mut means = vec![];
    for (k, modes) in MODES.iter().enumerate() {
        means.push(vec![
            format!("{modes}+{modes}"),
            format!("{:.0}", 1e-3 * paper[k].stiffness_n_per_m),
            PAPER_STIFFNESS_N_PER_MM[k].to_string(),
            percent(mean(&paper_errors[k])),
            percent(mean(&printed_errors[k])),
            percent(mean(&our_errors[k])),
        ]);
    }
    let dash = || "–".to_owned();
    means.push(vec![basis.name.clone(), dash(), dash(), dash(), dash(), percent(mean(&basis_errors))]);
    let mut each = vec![];
    let mut with_residual = vec![];
    for (mode, row) in TABLE_4.iter().enumerate() {
        let mut cells = vec![(mode + 1).to_string(), format!("{:.2}", truth.at_rest_hz[mode]), format!("{:?}", row[0])];
        for k in 0..MODES.len() {
            cells.extend([percent(paper_errors[k][mode]), percent(printed_errors[k][mode])]);
        }
        each.push(cells);
        let mut cells = vec![(mode + 1).to_string(), format!("{:.4}", truth.at_rest_hz[mode])];
        cells.extend(our_errors.iter().chain([&basis_errors]).map(|errors| percent(errors[mode])));
        with_residual.push(cells);
    }
    let text = format!(
        "<p>Mean errors of the first {FREQUENCIES} natural frequencies at rest, %. Left, the paper's method: each number of modes with the contact \
         stiffness that fits best, in N/mm. Right, this project's: one stiffness, {:.0} N/mm, for any number of modes, with the \
         residual flexibility of the truncated modes (and the inertial term up to half of the cut-off), or on a \
         basis of the full model's own vectors.</p>\n{}\
         <p>Mode by mode, the paper's method, our values next to the paper's: frequencies of the full models in Hz, errors in %. The paper's digits \
         end at 0.01 to 0.1 Hz, so that its errors below 0.005 % are rounding.</p>\n{}\
         <p>Mode by mode, one contact stiffness with residual, errors in %. 10+10 modes end at {:.0} Hz, below the {FREQUENCIES}th \
         frequency: such a rig shows no modes above.</p>\n{}",
        1e-3 * basis.stiffness_n_per_m,
        table(&["modes", "ours, N/mm", "paper, N/mm", "ours, its way", "paper", "ours, with residual"], &means),
        table(&["mode", "full", "paper", "RM 1", "paper", "RM 2", "paper", "RM 3", "paper", "RM 4", "paper"], &each),
        ours[0].band_hz,
        table(&["mode", "full, Hz", "10+10", "40+40", "80+80", "245+245", &basis.name], &with_residual)
    );
    let title = "Table 4: natural frequencies of the full model and of reduced models".to_owned();
    Item { name: "table-4", title, text, csv, svg: None }
}

/// Table of the windows of instability of all models, with the frequencies the paper measured.
fn critical(truth: &Truth, models: &[&Reduced], maps: &[Mapped]) -> Item {
    let mut csv = "model,window,mu_from,mu_to,frequency_hz,error_of_mu_from_percent\n".to_owned();
    let row = |model: &str, number: &str, window: &Window, error: String| {
        let to = window.mu_to.map_or(String::new(), |to| to.to_string());
        format!("\"{model}\",{number},{},{to},{},{error}\n", window.mu_from, window.frequency_hz)
    };
    let mut header = vec!["model".to_owned()];
    let mut cells = vec!["full model".to_owned()];
    for (k, window) in truth.windows.iter().enumerate() {
        csv += &row("full model", &(k + 1).to_string(), window, String::new());
        header.push(format!("at {:.0} Hz", window.frequency_hz));
        cells.push(format!("{:.6}", window.mu_from));
    }
    header.push("missed".to_owned());
    header.push("invented".to_owned());
    cells.extend([String::new(), String::new()]);
    let mut rows = vec![cells];
    for (model, map) in models.iter().zip(maps) {
        let compared = compare_windows(&truth.windows, &map.windows);
        let mut cells = vec![model.name.clone()];
        for (k, window) in truth.windows.iter().enumerate() {
            let partner = compared.pairs.iter().find(|(full, _)| full == window);
            cells.push(partner.map_or("missed".to_owned(), |(_, reduced)| {
                let error = 100.0 * (reduced.mu_from / window.mu_from - 1.0);
                csv += &row(&model.name, &(k + 1).to_string(), reduced, error.to_string());
                let error = if error.abs() < 1e-3 { format!("{error:+.0e}") } else { format!("{error:+.3}") };
                format!("{:.6} ({error} %)", reduced.mu_from)
            }));
        }
        for window in &compared.invented {
            csv += &row(&model.name, "invented", window, String::new());
        }
        cells.extend([compared.missed.len().to_string(), compared.invented.len().to_string()]);
        rows.push(cells);
    }
    let header: Vec<&str> = header.iter().map(String::as_str).collect();
    let merging: Vec<String> = truth.windows.iter().map(|window| format!("{:.0}", window.frequency_hz)).collect();
    let grows = match merging.as_slice() {
        [] => "Ours is stable there.".to_owned(),
        some => format!("Ours begins to grow at {} Hz.", some.join(", ")),
    };
    let text = format!(
        "<p>Where windows of instability begin, up to a friction coefficient of {MU_MAX}: the full model, the paper's method (RM 1 to RM 4, no residual, \
         a separate contact stiffness each), one contact stiffness with residual, and the parametric basis. A reduced model is not judged \
         above its cut-off.</p>\n{}\
         <p>The paper's rig vibrated at {} Hz (dominant) to {} Hz, at friction coefficients of 0.3 to 0.4; its reduced models merge at {} and {} Hz. \
         {grows} Our model differs from that rig: components, materials, supports and the first frequencies agree, but the mode \
         shapes, which the paper does not give, do not. The modes that merge, and where, depend on the distance of their frequencies and on \
         their motion at the pad. The error of a reduced model against its own full model can be compared.</p>\n",
        table(&header, &rows),
        PAPER_MEASURED_HZ[0],
        PAPER_MEASURED_HZ[1],
        PAPER_MERGING_HZ[0],
        PAPER_MERGING_HZ[1]
    );
    let title = "Critical friction coefficients, and measured frequencies".to_owned();
    Item { name: "critical-friction", title, text, csv, svg: None }
}

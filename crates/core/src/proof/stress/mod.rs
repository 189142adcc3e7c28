//! Extreme cases of the numerics, each with its required properties. `tests/suite/stress.rs` runs them,
//! `squealcast bench --stress` shows them.
//!
//! | extreme | what happens |
//! |---|---|
//! | at and near a merging point | error bounds of both roots rise up to `√ε`, not those of mean and discriminant |
//! | three modes merge | the same with the cube root of `ε`; the bounds grow accordingly |
//! | doublets split by rounding only | both modes are found with bounds; shapes are arbitrary within their plane |
//! | free modes | `λ = 0` exactly, static, no growth |
//! | static divergence | a static root grows; its window is found like any other |
//! | contact far softer or stiffer than the rig | accurate to rounding of the largest stiffness, as the bounds show |
//! | any scale of mass and frequency | the results scale likewise |
//! | friction coefficients of any size and sign | solved like any other |
//! | no load | the contact is open: neither springs nor friction |
//! | speed towards zero | lateral damping grows as `μN/v`, modes become static; below 0.01 rad/s `μ` is taken as 0 |
//! | matrices far from normal | bounds grow with the condition numbers of the roots |
//! | other order of nodes and modes, other signs or units | the same roots within their bounds |
//! | pairs that open and close | see `contact.rs` beside it |
//! | a disc at its critical speed | a wave stands still in the pad's frame; its root is known to rounding, or the solve is an error |
//!
//! Where rounding leaves no accurate digits, a solve is an error (a residual or trace exceeds its limit), never a
//! wrong number.

mod contact;

use faer::{Mat, c64};

use super::reference::{self, MAX_TOGETHER};
use super::synthetic::{Synthetic, Uniform, rig};
use crate::physics::solver::ROUNDING;
use crate::physics::stability_map::mirror;
use crate::physics::tracking::tracked;
use crate::physics::{
    ContactLaw, ContactPairs, Law, MapOptions, Model, ModelError, OperatingPoint, Solver, Spectrum, StabilityMap, Term,
    Vectors, Window,
};

/// An extreme case.
pub struct Case {
    /// Description of the case.
    pub what: &'static str,
    /// Runs the case and returns a summary, or what went wrong.
    pub run: fn() -> Result<String, String>,
}

impl Case {
    fn new(what: &'static str, run: fn() -> Result<String, String>) -> Self {
        Self { what, run }
    }
}

/// All cases.
pub fn cases() -> Vec<Case> {
    let mut cases = vec![
        Case::new("at, and 1e-16 to 1e-2 away from, every merging point", merging_points),
        Case::new("three modes meeting, 0 and 1e-16 to 1e-2 apart", three_modes),
        Case::new("disc doublets split by 1e-12", doublets),
        Case::new("free modes, contact closed and open", free_modes),
        Case::new("static divergence, damped and undamped", divergence),
        Case::new("contact stiffness 1e-6 to 1e12 times nominal", contact_stiffness),
        Case::new("frequencies scaled by 1e-10 to 1e10", scales),
        Case::new("friction coefficients from -20 to 20", friction),
        Case::new("load towards zero", vanishing_load),
        Case::new("speed towards zero, lateral friction without bound", vanishing_speed),
        Case::new("matrices far from normal, departures 1 to 1e8", non_normal),
        Case::new("nodes and modes permuted, modes sign-flipped", permuted),
        Case::new("a disc at and near its critical speed", critical_speed),
        Case::new("a scan of 100 000 friction coefficients, 20 modes", scanned),
    ];
    cases.extend(contact::cases());
    cases
}

const REFERENCE: OperatingPoint =
    OperatingPoint { normal_load_n: 500.0, disc_speed_rad_s: 13.0, friction_coefficient: 0.35 };

/// A root with an error bound above this, relative, counts as unknown.
const VAGUE: f64 = 0.1;

/// Statistics of the spectra checked.
#[derive(Clone, Copy, Debug, Default)]
pub struct Checked {
    roots: usize,
    together: usize,
    /// Number of roots that are unknown by their bounds, or part of a cluster too large to be refined together.
    vague: usize,
    /// The largest error as a fraction of its bound.
    share: f64,
    /// The largest bound, relative to the root.
    bound: f64,
}

impl Checked {
    /// Solves `model` at `p` and checks that every root is finite, has a bound, and is within that bound of the
    /// reference root.
    ///
    /// # Errors
    /// The first check that failed.
    pub fn solve(&mut self, model: &Model, p: &OperatingPoint) -> Result<Spectrum, String> {
        let n = model.dimension();
        let failed = |what: String| format!("{p:?}: {what}");
        let spectrum = Solver::new(n).solve(model, p, Vectors::Both).map_err(|error| failed(error.to_string()))?;
        let (mut stiffness, mut damping) = (Mat::zeros(n, n), Mat::zeros(n, n));
        model.assemble(p, &mut stiffness, &mut damping).map_err(|error| failed(error.to_string()))?;
        for root in &spectrum.roots {
            let numbers = [root.lambda.re, root.lambda.im, root.residual, root.error.square, root.error.sigma];
            if numbers.iter().any(|number| !number.is_finite()) {
                return Err(failed(format!("{root:?} is not finite")));
            }
        }
        for cluster in reference::clusters(&spectrum) {
            let is_vague =
                |&j: &usize| reference::bound(&spectrum, j) > VAGUE * reference::solved_for(&spectrum, j).norm();
            if cluster.len() > MAX_TOGETHER || cluster.iter().any(is_vague) {
                self.vague += cluster.len();
                continue;
            }
            let refined = reference::refine(stiffness.as_ref(), damping.as_ref(), &spectrum, &cluster)
                .ok_or_else(|| failed(format!("no reference for roots {cluster:?}")))?;
            self.together += usize::from(cluster.len() > 1);
            for (&j, error) in refined.members.iter().zip(&refined.errors) {
                let bound = reference::bound(&spectrum, j);
                if error.norm() > bound {
                    return Err(failed(format!("root {j} is off by {:e}, bound {bound:e}", error.norm())));
                }
                self.roots += 1;
                self.share = self.share.max(if bound > 0.0 { error.norm() / bound } else { 0.0 });
                self.bound = self.bound.max(bound / reference::solved_for(&spectrum, j).norm());
            }
        }
        Ok(spectrum)
    }

    fn said(&self) -> String {
        let Self { roots, together, vague, share, bound } = self;
        format!(
            "{roots} roots, {together} clusters; errors up to {share:.1e} of their bounds, bounds up to {bound:.1e}; {vague} roots unknown by their bounds"
        )
    }
}

fn text(error: impl std::fmt::Display) -> String {
    error.to_string()
}

fn synthetic(modes: usize, damping_ratio: f64, contact_law: ContactLaw) -> Result<Model, String> {
    rig(&Synthetic { modes, pairs: 12, damping_ratio, contact_law, seed: 5 }).map_err(text)
}

fn constant(stiffness: Mat<f64>, damping: Option<Mat<f64>>) -> Result<Model, ModelError> {
    let term = |matrix| Term { matrix, law: Law::Constant };
    let n = stiffness.nrows();
    Model::new(n, vec![term(stiffness)], damping.into_iter().map(term).collect(), ContactLaw::default(), None)
}

fn map(model: &Model, mu_max: f64) -> Result<StabilityMap, String> {
    let options = MapOptions { mu_min: 0.0, mu_max, band_max_hz: None, instability_threshold: 1e-6, windows: true };
    StabilityMap::build(model, &mut Solver::new(model.dimension()), &REFERENCE, &options).map_err(text)
}

/// The distances 0 and ±1e-16, ±1e-15, ... ±1e-2.
fn distances() -> impl Iterator<Item = f64> {
    let small = (2..=16).flat_map(|k| [1.0, -1.0].map(|sign| sign * 10f64.powi(-k)));
    std::iter::once(0.0).chain(small)
}

/// The first synthetic rig of 20 modes with at least two windows.
fn squealing() -> Result<(Model, Vec<Window>), String> {
    for seed in 0..40 {
        let contact_law = ContactLaw::default();
        let model = rig(&Synthetic { modes: 20, pairs: 48, damping_ratio: 0.0, contact_law, seed }).map_err(text)?;
        let windows = map(&model, 2.0)?.windows;
        if windows.len() > 1 {
            return Ok((model, windows));
        }
    }
    Err("no synthetic rig has windows".to_owned())
}

fn merging_points() -> Result<String, String> {
    let mut checked = Checked::default();
    let (model, windows) = squealing()?;
    let ends: Vec<f64> = windows.iter().flat_map(|w| [Some(w.mu_from), w.mu_to]).flatten().collect();
    for end in &ends {
        for off in distances() {
            checked.solve(&model, &REFERENCE.with_friction(end + off))?;
        }
    }
    Ok(format!("{} points: {}", ends.len(), checked.said()))
}

/// Three modes that merge at `w = 0`, `[[4, 1, 0], [0, 4, 1], [w, 0, 4]]`: `λ² = -4 + ∛(-w)`.
fn three_modes() -> Result<String, String> {
    let mut checked = Checked::default();
    for w in distances() {
        let stiffness = faer::mat![[4.0, 1.0, 0.0], [0.0, 4.0, 1.0], [w, 0.0, 4.0]];
        let damping = Mat::<f64>::identity(3, 3) * faer::Scale(1e-3);
        checked.solve(&constant(stiffness.clone(), None).map_err(text)?, &REFERENCE)?;
        checked.solve(&constant(stiffness, Some(damping)).map_err(text)?, &REFERENCE)?;
    }
    Ok(checked.said())
}

/// Free-interface modes in doublets `split` apart, coupled by `pairs`; with the modes in the given order and with
/// given signs.
fn with_pairs(split: f64, pairs: &ContactPairs, order: &[usize], signs: &[f64]) -> Result<Model, ModelError> {
    let n = order.len();
    let omega = |k: usize| 1.0 + (k / 2) as f64 * 0.7 + if k % 2 == 1 { split } else { 0.0 };
    let diagonal = Mat::from_fn(n, n, |i, j| if i == j { omega(order[i]).powi(2) } else { 0.0 });
    let stiffness = vec![Term { matrix: diagonal, law: Law::Constant }];
    let turned = |rows: &Mat<f64>| Mat::from_fn(rows.nrows(), n, |i, j| signs[j] * rows[(i, order[j])]);
    let pairs = ContactPairs {
        normal: turned(&pairs.normal),
        sliding: turned(&pairs.sliding),
        lateral: turned(&pairs.lateral),
        ..pairs.clone()
    };
    Model::new(n, stiffness, vec![], ContactLaw::default(), None)?.with_contact(&pairs)
}

fn random_pairs(count: usize, n: usize, stiffness_n_per_m: f64) -> ContactPairs {
    let mut uniform = Uniform::new(11);
    let mut rows = || Mat::from_fn(count, n, |_, _| uniform.draw());
    ContactPairs {
        normal: rows(),
        sliding: rows(),
        lateral: rows(),
        stiffness_n_per_m: vec![stiffness_n_per_m; count],
        damping_n_s_per_m: vec![0.0; count],
        radius_m: vec![0.1; count],
    }
}

fn doublets() -> Result<String, String> {
    let mut checked = Checked::default();
    let order: Vec<usize> = (0..12).collect();
    // The contact stiffness ranges from negligible to dominant relative to the splitting of the doublets.
    for stiffness in [1e-14, 1e-12, 1e-10, 1e-6, 1e-2, 1.0] {
        let model = with_pairs(1e-12, &random_pairs(2, 12, stiffness), &order, &[1.0; 12]).map_err(text)?;
        for step in 0..5 {
            checked.solve(&model, &REFERENCE.with_friction(0.25 * f64::from(step)))?;
        }
        map(&model, 1.0)?;
    }
    Ok(checked.said())
}

fn free_modes() -> Result<String, String> {
    let mut checked = Checked::default();
    let free = |n: usize| Mat::from_fn(n, n, |i, j| if i == j && i > 2 { 1e6 * i as f64 } else { 0.0 });
    let pairs = random_pairs(6, 9, 1e6);
    let term = Term { matrix: free(9), law: Law::Constant };
    let model = Model::new(9, vec![term], vec![], ContactLaw::default(), None).and_then(|m| m.with_contact(&pairs));
    let model = model.map_err(text)?;
    checked.solve(&model, &REFERENCE)?;
    let open = checked.solve(&model, &OperatingPoint { normal_load_n: 0.0, ..REFERENCE })?;
    let statics = open.nonoscillatory_growth_per_s();
    if statics != [0.0; 6] || open.mode_count != 6 {
        return Err(format!("three free modes, open: static roots {statics:?}, {} modes", open.mode_count));
    }
    Ok(format!("open: three pairs of roots at 0 exactly; {}", checked.said()))
}

/// `k₁ = 1 - μ`, next to a mode that does not depend on friction.
fn divergence() -> Result<String, String> {
    let mut ends = vec![];
    for damping in [0.0, 1e-6, 0.3, 3.0] {
        let term = |matrix, law| Term { matrix, law };
        let stiffness = vec![
            term(faer::mat![[1.0, 0.0], [0.0, 9.0]], Law::Constant),
            term(faer::mat![[-1.0, 0.0], [0.0, 0.0]], Law::FrictionStiffness),
        ];
        let damping = term(Mat::<f64>::identity(2, 2) * faer::Scale(damping), Law::Constant);
        let model = Model::new(2, stiffness, vec![damping], ContactLaw::default(), None).map_err(text)?;
        for off in distances() {
            Checked::default().solve(&model, &REFERENCE.with_friction(1.0 + off))?;
        }
        let windows = map(&model, 2.0)?.windows;
        match windows.as_slice() {
            [window] if (window.mu_from - 1.0).abs() < 1e-10 && window.mu_to.is_none() => ends.push(window.mu_from),
            _ => return Err(format!("one window from 1 expected: {windows:?}")),
        }
    }
    Ok(format!("windows from {ends:?}"))
}

/// A contact stiffness proportional to the load, so that the load sets it.
fn proportional(damping_ratio: f64) -> Result<Model, String> {
    synthetic(20, damping_ratio, ContactLaw { exponent: 1.0, ..ContactLaw::default() })
}

fn contact_stiffness() -> Result<String, String> {
    let mut checked = Checked::default();
    for damping_ratio in [0.0, 1e-2] {
        let model = proportional(damping_ratio)?;
        for decade in -6..=12 {
            let p = OperatingPoint { normal_load_n: 500.0 * 10f64.powi(decade), ..REFERENCE };
            checked.solve(&model, &p)?;
        }
    }
    Ok(checked.said())
}

fn scales() -> Result<String, String> {
    let mut off: f64 = 0.0;
    for damping_ratio in [0.0, 1e-2] {
        let model = synthetic(20, damping_ratio, ContactLaw::default())?;
        let (mut stiffness, mut damping) = (Mat::zeros(20, 20), Mat::zeros(20, 20));
        model.assemble(&REFERENCE, &mut stiffness, &mut damping).map_err(text)?;
        let as_it_is = Checked::default().solve(&model, &REFERENCE)?;
        for decade in -10..=10 {
            let s = 10f64.powi(decade);
            let damping = (damping_ratio > 0.0).then(|| &damping * faer::Scale(s));
            let scaled = constant(&stiffness * faer::Scale(s * s), damping).map_err(text)?;
            let scaled = Checked::default().solve(&scaled, &REFERENCE)?;
            for (a, b) in as_it_is.roots.iter().zip(&scaled.roots) {
                let difference = (b.lambda / s - a.lambda).norm();
                // The scaling itself rounds every entry.
                let limit = a.error.omega + b.error.omega / s;
                if difference > 2.0 * limit {
                    return Err(format!(
                        "scale {s:e}: {} differs from {} by more than {limit:e}",
                        b.lambda / s,
                        a.lambda
                    ));
                }
                off = off.max(difference / a.lambda.norm());
            }
        }
    }
    Ok(format!("roots scale to {off:.1e}"))
}

fn friction() -> Result<String, String> {
    let mut checked = Checked::default();
    for damping_ratio in [0.0, 1e-2] {
        let model = synthetic(20, damping_ratio, ContactLaw::default())?;
        for step in -40..=40 {
            checked.solve(&model, &REFERENCE.with_friction(0.5 * f64::from(step)))?;
        }
    }
    Ok(checked.said())
}

/// Everything that depends on load and speed.
fn slipping() -> ContactLaw {
    ContactLaw { exponent: 1.0 / 3.0, reference_n: 500.0, slope_s_per_m: -0.02, lateral_damping: true, stribeck: None }
}

fn vanishing_load() -> Result<String, String> {
    let mut checked = Checked::default();
    let model = synthetic(20, 5e-3, slipping())?;
    for decade in -300..=3 {
        if decade > -20 || decade % 40 == 0 {
            checked.solve(&model, &OperatingPoint { normal_load_n: 10f64.powi(decade), ..REFERENCE })?;
        }
    }
    checked.solve(&model, &OperatingPoint { normal_load_n: 0.0, ..REFERENCE })?;
    Ok(checked.said())
}

fn vanishing_speed() -> Result<String, String> {
    let mut checked = Checked::default();
    let model = synthetic(20, 5e-3, slipping())?;
    let mut statics = 0;
    for speed in [60.0, 1.0, 0.1, 0.02, 0.0100001, 0.01, 0.009999, 1e-6, 1e-300, 0.0] {
        for load in [1.0, 500.0, 1e5] {
            for sign in [1.0, -1.0] {
                let p = OperatingPoint { normal_load_n: load, disc_speed_rad_s: sign * speed, ..REFERENCE };
                let spectrum = checked.solve(&model, &p)?;
                statics = statics.max(spectrum.roots.len() - spectrum.mode_count);
            }
        }
    }
    Ok(format!("up to {statics} static roots; {}", checked.said()))
}

/// Waves of `m` diameters and frequency `ω` on a disc that turns with `Ω`, in the pad's frame: `λ = ±i(ω ± mΩ)`. At
/// `Ω = ω/m` the wave that runs against the rotation stands still.
fn critical_speed() -> Result<String, String> {
    let mut checked = Checked::default();
    let (omega, m) = (6.0, 3.0);
    let of_speed = |matrix: Mat<f64>, power| Term { matrix, law: Law::DiscSpeed { power } };
    let constant =
        Term { matrix: Mat::from_fn(2, 2, |i, j| if i == j { omega * omega } else { 0.0 }), law: Law::Constant };
    let spin = of_speed(Mat::from_fn(2, 2, |i, j| if i == j { -m * m } else { 0.0 }), 2);
    let gyroscopic = of_speed(faer::mat![[0.0, 2.0 * m], [-2.0 * m, 0.0]], 1);
    let model = Model::new(2, vec![constant, spin], vec![gyroscopic], ContactLaw::default(), None).map_err(text)?;
    let critical = omega / m;
    let (mut largest, mut refused): (f64, u32) = (0.0, 0);
    for off in distances() {
        for sign in [1.0, -1.0] {
            let p = OperatingPoint { disc_speed_rad_s: sign * (critical + off), ..REFERENCE };
            // Below 1e-12 only rounding is left of the slow wave, so a solve may be an error.
            let near = off.abs() < 1e-12;
            let roots = match Solver::new(2).solve(&model, &p, Vectors::Both) {
                Ok(spectrum) => spectrum.roots,
                Err(_) if near => {
                    refused += 1;
                    continue;
                }
                Err(error) => return Err(format!("{p:?}: {error}")),
            };
            if !near {
                checked.solve(&model, &p)?;
            }
            for root in &roots {
                let waves = [omega - m * p.disc_speed_rad_s, omega + m * p.disc_speed_rad_s];
                let errors = waves.map(|wave| (root.square + c64::new(wave * wave, 0.0)).norm());
                let error = errors[0].min(errors[1]);
                if error > root.error.square {
                    return Err(format!("{p:?}: λ² of {root:?} is off by {error:e}"));
                }
                largest = largest.max(error);
            }
        }
    }
    Ok(format!("λ² within {largest:.1e} of (ω ± mΩ)², {refused} refused; {}", checked.said()))
}

/// Blocks `[[1, b], [0, 1 + g]]`, transformed by random reflections; condition number `√(1 + b²/g²)`.
fn non_normal() -> Result<String, String> {
    let mut checked = Checked::default();
    let mut uniform = Uniform::new(3);
    for decade in 0..=8 {
        for gap in [1.0, 1e-2, 1e-4] {
            let b = 10f64.powi(decade);
            let mut matrix = Mat::from_fn(8, 8, |i, j| match (i, j) {
                _ if i == j => 1.0 + (i / 2) as f64 + if i % 2 == 1 { gap } else { 0.0 },
                _ if j == i + 1 && i % 2 == 0 => b,
                _ => 0.0,
            });
            for _ in 0..3 {
                let v = Mat::from_fn(8, 1, |_, _| uniform.draw());
                let twice = 2.0 / v.squared_norm_l2();
                let reflection = Mat::<f64>::identity(8, 8) - &v * v.transpose() * faer::Scale(twice);
                matrix = &reflection * &matrix * &reflection;
            }
            let solved = checked.solve(&constant(matrix, None).map_err(text)?, &REFERENCE);
            if let Err(said) = solved {
                return Err(format!("b {b:e}, gap {gap:e}: {said}"));
            }
        }
    }
    Ok(checked.said())
}

fn permuted() -> Result<String, String> {
    let mut off: f64 = 0.0;
    let n = 12;
    let pairs = random_pairs(5, n, 0.4);
    let plain: Vec<usize> = (0..n).collect();
    let mut turned = plain.clone();
    turned.rotate_left(5);
    turned.swap(1, 8);
    let signs: Vec<f64> = (0..n).map(|k| if k % 3 == 0 { -1.0 } else { 1.0 }).collect();
    let mut other = pairs.clone();
    let reversed = |rows: &Mat<f64>| Mat::from_fn(rows.nrows(), n, |i, j| rows[(rows.nrows() - 1 - i, j)]);
    (other.normal, other.sliding) = (reversed(&pairs.normal), reversed(&pairs.sliding));
    let a = with_pairs(1e-3, &pairs, &plain, &[1.0; 12]).map_err(text)?;
    let b = with_pairs(1e-3, &other, &turned, &signs).map_err(text)?;
    for step in 0..40 {
        let p = REFERENCE.with_friction(0.05 * f64::from(step));
        let (a, b) = (Checked::default().solve(&a, &p)?, Checked::default().solve(&b, &p)?);
        for root in &a.roots {
            let distance = |z: c64| (z - root.square).norm();
            let nearest = b.roots.iter().min_by(|x, y| distance(x.square).total_cmp(&distance(y.square)));
            let nearest = nearest.ok_or("no roots")?;
            let limit = 2.0 * (root.error.square + nearest.error.square);
            if distance(nearest.square) > limit {
                return Err(format!("{p:?}: {} and {} differ by more than {limit:e}", nearest.square, root.square));
            }
            off = off.max(distance(nearest.square) / root.square.norm());
        }
    }
    Ok(format!("the same to {off:.1e}"))
}

fn scanned() -> Result<String, String> {
    let (model, _) = squealing()?;
    scan(&model, &REFERENCE, 2.0, 100_000)
}

/// Relative tolerance between window ends of the map and those found by bisection of a scan.
const ENDS_AGREE: f64 = 1e-10;

/// Compares the windows of a map with `points` friction coefficients up to `mu_max`, solved independently of it.
/// Every unstable point must lie in a window, and every point well inside a window must be unstable. Where the number
/// of growing roots changes between two points, the change is located by bisection and must be the end of a window.
///
/// # Errors
/// The first disagreement.
pub fn scan(model: &Model, at: &OperatingPoint, mu_max: f64, points: usize) -> Result<String, String> {
    let mut solver = Solver::new(model.dimension());
    let options = MapOptions { mu_min: 0.0, mu_max, band_max_hz: None, instability_threshold: 1e-6, windows: true };
    let map = StabilityMap::build(model, &mut solver, at, &options).map_err(text)?;
    let ends: Vec<f64> = map.windows.iter().flat_map(|w| [Some(w.mu_from), w.mu_to]).flatten().collect();
    let mut solve = |mu: f64| solver.solve(model, &at.with_friction(mu), Vectors::None).map_err(text);
    let (mut growing, mut bisected, mut off) = (0, 0, 0.0f64);
    let mut before = None;
    for k in 0..points {
        let mu = mu_max * (k as f64 + 0.5) / points as f64;
        let spectrum = solve(mu)?;
        let grows = |threshold: f64| spectrum.roots.iter().any(|root| root.is_unstable(threshold));
        let inside =
            |slack: f64| map.windows.iter().any(|w| mu > w.mu_from + slack && w.mu_to.is_none_or(|to| mu < to - slack));
        if grows(1e-6) && !inside(-1e-9) {
            return Err(format!("{mu} grows in none of {:?}", map.windows));
        }
        if inside(1e-5) && !grows(1e-11) {
            return Err(format!("{mu} does not grow in {:?}", map.windows));
        }
        growing += usize::from(grows(1e-6));
        let count = growing_roots(&spectrum, if spectrum.undamped { GROWS } else { 0.0 });
        if let Some((left, below)) = before.replace((mu, count)).filter(|(_, below)| *below != count) {
            let mut bisect = |threshold: f64| change((left, below), mu, |mu| Ok(growing_roots(&solve(mu)?, threshold)));
            let end = if spectrum.undamped {
                // Beyond a merging point `σ/|λ|` rises like a square root, so a threshold moves the apparent end by
                // its square.
                let (near, far) = (bisect(GROWS)?, bisect(2.0 * GROWS)?);
                near - (far - near) / 3.0
            } else {
                bisect(0.0)?
            };
            let nearest = ends.iter().map(|other| (other - end).abs()).fold(f64::INFINITY, f64::min);
            if nearest > ENDS_AGREE * end {
                return Err(format!("{below} roots grow below {end}, {count} above; no window ends there: {ends:?}"));
            }
            bisected += 1;
            off = off.max(nearest / end);
        }
    }
    Ok(format!(
        "{} windows, {growing} of {points} points grow, all of them inside; {bisected} ends within {off:.1e} of bisected ones",
        map.windows.len()
    ))
}

/// Threshold of `σ/|λ|` for the growth of an undamped pair, used by bisection. Rounding leaves half the digits at a
/// merging point, where growth rises like a square root.
const GROWS: f64 = 1e-7;

/// Number of unstable roots.
fn growing_roots(spectrum: &Spectrum, threshold: f64) -> usize {
    spectrum.roots.iter().filter(|root| root.is_unstable(threshold)).count()
}

/// Locates the change of a count between `left`, where it is `below`, and `right`, by bisection to the last digit.
fn change(
    (mut left, below): (f64, usize),
    mut right: f64,
    mut count: impl FnMut(f64) -> Result<usize, String>,
) -> Result<f64, String> {
    loop {
        let middle = 0.5 * (left + right);
        if middle <= left || middle >= right || right - left <= 1e-15 * right {
            return Ok(right);
        }
        if count(middle)? == below { left = middle } else { right = middle }
    }
}

/// Maximum number of times the interval between two friction coefficients is halved to connect modes by shape.
const HALVED: usize = 24;

/// Follows the modes of a rig from friction coefficient 0 to `mu_max` in `steps` steps by the overlap of their shapes
/// alone, halving steps as needed, and compares with the identities of the map. Two modes that have exchanged
/// identities are a swap. Through a merging point a pair must keep its two identities, in either order. Returns the
/// number of modes compared, as text.
///
/// # Errors
/// The first swap, or a step over which shapes cannot be followed.
pub fn follow(model: &Model, at: &OperatingPoint, mu_max: f64, steps: usize) -> Result<String, String> {
    let mut solver = Solver::new(model.dimension());
    let options = MapOptions { mu_min: 0.0, mu_max, band_max_hz: None, instability_threshold: 1e-6, windows: true };
    let map = StabilityMap::build(model, &mut solver, at, &options).map_err(text)?;
    let mut solve = |mu: f64| solver.solve(model, &at.with_friction(mu), Vectors::Right).map_err(text);
    let mut here = solve(0.0)?;
    let mut ids: Vec<u32> = map.ids(&here).into_iter().take(tracked(&here)).map(Option::unwrap_or_default).collect();
    let (mut compared, mut halvings) = (0, 0);
    for step in 1..=steps {
        let target = mu_max * step as f64 / steps as f64;
        while here.point.friction_coefficient < target {
            let mut to = target;
            let (next, carried) = loop {
                let next = solve(to)?;
                if let Some(carried) = carried(&here, &ids, &next) {
                    break (next, carried);
                }
                halvings += 1;
                let from = here.point.friction_coefficient;
                to = 0.5 * (from + to);
                if to - from <= (target - from).max(mu_max / steps as f64) * 0.5f64.powi(HALVED as i32) {
                    return Err(format!("{from}: shapes cannot be followed"));
                }
            };
            (here, ids) = (next, carried);
        }
        let found = map.ids(&here);
        for k in 0..ids.len() {
            let partner = mirror(&here, k);
            let same = |j: usize| found[k] == Some(ids[j]);
            if !same(k) && !partner.is_some_and(same) {
                // Exchanges are accepted within a pair that has separated again, and between roots that rounding does
                // not separate.
                let other = (0..ids.len()).find(|&j| same(j));
                let may = |j: usize| was_pair(&map, ids[k], ids[j], target) || are_one(&here, k, j);
                let swapped = other.is_none_or(|j| found[j] != Some(ids[k]) || !may(j));
                if swapped {
                    let hz = here.roots[k].frequency_hz();
                    return Err(format!("{target}: mode {} at {hz} Hz is called {:?}", ids[k], found[k]));
                }
            }
            compared += 1;
        }
        // Within a pair the identities of the map are adopted from here on.
        ids = found.into_iter().take(ids.len()).map(Option::unwrap_or_default).collect();
    }
    Ok(format!("{compared} modes at {steps} steps, {halvings} of them halved, no swap"))
}

/// Whether rounding alone may separate two roots; the shapes of such a doublet are arbitrary within their plane.
fn are_one(spectrum: &Spectrum, a: usize, b: usize) -> bool {
    let value = |k: usize| if spectrum.undamped { spectrum.roots[k].square } else { spectrum.roots[k].lambda };
    (value(a) - value(b)).norm() <= 2.0 * ROUNDING * f64::EPSILON * spectrum.matrix_norm
}

/// Identities of `next` by the overlap of its shapes with those of `here`. Every shape must have one clear
/// counterpart, with two exceptions: two roots that merge or separate, whose shapes are nearly equal, and doublets.
/// These keep the order of their frequencies. `None` if a shape has no counterpart.
fn carried(here: &Spectrum, ids: &[u32], next: &Spectrum) -> Option<Vec<u32>> {
    let count = tracked(next);
    if count != ids.len() {
        return None;
    }
    let overlap = here.shapes.get(.., ..count).adjoint() * next.shapes.get(.., ..count);
    let mut of: Vec<Option<u32>> = vec![None; count];
    let mut taken = vec![false; count];
    for j in 0..count {
        let mut best: Vec<usize> = (0..count).collect();
        best.sort_by(|&a, &b| overlap[(b, j)].norm().total_cmp(&overlap[(a, j)].norm()));
        let [first, second] = [best[0], *best.get(1)?].map(|k| overlap[(k, j)].norm_sqr());
        // Shapes need not be orthogonal, so the overlap deficit of the best candidate is compared with that of the
        // second best.
        let clear = 1.0 - first < 0.1 * (1.0 - second);
        let merging = mirror(next, j).is_some() || nearly_merged(here, best[0], best[1]);
        let doublet = are_one(here, best[0], best[1]);
        if !(clear || merging && first > 0.9 || doublet && first + second > 0.9) {
            return None;
        }
        best.truncate(if clear && !doublet { 1 } else { 2 });
        best.sort_unstable(); // as roots are: by frequency
        let source = best.into_iter().find(|&k| !taken[k])?;
        taken[source] = true;
        of[j] = Some(ids[source]);
    }
    of.into_iter().collect()
}

/// Whether two roots are so close that their shapes are nearly equal.
fn nearly_merged(spectrum: &Spectrum, a: usize, b: usize) -> bool {
    let (a, b) = (spectrum.roots[a].square, spectrum.roots[b].square);
    (a - b).norm() < 1e-2 * a.norm()
}

/// Whether two identities are a pair of a window of the map that begins at or below `mu`.
fn was_pair(map: &StabilityMap, a: u32, b: u32, mu: f64) -> bool {
    map.windows.iter().any(|w| w.mu_from <= mu && w.mode_ids.contains(&a) && w.mode_ids.contains(&b))
}

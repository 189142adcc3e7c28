//! Compares a rig with the full model it was reduced from: the command `verify` and the table `[reduction]` of a rig
//! file.

use faer::c64;
use serde::Serialize;

use crate::contact::SteadyState;
use crate::full_model::FullModelFile;
use crate::physics::{MapError, MapOptions, OperatingPoint, SolveError, Solver, StabilityMap, Window};
use crate::random::Random;
use crate::reduction::{
    CompareError, FullProgress, FullSolver, FullVectors, Judged, ReductionError, compare_roots, compare_windows,
    full_windows, on_threads, reduced_roots, threads_for,
};
use crate::rig::{Certificate, Rig};

/// Default upper end of the band, if neither rig nor full model gives one, Hz.
pub const DEFAULT_BAND_HZ: f64 = 5000.0;
/// Roots that decay faster than this are neither compared nor held to the tolerance of a basis, 1/s.
pub const DECAY_PER_S: f64 = 20.0;

/// Why a rig could not be compared with its full model.
#[derive(Debug, thiserror::Error)]
pub enum VerificationError {
    /// No operating points were asked for.
    #[error("--points is 0, expected at least 1")]
    NoPoints,
    /// The contact pairs of one follow a contact state, those of the other are always closed.
    #[error(
        "{with}: `contact_state` is given, but the pairs of {without} are always closed; expected it in both or neither"
    )]
    ContactState {
        /// Name of the rig or full model that has it.
        with: String,
        /// Name of the other.
        without: String,
    },
    /// The full model could not be solved at an operating point.
    #[error("full model at {point:?}")]
    Full {
        /// The operating point.
        point: OperatingPoint,
        /// Why.
        source: ReductionError,
    },
    /// The rig could not be solved at an operating point.
    #[error("rig at {point:?}")]
    Rig {
        /// The operating point.
        point: OperatingPoint,
        /// Why.
        source: SolveError,
    },
    /// The windows of instability of the full model were not found.
    #[error(transparent)]
    Windows(#[from] CompareError),
    /// The windows of instability of the rig were not found.
    #[error(transparent)]
    Map(#[from] MapError),
}

impl VerificationError {
    /// Whether memory did not suffice.
    fn is_of_memory(&self) -> bool {
        match self {
            Self::Full { source, .. } | Self::Windows(CompareError::Full(source)) => {
                matches!(source, ReductionError::Memory { .. })
            }
            Self::Windows(_) | Self::NoPoints | Self::ContactState { .. } | Self::Rig { .. } | Self::Map(_) => false,
        }
    }
}

/// Options of a comparison.
#[derive(Clone, Debug)]
pub struct Against {
    /// Number of held-out operating points.
    pub points: usize,
    /// Seed of their random choice.
    pub seed: u64,
    /// Upper end of the band, Hz, overriding that of the rig or the full model.
    pub band_hz: Option<f64>,
    /// Whether windows of instability are compared.
    pub windows: bool,
}

/// Errors at one operating point.
#[derive(Clone, Debug, Serialize)]
pub struct PointReport {
    pub normal_load_n: f64,
    pub disc_speed_rad_s: f64,
    pub friction_coefficient: f64,
    pub modes: usize,
    pub max_frequency_error: f64,
    pub max_growth_error_per_s: f64,
    pub max_relative_error: f64,
    /// Growth rate (1/s) and frequency (Hz) of each missed mode.
    pub missed: Vec<[f64; 2]>,
    pub invented: Vec<[f64; 2]>,
    pub unpaired: usize,
    /// The contact states of both; `None` if the pairs are always closed, or if one of the two has no state.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub contact: Option<ContactDifference>,
}

/// Contact states of full model and rig.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct ContactDifference {
    /// Pairs that carry a force in the full model, and in the rig.
    pub pairs_closed: [usize; 2],
    /// Pairs that carry a force in one of the two only.
    pub pairs_differ: usize,
    /// Largest difference of the force of a pair, relative to the largest force of the full model.
    pub max_force_error: f64,
}

impl ContactDifference {
    fn new(full: &SteadyState, rig: &SteadyState) -> Self {
        let largest = full.force_n.iter().copied().fold(0.0, f64::max);
        let forces = || full.force_n.iter().zip(&rig.force_n);
        Self {
            pairs_closed: [full.pairs_closed(), rig.pairs_closed()],
            pairs_differ: forces().filter(|(full, rig)| (**full > 0.0) != (**rig > 0.0)).count(),
            max_force_error: forces().map(|(full, rig)| (full - rig).abs() / largest).fold(0.0, f64::max),
        }
    }
}

/// A window of instability of the full model, the rig or both.
#[derive(Clone, Debug, Serialize)]
pub struct WindowReport {
    pub normal_load_n: f64,
    pub disc_speed_rad_s: f64,
    pub kind: &'static str,
    pub full: Option<WindowEnds>,
    pub rig: Option<WindowEnds>,
}

#[derive(Clone, Copy, Debug, Serialize)]
pub struct WindowEnds {
    pub mu_from: f64,
    pub mu_to: Option<f64>,
    pub frequency_hz: f64,
}

/// The result of `verify`: the certificate and its details.
#[derive(Clone, Debug, Serialize)]
pub struct Verified {
    pub certificate: Certificate,
    pub points: Vec<PointReport>,
    pub windows: Vec<WindowReport>,
}

/// Compares a rig with its full model: contact states and roots at held-out operating points within the rig's range, and
/// windows of instability at the reference and at the corners of that range. A held-out point without a state of steady
/// sliding in one of the two counts as missed or invented, and is omitted otherwise. `full_solver` solves the full model; `progress`
/// receives a description of the step and its progress.
///
/// # Errors
/// [`VerificationError`].
pub fn verify_against(
    rig: &Rig,
    full: &FullModelFile,
    full_solver: &mut FullSolver<'_>,
    against: &Against,
    progress: &mut dyn FnMut(&str, FullProgress),
) -> Result<Verified, VerificationError> {
    if against.points == 0 {
        return Err(VerificationError::NoPoints);
    }
    let (of_rig, of_full) = (rig.name.clone(), full.name.clone());
    match (rig.model.statics(), full.model.statics()) {
        (Some(_), None) => return Err(VerificationError::ContactState { with: of_rig, without: of_full }),
        (None, Some(_)) => return Err(VerificationError::ContactState { with: of_full, without: of_rig }),
        (Some(_), Some(_)) | (None, None) => {}
    }
    let band_hz = against.band_hz.or(rig.band_max_hz).or(full.settings.band_max_hz).unwrap_or(DEFAULT_BAND_HZ);
    let band_rad_s = std::f64::consts::TAU * band_hz;
    let judged = Judged { band_rad_s, instability_threshold: rig.instability_threshold, decay_per_s: DECAY_PER_S };
    let mut states = StatesOfOne::default();
    let held_out: Vec<(usize, OperatingPoint)> =
        held_out(rig, against).into_iter().enumerate().filter(|(_, p)| !states.miss(rig, full, p)).collect();
    let options = MapOptions {
        mu_min: 0.0,
        mu_max: rig.mu_max.min(rig.limits.friction_coefficient[1]),
        band_max_hz: Some(band_hz),
        instability_threshold: rig.instability_threshold,
        windows: true,
    };
    let places = if against.windows { places(rig) } else { vec![] };
    let compared = Compared { rig, full, judged, options };
    let threads = threads_for(held_out.len().max(places.len()));
    let (points, of_places) = full_solver.for_threads(threads, VerificationError::is_of_memory, |solvers| {
        let mut workers: Vec<_> =
            solvers.iter_mut().map(|full| Solvers { full, reduced: Solver::new(rig.model.dimension()) }).collect();
        let mut report = |(what, step): (String, FullProgress)| progress(&what, step);
        let points = on_threads(&mut workers, &held_out, &mut report, &|solvers, (index, p), report| {
            let what = format!("point {} of {}", index + 1, against.points);
            compared.roots(solvers, p, &mut |step| report((what.clone(), step)))
        })?;
        // The full model first: its windows take longer.
        let of_both: Vec<_> =
            [Side::Full, Side::Rig].into_iter().flat_map(|side| places.iter().map(move |p| (side, p))).collect();
        let windows = on_threads(&mut workers, &of_both, &mut report, &|solvers, &(side, p), report| {
            let what = format!("windows at {} N, {} rad/s", p.normal_load_n, p.disc_speed_rad_s);
            compared.windows(solvers, side, p, &mut |step| report((what.clone(), step)))
        })?;
        Ok((points, windows))
    })?;
    let (windows_of_full, windows_of_rig) = of_places.split_at(places.len());
    let (mut windows, mut critical, mut missed, mut invented) = (vec![], None::<f64>, 0, 0);
    for ((p, of_full), of_rig) in places.iter().zip(windows_of_full).zip(windows_of_rig) {
        let compared = compare_windows(of_full, of_rig);
        if !compared.pairs.is_empty() {
            critical = Some(critical.unwrap_or(0.0).max(compared.friction_error(options.mu_max)));
        }
        missed += compared.missed.len();
        invented += compared.invented.len();
        let report = |full: Option<&Window>, rig: Option<&Window>| WindowReport {
            normal_load_n: p.normal_load_n,
            disc_speed_rad_s: p.disc_speed_rad_s,
            kind: full.or(rig).map_or("", |window| window.kind.name()),
            full: full.map(ends),
            rig: rig.map(ends),
        };
        windows.extend(compared.pairs.iter().map(|(full, rig)| report(Some(full), Some(rig))));
        windows.extend(compared.missed.iter().map(|full| report(Some(full), None)));
        windows.extend(compared.invented.iter().map(|rig| report(None, Some(rig))));
    }
    // Without a compared mode the errors are unknown, hence NaN.
    let nothing = if points.iter().all(|point| point.modes == 0) { f64::NAN } else { 0.0 };
    let largest = |of: fn(&PointReport) -> f64| nothing + points.iter().map(of).fold(0.0, f64::max);
    let contacts = || points.iter().filter_map(|point| point.contact);
    let certificate = Certificate {
        full_model_hash: full.content_hash.clone(),
        method: rig.reduction.as_ref().map(|known| known.method.clone()).unwrap_or_default(),
        band_hz,
        points: against.points,
        max_frequency_error: largest(|point| point.max_frequency_error),
        max_growth_error_per_s: largest(|point| point.max_growth_error_per_s),
        max_relative_error: largest(|point| point.max_relative_error),
        windows_compared_at: places.len(),
        critical_friction_error: critical,
        max_force_error: contacts().map(|contact| contact.max_force_error).reduce(f64::max),
        pairs_differ: contacts().map(|contact| contact.pairs_differ).reduce(|sum, count| sum + count),
        missed: missed + states.of_full + points.iter().map(|point| point.missed.len()).sum::<usize>(),
        invented: invented + states.of_rig + points.iter().map(|point| point.invented.len()).sum::<usize>(),
        unpaired: points.iter().map(|point| point.unpaired).sum(),
    };
    Ok(Verified { certificate, points, windows })
}

/// What is compared, and within which scope.
struct Compared<'a> {
    rig: &'a Rig,
    full: &'a FullModelFile,
    judged: Judged,
    options: MapOptions,
}

/// The two sides of a comparison.
#[derive(Clone, Copy)]
enum Side {
    Full,
    Rig,
}

/// The solvers of one thread.
struct Solvers<'s, 'a> {
    full: &'s mut FullSolver<'a>,
    reduced: Solver,
}

impl Compared<'_> {
    /// Compares roots and contact states at `p`.
    fn roots(
        &self,
        solvers: &mut Solvers<'_, '_>,
        p: &OperatingPoint,
        progress: &mut dyn FnMut(FullProgress),
    ) -> Result<PointReport, VerificationError> {
        let model = &self.rig.model;
        let found = solvers
            .full
            .roots(p, self.judged.band_rad_s, FullVectors::None, progress)
            .map_err(|source| VerificationError::Full { point: *p, source })?;
        let lambdas: Vec<c64> = found.roots.iter().map(|root| root.lambda).collect();
        let failed = |source| VerificationError::Rig { point: *p, source };
        let reduced = reduced_roots(model, &mut solvers.reduced, p).map_err(failed)?;
        let here = model.at(p).map_err(|error| failed(error.into()))?;
        let comparison = compare_roots(&lambdas, &reduced, &self.judged);
        let listed = |roots: &[c64]| roots.iter().map(|l| [l.re, l.im / std::f64::consts::TAU]).collect();
        Ok(PointReport {
            normal_load_n: p.normal_load_n,
            disc_speed_rad_s: p.disc_speed_rad_s,
            friction_coefficient: p.friction_coefficient,
            modes: comparison.pairs.len(),
            max_frequency_error: comparison.frequency_error(),
            max_growth_error_per_s: comparison.growth_error_per_s(),
            max_relative_error: comparison.relative_error(),
            missed: listed(&comparison.missed),
            invented: listed(&comparison.invented),
            unpaired: comparison.unpaired,
            contact: found.here.state().zip(here.state()).map(|(full, rig)| ContactDifference::new(full, rig)),
        })
    }

    /// The windows of instability at the load and speed of `p`.
    fn windows(
        &self,
        solvers: &mut Solvers<'_, '_>,
        side: Side,
        p: &OperatingPoint,
        progress: &mut dyn FnMut(FullProgress),
    ) -> Result<Vec<Window>, VerificationError> {
        let Self { rig, full, judged, options } = self;
        Ok(match side {
            Side::Full => full_windows(&full.model, solvers.full, p, judged.band_rad_s, options, progress)?,
            Side::Rig => StabilityMap::of_windows(&rig.model, &mut solvers.reduced, p, options)?.windows,
        })
    }
}

/// Number of held-out points at which only one of the two has a state of steady sliding.
#[derive(Default)]
struct StatesOfOne {
    of_full: usize,
    of_rig: usize,
}

impl StatesOfOne {
    /// Whether full model or rig has no state of steady sliding at `p`; counts it if the other one has.
    fn miss(&mut self, rig: &Rig, full: &FullModelFile, p: &OperatingPoint) -> bool {
        let (of_full, of_rig) = (full.model.at(p).is_ok(), rig.model.at(p).is_ok());
        self.of_full += usize::from(of_full && !of_rig);
        self.of_rig += usize::from(of_rig && !of_full);
        !(of_full && of_rig)
    }
}

fn ends(window: &Window) -> WindowEnds {
    WindowEnds { mu_from: window.mu_from, mu_to: window.mu_to, frequency_hz: window.frequency_hz }
}

/// Random operating points: load and speed from the range of the chart, friction coefficient from the range searched.
fn held_out(rig: &Rig, against: &Against) -> Vec<OperatingPoint> {
    let mut random = Random::new(against.seed);
    let mut within = |[low, high]: [f64; 2]| low + (high - low) * random.uniform();
    let [mu_low, mu_high] = rig.limits.friction_coefficient;
    (0..against.points)
        .map(|_| OperatingPoint {
            normal_load_n: within(rig.chart.normal_load_n),
            disc_speed_rad_s: within(rig.chart.disc_speed_rad_s),
            friction_coefficient: within([mu_low.max(0.0), mu_high.min(rig.mu_max)]),
        })
        .collect()
}

/// Loads and speeds at which windows are compared: the reference, and the corners of the chart's range. A condition on
/// which the model does not depend stays at its reference value.
fn places(rig: &Rig) -> Vec<OperatingPoint> {
    let mut places = vec![rig.reference];
    let (load, speed) = rig.model.depends_on_load_and_speed();
    let ends = |matters: bool, range: [f64; 2], reference: f64| if matters { range.to_vec() } else { vec![reference] };
    for normal_load_n in ends(load, rig.chart.normal_load_n, rig.reference.normal_load_n) {
        for disc_speed_rad_s in ends(speed, rig.chart.disc_speed_rad_s, rig.reference.disc_speed_rad_s) {
            places.push(OperatingPoint { normal_load_n, disc_speed_rad_s, ..rig.reference });
        }
    }
    places.dedup();
    places
}

//! Run time and error of every route from an operating point to its roots, on synthetic rigs.
//!
//! At each operating point all routes are measured in turn, so that other load on the machine affects all of them
//! alike. Errors are relative errors of `λ²` against roots to thirty digits ([`crate::proof::reference`]) of a seeded
//! choice of modes. Where rounding does not separate two roots, they are the errors of the pair's mean and
//! discriminant. Every answer is checked before it is timed.

pub mod lapack;

use std::sync::Arc;
use std::time::{Duration, Instant};

use faer::{Mat, c64};
use serde::Serialize;

use crate::contact::PressureLaw;
use crate::msgs::listed;
use crate::physics::chart::Scratch;
use crate::physics::chart::build::{ChartError, ChartOptions, Progress, resume};
use crate::physics::{
    Chart, ContactLaw, MapError, MapOptions, Model, ModelError, NotCharted, OperatingPoint, Root, SolveError, Solver,
    Spectrum, StabilityMap, Summary, Traces, Vectors,
};
use crate::proof::held_out::hold_out;
use crate::proof::reference::{self, Refined};
use crate::proof::synthetic::{STIFFNESS_N_PER_M, Synthetic, Uniform, parts, statics, turning_parts};
use lapack::{Lapack, LapackError};

/// Which synthetic rigs are measured.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum Kind {
    /// No damping, a linear contact: only the friction coefficient matters
    Undamped,
    /// No damping, a contact that stiffens with the cube root of the load
    Hertzian,
    /// Modal damping of 0.5 %, friction that damps across the sliding: friction coefficient and load over speed matter
    Lateral,
    /// Modal damping of 0.5 %, friction that falls with speed and damps across it, a stiffening contact: everything matters
    Damped,
    /// No damping, contact pairs that follow the state of steady sliding by the exponential law of rough surfaces: friction
    /// coefficient and load matter
    Rough,
    /// The same with springs that only push: roots jump where pairs open and close
    Opening,
    /// As `rough`, with a disc that turns in the frame of the pad: friction coefficient, load and speed matter
    Turning,
}

impl Kind {
    /// The contact law of the state of steady sliding; `None` for springs that are always closed. Where a pair carries its
    /// share of 500 N it is as stiff as these.
    fn contact_state(self, pairs: usize) -> Option<PressureLaw> {
        let (stiffness, share) = (STIFFNESS_N_PER_M / pairs as f64, 500.0 / pairs as f64);
        match self {
            Self::Undamped | Self::Hertzian | Self::Lateral | Self::Damped => None,
            Self::Rough | Self::Turning => {
                Some(PressureLaw::Exponential { pressure: 0.1 * share, roughness_m: share / stiffness })
            }
            Self::Opening => Some(PressureLaw::Linear { stiffness }),
        }
    }
}

/// The highest friction coefficient.
const MU_MAX: f64 = 1.0;
/// Largest initial gap of a rig with a contact state, m.
const GAP_M: f64 = 5e-6;
/// Anchors of its states, along the load and along the friction coefficient.
const ANCHORS: [u32; 2] = [6, 9];

/// Options of a measurement.
#[derive(Clone, Copy, Debug)]
pub struct Plan {
    pub kind: Kind,
    pub conditions: usize,
    /// Number of modes compared with the reference at each operating point.
    pub compared: usize,
    /// Number of random operating points at which every root of the chart is compared with a dense solve.
    pub held_out: usize,
    pub pairs: usize,
    pub seed: u64,
    pub band_max_hz: f64,
    pub tolerance: f64,
    /// Time limit of building the chart. Leaves not finished by then are solved densely.
    pub chart_limit: Duration,
    pub threads: usize,
}

/// Run time and errors of one route on one rig.
#[derive(Clone, Debug, Serialize)]
pub struct Route {
    pub modes: usize,
    pub route: &'static str,
    /// Number of operating points at which the route gave an answer.
    pub conditions: usize,
    pub median_us: f64,
    pub p99_us: f64,
    /// Median over the operating points of the ratio to LAPACK's time for the same problem.
    pub to_lapack: Option<f64>,
    /// Median and largest relative error of `λ²`.
    pub median_error: f64,
    pub largest_error: f64,
    /// Largest relative error of the mean of merging pairs, and of their discriminant relative to the square of the
    /// mean.
    pub largest_pair_mean_error: Option<f64>,
    pub largest_discriminant_error: Option<f64>,
    /// Number of roots compared with their error bounds, and how many broke them.
    pub bounds_checked: usize,
    pub bounds_broken: usize,
}

/// Preparation on one rig, before the first operating point, and counts of what was compared.
#[derive(Clone, Debug, Serialize)]
pub struct Offline {
    pub modes: usize,
    /// Seed of the rig.
    pub seed: u64,
    /// Number of merging points (with damping: zero crossings of growth rates), and of operating points within 1e-6 of
    /// one.
    pub merging_points: usize,
    pub near_merging: usize,
    /// Number of decoupled modes, which every dense solve excludes.
    pub decoupled_modes: usize,
    pub map_s: f64,
    pub chart_s: f64,
    /// False if the time limit ended the build.
    pub chart_complete: bool,
    pub chart_solves: usize,
    pub chart_leaves: usize,
    pub chart_bytes: usize,
    /// Share of the box that is solved densely, because it did not converge or was not reached in time.
    pub chart_dense_share: f64,
    /// Number of dense solves that the chart saved, out of `conditions`.
    pub dense_solves_skipped: usize,
    pub conditions: usize,
    /// Number of merging pairs compared, and of roots for which the reference did not converge.
    pub pairs_compared: usize,
    pub not_refined: usize,
    /// `None` if not requested.
    pub held_out: Option<HeldOut>,
}

/// Every root of a chart compared with dense solves at random operating points.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct HeldOut {
    /// Number of points that the chart answered, that lie on no converged leaf, and at which the trace check failed.
    pub charted: usize,
    pub not_converged: usize,
    pub incomplete: usize,
    /// Number of roots whose difference exceeds the sum of both bounds.
    pub bounds_broken: usize,
    /// Largest difference relative to its bound.
    pub largest_share: f64,
    /// Largest relative error of `λ²` away from merging points, and of the mean of merging pairs.
    pub largest_error: f64,
    pub largest_pair_mean_error: f64,
}

/// Why the routes could not be measured.
#[derive(Debug, thiserror::Error)]
pub enum BenchError {
    /// The rig could not be made or assembled.
    #[error(transparent)]
    Model(#[from] ModelError),
    /// The merging points of the rig were not found.
    #[error(transparent)]
    Map(#[from] MapError),
    /// A dense solve failed.
    #[error("{point:?}")]
    Solve {
        /// The operating point.
        point: OperatingPoint,
        /// Why.
        source: SolveError,
    },
    /// The chart could not be built.
    #[error(transparent)]
    Chart(#[from] ChartError),
    /// A dense solve at a held-out point failed.
    #[error("held-out conditions")]
    HeldOut(#[source] SolveError),
    /// The chart gave roots at a point once, but not again.
    #[error(transparent)]
    NotCharted(#[from] NotCharted),
    /// LAPACK gave no answer.
    #[error(transparent)]
    Lapack(#[from] LapackError),
    /// The band holds no mode to compare.
    #[error("no mode below {band_max_hz} Hz")]
    NoModes {
        /// Upper end of the band, Hz.
        band_max_hz: f64,
    },
}

listed! {
    /// A way to the roots at an operating point. Results list them in this order.
    enum Way {
        DenseValues,
        DenseVectors,
        ChartValues,
        ChartBounds,
        LapackValues,
        LapackVectors,
    }
}

impl Way {
    fn name(self) -> &'static str {
        match self {
            Self::DenseValues => "dense values",
            Self::DenseVectors => "dense both vectors",
            Self::ChartValues => "chart values",
            Self::ChartBounds => "chart + certificate",
            Self::LapackValues => "LAPACK values",
            Self::LapackVectors => "LAPACK both vectors",
        }
    }

    /// The way whose time its own is divided by. A chart is compared with LAPACK's time without vectors.
    fn compared_with(self) -> Option<Self> {
        match self {
            Self::DenseValues | Self::ChartValues | Self::ChartBounds => Some(Self::LapackValues),
            Self::DenseVectors => Some(Self::LapackVectors),
            Self::LapackValues | Self::LapackVectors => None,
        }
    }

    /// Whether it has an answer only where the chart has one.
    fn needs_chart(self) -> bool {
        match self {
            Self::ChartValues | Self::ChartBounds => true,
            Self::DenseValues | Self::DenseVectors | Self::LapackValues | Self::LapackVectors => false,
        }
    }
}

/// Times and errors collected for one route.
#[derive(Clone, Debug, Default)]
struct Samples {
    time_us: Vec<f64>,
    ratio: Vec<f64>,
    error: Vec<f64>,
    pair_mean: Vec<f64>,
    discriminant: Vec<f64>,
    checked: usize,
    broken: usize,
}

impl Samples {
    fn summary(mut self, modes: usize, route: &'static str) -> Option<Route> {
        if self.time_us.is_empty() {
            return None;
        }
        let quantile = |values: &mut Vec<f64>, share: f64| {
            values.sort_by(f64::total_cmp);
            values.get(((values.len() as f64 - 1.0) * share).round() as usize).copied().unwrap_or(f64::NAN)
        };
        let largest = |values: &[f64]| values.iter().copied().reduce(f64::max);
        Some(Route {
            modes,
            route,
            conditions: self.time_us.len(),
            median_us: quantile(&mut self.time_us, 0.5),
            p99_us: quantile(&mut self.time_us, 0.99),
            to_lapack: (!self.ratio.is_empty()).then(|| quantile(&mut self.ratio, 0.5)),
            median_error: quantile(&mut self.error, 0.5),
            largest_error: largest(&self.error).unwrap_or(f64::NAN),
            largest_pair_mean_error: largest(&self.pair_mean),
            largest_discriminant_error: largest(&self.discriminant),
            bounds_checked: self.checked,
            bounds_broken: self.broken,
        })
    }

    /// Adds the errors of one cluster of roots at one operating point. `roots` are all roots of the route, as `λ²` if
    /// the model is undamped and `λ` otherwise, each with its error bound if the route gives one. `refined` is the
    /// cluster to thirty digits.
    fn compare(&mut self, spectrum: &Spectrum, refined: &Refined, roots: &[(c64, Option<f64>)]) {
        // Relative errors of λ² are twice those of λ.
        let factor = if spectrum.undamped { 1.0 } else { 2.0 };
        let mut left: Vec<(c64, Option<f64>)> = roots.to_vec();
        let mut found = vec![];
        for (&j, &error) in refined.members.iter().zip(&refined.errors) {
            let dense = reference::solved_for(spectrum, j);
            let distance = |k: &usize| (left[*k].0 - dense - error).norm();
            let Some(k) = (0..left.len()).min_by(|a, b| distance(a).total_cmp(&distance(b))) else { return };
            let (value, bound) = left.swap_remove(k);
            let off = (value - dense - error).norm();
            found.push((value, dense, off));
            if let Some(bound) = bound {
                self.checked += 1;
                self.broken += usize::from(off.is_nan() || off > bound);
            }
        }
        let mean = |of: fn(&(c64, c64, f64)) -> c64| found.iter().map(of).sum::<c64>() / found.len() as f64;
        match found.as_slice() {
            [(_, dense, off)] => self.error.push(factor * off / dense.norm()),
            _ => {
                let size = mean(|f| f.1).norm();
                let off = mean(|f| f.0 - f.1) - refined.mean_error;
                self.pair_mean.push(factor * off.norm() / size);
                if let [(a, ..), (b, ..)] = found.as_slice() {
                    let half = 0.5 * (a - b);
                    self.discriminant.push((half * half - refined.discriminant).norm() / (size * size));
                }
            }
        }
    }
}

/// Seeded operating points, one tenth of them within 1e-6 of a merging point.
fn conditions(plan: &Plan, merging: &[f64], reference: &OperatingPoint) -> Vec<OperatingPoint> {
    let mut uniform = Uniform::new(plan.seed.wrapping_add(1000));
    let mut share = move || 0.5 * (uniform.draw() + 1.0);
    (0..plan.conditions)
        .map(|k| {
            let p = OperatingPoint {
                normal_load_n: 50.0 * 40f64.powf(share()),
                disc_speed_rad_s: 60f64.powf(share()),
                friction_coefficient: share(),
            };
            let (which, off) = (share(), 1e-6 * (2.0 * share() - 1.0));
            if !is_near_merging(k, merging) {
                return p;
            }
            // Merging points depend on load and speed, so those of the reference are kept.
            let at = merging[((which * merging.len() as f64) as usize).min(merging.len() - 1)];
            reference.with_friction((at + off).clamp(0.0, 1.0))
        })
        .collect()
}

/// Whether the k-th operating point is near a merging point: every tenth is, if there are merging points.
fn is_near_merging(k: usize, merging: &[f64]) -> bool {
    k % 10 == 9 && !merging.is_empty()
}

/// Largest number of rigs drawn to find one with merging points.
const MOST_SEEDS: u64 = 40;

/// Draws rigs, starting from the seed of the plan, until one has merging points in the band at the load and speed of
/// `reference`. Returns its seed, its model and its merging points; the last rig drawn if none has any.
fn squealing(modes: usize, plan: &Plan, reference: &OperatingPoint) -> Result<(u64, Model, Vec<f64>), BenchError> {
    let options = MapOptions {
        mu_min: 0.0,
        mu_max: 1.0,
        band_max_hz: Some(plan.band_max_hz),
        instability_threshold: 1e-6,
        windows: true,
    };
    let mut seed = plan.seed;
    loop {
        let model = model(modes, plan, seed)?;
        let map = StabilityMap::build(&model, &mut Solver::new(modes), reference, &options)?;
        let merging: Vec<f64> = map.windows.iter().flat_map(|w| [Some(w.mu_from), w.mu_to]).flatten().collect();
        if !merging.is_empty() || seed + 1 >= plan.seed + MOST_SEEDS {
            return Ok((seed, model, merging));
        }
        seed += 1;
    }
}

fn model(modes: usize, plan: &Plan, seed: u64) -> Result<Model, ModelError> {
    let contact_law = match plan.kind {
        Kind::Undamped => ContactLaw::default(),
        Kind::Hertzian => ContactLaw { exponent: 1.0 / 3.0, ..ContactLaw::default() },
        Kind::Lateral => ContactLaw { lateral_damping: true, ..ContactLaw::default() },
        Kind::Rough | Kind::Opening | Kind::Turning => ContactLaw::default(),
        Kind::Damped => ContactLaw {
            exponent: 1.0 / 3.0,
            reference_n: 500.0,
            slope_s_per_m: -0.02,
            lateral_damping: true,
            stribeck: None,
        },
    };
    let damping_ratio = if matches!(plan.kind, Kind::Damped | Kind::Lateral) { 5e-3 } else { 0.0 };
    let synthetic = Synthetic { modes, pairs: plan.pairs, damping_ratio, contact_law, seed };
    let parts = if plan.kind == Kind::Turning { turning_parts(&synthetic)? } else { parts(&synthetic)? };
    let Some(law) = plan.kind.contact_state(plan.pairs) else { return parts.free.with_contact(&parts.pairs) };
    let statics = statics(&parts, law, GAP_M).map_err(ModelError::State)?;
    let [loads, frictions] = ANCHORS.map(|count| (0..count).map(move |k| f64::from(k) / f64::from(count - 1)));
    let loads: Vec<f64> = loads.map(|share| 50.0 * 40f64.powf(share)).collect();
    let frictions: Vec<f64> = frictions.map(|share| MU_MAX * share).collect();
    let statics = Arc::new(statics.with_anchors(&loads, &frictions));
    parts.free.with_steady_contact(&parts.pairs, statics, None)
}

/// The answers of the dense solver and of LAPACK at one operating point. Those of the chart are in [`Routes`].
struct Answers {
    values: Spectrum,
    spectrum: Spectrum,
    on_chart: bool,
    /// Eigenvalues of LAPACK, without and with vectors.
    lapack: Option<[Vec<c64>; 2]>,
}

/// All routes on one rig, and what has been measured.
struct Routes<'a> {
    plan: &'a Plan,
    model: &'a Model,
    chart: &'a Chart,
    lapack: Option<&'a mut Lapack>,
    traces: Traces,
    solver: Solver,
    scratch: Scratch,
    summary: Summary,
    /// Roots of the chart at the present operating point: values only, and with bounds.
    bare: Vec<c64>,
    charted: Vec<Root>,
    samples: [Samples; Way::ALL.len()],
    pairs_compared: usize,
    not_refined: usize,
}

impl Routes<'_> {
    fn sample(&mut self, way: Way) -> &mut Samples {
        &mut self.samples[way as usize]
    }

    fn solve(&mut self, p: &OperatingPoint, vectors: Vectors) -> Result<Spectrum, BenchError> {
        self.solver.solve(self.model, p, vectors).map_err(|source| BenchError::Solve { point: *p, source })
    }

    /// The answers of all routes at `p`, checked but not timed.
    fn answer(&mut self, p: &OperatingPoint) -> Result<Answers, BenchError> {
        let values = self.solve(p, Vectors::None)?;
        let spectrum = self.solve(p, Vectors::Both)?;
        self.charted.clear();
        let known = self.traces.at(self.model, p);
        let on_chart = self.chart.evaluate(p, known, &mut self.scratch, &mut self.charted).is_ok();
        self.bare.clear();
        if on_chart {
            self.chart.values(p, &mut self.scratch, &mut self.bare)?;
        }
        let lapack = match self.lapack.as_deref_mut() {
            None => None,
            Some(peer) => {
                let matrix = self.solver.matrix(&spectrum);
                Some([peer.solve(matrix, false)?.1, peer.solve(matrix, true)?.1])
            }
        };
        Ok(Answers { values, spectrum, on_chart, lapack })
    }

    /// Compares every route with a cluster of roots to thirty digits.
    fn compare(&mut self, answers: &Answers, refined: &Refined) {
        let Answers { values, spectrum, on_chart, lapack } = answers;
        let of_root = |root: &Root, bounded: bool| {
            let (z, bound) =
                if spectrum.undamped { (root.square, root.error.square) } else { (root.lambda, root.error.omega) };
            (z, bounded.then_some(bound))
        };
        let all = |roots: &[Root], bounded| roots.iter().map(|r| of_root(r, bounded)).collect::<Vec<_>>();
        self.pairs_compared += usize::from(refined.members.len() > 1);
        self.sample(Way::DenseValues).compare(spectrum, refined, &all(&values.roots, false));
        self.sample(Way::DenseVectors).compare(spectrum, refined, &all(&spectrum.roots, true));
        if *on_chart {
            let bare: Vec<_> = self.bare.iter().map(|&z| (z, None)).collect();
            let charted = all(&self.charted, true);
            self.sample(Way::ChartValues).compare(spectrum, refined, &bare);
            self.sample(Way::ChartBounds).compare(spectrum, refined, &charted);
        }
        let sign = if spectrum.undamped { -1.0 } else { 1.0 };
        for (way, theirs) in [Way::LapackValues, Way::LapackVectors].into_iter().zip(lapack.iter().flatten()) {
            let theirs: Vec<_> = theirs.iter().map(|z| (z * sign, None)).collect();
            self.sample(way).compare(spectrum, refined, &theirs);
        }
    }

    /// Times the routes at `p`, one after another.
    fn time(&mut self, p: &OperatingPoint, answers: &Answers) -> Result<(), BenchError> {
        for (way, theirs, vectors) in [
            (Way::DenseValues, Way::LapackValues, Vectors::None),
            (Way::DenseVectors, Way::LapackVectors, Vectors::Both),
        ] {
            let begun = Instant::now();
            std::hint::black_box(self.solve(p, vectors)?);
            self.took(way, begun.elapsed().as_secs_f64());
            if let Some(peer) = self.lapack.as_deref_mut() {
                let (seconds, _) = peer.solve(self.solver.matrix(&answers.spectrum), vectors == Vectors::Both)?;
                self.took(theirs, seconds);
            }
        }
        if answers.on_chart {
            self.time_chart(p)?;
        }
        if self.lapack.is_some() {
            let compared = Way::ALL.into_iter().filter_map(|way| Some((way, way.compared_with()?)));
            for (way, theirs) in compared.filter(|(way, _)| answers.on_chart || !way.needs_chart()) {
                let last = |way: Way| self.samples[way as usize].time_us.last().copied().unwrap_or(f64::NAN);
                let ratio = last(way) / last(theirs);
                self.sample(way).ratio.push(ratio);
            }
        }
        Ok(())
    }

    fn time_chart(&mut self, p: &OperatingPoint) -> Result<(), BenchError> {
        // One untimed evaluation first: the dense solves evicted the chart from the caches, as they would not in a run
        // of charted predictions.
        self.bare.clear();
        self.chart.values(p, &mut self.scratch, &mut self.bare)?;
        self.bare.clear();
        let begun = Instant::now();
        self.chart.values(p, &mut self.scratch, &mut self.bare)?;
        self.took(Way::ChartValues, begun.elapsed().as_secs_f64());
        self.charted.clear();
        let begun = Instant::now();
        let known = self.traces.at(self.model, p);
        let all = self.chart.evaluate(p, known, &mut self.scratch, &mut self.charted)?;
        let band = Some(self.plan.band_max_hz);
        self.summary.take_chart(&self.charted, p.friction_coefficient, all, None, band, 1e-6);
        std::hint::black_box(&self.summary);
        self.took(Way::ChartBounds, begun.elapsed().as_secs_f64());
        Ok(())
    }

    fn took(&mut self, way: Way, seconds: f64) {
        self.sample(way).time_us.push(1e6 * seconds);
    }
}

/// Compares the chart with dense solves at held-out points; `None` if the plan asks for none.
fn checked(
    model: &Model,
    plan: &Plan,
    options: &ChartOptions,
    chart: &Chart,
    say: &dyn Fn(&str),
) -> Result<Option<HeldOut>, BenchError> {
    if plan.held_out == 0 {
        return Ok(None);
    }
    say("held-out conditions");
    let seed = plan.seed.wrapping_add(3000);
    let found = hold_out(model, options, chart, plan.held_out, seed).map_err(BenchError::HeldOut)?;
    Ok(Some(HeldOut {
        charted: found.charted,
        not_converged: found.not_converged,
        incomplete: found.incomplete,
        bounds_broken: found.violations,
        largest_share: found.largest_share,
        largest_error: found.largest_error,
        largest_pair_mean_error: found.largest_mean_error,
    }))
}

/// Measures all routes on a rig of `modes` modes; `say` receives progress messages.
///
/// # Errors
/// [`BenchError`].
pub fn measure(
    modes: usize,
    plan: &Plan,
    lapack: Option<&mut Lapack>,
    say: &dyn Fn(&str),
) -> Result<(Vec<Route>, Offline), BenchError> {
    let reference = OperatingPoint { normal_load_n: 500.0, disc_speed_rad_s: 13.0, friction_coefficient: 0.0 };
    say("merging points");
    let begun = Instant::now();
    let (seed, model, merging) = squealing(modes, plan, &reference)?;
    let map_s = begun.elapsed().as_secs_f64();
    let points = conditions(plan, &merging, &reference);

    let begun = Instant::now();
    let options = chart_options(plan);
    let chart = chart(&model, plan, &options, say)?;
    let chart_s = begun.elapsed().as_secs_f64();
    let held_out = checked(&model, plan, &options, &chart, say)?;

    let mut routes = Routes {
        plan,
        model: &model,
        chart: &chart,
        lapack,
        traces: Traces::new(&model),
        solver: Solver::new(modes),
        scratch: Scratch::default(),
        summary: Summary::default(),
        bare: vec![],
        charted: vec![],
        samples: Default::default(),
        pairs_compared: 0,
        not_refined: 0,
    };
    let mut choice = Uniform::new(plan.seed.wrapping_add(2000));
    for (done, p) in points.iter().enumerate() {
        if done % 20 == 0 {
            say(&format!("condition {done} of {}", points.len()));
        }
        // First the answers are computed and checked, then the routes are timed.
        let answers = routes.answer(p)?;
        for refined in refined(&model, p, &answers.spectrum, plan, &mut choice)? {
            match refined {
                Some(refined) => routes.compare(&answers, &refined),
                None => routes.not_refined += 1,
            }
        }
        routes.time(p, &answers)?;
    }
    let offline = Offline {
        modes,
        seed,
        merging_points: merging.len(),
        near_merging: (0..points.len()).filter(|&k| is_near_merging(k, &merging)).count(),
        decoupled_modes: model.decoupled_count(),
        map_s,
        chart_s,
        chart_complete: chart.is_complete(),
        chart_solves: chart.solve_count(),
        chart_leaves: chart.leaf_count(),
        chart_bytes: chart.size_bytes(),
        chart_dense_share: chart.dense_share(),
        dense_solves_skipped: routes.samples[Way::ChartValues as usize].time_us.len(),
        conditions: points.len(),
        pairs_compared: routes.pairs_compared,
        not_refined: routes.not_refined,
        held_out,
    };
    let listed = Way::ALL.into_iter().zip(routes.samples);
    Ok((listed.filter_map(|(way, samples)| samples.summary(modes, way.name())).collect(), offline))
}

/// A chart over the whole box of conditions.
fn chart_options(plan: &Plan) -> ChartOptions {
    let corner = |normal_load_n, disc_speed_rad_s, friction_coefficient| OperatingPoint {
        normal_load_n,
        disc_speed_rad_s,
        friction_coefficient,
    };
    let smallest_share = match plan.kind {
        // Low speeds, where roots move most, are few of the conditions.
        Kind::Lateral | Kind::Damped => 1e-8,
        Kind::Undamped | Kind::Hertzian | Kind::Rough | Kind::Opening | Kind::Turning => 1e-4,
    };
    ChartOptions {
        low: corner(50.0, 1.0, 0.0),
        high: corner(2000.0, 60.0, 1.0),
        band_max_hz: Some(plan.band_max_hz),
        tolerance: plan.tolerance,
        smallest_share,
        max_solves: usize::MAX,
        threads: plan.threads,
    }
}

/// Builds the chart, as far as the time limit allows.
fn chart(model: &Model, plan: &Plan, options: &ChartOptions, say: &dyn Fn(&str)) -> Result<Chart, ChartError> {
    let begun = Instant::now();
    let mut so_far = None;
    let mut go_on = |progress: &Progress<'_>| {
        say(&format!("chart {:.0} %", 100.0 * progress.share));
        let in_time = begun.elapsed() < plan.chart_limit;
        if !in_time {
            so_far = Some(progress.chart.clone());
        }
        in_time
    };
    match (resume(model, options, None, &mut go_on), so_far) {
        (Ok(chart), _) | (Err(ChartError::Stopped), Some(chart)) => Ok(chart),
        (Err(error), _) => Err(error),
    }
}

/// Nearest roots whose relative distance is below this are compared as a pair.
const NEARLY_MERGED: f64 = 1e-2;
/// The next root must be this many times as far from such a pair as its roots are from each other: the reference expands about
/// their mean to the seventh order.
const NEXT_ROOT: f64 = 50.0;

/// Refines a few modes of the band to thirty digits, each with the modes it merges with. The nearest pair is among them
/// if it is close to merging. `None` for a cluster whose refinement did not converge.
fn refined(
    model: &Model,
    p: &OperatingPoint,
    spectrum: &Spectrum,
    plan: &Plan,
    choice: &mut Uniform,
) -> Result<Vec<Option<Refined>>, BenchError> {
    let n = model.dimension();
    let (mut stiffness, mut damping) = (Mat::zeros(n, n), Mat::zeros(n, n));
    model.assemble(p, &mut stiffness, &mut damping)?;
    let mut clusters = reference::clusters(spectrum);
    let in_band = |cluster: &Vec<usize>| cluster.iter().any(|&k| spectrum.roots[k].frequency_hz() <= plan.band_max_hz);
    clusters.retain(in_band);
    if clusters.is_empty() {
        return Err(BenchError::NoModes { band_max_hz: plan.band_max_hz });
    }
    let (mut chosen, mut single): (Vec<_>, Vec<_>) = clusters.into_iter().partition(|cluster| cluster.len() > 1);
    let gap = |i: usize, j: usize| {
        let (a, b) = (reference::solved_for(spectrum, single[i][0]), reference::solved_for(spectrum, single[j][0]));
        (a - b).norm() / a.norm()
    };
    let is_apart = |i: usize, j: usize| {
        let pair = [single[i][0], single[j][0]];
        let [a, b] = pair.map(|k| reference::solved_for(spectrum, k));
        let others = (0..spectrum.mode_count).filter(|k| !pair.contains(k));
        let next =
            others.map(|k| (reference::solved_for(spectrum, k) - 0.5 * (a + b)).norm()).fold(f64::INFINITY, f64::min);
        next > NEXT_ROOT * (a - b).norm()
    };
    let pairs = (0..single.len()).flat_map(|j| (0..j).map(move |i| (i, j)));
    let nearest = pairs.min_by(|a, b| gap(a.0, a.1).total_cmp(&gap(b.0, b.1)));
    if let Some((i, j)) = nearest.filter(|&(i, j)| gap(i, j) < NEARLY_MERGED && is_apart(i, j)) {
        let pair = [single.swap_remove(j), single.swap_remove(i)].concat(); // the later one first: the other keeps its place
        chosen.push(pair);
    }
    while chosen.len() < plan.compared && !single.is_empty() {
        let k = (0.5 * (choice.draw() + 1.0) * single.len() as f64) as usize;
        chosen.push(single.swap_remove(k.min(single.len() - 1)));
    }
    let refine = |cluster: &Vec<usize>| reference::refine(stiffness.as_ref(), damping.as_ref(), spectrum, cluster);
    Ok(chosen.iter().map(refine).collect())
}

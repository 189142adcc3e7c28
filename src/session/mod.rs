//! The session: the state from which predictions follow, advanced one event at a time by a pure step.
//!
//! A node and a replay drive the same step. The session reads no clock: time comes from the stamps of its events. A
//! prediction depends only on the rig, the settings and the events so far.

pub mod computed;
pub mod settings;

use std::fmt::Write;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;

use crate::msgs::{self, Header, MAX_MODES, Prediction, Time, level};
use crate::physics::chart::build::ChartOptions;
use crate::physics::chart::{Chart, Scratch};
use crate::physics::{
    ContactState, Ends, MapOptions, Mode, Model, NearestEnd, OperatingPoint, Root, SolveError, Solver, Spectrum,
    StabilityMap, Summary, Traces, Vectors,
};
use crate::rig::Rig;
use crate::text::number::Significant;
use computed::Request;
use settings::{SettingError, Settings};

/// The operating point of an input, as the physics uses it.
pub fn conditions(input: &msgs::OperatingPoint) -> OperatingPoint {
    OperatingPoint {
        normal_load_n: input.normal_load_n,
        disc_speed_rad_s: input.disc_speed_rad_s,
        friction_coefficient: input.friction_coefficient,
    }
}

/// An event that advances a session.
#[derive(Clone, Debug)]
pub enum Event {
    /// An operating point to predict for.
    Input(msgs::OperatingPoint),
    /// A setting changed.
    Parameter { name: String, value: f64 },
    /// No input came for [`Settings::silence_timeout_s`]; `stamp` is the time at which that was detected.
    Silence { stamp: Time },
    /// A stability map was computed: windows and identities at one load and speed.
    MapReady(Arc<StabilityMap>),
    /// The window ends of the map in force were computed at another load and speed.
    EndsReady(Arc<Ends>),
    /// The chart of the rig was built.
    ChartReady(Arc<Chart>),
    /// The rig was built for another temperature.
    RigReady(Arc<Rig>),
}

/// What the caller has to do after a step.
#[derive(Clone, Copy, Debug, Default)]
pub struct Effects<'a> {
    /// The prediction to publish and record, if the step made one.
    pub publish: Option<&'a Prediction>,
    /// What to compute in the background, if later predictions would use it.
    pub request: Option<Request>,
}

/// Number of predictions by route, and the work they avoided.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Counters {
    /// Predictions by a dense solve.
    pub solved: u64,
    /// Predictions read off the chart, each of which replaced a dense solve.
    pub charted: u64,
    pub reused: u64,
    pub faults: u64,
    /// Matrix terms skipped in dense solves because their coefficient is zero.
    pub zero_terms: u64,
    /// Modes excluded from dense solves because no term couples them to others.
    pub decoupled_modes: u64,
    /// Roots beyond the band that charted predictions did not evaluate.
    pub roots_beyond_band: u64,
}

impl Counters {
    /// Predictions that were computed: solved or charted, not reused.
    pub fn worked(&self) -> u64 {
        let Self { solved, charted, reused: _, faults: _, zero_terms: _, decoupled_modes: _, roots_beyond_band: _ } =
            *self;
        solved + charted
    }
}

/// Window ends whose error bound is at most this are not recomputed.
const ENDS_TOLERANCE: f64 = 1e-10;
/// Minimum interval between two requests for window ends, measured in stamps, ns.
const ENDS_EVERY_NS: i64 = 100_000_000;

/// The state of a session.
pub struct Session {
    rig: Arc<Rig>,
    settings: Settings,
    solver: Solver,
    traces: Traces,
    scratch: Scratch,
    charted: Vec<Root>,
    /// Spectra solved in advance for operating points that are expected.
    beforehand: Vec<Spectrum>,
    summary: Summary,
    /// Buffer for selecting the modes to publish.
    order: Vec<usize>,
    chart: Option<Arc<Chart>>,
    map: Option<Arc<StabilityMap>>,
    /// Window ends of the map at a load and speed other than the map's own.
    ends: Option<Arc<Ends>>,
    /// The latest prediction.
    prediction: Prediction,
    /// Operating point of the latest prediction; `None` if that prediction must not be reused.
    last: Option<OperatingPoint>,
    ends_asked: Option<Time>,
    last_stamp: Option<Time>,
    last_seq: u64,
    squealing: bool,
    counters: Counters,
}

/// Options of the stability map that a session of `rig` uses.
pub fn map_options(rig: &Rig) -> MapOptions {
    MapOptions {
        mu_min: 0.0,
        mu_max: rig.mu_max,
        band_max_hz: rig.band_max_hz,
        instability_threshold: rig.instability_threshold,
        windows: true,
    }
}

/// Options of the chart that a session of `rig` uses: friction coefficients from 0 to `mu_max`, loads and speeds as
/// given in the rig.
pub fn chart_options(rig: &Rig) -> ChartOptions {
    let [load_low, load_high] = rig.chart.normal_load_n;
    let [speed_low, speed_high] = rig.chart.disc_speed_rad_s;
    let point = |friction_coefficient, normal_load_n, disc_speed_rad_s| OperatingPoint {
        normal_load_n,
        disc_speed_rad_s,
        friction_coefficient,
    };
    ChartOptions {
        low: point(0.0, load_low, speed_low),
        high: point(rig.mu_max, load_high, speed_high),
        band_max_hz: rig.band_max_hz,
        tolerance: rig.chart.tolerance,
        smallest_share: 1e-4,
        max_solves: max_solves(rig.model.dimension()),
        threads: 1,
    }
}

/// Limit on the dense solves for the chart of a model of `dimension` coordinates. It corresponds to about twenty
/// minutes on one core; large models get at least enough solves to chart one axis.
fn max_solves(dimension: usize) -> usize {
    let size = dimension.max(20) as f64 / 160.0;
    (12_000.0 / size.powi(3)).clamp(2_000.0, 200_000.0) as usize
}

impl Session {
    /// A session without events.
    pub fn new(rig: Arc<Rig>, settings: Settings) -> Self {
        let solver = Solver::new(rig.model.dimension());
        Self {
            traces: Traces::new(&rig.model),
            rig,
            settings,
            solver,
            scratch: Scratch::default(),
            charted: vec![],
            beforehand: vec![],
            summary: Summary::default(),
            order: vec![],
            chart: None,
            map: None,
            ends: None,
            prediction: Prediction::default(),
            last: None,
            ends_asked: None,
            last_stamp: None,
            last_seq: 0,
            squealing: false,
            counters: Counters::default(),
        }
    }

    /// The rig that is predicted for, at its present temperature.
    pub fn rig(&self) -> &Arc<Rig> {
        &self.rig
    }

    /// Whether a rig that follows the temperature should be built for this one, °C: it is outside the dead-band of the
    /// temperature that the rig has.
    pub fn leaves_temperature(&self, celsius: f64) -> bool {
        let outside = |present: f64| (celsius - present).abs() > self.settings.dead_band_temperature_k;
        self.rig.temperature_c().is_some_and(outside)
    }

    /// The settings in force.
    pub fn settings(&self) -> &Settings {
        &self.settings
    }

    /// The counters so far.
    pub fn counters(&self) -> Counters {
        self.counters
    }

    /// The stability map in force.
    pub fn map(&self) -> Option<&Arc<StabilityMap>> {
        self.map.as_ref()
    }

    /// The map in force, if its windows are valid at `point`.
    pub fn map_at(&self, point: &OperatingPoint) -> Option<&Arc<StabilityMap>> {
        let tolerance = self.settings.map_tolerance;
        self.map.as_ref().filter(|map| map_serves(&self.rig.model, map, point, tolerance))
    }

    /// The map in force, if it gives the identities of modes at `point`.
    pub fn numbering_at(&self, point: &OperatingPoint) -> Option<&Arc<StabilityMap>> {
        self.map.as_ref().filter(|map| numbers(&self.rig.model, map, point))
    }

    /// The window ends in force: those computed last, else those of the map.
    pub fn ends(&self) -> Option<&Ends> {
        self.ends.as_deref().or(self.map.as_ref().map(|map| &map.ends))
    }

    /// The latest prediction.
    pub fn prediction(&self) -> &Prediction {
        &self.prediction
    }

    /// The modes of the latest prediction that is not a FAULT: all of the band, ascending in frequency.
    pub fn modes(&self) -> &[Mode] {
        &self.summary.modes
    }

    /// Whether `point` can be predicted without a dense solve: reused or charted. A dense solve is still needed if the
    /// chart fails its check there.
    pub fn answers_at_once(&self, point: &OperatingPoint) -> bool {
        self.reuses(point) || self.usable_chart(point).is_some_and(|chart| chart.covers(point))
    }

    /// Whether a prediction at `point` would have no margin because no stability map is valid there.
    pub fn has_no_map(&self, point: &OperatingPoint) -> bool {
        self.rig.limits.check(point).is_ok()
            && self.rig.model.contact_state(point) == ContactState::Sliding
            && !self.reuses(point)
            && self.map_at(point).is_none()
    }

    /// Replaces the spectra solved in advance. They must contain left and right eigenvectors. Where an input has
    /// exactly one of their operating points, that spectrum is used instead of a new solve; the prediction is the same.
    pub fn hand_in(&mut self, spectra: Vec<Spectrum>) {
        self.beforehand = spectra;
    }

    /// Whether a prediction at `point` would need a dense solve now.
    pub fn would_solve(&self, point: &OperatingPoint) -> bool {
        let at_hand = self.beforehand.iter().any(|spectrum| same(&spectrum.point, point));
        !at_hand && !self.answers_at_once(point) && self.rig.limits.check(point).is_ok()
    }

    /// The operating points among `points` that would need a dense solve if they came in this order.
    pub fn would_solve_among<'a>(&self, points: impl Iterator<Item = &'a OperatingPoint>) -> Vec<OperatingPoint> {
        let mut last = self.last;
        let wanted = points.filter(|point| {
            let reused = last.is_some_and(|last| within_dead_band(&last, point, &self.settings));
            if !reused {
                last = Some(**point);
            }
            !reused && self.would_solve(point)
        });
        wanted.copied().collect()
    }

    /// Advances the session by one event. A charted prediction allocates no memory, except the first of a session.
    ///
    /// # Errors
    /// [`SettingError`] if a parameter is unknown or its value out of range; the session is then unchanged.
    pub fn step(&mut self, event: Event) -> Result<Effects<'_>, SettingError> {
        match event {
            Event::Input(input) => {
                let request = self.input(input);
                return Ok(Effects { publish: Some(&self.prediction), request });
            }
            Event::Silence { stamp } => {
                let timeout_s = self.settings.silence_timeout_s;
                self.fault(
                    Header { stamp, ..Default::default() },
                    self.last_seq,
                    format_args!("stale: no input for {timeout_s} s"),
                );
                return Ok(Effects { publish: Some(&self.prediction), request: None });
            }
            Event::Parameter { name, value } => self.settings.set(&name, value)?,
            Event::MapReady(map) => (self.map, self.ends) = (Some(map), None),
            Event::EndsReady(ends) => self.ends = Some(ends),
            Event::ChartReady(chart) => self.chart = Some(chart),
            Event::RigReady(rig) => self.take_rig(rig),
        }
        // The event may change predictions, so the latest one must not be reused.
        self.last = None;
        Ok(Effects::default())
    }

    /// Replaces the rig by the same rig at another temperature. What was computed for the former is dropped.
    fn take_rig(&mut self, rig: Arc<Rig>) {
        self.solver = Solver::new(rig.model.dimension());
        self.traces = Traces::new(&rig.model);
        self.scratch = Scratch::default();
        self.beforehand.clear();
        (self.chart, self.map, self.ends, self.ends_asked) = (None, None, None, None);
        self.rig = rig;
    }

    /// Predicts for an input; returns what should be computed for later predictions.
    fn input(&mut self, input: msgs::OperatingPoint) -> Option<Request> {
        let point = conditions(&input);
        let (header, seq) = (input.header, input.seq);
        let nanosec = header.stamp.nanosec;
        if nanosec >= 1_000_000_000 {
            self.fault(header, seq, format_args!("stamp has {nanosec} ns within a second, expected less than 1e9"));
            return None;
        }
        let stamp = header.stamp;
        let before = self.last_stamp.replace(stamp);
        self.last_seq = seq;
        if let Some(before) = before.filter(|&before| stamp < before) {
            let back = (before.as_ns() - stamp.as_ns()) as f64 * 1e-9;
            self.fault(header, seq, format_args!("stamp runs backward by {back:.6} s"));
            return None;
        }
        if let Err(reason) = self.rig.limits.check(&point) {
            self.fault(header, seq, format_args!("{reason}"));
            return None;
        }
        if self.reuses(&point) {
            self.counters.reused += 1;
            (self.prediction.header, self.prediction.input_seq, self.prediction.reused) = (header, seq, true);
            return None;
        }
        let tolerance = self.settings.map_tolerance;
        let map = self.map_at(&point).cloned();
        if let Err(reason) = self.predict(header.clone(), seq, point, map.as_deref()) {
            self.fault(header, seq, format_args!("{reason}"));
            return None;
        }
        self.last = Some(point);
        if self.rig.model.contact_state(&point) != ContactState::Sliding {
            return None;
        }
        match map.filter(|map| map_serves(&self.rig.model, map, &point, 0.5 * tolerance)) {
            None => Some(Request::Map(point)),
            Some(map) => self.request_ends(&map, &point, stamp),
        }
    }

    /// Requests new window ends for `point` if those in force were computed elsewhere and are not accurate enough.
    fn request_ends(&mut self, map: &StabilityMap, point: &OperatingPoint, stamp: Time) -> Option<Request> {
        let ends = self.ends.as_deref().unwrap_or(&map.ends);
        let moved = ends.point.with_friction(0.0) != point.with_friction(0.0);
        let lately = self.ends_asked.is_some_and(|asked| stamp.as_ns() - asked.as_ns() < ENDS_EVERY_NS);
        // If the model depends on neither load nor speed, the ends hold everywhere and their bound is rounding error.
        let worst = ends.at(point).flat_map(|(from, to)| std::iter::once(from).chain(to)).map(|end| end.error);
        let exact = worst.fold(0.0, |a: f64, b| if b.is_nan() { b } else { a.max(b) }) <= ENDS_TOLERANCE;
        let (load, speed) = self.rig.model.depends_on_load_and_speed();
        if exact || lately || !moved || !(load || speed) {
            return None;
        }
        self.ends_asked = Some(stamp);
        Some(Request::Ends(*point))
    }

    /// Predicts for `point` by chart or dense solve; `map` is the map valid there. The error is the reason of a FAULT.
    fn predict(
        &mut self,
        header: Header,
        input_seq: u64,
        point: OperatingPoint,
        map: Option<&StabilityMap>,
    ) -> Result<(), String> {
        let charted = self.charted_at(&point);
        if !charted {
            self.solved_at(&point)?;
        }
        let sliding = self.rig.model.contact_state(&point) == ContactState::Sliding;
        let searched = point.friction_coefficient <= self.rig.mu_max;
        let ends = map.filter(|_| sliding && searched).map(|map| self.ends.as_deref().unwrap_or(&map.ends));
        let nearest = ends.and_then(|ends| ends.nearest(&point));
        self.prediction.reason.clear();
        let level = self.judge(nearest.map(|end| end.margin));
        let others = [
            (sliding && !charted && self.chart.is_some()).then_some("not charted here: solved"),
            (sliding && map.is_none()).then_some("margin pending"),
            (sliding && !searched).then_some("friction coefficient beyond mu_max: no margin"),
        ];
        let Self { rig, prediction, summary, order, .. } = self;
        for note in rig.notes(&point).chain(others.into_iter().flatten()) {
            if !prediction.reason.is_empty() {
                prediction.reason.push_str("; ");
            }
            prediction.reason.push_str(note);
        }
        let known = |of: fn(&NearestEnd) -> f64| nearest.as_ref().map_or(f64::NAN, of);
        publish_modes(&summary.modes, order, &mut prediction.modes);
        *prediction = Prediction {
            header,
            input_seq,
            level,
            reused: false,
            unstable_modes: summary.unstable_modes,
            max_growth_rate_per_s: summary.max_growth_rate_per_s.unwrap_or(f64::NAN),
            worst_frequency_hz: summary.worst_frequency_hz.unwrap_or(f64::NAN),
            critical_friction: known(|end| end.mu),
            friction_margin: known(|end| end.margin),
            friction_margin_error: known(|end| end.error),
            // Their memory is used again.
            reason: std::mem::take(&mut prediction.reason),
            modes: std::mem::take(&mut prediction.modes),
        };
        Ok(())
    }

    /// Whether `point` is within the dead-band of the latest prediction.
    fn reuses(&self, point: &OperatingPoint) -> bool {
        self.last.is_some_and(|last| within_dead_band(&last, point, &self.settings))
    }

    /// The chart, if it can be used at `point`. It covers one direction of rotation only.
    fn usable_chart(&self, point: &OperatingPoint) -> Option<&Arc<Chart>> {
        let sliding = self.rig.model.contact_state(point) == ContactState::Sliding;
        self.chart.as_ref().filter(|_| sliding && point.disc_speed_rad_s >= 0.0)
    }

    /// Evaluates the chart at `point` and stores the modes in `summary`. False without a chart, or if the chart has no
    /// answer there.
    fn charted_at(&mut self, point: &OperatingPoint) -> bool {
        let Some(chart) = self.usable_chart(point).cloned() else { return false };
        self.charted.clear();
        let traces = self.traces.at(&self.rig.model, point);
        let (scratch, charted) = (&mut self.scratch, &mut self.charted);
        let Ok(answer) = catch_unwind(AssertUnwindSafe(|| chart.evaluate(point, traces, scratch, charted))) else {
            self.chart = None; // solve from here on; a replay does the same
            return false;
        };
        let Ok(all) = answer else { return false };
        self.counters.charted += 1;
        self.counters.roots_beyond_band += self.rig.model.dimension().saturating_sub(self.charted.len()) as u64;
        let Rig { band_max_hz, instability_threshold, .. } = *self.rig;
        let map = self.numbering_at(point).cloned();
        let mu = point.friction_coefficient;
        self.summary.take_chart(&self.charted, mu, all, map.as_deref(), band_max_hz, instability_threshold);
        true
    }

    /// Solves the eigenvalue problem at `point` and stores the modes in `summary`. The error is the reason of a FAULT.
    fn solved_at(&mut self, point: &OperatingPoint) -> Result<(), String> {
        let at_hand = self.beforehand.iter().position(|spectrum| same(&spectrum.point, point));
        let at_hand = at_hand.map(|k| self.beforehand.swap_remove(k));
        let (rig, solver, summary) = (&self.rig, &mut self.solver, &mut self.summary);
        let map = self.map.as_deref().filter(|map| numbers(&rig.model, map, point));
        let solved = catch_unwind(AssertUnwindSafe(|| -> Result<usize, SolveError> {
            let spectrum = match at_hand {
                Some(spectrum) => spectrum,
                None => solver.solve(&rig.model, point, Vectors::Both)?,
            };
            summary.take_spectrum(&spectrum, map, rig.band_max_hz, rig.instability_threshold);
            Ok(rig.model.zero_terms(point))
        }));
        self.counters.solved += 1;
        self.counters.decoupled_modes += self.rig.model.decoupled_count() as u64;
        match solved {
            Ok(solved) => {
                let zero_terms = solved.map_err(|error| format!("prediction failed: {error}"))?;
                self.counters.zero_terms += zero_terms as u64;
                Ok(())
            }
            Err(_) => {
                self.solver = Solver::new(self.rig.model.dimension());
                Err("prediction failed: internal error in the solver".to_owned())
            }
        }
    }

    /// Returns the level of a prediction and writes why into its reason. If several modes exceed the damping limit, the
    /// reason names the fastest growing one. It also names the limit that applies: the one at which squeal begins or,
    /// if the last prediction was SQUEAL, the one at which squeal ends (hysteresis).
    fn judge(&mut self, friction_margin: Option<f64>) -> u8 {
        let (summary, reason) = (&self.summary, &mut self.prediction.reason);
        let mut because = |text: std::fmt::Arguments<'_>| {
            let _ = reason.write_fmt(text); // writing to a String cannot fail
        };
        let Settings {
            squeal_damping_ratio: begins,
            squeal_hysteresis,
            warn_margin,
            // These affect when a prediction is made, not its level.
            silence_timeout_s: _,
            dead_band_load_n: _,
            dead_band_speed_rad_s: _,
            dead_band_friction: _,
            dead_band_temperature_k: _,
            temperature_timeout_s: _,
            map_tolerance: _,
        } = self.settings;
        let ends = begins + squeal_hysteresis;
        let fastest_below = |limit: f64| {
            let below = summary.modes.iter().filter(|mode| mode.root.damping_ratio() < limit);
            below.max_by(|a, b| a.root.growth_rate_per_s().total_cmp(&b.root.growth_rate_per_s()))
        };
        let begun = fastest_below(begins);
        let held = if self.squealing { fastest_below(ends) } else { None };
        self.squealing = begun.is_some() || held.is_some() || summary.diverges();
        if let Some(mode) = begun.or(held) {
            let ratio = Significant(mode.root.damping_ratio(), 3);
            because(format_args!(
                "mode {} at {} Hz: damping ratio {ratio}",
                mode.id,
                Significant(mode.root.frequency_hz(), 5)
            ));
            match begun {
                Some(_) => because(format_args!(" below {begins}")),
                None => because(format_args!(", squeal ends at {}", Significant(ends, 3))),
            }
            return level::SQUEAL;
        }
        if summary.diverges() {
            because(format_args!("static divergence"));
            return level::SQUEAL;
        }
        match friction_margin.filter(|&margin| margin < warn_margin) {
            Some(margin) => {
                because(format_args!("friction margin {} below {warn_margin}", Significant(margin, 3)));
                level::WARN
            }
            None => level::OK,
        }
    }

    /// Replaces the latest prediction by a FAULT with this reason.
    fn fault(&mut self, header: Header, input_seq: u64, reason: std::fmt::Arguments<'_>) {
        self.counters.faults += 1;
        self.last = None;
        self.prediction = Prediction {
            header,
            input_seq,
            level: level::FAULT,
            reused: false,
            unstable_modes: 0,
            max_growth_rate_per_s: f64::NAN,
            worst_frequency_hz: f64::NAN,
            critical_friction: f64::NAN,
            friction_margin: f64::NAN,
            friction_margin_error: f64::NAN,
            reason: reason.to_string(),
            modes: vec![],
        };
    }
}

/// Whether the windows and identities of `map` are valid at `point`. The contact must slide in the same direction as on
/// the map. The load and the speed must be within the relative `tolerance` of the map's, each only if the model depends
/// on it.
pub fn map_serves(model: &Model, map: &StabilityMap, point: &OperatingPoint, tolerance: f64) -> bool {
    let (load, speed) = model.depends_on_load_and_speed();
    let near = |a: f64, b: f64| (a - b).abs() <= tolerance * b.abs();
    model.contact_state(point) == ContactState::Sliding
        && point.disc_speed_rad_s.signum() == map.point.disc_speed_rad_s.signum()
        && (!load || near(point.normal_load_n, map.point.normal_load_n))
        && (!speed || near(point.disc_speed_rad_s, map.point.disc_speed_rad_s))
}

/// Whether `map` gives the identities of modes at `point`: the contact must slide in the same direction as on the map.
/// Load and speed may differ. If modes cross in between, their identities may then differ from those of the next map.
pub fn numbers(model: &Model, map: &StabilityMap, point: &OperatingPoint) -> bool {
    model.contact_state(point) == ContactState::Sliding
        && point.disc_speed_rad_s.signum() == map.point.disc_speed_rad_s.signum()
}

fn within_dead_band(from: &OperatingPoint, to: &OperatingPoint, settings: &Settings) -> bool {
    (from.normal_load_n - to.normal_load_n).abs() <= settings.dead_band_load_n
        && (from.disc_speed_rad_s - to.disc_speed_rad_s).abs() <= settings.dead_band_speed_rad_s
        && (from.friction_coefficient - to.friction_coefficient).abs() <= settings.dead_band_friction
}

/// Whether two operating points are equal bit by bit.
fn same(a: &OperatingPoint, b: &OperatingPoint) -> bool {
    let bits = |p: &OperatingPoint| [p.normal_load_n, p.disc_speed_rad_s, p.friction_coefficient].map(f64::to_bits);
    bits(a) == bits(b)
}

/// Copies the modes to publish to `out`, in ascending frequency. Of more than [`MAX_MODES`], those with the largest
/// growth rates are kept. `order` is a buffer for sorting.
fn publish_modes(modes: &[Mode], order: &mut Vec<usize>, out: &mut Vec<msgs::Mode>) {
    order.clear();
    order.extend(0..modes.len());
    if modes.len() > MAX_MODES {
        let growth = |k: &usize| modes[*k].root.lambda.re;
        order.sort_unstable_by(|a, b| growth(b).total_cmp(&growth(a)).then(a.cmp(b)));
        order.truncate(MAX_MODES);
        order.sort_unstable(); // modes are in ascending frequency
    }
    out.clear();
    out.extend(order.iter().map(|&k| {
        let Mode { id, root } = modes[k];
        msgs::Mode {
            id,
            frequency_hz: root.frequency_hz(),
            growth_rate_per_s: root.growth_rate_per_s(),
            damping_ratio: root.damping_ratio(),
            pad_participation: root.pad_participation,
            residual: root.residual,
            frequency_error_hz: root.error.omega / std::f64::consts::TAU,
            growth_rate_error_per_s: root.error.sigma,
        }
    }));
}

#[cfg(test)]
mod tests;

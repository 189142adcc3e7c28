//! The session: a pure step from events to effects.
//!
//! Live and replay drive the same step. It knows no clock: time comes from the stamps of its events. A prediction is a
//! function of the rig, the settings and the events so far, and of nothing else.

use std::fmt::Write;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;

use crate::physics::chart::build::ChartOptions;
use crate::physics::chart::{Chart, Scratch};
use crate::physics::{
    ContactState, Ends, MapOptions, Mode, Model, OperatingPoint, SolveError, Solver, Spectrum, StabilityMap, Summary,
    Traces, Vectors,
};
use crate::rig::Rig;
use crate::settings::{SettingError, Settings};
use crate::wire::{self, Header, MAX_MODES, Prediction, Time, level};

/// Something that happened.
#[derive(Clone, Debug)]
pub enum Event {
    /// Conditions to predict for.
    Input(wire::OperatingPoint),
    /// A setting was changed.
    Parameter { name: String, value: f64 },
    /// Nothing was heard for [`Settings::silence_timeout_s`]; the stamp is when that was noticed.
    Silence { stamp: Time },
    /// Windows and identities for a load and speed became ready.
    MapReady(Arc<StabilityMap>),
    /// The ends of the windows of the map in force, for another load and speed, became ready.
    EndsReady(Arc<Ends>),
    /// A chart of the roots became ready.
    ChartReady(Arc<Chart>),
}

/// What a step leads to.
#[derive(Clone, Copy, Debug, Default)]
pub struct Effects<'a> {
    /// Publish (and record) this prediction.
    pub publish: Option<&'a Prediction>,
    /// This would be used, if somebody computed it.
    pub want: Option<Want>,
}

/// What a session would use.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Want {
    /// A stability map for a load and speed.
    Map(OperatingPoint),
    /// The ends of the windows of the map in force, for a load and speed.
    Ends(OperatingPoint),
}

/// How many predictions were made and how many were saved.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Counters {
    /// Dense solves.
    pub solved: u64,
    /// Predictions read off the chart: dense solves saved.
    pub charted: u64,
    pub reused: u64,
    pub faults: u64,
    /// Matrices that were not added in dense solves, their coefficients being zero.
    pub zero_terms: u64,
    /// Modes that nothing couples, which dense solves did without.
    pub decoupled_modes: u64,
    /// Roots beyond the band that predictions off the chart did without.
    pub roots_beyond_band: u64,
}

impl Counters {
    /// Predictions that took work: all but those reused.
    pub fn worked(&self) -> u64 {
        self.solved + self.charted
    }
}

/// Exact enough: what is better known is not asked for again.
const ENDS_TOLERANCE: f64 = 1e-10;
/// Ends of windows are asked for at most this often, in the time of the stamps, ns.
const ENDS_EVERY_NS: i64 = 100_000_000;

/// The state of a session.
pub struct Session {
    rig: Arc<Rig>,
    settings: Settings,
    solver: Solver,
    traces: Traces,
    scratch: Scratch,
    charted: Vec<Mode>,
    /// Spectra that were worked out beforehand.
    beforehand: Vec<Spectrum>,
    summary: Summary,
    /// Room for the choice of the modes to publish.
    order: Vec<usize>,
    chart: Option<Arc<Chart>>,
    map: Option<Arc<StabilityMap>>,
    /// The ends of the map's windows elsewhere than the map.
    ends: Option<Arc<Ends>>,
    /// The latest prediction.
    prediction: Prediction,
    /// The conditions it was worked out for, if it may be reused.
    last: Option<OperatingPoint>,
    ends_asked: Option<Time>,
    last_stamp: Option<Time>,
    last_seq: u64,
    squealing: bool,
    counters: Counters,
}

/// What the node maps for a rig.
pub fn map_options(rig: &Rig) -> MapOptions {
    MapOptions {
        mu_min: 0.0,
        mu_max: rig.mu_max,
        band_max_hz: rig.band_max_hz,
        instability_threshold: rig.instability_threshold,
        windows: true,
    }
}

/// What the node charts for a rig: the whole searched range of friction coefficients, loads and speeds as the rig says.
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

/// Dense solves that the chart of a model of `dimension` coordinates may take: twenty minutes of one core, but for
/// large models enough for one axis.
fn max_solves(dimension: usize) -> usize {
    let size = dimension.max(20) as f64 / 160.0;
    (12_000.0 / size.powi(3)).clamp(2_000.0, 200_000.0) as usize
}

impl Session {
    /// A session that has heard nothing yet.
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

    /// The settings in force.
    pub fn settings(&self) -> &Settings {
        &self.settings
    }

    /// What was done and what was saved so far.
    pub fn counters(&self) -> Counters {
        self.counters
    }

    /// The stability map in force.
    pub fn map(&self) -> Option<&Arc<StabilityMap>> {
        self.map.as_ref()
    }

    /// The map that holds at `point`.
    pub fn map_at(&self, point: &OperatingPoint) -> Option<&Arc<StabilityMap>> {
        let tolerance = self.settings.map_tolerance;
        self.map.as_ref().filter(|map| map_serves(&self.rig.model, map, point, tolerance))
    }

    /// The ends of the map's windows in force.
    pub fn ends(&self) -> Option<&Ends> {
        self.ends.as_deref().or(self.map.as_ref().map(|map| &map.ends))
    }

    /// The latest prediction.
    pub fn prediction(&self) -> &Prediction {
        &self.prediction
    }

    /// Whether the prediction for `point` takes no dense solve, unless the chart's own check fails there.
    pub fn answers_at_once(&self, point: &OperatingPoint) -> bool {
        self.reuses(point) || self.usable_chart(point).is_some_and(|chart| chart.covers(point))
    }

    /// Whether the prediction for `point`, if it came next, would have no margin for want of a stability map.
    pub fn lacks_map(&self, point: &OperatingPoint) -> bool {
        self.rig.limits.check(point).is_ok()
            && self.rig.model.contact_state(point) == ContactState::Sliding
            && !self.reuses(point)
            && self.map_at(point).is_none()
    }

    /// Takes spectra of conditions that it may come to, solved with both vectors; those of before are dropped. Where it comes to
    /// them it does not solve again: what it predicts is the same.
    pub fn hand_in(&mut self, spectra: Vec<Spectrum>) {
        self.beforehand = spectra;
    }

    /// Whether the prediction for `point`, if it came next, would be solved.
    pub fn would_solve(&self, point: &OperatingPoint) -> bool {
        let at_hand = self.beforehand.iter().any(|spectrum| same(&spectrum.point, point));
        !at_hand && !self.answers_at_once(point) && self.rig.limits.check(point).is_ok()
    }

    /// Which of `points` would be solved if they came one after another.
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

    /// One step. After the first of its kind a step allocates nothing on the chart's route.
    ///
    /// # Errors
    /// [`SettingError`] for a parameter that is unknown or out of range; nothing has changed then.
    pub fn step(&mut self, event: Event) -> Result<Effects<'_>, SettingError> {
        match event {
            Event::Input(input) => {
                let want = self.input(input);
                return Ok(Effects { publish: Some(&self.prediction), want });
            }
            Event::Silence { stamp } => {
                let timeout_s = self.settings.silence_timeout_s;
                self.fault(
                    Header { stamp, ..Default::default() },
                    self.last_seq,
                    format_args!("stale: no input for {timeout_s} s"),
                );
                return Ok(Effects { publish: Some(&self.prediction), want: None });
            }
            Event::Parameter { name, value } => self.settings.set(&name, value)?,
            Event::MapReady(map) => (self.map, self.ends) = (Some(map), None),
            Event::EndsReady(ends) => self.ends = Some(ends),
            Event::ChartReady(chart) => self.chart = Some(chart),
        }
        // What was predicted before may come out otherwise now.
        self.last = None;
        Ok(Effects::default())
    }

    /// Makes the prediction for an input, and says what would make the next ones better.
    fn input(&mut self, input: wire::OperatingPoint) -> Option<Want> {
        let point = input.point();
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
            None => Some(Want::Map(point)),
            Some(map) => self.want_ends(&map, &point, stamp),
        }
    }

    /// Whether better ends than those in force are to be had at `point`.
    fn want_ends(&mut self, map: &StabilityMap, point: &OperatingPoint, stamp: Time) -> Option<Want> {
        let ends = self.ends.as_deref().unwrap_or(&map.ends);
        let moved = ends.point.with_friction(0.0) != point.with_friction(0.0);
        let lately = self.ends_asked.is_some_and(|asked| stamp.as_ns() - asked.as_ns() < ENDS_EVERY_NS);
        // Of a rig that knows neither load nor speed the bound is that of rounding anywhere.
        let worst = ends.at(point).flat_map(|(from, to)| std::iter::once(from).chain(to)).map(|end| end.error);
        let exact = worst.fold(0.0, |a: f64, b| if b.is_nan() { b } else { a.max(b) }) <= ENDS_TOLERANCE;
        let (load, speed) = self.rig.model.depends_on_load_and_speed();
        if exact || lately || !moved || !(load || speed) {
            return None;
        }
        self.ends_asked = Some(stamp);
        Some(Want::Ends(*point))
    }

    /// Solves for `point`; the error is the reason of a FAULT.
    fn predict(
        &mut self,
        header: Header,
        input_seq: u64,
        point: OperatingPoint,
        map: Option<&StabilityMap>,
    ) -> Result<(), String> {
        let charted = self.charted_at(&point);
        if !charted {
            self.solved_at(&point, map)?;
        }
        let sliding = self.rig.model.contact_state(&point) == ContactState::Sliding;
        let searched = point.friction_coefficient <= self.rig.mu_max;
        let ends = map.filter(|_| sliding).map(|map| self.ends.as_deref().unwrap_or(&map.ends));
        let critical = ends.and_then(|ends| ends.critical_friction(&point));
        let margin = ends.filter(|_| searched).and_then(|ends| ends.margin(&point));
        self.prediction.reason.clear();
        let level = self.judge(margin.map(|margin| margin.value));
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
        prediction.friction_margin_error = match (critical, margin) {
            // An unknown bound is not hidden by a known one.
            (Some(a), Some(b)) if a.error <= b.error || b.error.is_nan() => b.error,
            (Some(only), _) | (None, Some(only)) => only.error,
            (None, None) => f64::NAN,
        };
        prediction.header = header;
        prediction.input_seq = input_seq;
        prediction.level = level;
        prediction.reused = false;
        prediction.unstable_modes = summary.unstable_modes;
        prediction.max_growth_rate_per_s = summary.max_growth_rate_per_s.unwrap_or(f64::NAN);
        prediction.worst_frequency_hz = summary.worst_frequency_hz.unwrap_or(f64::NAN);
        prediction.critical_friction = critical.map_or(f64::NAN, |critical| critical.value);
        prediction.friction_margin = margin.map_or(f64::NAN, |margin| margin.value);
        publish_modes(&summary.modes, order, &mut prediction.modes);
        Ok(())
    }

    /// Whether `point` is within the dead-band of the latest prediction.
    fn reuses(&self, point: &OperatingPoint) -> bool {
        self.last.is_some_and(|last| within_dead_band(&last, point, &self.settings))
    }

    /// The chart, where it may be asked: it holds one direction of rotation.
    fn usable_chart(&self, point: &OperatingPoint) -> Option<&Arc<Chart>> {
        let sliding = self.rig.model.contact_state(point) == ContactState::Sliding;
        self.chart.as_ref().filter(|_| sliding && point.disc_speed_rad_s >= 0.0)
    }

    /// Takes what the chart says at `point`; false where there is none, or where it does not answer.
    fn charted_at(&mut self, point: &OperatingPoint) -> bool {
        let Some(chart) = self.usable_chart(point).cloned() else { return false };
        self.charted.clear();
        let traces = self.traces.at(&self.rig.model, point);
        let (scratch, charted) = (&mut self.scratch, &mut self.charted);
        let Ok(answer) = catch_unwind(AssertUnwindSafe(|| chart.evaluate(point, traces, scratch, charted))) else {
            self.chart = None; // solved from here on, in a replay as well
            return false;
        };
        if answer.is_err() {
            return false;
        }
        self.counters.charted += 1;
        self.counters.roots_beyond_band += self.rig.model.dimension().saturating_sub(self.charted.len()) as u64;
        self.summary.take_chart(&self.charted, self.rig.band_max_hz, self.rig.instability_threshold);
        true
    }

    /// Takes a dense solve at `point`; the error is the reason of a FAULT.
    fn solved_at(&mut self, point: &OperatingPoint, map: Option<&StabilityMap>) -> Result<(), String> {
        let at_hand = self.beforehand.iter().position(|spectrum| same(&spectrum.point, point));
        let at_hand = at_hand.map(|k| self.beforehand.swap_remove(k));
        let (rig, solver, summary) = (&self.rig, &mut self.solver, &mut self.summary);
        let solved = catch_unwind(AssertUnwindSafe(|| -> Result<(), SolveError> {
            let spectrum = match at_hand {
                Some(spectrum) => spectrum,
                None => solver.solve(&rig.model, point, Vectors::Both)?,
            };
            let ids = match map {
                Some(map) => map.identify(&spectrum),
                None => vec![], // in the order of the spectrum
            };
            summary.take_spectrum(&spectrum, &ids, rig.band_max_hz, rig.instability_threshold);
            Ok(())
        }));
        self.counters.solved += 1;
        self.counters.zero_terms += self.rig.model.zero_terms(point) as u64;
        self.counters.decoupled_modes += self.rig.model.decoupled_count() as u64;
        match solved {
            Ok(solved) => solved.map_err(|error| format!("prediction failed: {error}")),
            Err(_) => {
                self.solver = Solver::new(self.rig.model.dimension());
                Err("prediction failed: internal error in the solver".to_owned())
            }
        }
    }

    /// The level of a prediction; why goes into its reason.
    fn judge(&mut self, friction_margin: Option<f64>) -> u8 {
        let (summary, reason) = (&self.summary, &mut self.prediction.reason);
        let mut because = |text: std::fmt::Arguments<'_>| {
            let _ = reason.write_fmt(text); // a String takes everything
        };
        let ratio = |mode: &Mode| mode.root.damping_ratio();
        let worst = summary.modes.iter().min_by(|a, b| ratio(a).total_cmp(&ratio(b)));
        let Settings { squeal_damping_ratio, squeal_hysteresis, warn_margin, .. } = self.settings;
        let limit = squeal_damping_ratio + if self.squealing { squeal_hysteresis } else { 0.0 };
        let grows = worst.filter(|mode| ratio(mode) < limit);
        self.squealing = grows.is_some() || summary.diverges();
        if let Some(mode) = grows {
            let (id, hz, ratio) = (mode.id, mode.root.frequency_hz(), ratio(mode));
            because(format_args!("mode {id} at {hz:.6} Hz: damping ratio {ratio:.6} below {limit}"));
            return level::SQUEAL;
        }
        if summary.diverges() {
            because(format_args!("static divergence"));
            return level::SQUEAL;
        }
        match friction_margin.filter(|&margin| margin < warn_margin) {
            Some(margin) => {
                because(format_args!("friction margin {margin:.6} below {warn_margin}"));
                level::WARN
            }
            None => level::OK,
        }
    }

    /// Makes the prediction a FAULT.
    fn fault(&mut self, header: Header, input_seq: u64, reason: std::fmt::Arguments<'_>) {
        self.counters.faults += 1;
        self.last = None;
        self.prediction = Prediction {
            header,
            input_seq,
            level: level::FAULT,
            reason: reason.to_string(),
            max_growth_rate_per_s: f64::NAN,
            worst_frequency_hz: f64::NAN,
            critical_friction: f64::NAN,
            friction_margin: f64::NAN,
            friction_margin_error: f64::NAN,
            ..Default::default()
        };
    }
}

/// Whether a map's windows and identities hold at `point`: same way of sliding, and load and speed, where the model
/// depends on them, within `tolerance` of where it was computed.
pub fn map_serves(model: &Model, map: &StabilityMap, point: &OperatingPoint, tolerance: f64) -> bool {
    let (load, speed) = model.depends_on_load_and_speed();
    let near = |a: f64, b: f64| (a - b).abs() <= tolerance * b.abs();
    model.contact_state(point) == ContactState::Sliding
        && point.disc_speed_rad_s.signum() == map.point.disc_speed_rad_s.signum()
        && (!load || near(point.normal_load_n, map.point.normal_load_n))
        && (!speed || near(point.disc_speed_rad_s, map.point.disc_speed_rad_s))
}

fn within_dead_band(from: &OperatingPoint, to: &OperatingPoint, settings: &Settings) -> bool {
    (from.normal_load_n - to.normal_load_n).abs() <= settings.dead_band_load_n
        && (from.disc_speed_rad_s - to.disc_speed_rad_s).abs() <= settings.dead_band_speed_rad_s
        && (from.friction_coefficient - to.friction_coefficient).abs() <= settings.dead_band_friction
}

/// Whether two points are the same to the last bit.
fn same(a: &OperatingPoint, b: &OperatingPoint) -> bool {
    let bits = |p: &OperatingPoint| [p.normal_load_n, p.disc_speed_rad_s, p.friction_coefficient].map(f64::to_bits);
    bits(a) == bits(b)
}

/// The modes as published: ascending frequency, and above [`MAX_MODES`] those with the largest growth rates. `order` is
/// room for sorting.
fn publish_modes(modes: &[Mode], order: &mut Vec<usize>, out: &mut Vec<wire::Mode>) {
    order.clear();
    order.extend(0..modes.len());
    if modes.len() > MAX_MODES {
        let growth = |k: &usize| modes[*k].root.lambda.re;
        order.sort_unstable_by(|a, b| growth(b).total_cmp(&growth(a)).then(a.cmp(b)));
        order.truncate(MAX_MODES);
        order.sort_unstable(); // they ascend in frequency
    }
    out.clear();
    out.extend(order.iter().map(|&k| {
        let Mode { id, root } = modes[k];
        wire::Mode {
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
mod tests {
    use super::*;

    /// Case 2 of the paper's 9-degree-of-freedom model: unstable from 0.35592805826058 on.
    fn session() -> Session {
        let rig = Arc::new(Rig::load("nine-dof-case-2").expect("an embedded rig"));
        let settings = Settings::for_rig(&rig);
        Session::new(rig, settings)
    }

    fn conditions(seq: u64, load: f64, speed: f64, mu: f64) -> Event {
        Event::Input(wire::OperatingPoint {
            header: Header { stamp: Time::from_ns(1_000_000_000 + 1_000_000 * seq as i64), ..Default::default() },
            seq,
            normal_load_n: load,
            disc_speed_rad_s: speed,
            friction_coefficient: mu,
        })
    }

    fn friction(seq: u64, mu: f64) -> Event {
        conditions(seq, 500.0, 13.0, mu)
    }

    fn predict(session: &mut Session, event: Event) -> Prediction {
        let effects = session.step(event).expect("no setting is changed");
        effects.publish.expect("every input is answered").clone()
    }

    fn with_map(mut session: Session) -> Session {
        let point = session.rig.reference;
        let map = StabilityMap::build(&session.rig.model, &mut session.solver, &point, &map_options(&session.rig));
        session.step(Event::MapReady(Arc::new(map.expect("the rig can be mapped")))).unwrap();
        session
    }

    #[test]
    fn margin_is_pending_until_the_map_is_there() {
        let mut session = session();
        let effects = session.step(friction(0, 0.3)).unwrap();
        assert!(matches!(effects.want, Some(Want::Map(_))));
        let pending = predict(&mut session, friction(1, 0.31));
        assert!(pending.friction_margin.is_nan() && pending.reason == "margin pending");
        let mut session = with_map(session);
        let effects = session.step(friction(2, 0.3)).unwrap();
        assert_eq!(effects.want, None, "the rig knows no load or speed");
        let ready = predict(&mut session, friction(3, 0.2));
        assert!((ready.friction_margin - (0.35592805826058 - 0.2)).abs() < 1e-10 && ready.reason.is_empty());
        assert!((ready.critical_friction - 0.35592805826058).abs() < 1e-10);
    }

    #[test]
    fn levels_follow_margin_and_damping_ratio_with_hysteresis() {
        let mut session = with_map(session());
        let mut level_at = |seq, mu| predict(&mut session, friction(seq, mu)).level;
        assert_eq!(level_at(0, 0.30), level::OK);
        assert_eq!(level_at(1, 0.32), level::WARN, "margin 0.036 is below 0.05");
        assert_eq!(level_at(2, 0.40), level::SQUEAL);
        // Near the merging point ζ = -√(c (μ - μc)): between -1e-3 and -5e-4 it depends on where one comes from.
        let mut fresh = self::session();
        let between = (0..40_000).map(|k| (k, 0.355928 + 1e-8 * k as f64)).find(|&(k, mu)| {
            let worst = |p: Prediction| p.modes.iter().map(|mode| mode.damping_ratio).fold(f64::INFINITY, f64::min);
            (-0.9e-3..-0.6e-3).contains(&worst(predict(&mut fresh, friction(k, mu))))
        });
        let (_, mu) = between.expect("growth rates are continuous");
        assert_eq!(level_at(3, mu), level::SQUEAL, "coming from above");
        assert_eq!(level_at(4, 0.2), level::OK);
        assert_eq!(level_at(5, mu), level::WARN, "coming from below");
    }

    #[test]
    fn bad_and_stale_inputs_are_faults_without_modes() {
        let mut session = session();
        predict(&mut session, friction(10, 0.3));
        let cases = [
            (conditions(11, f64::NAN, 13.0, 0.3), "normal_load_n is NaN"),
            (conditions(12, 500.0, f64::INFINITY, 0.3), "disc_speed_rad_s is inf"),
            (conditions(13, 2e6, 13.0, 0.3), "normal_load_n is 2000000, expected 0 to 1000000"),
            (conditions(14, 500.0, 13.0, 2.5), "friction_coefficient is 2.5, expected 0 to 2"),
            (friction(5, 0.3), "stamp runs backward by 0.009000 s"),
            (Event::Silence { stamp: Time::from_ns(5_000_000_000) }, "stale: no input for 1 s"),
        ];
        for (event, reason) in cases {
            let fault = predict(&mut session, event);
            assert_eq!(fault.level, level::FAULT);
            assert!(fault.reason.contains(reason), "`{}` lacks `{reason}`", fault.reason);
            assert!(fault.modes.is_empty() && fault.friction_margin.is_nan() && !fault.reused);
        }
        assert_eq!(predict(&mut session, friction(15, 0.3)).level, level::OK, "the next good input is predicted");
    }

    #[test]
    fn conditions_within_the_dead_band_reuse_the_previous_prediction() {
        let mut session = with_map(session());
        let first = predict(&mut session, friction(0, 0.3));
        let second = predict(&mut session, friction(1, 0.3));
        assert!(!first.reused && second.reused);
        assert_eq!(second.input_seq, 1);
        // As text, for NaN is not equal to itself.
        assert_eq!(format!("{:?}", second.modes), format!("{:?}", first.modes));
        assert!(!predict(&mut session, friction(2, 0.3001)).reused, "the default dead-band is exact equality");
        session.step(Event::Parameter { name: "dead_band_friction".to_owned(), value: 0.01 }).unwrap();
        assert!(!predict(&mut session, friction(3, 0.3)).reused, "a changed setting is no reason to reuse");
        assert!(predict(&mut session, friction(4, 0.309)).reused);
        assert!(
            !predict(&mut session, friction(5, 0.311)).reused,
            "measured from what was solved, not from what was reused"
        );
        let counters = session.counters();
        assert_eq!((counters.solved, counters.charted, counters.reused, counters.faults), (4, 0, 2, 0));
    }

    /// A rig whose contact stiffens with load: between two loads for which the ends of its windows were worked out, the
    /// margin is off by no more than its bound; where they were, it is exact.
    #[test]
    fn the_margin_follows_the_load_and_is_exact_where_it_rests() {
        use crate::physics::synthetic::{Synthetic, rig};
        let law = crate::physics::ContactLaw { exponent: 0.4, ..Default::default() };
        let model = rig(&Synthetic { modes: 24, pairs: 12, damping_ratio: 0.0, contact_law: law, seed: 1 }).unwrap();
        let like = Rig::load("nine-dof-case-2").expect("embedded");
        let rig = Arc::new(Rig { model, band_max_hz: None, mu_max: 2.0, ..like });
        let session = Session::new(rig.clone(), Settings::for_rig(&rig));
        let mut session = with_map(session);
        let mut solver = Solver::new(rig.model.dimension());
        let mut exact_at = |load: f64| {
            let point = OperatingPoint { normal_load_n: load, ..rig.reference };
            StabilityMap::build(&rig.model, &mut solver, &point, &map_options(&rig)).unwrap().windows[0].mu_from
        };
        let (mut seq, mut largest) = (0, 0.0f64);
        for load in [498.0, 501.0, 502.0] {
            let truth = exact_at(load);
            let mut asked = None;
            for _ in 0..300 {
                seq += 1;
                // The friction coefficient moves a little: nothing is reused.
                let input = conditions(seq, load, 13.0, 1e-4 * (seq % 10) as f64);
                let effects = session.step(input).unwrap();
                let prediction = effects.publish.unwrap();
                let off = (prediction.critical_friction - truth).abs();
                assert!(off <= prediction.friction_margin_error + 1e-12, "{load} N: {off} {prediction:?}");
                if let Some(Want::Ends(point)) = effects.want {
                    largest = largest.max(off);
                    assert!(asked.replace(point).is_none(), "{load} N: asked for once");
                    let map = session.map().cloned().unwrap();
                    let ends = Ends::carried(&rig.model, &mut session.solver, &map, &point).unwrap().unwrap();
                    session.step(Event::EndsReady(Arc::new(ends))).unwrap();
                }
            }
            assert!(asked.is_some(), "{load} N");
            let rests = predict(&mut session, conditions(seq + 1, load, 13.0, 1e-3));
            assert!(
                (rests.critical_friction - truth).abs() < 1e-10 && rests.friction_margin_error < 1e-10,
                "{rests:?}"
            );
            seq += 1;
        }
        assert!(largest > 1e-10, "worth testing: extrapolation is off by {largest}");
    }

    /// The same conditions read off the chart and solved: same identities, same level, every value within the bounds.
    #[test]
    fn a_chart_predicts_what_a_solve_does() {
        let (mut solved, mut charted) = (with_map(session()), with_map(session()));
        let chart = crate::physics::chart::build::build(&charted.rig.model, &chart_options(&charted.rig), &|_| true);
        charted.step(Event::ChartReady(Arc::new(chart.expect("the rig can be charted")))).unwrap();
        for seq in 0..400 {
            let mu = 0.005 * seq as f64 + 1e-4;
            let (a, b) = (predict(&mut solved, friction(seq, mu)), predict(&mut charted, friction(seq, mu)));
            assert_eq!((a.level, a.unstable_modes, a.modes.len()), (b.level, b.unstable_modes, b.modes.len()), "{mu}");
            for (a, b) in a.modes.iter().zip(&b.modes) {
                assert_eq!(a.id, b.id, "{mu}");
                let frequency = (a.frequency_hz - b.frequency_hz).abs();
                assert!(frequency <= a.frequency_error_hz + b.frequency_error_hz, "{mu}: {a:?} {b:?}");
                let growth = (a.growth_rate_per_s - b.growth_rate_per_s).abs();
                assert!(growth <= a.growth_rate_error_per_s + b.growth_rate_error_per_s, "{mu}: {a:?} {b:?}");
                assert!(b.frequency_error_hz < 1e-6 * b.frequency_hz, "a bound that says something: {b:?}");
            }
        }
        assert_eq!((charted.counters().charted, charted.counters().solved), (400, 0));
        let backwards = predict(&mut charted, conditions(1000, 500.0, -13.0, 0.3));
        assert!(charted.counters().solved == 1 && backwards.modes.len() == 9, "the other direction is solved");
        assert!(backwards.reason.contains("not charted here: solved"), "{}", backwards.reason);
    }

    #[test]
    fn settings_are_validated() {
        let mut session = session();
        let set = |session: &mut Session, name: &str, value| {
            session.step(Event::Parameter { name: name.to_owned(), value }).map(drop).map_err(|e| e.to_string())
        };
        assert!(set(&mut session, "warn_margin", f64::NAN).unwrap_err().contains("`warn_margin` = NaN: expected"));
        assert!(set(&mut session, "dead_band_load_n", -1.0).unwrap_err().contains("0 to 1000000"));
        assert!(
            set(&mut session, "volume", 11.0).unwrap_err().contains("no parameter `volume`; there are warn_margin")
        );
        assert_eq!(session.settings().warn_margin, 0.05, "nothing was changed");
        assert_eq!(set(&mut session, "warn_margin", 0.1), Ok(()));
    }

    #[test]
    fn a_contact_that_does_not_slide_is_said_to() {
        let mut session = with_map(session());
        let still = predict(&mut session, conditions(0, 500.0, 0.005, 1.0));
        assert_eq!((still.level, still.unstable_modes), (level::OK, 0));
        assert!(still.reason.contains("not sliding") && still.friction_margin.is_nan());
        let open = predict(&mut session, conditions(1, 0.0, 13.0, 1.0));
        assert!(open.reason.contains("contact open") && open.unstable_modes == 0);
    }
}

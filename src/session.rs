//! The session: a pure step from events to effects.
//!
//! Live and replay drive the same step. It knows no clock: time comes from the stamps of its events. A prediction is a
//! function of the rig, the settings and the events so far, and of nothing else.

use std::fmt::Write;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;

use crate::number::Significant;
use crate::physics::chart::build::ChartOptions;
use crate::physics::chart::{Chart, Scratch};
use crate::physics::{
    ContactState, Ends, MapOptions, Mode, Model, NearestEnd, OperatingPoint, Root, SolveError, Solver, Spectrum,
    StabilityMap, Summary, Traces, Vectors,
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
    charted: Vec<Root>,
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

    /// The map whose windows hold at `point`.
    pub fn map_at(&self, point: &OperatingPoint) -> Option<&Arc<StabilityMap>> {
        let tolerance = self.settings.map_tolerance;
        self.map.as_ref().filter(|map| map_serves(&self.rig.model, map, point, tolerance))
    }

    /// The map that numbers modes at `point`.
    pub fn numbering_at(&self, point: &OperatingPoint) -> Option<&Arc<StabilityMap>> {
        self.map.as_ref().filter(|map| numbers(&self.rig.model, map, point))
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
        prediction.critical_friction = known(|end| end.mu);
        prediction.friction_margin = known(|end| end.margin);
        prediction.friction_margin_error = known(|end| end.error);
        prediction.header = header;
        prediction.input_seq = input_seq;
        prediction.level = level;
        prediction.reused = false;
        prediction.unstable_modes = summary.unstable_modes;
        prediction.max_growth_rate_per_s = summary.max_growth_rate_per_s.unwrap_or(f64::NAN);
        prediction.worst_frequency_hz = summary.worst_frequency_hz.unwrap_or(f64::NAN);
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
        let Ok(all) = answer else { return false };
        self.counters.charted += 1;
        self.counters.roots_beyond_band += self.rig.model.dimension().saturating_sub(self.charted.len()) as u64;
        let Rig { band_max_hz, instability_threshold, .. } = *self.rig;
        let map = self.numbering_at(point).cloned();
        let mu = point.friction_coefficient;
        self.summary.take_chart(&self.charted, mu, all, map.as_deref(), band_max_hz, instability_threshold);
        true
    }

    /// Takes a dense solve at `point`; the error is the reason of a FAULT.
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

    /// The level of a prediction; why goes into its reason. Of several modes past the limit the reason names the one that grows
    /// fastest, and the limit that decides: where squeal begins, or, once it has begun, where it ends.
    fn judge(&mut self, friction_margin: Option<f64>) -> u8 {
        let (summary, reason) = (&self.summary, &mut self.prediction.reason);
        let mut because = |text: std::fmt::Arguments<'_>| {
            let _ = reason.write_fmt(text); // a String takes everything
        };
        let Settings { squeal_damping_ratio: begins, squeal_hysteresis, warn_margin, .. } = self.settings;
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

/// Whether modes at `point` are numbered by `map`: it is for the same way of sliding. Its load and speed may be others than
/// those of `point`: then modes that cross between them may be numbered otherwise than by the map that is being made.
pub fn numbers(model: &Model, map: &StabilityMap, point: &OperatingPoint) -> bool {
    model.contact_state(point) == ContactState::Sliding
        && point.disc_speed_rad_s.signum() == map.point.disc_speed_rad_s.signum()
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
mod tests;

//! The session: a pure step from events to effects.
//!
//! Live and replay drive the same step. It knows no clock: time comes from the stamps of its events. A prediction is a
//! function of the rig, the settings and the events so far, and of nothing else.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;

use crate::physics::chart::build::ChartOptions;
use crate::physics::chart::{Chart, Scratch};
use crate::physics::{
    ContactState, MapOptions, Mode, Model, OperatingPoint, SolveError, Solver, StabilityMap, Summary, Traces, Vectors,
};
use crate::rig::{Limits, Rig};
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
    /// A chart of the roots became ready.
    ChartReady(Arc<Chart>),
}

/// Something to do.
#[derive(Clone, Debug)]
pub enum Effect {
    /// Publish (and record) a prediction.
    Publish(Prediction),
    /// A stability map for this load and speed would be used.
    WantMap(OperatingPoint),
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
}

impl Counters {
    /// Predictions that took work: all but those reused.
    pub fn worked(&self) -> u64 {
        self.solved + self.charted
    }
}

/// A prediction that may be reused, with the conditions it was solved for.
struct Last {
    point: OperatingPoint,
    prediction: Prediction,
}

/// The state of a session.
pub struct Session {
    rig: Arc<Rig>,
    settings: Settings,
    solver: Solver,
    traces: Traces,
    scratch: Scratch,
    charted: Vec<Mode>,
    chart: Option<Arc<Chart>>,
    map: Option<Arc<StabilityMap>>,
    last: Option<Last>,
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
        max_depth: 16,
        max_solves: 200_000,
        threads: 1,
    }
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
            chart: None,
            map: None,
            last: None,
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

    /// One step.
    ///
    /// # Errors
    /// [`SettingError`] for a parameter that is unknown or out of range; nothing has changed then.
    pub fn step(&mut self, event: Event) -> Result<Vec<Effect>, SettingError> {
        match event {
            Event::Input(input) => Ok(self.input(input)),
            Event::Parameter { name, value } => {
                self.settings.set(&name, value)?;
                self.last = None;
                Ok(vec![])
            }
            Event::Silence { stamp } => {
                let reason = format!("stale: no input for {} s", self.settings.silence_timeout_s);
                let header = Header { stamp, ..Default::default() };
                Ok(vec![Effect::Publish(self.fault(header, self.last_seq, reason))])
            }
            Event::MapReady(map) => {
                self.map = Some(map);
                self.last = None;
                Ok(vec![])
            }
            Event::ChartReady(chart) => {
                self.chart = Some(chart);
                self.last = None;
                Ok(vec![])
            }
        }
    }

    fn input(&mut self, input: wire::OperatingPoint) -> Vec<Effect> {
        let (header, seq, point) = (input.header.clone(), input.seq, input.point());
        if header.stamp.nanosec >= 1_000_000_000 {
            let reason = format!("stamp has {} ns within a second, expected less than 1e9", header.stamp.nanosec);
            return vec![Effect::Publish(self.fault(header, seq, reason))];
        }
        let before = self.last_stamp.replace(header.stamp);
        self.last_seq = seq;
        if let Some(before) = before.filter(|&before| header.stamp < before) {
            let back = (before.as_ns() - header.stamp.as_ns()) as f64 * 1e-9;
            return vec![Effect::Publish(self.fault(header, seq, format!("stamp runs backward by {back:.6} s")))];
        }
        if let Err(reason) = check_limits(&point, &self.rig.limits) {
            return vec![Effect::Publish(self.fault(header, seq, reason))];
        }
        if let Some(last) = self.last.as_ref().filter(|last| within_dead_band(&last.point, &point, &self.settings)) {
            self.counters.reused += 1;
            let prediction = Prediction { header, input_seq: seq, reused: true, ..last.prediction.clone() };
            return vec![Effect::Publish(prediction)];
        }
        let map = self.map.clone().filter(|map| map_serves(&self.rig.model, map, &point, self.settings.map_tolerance));
        match self.predict(header.clone(), seq, point, map.as_deref()) {
            Err(reason) => vec![Effect::Publish(self.fault(header, seq, reason))],
            Ok(prediction) => {
                self.last = Some(Last { point, prediction: prediction.clone() });
                let fresh =
                    map.is_some_and(|map| map_serves(&self.rig.model, &map, &point, 0.5 * self.settings.map_tolerance));
                let mut effects = vec![Effect::Publish(prediction)];
                if !fresh && self.rig.model.contact_state(&point) == ContactState::Sliding {
                    effects.push(Effect::WantMap(point));
                }
                effects
            }
        }
    }

    /// Solves for `point`; the error is the reason of a FAULT.
    fn predict(
        &mut self,
        header: Header,
        input_seq: u64,
        point: OperatingPoint,
        map: Option<&StabilityMap>,
    ) -> Result<Prediction, String> {
        let summary = match self.charted_at(&point) {
            Some(summary) => summary,
            None => self.solved_at(&point, map)?,
        };
        let sliding = self.rig.model.contact_state(&point) == ContactState::Sliding;
        let mu = point.friction_coefficient;
        let critical_friction = map.and_then(StabilityMap::critical_friction);
        let friction_margin = map.filter(|_| sliding && mu <= self.rig.mu_max).and_then(|map| map.margin(mu));
        let (level, why) = self.judge(&summary, friction_margin);
        let mut reason = why;
        let notes = [
            self.rig.model.contact_state(&point).note(),
            (sliding && map.is_none()).then_some("margin pending"),
            (sliding && mu > self.rig.mu_max).then_some("friction coefficient beyond mu_max: no margin"),
        ];
        for note in notes.into_iter().flatten() {
            if !reason.is_empty() {
                reason.push_str("; ");
            }
            reason.push_str(note);
        }
        Ok(Prediction {
            header,
            input_seq,
            level,
            reused: false,
            unstable_modes: summary.unstable_modes,
            max_growth_rate_per_s: summary.max_growth_rate_per_s.unwrap_or(f64::NAN),
            worst_frequency_hz: summary.worst_frequency_hz.unwrap_or(f64::NAN),
            critical_friction: critical_friction.filter(|_| sliding).unwrap_or(f64::NAN),
            friction_margin: friction_margin.unwrap_or(f64::NAN),
            reason,
            modes: published_modes(&summary),
        })
    }

    /// What the chart says at `point`; `None` where there is none, or where it does not answer.
    fn charted_at(&mut self, point: &OperatingPoint) -> Option<Summary> {
        let chart = self.chart.as_ref()?;
        // A chart holds one direction of rotation.
        if self.rig.model.contact_state(point) != ContactState::Sliding || point.disc_speed_rad_s < 0.0 {
            return None;
        }
        self.charted.clear();
        let traces = self.traces.at(&self.rig.model, point);
        let (scratch, charted) = (&mut self.scratch, &mut self.charted);
        let Ok(answer) = catch_unwind(AssertUnwindSafe(|| chart.evaluate(point, traces, scratch, charted))) else {
            self.chart = None; // solved from here on, in a replay as well
            return None;
        };
        answer.ok()?;
        self.counters.charted += 1;
        Some(Summary::of_chart(&self.charted, self.rig.band_max_hz, self.rig.instability_threshold))
    }

    /// A dense solve at `point`; the error is the reason of a FAULT.
    fn solved_at(&mut self, point: &OperatingPoint, map: Option<&StabilityMap>) -> Result<Summary, String> {
        let (rig, solver) = (&self.rig, &mut self.solver);
        let solved = catch_unwind(AssertUnwindSafe(|| -> Result<Summary, SolveError> {
            let spectrum = solver.solve(&rig.model, point, Vectors::Both)?;
            let ids = match map {
                Some(map) => map.identify(&spectrum),
                None => (0..spectrum.roots.len() as u32).map(Some).collect(),
            };
            Ok(Summary::of_spectrum(&spectrum, &ids, rig.band_max_hz, rig.instability_threshold))
        }));
        self.counters.solved += 1;
        match solved {
            Ok(summary) => summary.map_err(|error| format!("prediction failed: {error}")),
            Err(_) => {
                self.solver = Solver::new(self.rig.model.dimension());
                Err("prediction failed: internal error in the solver".to_owned())
            }
        }
    }

    /// The level of a prediction, and why.
    fn judge(&mut self, summary: &Summary, friction_margin: Option<f64>) -> (u8, String) {
        let ratio = |mode: &crate::physics::Mode| mode.root.damping_ratio();
        let worst = summary.modes.iter().min_by(|a, b| ratio(a).total_cmp(&ratio(b)));
        let Settings { squeal_damping_ratio, squeal_hysteresis, warn_margin, .. } = self.settings;
        let limit = squeal_damping_ratio + if self.squealing { squeal_hysteresis } else { 0.0 };
        let grows = worst.filter(|mode| ratio(mode) < limit);
        self.squealing = grows.is_some() || summary.diverges();
        if let Some(mode) = grows {
            let (id, hz, ratio) = (mode.id, mode.root.frequency_hz(), ratio(mode));
            return (level::SQUEAL, format!("mode {id} at {hz:.6} Hz: damping ratio {ratio:.6} below {limit}"));
        }
        if summary.diverges() {
            return (level::SQUEAL, "static divergence".to_owned());
        }
        match friction_margin.filter(|&margin| margin < warn_margin) {
            Some(margin) => (level::WARN, format!("friction margin {margin:.6} below {warn_margin}")),
            None => (level::OK, String::new()),
        }
    }

    fn fault(&mut self, header: Header, input_seq: u64, reason: String) -> Prediction {
        self.counters.faults += 1;
        self.last = None;
        Prediction {
            header,
            input_seq,
            level: level::FAULT,
            reason,
            max_growth_rate_per_s: f64::NAN,
            worst_frequency_hz: f64::NAN,
            critical_friction: f64::NAN,
            friction_margin: f64::NAN,
            ..Default::default()
        }
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

fn check_limits(point: &OperatingPoint, limits: &Limits) -> Result<(), String> {
    let checks = [
        ("normal_load_n", point.normal_load_n, limits.normal_load_n),
        ("disc_speed_rad_s", point.disc_speed_rad_s, limits.disc_speed_rad_s),
        ("friction_coefficient", point.friction_coefficient, limits.friction_coefficient),
    ];
    for (name, value, [low, high]) in checks {
        if !value.is_finite() {
            return Err(format!("{name} is {value}, expected a finite number"));
        }
        if !(low..=high).contains(&value) {
            return Err(format!("{name} is {value}, expected {low} to {high}"));
        }
    }
    Ok(())
}

/// The modes as published: ascending frequency, and above [`MAX_MODES`] those with the largest growth rates.
fn published_modes(summary: &Summary) -> Vec<wire::Mode> {
    let mut chosen: Vec<&crate::physics::Mode> = summary.modes.iter().collect();
    if chosen.len() > MAX_MODES {
        chosen.sort_by(|a, b| b.root.lambda.re.total_cmp(&a.root.lambda.re));
        chosen.truncate(MAX_MODES);
        chosen.sort_by(|a, b| a.root.lambda.im.total_cmp(&b.root.lambda.im));
    }
    chosen
        .into_iter()
        .map(|mode| wire::Mode {
            id: mode.id,
            frequency_hz: mode.root.frequency_hz(),
            growth_rate_per_s: mode.root.growth_rate_per_s(),
            damping_ratio: mode.root.damping_ratio(),
            pad_participation: mode.root.pad_participation,
            residual: mode.root.residual,
            frequency_error_hz: mode.root.error.omega / std::f64::consts::TAU,
            growth_rate_error_per_s: mode.root.error.sigma,
        })
        .collect()
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
        let mut published = effects.into_iter().filter_map(|effect| match effect {
            Effect::Publish(prediction) => Some(prediction),
            Effect::WantMap(_) => None,
        });
        let prediction = published.next().expect("every input is answered");
        assert!(published.next().is_none(), "every input is answered once");
        prediction
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
        assert!(effects.iter().any(|effect| matches!(effect, Effect::WantMap(_))));
        let pending = predict(&mut session, friction(1, 0.31));
        assert!(pending.friction_margin.is_nan() && pending.reason == "margin pending");
        let mut session = with_map(session);
        let effects = session.step(friction(2, 0.3)).unwrap();
        assert!(!effects.iter().any(|effect| matches!(effect, Effect::WantMap(_))), "the rig knows no load or speed");
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
        assert_eq!(session.counters(), Counters { solved: 4, charted: 0, reused: 2, faults: 0 });
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

//! The page's source for a running node, which follows the node's watch.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use super::contact::contact;
use super::curves::Curves;
use super::events::{Events, seconds};
use super::heard::SquealsInSound;
use super::history::History;
use super::metrics;
use super::running_score::RunningScore;
use super::server::{About, Source};
use super::shape::shape;
use super::sound_page::{SoundShown, SpectrogramPicture, picture};
use super::state::{CountersShown, Shown, State, TemperatureShown, spread, trend_per_s};
use crate::msgs::Heard;
use crate::node::{Sample, VibrationSample, Watch};
use crate::physics::{Solver, StabilityMap};
use crate::rig::Rig;
use crate::session::conditions;
use crate::sound::spectrogram::Part;
use crate::system::clock;

/// Length of a bin of the history, ns.
const BIN_NS: i64 = 200_000_000;
/// Number of bins kept: 10 minutes.
const BINS: usize = 3000;
/// Interval at which a state is sent even without changes, so that the page knows that the connection works.
const SIGN_OF_LIFE: Duration = Duration::from_millis(500);

/// Follows a node.
pub struct Live {
    rig: Arc<Rig>,
    watch: Watch,
    about: About,
    followed: Mutex<Followed>,
    solver: Mutex<Solver>,
}

struct Followed {
    samples: Vec<Sample>,
    vibrations: Vec<VibrationSample>,
    temperatures: Vec<(i64, f64)>,
    history: History,
    events: Events,
    heard: Vec<Heard>,
    score: RunningScore,
    squeals_in_sound: SquealsInSound,
    event_changes: u64,
    /// Number of the last bin in the state sent before.
    sent: i64,
    sent_at: Option<Instant>,
    /// Number of predictions in each tick of the last second.
    ticks: VecDeque<(Instant, usize)>,
    map: Option<Arc<StabilityMap>>,
    map_number: u64,
    curves: Option<(u64, Arc<str>)>,
}

impl Live {
    /// Follows the node from the first tick on; without a server nothing is collected.
    pub fn new(rig: Arc<Rig>, watch: Watch, about: About) -> Self {
        let solver = Mutex::new(Solver::new(rig.model.dimension()));
        watch.sound().follow();
        let followed = Followed {
            samples: vec![],
            vibrations: vec![],
            temperatures: vec![],
            history: History::new(BIN_NS, BINS),
            events: Events::default(),
            heard: vec![],
            score: RunningScore::default(),
            squeals_in_sound: SquealsInSound::default(),
            event_changes: 0,
            sent: i64::MIN,
            sent_at: None,
            ticks: VecDeque::new(),
            map: None,
            map_number: 0,
            curves: None,
        };
        Self { rig, watch, about, followed: Mutex::new(followed), solver }
    }

    fn followed(&self) -> MutexGuard<'_, Followed> {
        self.followed.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Followed {
    /// Collects what happened since the last call; returns whether anything did.
    fn follow(&mut self, watch: &Watch) -> bool {
        watch.take_samples(&mut self.samples);
        for sample in &self.samples {
            self.history.push(sample);
            self.score.predicted(sample);
            self.event_changes += u64::from(self.events.push(sample));
        }
        watch.take_vibrations(&mut self.vibrations);
        for sample in &self.vibrations {
            self.history.push_vibration(sample);
        }
        watch.take_temperatures(&mut self.temperatures);
        for &(time_ns, celsius) in &self.temperatures {
            self.history.push_temperature(time_ns, celsius);
        }
        watch.take_heard(&mut self.heard);
        for heard in &self.heard {
            self.squeals_in_sound.push(heard, heard.header.stamp.as_ns());
            self.score.heard(heard);
            self.event_changes += 1;
        }
        let now = Instant::now();
        self.ticks.push_back((now, self.samples.len()));
        while self.ticks.front().is_some_and(|tick| now - tick.0 > Duration::from_secs(1)) {
            self.ticks.pop_front();
        }
        let nothing = self.samples.is_empty() && self.vibrations.is_empty() && self.temperatures.is_empty();
        !nothing || !self.heard.is_empty()
    }

    fn state(&mut self, rig: &Rig, watch: &Watch, with_bins: bool) -> String {
        let snapshot = watch.snapshot();
        let assessment = snapshot.assessment();
        if let Some(map) = snapshot.map.filter(|map| self.map.as_ref().is_none_or(|known| !Arc::ptr_eq(known, map))) {
            self.map = Some(map);
            self.map_number += 1;
        }
        let time_s = seconds(clock::now_ns());
        let bins: Vec<_> = if with_bins { self.history.since(self.sent).collect() } else { vec![] };
        let state = State {
            time_s,
            age_s: snapshot.received.map(|received| received.elapsed().as_secs_f64()),
            rate_hz: Some(self.ticks.iter().map(|tick| tick.1).sum::<usize>() as f64),
            assessment,
            prediction: snapshot.prediction.as_ref().map(|p| Shown::new(snapshot.input.as_ref(), p)),
            spread: spread(&self.history, time_s),
            trend_per_s: trend_per_s(&self.history, time_s),
            warn_margin: snapshot.settings.map(|settings| settings.warn_margin),
            temperature: snapshot.temperature.map(|seen| TemperatureShown {
                celsius: seen.celsius,
                of_rig: snapshot.rig.as_deref().unwrap_or(rig).temperature_c(),
                stale: seen.is_stale(),
            }),
            map: self.map_number,
            events: self.event_changes,
            counters: Some(CountersShown::new(snapshot.counters, snapshot.passed_over, snapshot.bus_restarts)),
            bins,
        };
        // Only numbers and strings, so serialisation cannot fail.
        let text = serde_json::to_string(&state).unwrap_or_default();
        if with_bins {
            self.sent = self.history.bins().back().map_or(i64::MIN, |bin| bin.index);
            self.sent_at = Some(Instant::now());
        }
        text
    }
}

impl Source for Live {
    fn about(&self) -> About {
        self.about.clone()
    }

    fn tick(&self, listened_to: bool) -> Option<String> {
        let mut followed = self.followed();
        let changed = followed.follow(&self.watch);
        let due = changed || followed.sent_at.is_none_or(|sent| sent.elapsed() >= SIGN_OF_LIFE);
        (listened_to && due).then(|| followed.state(&self.rig, &self.watch, true))
    }

    fn state(&self, _at_s: Option<f64>) -> String {
        self.followed().state(&self.rig, &self.watch, false)
    }

    fn history(&self) -> String {
        // The next state has to wait meanwhile, but the node does not; a copy would cost memory.
        self.followed().history.to_json()
    }

    fn events(&self) -> Events {
        self.followed().events.clone()
    }

    fn squeals_in_sound(&self) -> SquealsInSound {
        self.followed().squeals_in_sound.clone()
    }

    fn sound(&self) -> SoundShown {
        let view = self.watch.sound();
        view.with(|shown| SoundShown::new(shown, &self.followed().score.meet(shown)))
    }

    fn spectrogram(&self, channel: &str, part: Option<Part>) -> Option<SpectrogramPicture> {
        // A node does not keep the samples that a part would need.
        if part.is_some() {
            return None;
        }
        self.watch.sound().with(|shown| {
            let whole = shown.get(channel)?;
            picture(whole, whole, 0.0)
        })
    }

    fn metrics(&self) -> Option<String> {
        Some(metrics::text(&self.about, &self.watch.snapshot()))
    }

    fn map(&self, number: u64) -> Option<Arc<str>> {
        let map = {
            let followed = self.followed();
            if let Some((_, text)) = followed.curves.as_ref().filter(|(of, _)| *of == followed.map_number) {
                return Some(text.clone());
            }
            followed.map.clone().filter(|_| number <= followed.map_number)?
        };
        let curves = Curves::new(&map, self.rig.band_max_hz);
        let text: Arc<str> = serde_json::to_string(&curves).unwrap_or_default().into();
        let mut followed = self.followed();
        if followed.map.as_ref().is_some_and(|latest| Arc::ptr_eq(latest, &map)) {
            followed.curves = Some((followed.map_number, text.clone()));
        }
        Some(text)
    }

    fn shape(&self, id: u32, _at_s: Option<f64>) -> Result<String, String> {
        let snapshot = self.watch.snapshot();
        let input = snapshot.input.ok_or("no conditions were received yet")?;
        let mut solver = self.solver.lock().unwrap_or_else(PoisonError::into_inner);
        let rig = snapshot.rig.as_deref().unwrap_or(&self.rig);
        let shape = shape(rig, &mut solver, snapshot.map.as_deref(), &conditions(&input), id)?;
        Ok(serde_json::to_string(&shape).unwrap_or_default())
    }

    fn contact(&self, _at_s: Option<f64>) -> Result<String, String> {
        let snapshot = self.watch.snapshot();
        let input = snapshot.input.ok_or("no conditions were received yet")?;
        let contact = contact(snapshot.rig.as_deref().unwrap_or(&self.rig), &conditions(&input))?;
        Ok(serde_json::to_string(&contact).unwrap_or_default())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::msgs::{OperatingPoint, Prediction, level};
    use crate::node::status::InputSources;

    /// The page gets the predicted level, at every level, and no statement where nothing is known.
    #[test]
    fn the_page_is_sent_the_level_that_was_predicted() {
        let rig = Arc::new(Rig::load("nine-dof-case-2").expect("embedded"));
        let watch = Watch::default();
        let inputs = Some(InputSources { places: vec!["/rig/operating_point".to_owned()], start: None });
        let about = About { simulated: true, inputs, ..About::new(&rig, "live", 70.0) };
        let live = Live::new(rig, watch.clone(), about);
        let state = || serde_json::from_str::<serde_json::Value>(&live.state(None)).expect("JSON");
        let about = serde_json::to_value(live.about()).expect("JSON");
        assert_eq!(
            (&about["simulated"], &about["inputs"]["places"][0]),
            (&true.into(), &"/rig/operating_point".into())
        );
        assert_eq!((&state()["status"], &state()["level"]), (&"waiting".into(), &serde_json::Value::Null));
        for (level, status) in [
            (level::OK, "ok"),
            (level::WARN, "warn"),
            (level::SQUEAL, "squeal"),
            (level::FAULT, "fault"),
            (level::OK, "ok"),
        ] {
            watch.input(&OperatingPoint::default());
            watch.prediction(&Prediction { level, ..Prediction::default() });
            let state = state();
            assert_eq!((state["level"].as_u64(), state["status"].as_str()), (Some(level.into()), Some(status)));
        }
        watch.silence();
        let silence =
            Prediction { level: level::FAULT, reason: "stale: no input for 1 s".to_owned(), ..Prediction::default() };
        watch.prediction(&silence);
        let state = state();
        assert_eq!(
            (state["status"].as_str(), state["message"].as_str()),
            (Some("no_data"), Some("inputs have stopped"))
        );
        assert!(state["next"].is_null() && state["fastest"].is_null());
    }
}

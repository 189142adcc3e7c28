//! The page's source for a recording: read once, then queried for single moments.

use std::collections::{BTreeMap, HashMap, VecDeque};
use std::sync::{Arc, Mutex, PoisonError};

use super::comparison::{Comparison, Criteria, Measurements};
use super::contact::contact;
use super::curves::Curves;
use super::events::{Events, seconds};
use super::heard::SquealsInSound;
use super::history::History;
use super::server::{About, Note, Source};
use super::shape::shape;
use super::sound_detail::{SampleIndex, longest_part_s};
use super::sound_page::{SoundShown, SpectrogramPicture, picture};
use super::state::{Shown, State, TemperatureShown, spread, trend_per_s};
use super::time_line::TimeLine;
use crate::msgs::{DiagnosticArray, OperatingPoint, Prediction, SessionEvent, SessionEventKind, Waveform, level};
use crate::node::status::{Assessment, Inputs, Status};
use crate::node::{Sample, VibrationSample};
use crate::offline::score::HeardAndPredicted;
use crate::offline::verify_sound::recorded_settings;
use crate::physics::{Solver, StabilityMap};
use crate::recording::message::Payload;
use crate::recording::reader::{FileDamage, Recorded as Content, Recording};
use crate::rig::Rig;
use crate::session::computed::{session_map, session_rig};
use crate::session::conditions;
use crate::simulator;
use crate::sound;
use crate::sound::search::channel_of;
use crate::sound::spectrogram::{Part, Spectrogram};

/// Bins of the history; their length grows with the recording.
const BINS: usize = 3000;
/// Initial length of a bin, ns.
const FIRST_BIN_NS: i64 = 50_000_000;
/// Number of predictions kept in full. Of a longer recording only every second, fourth ... prediction is kept, and
/// those at which the status changes. Events and history include all of them.
const MOST_MOMENTS: usize = 40_000;
/// Inputs remembered until their prediction is read.
const INPUTS: usize = 1024;
/// Channels of sound with a spectrogram.
pub const MOST_SPECTROGRAMS: usize = 8;
/// Columns of a spectrogram.
const SPECTROGRAM_COLUMNS: usize = 1200;
/// Stability maps kept in memory.
const MAPS: usize = 8;

/// One prediction with its input.
#[derive(Clone, Debug)]
pub struct Moment {
    /// Time according to the stamps; see `TimeLine`.
    pub time_ns: i64,
    pub input: Option<OperatingPoint>,
    pub prediction: Prediction,
    status: Status,
    /// Number of the prediction in the recording.
    index: u64,
    /// Whether its status differs from that of the previous prediction.
    changed: bool,
}

/// The content of a recording, prepared for the page and the report.
pub struct Recorded {
    pub rig: Arc<Rig>,
    pub history: History,
    pub events: Events,
    pub squeals_in_sound: SquealsInSound,
    /// Of each channel of sound whose samples were recorded, by name; of the first [`MOST_SPECTROGRAMS`].
    pub spectrograms: BTreeMap<String, Spectrogram>,
    /// Where their samples are in the recording.
    samples: SampleIndex,
    recording: Arc<Recording>,
    /// Predictions and squeals in sound for comparison, by their stamps.
    pub heard_and_predicted: HeardAndPredicted,
    /// The definition of squeal in sound.
    pub sound_settings: sound::Settings,
    /// The measured vibration.
    pub vibration: Measurements,
    /// The predictions kept, in order; see [`Recorded::stride`].
    pub moments: Vec<Moment>,
    /// One of this many predictions is kept.
    pub stride: u64,
    /// Number of predictions by status.
    pub counts: HashMap<Status, u64>,
    /// Whether any input came from the rig simulator.
    pub simulated: bool,
    /// Number of inputs recorded, and of those predicted.
    pub inputs: u64,
    pub answered: u64,
    /// The node's latest diagnostics.
    pub counted: Option<DiagnosticArray>,
    pub reused: u64,
    /// Settings, maps and other session events in order, with their time on the time line of the stamps.
    pub session_events: Vec<(i64, SessionEvent)>,
    pub damage: Vec<FileDamage>,
    status_before: Option<Status>,
    /// Whether inputs arrived at the latest entry read.
    flow: Inputs,
    maps: Mutex<VecDeque<(u64, Arc<StabilityMap>)>>,
    /// The latest rigs built for other temperatures, °C.
    rigs: Mutex<VecDeque<(f64, Arc<Rig>)>>,
    solver: Mutex<Solver>,
}

impl Recorded {
    /// Reads `recording`, which was made with `rig`. `criteria` define squeal in a measured vibration.
    pub fn read(recording: &Arc<Recording>, rig: Arc<Rig>, criteria: Criteria) -> Self {
        let sound_settings = recorded_settings(recording);
        let mut recorded = Self {
            spectrograms: BTreeMap::new(),
            samples: SampleIndex::default(),
            recording: recording.clone(),
            heard_and_predicted: HeardAndPredicted::new(sound_settings.band_hz),
            sound_settings,
            solver: Mutex::new(Solver::new(rig.model.dimension())),
            rig,
            history: History::coarsening(FIRST_BIN_NS, BINS),
            events: Events::default(),
            squeals_in_sound: SquealsInSound::default(),
            vibration: Measurements::new(criteria),
            moments: vec![],
            stride: 1,
            counts: HashMap::new(),
            simulated: false,
            inputs: 0,
            answered: 0,
            counted: None,
            reused: 0,
            session_events: vec![],
            damage: vec![],
            status_before: None,
            flow: Inputs::default(),
            maps: Mutex::default(),
            rigs: Mutex::default(),
        };
        let mut inputs: VecDeque<OperatingPoint> = VecDeque::new();
        let mut line = TimeLine::default();
        let mut messages = recording.messages();
        for entry in messages.by_ref() {
            let log_ns = i64::try_from(entry.log_time_ns).unwrap_or(i64::MAX);
            if let Content::Known(payload) = &entry.message {
                recorded.heard_and_predicted.take(payload);
            }
            match entry.message {
                Content::Known(Payload::OperatingPoint(input)) => {
                    recorded.inputs += 1;
                    recorded.flow.came();
                    if inputs.len() == INPUTS {
                        inputs.pop_front();
                    }
                    inputs.push_back(input);
                }
                Content::Known(Payload::Prediction(prediction)) => {
                    let input = inputs.iter().rev().find(|input| input.seq == prediction.input_seq);
                    // The FAULT of a silence refers to the last input, but its stamp is from the node's clock.
                    let stamp = prediction.header.stamp;
                    let measured = input.map_or(prediction.level != level::FAULT, |input| input.header.stamp == stamp);
                    let time_ns = if measured { line.stamped(stamp, log_ns) } else { line.unstamped(log_ns) };
                    if recorded.moments.is_empty() {
                        // Earlier events had no stamped message to follow.
                        for (event_ns, _) in &mut recorded.session_events {
                            *event_ns = time_ns.saturating_sub(log_ns.saturating_sub(*event_ns));
                        }
                    }
                    recorded.take(time_ns, input, prediction);
                }
                Content::Known(Payload::Vibration(vibration)) => {
                    let sample = VibrationSample::new(line.of_stamp(vibration.header.stamp, log_ns), &vibration);
                    recorded.history.push_vibration(&sample);
                    recorded.vibration.push(&sample);
                }
                Content::Known(Payload::Temperature(measured)) => {
                    let time_ns = line.of_stamp(measured.header.stamp, log_ns);
                    recorded.history.push_temperature(time_ns, measured.temperature);
                }
                Content::Known(Payload::Heard(heard)) => {
                    recorded.squeals_in_sound.push(&heard, line.of_stamp(heard.header.stamp, log_ns));
                }
                Content::Known(Payload::Diagnostics(counted)) => recorded.counted = Some(counted),
                Content::Known(Payload::SessionEvent(event)) => {
                    if SessionEventKind::of(&event) == Some(SessionEventKind::Silence) {
                        recorded.flow.silence();
                    }
                    recorded.session_events.push((line.unstamped(log_ns), event));
                }
                Content::Known(Payload::Waveform(block)) => {
                    let time_ns = line.of_stamp(block.header.stamp, log_ns);
                    recorded.samples.note(log_ns, time_ns, line);
                    recorded.show_samples(time_ns, &block);
                }
                Content::Known(Payload::RigInfo(_) | Payload::Sensitivity(_))
                | Content::Unreadable(_)
                | Content::Other => {}
            }
        }
        recorded.damage = messages.damage().to_vec();
        recorded
    }

    /// Adds samples to the spectrogram of their channel. Of a channel that changes, those before the change are shown.
    fn show_samples(&mut self, time_ns: i64, block: &Waveform) {
        let band_hz = self.sound_settings.band_hz;
        if !self.spectrograms.contains_key(&block.channel) && self.spectrograms.len() < MOST_SPECTROGRAMS {
            let new = channel_of(block).ok();
            let new = new.and_then(|channel| Spectrogram::coarsening(&channel, band_hz, SPECTROGRAM_COLUMNS).ok());
            self.spectrograms.extend(new.map(|new| (block.channel.clone(), new)));
        }
        let same = |shown: &&mut Spectrogram| channel_of(block).is_ok_and(|channel| channel == *shown.channel());
        if let Some(shown) = self.spectrograms.get_mut(&block.channel).filter(same) {
            shown.push(time_ns, &block.samples);
        }
    }

    fn take(&mut self, time_ns: i64, input: Option<&OperatingPoint>, prediction: Prediction) {
        self.flow.predicted();
        let sample = Sample::new(time_ns, input, &prediction, self.flow);
        self.history.push(&sample);
        self.events.push(&sample);
        let count = self.predictions();
        let status = sample.status;
        *self.counts.entry(status).or_default() += 1;
        self.simulated |= prediction.header.frame_id == simulator::FRAME_ID;
        self.reused += u64::from(prediction.reused);
        self.answered += u64::from(input.is_some_and(|input| input.header.stamp == prediction.header.stamp));
        let changed = self.status_before.replace(status) != Some(status);
        if !changed && !count.is_multiple_of(self.stride) {
            return;
        }
        if self.moments.len() == MOST_MOMENTS {
            self.stride *= 2;
            let stride = self.stride;
            let regular = |moment: &Moment| moment.index.is_multiple_of(stride);
            self.moments.retain(|moment| moment.changed || regular(moment));
            // If the status changes all the time, keep only every `stride`-th prediction.
            if self.moments.len() > MOST_MOMENTS / 4 * 3 {
                self.moments.retain(regular);
            }
        }
        self.moments.push(Moment { time_ns, input: input.cloned(), prediction, status, index: count, changed });
    }

    /// Number of predictions.
    pub fn predictions(&self) -> u64 {
        self.counts.values().sum()
    }

    /// Number of predictions with a status.
    pub fn count(&self, status: Status) -> u64 {
        self.counts.get(&status).copied().unwrap_or(0)
    }

    /// The assessment of a moment.
    fn assessment(&self, moment: &Moment) -> Assessment {
        let map = moment.status.is_known().then(|| self.stability_map(self.map_number(seconds(moment.time_ns))));
        let map = map.flatten();
        let windows = map.as_deref().map(|map| (map, &map.ends));
        Assessment::new(moment.status, &moment.prediction, moment.input.as_ref(), windows)
    }

    /// First and last moment, s since the epoch; `None` without predictions.
    pub fn span_s(&self) -> Option<(f64, f64)> {
        let first = seconds(self.moments.first()?.time_ns);
        let bin_s = seconds(self.history.bin_ns());
        let last = self.moments.last().map_or(first, |last| seconds(last.time_ns));
        // The last predictions may not be among those kept.
        let end = self.history.bins().back().map_or(last, |bin| bin.index as f64 * bin_s);
        Some((first, last.max(end)))
    }

    /// The latest kept prediction up to a time; before the first one, the first.
    pub fn moment(&self, at_s: f64) -> Option<&Moment> {
        let after = self.moments.partition_point(|moment| seconds(moment.time_ns) <= at_s + 1e-7);
        self.moments.get(after.saturating_sub(1))
    }

    /// The measured vibration compared with the predictions; `None` if none was recorded.
    pub fn comparison(&self) -> Option<Comparison> {
        self.vibration.compare(&self.events, self.span_s()?.1)
    }

    /// The session events of one kind.
    pub(super) fn events_of(&self, kind: SessionEventKind) -> impl Iterator<Item = &(i64, SessionEvent)> {
        self.session_events.iter().filter(move |(_, event)| SessionEventKind::of(event) == Some(kind))
    }

    fn map_events(&self) -> impl Iterator<Item = &(i64, SessionEvent)> {
        self.events_of(SessionEventKind::StabilityMap)
    }

    /// Number of the map in force at a time, from 1; 0 before the first.
    pub fn map_number(&self, at_s: f64) -> u64 {
        self.map_events().take_while(|(time_ns, _)| seconds(*time_ns) <= at_s + 1e-7).count() as u64
    }

    /// The value of a setting at a time; `None` if not recorded.
    pub fn setting(&self, name: &str, at_s: f64) -> Option<f64> {
        let settings = self.events_of(SessionEventKind::Parameter);
        let before = settings.take_while(|(time_ns, _)| seconds(*time_ns) <= at_s + 1e-7);
        before.map(|(_, event)| event).filter(|event| event.name == name).last().map(|event| event.value)
    }

    /// The rig that was in force after the first `events` session events; the rig at its reference temperature if it cannot
    /// be built for the recorded one.
    fn rig_after(&self, events: usize) -> Arc<Rig> {
        let before = self.session_events.iter().take(events);
        let of_rig =
            |(_, event): &&(i64, SessionEvent)| SessionEventKind::of(event) == Some(SessionEventKind::Temperature);
        let Some(celsius) = before.rev().find(of_rig).map(|(_, event)| event.value) else { return self.rig.clone() };
        let mut rigs = self.rigs.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some((_, rig)) = rigs.iter().find(|(known, _)| *known == celsius) {
            return rig.clone();
        }
        let Ok(rig) = session_rig(&self.rig, celsius) else { return self.rig.clone() };
        if rigs.len() == MAPS {
            rigs.pop_front();
        }
        rigs.push_back((celsius, rig.clone()));
        rig
    }

    /// The rig in force at a time.
    fn rig_at(&self, at_s: f64) -> Arc<Rig> {
        self.rig_after(self.session_events.partition_point(|(time_ns, _)| seconds(*time_ns) <= at_s + 1e-7))
    }

    /// The temperature of the contact at a time; `None` before the first.
    fn temperature(&self, at_s: f64) -> Option<TemperatureShown> {
        let (known_s, celsius) = self.history.temperature_before(at_s)?;
        let timeout_s = self.setting("temperature_timeout_s", at_s).unwrap_or(f64::INFINITY);
        let of_rig = self.rig.temperature.as_ref().and_then(|_| self.rig_at(at_s).temperature_c());
        Some(TemperatureShown { celsius, of_rig, stale: at_s - known_s > timeout_s })
    }

    /// The map with that number, computed again; `None` if there is none or the computation fails.
    pub fn stability_map(&self, number: u64) -> Option<Arc<StabilityMap>> {
        let known = |maps: &VecDeque<(u64, Arc<StabilityMap>)>| {
            maps.iter().find(|(known, _)| *known == number).map(|(_, map)| map.clone())
        };
        if let Some(map) = known(&self.maps.lock().unwrap_or_else(PoisonError::into_inner)) {
            return Some(map);
        }
        let events = self.session_events.iter().enumerate();
        let mut maps =
            events.filter(|(_, (_, event))| SessionEventKind::of(event) == Some(SessionEventKind::StabilityMap));
        let (index, (_, event)) = maps.nth(usize::try_from(number.checked_sub(1)?).ok()?)?;
        let rig = self.rig_after(index);
        let point = crate::physics::OperatingPoint {
            normal_load_n: event.normal_load_n,
            disc_speed_rad_s: event.disc_speed_rad_s,
            friction_coefficient: 0.0,
        };
        let mut solver = self.solver.lock().unwrap_or_else(PoisonError::into_inner);
        let maps = || self.maps.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(map) = known(&maps()) {
            return Some(map);
        }
        let map = Arc::new(session_map(&rig, &mut solver, &point).ok()?);
        let mut maps = maps();
        if maps.len() == MAPS {
            maps.pop_front();
        }
        maps.push_back((number, map.clone()));
        Some(map)
    }
}

impl Source for Recorded {
    fn about(&self) -> About {
        let notes = self.session_events.iter().filter_map(|(time_ns, event)| {
            let onset_s = seconds(*time_ns);
            let note = Note { onset_s, what: "chart ready", normal_load_n: None, disc_speed_rad_s: None };
            match SessionEventKind::of(event)? {
                SessionEventKind::Chart => Some(note),
                SessionEventKind::Temperature => Some(Note { what: "rig at another temperature", ..note }),
                SessionEventKind::StabilityMap => {
                    let (load, speed) = (event.normal_load_n, event.disc_speed_rad_s);
                    let what = "stability map ready";
                    Some(Note { what, normal_load_n: Some(load), disc_speed_rad_s: Some(speed), ..note })
                }
                SessionEventKind::Parameter | SessionEventKind::Silence | SessionEventKind::WindowEnds => None,
            }
        });
        About {
            simulated: self.simulated,
            span_s: self.span_s(),
            notes: notes.collect(),
            ..About::new(&self.rig, "recording", self.vibration.criteria().threshold_db)
        }
    }

    fn tick(&self, _listened_to: bool) -> Option<String> {
        None
    }

    fn state(&self, at_s: Option<f64>) -> String {
        let time_s = at_s.filter(|at_s| at_s.is_finite()).or(self.span_s().map(|span| span.0)).unwrap_or(0.0);
        let moment = self.moment(time_s);
        let state = State {
            time_s,
            age_s: moment.map(|moment| (time_s - seconds(moment.time_ns)).max(0.0)),
            rate_hz: None,
            assessment: moment.map_or_else(Assessment::waiting, |moment| self.assessment(moment)),
            prediction: moment.map(|moment| Shown::new(moment.input.as_ref(), &moment.prediction)),
            spread: spread(&self.history, time_s),
            trend_per_s: trend_per_s(&self.history, time_s),
            warn_margin: self.setting("warn_margin", time_s),
            temperature: self.temperature(time_s),
            map: self.map_number(time_s),
            events: self.events.count(),
            counters: None,
            bins: vec![],
        };
        serde_json::to_string(&state).unwrap_or_default()
    }

    fn history(&self) -> String {
        self.history.to_json()
    }

    fn events(&self) -> Events {
        self.events.clone()
    }

    fn squeals_in_sound(&self) -> SquealsInSound {
        self.squeals_in_sound.clone()
    }

    fn comparison(&self) -> Option<Comparison> {
        self.comparison()
    }

    fn sound(&self) -> SoundShown {
        SoundShown::new(&self.spectrograms, &self.heard_and_predicted.meet(&sound::matching::Criteria::default()))
    }

    fn spectrogram(&self, channel: &str, part: Option<Part>) -> Option<SpectrogramPicture> {
        let whole = self.spectrograms.get(channel)?;
        let detail = match part {
            None => None,
            Some(part) => Some(self.samples.detail(&self.recording, whole, part)?),
        };
        picture(detail.as_ref().unwrap_or(whole), whole, longest_part_s(whole))
    }

    fn map(&self, number: u64) -> Option<Arc<str>> {
        let map = self.stability_map(number)?;
        serde_json::to_string(&Curves::new(&map, self.rig.band_max_hz)).ok().map(Into::into)
    }

    fn shape(&self, id: u32, at_s: Option<f64>) -> Result<String, String> {
        let time_s = at_s.or(self.span_s().map(|span| span.0)).unwrap_or(0.0);
        let moment = self.moment(time_s).ok_or("the recording holds no prediction")?;
        let input = moment.input.as_ref().ok_or("the conditions of this prediction were not recorded")?;
        let map = self.stability_map(self.map_number(time_s));
        let mut solver = self.solver.lock().unwrap_or_else(PoisonError::into_inner);
        let shape = shape(&self.rig_at(time_s), &mut solver, map.as_deref(), &conditions(input), id)?;
        Ok(serde_json::to_string(&shape).unwrap_or_default())
    }

    fn contact(&self, at_s: Option<f64>) -> Result<String, String> {
        let time_s = at_s.or(self.span_s().map(|span| span.0)).unwrap_or(0.0);
        let moment = self.moment(time_s).ok_or("the recording holds no prediction")?;
        let input = moment.input.as_ref().ok_or("the conditions of this prediction were not recorded")?;
        let contact = contact(&self.rig_at(time_s), &conditions(input))?;
        Ok(serde_json::to_string(&contact).unwrap_or_default())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::display::comparison::Criteria;
    use crate::display::events::EventKind;
    use crate::display::report::{Origin, report};
    use crate::msgs::{Header, Time, level};
    use crate::offline::{self, Measured, Quantity};

    const STEPS: u32 = 40;

    /// A simulated session with a step of 0.1 s and friction coefficients from 0.28 to 0.45: `nine-dof-case-2` squeals
    /// above 0.3559.
    fn ramp(directory: &std::path::Path) -> Recorded {
        let rig = Arc::new(Rig::load("nine-dof-case-2").expect("embedded"));
        let inputs = (0..STEPS).map(|seq| {
            let stamp = Time::from_ns(offline::START_NS + i64::from(seq) * 100_000_000);
            let header = Header { stamp, frame_id: simulator::FRAME_ID.to_owned() };
            let friction_coefficient = 0.28 + 0.17 * f64::from(seq) / f64::from(STEPS);
            let (seq, normal_load_n) = (seq.into(), 500.0);
            let input = OperatingPoint { header, seq, normal_load_n, disc_speed_rad_s: 13.0, friction_coefficient };
            Measured::at_its_stamp(Quantity::Conditions(input))
        });
        let predicted = offline::record(&rig, None, std::iter::empty(), inputs, None, directory).expect("recorded");
        Recorded::read(&Arc::new(Recording::open(&predicted.directory).expect("a recording")), rig, Criteria::default())
    }

    #[test]
    fn every_moment_shows_its_own_prediction() {
        let directory = tempfile::tempdir().expect("a folder");
        let recorded = ramp(directory.path());
        assert_eq!(recorded.moments.len(), STEPS as usize);
        let mut seen = [0; 3];
        for moment in &recorded.moments {
            let text = recorded.state(Some(seconds(moment.time_ns)));
            let state: serde_json::Value = serde_json::from_str(&text).expect("JSON");
            let prediction = &moment.prediction;
            assert_eq!(state["seq"].as_u64(), Some(prediction.input_seq), "{text}");
            assert_eq!(state["level"].as_u64(), Some(prediction.level.into()), "{text}");
            let names = [(level::OK, "ok"), (level::WARN, "warn"), (level::SQUEAL, "squeal")];
            let (level, name) = names[usize::from(prediction.level)];
            seen[usize::from(level)] += 1;
            assert_eq!(state["status"], name, "{text}");
            assert_eq!(state["simulated"], true, "{text}");
            let growth = state["fastest"]["growth_rate_per_s"].as_f64();
            assert_eq!(growth, (prediction.unstable_modes > 0).then_some(prediction.max_growth_rate_per_s), "{text}");
            if prediction.friction_margin.is_finite() {
                let next = &state["next"];
                assert_eq!(next["margin"].as_f64(), Some(prediction.friction_margin), "{text}");
                assert!((next["mu"].as_f64().expect("a place") - 0.3559).abs() < 1e-4, "the only window near: {text}");
                assert_eq!(next["ids"].as_array().map(Vec::len), Some(2), "a pair merges: {text}");
            }
        }
        assert!(seen.iter().all(|&count| count > 3), "OK, WARN and SQUEAL: {seen:?}");
    }

    #[test]
    fn a_report_names_simulated_conditions_and_separates_onset_from_peak() {
        let directory = tempfile::tempdir().expect("a folder");
        let recorded = ramp(directory.path());
        let [event] = recorded.events.iter().collect::<Vec<_>>()[..] else { panic!("{:?}", recorded.events) };
        let peak = event.peak.expect("it grows");
        assert_eq!((event.kind, event.end_s), (EventKind::Squeal, None));
        let (onset_mu, peak_mu) = (event.onset.friction_coefficient, peak.friction_coefficient);
        assert!(onset_mu < Some(0.37) && peak_mu > Some(0.44), "growth rises with friction: {event:?}");
        let about = recorded.about();
        assert!(about.simulated && about.inputs.is_none());
        let html = report(&recorded, &Origin { file: "ramp".to_owned(), version: None }).expect("a report");
        assert!(html.contains("Conditions of a rig simulator, not of a rig"), "{html:.2000}");
        assert!(html.contains("at μ = 0.44"), "the worst moment is that of the peak: {html:.2000}");
    }
}

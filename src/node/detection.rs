//! Searches received samples for squeal, on a thread of its own, so that no prediction waits for it.
//!
//! Blocks of samples come through a bounded queue; blocks that do not fit are lost and counted, and the stamps of the next
//! block show the gap. Each channel has a [`Detector`]. What it finds depends on the samples and their stamps alone, so it
//! is found again in recorded samples, bit for bit. Squeals are compared with the predictions of that time
//! ([`crate::sound::in_force`]) and handed to the node's queue to be published.

use std::collections::{BTreeMap, VecDeque};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;

use crossbeam_channel::{Receiver, Sender, bounded};

use super::Incoming;
use super::outputs::record;
use super::watch::fastest_modes;
use crate::bus::{Bus, Received};
use crate::msgs::{Heard, Prediction, Waveform, heard_state, level};
use crate::recording::message::Payload;
use crate::recording::recorder::RecorderHandle;
use crate::sound::in_force::{self, InForce};
use crate::sound::matching::{Criteria, Unstable};
use crate::sound::{Channel, Counts, Detection, Detector, Interruption, Settings, Squeal};

/// Capacity of the queue, in blocks: 5 s of four channels at 51.2 kHz in blocks of 1024, at most 64 MiB.
const QUEUE: usize = 1024;
/// Number of channels; blocks of further ones are refused.
const MOST_CHANNELS: usize = 32;
/// A channel is received over the bus that delivered it first, until that has delivered nothing for this time, ns.
const OTHER_BUS_AFTER_NS: u64 = 1_000_000_000;
/// Predictions that are kept for comparison: 4 s at 1 kHz.
const PREDICTIONS: usize = 4096;
/// Samples are not recorded while this many messages wait for the recorder, so that predictions still fit its queue; with
/// the longest blocks they take 256 MiB.
const MOST_WAITING_FOR_RECORDER: usize = 4096;
/// Interruptions named in one report; others are counted.
const MOST_NAMED: usize = 8;

/// What counts as squeal in received samples, and whether the samples are recorded.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct SoundOptions {
    pub settings: Settings,
    /// Record the samples too, not only the squeals.
    pub record_samples: bool,
}

/// The state of the search, for diagnostics.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct SoundReport {
    pub channels: Vec<ChannelReport>,
    /// Blocks that came over another bus too.
    pub duplicates: u64,
    /// Blocks that cannot be searched, and the latest reason.
    pub refused: u64,
    pub why_refused: Option<String>,
    /// Blocks lost because the queue was full.
    pub lost: u64,
    /// Blocks that were not recorded because the recorder was held up.
    pub unrecorded: u64,
    /// Squeals that did not fit the node's queue.
    pub unpublished: u64,
    /// Interruptions since the last report: the first [`MOST_NAMED`] named, and their number.
    pub interruptions: Vec<String>,
    pub interruption_count: u64,
}

/// The state of one channel.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct ChannelReport {
    pub name: String,
    pub sample_rate_hz: f64,
    pub samples: u64,
    pub missing: u64,
    pub repeated: u64,
    pub not_finite: u64,
    pub squeals: u64,
}

enum Item {
    Block(Received<Waveform>),
    Stop,
}

/// Hands blocks of samples, and the predictions they are compared with, to the thread. Cheap to clone.
#[derive(Clone)]
pub(super) struct DetectionInlet {
    queue: Sender<Item>,
    shared: Arc<Shared>,
}

struct Shared {
    /// Whether samples have been received: without them, no prediction is kept.
    receives: AtomicBool,
    stopping: AtomicBool,
    lost: AtomicU64,
    predictions: Mutex<VecDeque<InForce>>,
    report: Mutex<SoundReport>,
}

impl Shared {
    fn report(&self) -> MutexGuard<'_, SoundReport> {
        self.report.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// The search before its thread is started.
pub(super) struct Prepared {
    blocks: Receiver<Item>,
    inlet: DetectionInlet,
    pub options: SoundOptions,
}

/// The running search.
pub(super) struct Running {
    inlet: DetectionInlet,
    thread: Option<JoinHandle<Vec<Heard>>>,
}

impl Prepared {
    /// A search with default options, and its inlet.
    pub fn new() -> (Self, DetectionInlet) {
        let (queue, blocks) = bounded(QUEUE);
        let shared = Arc::new(Shared {
            receives: AtomicBool::new(false),
            stopping: AtomicBool::new(false),
            lost: AtomicU64::new(0),
            predictions: Mutex::new(VecDeque::with_capacity(PREDICTIONS)),
            report: Mutex::default(),
        });
        let inlet = DetectionInlet { queue, shared };
        (Self { blocks, inlet: inlet.clone(), options: SoundOptions::default() }, inlet)
    }

    /// Starts the thread, which hands what it finds to `node`.
    pub fn start(self, node: Sender<Incoming>, recorder: Option<RecorderHandle>) -> Running {
        let Self { blocks, inlet, options } = self;
        let mut search = Search {
            options,
            recorder: recorder.filter(|_| options.record_samples),
            criteria: Criteria::default(),
            channels: BTreeMap::new(),
            shared: inlet.shared.clone(),
            found: vec![],
            send: Box::new(move |heard| node.try_send(Incoming::Heard(Box::new(heard))).is_ok()),
        };
        let thread = std::thread::Builder::new().name("sound".to_owned()).spawn(move || search.run(&blocks));
        if let Err(error) = &thread {
            note!("samples are not searched for squeal: {error}");
        }
        Running { inlet, thread: thread.ok() }
    }
}

impl Running {
    /// Ends the search. Returns the squeals that lasted, ended here. Blocks that still wait are counted as lost.
    pub fn stop(self) -> Vec<Heard> {
        self.inlet.shared.stopping.store(true, Ordering::Relaxed);
        // Fails if the thread has ended; a panic was reported there.
        let _ = self.inlet.queue.send(Item::Stop);
        self.thread.and_then(|thread| thread.join().ok()).unwrap_or_default()
    }
}

impl DetectionInlet {
    /// Queues a block; never blocks.
    pub fn waveform(&self, received: Received<Waveform>) {
        self.shared.receives.store(true, Ordering::Relaxed);
        if self.queue.try_send(Item::Block(received)).is_err() {
            self.shared.lost.fetch_add(1, Ordering::Relaxed);
        }
    }

    /// Keeps a prediction for comparison, if samples are received. Neither waits nor allocates.
    pub fn predicted(&self, prediction: &Prediction) {
        if prediction.level == level::FAULT || !self.shared.receives.load(Ordering::Relaxed) {
            return;
        }
        // The search holds the lock while it looks for the prediction of a squeal, for microseconds.
        if let Ok(mut predictions) = self.shared.predictions.try_lock() {
            if predictions.len() == PREDICTIONS {
                predictions.pop_front();
            }
            predictions.push_back(in_force(prediction));
        }
    }

    /// The state for diagnostics; the interruptions since the last call. `None` before the first block.
    pub fn report(&self) -> Option<SoundReport> {
        if !self.shared.receives.load(Ordering::Relaxed) {
            return None;
        }
        let mut report = self.shared.report();
        let now = SoundReport { lost: self.shared.lost.load(Ordering::Relaxed), ..report.clone() };
        report.interruptions.clear();
        report.interruption_count = 0;
        Some(now)
    }
}

/// A prediction as squeals are compared with it.
pub fn in_force(prediction: &Prediction) -> InForce {
    let squeals = prediction.level == level::SQUEAL;
    let modes = fastest_modes(prediction).map(|mode| {
        mode.filter(|_| squeals).map(|mode| Unstable {
            mode_id: mode.id,
            frequency_hz: mode.frequency_hz,
            growth_rate_per_s: mode.growth_rate_per_s,
        })
    });
    InForce { stamp_ns: prediction.header.stamp.as_ns(), input_seq: prediction.input_seq, modes }
}

/// The channel that a block describes.
///
/// # Errors
/// Why its unit or sensitivity is invalid.
pub fn channel_of(block: &Waveform) -> Result<Channel, String> {
    let Waveform { channel, sample_rate_hz, unit, sensitivity, .. } = block;
    let failed = |error: String| format!("channel `{channel}`: {error}");
    let sensitivity = if sensitivity.is_empty() {
        None
    } else {
        Some(sensitivity.parse().map_err(|error: crate::sound::waveform::SensitivityError| failed(error.to_string()))?)
    };
    let unit = unit.parse().map_err(|error: crate::sound::waveform::UnitError| failed(error.to_string()))?;
    Ok(Channel { name: channel.clone(), sample_rate_hz: *sample_rate_hz, unit, sensitivity })
}

/// A squeal that lasts, and the prediction it is compared with.
struct Lasting {
    began: Squeal,
    chosen: Option<InForce>,
    /// Whether all predictions within the time tolerance have been considered.
    decided: bool,
}

struct SearchedChannel {
    channel: Channel,
    detector: Detector,
    /// Squeals of earlier detectors of this channel, and of all.
    earlier: u64,
    squeals: u64,
    lasting: BTreeMap<u64, Lasting>,
    bus: Bus,
    received_ns: u64,
    /// Counts of earlier detectors.
    counts_before: ChannelReport,
}

/// State of the thread.
struct Search {
    options: SoundOptions,
    /// Records the samples, if that was asked for.
    recorder: Option<RecorderHandle>,
    criteria: Criteria,
    channels: BTreeMap<String, SearchedChannel>,
    shared: Arc<Shared>,
    found: Vec<Detection>,
    /// Hands a squeal to the node; returns whether it was accepted.
    send: Box<dyn FnMut(Heard) -> bool + Send>,
}

impl Search {
    fn run(&mut self, blocks: &Receiver<Item>) -> Vec<Heard> {
        for item in blocks {
            match item {
                Item::Stop => break,
                Item::Block(_) if self.shared.stopping.load(Ordering::Relaxed) => {
                    self.shared.lost.fetch_add(1, Ordering::Relaxed);
                }
                Item::Block(received) => {
                    if let Err(why) = self.block(received) {
                        let mut report = self.shared.report();
                        report.refused += 1;
                        report.why_refused = Some(why);
                    }
                }
            }
        }
        let names: Vec<String> = self.channels.keys().cloned().collect();
        names.iter().flat_map(|name| self.finish(name)).collect()
    }

    /// Ends the squeals of a channel that last.
    fn finish(&mut self, name: &str) -> Vec<Heard> {
        let Some(searched) = self.channels.get_mut(name) else { return vec![] };
        searched.detector.finish(&mut self.found);
        self.found.drain(..).map(|detection| searched.heard(detection, &self.shared, &self.criteria)).collect()
    }

    /// Searches a block.
    ///
    /// # Errors
    /// Why it cannot be searched.
    fn block(&mut self, received: Received<Waveform>) -> Result<(), String> {
        let Received { bus, at, message } = received;
        if message.samples.is_empty() {
            return Err(format!("channel `{}`: a block without samples", message.channel));
        }
        if let Some(searched) = self.channels.get_mut(&message.channel) {
            let silent_ns = at.monotonic_ns.saturating_sub(searched.received_ns);
            if searched.bus != bus && silent_ns < OTHER_BUS_AFTER_NS {
                self.shared.report().duplicates += 1;
                return Ok(());
            }
            (searched.bus, searched.received_ns) = (bus, at.monotonic_ns);
        }
        let channel = channel_of(&message)?;
        if self.channels.get(&message.channel).is_none_or(|searched| searched.channel != channel) {
            self.begin(channel, bus, at.monotonic_ns)?;
        }
        let Some(searched) = self.channels.get_mut(&message.channel) else { return Ok(()) };
        let stamp_ns = message.header.stamp.as_ns();
        searched.detector.push(stamp_ns, &message.samples, &mut self.found);
        let interruptions = searched.detector.take_interruptions();
        let found: Vec<Heard> =
            self.found.drain(..).map(|detection| searched.heard(detection, &self.shared, &self.criteria)).collect();
        let until_ns =
            crate::sound::waveform::stamp_ns(stamp_ns, message.samples.len() as u64, searched.channel.sample_rate_hz);
        searched.decide(until_ns, &self.shared, &self.criteria);
        let state = searched.report();
        if let Some(recorder) = &self.recorder {
            if recorder.queued() < MOST_WAITING_FOR_RECORDER {
                record(recorder, at, Payload::Waveform(message));
            } else {
                self.shared.report().unrecorded += 1;
            }
        }
        self.report(state, &interruptions);
        self.publish(found);
        Ok(())
    }

    /// Begins to search a channel, or begins anew because it has changed.
    fn begin(&mut self, channel: Channel, bus: Bus, received_ns: u64) -> Result<(), String> {
        if self.channels.len() >= MOST_CHANNELS && !self.channels.contains_key(&channel.name) {
            return Err(format!("channel `{}`: there are {MOST_CHANNELS} channels already", channel.name));
        }
        let detector = Detector::new(&channel, self.options.settings).map_err(|error| error.to_string())?;
        let ended = self.finish(&channel.name);
        self.publish(ended);
        let before = self.channels.remove(&channel.name);
        let counts_before = before.as_ref().map(SearchedChannel::report).unwrap_or_default();
        let earlier = before.map_or(0, |before| before.squeals);
        let searched = SearchedChannel {
            detector,
            earlier,
            squeals: earlier,
            lasting: BTreeMap::new(),
            bus,
            received_ns,
            counts_before,
            channel: channel.clone(),
        };
        self.channels.insert(channel.name, searched);
        Ok(())
    }

    fn publish(&mut self, found: Vec<Heard>) {
        for heard in found {
            if !(self.send)(heard) {
                self.shared.report().unpublished += 1;
            }
        }
    }

    fn report(&self, state: ChannelReport, interruptions: &[Interruption]) {
        let mut report = self.shared.report();
        report.interruption_count += interruptions.len() as u64;
        for interruption in interruptions {
            if report.interruptions.len() < MOST_NAMED {
                report.interruptions.push(format!("{}: {interruption}", state.name));
            }
        }
        match report.channels.iter_mut().find(|known| known.name == state.name) {
            Some(known) => *known = state,
            None => report.channels.push(state),
        }
    }
}

impl SearchedChannel {
    /// The message about a finding.
    fn heard(&mut self, detection: Detection, shared: &Shared, criteria: &Criteria) -> Heard {
        let choose = |squeal: &Squeal| {
            let predictions = shared.predictions.lock().unwrap_or_else(PoisonError::into_inner);
            in_force::choose(squeal, predictions.iter(), criteria)
        };
        let (squeal, state, chosen) = match detection {
            Detection::Began(squeal) => {
                let chosen = choose(&squeal);
                self.lasting.insert(squeal.number, Lasting { began: squeal, chosen, decided: false });
                self.squeals = self.earlier + squeal.number;
                (squeal, heard_state::BEGAN, chosen)
            }
            Detection::Ended(squeal) => {
                let decided = self.lasting.remove(&squeal.number).filter(|lasting| lasting.decided);
                (squeal, heard_state::ENDED, decided.map_or_else(|| choose(&squeal), |lasting| lasting.chosen))
            }
        };
        let quantity = self.detector.quantity();
        in_force::message(&self.channel.name, quantity, self.earlier, &squeal, state, chosen.as_ref(), criteria)
    }

    /// Chooses the predictions of lasting squeals once more, when all within the time tolerance have been made: samples
    /// up to `until_ns` have been received.
    fn decide(&mut self, until_ns: i64, shared: &Shared, criteria: &Criteria) {
        let tolerance_ns = (criteria.time_tolerance_s * 1e9) as i64;
        for lasting in self.lasting.values_mut().filter(|lasting| !lasting.decided) {
            if until_ns > lasting.began.onset_ns.saturating_add(tolerance_ns) {
                let predictions = shared.predictions.lock().unwrap_or_else(PoisonError::into_inner);
                lasting.chosen = in_force::choose(&lasting.began, predictions.iter(), criteria);
                lasting.decided = true;
            }
        }
    }

    fn report(&self) -> ChannelReport {
        let Counts { samples, missing, repeated, not_finite, .. } = self.detector.counts();
        let before = &self.counts_before;
        ChannelReport {
            name: self.channel.name.clone(),
            sample_rate_hz: self.channel.sample_rate_hz,
            samples: before.samples + samples,
            missing: before.missing.saturating_add(*missing),
            repeated: before.repeated + repeated,
            not_finite: before.not_finite + not_finite,
            squeals: self.squeals,
        }
    }
}

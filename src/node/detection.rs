//! Searches received samples for squeal, on a thread of its own, so that no prediction waits for it.
//!
//! Blocks of samples come through a bounded queue; blocks that do not fit are lost and counted, and the stamps of the next
//! block show the gap. Each channel has a [`ChannelSearch`]. What it finds depends on the samples and their stamps alone, so it
//! is found again in recorded samples, bit for bit. Squeals are compared with the predictions of that time
//! ([`crate::sound::in_force`]) and handed to the node's queue to be published.

use std::collections::{BTreeMap, VecDeque};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;

use crossbeam_channel::{Receiver, Sender, bounded};

use super::Incoming;
use super::outputs::record;
use super::sound_view::SoundView;
use super::watch::fastest_modes;
use crate::bus::{Bus, Received};
use crate::msgs::{Heard, Prediction, Waveform, level};
use crate::recording::message::Payload;
use crate::recording::recorder::RecorderHandle;
use crate::sound::in_force::{self, InForce};
use crate::sound::matching::{Criteria, Unstable};
use crate::sound::search::{ChannelSearch, channel_of};
use crate::sound::{Channel, Counts, Interruption, Settings, Squeal};

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
    pub fn start(self, node: Sender<Incoming>, recorder: Option<RecorderHandle>, view: Arc<SoundView>) -> Running {
        let Self { blocks, inlet, options } = self;
        let mut search = Search {
            options,
            recorder: recorder.filter(|_| options.record_samples),
            criteria: Criteria::default(),
            view,
            channels: BTreeMap::new(),
            shared: inlet.shared.clone(),
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

/// A channel that is searched, and where its blocks come from.
struct SearchedChannel {
    search: ChannelSearch,
    bus: Bus,
    received_ns: u64,
}

/// State of the thread.
struct Search {
    options: SoundOptions,
    /// Records the samples, if that was asked for.
    recorder: Option<RecorderHandle>,
    criteria: Criteria,
    /// What displays see of the samples.
    view: Arc<SoundView>,
    channels: BTreeMap<String, SearchedChannel>,
    shared: Arc<Shared>,
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
        self.channels.values_mut().flat_map(|searched| searched.search.finish(choose(&self.shared))).collect()
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
        if self.channels.get(&message.channel).is_none_or(|searched| *searched.search.channel() != channel) {
            self.begin(channel, bus, at.monotonic_ns)?;
        }
        let Some(searched) = self.channels.get_mut(&message.channel) else { return Ok(()) };
        let found = searched.search.push(message.header.stamp.as_ns(), &message.samples, choose(&self.shared));
        let interruptions = searched.search.take_interruptions();
        let band_hz = self.options.settings.band_hz;
        self.view.push(searched.search.channel(), band_hz, message.header.stamp.as_ns(), &message.samples);
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
        match self.channels.get_mut(&channel.name) {
            Some(known) => {
                let ended = known.search.change(channel, choose(&self.shared)).map_err(|error| error.to_string())?;
                self.publish(ended);
            }
            None => {
                let name = channel.name.clone();
                let search = ChannelSearch::new(channel, self.options.settings, self.criteria);
                let search = search.map_err(|error| error.to_string())?;
                self.channels.insert(name, SearchedChannel { search, bus, received_ns });
            }
        }
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

/// The prediction among those kept that a squeal is compared with.
fn choose(shared: &Shared) -> impl Fn(&Squeal, &Criteria) -> Option<InForce> + '_ {
    |squeal, criteria| {
        let predictions = shared.predictions.lock().unwrap_or_else(PoisonError::into_inner);
        in_force::choose(squeal, predictions.iter(), criteria)
    }
}

impl SearchedChannel {
    fn report(&self) -> ChannelReport {
        let Counts { samples, missing, repeated, not_finite, .. } = self.search.counts();
        let Channel { name, sample_rate_hz, .. } = self.search.channel().clone();
        ChannelReport { name, sample_rate_hz, samples, missing, repeated, not_finite, squeals: self.search.squeals() }
    }
}

//! A tone followed from frame to frame: its frequencies, its levels and its steady part.

use std::collections::BTreeMap;

use crate::sound::Growth;
use crate::sound::spectrum::Tone;

/// The level of a tone has risen if its power has grown by this factor (0.5 dB).
const RISE: f64 = 1.122;
/// Frames from which the frequency at the onset is computed.
const EARLY_FRAMES: u64 = 8;
/// The steady part of a squeal: within 3 dB of its highest level, in steps of 0.25 dB.
const STEPS_PER_DB: f64 = 4.0;
const STEADY_STEPS: i32 = 12;

/// A tone of a frame that is above the threshold.
#[derive(Clone, Copy)]
pub(super) struct Found {
    pub(super) tone: Tone,
    pub(super) frequency_hz: f64,
    /// Mean square with the frequency weighting.
    pub(super) weighted: f64,
    /// Noise in its bin.
    pub(super) noise: f64,
}

/// A tone followed from frame to frame.
pub(super) struct Track {
    pub(super) first_frame: u64,
    pub(super) last_frame: u64,
    /// Frames in which it was found.
    pub(super) hits: u64,
    pub(super) frequency_hz: f64,
    /// Weighted and plain mean square of the loudest frame.
    pub(super) highest: f64,
    pub(super) highest_plain: f64,
    /// Latest frame in which the level rose, and its mean square.
    pub(super) rose_frame: u64,
    rose_to: f64,
    /// Tone and noise when first found.
    pub(super) first: Found,
    /// The first frames: the frequency may drift later.
    pub(super) early: Level,
    /// Frames by level, in steps of 0.25 dB.
    levels: BTreeMap<i32, Level>,
    /// Set when it is announced.
    pub(super) number: Option<u64>,
    /// Set when it has saturated.
    pub(super) onset: Option<Onset>,
}

/// Frames of a tone, with the sums of its weighted mean square and of that times its frequency.
#[derive(Clone, Copy, Default)]
pub(super) struct Level {
    frames: u64,
    pub(super) power: f64,
    pub(super) power_times_hz: f64,
}

/// The onset of a squeal; `cut` if samples are missing there.
#[derive(Clone, Copy)]
pub(super) struct Onset {
    pub(super) stamp_ns: i64,
    pub(super) cut: bool,
    pub(super) growth: Option<Growth>,
}

/// A squeal that has ended, with its first and last frame.
pub(super) struct Ended {
    pub(super) number: u64,
    pub(super) frames: [u64; 2],
    pub(super) frequency_hz: f64,
}

impl Level {
    fn add(&mut self, tone: &Found) {
        self.frames += 1;
        self.power += tone.weighted;
        self.power_times_hz += tone.weighted * tone.frequency_hz;
    }
}

impl Track {
    pub(super) fn new(frame: u64, tone: Found) -> Self {
        let mut track = Self {
            first_frame: frame,
            last_frame: frame,
            hits: 0,
            frequency_hz: tone.frequency_hz,
            highest: 0.0,
            highest_plain: 0.0,
            rose_frame: frame,
            rose_to: 0.0,
            first: tone,
            early: Level::default(),
            levels: BTreeMap::new(),
            number: None,
            onset: None,
        };
        track.continue_with(frame, &tone);
        track
    }

    pub(super) fn continue_with(&mut self, frame: u64, tone: &Found) {
        self.last_frame = frame;
        self.hits += 1;
        self.frequency_hz = tone.frequency_hz;
        if tone.weighted > self.highest {
            (self.highest, self.highest_plain) = (tone.weighted, tone.tone.power);
        }
        if tone.weighted > RISE * self.rose_to {
            (self.rose_frame, self.rose_to) = (frame, tone.weighted);
        }
        if self.hits <= EARLY_FRAMES {
            self.early.add(tone);
        }
        let step = (STEPS_PER_DB * 10.0 * tone.weighted.log10()).floor() as i32;
        self.levels.entry(step).or_default().add(tone);
    }

    /// Mean frequency, Hz, and mean weighted square of the steady part.
    pub(super) fn steady(&self) -> (f64, f64) {
        let highest = self.levels.keys().next_back().copied().unwrap_or_default();
        let mut sum = Level::default();
        for level in self.levels.range(highest - STEADY_STEPS..).map(|(_, level)| level) {
            sum.frames += level.frames;
            sum.power += level.power;
            sum.power_times_hz += level.power_times_hz;
        }
        (sum.power_times_hz / sum.power, sum.power / sum.frames as f64)
    }
}

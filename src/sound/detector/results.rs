//! What a detector finds in a stream, and what it counts.

use std::fmt;

use crate::sound::Growth;

/// Most interruptions that are named; later ones are counted.
pub const MOST_NAMED: usize = 100;

/// A squeal: a tone above the threshold from `onset_ns` to `end_ns`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Squeal {
    /// Counts the squeals of a detector in the order in which they are announced.
    pub number: u64,
    /// When the level of the tone passes the threshold.
    pub onset_ns: i64,
    /// When it falls below; the latest frame, while it lasts.
    pub end_ns: i64,
    /// Whether samples are missing at the onset or the end: at the ends of the stream and at gaps.
    pub cut: [bool; 2],
    /// Mean over the steady part: the frames within 3 dB of the highest level.
    pub frequency_hz: f64,
    /// Level of the mean square of the steady part, dB(A) re 20 µPa or dB re 1 µm/s².
    pub level_db: f64,
    /// Highest level of a frame.
    pub peak_level_db: f64,
    /// Ratio of the tone to the noise in its bin at the onset, dB.
    pub prominence_db: f64,
    /// Growth at the onset; `None` if it cannot be measured.
    pub growth: Option<Growth>,
    /// The squeal of which it is a harmonic.
    pub harmonic: Option<Harmonic>,
}

#[cfg(test)]
impl Squeal {
    /// A squeal of 90 dB that is no harmonic, for tests.
    pub fn of_90_db(onset_ns: i64, end_ns: i64, frequency_hz: f64) -> Self {
        Self {
            number: 1,
            onset_ns,
            end_ns,
            cut: [false; 2],
            frequency_hz,
            level_db: 90.0,
            peak_level_db: 91.0,
            prominence_db: 20.0,
            growth: None,
            harmonic: None,
        }
    }
}

/// A squeal at a multiple of the frequency of another.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Harmonic {
    /// At least 2.
    pub order: u32,
    /// Number of the squeal that is the fundamental.
    pub of: u64,
}

/// A finding of a detector.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Detection {
    /// A tone has lasted long enough. Its values are those so far.
    Began(Squeal),
    /// A squeal is over.
    Ended(Squeal),
}

impl Detection {
    /// The squeal, if it is over.
    pub fn ended(self) -> Option<Squeal> {
        match self {
            Self::Ended(squeal) => Some(squeal),
            Self::Began(_) => None,
        }
    }
}

/// An interruption of a stream.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Interruption {
    /// Samples are missing; squeals end there.
    Gap { after_ns: i64, samples: u64 },
    /// Samples came twice; the later ones are ignored.
    Overlap { at_ns: i64, samples: u64 },
    /// The stamps went back by more than a second; squeals end there.
    Restart { after_ns: i64, at_ns: i64 },
}

impl fmt::Display for Interruption {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let s = |ns: i64| ns as f64 * 1e-9;
        match *self {
            Self::Gap { after_ns, samples } => write!(f, "{samples} samples are missing after {:.6} s", s(after_ns)),
            Self::Overlap { at_ns, samples } => write!(f, "{samples} samples came twice at {:.6} s", s(at_ns)),
            Self::Restart { after_ns, at_ns } => {
                write!(f, "the stamps went back from {:.6} to {:.6} s", s(after_ns), s(at_ns))
            }
        }
    }
}

/// Counts of what a detector received.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Counts {
    /// Samples searched for squeal.
    pub samples: u64,
    /// Missing samples, at gaps.
    pub missing: u64,
    /// Ignored samples, at overlaps.
    pub repeated: u64,
    /// Samples that are not finite; replaced by 0.
    pub not_finite: u64,
    pub interruptions: u64,
    /// The first [`MOST_NAMED`] interruptions.
    pub named: Vec<Interruption>,
    /// Tones that were not followed because there were more than 64 at a time.
    pub tones_not_followed: u64,
}

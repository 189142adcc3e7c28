//! The last minutes in bins of equal length, each with the ranges of the values in it.

use std::collections::VecDeque;

use serde::{Serialize, Serializer};

use super::events::seconds;
use crate::node::{SAMPLE_MODES, Sample, UnstableMode, VibrationSample};

/// Quantities with a range in every bin, in the order of [`Bin::ranges`].
pub const QUANTITIES: [&str; 5] = ["load", "speed", "mu", "growth", "margin"];

/// Usual upper limit on the JSON of a bin, bytes.
const BIN_JSON: usize = 256;

/// Values of one interval of time.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Bin {
    /// Number of the bin: its start time divided by the bin length.
    #[serde(rename = "k")]
    pub index: i64,
    /// Smallest and largest value of each quantity; `null` without values.
    #[serde(rename = "r")]
    pub ranges: [Option<(f32, f32)>; QUANTITIES.len()],
    /// The most severe level; `null` without a prediction.
    #[serde(rename = "l")]
    pub level: Option<u8>,
    /// Frequency and growth rate of the unstable modes at the moment of the largest growth rate.
    #[serde(rename = "u", serialize_with = "present")]
    pub unstable: [Option<(f32, f32)>; SAMPLE_MODES],
    /// The measured vibration.
    #[serde(rename = "v", skip_serializing_if = "Option::is_none")]
    pub vibration: Option<Vibration>,
    /// Smallest and largest temperature of the contact, °C.
    #[serde(rename = "t", skip_serializing_if = "Option::is_none")]
    pub temperature_c: Option<(f32, f32)>,
}

/// Smallest and largest level of the measured vibration, and the frequency at the largest.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Vibration {
    #[serde(rename = "lo")]
    pub low_db: f32,
    #[serde(rename = "hi")]
    pub high_db: f32,
    #[serde(rename = "hz")]
    pub frequency_hz: f32,
}

impl Vibration {
    fn merge(self, other: Self) -> Self {
        let louder = if other.high_db > self.high_db { other } else { self };
        Self { low_db: self.low_db.min(other.low_db), ..louder }
    }
}

/// The range of two ranges.
pub fn both(a: Option<(f32, f32)>, b: Option<(f32, f32)>) -> Option<(f32, f32)> {
    match (a, b) {
        (Some(a), Some(b)) => Some((a.0.min(b.0), a.1.max(b.1))),
        (a, b) => a.or(b),
    }
}

/// Serialises the entries that are present.
fn present<S: Serializer>(unstable: &[Option<(f32, f32)>; SAMPLE_MODES], serializer: S) -> Result<S::Ok, S::Error> {
    serializer.collect_seq(unstable.iter().flatten())
}

impl Bin {
    fn empty(index: i64) -> Self {
        let ranges = [None; QUANTITIES.len()];
        Self { index, ranges, level: None, unstable: [None; SAMPLE_MODES], vibration: None, temperature_c: None }
    }

    fn merge(&mut self, other: Self) {
        let growth = |bin: &Self| bin.ranges[3].map_or(f32::NEG_INFINITY, |(_, high)| high);
        if growth(&other) > growth(self) {
            self.unstable = other.unstable;
        }
        for (range, other) in self.ranges.iter_mut().zip(other.ranges) {
            *range = both(*range, other);
        }
        self.temperature_c = both(self.temperature_c, other.temperature_c);
        self.level = self.level.max(other.level);
        self.vibration = match (self.vibration, other.vibration) {
            (Some(a), Some(b)) => Some(a.merge(b)),
            (a, b) => a.or(b),
        };
    }
}

/// Bins up to now, of which the last is still open. Either the latest bins are kept, or all of them with increasing
/// length.
#[derive(Clone, Debug)]
pub struct History {
    bin_ns: i64,
    capacity: usize,
    coarsens: bool,
    bins: VecDeque<Bin>,
}

impl History {
    /// Keeps the latest `capacity` bins of length `bin_ns`.
    pub fn new(bin_ns: i64, capacity: usize) -> Self {
        assert!(bin_ns > 0 && capacity > 0, "bins of {bin_ns} ns, {capacity} of them");
        // Written once, so that the memory is resident from the start and does not grow as the history fills.
        let mut bins: VecDeque<Bin> = (0..capacity).map(|_| Bin::empty(0)).collect();
        bins.clear();
        Self { bin_ns, capacity, coarsens: false, bins }
    }

    /// Keeps everything in at most `capacity` bins: their length starts at `bin_ns` and doubles when necessary.
    pub fn coarsening(bin_ns: i64, capacity: usize) -> Self {
        assert!(capacity > 1, "{capacity} bins that are to be merged");
        Self { coarsens: true, ..Self::new(bin_ns, capacity) }
    }

    /// Merges pairs of bins until there are fewer than the capacity.
    fn coarsen(&mut self) {
        while self.bins.len() >= self.capacity {
            self.bin_ns *= 2;
            let mut coarse: VecDeque<Bin> = VecDeque::with_capacity(self.capacity);
            for mut bin in self.bins.drain(..) {
                bin.index = bin.index.div_euclid(2);
                match coarse.back_mut().filter(|last| last.index == bin.index) {
                    Some(last) => last.merge(bin),
                    None => coarse.push_back(bin),
                }
            }
            self.bins = coarse;
        }
    }

    /// Length of a bin, ns.
    pub fn bin_ns(&self) -> i64 {
        self.bin_ns
    }

    /// All bins, oldest first.
    pub fn bins(&self) -> &VecDeque<Bin> {
        &self.bins
    }

    /// The history as JSON, serialised directly: an intermediate tree would take many times the memory.
    pub fn to_json(&self) -> String {
        #[derive(Serialize)]
        struct Whole<'a> {
            bin_s: f64,
            bins: &'a VecDeque<Bin>,
        }
        // Reserves the memory of a full history from the start, so that the allocator's share does not grow.
        let mut text = Vec::with_capacity(64 + BIN_JSON * self.capacity);
        // Only numbers, so serialisation cannot fail.
        let whole = Whole { bin_s: seconds(self.bin_ns), bins: &self.bins };
        serde_json::to_writer(&mut text, &whole).ok().and_then(|()| String::from_utf8(text).ok()).unwrap_or_default()
    }

    /// The bins from number `index` on.
    pub fn since(&self, index: i64) -> impl Iterator<Item = &Bin> {
        self.bins.range(self.bins.partition_point(|bin| bin.index < index)..)
    }

    /// The bin of a time. A time before the latest bin is put into the latest bin.
    fn bin(&mut self, time_ns: i64) -> Option<&mut Bin> {
        let mut index = time_ns.div_euclid(self.bin_ns);
        if self.coarsens && self.bins.len() == self.capacity && self.bins.back().is_none_or(|last| last.index < index) {
            self.coarsen();
            index = time_ns.div_euclid(self.bin_ns);
        }
        if self.bins.back().is_none_or(|last| last.index < index) {
            if self.bins.len() == self.capacity {
                self.bins.pop_front();
            }
            self.bins.push_back(Bin::empty(index));
        }
        self.bins.back_mut()
    }

    /// Adds a measured vibration.
    pub fn push_vibration(&mut self, sample: &VibrationSample) {
        let (level_db, frequency_hz) = (sample.level_db as f32, sample.frequency_hz as f32);
        let Some(bin) = self.bin(sample.time_ns).filter(|_| level_db.is_finite() && frequency_hz.is_finite()) else {
            return;
        };
        let new = Vibration { low_db: level_db, high_db: level_db, frequency_hz };
        bin.vibration = Some(bin.vibration.map_or(new, |before| before.merge(new)));
    }

    /// Adds a temperature of the contact, °C.
    pub fn push_temperature(&mut self, time_ns: i64, celsius: f64) {
        let celsius = celsius as f32;
        if let Some(bin) = self.bin(time_ns).filter(|_| celsius.is_finite()) {
            bin.temperature_c = both(bin.temperature_c, Some((celsius, celsius)));
        }
    }

    /// The latest temperature before the end of the bin of `time_s`, with the end of its own bin, s; `None` before the first.
    pub fn temperature_before(&self, time_s: f64) -> Option<(f64, f64)> {
        let bin_s = seconds(self.bin_ns);
        let until = self.bins.partition_point(|bin| bin.index as f64 * bin_s <= time_s);
        let known = self.bins.range(..until).rev().find_map(|bin| Some((bin, bin.temperature_c?)));
        known.map(|(bin, (low, high))| ((bin.index + 1) as f64 * bin_s, 0.5 * f64::from(low + high)))
    }

    /// Adds a sample.
    pub fn push(&mut self, sample: &Sample) {
        let Some(bin) = self.bin(sample.time_ns) else { return };
        let values = [
            sample.normal_load_n,
            sample.disc_speed_rad_s,
            sample.friction_coefficient,
            sample.max_growth_rate_per_s,
            sample.friction_margin,
        ];
        let fastest = bin.ranges[3].map_or(f32::NEG_INFINITY, |(_, high)| high);
        for (range, value) in bin.ranges.iter_mut().zip(values) {
            let value = value as f32;
            if value.is_finite() {
                let (low, high) = range.unwrap_or((value, value));
                *range = Some((low.min(value), high.max(value)));
            }
        }
        bin.level = bin.level.max(sample.status.level());
        if sample.max_growth_rate_per_s as f32 >= fastest && sample.unstable_modes > 0 {
            let shown = |mode: UnstableMode| (mode.frequency_hz as f32, mode.growth_rate_per_s as f32);
            bin.unstable = sample.unstable.map(|mode| mode.map(shown));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::display::events::tests::sample;
    use crate::msgs::level;
    use crate::node::status::Status;

    #[test]
    fn bins_hold_ranges_and_the_gravest_level_and_are_bounded() {
        let mut history = History::new(100, 3);
        for (time_ns, mu, at) in [(0, 0.3, Status::Ok), (50, 0.1, Status::Squeal), (99, 0.2, Status::Warn)] {
            history.push(&sample(time_ns, mu, at));
        }
        assert_eq!(history.bins().len(), 1);
        let bin = &history.bins()[0];
        assert_eq!((bin.index, bin.level), (0, Some(level::SQUEAL)));
        assert_eq!(bin.ranges[2], Some((0.1, 0.3)));
        history.push(&sample(100, f64::NAN, Status::Fault));
        assert_eq!(history.bins()[1].ranges[2], None, "a quantity that is not known has no range");
        history.push(&sample(20, 0.4, Status::Ok));
        assert_eq!((history.bins().len(), history.bins()[1].ranges[2]), (2, Some((0.4, 0.4))), "time ran backward");
        for time_ns in [1000, 2000] {
            history.push(&sample(time_ns, 0.5, Status::Ok));
        }
        assert_eq!(history.bins().iter().map(|bin| bin.index).collect::<Vec<_>>(), [1, 10, 20]);
        assert_eq!(history.since(2).count(), 2);
    }

    #[test]
    fn coarsening_loses_no_extremes() {
        let mut history = History::coarsening(10, 8);
        let values: Vec<f64> = (0..1000).map(|k| f64::from(k * 37 % 101)).collect();
        for (k, &mu) in values.iter().enumerate() {
            history.push(&sample(k as i64, mu, if k == 500 { Status::Fault } else { Status::Ok }));
        }
        assert!(history.bins().len() <= 8 && history.bin_ns() == 160, "{} ns", history.bin_ns());
        for bin in history.bins() {
            let of_bin = |k: &usize| (*k as i64).div_euclid(160) == bin.index;
            let inside: Vec<f64> = (0..1000).filter(of_bin).map(|k| values[k]).collect();
            let extreme = |f: fn(f64, f64) -> f64| inside.iter().copied().reduce(f).unwrap() as f32;
            assert_eq!(bin.ranges[2], Some((extreme(f64::min), extreme(f64::max))));
            assert_eq!(bin.level == Some(level::FAULT), bin.index == 500 / 160);
        }
    }

    #[test]
    fn a_bin_shows_the_modes_of_its_fastest_growth() {
        let mut history = History::new(100, 3);
        let mut slow = sample(0, 0.5, Status::Squeal);
        slow.max_growth_rate_per_s = 0.1;
        let mut fast = slow.clone();
        fast.max_growth_rate_per_s = 2.0;
        fast.unstable[0].as_mut().unwrap().frequency_hz = 77.0;
        for sample in [&slow, &fast, &slow] {
            history.push(sample);
        }
        assert_eq!(history.bins()[0].unstable, [Some((77.0, 1.0)), None, None, None]);
        let json = serde_json::to_value(&history.bins()[0]).unwrap();
        assert_eq!(json["u"], serde_json::json!([[77.0, 1.0]]));
        assert!(json.get("v").is_none(), "nothing was measured");
    }

    #[test]
    fn a_bin_holds_the_range_of_the_measured_level_and_where_it_was_loudest() {
        let sample = |time_ns, frequency_hz, level_db| VibrationSample { time_ns, frequency_hz, level_db };
        let mut history = History::coarsening(100, 4);
        for (time_ns, hz, db) in [(0, 10.0, 50.0), (50, 20.0, 90.0), (99, 30.0, 40.0), (100, 40.0, f64::NAN)] {
            history.push_vibration(&sample(time_ns, hz, db));
        }
        let known = Vibration { low_db: 40.0, high_db: 90.0, frequency_hz: 20.0 };
        assert_eq!((history.bins()[0].vibration, history.bins()[0].level), (Some(known), None));
        assert_eq!(history.bins()[1].vibration, None);
        for time_ns in [200, 300, 400] {
            history.push_vibration(&sample(time_ns, 50.0, 30.0));
        }
        assert_eq!((history.bin_ns(), history.bins()[0].vibration), (200, Some(known)));
    }
}

//! The last minutes as bins of equal length, each with the range of what fell into it.

use std::collections::VecDeque;

use serde::Serialize;

use crate::node::Sample;

/// Quantities with a range in every bin, in the order of [`Bin::ranges`].
pub const QUANTITIES: [&str; 5] = ["load", "speed", "mu", "growth", "margin"];

/// A stretch of time.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Bin {
    /// Number of the bin: its beginning over the length of a bin.
    #[serde(rename = "k")]
    pub index: i64,
    /// Smallest and largest of each quantity; `null` where there was none.
    #[serde(rename = "r")]
    pub ranges: [Option<(f32, f32)>; QUANTITIES.len()],
    /// The gravest level.
    #[serde(rename = "l")]
    pub level: u8,
    /// Frequency and growth rate of the unstable modes at the moment of the fastest growth.
    #[serde(rename = "u")]
    pub unstable: Vec<(f32, f32)>,
}

impl Bin {
    fn merge(&mut self, other: Self) {
        let growth = |bin: &Self| bin.ranges[3].map_or(f32::NEG_INFINITY, |(_, high)| high);
        if growth(&other) > growth(self) {
            self.unstable = other.unstable;
        }
        for (range, other) in self.ranges.iter_mut().zip(other.ranges) {
            *range = match (*range, other) {
                (Some(a), Some(b)) => Some((a.0.min(b.0), a.1.max(b.1))),
                (a, b) => a.or(b),
            };
        }
        self.level = self.level.max(other.level);
    }
}

/// Bins up to now, the last of them still open: the latest ones, or all, longer and longer.
#[derive(Clone, Debug)]
pub struct History {
    bin_ns: i64,
    capacity: usize,
    coarsens: bool,
    bins: VecDeque<Bin>,
}

impl History {
    /// At most `capacity` bins of `bin_ns`.
    pub fn new(bin_ns: i64, capacity: usize) -> Self {
        assert!(bin_ns > 0 && capacity > 0, "bins of {bin_ns} ns, {capacity} of them");
        Self { bin_ns, capacity, coarsens: false, bins: VecDeque::new() }
    }

    /// At most `capacity` bins of `bin_ns` or longer, so that nothing has to be forgotten.
    pub fn coarsening(bin_ns: i64, capacity: usize) -> Self {
        assert!(capacity > 1, "{capacity} bins that are to be merged");
        Self { coarsens: true, ..Self::new(bin_ns, capacity) }
    }

    /// Makes two bins one until there are fewer than may be.
    fn coarsen(&mut self) {
        while self.bins.len() >= self.capacity {
            self.bin_ns *= 2;
            let mut coarse: VecDeque<Bin> = VecDeque::new();
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

    /// The bins from `index` on.
    pub fn since(&self, index: i64) -> impl Iterator<Item = &Bin> {
        self.bins.range(self.bins.partition_point(|bin| bin.index < index)..)
    }

    /// Takes a sample in. Time that runs backward stays in the latest bin.
    pub fn push(&mut self, sample: &Sample) {
        let mut index = sample.time_ns.div_euclid(self.bin_ns);
        if self.coarsens && self.bins.len() == self.capacity && self.bins.back().is_none_or(|last| last.index < index) {
            self.coarsen();
            index = sample.time_ns.div_euclid(self.bin_ns);
        }
        if self.bins.back().is_none_or(|last| last.index < index) {
            if self.bins.len() == self.capacity {
                self.bins.pop_front();
            }
            self.bins.push_back(Bin { index, ranges: [None; QUANTITIES.len()], level: sample.level, unstable: vec![] });
        }
        let Some(bin) = self.bins.back_mut() else { return };
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
        bin.level = bin.level.max(sample.level);
        if sample.max_growth_rate_per_s as f32 >= fastest && sample.unstable_modes > 0 {
            bin.unstable.clear();
            let modes = sample.unstable.iter().flatten();
            bin.unstable.extend(modes.map(|mode| (mode.frequency_hz as f32, mode.growth_rate_per_s as f32)));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::display::events::tests::sample;
    use crate::wire::level;

    #[test]
    fn bins_hold_ranges_and_the_gravest_level_and_are_bounded() {
        let mut history = History::new(100, 3);
        for (time_ns, mu, at) in [(0, 0.3, level::OK), (50, 0.1, level::SQUEAL), (99, 0.2, level::WARN)] {
            history.push(&sample(time_ns, mu, at));
        }
        assert_eq!(history.bins().len(), 1);
        let bin = &history.bins()[0];
        assert_eq!((bin.index, bin.level), (0, level::SQUEAL));
        assert_eq!(bin.ranges[2], Some((0.1, 0.3)));
        history.push(&sample(100, f64::NAN, level::FAULT));
        assert_eq!(history.bins()[1].ranges[2], None, "a quantity that is not known has no range");
        history.push(&sample(20, 0.4, level::OK));
        assert_eq!((history.bins().len(), history.bins()[1].ranges[2]), (2, Some((0.4, 0.4))), "time ran backward");
        for time_ns in [1000, 2000] {
            history.push(&sample(time_ns, 0.5, level::OK));
        }
        assert_eq!(history.bins().iter().map(|bin| bin.index).collect::<Vec<_>>(), [1, 10, 20]);
        assert_eq!(history.since(2).count(), 2);
    }

    #[test]
    fn coarsening_loses_no_extremes() {
        let mut history = History::coarsening(10, 8);
        let values: Vec<f64> = (0..1000).map(|k| f64::from(k * 37 % 101)).collect();
        for (k, &mu) in values.iter().enumerate() {
            history.push(&sample(k as i64, mu, if k == 500 { level::FAULT } else { level::OK }));
        }
        assert!(history.bins().len() <= 8 && history.bin_ns() == 160, "{} ns", history.bin_ns());
        for bin in history.bins() {
            let of_bin = |k: &usize| (*k as i64).div_euclid(160) == bin.index;
            let inside: Vec<f64> = (0..1000).filter(of_bin).map(|k| values[k]).collect();
            let extreme = |f: fn(f64, f64) -> f64| inside.iter().copied().reduce(f).unwrap() as f32;
            assert_eq!(bin.ranges[2], Some((extreme(f64::min), extreme(f64::max))));
            assert_eq!(bin.level == level::FAULT, bin.index == 500 / 160);
        }
    }

    #[test]
    fn a_bin_shows_the_modes_of_its_fastest_growth() {
        let mut history = History::new(100, 3);
        let mut slow = sample(0, 0.5, level::SQUEAL);
        slow.max_growth_rate_per_s = 0.1;
        let mut fast = slow;
        fast.max_growth_rate_per_s = 2.0;
        fast.unstable[0].as_mut().unwrap().frequency_hz = 77.0;
        for sample in [slow, fast, slow] {
            history.push(&sample);
        }
        assert_eq!(history.bins()[0].unstable, [(77.0, 1.0)]);
    }
}

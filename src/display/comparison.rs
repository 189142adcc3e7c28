//! Compares the measured vibration with the predictions: hits, misses and false alarms.
//!
//! - A *measured squeal* is an interval of measurements whose level is at or above a threshold, from the first of them
//!   to the last. Interruptions shorter than a quarter of a second are included, and it must last a minimum time. Its
//!   frequency is that of its loudest measurement. A second without measurements ends it.
//! - A *predicted squeal* is a SQUEAL event of [`Events`]. Its frequencies are the ranges that its unstable modes
//!   covered.
//! - They *match* if they overlap in time, with the prediction extended by the time tolerance at both ends, and if the
//!   measured frequency is within the relative frequency tolerance of one of the predicted ranges.
//! - A measured squeal with a match is a *hit*, one without is a *miss*. A predicted squeal without a match is a *false
//!   alarm*. It is not judged if nothing was measured during it or if it has no frequency (static divergence).
//! - The *lead* of a hit is the time from the onset of the earliest matching prediction to the measured onset; negative
//!   if the prediction came later.

use serde::Serialize;

use super::events::{BRIDGED_S, Event, EventKind, Events, seconds};
use crate::node::VibrationSample;

/// A longer interval without measurements is a gap, in which the vibration is unknown, s.
const GAP_S: f64 = 1.0;

/// Definitions of a measured squeal and of a match.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Criteria {
    pub threshold_db: f64,
    pub least_duration_s: f64,
    pub time_tolerance_s: f64,
    /// Relative to the predicted frequency.
    pub frequency_tolerance: f64,
}

impl Default for Criteria {
    /// The defaults: 70 dB, from which on dynamometer tests count noise; 0.1 s; 0.5 s; 5 %.
    fn default() -> Self {
        Self { threshold_db: 70.0, least_duration_s: 0.1, time_tolerance_s: 0.5, frequency_tolerance: 0.05 }
    }
}

/// An interval of measurements at or above the threshold.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct MeasuredSqueal {
    pub onset_s: f64,
    pub end_s: f64,
    pub peak_db: f64,
    pub frequency_hz: f64,
}

/// The result for a measured squeal.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
#[serde(tag = "verdict", rename_all = "snake_case")]
pub enum Verdict {
    /// Predicted by that event with that mode. `frequency_difference` is relative and measured from the frequency range
    /// of the mode; 0 inside it.
    Hit { event: u64, mode_id: u32, lead_s: f64, frequency_difference: f64 },
    /// No squeal was predicted near that time.
    NotPredicted,
    /// Squeal was predicted near that time, but at other frequencies.
    OtherFrequency,
}

impl Verdict {
    /// Whether it is a hit.
    pub fn is_hit(&self) -> bool {
        matches!(self, Self::Hit { .. })
    }
}

/// The measurements so far and the measured squeals formed from them.
#[derive(Clone, Debug)]
pub struct Measurements {
    criteria: Criteria,
    count: u64,
    squeals: Vec<MeasuredSqueal>,
    open: Option<MeasuredSqueal>,
    /// Intervals in which the vibration was measured.
    measured: Vec<(f64, f64)>,
}

impl Measurements {
    /// No measurements yet.
    pub fn new(criteria: Criteria) -> Self {
        Self { criteria, count: 0, squeals: vec![], open: None, measured: vec![] }
    }

    /// The criteria in use.
    pub fn criteria(&self) -> &Criteria {
        &self.criteria
    }

    /// Number of measurements.
    pub fn count(&self) -> u64 {
        self.count
    }

    /// Adds the next measurement. A time before the latest one is set to the latest.
    pub fn push(&mut self, sample: &VibrationSample) {
        self.count += 1;
        let mut time_s = seconds(sample.time_ns);
        match self.measured.last_mut().filter(|last| time_s - last.1 <= GAP_S) {
            Some(last) => {
                time_s = time_s.max(last.1);
                last.1 = time_s;
            }
            None => {
                self.close();
                self.measured.push((time_s, time_s));
            }
        }
        let VibrationSample { frequency_hz, level_db: peak_db, .. } = *sample;
        if peak_db >= self.criteria.threshold_db {
            let onset_s = time_s;
            let new = MeasuredSqueal { onset_s, end_s: time_s, peak_db, frequency_hz };
            let open = self.open.get_or_insert(new);
            open.end_s = time_s;
            if peak_db > open.peak_db {
                (open.peak_db, open.frequency_hz) = (peak_db, frequency_hz);
            }
        } else if self.open.is_some_and(|open| time_s - open.end_s >= BRIDGED_S) {
            self.close();
        }
    }

    fn close(&mut self) {
        self.squeals.extend(self.open.take().filter(|squeal| self.lasts(squeal)));
    }

    /// Whether a squeal lasts long enough. Times have rounding errors, hence the allowance.
    fn lasts(&self, squeal: &MeasuredSqueal) -> bool {
        squeal.end_s - squeal.onset_s >= self.criteria.least_duration_s - 1e-6
    }

    /// Whether anything was measured between two times.
    fn covers(&self, from_s: f64, to_s: f64) -> bool {
        self.measured.iter().any(|&(first, last)| first <= to_s && last >= from_s)
    }

    /// Compares the measured squeals with `events`, the last of which may extend to `end_s`. `None` without
    /// measurements.
    pub fn compare(&self, events: &Events, end_s: f64) -> Option<Comparison> {
        if self.count == 0 {
            return None;
        }
        let predicted: Vec<&Event> = events.iter().filter(|event| event.kind == EventKind::Squeal).collect();
        let mut matched = vec![false; predicted.len()];
        let open = self.open.iter().filter(|squeal| self.lasts(squeal));
        let judge = |squeal: &MeasuredSqueal| {
            let mut verdict = Verdict::NotPredicted;
            for (event, matched) in predicted.iter().zip(&mut matched) {
                let tolerance_s = self.criteria.time_tolerance_s;
                let ends_s = event.end_s.unwrap_or(end_s) + tolerance_s;
                if squeal.end_s < event.onset_s - tolerance_s || squeal.onset_s > ends_s {
                    continue;
                }
                let hit = self.same_frequency(squeal, event);
                *matched |= hit.is_some();
                // The earliest match gave the warning.
                if !verdict.is_hit() {
                    verdict = hit.unwrap_or(Verdict::OtherFrequency);
                }
            }
            Judged { squeal: *squeal, verdict }
        };
        let measured: Vec<Judged> = self.squeals.iter().chain(open).map(judge).collect();
        let mut comparison =
            Comparison { criteria: self.criteria, measured, confirmed: vec![], false_alarms: vec![], unjudged: vec![] };
        for (event, matched) in predicted.iter().zip(matched) {
            let judged = !event.modes.is_empty() && self.covers(event.onset_s, event.end_s.unwrap_or(end_s));
            let list = match (matched, judged) {
                (true, _) => &mut comparison.confirmed,
                (false, true) => &mut comparison.false_alarms,
                (false, false) => &mut comparison.unjudged,
            };
            list.push(event.number);
        }
        Some(comparison)
    }

    /// The hit, if the frequencies match.
    fn same_frequency(&self, squeal: &MeasuredSqueal, event: &Event) -> Option<Verdict> {
        let hz = squeal.frequency_hz;
        let differences = event.modes.iter().map(|mode| {
            let nearest = hz.clamp(mode.low_hz, mode.high_hz);
            (mode.id, (hz - nearest) / nearest)
        });
        let (mode_id, frequency_difference) = differences
            .filter(|(_, difference)| difference.abs() <= self.criteria.frequency_tolerance)
            .min_by(|a, b| a.1.abs().total_cmp(&b.1.abs()))?;
        let lead_s = squeal.onset_s - event.onset_s;
        Some(Verdict::Hit { event: event.number, mode_id, lead_s, frequency_difference })
    }
}

/// A measured squeal with its verdict.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Judged {
    #[serde(flatten)]
    pub squeal: MeasuredSqueal,
    #[serde(flatten)]
    pub verdict: Verdict,
}

/// Result of comparing measurements with predictions.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Comparison {
    pub criteria: Criteria,
    /// In order.
    pub measured: Vec<Judged>,
    /// Numbers of the predicted squeals that were measured, that were false alarms, and that were not judged.
    pub confirmed: Vec<u64>,
    pub false_alarms: Vec<u64>,
    pub unjudged: Vec<u64>,
}

impl Comparison {
    /// Number of measured squeals that were predicted.
    pub fn hits(&self) -> usize {
        self.measured.iter().filter(|judged| judged.verdict.is_hit()).count()
    }

    /// Number of measured squeals that were not predicted.
    pub fn misses(&self) -> usize {
        self.measured.len() - self.hits()
    }

    /// The leads of the hits, ascending, s.
    pub fn leads_s(&self) -> Vec<f64> {
        let leads = self.measured.iter().filter_map(|judged| match judged.verdict {
            Verdict::Hit { lead_s, .. } => Some(lead_s),
            Verdict::NotPredicted | Verdict::OtherFrequency => None,
        });
        let mut leads: Vec<f64> = leads.collect();
        leads.sort_by(f64::total_cmp);
        leads
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::display::events::tests::sample;
    use crate::node::status::Status;

    /// Predictions every 10 ms over 60 s, in which mode 3 at 1500 Hz is unstable in the given intervals (s).
    fn predicted(squeals: &[(f64, f64)]) -> Events {
        let mut events = Events::default();
        for k in 0..6000 {
            let time_s = 0.01 * f64::from(k);
            let squeals = squeals.iter().any(|&(from, to)| (from..to).contains(&time_s));
            events.push(&sample((time_s * 1e9) as i64, 0.5, if squeals { Status::Squeal } else { Status::Ok }));
        }
        events
    }

    /// Measurements every 50 ms between two times, with a tone of 90 dB in the given intervals (s).
    fn measured(from_s: f64, to_s: f64, tones: &[(f64, f64, f64)]) -> Measurements {
        let mut measurements = Measurements::new(Criteria::default());
        for k in 0..1200 {
            let time_s = 0.05 * f64::from(k);
            if !(from_s..to_s).contains(&time_s) {
                continue;
            }
            let tone = tones.iter().find(|&&(from, to, _)| (from..to).contains(&time_s));
            let (frequency_hz, level_db) = tone.map_or((77.0, 50.0), |&(.., hz)| (hz, 90.0));
            measurements.push(&VibrationSample { time_ns: (time_s * 1e9) as i64, frequency_hz, level_db });
        }
        measurements
    }

    #[test]
    fn hits_misses_and_false_alarms_are_counted_separately() {
        let events = predicted(&[(5.0, 10.0), (20.0, 25.0), (30.0, 35.0), (40.0, 45.0), (57.0, 58.0)]);
        let tones = [
            (6.0, 9.0, 1530.0),   // a hit, 1 s after the prediction, 2 % off
            (12.0, 14.0, 1500.0), // nothing was predicted
            (21.0, 22.0, 1700.0), // another frequency: a miss, and the prediction a false alarm
            (39.7, 41.0, 1500.0), // a hit, before the prediction by less than the tolerance
            (50.0, 50.1, 1500.0), // too short: two measurements 0.05 s apart
        ];
        let found = measured(0.0, 55.0, &tones).compare(&events, 60.0).unwrap();
        let verdicts: Vec<Verdict> = found.measured.iter().map(|judged| judged.verdict).collect();
        let Verdict::Hit { event: 1, mode_id: 3, lead_s, frequency_difference } = verdicts[0] else {
            panic!("{verdicts:?}")
        };
        assert!((lead_s - 1.0).abs() < 1e-6 && (frequency_difference - 0.02).abs() < 1e-12, "{verdicts:?}");
        assert_eq!(verdicts[1..3], [Verdict::NotPredicted, Verdict::OtherFrequency]);
        let Verdict::Hit { event: 4, lead_s, .. } = verdicts[3] else { panic!("{verdicts:?}") };
        assert!((lead_s + 0.3).abs() < 0.051, "{lead_s}");
        assert_eq!((verdicts.len(), found.hits(), found.misses()), (4, 2, 2));
        assert_eq!(found.confirmed, [1, 4]);
        assert_eq!(found.false_alarms, [2, 3]);
        assert_eq!(found.unjudged, [5], "nothing was measured then");
        assert_eq!(found.leads_s().len(), 2);
    }

    #[test]
    fn interruptions_are_bridged_and_gaps_are_not() {
        let events = predicted(&[]);
        let short = measured(0.0, 60.0, &[(5.0, 6.0, 1500.0), (6.2, 7.0, 1500.0), (7.5, 8.0, 1500.0)]);
        let found = short.compare(&events, 60.0).unwrap();
        let stretches: Vec<(f64, f64)> = found
            .measured
            .iter()
            .map(|j| ((j.squeal.onset_s * 20.0).round(), (j.squeal.end_s * 20.0).round()))
            .collect();
        assert_eq!(stretches, [(100.0, 139.0), (150.0, 159.0)]);
        // A gap of more than a second in the measurements, and a squeal that lasts to the end.
        let mut measurements = Measurements::new(Criteria::default());
        for time_ms in (0..500).chain(2000..2500) {
            let time_ns = time_ms * 1_000_000;
            measurements.push(&VibrationSample { time_ns, frequency_hz: 1.0, level_db: 70.0 });
        }
        assert_eq!(measurements.compare(&events, 60.0).unwrap().measured.len(), 2);
        assert_eq!(Measurements::new(Criteria::default()).compare(&events, 60.0), None);
    }
}

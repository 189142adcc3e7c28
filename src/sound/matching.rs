//! Scores predictions against squeal in sound: hits, misses and false alarms, of each mode and in all.
//!
//! - A *predicted squeal* is a stretch in which a mode is unstable in predictions of the level SQUEAL; interruptions
//!   shorter than a quarter of a second are included.
//! - A squeal in the sound *matches* a predicted one if they overlap in time, with the prediction extended by the time
//!   tolerance at both ends, and if its frequency is within the relative frequency tolerance of the range that the
//!   mode covered.
//! - A squeal with a match is a *hit*, of the mode that is nearest in frequency, one without is a *miss*. Every
//!   predicted squeal with a match is confirmed: of a doublet, whose modes sound as one, both are. One without is a
//!   *false alarm*.
//! - A harmonic is no squeal of its own: it is neither hit nor miss.
//! - What one side cannot know is not judged: squeals outside the time of the predictions, predictions outside the time
//!   or the band of the sound.
//! - The *lead* of a hit is the time from the first prediction of at least WARN, without an interruption up to the
//!   matching predicted squeal, to the onset of the squeal.
//! - Time is also divided into slots. A slot in which there is a miss is a miss; else, with a false alarm, a false
//!   alarm; else, with a hit or a confirmed prediction, a hit; else both sides were silent.

use std::collections::BTreeMap;
use std::ops::AddAssign;

use serde::Serialize;

use super::Squeal;

/// Shorter interruptions do not end a predicted squeal or a warning, ns.
const BRIDGED_NS: i64 = 250_000_000;
/// Most slots; for longer sessions slots are longer.
const MOST_SLOTS: i64 = 1_000_000;

/// When a squeal and a predicted one match.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Criteria {
    /// Relative to the predicted frequency.
    pub frequency_tolerance: f64,
    pub time_tolerance_s: f64,
    /// Length of a slot of time.
    pub slot_s: f64,
}

impl Default for Criteria {
    fn default() -> Self {
        Self { frequency_tolerance: 0.05, time_tolerance_s: 0.5, slot_s: 1.0 }
    }
}

/// An unstable mode of a prediction.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Unstable {
    pub mode_id: u32,
    pub frequency_hz: f64,
    pub growth_rate_per_s: f64,
}

/// A stretch in which a mode is predicted to squeal.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PredictedSqueal {
    pub mode_id: u32,
    pub from_ns: i64,
    pub to_ns: i64,
    pub low_hz: f64,
    pub high_hz: f64,
    /// The largest.
    pub growth_rate_per_s: f64,
    /// First prediction of at least WARN that led to it.
    pub warned_ns: i64,
}

/// Predictions in the order of their stamps.
#[derive(Clone, Debug, Default)]
pub struct Predictions {
    squeals: Vec<PredictedSqueal>,
    /// Stamps and growth rates of the predictions of each squeal.
    growth: Vec<Vec<(i64, f64)>>,
    /// Index of the latest squeal of each mode.
    latest: BTreeMap<u32, usize>,
    /// First and last prediction of the latest warning.
    warning: Option<(i64, i64)>,
    span_ns: Option<(i64, i64)>,
}

/// Time and band in which squeal would have been found.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Listened {
    pub from_ns: i64,
    pub to_ns: i64,
    pub band_hz: [f64; 2],
}

/// The result for a squeal.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
#[serde(tag = "verdict", rename_all = "snake_case")]
pub enum Verdict {
    Hit {
        mode_id: u32,
        /// Predicted frequency nearest to that of the squeal.
        predicted_hz: f64,
        /// Growth rate predicted at the onset; if the prediction came later, its first.
        predicted_growth_rate_per_s: f64,
        lead_s: f64,
    },
    Miss,
    Harmonic,
    NotJudged,
}

/// Counts of hits, misses and false alarms.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Score {
    pub hits: u64,
    pub misses: u64,
    /// Predicted squeals with a match, and without.
    pub confirmed: u64,
    pub false_alarms: u64,
}

/// Counts of slots of time.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Slots {
    pub hits: u64,
    pub misses: u64,
    pub false_alarms: u64,
    /// Neither predicted nor found.
    pub quiet: u64,
}

/// Result of the comparison.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Meeting {
    pub criteria: Criteria,
    /// One for each squeal, in their order.
    pub verdicts: Vec<Verdict>,
    pub score: Score,
    /// Of each mode: hits of the mode, and its predicted squeals; no misses, which belong to no mode.
    pub modes: BTreeMap<u32, Score>,
    pub slots: Slots,
    /// Length of a slot, s.
    pub slot_s: f64,
    pub harmonics: u64,
    pub squeals_not_judged: u64,
    pub predictions_not_judged: u64,
    /// Predicted squeals that are false alarms: indices into [`Predictions::squeals`].
    pub false_alarms: Vec<usize>,
}

impl Predictions {
    /// Adds the next prediction: whether its level is at least WARN, and the modes that squeal in it.
    pub fn push(&mut self, stamp_ns: i64, warns: bool, squealing: &[Unstable]) {
        let first_ns = self.span_ns.map_or(stamp_ns, |(first, _)| first);
        self.span_ns = Some((first_ns, stamp_ns));
        if warns {
            let lasts = self.warning.filter(|(_, last)| stamp_ns.saturating_sub(*last) < BRIDGED_NS);
            self.warning = Some((lasts.map_or(stamp_ns, |(first, _)| first), stamp_ns));
        }
        for unstable in squealing {
            let &Unstable { mode_id, frequency_hz: hz, growth_rate_per_s } = unstable;
            let latest = self.latest.get(&mode_id).copied();
            match latest.filter(|&index| stamp_ns.saturating_sub(self.squeals[index].to_ns) < BRIDGED_NS) {
                Some(index) => {
                    self.growth[index].push((stamp_ns, growth_rate_per_s));
                    let squeal = &mut self.squeals[index];
                    squeal.to_ns = stamp_ns;
                    (squeal.low_hz, squeal.high_hz) = (squeal.low_hz.min(hz), squeal.high_hz.max(hz));
                    squeal.growth_rate_per_s = squeal.growth_rate_per_s.max(growth_rate_per_s);
                }
                None => {
                    self.latest.insert(mode_id, self.squeals.len());
                    let warned_ns = self.warning.map_or(stamp_ns, |(first, _)| first);
                    let (from_ns, to_ns, low_hz, high_hz) = (stamp_ns, stamp_ns, hz, hz);
                    let new =
                        PredictedSqueal { mode_id, from_ns, to_ns, low_hz, high_hz, growth_rate_per_s, warned_ns };
                    self.squeals.push(new);
                    self.growth.push(vec![(stamp_ns, growth_rate_per_s)]);
                }
            }
        }
    }

    /// Forgets predicted squeals that ended before `stamp_ns`; the time of the predictions then begins there.
    pub fn forget_before(&mut self, stamp_ns: i64) {
        let kept: Vec<bool> = self.squeals.iter().map(|squeal| squeal.to_ns >= stamp_ns).collect();
        self.span_ns = self.span_ns.map(|(first, last)| (first.max(stamp_ns).min(last), last));
        if !kept.contains(&false) {
            return;
        }
        let mut each = kept.iter();
        self.squeals.retain(|_| each.next() == Some(&true));
        let mut each = kept.iter();
        self.growth.retain(|_| each.next() == Some(&true));
        self.latest = self.squeals.iter().enumerate().map(|(index, squeal)| (squeal.mode_id, index)).collect();
    }

    /// The predicted squeals in the order of their beginnings.
    pub fn squeals(&self) -> &[PredictedSqueal] {
        &self.squeals
    }

    /// Stamps of the first and last prediction; `None` without predictions.
    pub fn span_ns(&self) -> Option<(i64, i64)> {
        self.span_ns
    }

    /// Compares squeals in sound with the predictions. `None` if there is no time in which there are both.
    pub fn meet(&self, squeals: &[Squeal], listened: &Listened, criteria: &Criteria) -> Option<Meeting> {
        let (first_ns, last_ns) = self.span_ns?;
        let common = (first_ns.max(listened.from_ns), last_ns.min(listened.to_ns));
        if common.0 >= common.1 {
            return None;
        }
        let judged = |from_ns: i64, to_ns: i64| from_ns <= common.1 && to_ns >= common.0;
        let mut confirmed = vec![false; self.squeals.len()];
        let mut score = Score::default();
        let mut modes: BTreeMap<u32, Score> = BTreeMap::new();
        let verdicts: Vec<Verdict> = squeals
            .iter()
            .map(|squeal| {
                if !judged(squeal.onset_ns, squeal.end_ns) {
                    return Verdict::NotJudged;
                }
                let matches = self.matches(squeal, criteria);
                // A harmonic that has its own match confirms that, too.
                matches.iter().for_each(|&(index, _)| confirmed[index] = true);
                if squeal.harmonic.is_some() {
                    return Verdict::Harmonic;
                }
                let Some(&(index, predicted_hz)) = matches.iter().min_by(|a, b| {
                    let off = |hz: f64| (squeal.frequency_hz / hz - 1.0).abs();
                    off(a.1).total_cmp(&off(b.1))
                }) else {
                    score.misses += 1;
                    return Verdict::Miss;
                };
                let predicted = &self.squeals[index];
                score.hits += 1;
                modes.entry(predicted.mode_id).or_default().hits += 1;
                Verdict::Hit {
                    mode_id: predicted.mode_id,
                    predicted_hz,
                    predicted_growth_rate_per_s: self.growth_at(index, squeal.onset_ns),
                    lead_s: squeal.onset_ns.saturating_sub(predicted.warned_ns) as f64 * 1e-9,
                }
            })
            .collect();
        let [low_hz, high_hz] = listened.band_hz;
        let mut false_alarms = vec![];
        let mut predictions_not_judged = 0;
        for (index, predicted) in self.squeals.iter().enumerate() {
            let in_band = predicted.high_hz >= low_hz && predicted.low_hz <= high_hz;
            let mode = modes.entry(predicted.mode_id).or_default();
            if confirmed[index] {
                (score.confirmed, mode.confirmed) = (score.confirmed + 1, mode.confirmed + 1);
            } else if in_band && judged(predicted.from_ns, predicted.to_ns) {
                (score.false_alarms, mode.false_alarms) = (score.false_alarms + 1, mode.false_alarms + 1);
                false_alarms.push(index);
            } else {
                predictions_not_judged += 1;
            }
        }
        let (slots, slot_s) = self.slots(squeals, &verdicts, &confirmed, &false_alarms, common, criteria);
        let count = |wanted: Verdict| verdicts.iter().filter(|verdict| **verdict == wanted).count() as u64;
        Some(Meeting {
            criteria: *criteria,
            score,
            modes,
            slots,
            slot_s,
            harmonics: count(Verdict::Harmonic),
            squeals_not_judged: count(Verdict::NotJudged),
            predictions_not_judged,
            false_alarms,
            verdicts,
        })
    }

    /// Growth rate of the latest prediction of a squeal before a time, else of its first.
    fn growth_at(&self, index: usize, time_ns: i64) -> f64 {
        let growth = &self.growth[index];
        let after = growth.partition_point(|(stamp_ns, _)| *stamp_ns <= time_ns);
        growth.get(after.saturating_sub(1)).map_or(f64::NAN, |(_, rate)| *rate)
    }

    /// The predicted squeals that match a squeal, with the nearest frequency of each.
    fn matches(&self, squeal: &Squeal, criteria: &Criteria) -> Vec<(usize, f64)> {
        let tolerance_ns = (criteria.time_tolerance_s * 1e9) as i64;
        let overlap = |predicted: &PredictedSqueal| {
            squeal.end_ns >= predicted.from_ns.saturating_sub(tolerance_ns)
                && squeal.onset_ns <= predicted.to_ns.saturating_add(tolerance_ns)
        };
        let nearest = |predicted: &PredictedSqueal| squeal.frequency_hz.clamp(predicted.low_hz, predicted.high_hz);
        let all = self.squeals.iter().enumerate().filter(|(_, predicted)| overlap(predicted));
        all.map(|(index, predicted)| (index, nearest(predicted)))
            .filter(|(_, hz)| (squeal.frequency_hz / hz - 1.0).abs() <= criteria.frequency_tolerance)
            .collect()
    }

    fn slots(
        &self,
        squeals: &[Squeal],
        verdicts: &[Verdict],
        confirmed: &[bool],
        false_alarms: &[usize],
        (from_ns, to_ns): (i64, i64),
        criteria: &Criteria,
    ) -> (Slots, f64) {
        let length_ns = to_ns.saturating_sub(from_ns);
        let slot_ns = ((criteria.slot_s * 1e9) as i64).max(length_ns / MOST_SLOTS).max(1);
        // The later kinds win.
        let (quiet, hit, false_alarm, miss) = (0_u8, 1, 2, 3);
        let mut kinds = vec![quiet; (length_ns / slot_ns) as usize + usize::from(length_ns % slot_ns > 0)];
        let mut mark = |first_ns: i64, last_ns: i64, kind: u8| {
            let index = |ns: i64| (ns.clamp(from_ns, to_ns - 1) - from_ns) / slot_ns;
            for slot in &mut kinds[index(first_ns) as usize..=index(last_ns) as usize] {
                *slot = kind.max(*slot);
            }
        };
        for (squeal, verdict) in squeals.iter().zip(verdicts) {
            match verdict {
                Verdict::Hit { .. } => mark(squeal.onset_ns, squeal.end_ns, hit),
                Verdict::Miss => mark(squeal.onset_ns, squeal.end_ns, miss),
                Verdict::Harmonic | Verdict::NotJudged => {}
            }
        }
        let overlaps = |predicted: &PredictedSqueal| predicted.from_ns <= to_ns && predicted.to_ns >= from_ns;
        for (predicted, _) in self.squeals.iter().zip(confirmed).filter(|(p, confirmed)| **confirmed && overlaps(p)) {
            mark(predicted.from_ns, predicted.to_ns, hit);
        }
        for &index in false_alarms {
            mark(self.squeals[index].from_ns, self.squeals[index].to_ns, false_alarm);
        }
        let count = |wanted: u8| kinds.iter().filter(|&&kind| kind == wanted).count() as u64;
        let slots =
            Slots { hits: count(hit), misses: count(miss), false_alarms: count(false_alarm), quiet: count(quiet) };
        (slots, slot_ns as f64 * 1e-9)
    }
}

impl AddAssign for Score {
    fn add_assign(&mut self, other: Self) {
        let Self { hits, misses, confirmed, false_alarms } = other;
        self.hits += hits;
        self.misses += misses;
        self.confirmed += confirmed;
        self.false_alarms += false_alarms;
    }
}

impl AddAssign for Slots {
    fn add_assign(&mut self, other: Self) {
        let Self { hits, misses, false_alarms, quiet } = other;
        self.hits += hits;
        self.misses += misses;
        self.false_alarms += false_alarms;
        self.quiet += quiet;
    }
}

impl Score {
    /// Share of the judged predicted squeals that were confirmed; `None` without any.
    pub fn precision(&self) -> Option<f64> {
        ratio(self.confirmed, self.confirmed + self.false_alarms)
    }

    /// Share of the judged squeals that were predicted; `None` without any.
    pub fn recall(&self) -> Option<f64> {
        ratio(self.hits, self.hits + self.misses)
    }
}

impl Slots {
    /// Matthews correlation coefficient, -1 to 1; `None` if one side was always or never silent.
    ///
    /// `(TP TN - FP FN) / √((TP+FP)(TP+FN)(TN+FP)(TN+FN))`
    ///
    /// # Source
    /// B. W. Matthews, Biochim. Biophys. Acta 405 (1975) 442.
    pub fn mcc(&self) -> Option<f64> {
        let Self { hits, misses, false_alarms, quiet } = *self;
        let [tp, missed, fp, tn] = [hits, misses, false_alarms, quiet].map(|count| count as f64);
        let square = (tp + fp) * (tp + missed) * (tn + fp) * (tn + missed);
        (square > 0.0).then(|| (tp * tn - fp * missed) / square.sqrt())
    }
}

impl Meeting {
    /// The leads of the hits in ascending order, s.
    pub fn leads_s(&self) -> Vec<f64> {
        let leads = self.verdicts.iter().filter_map(|verdict| match verdict {
            Verdict::Hit { lead_s, .. } => Some(*lead_s),
            Verdict::Miss | Verdict::Harmonic | Verdict::NotJudged => None,
        });
        let mut leads: Vec<f64> = leads.collect();
        leads.sort_by(f64::total_cmp);
        leads
    }
}

/// Median of values in ascending order: of an even number, the mean of the two in the middle.
pub fn median(sorted: &[f64]) -> Option<f64> {
    let upper = sorted.get(sorted.len() / 2)?;
    let lower = sorted.get(sorted.len().saturating_sub(1) / 2)?;
    Some(0.5 * (lower + upper))
}

fn ratio(part: u64, all: u64) -> Option<f64> {
    (all > 0).then(|| part as f64 / all as f64)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sound::Harmonic;

    fn ns(time_s: f64) -> i64 {
        (time_s * 1e9).round() as i64
    }

    fn squeal(onset_s: f64, end_s: f64, frequency_hz: f64) -> Squeal {
        Squeal::of_90_db(ns(onset_s), ns(end_s), frequency_hz)
    }

    /// Predictions every 10 ms over 60 s: modes `(id, frequency, from, to)`, each warned of for 2 s before.
    fn predictions(modes: &[(u32, f64, f64, f64)]) -> Predictions {
        let mut predictions = Predictions::default();
        for k in 0..=6000 {
            let t = 0.01 * f64::from(k);
            let squealing: Vec<Unstable> = modes
                .iter()
                .filter(|(.., from, to)| (*from..*to).contains(&t))
                .map(|&(mode_id, frequency_hz, from, _)| Unstable {
                    mode_id,
                    frequency_hz,
                    growth_rate_per_s: 100.0 + t - from,
                })
                .collect();
            let warns = modes.iter().any(|(.., from, to)| (from - 2.0..*to).contains(&t));
            predictions.push(ns(t), warns, &squealing);
        }
        predictions
    }

    const ALL: Listened = Listened { from_ns: 0, to_ns: 60_000_000_000, band_hz: [1250.0, 16_000.0] };

    #[test]
    fn hits_misses_and_false_alarms_are_counted_with_their_leads() {
        let predictions = predictions(&[
            (3, 1500.0, 5.0, 8.0),
            (3, 1500.0, 20.0, 25.0),
            (7, 2600.0, 30.0, 33.0),
            (1, 900.0, 40.0, 42.0), // below the band of the sound
        ]);
        let squeals = [
            squeal(5.5, 7.0, 1530.0),   // 2 % off
            squeal(12.0, 13.0, 1500.0), // not predicted then
            squeal(31.0, 32.0, 2900.0), // at another frequency
        ];
        let met = predictions.meet(&squeals, &ALL, &Criteria::default()).expect("common time");
        let Verdict::Hit { mode_id: 3, predicted_hz: 1500.0, predicted_growth_rate_per_s, lead_s } = met.verdicts[0]
        else {
            panic!("{met:?}")
        };
        assert!((lead_s - 2.5).abs() < 0.011 && (predicted_growth_rate_per_s - 100.5).abs() < 0.011, "{met:?}");
        assert_eq!(met.verdicts[1..], [Verdict::Miss, Verdict::Miss]);
        assert_eq!(met.score, Score { hits: 1, misses: 2, confirmed: 1, false_alarms: 2 });
        assert_eq!((met.score.precision(), met.score.recall()), (Some(1.0 / 3.0), Some(1.0 / 3.0)));
        assert_eq!(met.modes[&3], Score { hits: 1, misses: 0, confirmed: 1, false_alarms: 1 });
        assert_eq!((met.predictions_not_judged, met.false_alarms.as_slice()), (1, [1, 2].as_slice()));
        // Slots of 1 s: 5 to 7 hit; 12 and 13, 31 and 32 missed; 20 to 24 and 30 false alarms; the others quiet.
        assert_eq!(met.slots, Slots { hits: 3, misses: 4, false_alarms: 6, quiet: 47 });
        // (3·47 - 6·4) / √(9 · 7 · 53 · 51) by hand.
        assert!((met.slots.mcc().unwrap() - 117.0 / 170_289.0_f64.sqrt()).abs() < 1e-12);
        assert_eq!(met.leads_s().len(), 1);
    }

    #[test]
    fn the_median_of_an_even_number_is_the_mean_of_two() {
        assert_eq!(
            [&[][..], &[2.0], &[2.0, 3.0], &[2.0, 3.0, 7.0]].map(median),
            [None, Some(2.0), Some(2.5), Some(3.0)]
        );
    }

    #[test]
    fn doublets_are_confirmed_together_and_harmonics_are_no_misses() {
        let predictions = predictions(&[(3, 2000.0, 5.0, 8.0), (4, 2010.0, 5.0, 8.0)]);
        let harmonic = Squeal { harmonic: Some(Harmonic { order: 2, of: 1 }), ..squeal(5.5, 7.0, 4018.0) };
        let squeals = [squeal(5.5, 7.0, 2009.0), harmonic];
        let met = predictions.meet(&squeals, &ALL, &Criteria::default()).expect("common time");
        assert!(matches!(met.verdicts[0], Verdict::Hit { mode_id: 4, .. }), "{met:?}");
        assert_eq!(met.verdicts[1], Verdict::Harmonic);
        assert_eq!(met.score, Score { hits: 1, misses: 0, confirmed: 2, false_alarms: 0 });
        assert_eq!(met.slots.mcc(), Some(1.0));
    }

    #[test]
    fn what_one_side_cannot_know_is_not_judged() {
        let predictions = predictions(&[(3, 2000.0, 5.0, 8.0), (3, 2000.0, 40.0, 41.0)]);
        let late = Listened { from_ns: ns(10.0), to_ns: ns(70.0), ..ALL };
        let squeals = [squeal(62.0, 64.0, 2000.0)];
        let met = predictions.meet(&squeals, &late, &Criteria::default()).expect("common time");
        assert_eq!((met.squeals_not_judged, met.predictions_not_judged), (1, 1));
        assert_eq!(met.score, Score { false_alarms: 1, ..Score::default() });
        assert_eq!((met.score.precision(), met.score.recall(), met.slots.mcc()), (Some(0.0), None, None));
        let never = Listened { from_ns: ns(61.0), to_ns: ns(70.0), ..ALL };
        assert_eq!(predictions.meet(&squeals, &never, &Criteria::default()), None);
        assert_eq!(Predictions::default().meet(&squeals, &ALL, &Criteria::default()), None);
    }

    #[test]
    fn short_interruptions_do_not_divide_a_predicted_squeal() {
        let mode = [Unstable { mode_id: 1, frequency_hz: 2000.0, growth_rate_per_s: 10.0 }];
        let mut predictions = Predictions::default();
        for (time_s, squeals) in [(0.0, true), (0.1, false), (0.2, true), (0.3, false), (0.6, true)] {
            predictions.push(ns(time_s), squeals, if squeals { &mode } else { &[] });
        }
        let spans: Vec<(i64, i64)> = predictions.squeals().iter().map(|s| (s.from_ns, s.to_ns)).collect();
        assert_eq!(spans, [(0, ns(0.2)), (ns(0.6), ns(0.6))]);
        assert_eq!(predictions.squeals()[1].warned_ns, ns(0.6), "a new warning");
    }
}

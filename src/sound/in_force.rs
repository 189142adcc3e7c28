//! Compares a squeal with the prediction in force at its onset, while the rig runs.
//!
//! Of the predictions whose stamps are within the time tolerance of the onset, the one that squeals at the frequency of
//! the sound counts, and of several the nearest in time. If none does, the latest before the onset counts. The message
//! about the squeal names that prediction, so the comparison can be repeated from a recording. The comparison of a whole
//! recording is in [`super::matching`].

use super::matching::{Criteria, Unstable};
use super::{Quantity, Squeal};
use crate::msgs::{Header, Heard, Time, heard_quantity, heard_verdict};

/// Number of unstable modes of a prediction that squeals are compared with: those that grow fastest.
pub const MODES: usize = 4;

/// A prediction, as far as squeals are compared with it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct InForce {
    pub stamp_ns: i64,
    pub input_seq: u64,
    /// The modes predicted to squeal; none unless the level is SQUEAL.
    pub modes: [Option<Unstable>; MODES],
}

impl InForce {
    /// The mode that is predicted to squeal at the frequency of `squeal`; of several the nearest in frequency.
    fn hit(&self, squeal: &Squeal, criteria: &Criteria) -> Option<&Unstable> {
        let off = |mode: &Unstable| (squeal.frequency_hz / mode.frequency_hz - 1.0).abs();
        let near = self.modes.iter().flatten().filter(|mode| off(mode) <= criteria.frequency_tolerance);
        near.min_by(|a, b| off(a).total_cmp(&off(b)))
    }
}

/// The prediction that a squeal is compared with; `None` if there is none within the time tolerance of its onset.
pub fn choose<'a>(
    squeal: &Squeal,
    predictions: impl Iterator<Item = &'a InForce>,
    criteria: &Criteria,
) -> Option<InForce> {
    let tolerance_ns = (criteria.time_tolerance_s * 1e9) as u64;
    let distance = |prediction: &InForce| prediction.stamp_ns.abs_diff(squeal.onset_ns);
    let order = |prediction: &InForce| {
        let hits = prediction.hit(squeal, criteria).is_some();
        (!hits, !hits && prediction.stamp_ns > squeal.onset_ns, distance(prediction))
    };
    predictions
        .filter(|prediction| distance(prediction) <= tolerance_ns)
        .min_by_key(|prediction| order(prediction))
        .copied()
}

/// The message about a squeal of a channel, compared with the prediction `chosen` by [`choose`]. `earlier` squeals of the
/// channel were numbered by another detector.
pub fn message(
    channel: &str,
    quantity: Quantity,
    earlier: u64,
    squeal: &Squeal,
    state: u8,
    chosen: Option<&InForce>,
    criteria: &Criteria,
) -> Heard {
    let hit = chosen.and_then(|prediction| prediction.hit(squeal, criteria)).filter(|_| squeal.harmonic.is_none());
    let verdict = match (squeal.harmonic, chosen, hit) {
        (Some(_), _, _) => heard_verdict::HARMONIC,
        (None, None, _) => heard_verdict::NOT_JUDGED,
        (None, Some(_), Some(_)) => heard_verdict::HIT,
        (None, Some(_), None) => heard_verdict::MISS,
    };
    let growth = |of: fn(&super::Growth) -> f64| squeal.growth.as_ref().map_or(f64::NAN, of);
    Heard {
        header: Header { stamp: Time::from_ns(squeal.onset_ns), frame_id: String::new() },
        channel: channel.to_owned(),
        number: earlier + squeal.number,
        state,
        end_stamp: Time::from_ns(squeal.end_ns),
        cut_at_onset: squeal.cut[0],
        cut_at_end: squeal.cut[1],
        frequency_hz: squeal.frequency_hz,
        quantity: match quantity {
            Quantity::SoundPressure => heard_quantity::SOUND_PRESSURE,
            Quantity::Acceleration => heard_quantity::ACCELERATION,
        },
        level_db: squeal.level_db,
        peak_level_db: squeal.peak_level_db,
        prominence_db: squeal.prominence_db,
        growth_rate_per_s: growth(|growth| growth.rate_per_s),
        growth_rate_low_per_s: growth(|growth| growth.low_per_s),
        growth_rate_high_per_s: growth(|growth| growth.high_per_s),
        harmonic_order: squeal.harmonic.map_or(0, |harmonic| harmonic.order),
        harmonic_of: squeal.harmonic.map_or(0, |harmonic| earlier + harmonic.of),
        verdict,
        mode_id: hit.map_or(0, |mode| mode.mode_id),
        predicted_frequency_hz: hit.map_or(f64::NAN, |mode| mode.frequency_hz),
        predicted_growth_rate_per_s: hit.map_or(f64::NAN, |mode| mode.growth_rate_per_s),
        input_seq: chosen.map_or(0, |prediction| prediction.input_seq),
        prediction_stamp: chosen.map_or_else(Time::default, |prediction| Time::from_ns(prediction.stamp_ns)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::msgs::heard_state;
    use crate::sound::Harmonic;

    const S: i64 = 1_000_000_000;

    fn squeal(onset_ns: i64, frequency_hz: f64) -> Squeal {
        Squeal { number: 2, ..Squeal::of_90_db(onset_ns, onset_ns + S, frequency_hz) }
    }

    fn prediction(stamp_ns: i64, hz: &[f64]) -> InForce {
        let mode = |k: usize| {
            hz.get(k).map(|&frequency_hz| Unstable { mode_id: k as u32, frequency_hz, growth_rate_per_s: 10.0 })
        };
        InForce { stamp_ns, input_seq: stamp_ns as u64, modes: std::array::from_fn(mode) }
    }

    #[test]
    fn the_nearest_prediction_that_squeals_at_the_frequency_counts() {
        let criteria = Criteria::default();
        let chosen = |predictions: &[InForce]| choose(&squeal(10 * S, 2000.0), predictions.iter(), &criteria);
        let at = |tenths: i64, hz: &[f64]| prediction(tenths * S / 10, hz);
        // A hit after the onset is preferred to a prediction of another frequency at the onset.
        let hit = at(103, &[1500.0, 2050.0]);
        assert_eq!(chosen(&[at(99, &[]), at(100, &[1500.0]), hit, at(104, &[2000.0])]), Some(hit));
        // Without a hit the latest before the onset counts, and after it only if there is none before.
        assert_eq!(chosen(&[at(97, &[]), at(99, &[]), at(101, &[])]), Some(at(99, &[])));
        assert_eq!(chosen(&[at(101, &[]), at(103, &[])]), Some(at(101, &[])));
        assert_eq!(chosen(&[at(94, &[2000.0]), at(106, &[2000.0])]), None, "further than 0.5 s");
    }

    #[test]
    fn the_message_carries_squeal_verdict_and_prediction() {
        let criteria = Criteria::default();
        let of = |squeal: &Squeal, chosen: Option<&InForce>| {
            message("m", Quantity::SoundPressure, 5, squeal, heard_state::ENDED, chosen, &criteria)
        };
        let (two, hit) = (squeal(10 * S, 2000.0), prediction(9 * S, &[1500.0, 2010.0]));
        let found = of(&two, Some(&hit));
        assert_eq!((found.verdict, found.mode_id, found.predicted_frequency_hz), (heard_verdict::HIT, 1, 2010.0));
        assert_eq!((found.number, found.input_seq, found.prediction_stamp), (7, 9 * S as u64, Time::from_ns(9 * S)));
        let miss = of(&two, Some(&prediction(9 * S, &[1500.0])));
        assert_eq!((miss.verdict, miss.mode_id), (heard_verdict::MISS, 0));
        assert!(miss.predicted_frequency_hz.is_nan() && miss.growth_rate_per_s.is_nan());
        assert_eq!(of(&two, None).verdict, heard_verdict::NOT_JUDGED);
        let harmonic = Squeal { harmonic: Some(Harmonic { order: 2, of: 1 }), ..two };
        let found = of(&harmonic, Some(&hit));
        assert_eq!((found.verdict, found.harmonic_order, found.harmonic_of), (heard_verdict::HARMONIC, 2, 6));
        assert!(found.predicted_frequency_hz.is_nan());
    }
}

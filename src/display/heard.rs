//! Squeals found in the samples of a session, for event lists.

use std::collections::VecDeque;

use serde::Serialize;

use super::events::seconds;
use crate::msgs::{Heard, heard_quantity, heard_state, heard_verdict};
use crate::sound::Quantity;

/// Number of squeals kept.
const MOST: usize = 10_000;

/// A squeal found in samples; unknown values are `null`.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct SquealInSound {
    pub channel: String,
    /// Counts the squeals of the channel.
    pub number: u64,
    /// s since the epoch.
    pub onset_s: f64,
    /// `null` while it lasts.
    pub end_s: Option<f64>,
    pub frequency_hz: f64,
    pub level_db: f64,
    pub level_unit: &'static str,
    pub growth_rate_per_s: Option<f64>,
    /// `hit`, `miss`, `harmonic` or `not judged`.
    pub verdict: &'static str,
    /// Of a hit: mode, predicted frequency and growth rate.
    pub mode_id: Option<u32>,
    pub predicted_frequency_hz: Option<f64>,
    pub predicted_growth_rate_per_s: Option<f64>,
}

/// The squeals so far in the order of their announcement; the oldest are dropped beyond 10 000.
#[derive(Clone, Debug, Default)]
pub struct SquealsInSound(VecDeque<SquealInSound>);

impl SquealsInSound {
    /// Adds a squeal whose onset was at `onset_ns` on the time line of the display; its end replaces its beginning.
    pub fn push(&mut self, heard: &Heard, onset_ns: i64) {
        let ended = heard.state == heard_state::ENDED;
        let lasted_ns = heard.end_stamp.as_ns().saturating_sub(heard.header.stamp.as_ns());
        let known = |value: f64| Some(value).filter(|value| value.is_finite());
        let quantity = if heard.quantity == heard_quantity::ACCELERATION {
            Quantity::Acceleration
        } else {
            Quantity::SoundPressure
        };
        let squeal = SquealInSound {
            channel: heard.channel.clone(),
            number: heard.number,
            onset_s: seconds(onset_ns),
            end_s: ended.then(|| seconds(onset_ns.saturating_add(lasted_ns))),
            frequency_hz: heard.frequency_hz,
            level_db: heard.level_db,
            level_unit: quantity.level_unit(),
            growth_rate_per_s: known(heard.growth_rate_per_s),
            verdict: heard_verdict::name(heard.verdict),
            mode_id: (heard.verdict == heard_verdict::HIT).then_some(heard.mode_id),
            predicted_frequency_hz: known(heard.predicted_frequency_hz),
            predicted_growth_rate_per_s: known(heard.predicted_growth_rate_per_s),
        };
        let same = |other: &&mut SquealInSound| {
            other.end_s.is_none() && (&other.channel, other.number) == (&squeal.channel, squeal.number)
        };
        if let Some(begun) = self.0.iter_mut().rev().find(same) {
            *begun = squeal;
            return;
        }
        if self.0.len() == MOST {
            self.0.pop_front();
        }
        self.0.push_back(squeal);
    }

    pub fn iter(&self) -> impl ExactSizeIterator<Item = &SquealInSound> {
        self.0.iter()
    }

    /// As a JSON array.
    pub fn to_json(&self) -> String {
        serde_json::to_string(&self.0).unwrap_or_else(|_| "[]".to_owned())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::msgs::{Header, Time};

    fn heard(number: u64, state: u8, from_s: i64, to_s: i64) -> Heard {
        let header = Header { stamp: Time::from_ns(from_s * 1_000_000_000), frame_id: String::new() };
        let (channel, end_stamp) = ("microphone".to_owned(), Time::from_ns(to_s * 1_000_000_000));
        let growth_rate_per_s = f64::NAN;
        Heard { header, channel, number, state, end_stamp, growth_rate_per_s, mode_id: 7, ..Heard::default() }
    }

    #[test]
    fn the_end_of_a_squeal_replaces_its_beginning() {
        let mut squeals = SquealsInSound::default();
        for one in [
            heard(1, heard_state::BEGAN, 5, 6),
            heard(2, heard_state::BEGAN, 6, 6),
            heard(1, heard_state::ENDED, 5, 8),
            heard(1, heard_state::BEGAN, 20, 21),
        ] {
            squeals.push(&one, one.header.stamp.as_ns() + 1_000_000_000);
        }
        let found: Vec<_> = squeals.iter().map(|one| (one.number, one.onset_s, one.end_s)).collect();
        assert_eq!(found, [(1, 6.0, Some(9.0)), (2, 7.0, None), (1, 21.0, None)]);
        let json: serde_json::Value = serde_json::from_str(&squeals.to_json()).expect("JSON");
        assert_eq!((&json[0]["verdict"], &json[0]["mode_id"]), (&"hit".into(), &7.into()));
        assert!(json[0]["growth_rate_per_s"].is_null() && json[1]["end_s"].is_null());
    }

    #[test]
    fn the_oldest_squeals_are_forgotten() {
        let mut squeals = SquealsInSound::default();
        for number in 0..MOST as u64 + 5 {
            squeals.push(&heard(number, heard_state::ENDED, 1, 2), 0);
        }
        assert_eq!((squeals.iter().len(), squeals.iter().next().map(|one| one.number)), (MOST, Some(5)));
    }
}

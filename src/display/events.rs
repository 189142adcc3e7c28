//! Onsets and ends of squeal and of faults, from predictions in order.

use std::collections::VecDeque;

use serde::Serialize;

use crate::node::{Sample, UnstableMode};
use crate::wire::{Time, level};

/// A stretch of predictions that were SQUEAL, or FAULT, with interruptions shorter than a quarter of a second.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Event {
    /// Counted from 1.
    pub number: u64,
    /// `SQUEAL` or `FAULT`.
    pub kind: &'static str,
    /// Time of its first prediction, s since the epoch.
    pub onset_s: f64,
    /// Time of the first prediction that was not so any more; `null` while it lasts.
    pub end_s: Option<f64>,
    /// How often it was interrupted: noise about the limit is not a new event each time.
    pub interruptions: u32,
    /// Where it is in the sequence of inputs.
    pub input_seq: u64,
    /// The mode that grew fastest over the event, at its fastest; `null` for faults and static divergence.
    pub mode_id: Option<u32>,
    pub frequency_hz: Option<f64>,
    pub growth_rate_per_s: Option<f64>,
    /// The frequencies over which its unstable modes went, of the fastest at every moment.
    pub modes: Vec<ModeRange>,
    /// Conditions at the onset.
    pub normal_load_n: f64,
    pub disc_speed_rad_s: f64,
    pub friction_coefficient: f64,
    pub critical_friction: f64,
}

/// Smallest and largest frequency of a mode.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct ModeRange {
    pub id: u32,
    pub low_hz: f64,
    pub high_hz: f64,
}

/// The events so far, the oldest forgotten beyond a bound.
#[derive(Clone, Debug, Default)]
pub struct Events {
    events: VecDeque<Event>,
    count: u64,
    /// The latest event has not ended.
    open: bool,
}

/// An interruption shorter than this does not end an event, s.
pub(super) const BRIDGED_S: f64 = 0.25;
/// Events kept; older ones are forgotten.
const MOST_EVENTS: usize = 10_000;

/// First line of the CSV.
const CSV_HEADER: &str = "number,kind,onset,end,duration_s,interruptions,mode_id,frequency_hz,growth_rate_per_s,normal_load_n,\
                          disc_speed_rad_s,friction_coefficient,critical_friction,input_seq\r\n";

impl Events {
    /// Takes the next prediction in; whether something began or ended.
    pub fn push(&mut self, sample: &Sample) -> bool {
        let kind = match sample.level {
            level::SQUEAL | level::FAULT => Some(level::name(sample.level)),
            _ => None,
        };
        let time_s = seconds(sample.time_ns);
        let mut changed = false;
        if self.open {
            if let Some(last) = self.events.back_mut() {
                if kind == Some(last.kind) {
                    last.grew(&sample.unstable);
                    return false;
                }
                last.end_s = Some(time_s);
            }
            self.open = false;
            changed = true;
        }
        let Some(kind) = kind else { return changed };
        let resumed = |last: &&mut Event| {
            last.kind == kind && last.end_s.is_some_and(|end_s| (0.0..BRIDGED_S).contains(&(time_s - end_s)))
        };
        if let Some(last) = self.events.back_mut().filter(resumed) {
            last.end_s = None;
            last.interruptions += 1;
            last.grew(&sample.unstable);
            self.open = true;
            return true;
        }
        self.count += 1;
        self.open = true;
        let mut event = Event {
            number: self.count,
            kind,
            onset_s: time_s,
            end_s: None,
            interruptions: 0,
            input_seq: sample.input_seq,
            mode_id: None,
            frequency_hz: None,
            growth_rate_per_s: None,
            modes: vec![],
            normal_load_n: sample.normal_load_n,
            disc_speed_rad_s: sample.disc_speed_rad_s,
            friction_coefficient: sample.friction_coefficient,
            critical_friction: sample.critical_friction,
        };
        event.grew(&sample.unstable);
        if self.events.len() == MOST_EVENTS {
            self.events.pop_front();
        }
        self.events.push_back(event);
        true
    }

    /// The events, oldest first.
    pub fn iter(&self) -> impl DoubleEndedIterator<Item = &Event> {
        self.events.iter()
    }

    /// How many there were, the forgotten ones included.
    pub fn count(&self) -> u64 {
        self.count
    }

    /// As comma-separated values with a header, times in ISO 8601.
    pub fn to_csv(&self) -> String {
        let mut text = CSV_HEADER.to_owned();
        let optional = |value: Option<f64>| value.map_or_else(String::new, |value| value.to_string());
        let known = |value: f64| if value.is_finite() { value.to_string() } else { String::new() };
        for event in &self.events {
            text += &[
                event.number.to_string(),
                event.kind.to_owned(),
                iso(event.onset_s),
                event.end_s.map_or_else(String::new, iso),
                event.end_s.map_or_else(String::new, |end_s| format!("{:.6}", end_s - event.onset_s)),
                event.interruptions.to_string(),
                event.mode_id.map_or_else(String::new, |id| id.to_string()),
                optional(event.frequency_hz),
                optional(event.growth_rate_per_s),
                known(event.normal_load_n),
                known(event.disc_speed_rad_s),
                known(event.friction_coefficient),
                known(event.critical_friction),
                event.input_seq.to_string(),
            ]
            .join(",");
            text += "\r\n";
        }
        text
    }
}

impl Event {
    /// Takes the unstable modes of a moment in, fastest first.
    fn grew(&mut self, unstable: &[Option<UnstableMode>]) {
        for mode in unstable.iter().flatten() {
            let hz = mode.frequency_hz;
            match self.modes.iter_mut().find(|range| range.id == mode.id) {
                Some(range) => (range.low_hz, range.high_hz) = (range.low_hz.min(hz), range.high_hz.max(hz)),
                None => self.modes.push(ModeRange { id: mode.id, low_hz: hz, high_hz: hz }),
            }
        }
        let Some(mode) = unstable.first().copied().flatten() else { return };
        if self.growth_rate_per_s.is_none_or(|before| mode.growth_rate_per_s > before) {
            self.mode_id = Some(mode.id);
            self.frequency_hz = Some(mode.frequency_hz);
            self.growth_rate_per_s = Some(mode.growth_rate_per_s);
        }
    }
}

/// Seconds since the epoch.
pub fn seconds(ns: i64) -> f64 {
    ns as f64 * 1e-9
}

/// A time as people and spreadsheets read it, UTC.
pub fn iso(time_s: f64) -> String {
    let time = Time::from_ns((time_s * 1e6).round() as i64 * 1000);
    jiff::Timestamp::new(i64::from(time.sec), time.nanosec as i32)
        .map_or_else(|_| time_s.to_string(), |stamp| format!("{stamp:.6}"))
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;

    pub fn sample(time_ns: i64, mu: f64, level: u8) -> Sample {
        let growing = level == level::SQUEAL;
        Sample {
            time_ns,
            stamp_ns: time_ns,
            input_seq: time_ns as u64,
            normal_load_n: 500.0,
            disc_speed_rad_s: 13.0,
            friction_coefficient: mu,
            level,
            unstable_modes: u32::from(growing),
            max_growth_rate_per_s: 0.0,
            critical_friction: 0.4,
            friction_margin: 0.4 - mu,
            unstable: [
                growing.then_some(UnstableMode { id: 3, frequency_hz: 1500.0, growth_rate_per_s: 1.0 }),
                None,
                None,
                None,
            ],
        }
    }

    #[test]
    fn a_stretch_of_squeal_is_one_event_with_its_fastest_mode() {
        let mut events = Events::default();
        assert!(!events.push(&sample(0, 0.3, level::OK)));
        assert!(events.push(&sample(1_000_000_000, 0.41, level::SQUEAL)));
        let mut fast = sample(2_000_000_000, 0.5, level::SQUEAL);
        fast.unstable[0] = Some(UnstableMode { id: 4, frequency_hz: 1600.0, growth_rate_per_s: 9.0 });
        assert!(!events.push(&fast));
        assert!(events.push(&sample(2_500_000_000, 0.39, level::WARN)));
        assert!(events.push(&sample(3_000_000_000, 0.5, level::SQUEAL)));
        assert!(events.push(&sample(4_000_000_000, f64::NAN, level::FAULT)));
        let all: Vec<&Event> = events.iter().collect();
        assert_eq!(all.iter().map(|event| event.kind).collect::<Vec<_>>(), ["SQUEAL", "SQUEAL", "FAULT"]);
        let first = all[0];
        assert_eq!((first.onset_s, first.end_s, first.input_seq), (1.0, Some(2.5), 1_000_000_000));
        assert_eq!((first.mode_id, first.growth_rate_per_s, first.friction_coefficient), (Some(4), Some(9.0), 0.41));
        assert_eq!((all[1].end_s, all[2].end_s), (Some(4.0), None), "a fault ends a squeal; the fault lasts");
    }

    #[test]
    fn a_short_interruption_does_not_end_an_event() {
        let mut events = Events::default();
        for (time_ms, at) in
            [(0, level::SQUEAL), (10, level::OK), (200, level::SQUEAL), (300, level::OK), (600, level::SQUEAL)]
        {
            events.push(&sample(time_ms * 1_000_000, 0.5, at));
        }
        let ms = |time_s: f64| (time_s * 1e3).round();
        let found: Vec<_> = events.iter().map(|e| (ms(e.onset_s), e.end_s.map(ms), e.interruptions)).collect();
        assert_eq!(found, [(0.0, Some(300.0), 1), (600.0, None, 0)]);
    }

    #[test]
    fn csv_has_a_line_for_each_event_and_no_value_where_there_is_none() {
        let mut events = Events::default();
        events.push(&sample(1_700_000_000_000_000_000, 0.5, level::SQUEAL));
        events.push(&sample(1_700_000_001_250_000_000, f64::NAN, level::FAULT));
        let csv = events.to_csv();
        let lines: Vec<&str> = csv.lines().collect();
        assert_eq!(lines.len(), 3);
        assert_eq!(
            lines[1],
            "1,SQUEAL,2023-11-14T22:13:20.000000Z,2023-11-14T22:13:21.250000Z,1.250000,0,3,1500,1,500,13,0.5,0.4,\
             1700000000000000000"
        );
        assert!(lines[2].starts_with("2,FAULT,2023-11-14T22:13:21.250000Z,,,0,,,,500,13,,0.4,"), "{}", lines[2]);
        assert!(lines.iter().all(|line| line.split(',').count() == 14));
    }

    #[test]
    fn the_oldest_events_are_forgotten() {
        let mut events = Events::default();
        for k in 0..2 * (MOST_EVENTS as i64 + 5) {
            events.push(&sample(k * 1_000_000_000, 0.5, if k % 2 == 0 { level::SQUEAL } else { level::OK }));
        }
        assert_eq!((events.iter().count(), events.count()), (MOST_EVENTS, MOST_EVENTS as u64 + 5));
        assert_eq!(events.iter().next().map(|event| event.number), Some(6));
    }
}

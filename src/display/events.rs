//! Squeals, faults and silences, detected in a sequence of predictions.

use std::collections::VecDeque;

use serde::Serialize;

use crate::msgs::{Time, listed};
use crate::node::status::Status;
use crate::node::{Sample, UnstableMode};

/// The kind of an event.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub enum EventKind {
    #[serde(rename = "SQUEAL")]
    Squeal,
    #[serde(rename = "FAULT")]
    Fault,
    /// Inputs have stopped.
    #[serde(rename = "NO DATA")]
    NoData,
}

impl EventKind {
    /// The kind of event that a prediction with `status` belongs to; `None` for OK, WARN and WAITING.
    fn of(status: Status) -> Option<Self> {
        match status {
            Status::Squeal => Some(Self::Squeal),
            Status::Fault => Some(Self::Fault),
            Status::NoData => Some(Self::NoData),
            Status::Waiting | Status::Inactive | Status::Ok | Status::Warn => None,
        }
    }

    /// The kind as displays show it.
    pub fn name(self) -> &'static str {
        match self {
            Self::Squeal => Status::Squeal.name(),
            Self::Fault => Status::Fault.name(),
            Self::NoData => Status::NoData.name(),
        }
    }
}

/// An interval of predictions of the same kind; interruptions shorter than a quarter of a second are included.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Event {
    /// Counted from 1.
    pub number: u64,
    pub kind: EventKind,
    /// Time of the first prediction, s since the epoch.
    pub onset_s: f64,
    /// Time of the first prediction that no longer belongs to the event, s since the epoch; `null` while it lasts.
    pub end_s: Option<f64>,
    /// Number of interruptions: noise at the limit does not start a new event each time.
    pub interruptions: u32,
    /// Sequence number of the input at the onset.
    pub input_seq: u64,
    /// Frequency ranges of its unstable modes; of each prediction the fastest growing ones are included.
    pub modes: Vec<ModeRange>,
    /// Why there was no prediction at the onset of a fault or silence; `null` for a squeal.
    pub reason: Option<Box<str>>,
    /// The first prediction.
    pub onset: EventMoment,
    /// The prediction with the largest growth rate; `null` for faults and silences.
    pub peak: Option<EventMoment>,
}

/// One prediction of an event: its conditions and its fastest growing mode; unknown values are `null`.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct EventMoment {
    /// s since the epoch.
    pub time_s: f64,
    /// `null` if no mode grows, or only a static root.
    pub mode_id: Option<u32>,
    pub frequency_hz: Option<f64>,
    pub growth_rate_per_s: Option<f64>,
    pub normal_load_n: Option<f64>,
    pub disc_speed_rad_s: Option<f64>,
    pub friction_coefficient: Option<f64>,
    pub critical_friction: Option<f64>,
}

impl EventMoment {
    fn new(sample: &Sample) -> Self {
        let known = |value: f64| Some(value).filter(|value| value.is_finite());
        let [fastest, ..] = sample.unstable;
        let static_growth = known(sample.max_growth_rate_per_s).filter(|_| sample.unstable_modes > 0);
        Self {
            time_s: seconds(sample.time_ns),
            mode_id: fastest.map(|mode| mode.id),
            frequency_hz: fastest.map(|mode| mode.frequency_hz),
            growth_rate_per_s: fastest.map(|mode| mode.growth_rate_per_s).or(static_growth),
            normal_load_n: known(sample.normal_load_n),
            disc_speed_rad_s: known(sample.disc_speed_rad_s),
            friction_coefficient: known(sample.friction_coefficient),
            critical_friction: known(sample.critical_friction),
        }
    }
}

listed! {
    /// A column of the event lists with what an event has once. The CSV file has all, in this order: the columns for
    /// onset and peak are before the reason.
    pub enum EventColumn {
        Number,
        Kind,
        Onset,
        End,
        Duration,
        Interruptions,
        InputSeq,
        Reason,
    }
}

listed! {
    /// A column of the event lists for a moment of an event. The CSV file has all, in this order.
    pub enum MomentColumn {
        Time,
        Mode,
        Frequency,
        GrowthRate,
        NormalLoad,
        DiscSpeed,
        Friction,
        CriticalFriction,
    }
}

/// A column of the events on the page.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub struct PageColumn {
    /// Its name in the CSV file; of a moment also the field of [`EventMoment`].
    pub name: &'static str,
    pub heading: &'static str,
    /// Unit or remark, in small letters below the heading.
    pub unit: &'static str,
    /// How a value of a moment is written; `null` for what an event has once.
    pub moment: Option<MomentFormat>,
}

/// How the page writes a value of a moment.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub struct MomentFormat {
    /// Decimals of values from 100 on, and of values below.
    pub decimals: [u8; 2],
    /// Whether the value at the onset precedes that at the peak.
    pub from_onset: bool,
}

/// The columns of the events on the page, in their order.
pub fn page_columns() -> Vec<PageColumn> {
    let [once @ .., last] = EventColumn::ALL;
    let once = once.into_iter().filter_map(EventColumn::on_page);
    once.chain(MomentColumn::ALL.into_iter().filter_map(MomentColumn::on_page)).chain(last.on_page()).collect()
}

impl EventColumn {
    /// Its name in the CSV file, with unit.
    fn name(self) -> &'static str {
        match self {
            Self::Number => "number",
            Self::Kind => "kind",
            Self::Onset => "onset_utc",
            Self::End => "end_utc",
            Self::Duration => "duration_s",
            Self::Interruptions => "interruptions",
            Self::InputSeq => "input_seq",
            Self::Reason => "reason",
        }
    }

    /// Its heading in a report; `None` if reports omit it. The onset is in the columns of its moment.
    pub fn heading(self) -> Option<&'static str> {
        match self {
            Self::Number => Some("no."),
            Self::Kind => Some("event"),
            Self::End => Some("end, s"),
            Self::Duration => Some("duration, s"),
            Self::Reason => Some("reason"),
            Self::Onset | Self::Interruptions | Self::InputSeq => None,
        }
    }

    /// The column on the page, which `CELLS` in `events.js` fills; `None` if the page omits it.
    fn on_page(self) -> Option<PageColumn> {
        let (heading, unit) = match self {
            Self::Number => ("no.", ""),
            Self::Kind => ("event", ""),
            Self::Onset => ("onset", ""),
            Self::End => ("end", ""),
            Self::Duration => ("duration", "s"),
            Self::Reason => ("reason", ""),
            Self::Interruptions | Self::InputSeq => return None,
        };
        Some(PageColumn { name: self.name(), heading, unit, moment: None })
    }

    /// Its cell in the CSV file, empty if unknown.
    fn cell(self, event: &Event) -> String {
        match self {
            Self::Number => event.number.to_string(),
            Self::Kind => event.kind.name().to_owned(),
            Self::Onset => iso(event.onset_s),
            Self::End => event.end_s.map_or_else(String::new, iso),
            Self::Duration => event.end_s.map_or_else(String::new, |end_s| format!("{:.6}", end_s - event.onset_s)),
            Self::Interruptions => event.interruptions.to_string(),
            Self::InputSeq => event.input_seq.to_string(),
            Self::Reason => event.reason.as_deref().map_or_else(String::new, quoted),
        }
    }
}

impl MomentColumn {
    /// Its name in the CSV file, with unit.
    fn name(self) -> &'static str {
        match self {
            Self::Time => "utc",
            Self::Mode => "mode_id",
            Self::Frequency => "frequency_hz",
            Self::GrowthRate => "growth_rate_per_s",
            Self::NormalLoad => "normal_load_n",
            Self::DiscSpeed => "disc_speed_rad_s",
            Self::Friction => "friction_coefficient",
            Self::CriticalFriction => "critical_friction",
        }
    }

    /// Its heading in a report; `None` if reports omit it.
    pub fn heading(self) -> Option<&'static str> {
        match self {
            Self::Time => Some("after, s"),
            Self::Mode => Some("mode"),
            Self::Frequency => Some("frequency, Hz"),
            Self::GrowthRate => Some("growth, 1/s"),
            Self::NormalLoad => Some("load, N"),
            Self::DiscSpeed => Some("speed, rad/s"),
            Self::Friction => Some("μ"),
            Self::CriticalFriction => None,
        }
    }

    /// The column on the page; `None` if the page omits it.
    fn on_page(self) -> Option<PageColumn> {
        let (heading, unit, decimals, from_onset) = match self {
            Self::Mode => ("mode", "fastest", [0, 0], false),
            Self::Frequency => ("frequency", "Hz", [1, 5], false),
            Self::NormalLoad => ("load", "N", [1, 1], false),
            Self::DiscSpeed => ("speed", "rad/s", [2, 2], false),
            Self::Friction => ("μ", "onset → fastest", [4, 4], true),
            // The onset has a column of its own.
            Self::Time | Self::GrowthRate | Self::CriticalFriction => return None,
        };
        Some(PageColumn { name: self.name(), heading, unit, moment: Some(MomentFormat { decimals, from_onset }) })
    }

    /// Its cell in the CSV file, empty if unknown.
    fn cell(self, moment: &EventMoment) -> String {
        match self {
            Self::Time => iso(moment.time_s),
            Self::Mode => cell(moment.mode_id),
            Self::Frequency => cell(moment.frequency_hz),
            Self::GrowthRate => cell(moment.growth_rate_per_s),
            Self::NormalLoad => cell(moment.normal_load_n),
            Self::DiscSpeed => cell(moment.disc_speed_rad_s),
            Self::Friction => cell(moment.friction_coefficient),
            Self::CriticalFriction => cell(moment.critical_friction),
        }
    }
}

/// Smallest and largest frequency of a mode.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct ModeRange {
    pub id: u32,
    pub low_hz: f64,
    pub high_hz: f64,
}

/// The events so far; the oldest are dropped beyond 10 000.
#[derive(Clone, Debug, Default)]
pub struct Events {
    events: VecDeque<Event>,
    count: u64,
    /// Whether the latest event has not ended.
    open: bool,
}

/// An interruption shorter than this does not end an event, s.
pub(super) const BRIDGED_S: f64 = 0.25;
/// Number of events kept.
const MOST_EVENTS: usize = 10_000;

impl Events {
    /// Adds the next prediction; returns whether an event began or ended.
    pub fn push(&mut self, sample: &Sample) -> bool {
        let kind = EventKind::of(sample.status);
        let time_s = seconds(sample.time_ns);
        let mut changed = false;
        if self.open {
            if let Some(last) = self.events.back_mut() {
                if kind == Some(last.kind) {
                    last.take(sample);
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
        self.open = true;
        if let Some(last) = self.events.back_mut().filter(resumed) {
            last.end_s = None;
            last.interruptions += 1;
            last.take(sample);
            return true;
        }
        self.count += 1;
        let mut event = Event {
            number: self.count,
            kind,
            onset_s: time_s,
            end_s: None,
            interruptions: 0,
            input_seq: sample.input_seq,
            modes: vec![],
            reason: sample.fault.clone(),
            onset: EventMoment::new(sample),
            peak: None,
        };
        event.take(sample);
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

    /// Number of events so far, including dropped ones.
    pub fn count(&self) -> u64 {
        self.count
    }

    /// The events as CSV. The header contains the units, times are ISO 8601, onset and peak have separate columns, and
    /// the last column is the reason of a fault.
    pub fn to_csv(&self) -> String {
        let [once @ .., last] = EventColumn::ALL;
        let mut header: Vec<String> = once.map(|column| column.name().to_owned()).into();
        for when in ["onset", "peak"] {
            // The time of the onset already has a column.
            let columns = MomentColumn::ALL.into_iter().skip(usize::from(when == "onset"));
            header.extend(columns.map(|column| format!("{when}_{}", column.name())));
        }
        header.push(last.name().to_owned());
        let mut text = header.join(",") + "\r\n";
        for event in &self.events {
            let mut cells: Vec<String> = once.map(|column| column.cell(event)).into();
            let [_, onset @ ..] = MomentColumn::ALL.map(|column| column.cell(&event.onset));
            cells.extend(onset);
            let peak = |column: MomentColumn| event.peak.map_or_else(String::new, |peak| column.cell(&peak));
            cells.extend(MomentColumn::ALL.map(peak));
            cells.push(last.cell(event));
            text += &cells.join(",");
            text += "\r\n";
        }
        text
    }
}

/// A text as a quoted CSV cell (RFC 4180).
fn quoted(text: &str) -> String {
    format!("\"{}\"", text.replace('"', "\"\""))
}

fn cell<T: ToString>(value: Option<T>) -> String {
    value.map_or_else(String::new, |value| value.to_string())
}

impl Event {
    /// Adds a prediction to the event.
    fn take(&mut self, sample: &Sample) {
        for UnstableMode { id, frequency_hz: hz, .. } in sample.unstable.iter().flatten().copied() {
            match self.modes.iter_mut().find(|range| range.id == id) {
                Some(range) => (range.low_hz, range.high_hz) = (range.low_hz.min(hz), range.high_hz.max(hz)),
                None => self.modes.push(ModeRange { id, low_hz: hz, high_hz: hz }),
            }
        }
        let now = EventMoment::new(sample);
        let before = self.peak.and_then(|peak| peak.growth_rate_per_s);
        if now.growth_rate_per_s.is_some_and(|growth| before.is_none_or(|before| growth > before)) {
            self.peak = Some(now);
        }
    }
}

/// Seconds since the epoch.
pub fn seconds(ns: i64) -> f64 {
    ns as f64 * 1e-9
}

/// A time in UTC as people and spreadsheets read it (ISO 8601).
pub fn iso(time_s: f64) -> String {
    let time = Time::from_ns((time_s * 1e6).round() as i64 * 1000);
    jiff::Timestamp::new(i64::from(time.sec), time.nanosec as i32)
        .map_or_else(|_| time_s.to_string(), |stamp| format!("{stamp:.6}"))
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;

    pub fn sample(time_ns: i64, mu: f64, status: Status) -> Sample {
        let growing = status == Status::Squeal;
        Sample {
            time_ns,
            stamp_ns: time_ns,
            input_seq: time_ns as u64,
            normal_load_n: 500.0,
            disc_speed_rad_s: 13.0,
            friction_coefficient: mu,
            status,
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
            fault: (status == Status::Fault).then(|| "normal_load_n is -5, expected 0 to \"1e6\"".into()),
        }
    }

    /// Onset and peak are actual predictions: each has its own conditions and mode.
    #[test]
    fn a_squeal_is_one_event_whose_onset_and_peak_have_their_own_conditions() {
        let mut events = Events::default();
        assert!(!events.push(&sample(0, 0.3, Status::Ok)));
        assert!(events.push(&sample(1_000_000_000, 0.41, Status::Squeal)));
        let mut fast =
            Sample { normal_load_n: 700.0, disc_speed_rad_s: 9.0, ..sample(2_000_000_000, 0.5, Status::Squeal) };
        fast.unstable[0] = Some(UnstableMode { id: 4, frequency_hz: 1600.0, growth_rate_per_s: 9.0 });
        assert!(!events.push(&fast));
        assert!(!events.push(&sample(2_200_000_000, 0.45, Status::Squeal)), "slower again");
        assert!(events.push(&sample(2_500_000_000, 0.39, Status::Warn)));
        assert!(events.push(&sample(3_000_000_000, 0.5, Status::Squeal)));
        assert!(events.push(&sample(4_000_000_000, f64::NAN, Status::Fault)));
        let all: Vec<&Event> = events.iter().collect();
        let kinds: Vec<EventKind> = all.iter().map(|event| event.kind).collect();
        assert_eq!(kinds, [EventKind::Squeal, EventKind::Squeal, EventKind::Fault]);
        let first = all[0];
        assert_eq!((first.onset_s, first.end_s, first.input_seq), (1.0, Some(2.5), 1_000_000_000));
        let (onset, peak) = (first.onset, first.peak.expect("it grew"));
        let seen = |at: EventMoment| (at.time_s, at.mode_id, at.frequency_hz, at.growth_rate_per_s);
        let under = |at: EventMoment| (at.normal_load_n, at.disc_speed_rad_s, at.friction_coefficient);
        assert_eq!(seen(onset), (1.0, Some(3), Some(1500.0), Some(1.0)));
        assert_eq!(under(onset), (Some(500.0), Some(13.0), Some(0.41)));
        assert_eq!(seen(peak), (2.0, Some(4), Some(1600.0), Some(9.0)));
        assert_eq!(under(peak), (Some(700.0), Some(9.0), Some(0.5)));
        assert_eq!((all[1].end_s, all[2].end_s), (Some(4.0), None), "a fault ends a squeal; the fault lasts");
        assert_eq!((all[2].peak, all[2].onset.friction_coefficient), (None, None));
    }

    #[test]
    fn a_static_divergence_has_a_growth_and_no_mode() {
        let mut events = Events::default();
        let diverging = Sample { unstable: [None; 4], max_growth_rate_per_s: 7.0, ..sample(0, 0.5, Status::Squeal) };
        events.push(&diverging);
        let peak = events.iter().next().and_then(|event| event.peak).expect("it grows");
        assert_eq!((peak.mode_id, peak.frequency_hz, peak.growth_rate_per_s), (None, None, Some(7.0)));
    }

    #[test]
    fn waiting_for_the_first_input_is_no_event_and_silence_is_no_fault() {
        let mut events = Events::default();
        assert!(!events.push(&sample(0, f64::NAN, Status::Waiting)));
        assert!(events.push(&sample(1, f64::NAN, Status::NoData)));
        let kinds: Vec<&str> = events.iter().map(|event| event.kind.name()).collect();
        assert_eq!(kinds, ["NO DATA"]);
    }

    #[test]
    fn a_short_interruption_does_not_end_an_event() {
        let mut events = Events::default();
        for (time_ms, at) in
            [(0, Status::Squeal), (10, Status::Ok), (200, Status::Squeal), (300, Status::Ok), (600, Status::Squeal)]
        {
            events.push(&sample(time_ms * 1_000_000, 0.5, at));
        }
        let ms = |time_s: f64| (time_s * 1e3).round();
        let found: Vec<_> = events.iter().map(|e| (ms(e.onset_s), e.end_s.map(ms), e.interruptions)).collect();
        assert_eq!(found, [(0.0, Some(300.0), 1), (600.0, None, 0)]);
    }

    #[test]
    fn csv_has_a_line_for_each_event_and_empty_cells_for_unknown_values() {
        let mut events = Events::default();
        events.push(&sample(1_700_000_000_000_000_000, 0.5, Status::Squeal));
        events.push(&sample(1_700_000_001_250_000_000, f64::NAN, Status::Fault));
        let csv = events.to_csv();
        let lines: Vec<&str> = csv.lines().collect();
        assert_eq!(lines.len(), 3);
        assert_eq!(
            lines[1],
            "1,SQUEAL,2023-11-14T22:13:20.000000Z,2023-11-14T22:13:21.250000Z,1.250000,0,1700000000000000000,\
             3,1500,1,500,13,0.5,0.4,2023-11-14T22:13:20.000000Z,3,1500,1,500,13,0.5,0.4,"
        );
        assert_eq!(
            lines[2],
            "2,FAULT,2023-11-14T22:13:21.250000Z,,,0,1700000001250000000,,,,500,13,,0.4,,,,,,,,,\
             \"normal_load_n is -5, expected 0 to \"\"1e6\"\"\""
        );
        let columns: Vec<&str> = lines[0].split(',').collect();
        assert_eq!((columns.len(), columns.last()), (23, Some(&"reason")));
        let rows =
            csv::Reader::from_reader(csv.as_bytes()).into_records().map(|row| row.expect("as wide as the header"));
        let reasons: Vec<String> = rows.map(|row| row[22].to_owned()).collect();
        assert_eq!(reasons, ["", "normal_load_n is -5, expected 0 to \"1e6\""]);
        for (column, unit) in
            [("growth_rate", "_per_s"), ("normal_load", "_n"), ("disc_speed", "_rad_s"), ("duration", "_s")]
        {
            let named: Vec<&&str> = columns.iter().filter(|name| name.contains(column)).collect();
            assert!(!named.is_empty() && named.iter().all(|name| name.ends_with(unit)), "{columns:?}");
        }
    }

    /// The page finds a value of a moment by the name of its column, and anything else in `CELLS` of `events.js`.
    #[test]
    fn the_page_has_a_value_for_each_of_its_columns() {
        let moment = serde_json::to_value(EventMoment::new(&sample(0, 0.5, Status::Squeal))).unwrap();
        let script = include_str!("assets/events.js");
        let columns = page_columns();
        assert_eq!(columns.last().map(|column| column.name), Some("reason"));
        for column in columns {
            match column.moment {
                Some(_) => assert!(moment.get(column.name).is_some(), "{column:?}"),
                None => assert!(script.contains(&format!("\n  {}: (", column.name)), "{column:?}"),
            }
        }
    }

    #[test]
    fn the_oldest_events_are_forgotten() {
        let mut events = Events::default();
        for k in 0..2 * (MOST_EVENTS as i64 + 5) {
            events.push(&sample(k * 1_000_000_000, 0.5, if k % 2 == 0 { Status::Squeal } else { Status::Ok }));
        }
        assert_eq!((events.iter().count(), events.count()), (MOST_EVENTS, MOST_EVENTS as u64 + 5));
        assert_eq!(events.iter().next().map(|event| event.number), Some(6));
    }
}

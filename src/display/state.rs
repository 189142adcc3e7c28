//! The state sent to the page: the latest prediction with its context.

use serde::Serialize;

use super::events::seconds;
use super::history::{Bin, History};
use crate::msgs::{OperatingPoint, Prediction};
use crate::node::status::Assessment;
use crate::session::Counters;
use crate::simulator;

/// Time over which spread and trend are computed, s.
const RECENT_S: f64 = 2.0;

/// Everything about one moment; unknown numbers are `null`.
#[derive(Clone, Debug, Serialize)]
pub struct State<'a> {
    /// Time of the moment, s since the epoch.
    pub time_s: f64,
    /// Time since the last input, s; `null` before the first.
    pub age_s: Option<f64>,
    /// Number of predictions in the last second.
    pub rate_hz: Option<f64>,
    #[serde(flatten)]
    pub assessment: Assessment,
    #[serde(flatten)]
    pub prediction: Option<Shown<'a>>,
    /// Smallest and largest friction coefficient of the last 2 s.
    pub spread: Option<(f32, f32)>,
    /// Change of the margin over the last 2 s, 1/s.
    pub trend_per_s: Option<f64>,
    /// Margin below which the node warns; `null` if unknown.
    pub warn_margin: Option<f64>,
    /// `null` if none was received.
    pub temperature: Option<TemperatureShown>,
    /// Number of the stability map in force; 0 before the first.
    pub map: u64,
    /// Changes whenever an event begins or ends.
    pub events: u64,
    pub counters: Option<CountersShown>,
    /// Bins that changed since the last state sent; the first of them was part of that state.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub bins: Vec<&'a Bin>,
}

/// The temperature of the contact.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct TemperatureShown {
    /// The latest temperature received, °C.
    pub celsius: f64,
    /// The temperature that the rig has in predictions, °C; `null` if it does not follow the temperature.
    pub of_rig: Option<f64>,
    /// Whether the latest one is too old.
    pub stale: bool,
}

/// A prediction with its operating point.
#[derive(Clone, Debug, Serialize)]
pub struct Shown<'a> {
    pub level: u8,
    pub reason: &'a str,
    pub seq: u64,
    pub stamp_s: f64,
    pub reused: bool,
    /// Whether the input is from the rig simulator. Messages in shared memory do not carry this.
    pub simulated: bool,
    pub load: Option<f64>,
    pub speed: Option<f64>,
    pub mu: Option<f64>,
    pub critical: f64,
    pub margin: f64,
    pub growth: f64,
    pub worst_hz: f64,
    pub unstable: u32,
    /// Identity, then frequency, growth rate, damping ratio, pad share, and the error bounds of frequency and growth
    /// rate.
    pub modes: Vec<(u32, [f64; 6])>,
}

/// Counters of the session. The page shows all but the last in this order, each with its name.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct CountersShown {
    pub solved: u64,
    pub charted: u64,
    pub reused: u64,
    pub faults: u64,
    pub passed_over: u64,
    /// Number of restarts of the ROS 2 side.
    pub ros2_falls: u64,
}

impl CountersShown {
    pub fn new(counters: Counters, passed_over: u64, bus_restarts: u64) -> Self {
        let Counters { solved, charted, reused, faults, zero_terms: _, decoupled_modes: _, roots_beyond_band: _ } =
            counters;
        Self { solved, charted, reused, faults, passed_over, ros2_falls: bus_restarts }
    }
}

impl<'a> Shown<'a> {
    /// `input` must be the input of `prediction`; another one is ignored.
    pub fn new(input: Option<&OperatingPoint>, prediction: &'a Prediction) -> Self {
        let input = input.filter(|input| input.seq == prediction.input_seq);
        let mode = |mode: &crate::msgs::Mode| {
            let values = [
                mode.frequency_hz,
                mode.growth_rate_per_s,
                mode.damping_ratio,
                mode.pad_participation,
                mode.frequency_error_hz,
                mode.growth_rate_error_per_s,
            ];
            (mode.id, values)
        };
        Self {
            level: prediction.level,
            reason: &prediction.reason,
            seq: prediction.input_seq,
            stamp_s: seconds(prediction.header.stamp.as_ns()),
            reused: prediction.reused,
            simulated: prediction.header.frame_id == simulator::FRAME_ID,
            load: input.map(|input| input.normal_load_n),
            speed: input.map(|input| input.disc_speed_rad_s),
            mu: input.map(|input| input.friction_coefficient),
            critical: prediction.critical_friction,
            margin: prediction.friction_margin,
            growth: prediction.max_growth_rate_per_s,
            worst_hz: prediction.worst_frequency_hz,
            unstable: prediction.unstable_modes,
            modes: prediction.modes.iter().map(mode).collect(),
        }
    }
}

/// The bins of the last 2 s before `time_s`.
fn recent(history: &History, time_s: f64) -> impl Iterator<Item = &Bin> {
    let length_s = seconds(history.bin_ns());
    let (first, last) = (((time_s - RECENT_S) / length_s) as i64, (time_s / length_s) as i64);
    history.since(first).take_while(move |bin| bin.index <= last)
}

/// Smallest and largest friction coefficient of the last 2 s.
pub fn spread(history: &History, time_s: f64) -> Option<(f32, f32)> {
    let ranges = recent(history, time_s).filter_map(|bin| bin.ranges[2]);
    ranges.reduce(|all, range| (all.0.min(range.0), all.1.max(range.1)))
}

/// Slope of the margin over the last 2 s by least squares, 1/s; `None` with fewer than three bins that have a margin.
pub fn trend_per_s(history: &History, time_s: f64) -> Option<f64> {
    let length_s = seconds(history.bin_ns());
    let points: Vec<(f64, f64)> = recent(history, time_s)
        .filter_map(|bin| {
            let (low, high) = bin.ranges[4]?;
            Some((bin.index as f64 * length_s - time_s, 0.5 * (f64::from(low) + f64::from(high))))
        })
        .collect();
    if points.len() < 3 {
        return None;
    }
    let count = points.len() as f64;
    let (mean_t, mean_y) = points.iter().fold((0.0, 0.0), |sum, p| (sum.0 + p.0 / count, sum.1 + p.1 / count));
    let (above, below) = points
        .iter()
        .fold((0.0, 0.0), |sum, &(t, y)| (sum.0 + (t - mean_t) * (y - mean_y), sum.1 + (t - mean_t) * (t - mean_t)));
    Some(above / below)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::display::events::tests::sample;
    use crate::msgs::Mode;
    use crate::node::status::Status;

    #[test]
    fn spread_and_trend_look_two_seconds_back() {
        let mut history = History::new(200_000_000, 100);
        for k in 0..500 {
            let time_s = 0.01 * f64::from(k);
            history.push(&sample((time_s * 1e9) as i64, 0.3 + 0.02 * time_s, Status::Ok));
        }
        let (low, high) = spread(&history, 4.99).unwrap();
        assert!((f64::from(low) - (0.3 + 0.02 * 2.8)).abs() < 1e-6 && (f64::from(high) - 0.3998).abs() < 1e-6);
        let trend = trend_per_s(&history, 4.99).unwrap();
        assert!((trend + 0.02).abs() < 2e-4, "the margin falls as friction rises, by 0.02/s: {trend}");
        assert_eq!(trend_per_s(&history, 20.0), None);
    }

    #[test]
    fn json_has_null_for_unknown_values_and_all_digits_of_known_ones() {
        let prediction = Prediction {
            input_seq: 7,
            critical_friction: f64::NAN,
            friction_margin: 0.1 + 0.2,
            modes: vec![Mode { id: 3, frequency_hz: 1.0 / 3.0, frequency_error_hz: f64::NAN, ..Default::default() }],
            ..Default::default()
        };
        let other = OperatingPoint { seq: 8, ..Default::default() };
        let json = serde_json::to_value(Shown::new(Some(&other), &prediction)).unwrap();
        assert!(json["critical"].is_null() && json["mu"].is_null(), "conditions of another input are not shown");
        assert_eq!(json["margin"].as_f64(), Some(0.1 + 0.2));
        assert_eq!(json["modes"][0][1][0].as_f64(), Some(1.0 / 3.0));
        assert!(json["modes"][0][1][4].is_null());
    }
}

//! Applications of a brake in a session, and the squeal in them: the view of SAE J2521.
//!
//! An application is a stretch of the history in which the load is at least a tenth of the highest and the speed at least a
//! hundredth of the fastest. Interruptions below half a second are included, and shorter applications are none.

use super::heard::SquealInSound;
use super::history::{Bin, History, both};

/// Least share of the highest load, and of the fastest speed.
const LEAST_LOAD: f32 = 0.1;
const LEAST_SPEED: f32 = 0.01;
/// Shorter interruptions do not end an application, and shorter applications do not count, s.
const SHORTEST_S: f64 = 0.5;

/// A stretch of sliding under load.
#[derive(Clone, Debug, PartialEq)]
pub struct Application {
    /// s since the epoch.
    pub from_s: f64,
    pub to_s: f64,
    /// Smallest and largest load and speed.
    pub load_n: (f32, f32),
    pub speed_rad_s: (f32, f32),
    /// Smallest and largest temperature measured in it, °C.
    pub temperature_c: Option<(f32, f32)>,
    /// Squeals with their onset or a part of them in it, without harmonics; the level and frequency of the loudest.
    pub squeals: usize,
    pub level_db: Option<f64>,
    pub frequency_hz: Option<f64>,
}

/// The bin of a time; `None` if it is empty.
pub fn at(history: &History, time_s: f64) -> Option<&Bin> {
    let index = (time_s * 1e9 / history.bin_ns() as f64).floor() as i64;
    history.since(index).next().filter(|bin| bin.index == index)
}

/// The applications in order, with the squeals in them.
pub fn applications<'a>(history: &History, squeals: impl Iterator<Item = &'a SquealInSound>) -> Vec<Application> {
    let highest = |index: usize| {
        let highest = |bin: &Bin| bin.ranges[index].map_or(0.0, |(low, high)| low.abs().max(high.abs()));
        history.bins().iter().map(highest).fold(0.0, f32::max)
    };
    let (least_load, least_speed) = (LEAST_LOAD * highest(0), LEAST_SPEED * highest(1));
    let bin_s = history.bin_ns() as f64 * 1e-9;
    let mut found: Vec<Application> = vec![];
    for bin in history.bins() {
        let (Some(load_n), Some(speed_rad_s)) = (bin.ranges[0], bin.ranges[1]) else { continue };
        let speed = speed_rad_s.0.abs().max(speed_rad_s.1.abs());
        if load_n.1 < least_load || speed < least_speed || load_n.1 <= 0.0 || speed <= 0.0 {
            continue;
        }
        let (from_s, to_s) = (bin.index as f64 * bin_s, (bin.index + 1) as f64 * bin_s);
        match found.last_mut().filter(|last| from_s - last.to_s < SHORTEST_S) {
            Some(last) => {
                let joined = |a: (f32, f32), b: (f32, f32)| (a.0.min(b.0), a.1.max(b.1));
                last.to_s = to_s;
                (last.load_n, last.speed_rad_s) = (joined(last.load_n, load_n), joined(last.speed_rad_s, speed_rad_s));
                last.temperature_c = both(last.temperature_c, bin.temperature_c);
            }
            None => found.push(Application {
                from_s,
                to_s,
                load_n,
                speed_rad_s,
                temperature_c: bin.temperature_c,
                squeals: 0,
                level_db: None,
                frequency_hz: None,
            }),
        }
    }
    found.retain(|application| application.to_s - application.from_s >= SHORTEST_S);
    for squeal in squeals.filter(|squeal| squeal.verdict != "harmonic") {
        let end_s = squeal.end_s.unwrap_or(f64::INFINITY);
        let during = found.iter_mut().filter(|one| squeal.onset_s < one.to_s && end_s > one.from_s);
        for application in during {
            application.squeals += 1;
            if application.level_db.is_none_or(|level_db| squeal.level_db > level_db) {
                (application.level_db, application.frequency_hz) = (Some(squeal.level_db), Some(squeal.frequency_hz));
            }
        }
    }
    found
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::display::events::tests::sample;
    use crate::display::heard::SquealsInSound;
    use crate::msgs::{Header, Heard, Time, heard_state, heard_verdict};
    use crate::node::status::Status;

    fn heard(number: u64, from_s: f64, to_s: f64, level_db: f64, verdict: u8) -> Heard {
        let stamp = |s: f64| Time::from_ns((s * 1e9) as i64);
        let header = Header { stamp: stamp(from_s), frame_id: String::new() };
        let state = heard_state::ENDED;
        Heard {
            header,
            number,
            state,
            end_stamp: stamp(to_s),
            level_db,
            frequency_hz: 2000.0,
            verdict,
            ..Heard::default()
        }
    }

    /// 60 s of samples every 50 ms; the load is on from 5 to 10 s, from 10.2 to 12 s, from 20 to 30 s and from 40 to 40.2 s.
    #[test]
    fn stretches_of_sliding_under_load_are_applications_with_their_squeal() {
        let mut history = History::coarsening(50_000_000, 3000);
        for k in 0..1200 {
            let time_s = 0.05 * f64::from(k) + 0.01;
            let on =
                [(5.0, 10.0), (10.2, 12.0), (20.0, 30.0), (40.0, 40.2)].iter().any(|&(a, b)| (a..b).contains(&time_s));
            let mut one = sample((time_s * 1e9) as i64, 0.5, Status::Ok);
            one.normal_load_n = if on { 500.0 } else { 5.0 };
            one.disc_speed_rad_s = 10.0;
            history.push(&one);
            // From 20 °C, by 1 K/s, measured twice a second until 25 s.
            if k % 10 == 0 && time_s < 25.0 {
                history.push_temperature((time_s * 1e9) as i64, 20.0 + time_s);
            }
        }
        let mut squeals = SquealsInSound::default();
        for one in [
            heard(1, 6.0, 7.0, 80.0, heard_verdict::HIT),
            heard(2, 11.0, 11.5, 85.0, heard_verdict::MISS),
            heard(3, 21.0, 22.0, 99.0, heard_verdict::HARMONIC),
            heard(4, 50.0, 51.0, 99.0, heard_verdict::MISS),
        ] {
            squeals.push(&one, one.header.stamp.as_ns());
        }
        let found = applications(&history, squeals.iter());
        let times: Vec<(f64, f64)> = found.iter().map(|one| (one.from_s.round(), one.to_s.round())).collect();
        assert_eq!(times, [(5.0, 12.0), (20.0, 30.0)]);
        assert_eq!((found[0].squeals, found[0].level_db, found[0].load_n), (2, Some(85.0), (500.0, 500.0)));
        assert_eq!((found[1].squeals, found[1].level_db), (0, None));
        let range = |one: &Application| one.temperature_c.map(|(low, high)| (low.round(), high.round()));
        assert_eq!((range(&found[0]), range(&found[1])), (Some((25.0, 32.0)), Some((40.0, 45.0))));
        let (known_s, celsius) = history.temperature_before(50.0).expect("the last one");
        assert!((celsius - 44.5).abs() < 0.1 && (known_s - 24.5).abs() < 0.2, "{known_s} {celsius}");
        assert!(history.temperature_before(-1.0).is_none());
        assert_eq!(at(&history, 6.01).and_then(|bin| bin.ranges[0]), Some((500.0, 500.0)));
        assert!(at(&history, 100.0).is_none());
    }
}

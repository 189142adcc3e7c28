//! Detection of squeal: what it costs, and what it finds against the ratio of signal to noise. `cargo bench --bench sound`.
//!
//! The squeals are planted by `squealcast::sound::simulated`: frequencies from 1.3 to 15 kHz and growth rates from 20 to 300
//! 1/s, both log-uniform, 95 dB(A) when saturated, 0.3 to 1 s long, over white noise. The ratio is that of the saturated
//! squeal to the noise in the band from 1.25 to 16 kHz, both A-weighted. SQUEALCAST_MEASURE=1 takes ten times as many.

use std::time::Instant;

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use squealcast::sound::simulated::{Drive, Planted, SimulatedSound, SoundSettings};
use squealcast::sound::waveform::stamp_ns;
use squealcast::sound::{Channel, Detection, Detector, Settings, Squeal, Unit};

const RATE_HZ: f64 = 51_200.0;
const SNRS_DB: [f64; 11] = [-20.0, -15.0, -10.0, -5.0, 0.0, 5.0, 10.0, 15.0, 20.0, 30.0, 40.0];
const BLOCK: usize = 1024;
/// Four channels at 51.2 kHz may take this share of one core.
const SHARE_OF_A_CORE: f64 = 0.08;

fn main() {
    let times = if std::env::var_os("SQUEALCAST_MEASURE").is_some() { 10 } else { 1 };
    cost();
    curve(50 * times);
    noise_alone(360.0 * times as f64);
}

fn detector() -> Detector {
    let channel =
        Channel { name: "microphone".to_owned(), sample_rate_hz: RATE_HZ, unit: Unit::Pascal, sensitivity: None };
    Detector::new(&channel, Settings::default()).expect("the defaults are valid")
}

/// The squeals in samples that arrive in blocks.
fn detect(detector: &mut Detector, samples: &[f32]) -> Vec<Squeal> {
    let mut found = vec![];
    for (k, block) in samples.chunks(BLOCK).enumerate() {
        detector.push(stamp_ns(0, (k * BLOCK) as u64, RATE_HZ), block, &mut found);
    }
    detector.finish(&mut found);
    found.into_iter().filter_map(Detection::ended).collect()
}

/// `events` squeals, 2 s apart.
fn planted(snr_db: f64, events: usize, seed: u64) -> (Vec<f32>, Vec<Planted>) {
    let defaults = SoundSettings::default();
    let settings = SoundSettings { seed, noise_db: defaults.saturated_db - snr_db, ..defaults };
    let mut sound = SimulatedSound::new(settings);
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let mut samples = vec![];
    for mode_id in 0..events as u32 {
        let mut between = |low: f64, high: f64| low * (high / low).powf(random.random::<f64>());
        let (frequency_hz, growth_rate_per_s) = (between(1300.0, 15_000.0), between(20.0, 300.0));
        // 65 dB of growth are 7.5 e-folds of the amplitude.
        let (grows_s, holds_s) = (7.5 / growth_rate_per_s, between(0.3, 1.0));
        let sounds = ((grows_s + holds_s) * RATE_HZ) as usize;
        let drive = Drive { mode_id, frequency_hz, growth_rate_per_s };
        sound.advance(&[], 0.0, 10_240, &mut samples);
        sound.advance(&[drive], 0.0, sounds, &mut samples);
        sound.advance(&[], 50.0, (2.0 * RATE_HZ) as usize - 10_240 - sounds, &mut samples);
    }
    (samples, sound.planted())
}

fn cost() {
    println!("four channels at 51.2 kHz in blocks of {BLOCK}, share of one core (at most {SHARE_OF_A_CORE}):");
    for (name, snr_db, events) in [("squeal half of the time", 30.0, 15), ("noise above the threshold", -20.0, 15)] {
        let channels: Vec<Vec<f32>> = (0..4).map(|seed| planted(snr_db, events, seed).0).collect();
        let duration_s = channels[0].len() as f64 / RATE_HZ;
        let mut shares: Vec<f64> = (0..3)
            .map(|_| {
                let mut detectors: Vec<Detector> = (0..4).map(|_| detector()).collect();
                let mut squeals = 0;
                let started = Instant::now();
                for (detector, samples) in detectors.iter_mut().zip(&channels) {
                    squeals += detect(detector, samples).len();
                }
                let share = started.elapsed().as_secs_f64() / duration_s;
                assert!(snr_db < 0.0 || squeals >= 4 * events, "{squeals} squeals of {}", 4 * events);
                share
            })
            .collect();
        shares.sort_by(f64::total_cmp);
        println!("  {name}: {:.4}, {:.4} to {:.4} in 3 runs", shares[1], shares[0], shares[2]);
        assert!(cfg!(debug_assertions) || shares[0] <= SHARE_OF_A_CORE, "{name} takes {:.4} of a core", shares[0]);
    }
}

/// Median and 95th percentile.
fn spread(values: &mut [f64]) -> String {
    values.sort_by(f64::total_cmp);
    let at = |share: f64| values.get((share * (values.len() as f64 - 1.0)).round() as usize);
    match (at(0.5), at(0.95)) {
        (Some(median), Some(most)) if !values.is_empty() => format!("{median:.3}/{most:.3}"),
        _ => "-".to_owned(),
    }
}

fn curve(events: usize) {
    println!("\n{events} planted squeals at each ratio; errors as median/95th percentile:");
    println!(
        "  SNR, dB  found, %  false/h  frequency, Hz  exact, %  level, dB     onset, ms      growth, %      measured, %  \
         within 10 %, %"
    );
    for snr_db in SNRS_DB {
        let (samples, truth) = planted(snr_db, events, 100 + snr_db.abs() as u64);
        assert_eq!(truth.len(), events);
        let squeals = detect(&mut detector(), &samples);
        let seconds = |ns: i64| ns as f64 * 1e-9;
        let same = |squeal: &Squeal, planted: &Planted| {
            let near = (squeal.frequency_hz / planted.frequency_hz - 1.0).abs() < 0.01;
            near && seconds(squeal.end_ns) > planted.onset_s
                && seconds(squeal.onset_ns) < planted.end_s.unwrap_or(f64::INFINITY)
        };
        let alarms = squeals.iter().filter(|squeal| !truth.iter().any(|planted| same(squeal, planted))).count();
        // The first part of a squeal that noise has divided.
        let found: Vec<(&Planted, &Squeal)> = truth
            .iter()
            .filter_map(|planted| Some((planted, squeals.iter().find(|squeal| same(squeal, planted))?)))
            .collect();
        let errors = |error: &dyn Fn(&Planted, &Squeal) -> Option<f64>| -> Vec<f64> {
            found.iter().filter_map(|(planted, squeal)| error(planted, squeal).map(f64::abs)).collect()
        };
        let mut frequency = errors(&|p, s| Some(s.frequency_hz - p.frequency_hz));
        let exact = found
            .iter()
            .filter(|(p, s)| (s.frequency_hz - p.frequency_hz).abs() <= f64::max(1.0, 5e-4 * p.frequency_hz))
            .count();
        let mut level = errors(&|p, s| Some(s.level_db - p.level_db));
        let mut onset = errors(&|p, s| Some(1e3 * (seconds(s.onset_ns) - p.onset_s)));
        let mut growth = errors(&|p, s| Some(100.0 * (s.growth?.rate_per_s / p.growth_rate_per_s - 1.0)));
        let share = |part: usize, all: usize| 100.0 * part as f64 / all.max(1) as f64;
        let within = growth.iter().filter(|error| **error <= 10.0).count();
        println!(
            "  {snr_db:>7}  {:>8.1}  {:>7.1}  {:<13}  {:>8.1}  {:<12}  {:<13}  {:<13}  {:>11.1}  {:>14.1}",
            share(found.len(), events),
            alarms as f64 / (samples.len() as f64 / RATE_HZ / 3600.0),
            spread(&mut frequency),
            share(exact, found.len()),
            spread(&mut level),
            spread(&mut onset),
            spread(&mut growth),
            share(growth.len(), found.len()),
            share(within, growth.len()),
        );
        // What is promised from 20 dB on.
        if snr_db >= 20.0 {
            assert_eq!((found.len(), alarms), (events, 0), "at {snr_db} dB");
            assert!(share(exact, found.len()) >= 95.0 && level[level.len() * 19 / 20] <= 0.5, "at {snr_db} dB");
            assert!(onset[onset.len() * 19 / 20] <= 10.0, "at {snr_db} dB");
        }
    }
}

/// False alarms in noise whose bins of 25 Hz are around the threshold, where most tones could pass for squeal.
fn noise_alone(duration_s: f64) {
    println!("\nfalse alarms in white noise alone, {:.2} hours each:", duration_s / 3600.0);
    for noise_db in [85.0, 95.0, 105.0] {
        let mut sound = SimulatedSound::new(SoundSettings { noise_db, seed: 7, ..Default::default() });
        let (mut detector, mut found, mut samples) = (detector(), vec![], vec![]);
        let mut index = 0_u64;
        while (index as f64) < duration_s * RATE_HZ {
            samples.clear();
            sound.advance(&[], 0.0, 51_200, &mut samples);
            detector.push(stamp_ns(0, index, RATE_HZ), &samples, &mut found);
            index += samples.len() as u64;
        }
        detector.finish(&mut found);
        let alarms = found.into_iter().filter_map(Detection::ended).count();
        println!("  {noise_db} dB(A): {alarms}");
    }
}

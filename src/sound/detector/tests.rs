//! Squeals planted in simulated sound, interruptions, latency and settings.

use super::*;
use crate::sound::Unit;
use crate::sound::simulated::{Drive, Planted, SimulatedSound, SoundSettings};

const RATE_HZ: f64 = 51_200.0;
const START_NS: i64 = 1_000_000_000;

fn channel(sample_rate_hz: f64) -> Channel {
    Channel { name: "microphone".to_owned(), sample_rate_hz, unit: Unit::Pascal, sensitivity: None }
}

/// The squeals that ended, in the order of their onsets, from blocks of `size` samples.
fn squeals(samples: &[f32], size: usize) -> Vec<Squeal> {
    let mut detector = Detector::new(&channel(RATE_HZ), Settings::default()).unwrap();
    let mut found = vec![];
    for (k, block) in samples.chunks(size).enumerate() {
        detector.push(stamp_ns(START_NS, (k * size) as u64, RATE_HZ), block, &mut found);
    }
    detector.finish(&mut found);
    assert_eq!(detector.counts().interruptions, 0);
    ended(&found)
}

fn ended(found: &[Detection]) -> Vec<Squeal> {
    let mut ended: Vec<Squeal> = found.iter().copied().filter_map(Detection::ended).collect();
    ended.sort_by_key(|squeal| squeal.onset_ns);
    ended
}

/// Modes that grow from 0.3 s to 1.3 s of 2 s, over noise of `noise_db`.
fn sound(noise_db: f64, harmonics_db: &[f64], modes: &[(f64, f64)]) -> (Vec<f32>, Vec<Planted>) {
    let harmonics_db = harmonics_db.to_vec();
    let mut sound = SimulatedSound::new(SoundSettings { noise_db, harmonics_db, ..Default::default() });
    let drives: Vec<Drive> = (0..)
        .zip(modes)
        .map(|(mode_id, &(frequency_hz, growth_rate_per_s))| Drive { mode_id, frequency_hz, growth_rate_per_s })
        .collect();
    let mut samples = vec![];
    sound.advance(&[], 60.0, 15_360, &mut samples);
    sound.advance(&drives, 60.0, 51_200, &mut samples);
    sound.advance(&[], 60.0, 35_840, &mut samples);
    (samples, sound.planted())
}

fn check(squeal: &Squeal, planted: &Planted) {
    let after_s = |stamp_ns: i64| (stamp_ns - START_NS) as f64 * 1e-9;
    let hz = squeal.frequency_hz - planted.frequency_hz;
    assert!(hz.abs() <= f64::max(1.0, 5e-4 * planted.frequency_hz), "{squeal:?}, planted {planted:?}");
    assert!((squeal.level_db - planted.level_db).abs() <= 0.5, "{squeal:?}, planted {planted:?}");
    assert!((after_s(squeal.onset_ns) - planted.onset_s).abs() <= 0.01, "{squeal:?}, planted {planted:?}");
    assert!((after_s(squeal.end_ns) - planted.end_s.unwrap()).abs() <= 0.01, "{squeal:?}, planted {planted:?}");
    let growth = squeal.growth.unwrap_or_else(|| panic!("{squeal:?}, planted {planted:?}"));
    let rate = growth.rate_per_s / planted.growth_rate_per_s;
    assert!((rate - 1.0).abs() <= 0.1, "{squeal:?}, planted {planted:?}");
    assert_eq!(squeal.cut, [false; 2]);
}

/// 95 dB(A) over 65 dB(A) of noise, from slow to fast growth, at both ends of the band and between.
#[test]
fn planted_squeals_are_found_with_their_values() {
    for (frequency_hz, rate) in [(1300.0, 30.0), (2512.3, 80.0), (6789.0, 200.0), (15_500.0, 400.0)] {
        let (samples, planted) = sound(65.0, &[], &[(frequency_hz, rate)]);
        let found = squeals(&samples, 1024);
        let [squeal] = found[..] else { panic!("{found:?}") };
        check(&squeal, &planted[0]);
        assert_eq!(squeal.harmonic, None);
    }
}

#[test]
fn simultaneous_squeals_are_distinguished() {
    let (samples, planted) = sound(60.0, &[], &[(1900.0, 60.0), (2000.0, 90.0), (5432.1, 150.0)]);
    let found = squeals(&samples, 1024);
    assert_eq!(found.len(), 3, "{found:?}");
    for planted in &planted {
        let near = |squeal: &&Squeal| (squeal.frequency_hz - planted.frequency_hz).abs() < 20.0;
        check(found.iter().find(near).unwrap_or_else(|| panic!("{planted:?} is not among {found:?}")), planted);
    }
}

#[test]
fn harmonics_are_recognised_and_other_tones_are_not() {
    let (samples, _) = sound(60.0, &[-15.0, -20.0], &[(2345.6, 80.0), (6000.0, 80.0)]);
    let mut found = squeals(&samples, 1024);
    found.sort_by(|a, b| a.frequency_hz.total_cmp(&b.frequency_hz));
    let orders: Vec<(f64, Option<u32>)> =
        found.iter().map(|s| (s.frequency_hz.round(), s.harmonic.map(|harmonic| harmonic.order))).collect();
    let expected = [(2346.0, None), (4691.0, Some(2)), (6000.0, None), (7037.0, Some(3)), (12_000.0, Some(2))];
    assert_eq!(orders, expected);
    assert!(found[1].harmonic.unwrap().of == found[0].number && found[4].harmonic.unwrap().of == found[2].number);
}

#[test]
fn results_do_not_depend_on_the_blocks() {
    let (samples, _) = sound(75.0, &[-20.0], &[(3000.0, 80.0), (4100.0, 20.0)]);
    let whole = squeals(&samples, samples.len());
    assert!(whole.len() >= 2, "{whole:?}");
    for size in [1, 17, 512, 1000, 4096] {
        assert_eq!(squeals(&samples, size), whole, "blocks of {size}");
    }
}

#[test]
fn noise_alone_and_tones_below_the_threshold_are_no_squeal() {
    // In a bin of 25 Hz, 75 dB of noise in the band are 49 dB: a tone of 66 dB has a standard deviation of 1.2 dB.
    for (saturated_db, noise_db) in [(66.0, 75.0), (31.0, 90.0)] {
        let mut quiet = SimulatedSound::new(SoundSettings { saturated_db, noise_db, ..Default::default() });
        let mut samples = vec![];
        let drive = Drive { mode_id: 0, frequency_hz: 3000.0, growth_rate_per_s: 100.0 };
        quiet.advance(&[drive], 60.0, 5 * 51_200, &mut samples);
        assert_eq!(squeals(&samples, 1024), []);
    }
}

#[test]
fn squeals_at_the_ends_of_a_stream_are_cut_there() {
    let samples: Vec<f32> =
        (0..51_200).map(|i| (std::f64::consts::TAU * 3000.0 * f64::from(i) / RATE_HZ).sin() as f32).collect();
    let found = squeals(&samples, 1024);
    let [squeal] = found[..] else { panic!("{found:?}") };
    assert_eq!((squeal.cut, squeal.growth, squeal.onset_ns), ([true; 2], None, START_NS));
    // Amplitude 1 Pa: 90.97 dB. IEC 61672-1 weights 2.5 kHz by 1.3 dB and 3.15 kHz by 1.2 dB, both rounded.
    assert!((squeal.level_db - 90.97 - 1.22).abs() < 0.08 && (squeal.frequency_hz - 3000.0).abs() < 0.01, "{squeal:?}");
    assert!((squeal.end_ns - START_NS - 1_000_000_000).abs() < 20_000_000, "{squeal:?}");
}

/// Missing, repeated and invalid samples are counted and named; a squeal ends at a gap and another begins after it.
#[test]
fn interruptions_are_counted_and_named() {
    let tone = |i: usize| (std::f64::consts::TAU * 3000.0 * i as f64 / RATE_HZ).sin() as f32;
    let mut detector = Detector::new(&channel(RATE_HZ), Settings::default()).unwrap();
    let mut found = vec![];
    let mut push = |detector: &mut Detector, from: usize, to: usize| {
        let block: Vec<f32> = (from..to).map(|i| if i == 100 { f32::NAN } else { tone(i) }).collect();
        detector.push(stamp_ns(START_NS, from as u64, RATE_HZ), &block, &mut found);
    };
    push(&mut detector, 0, 20_480);
    push(&mut detector, 25_600, 51_200); // 0.1 s missing
    push(&mut detector, 50_688, 61_440); // 512 samples again
    detector.finish(&mut found);
    let at = |index: u64| stamp_ns(START_NS, index, RATE_HZ);
    let counts = detector.counts();
    assert_eq!((counts.missing, counts.repeated, counts.not_finite, counts.interruptions), (5120, 512, 1, 2));
    assert_eq!(counts.samples, 20_480 + 25_600 + 10_752 - 512);
    let gap = Interruption::Gap { after_ns: at(20_480), samples: 5120 };
    assert_eq!(counts.named, [gap, Interruption::Overlap { at_ns: at(50_688), samples: 512 }]);
    let squeals = ended(&found);
    assert_eq!(squeals.len(), 2, "{squeals:?}");
    assert_eq!(squeals.iter().map(|squeal| squeal.cut).collect::<Vec<_>>(), [[true; 2]; 2]);
    assert_eq!(squeals[1].onset_ns, at(25_600));
}

/// An announcement comes within the stated latency of the onset.
#[test]
fn squeals_are_announced_within_the_latency() {
    let (samples, planted) = sound(65.0, &[], &[(2500.0, 100.0)]);
    let mut detector = Detector::new(&channel(RATE_HZ), Settings::default()).unwrap();
    let mut found = vec![];
    let pushed = samples.chunks(64).enumerate().position(|(k, block)| {
        detector.push(stamp_ns(START_NS, 64 * k as u64, RATE_HZ), block, &mut found);
        !found.is_empty()
    });
    let announced_s = 64.0 * (pushed.unwrap() + 1) as f64 / RATE_HZ;
    let latency_s = announced_s - planted[0].onset_s;
    assert!(latency_s > 0.1 && latency_s <= detector.latency_s(), "{latency_s} s, stated {} s", detector.latency_s());
    assert!(matches!(found[0], Detection::Began(squeal) if (squeal.frequency_hz - 2500.0).abs() < 5.0));
}

#[test]
fn settings_outside_their_limits_are_refused() {
    let error = |settings, rate| Detector::new(&channel(rate), settings).err().expect("refused").to_string();
    let settings = Settings { threshold_db: f64::NAN, ..Default::default() };
    assert_eq!(error(settings, RATE_HZ), "`threshold_db` is NaN, expected a finite number of -100 to 300");
    let settings = Settings { band_hz: [5000.0, 2000.0], ..Default::default() };
    assert_eq!(error(settings, RATE_HZ), "`band_hz` is 2000, expected a finite number of 5000 to 1000000");
    let settings = Settings { band_hz: [5000.0, 6000.0], ..Default::default() };
    let refused = "channel `microphone`: sampled at 8000 Hz it contains no frequency of the band 5000 to 6000 Hz";
    assert_eq!(error(settings, 8000.0), refused);
    let slow = Detector::new(&channel(8000.0), Settings::default()).unwrap();
    assert_eq!(slow.band_hz(), [1250.0, 3937.5]);
}

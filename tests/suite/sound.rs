//! `hear`: squeal in WAV files whose tones are known, and in the sound of simulated sessions; spectra against scipy
//! (`tests/peers/scipy_spectra.py`).

use std::f64::consts::TAU;
use std::path::Path;
use std::process::Command;

use crate::program::{self, folder, json, number, python, run, text};
use crate::sound_beside_logs::{Simulated, simulated};
use serde_json::Value;
use squealcast::import::samples::SampleFile;
use squealcast::sound::{self, spectrum::Spectra};

const RATE_HZ: u32 = 48_000;

/// A WAV file of integers of `bytes` each, from samples in parts of full scale, channel by channel.
fn wav(path: &Path, bytes: u16, channels: &[Vec<f64>]) -> String {
    let count = channels.len() as u16;
    let mut data = vec![];
    for k in 0..channels[0].len() {
        for channel in channels {
            let value = (channel[k] * 2.0_f64.powi(i32::from(8 * bytes) - 1)).round() as i32;
            data.extend_from_slice(&value.to_le_bytes()[..usize::from(bytes)]);
        }
    }
    let mut file = b"RIFF\0\0\0\0WAVEfmt \x10\0\0\0\x01\0".to_vec();
    file.extend(count.to_le_bytes());
    file.extend(RATE_HZ.to_le_bytes());
    file.extend((RATE_HZ * u32::from(bytes * count)).to_le_bytes());
    file.extend([(bytes * count).to_le_bytes(), (8 * bytes).to_le_bytes()].concat());
    file.extend(b"data");
    file.extend((data.len() as u32).to_le_bytes());
    file.extend(data);
    std::fs::write(path, file).expect("a test can write its files");
    text(path)
}

/// A tone of `amplitude` between two times, with flanks of 10 ms.
fn tone(duration_s: f64, frequency_hz: f64, amplitude: f64, from_s: f64, to_s: f64) -> Vec<f64> {
    let count = (duration_s * f64::from(RATE_HZ)) as usize;
    let sample = |k: usize| {
        let t = k as f64 / f64::from(RATE_HZ);
        let flank = ((t - from_s).min(to_s - t) / 0.01).clamp(0.0, 1.0);
        amplitude * (0.25 * TAU * flank).sin().powi(2) * (TAU * frequency_hz * t).sin()
    };
    (0..count).map(sample).collect()
}

fn squeals(report: &Value, channel: usize) -> &Vec<Value> {
    report["channels"][channel]["squeals"].as_array().expect("squeals")
}

/// Amplitude 0.5 of full scale at 0.1 FS/Pa: 5 Pa, 104.95 dB; A-weighting of IEC 61672-1 at 4 kHz: 1.0 dB, rounded to 0.1.
/// In m/s², 5 are 130.97 dB re 1 µm/s². A flank of 10 ms passes 70 dB(A), a fiftieth of the amplitude, at 0.9 ms.
#[test]
fn squeals_of_a_file_have_their_frequency_level_and_time_in_every_resolution() {
    let folder = folder();
    let samples = [tone(2.0, 4000.0, 0.5, 0.5, 1.2), tone(2.0, 2345.6, 0.5, 1.0, 1.5)];
    for bytes in [2, 3, 4] {
        let file = wav(&folder.path().join("a.wav"), bytes, &samples);
        let found = json(["hear", &file, "--sensitivity", "0.1 FS/Pa", "--json"]);
        let [squeal] = squeals(&found, 0).as_slice() else { panic!("{found}") };
        assert!((number(squeal, "frequency_hz") - 4000.0).abs() < 0.1, "{squeal}");
        assert!((number(squeal, "level_db") - 105.95).abs() < 0.1, "{squeal}");
        assert!(
            (number(squeal, "onset_s") - 0.5).abs() < 0.003 && (number(squeal, "end_s") - 1.2).abs() < 0.003,
            "{squeal}"
        );
        let [squeal] = squeals(&found, 1).as_slice() else { panic!("{found}") };
        assert!((number(squeal, "frequency_hz") - 2345.6).abs() < 0.1, "{squeal}");
        assert_eq!((number(&found, "sample_rate_hz"), number(&found, "missing_bytes")), (48_000.0, 0.0));
    }
    let file = wav(&folder.path().join("a.wav"), 2, &samples);
    let args = ["hear", &file, "--sensitivity", "0.1 FS/(m/s²)", "--json", "--channel", "1"];
    let found = json(args);
    let [squeal] = squeals(&found, 0).as_slice() else { panic!("{found}") };
    assert!((number(squeal, "level_db") - 130.97).abs() < 0.05, "{squeal}");
    assert_eq!(found["channels"][0]["level_unit"], "dB re 1 µm/s²");
}

/// A tone that rises by 50 Hz/s, from 2000 to 2150 Hz: its mean frequency over the time is 2075 Hz. 0.5 Pa are 84.95 dB, with
/// the A-weighting of IEC 61672-1 at 2 kHz, 1.2 dB, 86.15 dB(A); at 2.5 kHz it is 1.3 dB.
#[test]
fn a_tone_that_drifts_is_one_squeal_with_its_mean_frequency_and_level() {
    let folder = folder();
    let sample = |k: usize| {
        let t = k as f64 / f64::from(RATE_HZ) - 0.5;
        let flank = (t.min(3.0 - t) / 0.01).clamp(0.0, 1.0);
        0.5 * (0.25 * TAU * flank).sin().powi(2) * (TAU * (2000.0 * t + 25.0 * t * t)).sin()
    };
    let samples: Vec<f64> = (0..4 * RATE_HZ as usize).map(sample).collect();
    let file = wav(&folder.path().join("a.wav"), 3, &[samples]);
    let found = json(["hear", &file, "--sensitivity", "1 FS/Pa", "--json"]);
    let [squeal] = squeals(&found, 0).as_slice() else { panic!("{found}") };
    assert!((number(squeal, "frequency_hz") - 2075.0).abs() < 1.0, "{squeal}");
    assert!((number(squeal, "level_db") - 86.15).abs() < 0.1, "{squeal}");
    let times = (number(squeal, "onset_s"), number(squeal, "end_s"));
    assert!((times.0 - 0.5).abs() < 0.005 && (times.1 - 3.5).abs() < 0.005, "{squeal}");
}

#[test]
fn tables_and_csv_hold_the_squeals_and_options_select_them() {
    let folder = folder();
    let samples = [tone(2.0, 4000.0, 0.5, 0.5, 1.2), tone(2.0, 2345.6, 0.5, 1.0, 1.5)];
    let file = wav(&folder.path().join("a.wav"), 2, &samples);
    let csv = text(&folder.path().join("a.csv"));
    let hear = ["hear", file.as_str(), "--sensitivity", "0.1 FS/Pa"];
    let with = |more: &[&str]| run(hear.iter().chain(more).copied());
    let shown = with(&["--csv", &csv]).exits(0);
    assert!(shown.stdout.contains("2.000 s, 48000 Hz, 16 bit, 2 channels"), "{}", shown.stdout);
    assert!(shown.stdout.contains("channel 1: 1 squeal of at least 70 dB(A)"), "{}", shown.stdout);
    assert!(shown.stdout.contains("4000.0"), "{}", shown.stdout);
    let lines: Vec<String> = std::fs::read_to_string(&csv).expect("the file").lines().map(str::to_owned).collect();
    assert_eq!(lines.len(), 3, "{lines:?}");
    assert!(lines[0].starts_with("channel,number,onset_s,end_s,") && lines[2].starts_with("2,1,1.00"), "{lines:?}");
    with(&["--channel", "2"]).exits(0).says("channel 2: 1 squeal");
    with(&["--channel", "3"]).exits(1).complains("--channel is 3, expected 1 to the 2 of");
    with(&["--threshold-db", "107", "--channel", "1"]).exits(0).says("channel 1: 0 squeals of at least 107");
    with(&["--band-hz", "3000:16000"]).exits(0).says("channel 1: 1 squeal").says("channel 2: 0 squeals");
    with(&["--band-hz", "3000:2000"]).exits(2).complains("3000 is not less than 2000");
    with(&["--min-duration-s", "0.6"]).exits(0).says("channel 1: 1 squeal").says("channel 2: 0 squeals");
    run(["hear", &file]).exits(1).complains("its samples are in FS; a sensitivity is needed, such as 0.1 FS/Pa");
    run(["hear", "--help"]).exits(0).says("squealcast hear test.wav --sensitivity");
}

/// A calibrator of 94 dB (1.0024 Pa) recorded with an amplitude of 0.1: full scale is 14.2 Pa.
#[test]
fn the_recording_of_a_calibrator_gives_the_sensitivity() {
    let folder = folder();
    let file = wav(&folder.path().join("a.wav"), 3, &[tone(2.0, 4000.0, 0.5, 0.5, 1.2)]);
    let calibrator = wav(&folder.path().join("calibrator.wav"), 3, &[tone(2.0, 1000.0, 0.1, -1.0, 3.0)]);
    let found = json(["hear", &file, "--calibration", &calibrator, "--json"]);
    // 20 lg 5 = 13.98 dB more than the calibrator, and 1.0 dB of A-weighting.
    assert!((number(&squeals(&found, 0)[0], "level_db") - 94.0 - 13.98 - 1.0).abs() < 0.1, "{found}");
    let found = json(["hear", &file, "--calibration", &calibrator, "--calibration-db", "114", "--json"]);
    assert!((number(&squeals(&found, 0)[0], "level_db") - 114.0 - 13.98 - 1.0).abs() < 0.1, "{found}");
    run(["hear", &file, "--calibration", &file]).exits(1).complains("expected a steady tone");
    run(["hear", &file, "--calibration", &calibrator, "--unit", "Pa"]).exits(1).complains("needs no calibrator");
}

/// All samples of the one channel of a file.
fn samples_of(path: &Path) -> (f64, Option<sound::Unit>, Vec<f32>) {
    let mut file = SampleFile::open(path).unwrap_or_else(|error| panic!("{error}"));
    let mut samples = vec![vec![]];
    while file.read(1 << 16, &mut samples).expect("read") > 0 {}
    (file.sample_rate_hz(0), file.unit(0), samples.remove(0))
}

/// The same samples written by scipy, pyuff, asammdf, nptdms and h5py, the last three converted by the lines of
/// launch/SAMPLES.md.
#[test]
fn files_of_other_programs_have_the_same_samples() {
    let python = python();
    if !program::python_has(&python, "numpy, scipy") {
        return;
    }
    let folder = folder();
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let output = Command::new(&python)
        .arg(root.join("tests/peers/sample_files.py"))
        .args([folder.path(), &root.join("launch/SAMPLES.md")])
        .output()
        .expect("Python starts");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let report: Value = serde_json::from_slice(&output.stdout).expect("JSON");
    eprintln!("compared with {report}");
    let (rate_hz, _, reference) = samples_of(&folder.path().join("reference.wav"));
    assert_eq!((rate_hz, reference.len()), (51_200.0, 76_800));
    for name in report["written"].as_array().expect("names").iter().map(|name| name.as_str().expect("a name")) {
        let (rate_hz, unit, samples) = samples_of(&folder.path().join(name));
        assert_eq!(rate_hz, 51_200.0, "{name}");
        assert_eq!(unit, (!name.ends_with(".wav")).then_some(sound::Unit::Pascal), "{name}");
        if name == "text.uff" {
            // Six digits.
            let near = |(a, b): (&f32, &f32)| (a - b).abs() <= 5.1e-6 * b.abs();
            assert!(samples.len() == reference.len() && samples.iter().zip(&reference).all(near), "{name}");
        } else {
            assert!(samples == reference, "{name}");
        }
        let found = json(["hear", &text(&folder.path().join(name)), "--unit", "Pa", "--json"]);
        let [squeal] = squeals(&found, 0).as_slice() else { panic!("{name}: {found}") };
        assert!((number(squeal, "frequency_hz") - 3210.5).abs() < 0.1, "{name}: {squeal}");
    }
    let csv = run(["hear", &text(&folder.path().join("test.csv"))]).exits(0);
    assert!(csv.stderr.contains("omitted column `load`: unit `N`"), "{}", csv.stderr);
    assert!(csv.stdout.contains("channel 1 (microphone): 1 squeal of at least 70 dB(A)"), "{}", csv.stdout);
}

#[test]
fn damaged_files_are_named_with_position_and_expectation() {
    let folder = folder();
    let path = folder.path().join("a.wav");
    let file = wav(&path, 2, &[tone(2.0, 4000.0, 0.5, 0.5, 1.2)]);
    let whole = std::fs::read(&path).expect("the file");
    let hear = ["hear", &file, "--sensitivity", "0.1 FS/Pa"];
    // Cut off within the squeal: it is found, and what is missing is reported.
    std::fs::write(&path, &whole[..44 + 2 * 48_000]).expect("a test can write its files");
    run(hear).exits(3).complains("96000 bytes of samples are missing at its end").says("goes on after the samples");
    std::fs::write(&path, &whole[..30]).expect("a test can write its files");
    run(hear).exits(1).complains("a.wav, byte 20: 10 bytes up to the end of the file, expected the 16 bytes");
    std::fs::write(&path, b"hello\n").expect("a test can write its files");
    run(hear).exits(1).complains("line 1: `hello`, expected a WAV file, a Universal File");
    run(["hear", "/dev/zero", "--sensitivity", "0.1 FS/Pa"]).exits(1).complains("is a device");
    let slow = [&whole[..24], &100_u32.to_le_bytes(), &whole[28..]].concat();
    std::fs::write(&path, slow).expect("a test can write its files");
    run(hear).exits(1).complains("`sample_rate_hz` is 100, expected 8000 to 204800");
}

/// Both compute in double precision: 1e-6 is what is promised, 1e-12 of the largest bin what rounding may leave in a bin
/// where contributions cancel.
#[test]
fn spectra_are_those_of_scipy() {
    let python = python();
    if !program::python_has(&python, "numpy, scipy") {
        return;
    }
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/peers/scipy_spectra.py");
    let output = Command::new(&python).arg(script).output().expect("Python starts");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let expected: Value = serde_json::from_slice(&output.stdout).expect("JSON");
    eprintln!("compared with {}", expected["versions"]);
    let numbers = |list: &Value| -> Vec<f64> {
        list.as_array().expect("a list").iter().map(|value| value.as_f64().expect("a number")).collect()
    };
    let mut compared = 0;
    for case in expected["cases"].as_array().expect("cases") {
        let (length, hop) = (number(case, "length") as usize, number(case, "hop") as usize);
        let samples = numbers(&case["samples"]);
        let mut spectra = Spectra::new(length);
        for (index, expected) in case["power"].as_array().expect("frames").iter().enumerate() {
            let expected = numbers(expected);
            let found = spectra.power(samples[index * hop..index * hop + length].iter().copied());
            assert_eq!(found.len(), expected.len());
            let largest = expected.iter().copied().fold(0.0, f64::max);
            for (k, (found, expected)) in found.iter().zip(&expected).enumerate() {
                let off = (found - expected).abs();
                assert!(off <= 1e-6 * expected + 1e-12 * largest, "bin {k}: {found:e}, scipy {expected:e}");
                compared += 1;
            }
        }
    }
    assert!(compared > 5000, "{compared} bins");
}

/// The tribometer of the demo squeals at friction coefficients near 1: what is planted in its sound is found, and is what
/// was predicted.
#[test]
fn the_sound_of_a_simulated_session_is_found_and_meets_its_predictions() {
    let Simulated { folder, sessions, sound, truth, .. } = simulated();
    // A mode of 730 Hz, which grows too, is below the band.
    let planted = truth["squeals"].as_array().expect("squeals").iter();
    let planted: Vec<&Value> = planted.filter(|squeal| number(squeal, "frequency_hz") > 1250.0).collect();
    assert!(!planted.is_empty(), "{truth}");

    let met = json(["hear", &sound, "--unit", "Pa", "--against", &sessions, "--json"]);
    let found = squeals(&met, 0);
    for planted in &planted {
        let near = |squeal: &&Value| {
            let off = number(squeal, "frequency_hz") / number(planted, "frequency_hz") - 1.0;
            off.abs() < 0.01 && (number(squeal, "onset_s") - number(planted, "onset_s")).abs() < 0.02
        };
        // The frequency moves with the conditions, so its mean over the steady part is not that of the whole.
        let squeal = found.iter().find(near).unwrap_or_else(|| panic!("{planted} is not among {met}"));
        assert!((number(squeal, "level_db") - number(planted, "level_db")).abs() < 1.0, "{squeal}, planted {planted}");
    }
    let scores = &met["channels"][0]["against"];
    assert_eq!(scores["score"]["misses"], 0, "{scores}");
    assert_eq!(number(scores, "recall"), 1.0);
    assert!(number(&scores["score"], "hits") >= planted.len() as f64, "{scores}");
    let shown = run(["hear", &sound, "--unit", "Pa", "--against", &sessions]).exits(0);
    assert!(shown.stdout.contains("recall     1.000: ") && shown.stdout.contains("MCC  "), "{}", shown.stdout);
    eprintln!("{}", shown.stdout);

    // Sound of another time.
    let late = ["hear", &sound, "--unit", "Pa", "--against", &sessions, "--offset-s", "100"];
    run(late).exits(1).complains("no time in common; --offset-s shifts the sound");
    let bag = text(&folder.path().join("empty"));
    run(["hear", &sound, "--unit", "Pa", "--against", &bag]).exits(1).complains("empty");
    run(["simulate", "--sound", &sound]).exits(2).complains("--record");
}

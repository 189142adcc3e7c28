//! The page in Debian's Chromium.

use std::collections::HashMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};

use super::{Shown, alone, browse, browser_ready};
use crate::program::{self, PATIENCE, measuring, npz_bytes};
use crate::sound_beside_logs::simulated;
use squealcast::msgs::{Header, OperatingPoint, Prediction, Time, Waveform};
use squealcast::offline::{self, Measured, Quantity, START_NS};
use squealcast::recording::message::Payload;
use squealcast::recording::reader::{Recorded, Recording};
use squealcast::rig::Rig;

/// Predictions of a recording with their conditions, by sequence number.
fn predictions(directory: &Path) -> HashMap<u64, (OperatingPoint, Prediction)> {
    let session = std::fs::read_dir(directory).unwrap().next().unwrap().unwrap().path();
    let mut inputs = HashMap::new();
    let mut predictions = HashMap::new();
    for entry in Recording::open(&session).unwrap().messages() {
        match entry.message {
            Recorded::Known(Payload::OperatingPoint(input)) => drop(inputs.insert(input.seq, input)),
            Recorded::Known(Payload::Prediction(prediction)) => {
                if let Some(input) = inputs.get(&prediction.input_seq) {
                    predictions.insert(prediction.input_seq, (OperatingPoint::clone(input), prediction));
                }
            }
            _ => {}
        }
    }
    predictions
}

#[test]
fn the_page_shows_a_demo_as_it_is() {
    let _alone = alone();
    if !browser_ready() {
        return;
    }
    let directory = tempfile::tempdir().unwrap();
    let shown = Shown::demo(&["--rate", "200", "--record", directory.path().to_str().unwrap()]);
    let seen = browse("live.mjs", &[&format!("http://{}/", shown.address)]);
    shown.stop();

    // Every number on the page against the prediction that was published for the same input.
    let published = predictions(directory.path());
    let moments = seen["shown"].as_array().unwrap();
    assert!(moments.len() > 10);
    for moment in moments {
        let seq: u64 = moment["seq"].as_str().unwrap().parse().unwrap();
        let (input, prediction) = &published[&seq];
        // The level is there at once, the numbers follow every 0.3 s: within 0.5 s of them there was such a prediction.
        let level = moment["level"].as_str().unwrap();
        let near = (seq.saturating_sub(100)..seq + 100).filter_map(|seq| published.get(&seq));
        let levels: Vec<String> =
            near.map(|(_, near)| squealcast::msgs::level::name(near.level).to_lowercase()).collect();
        assert!(levels.iter().any(|near| near == level), "{level} about input {seq}");
        let numbers = &moment["numbers"];
        for (name, value) in [
            ("margin", prediction.friction_margin),
            ("growth", prediction.max_growth_rate_per_s),
            ("worst", prediction.worst_frequency_hz),
            ("unstable", f64::from(prediction.unstable_modes)),
            ("mu", input.friction_coefficient),
            ("load", input.normal_load_n),
            ("speed", input.disc_speed_rad_s),
        ] {
            let (exact, text) =
                (numbers[name]["value"].as_str().unwrap(), numbers[name]["text"].as_str().unwrap().replace('−', "-"));
            if value.is_finite() {
                assert_eq!(exact.parse::<f64>().unwrap().to_bits(), value.to_bits(), "{name} of input {seq}");
                let decimals = text.split_once('.').map_or(0, |(_, decimals)| decimals.len());
                let half = 0.5 * 10f64.powi(-(decimals as i32)) * (1.0 + 1e-9);
                assert!((text.parse::<f64>().unwrap() - value).abs() <= half, "{name} of input {seq}: {text}, {value}");
            } else {
                assert_eq!((exact, text.as_str()), ("", "–"), "{name} of input {seq}");
            }
        }
        // What squeals next is the end of a window that the margin is measured to.
        if let Ok(end) = numbers["answer-mu"]["value"].as_str().unwrap().parse::<f64>() {
            let (away, margin) = ((end - input.friction_coefficient).abs(), prediction.friction_margin.abs());
            assert!(
                (away - margin).abs() < 1e-6,
                "input {seq}: the end at {end} is {away} away, the margin is {margin}"
            );
        }
        let modes = moment["modes"].as_array().unwrap();
        assert_eq!(modes.len(), prediction.modes.len());
        for mode in modes {
            let known =
                prediction.modes.iter().find(|known| u64::from(known.id) == mode["id"].as_u64().unwrap()).unwrap();
            let values = [
                known.frequency_hz,
                known.growth_rate_per_s,
                known.damping_ratio,
                known.pad_participation,
                known.frequency_error_hz,
                known.growth_rate_error_per_s,
            ];
            assert_eq!(mode["values"].as_array().unwrap().len(), values.len());
            for (shown, value) in mode["values"].as_array().unwrap().iter().zip(values) {
                // Unknown values, such as the pad's share of a charted cluster, are shown as empty.
                let exact = shown.as_str().unwrap().parse().ok();
                assert_eq!(exact, value.is_finite().then_some(value), "mode {} of input {seq}", known.id);
            }
        }
    }
    let squealed = |moment: &&serde_json::Value| {
        let seq: u64 = moment["seq"].as_str().unwrap().parse().unwrap();
        published[&seq].1.level == squealcast::msgs::level::SQUEAL
    };
    assert!(moments.iter().any(|moment| squealed(&moment)) && !moments.iter().all(|moment| squealed(&moment)));
    println!("first paint {} ms, page work {} of a core", seen["first_paint_ms"], seen["work"]);
    if measuring() {
        assert!(seen["first_paint_ms"].as_f64().unwrap() < 1000.0, "first paint after {} ms", seen["first_paint_ms"]);
        assert!(seen["work"].as_f64().unwrap() < 0.2, "the page takes {} of a core", seen["work"]);
    }
    assert!(seen["csv"].as_str().unwrap().contains(",SQUEAL,"));
}

/// Fields of an answer, sorted.
fn fields(answer: &serde_json::Value) -> Vec<&str> {
    let mut fields: Vec<&str> = answer.as_object().unwrap().keys().map(String::as_str).collect();
    fields.sort_unstable();
    fields
}

/// Made-up answers lead the page into every status; that they are as a node's answers, a demo shows.
#[test]
fn the_page_shows_every_status_and_the_next_squeal() {
    let _alone = alone();
    if !browser_ready() {
        return;
    }
    let made_up = browse("states.mjs", &[]);
    let shown = Shown::demo(&["nine-dof-case-2", "--rate", "100"]);
    let json = |path: &str| serde_json::from_str::<serde_json::Value>(&shown.get(path).2).unwrap_or_default();
    let about = json("/about.json");
    // The answers belong to different moments of a node whose modes grow and decay, so they are asked until all are there.
    let began = Instant::now();
    let answers = loop {
        let state = json("/state.json");
        let map = json(&format!("/map.json?number={}", state["map"]));
        let shape = json(&format!("/shape.json?id={}", state["fastest"]["id"]));
        let events = json("/events.json");
        let answers = [
            ("about", &about),
            ("state", &state),
            ("fastest", &state["fastest"]),
            ("next", &state["next"]),
            ("map", &map),
            ("curve", &map["modes"][0]),
            ("window", &map["windows"][0]),
            ("shape", &shape),
            ("part", &shape["parts"][0]),
            ("growth_change", &shape["growth_change"]),
            ("event", &events[0]),
            ("moment", &events[0]["onset"]),
        ];
        let missing: Vec<&str> =
            answers.iter().filter(|(_, answer)| !answer.is_object()).map(|(name, _)| *name).collect();
        if missing.is_empty() {
            break answers.map(|(name, answer)| (name, answer.clone()));
        }
        assert!(began.elapsed() < PATIENCE, "no answer has {missing:?}: {state}");
        std::thread::sleep(Duration::from_millis(50));
    };
    shown.stop();
    for (name, answer) in &answers {
        let known: Vec<&str> = made_up[*name].as_array().unwrap().iter().map(|field| field.as_str().unwrap()).collect();
        assert_eq!(fields(answer), known, "{name}");
    }
    assert_eq!(about["event_columns"], made_up["event_columns"]);
    let disc = serde_json::to_value(tribometer_axis()).unwrap();
    assert_eq!(serde_json::json!(fields(&disc)), made_up["disc"]);
}

/// The page of a node whose contact pairs open and close shows their forces: those of the state at the conditions it names.
#[test]
fn the_page_shows_the_contact() {
    let _alone = alone();
    if !browser_ready() {
        return;
    }
    let shown = Shown::demo(&["rough-pad", "--rate", "100"]);
    let found = browse("contact.mjs", &[&format!("http://{}/", shown.address)]);
    let answer: serde_json::Value = serde_json::from_str(&shown.get("/contact.json").2).unwrap();
    shown.stop();
    let made_up = |name: &str| -> Vec<&str> {
        found["fields"][name].as_array().unwrap().iter().map(|field| field.as_str().unwrap()).collect()
    };
    assert_eq!(fields(&answer), made_up("contact"));
    let place = squealcast::display::contact::Place { along_m: 0.0, outward_m: 0.0, opposite: false };
    assert_eq!(fields(&serde_json::to_value(place).unwrap()), made_up("place"));
    let number = |name: &str| answer[name].as_f64().unwrap();
    let rig = squealcast::rig::Rig::load("rough-pad").unwrap();
    let point = squealcast::physics::OperatingPoint {
        normal_load_n: number("normal_load_n"),
        disc_speed_rad_s: number("disc_speed_rad_s"),
        friction_coefficient: number("friction_coefficient"),
    };
    let state = rig.model.at(&point).unwrap().state().unwrap().clone();
    let forces: Vec<f64> = answer["force_n"].as_array().unwrap().iter().map(|force| force.as_f64().unwrap()).collect();
    assert_eq!(forces, state.force_n);
    // The page shows a bar for each pair, as high as its force is of the largest.
    let page = &found["shown"];
    assert!(page["note"].as_str().unwrap().starts_with("7 of 7 pairs closed at "), "{page}");
    let bars: Vec<f64> = page["bars"].as_array().unwrap().iter().map(|bar| bar.as_f64().unwrap()).collect();
    let forces: Vec<f64> = page["titles"]
        .as_array()
        .unwrap()
        .iter()
        .map(|title| title.as_str().unwrap().split([' ']).nth(2).unwrap().parse().unwrap())
        .collect();
    let most = |values: &[f64]| values.iter().copied().fold(0.0, f64::max);
    assert_eq!((bars.len(), forces.len()), (7, 7));
    for (bar, force) in bars.iter().zip(&forces) {
        // Forces are written with two decimals.
        assert!((bar / most(&bars) - force / most(&forces)).abs() < 0.01 / most(&forces), "{page}");
    }
}

/// The page shows the scores of `score` and the planted squeal in its spectrogram, with the predicted frequency over it.
#[test]
fn the_page_shows_the_sound_of_a_recording_with_predictions_over_it_and_their_score() {
    let _alone = alone();
    let simulated = simulated();
    let out = simulated.folder.path().join("out");
    let out = out.to_str().unwrap();
    let args = ["predict-log", &simulated.log, "--rig", "tribometer", "-o", out, "--sound", &simulated.sound];
    program::run(args.iter().chain(&["--unit", "Pa"])).exits(0);
    let shown = Shown::start(&["view", out]);
    let sound: serde_json::Value = serde_json::from_str(&shown.get("/sound.json").2).unwrap();
    let score = program::json(["score", out, "--json"]);
    for count in ["hits", "misses", "confirmed", "false_alarms", "recall", "precision", "mcc", "judged_s"] {
        assert_eq!(sound["scores"][0][count], score["rows"][0][count], "{count}");
    }
    assert_eq!(sound["channels"], serde_json::json!(["1"]));
    if browser_ready() {
        let planted = simulated.truth["squeals"].as_array().unwrap().iter();
        let planted = planted.filter(|squeal| squeal["frequency_hz"].as_f64().unwrap() > 1250.0).map(|squeal| {
            let middle_s = 0.5 * (squeal["onset_s"].as_f64().unwrap() + squeal["end_s"].as_f64().unwrap());
            // Relative times of a log count from 2000-01-01.
            serde_json::json!({ "hz": squeal["frequency_hz"], "time_s": 946_684_800.0 + middle_s })
        });
        let planted = serde_json::Value::from(planted.collect::<Vec<_>>()).to_string();
        let seen = browse("sound.mjs", &[&format!("http://{}/", shown.address), &planted]);
        let text = seen["scores"][0].as_str().unwrap();
        let hits = format!("{} hits, {} misses", score["rows"][0]["hits"], score["rows"][0]["misses"]);
        assert!(text.contains(&hits), "{text}");
    }
    shown.stop();
}

/// Channels of a long recording: 8 kHz, a tone of its own in each.
const CHANNELS: [(&str, f64); 4] = [("front", 1500.0), ("rear", 2000.0), ("pad", 2500.0), ("disc", 3000.0)];
const SAMPLE_RATE_HZ: f64 = 8000.0;
/// Conditions in a second, and seconds.
const PER_S: i64 = 2;
const LENGTH_S: i64 = 600;

/// Records ten minutes of four channels, of which channel `k` sounds from `100 k + 60` s on for 30 s, with predictions of the
/// tribometer at friction coefficients at which it squeals. Returns the middles of the tones.
fn ten_minutes_of_sound(directory: &Path) -> Vec<serde_json::Value> {
    let header =
        |time_s: f64| Header { stamp: Time::from_ns(START_NS + (time_s * 1e9) as i64), frame_id: String::new() };
    let conditions = move |seq: i64| OperatingPoint {
        header: header(seq as f64 / PER_S as f64),
        seq: seq as u64,
        normal_load_n: 500.0,
        disc_speed_rad_s: 13.0,
        friction_coefficient: 0.75 + 0.15 * (seq as f64 / 40.0).sin(),
    };
    // Noise with and without a tone of a whole number of periods, a second each.
    let mut random = 1_u32;
    let noise: Vec<f32> = std::iter::repeat_with(|| {
        random = random.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        0.004 * (random as f32 / u32::MAX as f32 - 0.5)
    })
    .take(SAMPLE_RATE_HZ as usize)
    .collect();
    let with_tone = |hz: f64| -> Vec<f32> {
        let tone = (0..).map(|k| (std::f64::consts::TAU * hz * f64::from(k) / SAMPLE_RATE_HZ).sin() as f32);
        noise.iter().zip(tone).map(|(noise, tone)| noise + tone).collect()
    };
    let tones = CHANNELS.map(|(_, hz)| with_tone(hz));
    let sounds = |k: usize, second: i64| (0..30).contains(&(second - 100 * k as i64 - 60));
    let block = |k: usize, second: i64| Waveform {
        header: header(second as f64),
        channel: CHANNELS[k].0.to_owned(),
        sample_rate_hz: SAMPLE_RATE_HZ,
        unit: "Pa".to_owned(),
        sensitivity: String::new(),
        samples: if sounds(k, second) { tones[k].clone() } else { noise.clone() },
    };
    let measured = (0..LENGTH_S).flat_map(|second| {
        let inputs = (PER_S * second..PER_S * (second + 1)).map(|seq| Quantity::Conditions(conditions(seq)));
        inputs.chain((0..CHANNELS.len()).map(|k| Quantity::Samples(block(k, second)))).collect::<Vec<_>>()
    });
    let points = (0..PER_S * LENGTH_S).map(|seq| squealcast::session::conditions(&conditions(seq)));
    let rig = Arc::new(Rig::load("tribometer").unwrap());
    let measured = measured.map(Measured::at_its_stamp);
    offline::record(&rig, None, points, measured, Some(squealcast::sound::Settings::default()), directory).unwrap();
    let middle_s = |k: usize| START_NS as f64 * 1e-9 + 100.0 * k as f64 + 75.0;
    let planted = CHANNELS.iter().enumerate();
    planted.map(|(k, (name, hz))| serde_json::json!({ "name": name, "hz": hz, "time_s": middle_s(k) })).collect()
}

/// The page answers each step through ten minutes of four channels, on the time line and in the spectrogram.
#[test]
fn the_page_follows_the_hand_through_ten_minutes_of_four_channels() {
    let _alone = alone();
    if !browser_ready() {
        return;
    }
    let directory = tempfile::tempdir().unwrap();
    let began = Instant::now();
    let channels = ten_minutes_of_sound(directory.path());
    let recorded = began.elapsed();
    let shown = Shown::start(&["view", directory.path().to_str().unwrap()]);
    let served = began.elapsed() - recorded;
    let what = serde_json::json!({ "per_s": PER_S, "channels": channels }).to_string();
    let speed = browse("scrub.mjs", &[&format!("http://{}/", shown.address), &what]);
    shown.stop();
    println!("recorded in {recorded:?}, served in {served:?}: {speed}");
    if measuring() {
        for wait in ["step_ms", "choose_ms", "pan_ms"] {
            assert!(speed[wait]["median"].as_f64().unwrap() < 100.0, "{wait}: {speed}");
        }
        assert!(speed["drag"]["longest_frame_ms"].as_f64().unwrap() < 250.0, "{speed}");
    }
}

fn tribometer_axis() -> squealcast::rig::DiscAxis {
    squealcast::rig::Rig::load("tribometer").unwrap().disc_axis.unwrap()
}

/// A ring of 24 nodes with a pair of modes, `z = cos 2θ` and `z = sin 2θ`, and two contact points that couple them:
/// one feels the first along the normal and the second along the sliding direction, the other the reverse. So
///
/// ```text
/// K = (ω² + k) I + μ k [0 -1; 1 0],   λ² = -(ω² + k) ± i μ k
/// ```
///
/// and the growing mode is `(1, i)`: `z = Re((cos 2θ + i sin 2θ) e^{iωt}) = cos(2θ + ωt)`.
fn ring(directory: &Path) -> PathBuf {
    let nodes = 24;
    let mut nodes_m = vec![];
    let mut phi = vec![];
    for k in 0..nodes {
        let theta = std::f64::consts::TAU * f64::from(k) / f64::from(nodes);
        nodes_m.extend([0.1 * theta.cos(), 0.1 * theta.sin(), 0.0]);
        phi.extend([0.0, 0.0, 0.0, 0.0, (2.0 * theta).cos(), (2.0 * theta).sin()]);
    }
    // At (r, 0) the disc slides along +y, at (0, r) along -x. Rows x, y, z; columns the two modes.
    nodes_m.extend([0.12, 0.0, 0.0, 0.0, 0.12, 0.0]);
    phi.extend([0.0, 0.0, 0.0, 1.0, 1.0, 0.0]);
    phi.extend([1.0, 0.0, 0.0, 0.0, 0.0, 1.0]);
    let arrays: [(&str, &[u64], &[f64]); 3] =
        [("omega_rad_s", &[2], &[600.0, 600.0]), ("phi", &[26, 3, 2], &phi), ("nodes_m", &[26, 3], &nodes_m)];
    std::fs::write(directory.join("pad.npz"), npz_bytes(&arrays)).unwrap();
    let rig = "name = \"ring\"\n[pad]\nmodal = \"pad.npz\"\n[[contact_patch]]\npad_nodes = [24, 25]\n\
               axis_point_m = [0.0, 0.0, 0.0]\naxis_direction = [0.0, 0.0, 1.0]\nnormal = [0.0, 0.0, 1.0]\n\
               stiffness_n_per_m = 1e5\n[search]\nmu_max = 2.0\n";
    let path = directory.join("ring.toml");
    std::fs::write(&path, rig).unwrap();
    path
}

#[test]
fn a_travelling_wave_travels_the_right_way() {
    let _alone = alone();
    if !browser_ready() {
        return;
    }
    let directory = tempfile::tempdir().unwrap();
    let shown = Shown::demo(&[ring(directory.path()).to_str().unwrap()]);
    browse("wave.mjs", &[&format!("http://{}/", shown.address)]);
    shown.stop();
}

//! What tests of recordings share: messages, how they are recorded, and how they are read back.

use std::path::Path;
use std::time::Duration;

use squealcast::msgs::{Header, Mode, OperatingPoint, Prediction, RigInfo, Time};
use squealcast::recording::message::{Message, Payload};
use squealcast::recording::reader::{Entry, Recorded, Recording};
use squealcast::recording::recorder::RecorderConfig;
use squealcast::rig::RigFile;

/// The start of the recordings made here, ns since the epoch.
pub const T0: u64 = 1_700_000_000_000_000_000;
pub const LIMIT: Duration = Duration::from_secs(120);

pub fn point(seq: u64, log_time_ns: u64) -> Message {
    let stamp = Time::from_ns(log_time_ns as i64);
    let point = OperatingPoint {
        header: Header { stamp, frame_id: "rig".to_owned() },
        seq,
        normal_load_n: 500.0 + (seq as f64 * 0.37).sin(),
        disc_speed_rad_s: 13.0,
        friction_coefficient: 0.3 + 1e-4 * (seq % 1000) as f64,
    };
    Message { log_time_ns, publish_time_ns: log_time_ns, payload: Payload::OperatingPoint(point) }
}

pub fn prediction(seq: u64, log_time_ns: u64) -> Message {
    let mode = |id: u32| Mode {
        id,
        frequency_hz: 1000.0 * f64::from(id) + (seq as f64).sqrt(),
        growth_rate_per_s: -(f64::from(id) + seq as f64).sin(),
        damping_ratio: 0.01,
        pad_participation: 0.5,
        residual: 1e-14,
        frequency_error_hz: f64::INFINITY,
        growth_rate_error_per_s: -0.0,
    };
    let prediction = Prediction {
        header: Header { stamp: Time::from_ns(log_time_ns as i64), frame_id: String::new() },
        input_seq: seq,
        level: 2,
        reused: seq % 2 == 1,
        unstable_modes: 1,
        max_growth_rate_per_s: 1.5,
        worst_frequency_hz: 2000.0,
        critical_friction: 0.31,
        friction_margin: -0.02,
        friction_margin_error: 1e-10,
        reason: "ä reason".to_owned(),
        modes: (0..9).map(mode).collect(),
    };
    Message { log_time_ns, publish_time_ns: log_time_ns, payload: Payload::Prediction(prediction) }
}

pub fn rig_info() -> Message {
    let info = RigInfo {
        name: "nine-dof".to_owned(),
        content_hash: "c0ffee".to_owned(),
        version: "0.1.0".to_owned(),
        mode_count: 9,
        band_max_hz: 20_000.0,
        reduction: "0 missed".to_owned(),
    };
    Message { log_time_ns: T0, publish_time_ns: T0, payload: Payload::RigInfo(info) }
}

pub fn config(directory: &Path) -> RecorderConfig {
    let rig_files = vec![
        RigFile { name: "rig.toml".to_owned(), bytes: b"name = \"nine-dof\"\n".to_vec() },
        RigFile { name: "M.mtx".to_owned(), bytes: (0..=255).collect() },
    ];
    RecorderConfig { rig_name: "nine-dof".to_owned(), rig_files, ..RecorderConfig::new(directory) }
}

pub fn known(entry: &Entry) -> Option<&Payload> {
    match &entry.message {
        Recorded::Known(payload) => Some(payload),
        _ => None,
    }
}

pub fn sequence_numbers<'a>(entries: impl IntoIterator<Item = &'a Entry>) -> Vec<u64> {
    let seq = |entry: &'a Entry| match known(entry) {
        Some(Payload::OperatingPoint(point)) => Some(point.seq),
        _ => None,
    };
    entries.into_iter().filter_map(seq).collect()
}

pub fn read(path: &Path) -> Vec<Entry> {
    let recording = Recording::open(path).unwrap();
    assert!(recording.is_complete(), "{:?}", recording.damage());
    let mut messages = recording.messages();
    let entries: Vec<Entry> = messages.by_ref().collect();
    assert_eq!(messages.damage(), []);
    entries
}

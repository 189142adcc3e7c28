//! What tests on the buses share: messages, and how to wait for them.

use std::sync::atomic::{AtomicU32, Ordering};
use std::thread;
use std::time::{Duration, Instant};

use crossbeam_channel::{Receiver, Sender};
use squealcast::bus::received::Received;
use squealcast::bus::shm::ShmOptions;
use squealcast::msgs::{Header, Mode, OperatingPoint, Prediction, Time, level};

pub const PATIENCE: Duration = Duration::from_secs(60);

pub fn point(seq: u64) -> OperatingPoint {
    OperatingPoint {
        header: Header { stamp: Time { sec: 1_000, nanosec: seq as u32 }, frame_id: String::new() },
        seq,
        normal_load_n: 500.0,
        disc_speed_rad_s: 13.0,
        friction_coefficient: 0.35 + seq as f64 * 1e-6,
    }
}

/// The answer of a node, with as many modes as a message holds.
pub fn answer(point: &OperatingPoint) -> Prediction {
    Prediction {
        header: point.header.clone(),
        input_seq: point.seq,
        level: level::WARN,
        reused: point.seq % 2 == 1,
        friction_margin: point.friction_coefficient,
        reason: "margin below 0.05 µ".to_owned(),
        modes: (0..64).map(|id| Mode { id, frequency_hz: f64::from(id) * 10.0, ..Mode::default() }).collect(),
        ..Prediction::default()
    }
}

pub fn into<M: Send + 'static>(sender: Sender<Received<M>>) -> impl FnMut(Received<M>) + Send + 'static {
    move |received| drop(sender.send(received))
}

pub fn next<M>(receiver: &Receiver<Received<M>>) -> Received<M> {
    receiver.recv_timeout(PATIENCE).expect("received in time")
}

pub fn wait_until(what: &str, condition: impl Fn() -> bool) {
    let started = Instant::now();
    while !condition() {
        assert!(started.elapsed() < PATIENCE, "waited too long: {what}");
        thread::sleep(Duration::from_millis(5));
    }
}

/// Shared memory under names that no other test has.
pub fn shm(name: &str) -> ShmOptions {
    static COUNT: AtomicU32 = AtomicU32::new(0);
    let number = COUNT.fetch_add(1, Ordering::Relaxed);
    ShmOptions { service_prefix: format!("test-{}-{number}-{name}/", std::process::id()), file_prefix: None }
}

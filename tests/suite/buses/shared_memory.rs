//! Shared memory, both ways, against its own mirror.

use std::sync::{Arc, Mutex};
use std::thread;
use std::time::{Duration, Instant};

use super::spawn_peer;
use crate::bus::{PATIENCE, answer, into, next, point, shm, wait_until};
use crossbeam_channel::unbounded;
use squealcast::bus::lifecycle::State;
use squealcast::bus::shm::{ShmInput, ShmOptions, ShmOutput, ShmSink, ShmSource};
use squealcast::bus::{Bus, Connection, Outgoing, Received, ShmConnection, Sink};
use squealcast::msgs::shm::{Form, OperatingPointForm};
use squealcast::msgs::{OperatingPoint, Prediction, Temperature, Vibration, Waveform};

#[test]
fn shared_memory_carries_both_ways() {
    let options = shm("both-ways");
    let output = Arc::new(Mutex::new(ShmOutput::new(&options).expect("output")));
    let (points, heard_points) = unbounded();
    let (predictions, heard_predictions) = unbounded();
    let answering = Arc::clone(&output);
    let input = ShmInput::spawn(&options, move |received: Received<OperatingPoint>| {
        answering.lock().expect("whole").publish(&answer(&received.message)).expect("published");
        points.send(received).expect("test is there");
    })
    .expect("input");
    let sink = ShmSink::spawn(&options, into(predictions)).expect("sink");
    let source = ShmSource::new(&options).expect("source");

    for seq in 0..1000 {
        assert_eq!(source.publish(&point(seq)).expect("published"), 1);
        let prediction = next(&heard_predictions);
        assert_eq!((prediction.bus, prediction.message), (Bus::Shm, answer(&point(seq))));
    }
    for seq in 0..1000 {
        assert_eq!(next(&heard_points).message, point(seq));
    }
    for counts in [input.counts(), sink.counts()] {
        assert_eq!((counts.received, counts.missed, counts.malformed, counts.failures), (1000, 0, 0, 0));
    }
    let stopping = Instant::now();
    input.stop();
    sink.stop();
    assert!(stopping.elapsed() < PATIENCE, "readers stop at once");
}

#[test]
fn a_slow_shared_memory_reader_counts_lost_messages() {
    // Twice as many as its queue holds.
    const WAITING: u64 = OperatingPointForm::WAITING_SAMPLES as u64;
    const COUNT: u64 = 2 * WAITING;
    let options = shm("slow");
    let (sender, received) = unbounded();
    let (gate, opened) = unbounded::<()>();
    let input = ShmInput::spawn(&options, move |point: Received<OperatingPoint>| {
        if point.message.seq == 0 {
            let _ = opened.recv();
        }
        let _ = sender.send(point);
    })
    .expect("input");
    let source = ShmSource::new(&options).expect("source");
    source.publish(&point(0)).expect("published");
    // The reader sits in its sink by now or soon; either way it holds at most one of these.
    thread::sleep(Duration::from_millis(200));
    let publishing = Instant::now();
    for seq in 1..COUNT {
        source.publish(&point(seq)).expect("published");
    }
    assert!(publishing.elapsed() < PATIENCE, "a writer does not wait for readers");
    drop(gate);
    wait_until("the newest", || input.counts().received + input.counts().missed == COUNT);
    let seqs: Vec<u64> = received.try_iter().map(|received| received.message.seq).collect();
    assert_eq!(seqs.last(), Some(&(COUNT - 1)), "the oldest are lost, not the newest");
    assert!(input.counts().missed >= COUNT - WAITING - 1, "{:?}", input.counts());
}

#[test]
fn a_late_shared_memory_reader_gets_the_latest() {
    let options = shm("late");
    let source = ShmSource::new(&options).expect("source");
    for seq in 0..100 {
        source.publish(&point(seq)).expect("published");
    }
    let (sender, received) = unbounded();
    let _input = ShmInput::spawn(&options, into(sender)).expect("input");
    // iceoryx2 delivers history when the writer next looks at its readers.
    source.publish(&point(100)).expect("published");
    let seqs: Vec<u64> = (0..17).map(|_| next(&received).message.seq).collect();
    assert_eq!(seqs, (84..=100).collect::<Vec<_>>());
}

/// iceoryx2 delivers history when a writer looks at its readers; a node does that with its report, once a second.
#[test]
fn a_late_shared_memory_reader_of_a_node_gets_the_latest_without_a_further_message() {
    let options = shm("history");
    let sink: Arc<dyn Sink> = Arc::new(Deaf);
    let mut node = ShmConnection::of_node(&options, &sink).expect("a node");
    for input_seq in 0..3 {
        let prediction = Prediction { input_seq, ..Prediction::default() };
        node.publish(Outgoing::Prediction(&prediction)).expect("published");
    }
    node.report();
    let (sender, received) = unbounded();
    let _reader = ShmSink::spawn(&options, into(sender)).expect("a reader");
    assert!(received.recv_timeout(Duration::from_millis(300)).is_err(), "iceoryx2 delivers it by itself");
    node.report();
    let seqs: Vec<u64> = (0..3).map(|_| next(&received).message.input_seq).collect();
    assert_eq!(seqs, [0, 1, 2]);
    node.report();
    assert!(received.recv_timeout(Duration::from_millis(300)).is_err(), "once");
}

/// Takes nothing.
struct Deaf;

impl Sink for Deaf {
    fn takes_inputs(&self) -> bool {
        false
    }

    fn operating_point(&self, _: Received<OperatingPoint>, _: bool) {}

    fn vibration(&self, _: Received<Vibration>) {}

    fn temperature(&self, _: Received<Temperature>) {}

    fn waveform(&self, _: Received<Waveform>) {}

    fn parameter(&self, _: &str, _: f64) {}

    fn lifecycle(&self, _: State) {}
}

#[test]
fn services_with_other_settings_are_taken_as_they_are() {
    use iceoryx2::prelude::*;
    let options = shm("foreign");
    let node = NodeBuilder::new().create::<ipc::Service>().expect("node");
    let name = format!("{}rig/operating_point", options.service_prefix);
    let name = ServiceName::new(&name).expect("name");
    let _topic = node
        .service_builder(&name)
        .publish_subscribe::<OperatingPointForm>()
        .max_publishers(1)
        .max_subscribers(1)
        .subscriber_max_buffer_size(3)
        .history_size(0)
        .enable_safe_overflow(false)
        .create()
        .expect("topic");
    let _event = node.service_builder(&name).event().max_listeners(1).max_notifiers(1).create().expect("event");

    let (sender, received) = unbounded();
    let _input = ShmInput::spawn(&options, into(sender)).expect("input");
    let source = ShmSource::new(&options).expect("source");
    source.publish(&point(7)).expect("published");
    assert_eq!(next(&received).message, point(7));
    assert!(ShmSource::new(&options).is_err(), "its limits are respected, as an error");
    let publishing = Instant::now();
    for seq in 8..1000 {
        let _ = source.publish(&point(seq));
    }
    assert!(publishing.elapsed() < PATIENCE, "without overflow it does not wait either");
}

#[test]
fn another_type_on_the_service_is_an_error() {
    use iceoryx2::prelude::*;
    let options = shm("type");
    let node = NodeBuilder::new().create::<ipc::Service>().expect("node");
    let name = format!("{}rig/operating_point", options.service_prefix);
    let name = ServiceName::new(&name).expect("name");
    let _topic = node.service_builder(&name).publish_subscribe::<u64>().create().expect("topic");
    let error = ShmSource::new(&options).expect_err("another type").to_string();
    assert!(error.contains("IncompatibleTypes"), "{error}");
    let bad = ShmOptions { service_prefix: "x".repeat(10_000), file_prefix: None };
    assert!(ShmSource::new(&bad).is_err());
}

#[test]
fn a_file_prefix_keeps_strangers_apart() {
    let options = shm("apart");
    // The same in every run: iceoryx2 leaves one small file per prefix.
    let apart = ShmOptions { file_prefix: Some("squealcast_test_".to_owned()), ..options.clone() };
    let (sender, received) = unbounded();
    let _input = ShmInput::spawn(&apart, into(sender)).expect("input");
    assert_eq!(ShmSource::new(&options).expect("stranger").publish(&point(1)).expect("published"), 0);
    // It is kept alive: the samples of a writer without readers vanish with it.
    let source = ShmSource::new(&apart).expect("source");
    assert_eq!(source.publish(&point(2)).expect("published"), 1);
    assert_eq!(next(&received).message, point(2));
    let bad = ShmOptions { file_prefix: Some("a/b".to_owned()), ..options };
    assert!(ShmSource::new(&bad).is_err());
}

#[test]
fn shared_memory_outlives_killed_peers() {
    let options = shm("killed");
    let (sender, received) = unbounded();
    let input = ShmInput::spawn(&options, into(sender)).expect("input");
    let output = ShmOutput::new(&options).expect("output");
    // More peers one after another than the service has room for at once: the dead make room.
    for _ in 0..10 {
        let peer = spawn_peer("shared_memory::peer_on_shared_memory", "SQUEALCAST_TEST_SHM", &options.service_prefix);
        let first = next(&received).message;
        output.publish(&answer(&first)).expect("published");
        drop(peer);
        while received.try_recv().is_ok() {}
        output.publish(&answer(&first)).expect("published after the reader was killed");
    }
    let source = ShmSource::new(&options).expect("source");
    source.publish(&point(u64::MAX)).expect("published");
    while next(&received).message.seq != u64::MAX {}
    assert_eq!(input.counts().malformed, 0);
}

#[test]
#[ignore = "the other process of a test above"]
fn peer_on_shared_memory() {
    let Ok(service_prefix) = std::env::var("SQUEALCAST_TEST_SHM") else { return };
    let options = ShmOptions { service_prefix, file_prefix: None };
    let source = ShmSource::new(&options).expect("source");
    let _sink = ShmSink::spawn(&options, |_| ()).expect("sink");
    for seq in 0..20_000 {
        source.publish(&point(seq)).expect("published");
        thread::sleep(Duration::from_millis(1));
    }
}

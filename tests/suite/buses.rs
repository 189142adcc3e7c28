//! Both buses, both ways, against their own mirror; loopback, private names and domains. Peers in other languages are
//! in `tests/peers`.

use std::process::{Child, Command, Stdio};
use std::sync::{Arc, Mutex};
use std::thread;
use std::time::{Duration, Instant};

use crate::bus::{PATIENCE, answer, into, next, point, shm, wait_until};
use crate::domain::Domain;
use crossbeam_channel::unbounded;
use squealcast::bus::lifecycle::State;
use squealcast::bus::ros_args::RosArgs;
use squealcast::bus::ros2::{Parameters, Ros2, Ros2Options, Ros2Source};
use squealcast::bus::shm::{
    ShmInput, ShmOptions, ShmOutput, ShmSink, ShmSource, ShmVibrationInput, ShmVibrationSource,
};
use squealcast::bus::{Bus, Connection, Outgoing, Received, ShmConnection, Sink};
use squealcast::msgs::shm::{Form, OperatingPointForm};
use squealcast::msgs::{OperatingPoint, Prediction, RigInfo, Temperature, Vibration, Waveform};
use squealcast::rig::Rig;
use squealcast::session::settings::{PARAMETERS, Settings};

/// A node receives its inputs with two readers: a reliable one and a best-effort one.
const READERS: usize = 2;

/// Loopback, in a domain.
fn ros_options(domain: &Domain) -> Ros2Options {
    Ros2Options::new(Some(domain.id), true, RosArgs::default()).expect("a valid domain")
}

#[test]
fn no_two_tests_share_a_domain_or_a_name() {
    let domains: Vec<Domain> = (0..20).map(|_| Domain::claim()).collect();
    let ids: std::collections::HashSet<u16> = domains.iter().map(|domain| domain.id).collect();
    assert_eq!(ids.len(), domains.len());
    for domain in &domains {
        assert!((1..102).contains(&domain.id) && Domain::take(domain.id).is_none(), "{}", domain.id);
    }
    assert_ne!(shm("name").service_prefix, shm("name").service_prefix);
}

/// Users copy `launch/params.yaml`, and the peers in Python take the parameters from it.
#[test]
fn the_parameter_file_has_every_setting_with_its_default() {
    let rig = Rig::load("nine-dof-case-2").expect("an embedded rig, without [warning]");
    let file = concat!(env!("CARGO_MANIFEST_DIR"), "/launch/params.yaml");
    let (args, _) = RosArgs::split(["--ros-args", "--params-file", file].map(String::from)).expect("ROS arguments");
    let unset = PARAMETERS.map(|parameter| (parameter.name, f64::NAN));
    let (values, ignored) = args.parameters(&unset, "/", "squealcast").expect("a parameter file");
    let defaults: Vec<(String, f64)> =
        Settings::for_rig(&rig).values().map(|(name, value)| (name.to_owned(), value)).collect();
    assert_eq!((values, ignored), (defaults, vec![]));
}

/// This test binary once more, running one `#[ignore]`d test as another process.
fn spawn_peer(test: &str, name: &str, value: &str) -> Peer {
    let child = Command::new(std::env::current_exe().expect("own path"))
        .args(["--exact", &format!("buses::{test}"), "--ignored", "--nocapture"])
        .env(name, value)
        .stdout(Stdio::null())
        .spawn()
        .expect("started");
    Peer(child)
}

/// Another process; it is killed even if the test fails.
struct Peer(Child);

impl Drop for Peer {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

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
    use squealcast::msgs::shm::OperatingPointForm;
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
        let peer = spawn_peer("peer_on_shared_memory", "SQUEALCAST_TEST_SHM", &options.service_prefix);
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

fn echoing_node(options: &Ros2Options, parameters: Parameters) -> Arc<Ros2> {
    let (points, received) = unbounded();
    let ros = Arc::new(Ros2::start(options, parameters, into(points), |_| ()).expect("node"));
    let computing = Arc::downgrade(&ros);
    thread::spawn(move || {
        for point in received {
            let Some(ros) = computing.upgrade() else { return };
            ros.publish_prediction(&answer(&point.message)).expect("published");
        }
    });
    ros
}

#[test]
fn ros2_carries_both_ways() {
    let domain = Domain::claim();
    let options = ros_options(&domain);
    let ros = echoing_node(&options, Parameters::none());
    let (predictions, received) = unbounded();
    let source = Ros2Source::start(&options, into(predictions)).expect("source");
    wait_until("discovery", || {
        source.readers() == READERS
            && source.prediction_writers() == 1
            && ros.prediction_readers() == READERS
            && ros.operating_point_writers() == 1
    });
    for seq in 0..500 {
        source.publish(&point(seq)).expect("published");
        let prediction = next(&received);
        assert_eq!((prediction.bus, prediction.message), (Bus::Ros2, answer(&point(seq))));
    }
    for counts in [source.counts(), ros.counts()] {
        assert_eq!((counts.received, counts.missed, counts.malformed, counts.failures), (500, 0, 0, 0));
    }
    let stopping = Instant::now();
    source.stop();
    drop(ros);
    assert!(stopping.elapsed() < PATIENCE, "nodes leave at once: {:?}", stopping.elapsed());
}

fn vibration(k: u64) -> Vibration {
    Vibration { header: point(k).header, frequency_hz: 1500.0 + k as f64, level_db: 60.0 + k as f64 }
}

#[test]
fn both_buses_carry_vibration_and_conditions() {
    let options = shm("vibration");
    let (vibrations, received) = unbounded();
    let input = ShmVibrationInput::spawn(&options, into(vibrations.clone())).expect("input");
    let source = ShmVibrationSource::new(&options).expect("source");
    for k in 0..100 {
        source.publish(&vibration(k)).expect("published");
        let found = next(&received);
        assert_eq!((found.bus, found.message), (Bus::Shm, vibration(k)));
    }
    assert_eq!((input.counts().received, input.counts().missed), (100, 0), "it has no numbers to miss");

    let domain = Domain::claim();
    let options = ros_options(&domain);
    let (points, heard_points) = unbounded();
    let ros = Ros2::start(&options, Parameters::none(), into(points), into(vibrations)).expect("node");
    let source = Ros2Source::start(&options, |_| ()).expect("source");
    wait_until("discovery", || {
        source.readers() == READERS && source.vibration_readers() == READERS && ros.operating_point_writers() == 1
    });
    for k in 0..100 {
        source.publish_vibration(&vibration(k)).expect("published");
        source.publish(&point(k)).expect("published");
        let found = next(&received);
        assert_eq!((found.bus, found.message), (Bus::Ros2, vibration(k)));
        assert_eq!(next(&heard_points).message, point(k));
    }
    assert_eq!(ros.counts().received, 100, "the vibration is no input");
}

#[test]
fn ros2_names_are_remapped() {
    let args = "--ros-args -r __node:=left -r __ns:=/cells -r rig/operating_point:=point";
    let (args, _) = RosArgs::split(args.split(' ').map(str::to_owned)).expect("well formed");
    let domain = Domain::claim();
    let node_options = Ros2Options { args: args.clone(), ..ros_options(&domain) };
    let (points, received) = unbounded();
    let ros = Ros2::start(&node_options, Parameters::none(), into(points), |_| ()).expect("node");
    assert_eq!(ros.full_name(), "/cells/left");
    let args = "--ros-args -r /rig/operating_point:=/cells/point";
    let (args, _) = RosArgs::split(args.split(' ').map(str::to_owned)).expect("well formed");
    let source = Ros2Source::start(&Ros2Options { args, ..ros_options(&domain) }, |_| ()).expect("source");
    wait_until("discovery", || source.readers() == READERS && ros.operating_point_writers() == 1);
    source.publish(&point(3)).expect("published");
    assert_eq!(next(&received).message, point(3));
}

/// Two rigs, each with its node, in one domain.
#[test]
fn namespaces_separate_nodes() {
    let domain = Domain::claim();
    let cells = ["left", "right"].map(|cell| {
        let args = ["--ros-args".to_owned(), "-r".to_owned(), format!("__ns:=/{cell}")];
        let (args, _) = RosArgs::split(args).expect("well formed");
        let options = Ros2Options { args, ..ros_options(&domain) };
        let (predictions, received) = unbounded();
        let ros = echoing_node(&options, Parameters::none());
        assert_eq!(ros.full_name(), format!("/{cell}/squealcast"));
        (ros, Ros2Source::start(&options, into(predictions)).expect("source"), received)
    });
    wait_until("discovery", || {
        cells.iter().all(|(ros, source, _)| {
            source.readers() == READERS && source.prediction_writers() == 1 && ros.prediction_readers() > 0
        }) && cells.iter().all(|(ros, ..)| ros.operating_point_writers() == 1)
    });
    for (first, (_, source, received)) in (0..).step_by(1000).zip(&cells) {
        for seq in first..first + 100 {
            source.publish(&point(seq)).expect("published");
            assert_eq!(next(received).message, answer(&point(seq)));
        }
    }
    for (ros, source, received) in &cells {
        assert_eq!((ros.counts().received, source.counts().received, received.len()), (100, 100, 0));
    }
}

/// Samples are queued while a lost one is sent again or the machine is busy; here the receiving thread is delayed.
#[test]
fn reliable_inputs_that_wait_are_not_lost() {
    const COUNT: u64 = 6000; // 2 kHz for 3 s, the default time between heartbeats of Fast DDS
    let domain = Domain::claim();
    let options = ros_options(&domain);
    let (sender, received) = unbounded();
    let (gate, opened) = unbounded::<()>();
    let sink = move |point: Received<OperatingPoint>| {
        if point.message.seq == 0 {
            let _ = opened.recv();
        }
        let _ = sender.send(point.message.seq);
    };
    let ros = Ros2::start(&options, Parameters::none(), sink, |_| ()).expect("node");
    let source = Ros2Source::start(&options, |_| ()).expect("source");
    wait_until("discovery", || source.readers() == READERS && ros.operating_point_writers() == 1);
    for seq in 0..COUNT {
        source.publish(&point(seq)).expect("published");
        // Not faster than RustDDS can send.
        if seq % 50 == 0 {
            thread::sleep(Duration::from_millis(5));
        }
    }
    drop(gate);
    for seq in 0..COUNT {
        assert_eq!(received.recv_timeout(PATIENCE).expect("received in time"), seq);
    }
    assert_eq!((ros.counts().received, ros.counts().missed), (COUNT, 0));
}

/// Another node in a domain, made with the library underneath; it spins.
fn foreign_node(domain: &Domain, name: &str) -> (ros2_client::Node, tokio::runtime::Runtime) {
    use ros2_client::{Context, NodeName, NodeOptions};
    let participant = rustdds::DomainParticipantBuilder::new(domain.id)
        .with_only_networks([std::net::Ipv4Addr::LOCALHOST])
        .build()
        .expect("participant");
    let context = Context::from_domain_participant(participant).expect("context");
    let mut node = context.new_node(NodeName::new("/", name).expect("name"), NodeOptions::new()).expect("node");
    let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(1).enable_all().build().expect("runtime");
    runtime.spawn(node.spinner().expect("spinner").spin());
    (node, runtime)
}

/// Sensor drivers publish best effort, which a reliable subscription refuses.
#[test]
fn best_effort_and_reliable_publishers_are_received_once() {
    use ros2_client::{MessageTypeName, Name, QosProfile, qos};
    const COUNT: u64 = 500;
    let domain = Domain::claim();
    let options = ros_options(&domain);
    let (points, received) = unbounded();
    let ros = Ros2::start(&options, Parameters::none(), into(points), |_| ()).expect("node");
    let (mut node, _runtime) = foreign_node(&domain, "driver");
    let profile = QosProfile::publisher_default().reliability(qos::Reliability::BestEffort);
    let name = Name::new("/rig", "operating_point").expect("name");
    let kind = MessageTypeName::new("squealcast_msgs", "OperatingPoint");
    let topic = node.create_topic(&name, kind, &profile).expect("topic");
    let driver = node.create_publisher::<OperatingPoint>(&topic, None).expect("publisher");
    let source = Ros2Source::start(&options, |_| ()).expect("source");
    wait_until("discovery", || source.readers() == READERS && ros.operating_point_writers() == 2);
    wait_until("the driver's discovery", || driver.get_subscription_count(&node) > 0);
    for seq in 0..COUNT {
        driver.publish(point(COUNT + seq)).expect("published");
        source.publish(&point(seq)).expect("published");
        thread::sleep(Duration::from_millis(1));
    }
    let mut reliable = Vec::new();
    let mut best_effort = std::collections::BTreeSet::new();
    while reliable.len() < COUNT as usize || !best_effort.contains(&(2 * COUNT - 1)) {
        let seq = next(&received).message.seq;
        if seq < COUNT {
            reliable.push(seq);
        } else {
            assert!(best_effort.insert(seq), "{seq} came twice");
        }
    }
    assert_eq!(reliable, (0..COUNT).collect::<Vec<_>>());
    // It may lose some, but not on loopback at this pace.
    assert!(best_effort.len() as u64 > COUNT / 2, "{}", best_effort.len());
    assert_eq!((ros.counts().malformed, ros.counts().incompatible), (0, 0));
}

#[test]
fn a_user_chooses_the_quality_of_service_of_a_topic() {
    let domain = Domain::claim();
    let start = |policy: &str| {
        let parameter = format!("qos_overrides./rig/operating_point.subscription.reliability:={policy}");
        let (args, _) = RosArgs::split(["--ros-args", "-p", &parameter].map(str::to_owned)).expect("well formed");
        let options = Ros2Options { args: args.renamed(policy), ..ros_options(&domain) };
        let (points, received) = unbounded();
        (Ros2::start(&options, Parameters::none(), into(points), |_| ()).expect("node"), received)
    };
    let (reliable, from_reliable) = start("reliable");
    let (best_effort, from_best_effort) = start("best_effort");
    // Each has one subscription instead of two.
    let source = Ros2Source::start(&ros_options(&domain), |_| ()).expect("source");
    wait_until("discovery", || source.readers() == READERS);
    wait_until("the source", || [&reliable, &best_effort].iter().all(|ros| ros.operating_point_writers() == 1));
    source.publish(&point(7)).expect("published");
    assert_eq!((next(&from_reliable).message.seq, next(&from_best_effort).message.seq), (7, 7));
    let (mut node, _runtime) = foreign_node(&domain, "driver");
    let profile = ros2_client::QosProfile::publisher_default().reliability(ros2_client::qos::Reliability::BestEffort);
    let name = ros2_client::Name::new("/rig", "operating_point").expect("name");
    let kind = ros2_client::MessageTypeName::new("squealcast_msgs", "OperatingPoint");
    let topic = node.create_topic(&name, kind, &profile).expect("topic");
    let _driver = node.create_publisher::<OperatingPoint>(&topic, None).expect("publisher");
    wait_until("the sensor's driver is refused", || reliable.counts().incompatible == 1);
    wait_until("the sensor's driver is known", || best_effort.operating_point_writers() == 2);
    assert_eq!(best_effort.counts().incompatible, 0);
}

#[test]
fn peers_with_incompatible_quality_of_service_are_counted_while_they_are_there() {
    use ros2_client::{MessageTypeName, Name, QosProfile};
    let domain = Domain::claim();
    let options = ros_options(&domain);
    let ros = Ros2::start(&options, Parameters::none(), |_| (), |_| ()).expect("node");
    let (mut node, runtime) = foreign_node(&domain, "demanding");
    let profile = QosProfile { deadline: Some(Duration::from_millis(10)), ..QosProfile::subscription_default() };
    let name = Name::new("/squealcast", "prediction").expect("name");
    let kind = MessageTypeName::new("squealcast_msgs", "Prediction");
    let topic = node.create_topic(&name, kind, &profile).expect("topic");
    let subscription = node.create_subscription::<Prediction>(&topic, None).expect("subscription");
    wait_until("the peer is counted", || ros.counts().incompatible == 1);
    assert_eq!(ros.prediction_readers(), 0);
    drop((subscription, topic, node, runtime));
    wait_until("it is gone", || ros.counts().incompatible == 0);
}

/// A second node of one domain and namespace: subscribers cannot distinguish the predictions of both. In another
/// namespace it is no problem.
#[test]
fn another_publisher_of_predictions_is_counted_while_it_is_there() {
    let domain = Domain::claim();
    let start = |name: &str, more: &[&str]| {
        let arguments = ["--ros-args", "-r", name].into_iter().chain(more.iter().copied()).map(str::to_owned);
        let (args, _) = RosArgs::split(arguments).expect("well formed");
        let options = Ros2Options { args, ..ros_options(&domain) };
        Ros2::start(&options, Parameters::none(), |_| (), |_| ()).expect("node")
    };
    let first = start("__node:=first", &[]);
    let apart = start("__node:=apart", &["-r", "__ns:=/apart"]);
    let second = start("__node:=second", &[]);
    wait_until("each is counted by the other", || first.counts().rivals == 1 && second.counts().rivals == 1);
    assert_eq!(apart.counts().rivals, 0);
    drop(second);
    wait_until("it is gone", || first.counts().rivals == 0);
}

#[test]
fn bad_ros2_names_are_errors() {
    for bad in ["__node:=a-b", "__node:=a__b", "__ns:=/a//b", "__ns:=/1", "rig/operating_point:=/a//b"] {
        let (args, _) = RosArgs::split(["--ros-args", "-r", bad].map(str::to_owned)).expect("well formed");
        let domain = Domain::claim();
        let options = Ros2Options { args, ..ros_options(&domain) };
        assert!(Ros2::start(&options, Parameters::none(), |_| (), |_| ()).is_err(), "{bad}");
    }
    assert!(Ros2Options::new(Some(233), true, RosArgs::default()).is_err());
}

#[test]
fn a_late_ros2_reader_gets_the_rig() {
    use ros2_client::{Context, MessageTypeName, Name, NodeName, NodeOptions, QosProfile, qos};
    let domain = Domain::claim();
    let options = ros_options(&domain);
    let ros = Ros2::start(&options, Parameters::none(), |_| (), |_| ()).expect("node");
    let rig = RigInfo { name: "nine-dof".to_owned(), mode_count: 9, ..RigInfo::default() };
    ros.publish_rig(&rig).expect("published");

    let participant = rustdds::DomainParticipantBuilder::new(options.domain_id)
        .with_only_networks([std::net::Ipv4Addr::LOCALHOST])
        .build()
        .expect("participant");
    let context = Context::from_domain_participant(participant).expect("context");
    let mut node = context.new_node(NodeName::new("/", "late").expect("name"), NodeOptions::new()).expect("node");
    let profile = QosProfile::publisher_default().durability(qos::Durability::TransientLocal);
    let topic = node
        .create_topic(
            &Name::new("/squealcast", "rig").expect("name"),
            MessageTypeName::new("squealcast_msgs", "RigInfo"),
            &profile,
        )
        .expect("topic");
    let subscription = node.create_subscription::<RigInfo>(&topic, None).expect("subscription");
    let started = Instant::now();
    let received = loop {
        if let Some((message, _)) = subscription.take().expect("taken") {
            break message;
        }
        assert!(started.elapsed() < PATIENCE, "no rig received");
        thread::sleep(Duration::from_millis(10));
    };
    assert_eq!(received, rig);
}

#[test]
fn ros2_parameters_are_judged() {
    use ros2_client::rcl_interfaces::{
        DescribeParametersRequest, DescribeParametersResponse, GetParametersRequest, GetParametersResponse,
        ListParametersRequest, ListParametersResponse, SetParametersAtomicallyResponse, SetParametersRequest,
        SetParametersResponse,
    };
    use ros2_client::{
        Context, Name, NodeName, NodeOptions, Parameter, ParameterValue, QosProfile, ServiceMapping, ServiceTypeName,
    };
    let domain = Domain::claim();
    let options = ros_options(&domain);
    let accepted = Arc::new(Mutex::new(Vec::new()));
    let collecting = Arc::clone(&accepted);
    let parameters = Parameters {
        values: vec![("warn_margin".to_owned(), 0.05), ("dead_band".to_owned(), 0.0)],
        validate: Box::new(|name, value| if value < 0.0 { Err(format!("{name}: {value} is below 0")) } else { Ok(()) }),
        describe: |name| (name == "warn_margin").then_some(("what it is", [0.0, 1.0])),
        accepted: Box::new(move |name, value| collecting.lock().expect("whole").push((name.to_owned(), value))),
    };
    let _ros = Ros2::start(&options, parameters, |_| (), |_| ()).expect("node");

    let participant = rustdds::DomainParticipantBuilder::new(options.domain_id)
        .with_only_networks([std::net::Ipv4Addr::LOCALHOST])
        .build()
        .expect("participant");
    let context = Context::from_domain_participant(participant).expect("context");
    let mut node = context.new_node(NodeName::new("/", "asking").expect("name"), NodeOptions::new()).expect("node");
    let profile = QosProfile::publisher_default();
    let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(1).enable_all().build().expect("runtime");
    runtime.spawn(node.spinner().expect("spinner").spin());
    macro_rules! call {
        ($kind:literal, $name:literal, $request:expr, $response:ty) => {{
            let client = node
                .create_client::<_, $response>(
                    ServiceMapping::Enhanced,
                    &Name::new("/squealcast", $name).expect("name"),
                    &ServiceTypeName::new("rcl_interfaces", $kind),
                    profile.clone(),
                    profile.clone(),
                )
                .expect("client");
            // Asked right after discovery, on a busy machine, the node sometimes never sees the request: the client
            // then knows the service, but not yet the other way round.
            let started = Instant::now();
            loop {
                let answered = runtime.block_on(async {
                    tokio::time::timeout(Duration::from_secs(1), async {
                        client.wait_for_service(&node).await;
                        client.async_call_service($request).await.expect("answered")
                    })
                    .await
                });
                match answered {
                    Ok(answer) => break answer,
                    Err(_) => assert!(started.elapsed() < PATIENCE, "no answer: {}", $name),
                }
            }
        }};
    }
    let list: ListParametersResponse = call!(
        "ListParameters",
        "list_parameters",
        ListParametersRequest { prefixes: vec![], depth: 0 },
        ListParametersResponse
    );
    for name in ["warn_margin", "dead_band"] {
        assert!(list.result.names.iter().any(|known| known == name), "{:?}", list.result.names);
    }
    let set = |value: ParameterValue| Parameter { name: "warn_margin".to_owned(), value }.into();
    let answers: SetParametersResponse = call!(
        "SetParameters",
        "set_parameters",
        SetParametersRequest {
            parameter: vec![
                set(ParameterValue::Double(0.1)),
                set(ParameterValue::Double(-1.0)),
                set(ParameterValue::Double(f64::NAN)),
                set(ParameterValue::String("wide".to_owned())),
                set(ParameterValue::NotSet),
            ]
        },
        SetParametersResponse
    );
    let successes: Vec<bool> = answers.results.iter().map(|result| result.successful).collect();
    assert_eq!(successes, [true, false, false, false, false], "{:?}", answers.results);
    assert_eq!(answers.results[1].reason, "warn_margin: -1 is below 0");
    let got: GetParametersResponse = call!(
        "GetParameters",
        "get_parameters",
        GetParametersRequest { names: vec!["warn_margin".to_owned()] },
        GetParametersResponse
    );
    assert_eq!(got.values[0].double_value, 0.1);
    let described: DescribeParametersResponse = call!(
        "DescribeParameters",
        "describe_parameters",
        DescribeParametersRequest { names: vec!["warn_margin".to_owned(), "use_sim_time".to_owned()] },
        DescribeParametersResponse
    );
    let [margin, sim_time] = &described.values[..] else { panic!("{described:?}") };
    let range = &margin.floating_point_range[0];
    assert_eq!((&*margin.description, range.from_value, range.to_value), ("what it is", 0.0, 1.0));
    assert!(sim_time.read_only && !margin.read_only, "{described:?}");
    let of = |name: &str, value| Parameter { name: name.to_owned(), value }.into();
    let set_together: SetParametersAtomicallyResponse = call!(
        "SetParametersAtomically",
        "set_parameters_atomically",
        SetParametersRequest {
            parameter: vec![
                of("warn_margin", ParameterValue::Double(0.7)),
                of("use_sim_time", ParameterValue::Boolean(true)),
            ]
        },
        SetParametersAtomicallyResponse
    );
    assert_eq!(
        (set_together.result.successful, &*set_together.result.reason),
        (false, "use_sim_time is not supported: times are those of this machine"),
        "neither is set"
    );
    let mut accepted = accepted.lock().expect("whole");
    accepted.dedup();
    assert_eq!(*accepted, [("warn_margin".to_owned(), 0.1)], "initial and refused values are not passed on");
}

#[test]
fn a_refused_initial_value_is_an_error() {
    let parameters = Parameters {
        values: vec![("warn_margin".to_owned(), -1.0)],
        validate: Box::new(|_, _| Err("below 0".to_owned())),
        ..Parameters::none()
    };
    let domain = Domain::claim();
    let error = Ros2::start(&ros_options(&domain), parameters, |_| (), |_| ()).err().expect("refused").to_string();
    assert!(error.contains("below 0"), "{error}");
}

#[test]
fn malformed_ros2_samples_are_counted() {
    use ros2_client::{Context, MessageTypeName, Name, NodeName, NodeOptions, QosProfile, qos};
    let domain = Domain::claim();
    let options = ros_options(&domain);
    let (points, received) = unbounded();
    let ros = Ros2::start(&options, Parameters::none(), into(points), |_| ()).expect("node");
    let participant = rustdds::DomainParticipantBuilder::new(options.domain_id)
        .with_only_networks([std::net::Ipv4Addr::LOCALHOST])
        .build()
        .expect("participant");
    let context = Context::from_domain_participant(participant).expect("context");
    let mut node = context.new_node(NodeName::new("/", "broken").expect("name"), NodeOptions::new()).expect("node");
    // The right topic and type name, but two bytes where a header belongs.
    let topic = node
        .create_topic(
            &Name::new("/rig", "operating_point").expect("name"),
            MessageTypeName::new("squealcast_msgs", "OperatingPoint"),
            &QosProfile::publisher_default().history(qos::History::KeepLast { depth: 64 }),
        )
        .expect("topic");
    let publisher = node.create_publisher::<u16>(&topic, None).expect("publisher");
    let source = Ros2Source::start(&options, |_| ()).expect("source");
    wait_until("discovery", || source.readers() == READERS && ros.operating_point_writers() == 2);
    wait_until("malformed samples", || {
        publisher.publish(0xffff).expect("published");
        ros.counts().malformed > 0
    });
    source.publish(&point(1)).expect("published");
    assert_eq!(next(&received).message, point(1));
}

#[test]
fn ros2_outlives_killed_peers() {
    let domain = Domain::claim();
    let options = ros_options(&domain);
    let ros = echoing_node(&options, Parameters::none());
    for seq in 0..2 {
        let peer = spawn_peer("peer_on_ros2", "SQUEALCAST_TEST_DOMAIN", &options.domain_id.to_string());
        let before = ros.counts().received;
        wait_until("the peer", || ros.counts().received > before + 10);
        drop(peer);
        // The dead reader still counts and answers nothing; more than RustDDS itself would hold for it.
        for _ in 0..10_000 {
            ros.publish_prediction(&Prediction::default()).expect("published for a killed reader");
        }
        let (predictions, received) = unbounded();
        let source = Ros2Source::start(&options, into(predictions)).expect("source");
        wait_until("discovery", || source.readers() == READERS && source.prediction_writers() == 1);
        let started = Instant::now();
        loop {
            source.publish(&point(seq)).expect("published");
            match received.recv_timeout(Duration::from_millis(100)) {
                Ok(prediction) if prediction.message == answer(&point(seq)) => break,
                _ => assert!(started.elapsed() < PATIENCE, "no answer after a peer was killed"),
            }
        }
    }
}

#[test]
#[ignore = "the other process of a test above"]
fn peer_on_ros2() {
    let Ok(domain) = std::env::var("SQUEALCAST_TEST_DOMAIN") else { return };
    let options = Ros2Options::new(Some(domain.parse().expect("a domain")), true, RosArgs::default()).expect("valid");
    let source = Ros2Source::start(&options, |_| ()).expect("source");
    for seq in 0..20_000 {
        source.publish(&point(seq)).expect("published");
        thread::sleep(Duration::from_millis(2));
    }
}

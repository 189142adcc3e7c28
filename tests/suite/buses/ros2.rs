//! ROS 2, both ways, against its own mirror and against other nodes.

use std::sync::Arc;
use std::thread;
use std::time::{Duration, Instant};

use super::{READERS, foreign_node, ros_options, spawn_peer};
use crate::bus::{PATIENCE, answer, into, next, point, wait_until};
use crate::domain::Domain;
use crossbeam_channel::unbounded;
use squealcast::bus::ros_args::RosArgs;
use squealcast::bus::ros2::{Parameters, Ros2, Ros2Options, Ros2Source};
use squealcast::bus::{Bus, Received};
use squealcast::msgs::{OperatingPoint, Prediction, RigInfo};

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
    use ros2_client::{MessageTypeName, Name, QosProfile, qos};
    let domain = Domain::claim();
    let options = ros_options(&domain);
    let ros = Ros2::start(&options, Parameters::none(), |_| (), |_| ()).expect("node");
    let rig = RigInfo { name: "nine-dof".to_owned(), mode_count: 9, ..RigInfo::default() };
    ros.publish_rig(&rig).expect("published");

    let (mut node, _runtime) = foreign_node(&domain, "late");
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
fn malformed_ros2_samples_are_counted() {
    use ros2_client::{MessageTypeName, Name, QosProfile, qos};
    let domain = Domain::claim();
    let options = ros_options(&domain);
    let (points, received) = unbounded();
    let ros = Ros2::start(&options, Parameters::none(), into(points), |_| ()).expect("node");
    let (mut node, _runtime) = foreign_node(&domain, "broken");
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
        let peer = spawn_peer("ros2::peer_on_ros2", "SQUEALCAST_TEST_DOMAIN", &options.domain_id.to_string());
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

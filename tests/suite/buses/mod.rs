//! Both buses, both ways, against their own mirror; loopback, private names and domains. Peers in other languages are
//! in `tests/peers`.

mod parameters;
mod ros2;
mod shared_memory;

use std::process::{Child, Command, Stdio};

use crate::bus::{into, next, point, shm, wait_until};
use crate::domain::Domain;
use crossbeam_channel::unbounded;
use squealcast::bus::Bus;
use squealcast::bus::ros_args::RosArgs;
use squealcast::bus::ros2::{Parameters, Ros2, Ros2Options, Ros2Source};
use squealcast::bus::shm::{ShmVibrationInput, ShmVibrationSource};
use squealcast::msgs::Vibration;
use squealcast::rig::Rig;
use squealcast::session::settings::{PARAMETERS, Settings};

/// A node receives its inputs with two readers: a reliable one and a best-effort one.
const READERS: usize = 2;

/// Loopback, in a domain.
fn ros_options(domain: &Domain) -> Ros2Options {
    Ros2Options::new(Some(domain.id), true, RosArgs::default()).expect("a valid domain")
}

/// Another node in a domain, made with the library underneath; it spins as long as the runtime is kept.
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

//! Limits of RustDDS and ros2-client, which launch/ROS2.md lists: each test passes as long as a limit exists. If one fails, the
//! limit is gone, and its workaround and description can be removed.

use std::net::UdpSocket;
use std::time::{Duration, Instant};

use crate::domain::Domain;
use ros2_client::{Context, Node, NodeName, NodeOptions};
use rustdds::discovery::{DiscoveredReaderData, DiscoveredWriterData};
use squealcast::bus::ros_args::RosArgs;
use squealcast::bus::ros2::{Parameters, Ros2, Ros2Options};

const PATIENCE: Duration = Duration::from_secs(60);

/// Versions that launch/ROS2.md was written about.
const VERSIONS: [(&str, &str); 2] = [("rustdds", "0.15.1"), ("ros2-client", "0.12.1")];

fn node(domain: &Domain) -> Ros2 {
    let options = Ros2Options::new(Some(domain.id), true, RosArgs::default()).expect("valid");
    let parameters = Parameters { values: vec![("warn_margin".to_owned(), 0.05)], ..Parameters::none() };
    Ros2::start(&options, parameters, |_| (), |_| ()).expect("node")
}

/// Another participant that sees the node.
fn onlooker(domain: &Domain) -> (Context, Node) {
    let participant = rustdds::DomainParticipantBuilder::new(domain.id)
        .with_only_networks([std::net::Ipv4Addr::LOCALHOST])
        .build()
        .expect("participant");
    let context = Context::from_domain_participant(participant).expect("context");
    let node = context.new_node(NodeName::new("/", "onlooker").expect("name"), NodeOptions::new()).expect("node");
    (context, node)
}

fn awaited<T>(what: &str, mut look: impl FnMut() -> Option<T>) -> T {
    let started = Instant::now();
    loop {
        if let Some(found) = look() {
            return found;
        }
        assert!(started.elapsed() < PATIENCE, "waited too long for {what}");
        std::thread::sleep(Duration::from_millis(10));
    }
}

/// The limits without a test here: a participant that returns with the GUID prefix of one that left is not found again;
/// services do not answer rmw_cyclonedds; answers of services longer than one datagram are malformed (in a build with debug
/// assertions RustDDS ends the process); there are no static peers and no range OFF.
#[test]
fn the_limits_were_seen_in_these_versions() {
    let lock = include_str!("../../Cargo.lock");
    for (name, version) in VERSIONS {
        assert!(
            lock.contains(&format!("name = \"{name}\"\nversion = \"{version}\"\n")),
            "{name} is no longer {version}: go through the limits in launch/ROS2.md, then change the version here"
        );
    }
}

#[test]
fn the_clock_is_subscribed_with_the_wrong_type() {
    let domain = Domain::claim();
    let _ros = node(&domain);
    let (context, _node) = onlooker(&domain);
    let clock: DiscoveredReaderData = awaited("the node's subscription of the clock", || {
        let readers = context.domain_participant().discovered_readers();
        readers.into_iter().find(|reader| reader.subscription_topic_data.topic_name == "rt/clock")
    });
    assert_eq!(
        clock.subscription_topic_data.type_name(),
        "builtin_interfaces::msg::dds_::Time_",
        "cured upstream: the limit of /clock in launch/ROS2.md can go"
    );
}

#[test]
fn types_are_announced_without_their_hash() {
    let domain = Domain::claim();
    let _ros = node(&domain);
    let (context, _node) = onlooker(&domain);
    let prediction: DiscoveredWriterData = awaited("the node's predictions", || {
        let writers = context.domain_participant().discovered_writers();
        writers.into_iter().find(|writer| writer.publication_topic_data.topic_name == "rt/squealcast/prediction")
    });
    assert!(
        !String::from_utf8_lossy(&prediction.user_data).contains("typehash="),
        "cured upstream: the limit of type hashes in launch/ROS2.md can go"
    );
}

/// A reader asks a new writer for a heartbeat at once. Fast DDS only takes that for a request if its base is 0, and otherwise
/// waits for its heartbeat period, 3 s: messages sent before the node discovered it arrive that late.
///
/// Here a participant made by this test is announced by one datagram, as one that has discovery's own writers: the
/// node's readers request data from those.
#[test]
fn a_new_writer_is_asked_for_a_heartbeat_in_a_form_that_fast_dds_ignores() {
    let domain = Domain::claim();
    let _ros = node(&domain);
    let socket = UdpSocket::bind("127.0.0.1:0").expect("a port");
    socket.set_read_timeout(Some(Duration::from_secs(1))).expect("set");
    let announcement = participant_announcement(socket.local_addr().expect("bound").port());
    // Where the first participants of a domain listen for others: RTPS 2.5, 9.6.2.
    let listening = 7400 + 250 * domain.id + 10;
    let base = awaited("a request", || {
        socket.send_to(&announcement, ("127.0.0.1", listening)).expect("sent");
        let mut datagram = [0; 65_536];
        let length = socket.recv(&mut datagram).ok()?;
        acknowledged_base(&datagram[..length])
    });
    assert_eq!(base, 1, "cured upstream: the limit of first messages in launch/ROS2.md can go; Fast DDS wants 0");
}

/// The prefix of every GUID of the made-up participant.
const PREFIX: [u8; 12] = [1, 15, 77, 7, 3, 3, 3, 3, 0, 0, 0, 1];

/// An RTPS message with one DATA submessage: SPDPdiscoveredParticipantData (RTPS 2.5, 9.6.3), little endian.
fn participant_announcement(port: u16) -> Vec<u8> {
    let locator =
        |port: u16| [&1i32.to_le_bytes()[..], &u32::from(port).to_le_bytes(), &[0; 12], &[127, 0, 0, 1]].concat();
    let parameters: [(u16, Vec<u8>); 7] = [
        (0x15, vec![2, 3, 0, 0]),                         // protocol version
        (0x16, vec![1, 15, 0, 0]),                        // vendor
        (0x50, [&PREFIX[..], &[0, 0, 1, 0xc1]].concat()), // participant GUID
        (0x32, locator(port)),                            // metatraffic unicast locator
        (0x31, locator(port)),                            // default unicast locator
        (0x02, [20i32.to_le_bytes(), [0; 4]].concat()),   // lease duration, s
        (0x58, 0x0000_003fu32.to_le_bytes().to_vec()), // builtin endpoints: announcers and detectors of SPDP and SEDP
    ];
    let mut payload = vec![0, 3, 0, 0]; // PL_CDR_LE
    for (id, value) in &parameters {
        payload.extend(id.to_le_bytes());
        payload.extend((value.len() as u16).to_le_bytes());
        payload.extend(value);
    }
    payload.extend([1, 0, 0, 0]); // sentinel
    let mut data = vec![0, 0, 16, 0]; // extra flags, octets to inline QoS
    data.extend([0, 1, 0, 0xc7]); // SPDP's reader
    data.extend([0, 1, 0, 0xc2]); // SPDP's writer
    data.extend([0, 0, 0, 0, 1, 0, 0, 0]); // sequence number 1
    data.extend(payload);
    let header = [&b"RTPS"[..], &[2, 3, 1, 15], &PREFIX].concat();
    // DATA, little endian with a payload.
    [header, vec![0x15, 0x05], (data.len() as u16).to_le_bytes().to_vec(), data].concat()
}

/// The base of the first ACKNACK in an RTPS message without any requested sample.
fn acknowledged_base(message: &[u8]) -> Option<i64> {
    let mut rest = message.strip_prefix(b"RTPS")?.get(16..)?;
    loop {
        let [kind, flags, length @ ..] = *rest.first_chunk::<4>()?;
        let little = flags & 1 == 1;
        let length = if little { u16::from_le_bytes(length) } else { u16::from_be_bytes(length) };
        let body = rest.get(4..4 + usize::from(length))?;
        let word = |at: usize| {
            let bytes = *body.get(at..)?.first_chunk::<4>()?;
            Some(if little { u32::from_le_bytes(bytes) } else { u32::from_be_bytes(bytes) })
        };
        const ACKNACK: u8 = 0x06;
        if kind == ACKNACK && word(16)? == 0 {
            // Reader, writer, then the base: high word, low word; then how many bits follow it.
            return Some(i64::from(word(8)?) << 32 | i64::from(word(12)?));
        }
        rest = rest.get(4 + usize::from(length)..)?;
    }
}

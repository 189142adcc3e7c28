//! The ROS 2 side of a running node, a process of its own, attacked, killed and stopped: predictions over shared memory and
//! the recording go on, and ROS 2 is answered again.

use std::fs::{self, File};
use std::net::Ipv4Addr;
use std::path::PathBuf;
use std::process::{Child, Stdio};
use std::sync::{Arc, Mutex, OnceLock};
use std::time::{Duration, Instant};

use crate::bus::{self, into, wait_until};
use crate::forger::{ALL_FORGED, Forged, Forger, mutate, random};
use crate::program::{self, command, text};
use crossbeam_channel::{Receiver, Sender, unbounded};
use squealcast::bus::lifecycle::State;
use squealcast::bus::received::Received;
use squealcast::bus::ros_args::RosArgs;
use squealcast::bus::ros2::process::{Ros2Process, Sinks};
use squealcast::bus::ros2::{Parameters, Ros2, Ros2Options, Ros2Source};
use squealcast::bus::shm::{ShmOptions, ShmSink, ShmSource};
use squealcast::msgs::{DiagnosticStatus, Header, OperatingPoint, Prediction, RigInfo, Time, level};
use squealcast::recording::message::Payload;
use squealcast::recording::reader::{Recorded, Recording};
use tempfile::TempDir;

/// How far the memory of a node may be from what it was before an attack, bytes.
const MEMORY_MARGIN: u64 = 64 << 20;
/// Inputs over shared memory have sequence numbers below, those of a peer on ROS 2 above.
const FIRST_OVER_ROS: u64 = 1 << 32;

/// `squealcast run`, recording, with peers on both buses.
struct Node {
    process: Child,
    folder: TempDir,
    domain: u16,
    shm: ShmSource,
    predictions: Receiver<Received<Prediction>>,
    _shm_sink: ShmSink,
    /// Of the latest input over shared memory, and of the first that was answered.
    seq: u64,
    first_seq: u64,
}

impl Node {
    /// `number` distinguishes the tests of this file.
    fn start(number: u16) -> Self {
        let folder = TempDir::new().expect("a folder");
        let process_id = std::process::id();
        let domain = 10 + (process_id % 9) as u16 * 10 + number;
        let prefix = format!("ros2-side-{process_id}-{number}/");
        let records = text(&folder.path().join("records"));
        let domain_text = domain.to_string();
        let arguments = ["run", "nine-dof-case-2", "--no-display", "--plain", "--no-chart", "--domain", &domain_text];
        let file = |name| File::create(folder.path().join(name)).expect("created");
        let process = command(arguments)
            .args(["--loopback", "--shm-prefix", &prefix, "--record", &records])
            .stdout(Stdio::from(file("stdout")))
            .stderr(Stdio::from(file("stderr")))
            .spawn()
            .expect("started");
        let options = ShmOptions { service_prefix: prefix, file_prefix: None };
        let (sender, predictions) = unbounded();
        let sink = ShmSink::spawn(&options, into(sender)).expect("a sink");
        let shm = ShmSource::new(&options).expect("a source");
        let mut node = Self { process, folder, domain, shm, predictions, _shm_sink: sink, seq: 0, first_seq: 0 };
        node.wait("the node", |node| node.side().is_some());
        node.wait("the first answer", |node| node.answer_within(Duration::from_millis(200)).is_some());
        node.first_seq = node.seq;
        node
    }

    fn said(&self) -> String {
        fs::read_to_string(self.folder.path().join("stderr")).unwrap_or_default()
    }

    /// How often it reported that its ROS 2 side ended.
    fn falls(&self) -> usize {
        self.said().matches("the ROS 2 side ended").count()
    }

    /// The process of its ROS 2 side.
    fn side(&self) -> Option<u32> {
        children(self.process.id()).into_iter().next()
    }

    /// Waits for something, while shared memory is answered throughout.
    #[track_caller]
    fn wait(&mut self, what: &str, mut holds: impl FnMut(&mut Self) -> bool) {
        let begun = Instant::now();
        while !holds(self) {
            assert!(begun.elapsed() < bus::PATIENCE, "waited too long: {what}\n{}", self.said());
            assert!(self.process.try_wait().expect("waited").is_none(), "the node ended: {}", self.said());
            std::thread::sleep(Duration::from_millis(5));
        }
    }

    /// Asks for a prediction over shared memory, and how long that took.
    fn answer_within(&mut self, limit: Duration) -> Option<Duration> {
        self.seq += 1;
        let asked = Instant::now();
        self.shm.publish(&point(self.seq)).expect("published");
        while let Ok(received) = self.predictions.recv_timeout(limit.saturating_sub(asked.elapsed())) {
            if received.message.input_seq == self.seq {
                return Some(asked.elapsed());
            }
        }
        None
    }

    #[track_caller]
    fn answers(&mut self) -> Duration {
        self.answer_within(bus::PATIENCE).unwrap_or_else(|| panic!("no answer over shared memory: {}", self.said()))
    }

    /// Ends it, and checks that every input that it answered is in its recording with its answer. Gives back
    /// the recorded state of the node, once a second, and the sequence numbers of the inputs over ROS 2.
    fn finish(mut self) -> (Vec<DiagnosticStatus>, Vec<u64>) {
        signal(self.process.id(), "INT");
        let status = self.process.wait().expect("it ends");
        assert!(status.success(), "{status}: {}", self.said());
        let records: Vec<PathBuf> = fs::read_dir(self.folder.path().join("records"))
            .expect("records")
            .map(|e| e.expect("one").path())
            .collect();
        let recording = Recording::open(&records[0]).expect("a recording");
        assert!(recording.is_complete(), "{:?}", recording.damage());
        let (mut inputs, mut over_ros2, mut answers, mut states) = (vec![], vec![], vec![], vec![]);
        for entry in recording.messages() {
            match entry.message {
                Recorded::Known(Payload::OperatingPoint(input)) if input.seq < FIRST_OVER_ROS => inputs.push(input.seq),
                Recorded::Known(Payload::OperatingPoint(input)) => over_ros2.push(input.seq),
                // The note of a silence is no answer to an input.
                Recorded::Known(Payload::Prediction(answer))
                    if answer.input_seq < FIRST_OVER_ROS && !answer.reason.starts_with("stale") =>
                {
                    answers.push(answer.input_seq);
                }
                Recorded::Known(Payload::Diagnostics(array)) => {
                    states.extend(array.status.into_iter().find(|status| status.name.ends_with("predictions")));
                }
                _ => {}
            }
        }
        let asked: Vec<u64> = (self.first_seq..=self.seq).collect();
        for (what, seqs) in [("inputs", inputs), ("answers", answers)] {
            let recorded: Vec<u64> = seqs.into_iter().filter(|&seq| seq >= self.first_seq).collect();
            assert!(recorded == asked, "{} {what} recorded of {}", recorded.len(), asked.len());
        }
        (states, over_ros2)
    }
}

impl Drop for Node {
    fn drop(&mut self) {
        let _ = self.process.kill();
        let _ = self.process.wait();
    }
}

fn point(seq: u64) -> OperatingPoint {
    OperatingPoint {
        header: Header { stamp: Time::from_ns(1_000_000 * seq as i64), frame_id: String::new() },
        seq,
        normal_load_n: 500.0,
        disc_speed_rad_s: 13.0,
        friction_coefficient: 0.3 + 1e-4 * (seq % 1000) as f64,
    }
}

/// A rig's program on ROS 2.
struct Peer {
    source: Ros2Source,
    received: Receiver<Received<Prediction>>,
    seq: u64,
}

impl Peer {
    fn join(domain: u16) -> Self {
        let (sender, received): (Sender<Received<Prediction>>, _) = unbounded();
        let options = Ros2Options::new(Some(domain), true, RosArgs::default()).expect("a domain");
        Self { source: Ros2Source::start(&options, into(sender)).expect("joined"), received, seq: FIRST_OVER_ROS }
    }

    /// Publishes an input, and whether some input of this peer was answered since the last call.
    fn is_answered(&mut self) -> bool {
        self.seq += 1;
        self.source.publish(&point(self.seq)).expect("published");
        self.received.try_iter().any(|received| received.message.input_seq > FIRST_OVER_ROS)
    }

    fn forget(&self) {
        while self.received.try_recv().is_ok() {}
    }
}

/// Subscribes to the rig as a late reader does and passes the subscription to `check`.
fn late_reader_of_the_rig(domain: u16, check: impl FnOnce(&dyn Fn() -> Option<RigInfo>)) {
    use ros2_client::{Context, MessageTypeName, Name, NodeName, NodeOptions, QosProfile, qos};
    let participant = rustdds::DomainParticipantBuilder::new(domain).with_only_networks([Ipv4Addr::LOCALHOST]).build();
    let context = Context::from_domain_participant(participant.expect("participant")).expect("context");
    let mut node = context.new_node(NodeName::new("/", "late").expect("name"), NodeOptions::new()).expect("node");
    let profile = QosProfile::publisher_default().durability(qos::Durability::TransientLocal);
    let kind = MessageTypeName::new("squealcast_msgs", "RigInfo");
    let topic = node.create_topic(&Name::new("/squealcast", "rig").expect("name"), kind, &profile).expect("topic");
    let subscription = node.create_subscription::<RigInfo>(&topic, None).expect("subscription");
    check(&|| subscription.take().expect("taken").map(|(rig, _)| rig));
}

/// The processes started by one.
pub fn children(parent: u32) -> Vec<u32> {
    let processes =
        fs::read_dir("/proc").expect("/proc").filter_map(|entry| entry.ok()?.file_name().to_str()?.parse().ok());
    processes
        .filter(|&id: &u32| status(id, "PPid:") == Some(u64::from(parent)) && status(id, "VmRSS:").is_some())
        .collect()
}

/// A number of `/proc/ID/status`.
fn status(id: u32, key: &str) -> Option<u64> {
    let text = fs::read_to_string(format!("/proc/{id}/status")).ok()?;
    text.lines().find_map(|line| line.strip_prefix(key))?.split_whitespace().next()?.parse().ok()
}

pub fn resident_bytes(id: u32) -> u64 {
    1024 * status(id, "VmRSS:").expect("it runs")
}

fn signal(id: u32, signal: &str) {
    let sent = std::process::Command::new("kill").args([&format!("-{signal}"), &id.to_string()]).status();
    assert!(sent.expect("kill is there").success());
}

/// Each kind that makes RustDDS allocate without bound ends the ROS 2 side, again and again, and nothing else.
#[test]
fn a_forged_datagram_ends_the_ros2_side_alone() {
    let mut node = Node::start(0);
    let mut peer = Peer::join(node.domain);
    node.wait("an answer over ROS 2", |_| peer.is_answered());
    let before = resident_bytes(node.process.id());
    let mut slowest = Duration::ZERO;
    for (number, kind) in ALL_FORGED.into_iter().enumerate() {
        let (side, falls) = (node.side(), node.falls());
        let mut forger = Forger::new(Ipv4Addr::LOCALHOST, node.domain, number as u32);
        let begun = Instant::now();
        node.wait(&format!("a fall by {kind:?}"), |node| {
            forger.announce();
            forger.forge(kind);
            slowest = slowest.max(node.answers());
            node.falls() > falls
        });
        let fell_after = begun.elapsed();
        peer.forget();
        node.wait("an answer over ROS 2 again", |node| {
            slowest = slowest.max(node.answers());
            peer.is_answered()
        });
        assert_ne!(node.side(), side);
        eprintln!("{kind:?}: fell after {fell_after:.1?}, ROS 2 answered after {:.1?}", begun.elapsed());
    }
    eprintln!("{}", node.said());
    let after = resident_bytes(node.process.id());
    eprintln!("shared memory answered within {slowest:.1?}; {} kB before, {} kB after", before >> 10, after >> 10);
    assert!(after < before + MEMORY_MARGIN, "{before} bytes before, {after} after");
    node.finish();
}

/// Mutated datagrams, as many as `SQUEALCAST_DATAGRAMS` says or 20 000.
#[test]
fn mutated_datagrams_leave_predictions_and_memory_alone() {
    let count = std::env::var("SQUEALCAST_DATAGRAMS").map_or(20_000, |text| text.parse().expect("a number"));
    let mut node = Node::start(1);
    let mut peer = Peer::join(node.domain);
    node.wait("an answer over ROS 2", |_| peer.is_answered());
    let (before, mut most, mut most_of_side) = (resident_bytes(node.process.id()), 0, 0);
    let (mut slowest, mut answered) = (Duration::ZERO, 0);
    let mut random = random(1);
    let mut forger = Forger::new(Ipv4Addr::LOCALHOST, node.domain, 1);
    let seeds = forger.seeds();
    for sent in 0..count {
        if sent % 50 == 0 {
            forger.announce();
            slowest = slowest.max(node.answers());
            answered += u32::from(peer.is_answered());
            most = most.max(resident_bytes(node.process.id()));
            most_of_side = most_of_side.max(node.side().and_then(|side| status(side, "VmRSS:")).unwrap_or(0));
            assert!(node.process.try_wait().expect("waited").is_none(), "the node ended: {}", node.said());
        }
        let mut datagram = seeds[(random() % seeds.len() as u64) as usize].clone();
        mutate(&mut datagram, &mut random);
        forger.send(&datagram);
    }
    peer.forget();
    let begun = Instant::now();
    node.wait("an answer over ROS 2 again", |_| peer.is_answered());
    eprintln!(
        "{count} mutated datagrams: {} falls; slowest answer over shared memory {slowest:.1?}, {answered} answers over ROS 2 \
         meanwhile, the next {:.1?} after the last datagram; node {} kB before, {} kB at most; its ROS 2 side {most_of_side} kB \
         at most",
        node.falls(),
        begun.elapsed(),
        before >> 10,
        most >> 10,
    );
    assert!(most < before + MEMORY_MARGIN, "{before} bytes before, {most} at most");
    node.finish();
}

#[test]
fn a_ros2_side_that_is_killed_is_started_again_with_the_rig() {
    let mut node = Node::start(2);
    let mut peer = Peer::join(node.domain);
    node.wait("an answer over ROS 2", |_| peer.is_answered());
    for falls in 1..=3 {
        let side = node.side().expect("it is there");
        signal(side, "KILL");
        node.wait("the note of the fall", |node| node.answers() > Duration::ZERO && node.falls() == falls);
        peer.forget();
        node.wait("an answer over ROS 2 again", |node| node.answers() > Duration::ZERO && peer.is_answered());
    }
    assert!(node.said().contains("SIGKILL"), "{}", node.said());
    late_reader_of_the_rig(node.domain, |rig| {
        node.wait("the latched rig", |_| rig().is_some_and(|rig| rig.mode_count == 9))
    });
    let (states, _) = node.finish();
    let warned = |state: &&DiagnosticStatus| state.level == 1 && state.message.contains("the ROS 2 side ended");
    assert!(states.iter().filter(warned).any(|state| state.message.contains("SIGKILL")), "{states:?}");
    let last = states.last().expect("one a second");
    assert!(last.values.iter().any(|pair| pair.key == "ros2_side_falls" && pair.value == "3"), "{last:?}");
}

/// A value that a peer set is in force in the next ROS 2 side too, and what must be refused is.
#[test]
fn parameters_outlive_the_ros2_side() {
    let mut node = Node::start(7);
    let client = ParameterClient::join(node.domain);
    assert_eq!(client.set("warn_margin", 0.33), Ok(()));
    assert!(client.set("warn_margin", -1.0).is_err_and(|reason| reason.contains("warn_margin")));
    signal(node.side().expect("it is there"), "KILL");
    node.wait("the note of the fall", |node| node.answers() > Duration::ZERO && node.falls() == 1);
    node.wait("the next ROS 2 side", |node| node.side().is_some());
    assert_eq!(ParameterClient::join(node.domain).get("warn_margin"), 0.33);
    node.finish();
}

/// Asks a node for its parameters.
pub struct ParameterClient {
    node: Mutex<ros2_client::Node>,
    runtime: tokio::runtime::Runtime,
    _context: ros2_client::Context,
}

impl ParameterClient {
    pub fn join(domain: u16) -> Self {
        use ros2_client::{Context, NodeName, NodeOptions};
        let participant =
            rustdds::DomainParticipantBuilder::new(domain).with_only_networks([Ipv4Addr::LOCALHOST]).build();
        let context = Context::from_domain_participant(participant.expect("participant")).expect("context");
        let mut node = context.new_node(NodeName::new("/", "asking").expect("name"), NodeOptions::new()).expect("node");
        let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(1).enable_all().build();
        let runtime = runtime.expect("runtime");
        runtime.spawn(node.spinner().expect("spinner").spin());
        Self { node: Mutex::new(node), runtime, _context: context }
    }

    pub fn set(&self, name: &str, value: f64) -> Result<(), String> {
        use ros2_client::rcl_interfaces::{SetParametersRequest, SetParametersResponse};
        use ros2_client::{Parameter, ParameterValue};
        let parameter = Parameter { name: name.to_owned(), value: ParameterValue::Double(value) };
        let request = SetParametersRequest { parameter: vec![parameter.into()] };
        let answer: SetParametersResponse = self.call("SetParameters", "set_parameters", request);
        let result = &answer.results[0];
        if result.successful { Ok(()) } else { Err(result.reason.clone()) }
    }

    pub fn get(&self, name: &str) -> f64 {
        use ros2_client::rcl_interfaces::{GetParametersRequest, GetParametersResponse};
        let request = GetParametersRequest { names: vec![name.to_owned()] };
        let answer: GetParametersResponse = self.call("GetParameters", "get_parameters", request);
        answer.values[0].double_value
    }

    fn call<Q, A>(&self, kind: &str, name: &str, request: Q) -> A
    where
        Q: ros2_client::Message + Clone + 'static,
        A: ros2_client::Message + 'static,
    {
        use ros2_client::{Name, QosProfile, ServiceMapping, ServiceTypeName};
        let mut node = self.node.lock().expect("whole");
        let profile = QosProfile::publisher_default();
        let client = node.create_client::<Q, A>(
            ServiceMapping::Enhanced,
            &Name::new("/squealcast", name).expect("name"),
            &ServiceTypeName::new("rcl_interfaces", kind),
            profile.clone(),
            profile,
        );
        let client = client.expect("client");
        let begun = Instant::now();
        loop {
            // The client may know the service before the service knows the client: then the request is lost.
            let answered = self.runtime.block_on(async {
                tokio::time::timeout(Duration::from_secs(1), async {
                    client.wait_for_service(&node).await;
                    client.async_call_service(request.clone()).await.expect("answered")
                })
                .await
            });
            match answered {
                Ok(answer) => return answer,
                Err(_) => assert!(begun.elapsed() < bus::PATIENCE, "no answer: {name}"),
            }
        }
    }
}

#[test]
fn a_ros2_side_that_hangs_is_replaced() {
    let mut node = Node::start(3);
    let mut peer = Peer::join(node.domain);
    node.wait("an answer over ROS 2", |_| peer.is_answered());
    let side = node.side().expect("it is there");
    signal(side, "STOP");
    node.wait("the note of the fall", |node| node.answers() > Duration::ZERO && node.falls() == 1);
    assert!(node.said().contains("no message for"), "{}", node.said());
    peer.forget();
    node.wait("an answer over ROS 2 again", |node| node.answers() > Duration::ZERO && peer.is_answered());
    assert_ne!(node.side(), Some(side));
    node.finish();
}

/// The ROS 2 side continues to receive while its node is stopped, and the node gets these messages afterwards.
#[test]
fn a_node_that_is_stopped_for_a_while_loses_no_input() {
    const COUNT: u64 = 2000;
    let mut node = Node::start(9);
    let mut peer = Peer::join(node.domain);
    node.wait("an answer over ROS 2", |_| peer.is_answered());
    let first = peer.seq;
    signal(node.process.id(), "STOP");
    let begun = Instant::now();
    while peer.seq < first + COUNT {
        peer.is_answered();
        std::thread::sleep(Duration::from_millis(2 * (peer.seq - first)).saturating_sub(begun.elapsed()));
    }
    signal(node.process.id(), "CONT");
    node.wait("an answer to the last input", |_| {
        peer.received.try_iter().any(|received| received.message.input_seq == first + COUNT)
    });
    assert_eq!(node.falls(), 0, "{}", node.said());
    let (_, recorded) = node.finish();
    let recorded = recorded.iter().filter(|&&seq| seq > first).count() as u64;
    eprintln!("{recorded} of {COUNT} recorded");
    // The subscription itself may lose some on a busy machine; the socket alone holds a few hundred.
    assert!(recorded > COUNT * 9 / 10, "{recorded}");
}

/// Also one that is stopped: it cannot read that its socket was closed.
#[test]
fn the_ros2_side_ends_with_its_node() {
    for stopped in [false, true] {
        let mut node = Node::start(4);
        let side = node.side().expect("it is there");
        if stopped {
            signal(side, "STOP");
        }
        node.process.kill().expect("killed");
        node.process.wait().expect("waited");
        wait_until("the end of the ROS 2 side", || status(side, "VmRSS:").is_none());
    }
}

/// A reader that is stopped leaves every prediction unacknowledged. 20 000 at 2 kHz are more than twice what the publisher
/// has room for, and less than the reader's lease, after which it would be forgotten.
#[test]
fn a_reader_that_does_not_acknowledge_holds_up_no_other() {
    const COUNT: u64 = 20_000;
    let mut node = Node::start(5);
    let domain = node.domain.to_string();
    let frozen = command(["simulate", "--no-shm", "--loopback", "--rate", "20", "--domain", &domain]).spawn();
    let mut frozen = frozen.expect("started");
    node.wait("the reader that will freeze", |node| {
        // Its stamps are of today, those of this test of 1970.
        let is_simulated =
            |answer: &Prediction| answer.level != level::FAULT && answer.header.stamp.sec > 1_000_000_000;
        node.predictions.try_iter().any(|received| is_simulated(&received.message))
    });
    let mut peer = Peer::join(node.domain);
    node.wait("an answer over ROS 2", |_| peer.is_answered());
    signal(frozen.id(), "STOP");
    peer.forget();
    let (first, begun) = (node.seq, Instant::now());
    let (mut received, mut last_received, mut longest_pause, mut last_seq) = (0, begun, Duration::ZERO, 0);
    while last_seq < first + COUNT {
        for prediction in peer
            .received
            .try_iter()
            .filter(|received| (first + 1..FIRST_OVER_ROS).contains(&received.message.input_seq))
        {
            received += 1;
            last_seq = prediction.message.input_seq;
            longest_pause = longest_pause.max(last_received.elapsed());
            last_received = Instant::now();
        }
        let due = first + (2000.0 * begun.elapsed().as_secs_f64()) as u64;
        while node.seq < due.min(first + COUNT) {
            node.seq += 1;
            node.shm.publish(&point(node.seq)).expect("published");
        }
        assert!(
            begun.elapsed() < bus::PATIENCE,
            "{received} received, the last {last_seq} of {}: {}",
            first + COUNT,
            node.said()
        );
        std::thread::sleep(Duration::from_millis(1));
    }
    let _ = frozen.kill();
    let _ = frozen.wait();
    eprintln!(
        "{received} of {COUNT} received next to a frozen reader in {:.1?}, longest pause {longest_pause:.1?}",
        begun.elapsed()
    );
    // What this reader cannot keep up with at 2 kHz on a busy machine is lost in its own queue.
    assert!(received >= COUNT / 2, "{received}");
    // A renewal holds predictions back for 0.1 s; a busy machine adds to it. Without, it is the reader's lease.
    assert!(longest_pause < Duration::from_secs(3), "{longest_pause:?}");
    assert_eq!(node.falls(), 0, "{}", node.said());
}

/// Round trips over ROS 2 to an echo in one process with RustDDS, and to one whose ROS 2 side is a process of its own, in turn.
#[test]
fn the_ros2_side_costs_little_time() {
    const BLOCKS: usize = 10;
    const ROUNDS: usize = 100;
    let domain = 10 + (std::process::id() % 9) as u16 * 10 + 8;
    let options = |topic: &str| {
        let rules = ["/rig/operating_point", "/squealcast/prediction"].map(|name| format!("{name}:={topic}{name}"));
        let arguments = ["--ros-args", "-r", &rules[0], "-r", &rules[1]].map(str::to_owned);
        let (args, _) = RosArgs::split(arguments).expect("well formed");
        Ros2Options::new(Some(domain), true, args).expect("a domain")
    };
    let (inside, outside) = (options("/inside"), options("/outside"));

    let echo: Arc<OnceLock<Ros2>> = Arc::default();
    let echoing = echo.clone();
    let answer = move |received: Received<OperatingPoint>| {
        let ros2 = echoing.get().expect("started");
        ros2.publish_prediction(&bus::answer(&received.message)).expect("published");
    };
    let started = Ros2::start(&inside, Parameters::none(), answer, |_| ()).expect("started");
    assert!(echo.set(started).is_ok());

    let apart: Arc<OnceLock<Ros2Process>> = Arc::default();
    let echoing = apart.clone();
    let sinks = Sinks {
        input: Box::new(move |received| {
            let ros2 = echoing.get().expect("started");
            ros2.publish_prediction(&bus::answer(&received.message)).expect("published");
        }),
        vibration: Box::new(|_| ()),
        temperature: Box::new(|_| ()),
        waveform: Box::new(|_| ()),
        parameter: Box::new(|_, _| ()),
        lifecycle: Box::new(|_| ()),
        fell: Box::new(|why| panic!("{why}")),
    };
    let program = env!("CARGO_BIN_EXE_squealcast").into();
    assert!(
        apart
            .set(Ros2Process::start_program(program, &outside, vec![], State::Active, sinks).expect("started"))
            .is_ok()
    );

    let mut askers = [inside, outside].map(|options| {
        let (sender, received) = unbounded();
        let source = Ros2Source::start(&options, into(sender)).expect("joined");
        wait_until("readers", || source.readers() > 0 && source.prediction_writers() > 0);
        Peer { source, received, seq: 0 }
    });
    let mut times = [vec![], vec![]];
    for block in 0..BLOCKS {
        for (asker, times) in askers.iter_mut().zip(&mut times) {
            for _ in 0..ROUNDS {
                asker.seq += 1;
                let asked = Instant::now();
                asker.source.publish(&point(asker.seq)).expect("published");
                // A first answer may be lost while reader and writer find each other.
                match asker.received.recv_timeout(if block == 0 { Duration::from_millis(200) } else { bus::PATIENCE }) {
                    Ok(_) => times.push(asked.elapsed().as_secs_f64() * 1e6),
                    Err(_) => assert_eq!(block, 0, "no answer"),
                }
            }
        }
    }
    let [inside, outside] = times.map(|mut times| {
        times.sort_by(f64::total_cmp);
        [times[times.len() / 2], times[times.len() * 99 / 100]]
    });
    let ratio = outside[0] / inside[0];
    eprintln!("round trip, median and p99 in us: one process {inside:.0?}, two {outside:.0?}, ratio {ratio:.2}");
    assert!(!program::measuring() || ratio < 2.0, "{ratio}");
}

/// Where to send forged datagrams, for this test binary started once more in another network namespace.
const FORGE: &str = "SQUEALCAST_FORGE_DOMAIN";
const HOST: Ipv4Addr = Ipv4Addr::new(10, 213, 77, 1);

/// From a network namespace, as from another machine: a node with `--loopback` does not receive the datagrams that end its ROS 2 side when it
/// comes from this machine.
#[test]
fn forged_datagrams_from_elsewhere_do_not_reach_a_node_on_loopback() {
    if let Ok(domain) = std::env::var(FORGE) {
        let mut forger = Forger::new(HOST, domain.parse().expect("a number"), 7);
        for _ in 0..100 {
            forger.announce();
            forger.forge(Forged::NackFrag);
            std::thread::sleep(Duration::from_millis(10));
        }
        return;
    }
    let Some(elsewhere) = Namespace::new() else {
        return program::skipped("making a network namespace takes rights that this process does not have");
    };
    let forge = |node: &Node| {
        let test = "ros2_side::forged_datagrams_from_elsewhere_do_not_reach_a_node_on_loopback";
        let program = std::env::current_exe().expect("its path");
        let mut forging = std::process::Command::new("ip");
        forging.args(["netns", "exec", &elsewhere.name]).arg(program).args(["--exact", test]);
        let status = forging.env(FORGE, node.domain.to_string()).stdout(Stdio::null()).status();
        assert!(status.expect("ip is there").success());
    };
    let mut node = Node::start(6);
    let mut peer = Peer::join(node.domain);
    forge(&node);
    node.wait("an answer over ROS 2", |_| peer.is_answered());
    assert_eq!(node.falls(), 0, "{}", node.said());
    let mut forger = Forger::new(Ipv4Addr::LOCALHOST, node.domain, 8);
    node.wait("a fall by the same datagrams from this machine", |node| {
        forger.announce();
        forger.forge(Forged::NackFrag);
        node.falls() > 0
    });
    node.finish();
}

/// A network namespace joined to this one; it goes with this value.
struct Namespace {
    name: String,
}

impl Namespace {
    /// `None` where that is not permitted.
    fn new() -> Option<Self> {
        // Names of interfaces have 15 characters at most.
        let name = format!("sq{}", std::process::id());
        let (inner, outer) = (format!("{name}-in"), format!("{name}-out"));
        let this = Self { name: name.clone() };
        let made = this.ip(&["netns", "add", &name])
            && this.ip(&["link", "add", &outer, "type", "veth", "peer", "name", &inner, "netns", &name])
            && this.ip(&["addr", "add", "10.213.77.1/24", "dev", &outer])
            && this.ip(&["link", "set", &outer, "up"])
            && this.ip(&["-n", &name, "addr", "add", "10.213.77.2/24", "dev", &inner])
            && this.ip(&["-n", &name, "link", "set", &inner, "up"]);
        made.then_some(this)
    }

    fn ip(&self, arguments: &[&str]) -> bool {
        let output = std::process::Command::new("ip").args(arguments).output();
        output.is_ok_and(|output| output.status.success())
    }
}

impl Drop for Namespace {
    fn drop(&mut self) {
        // The pair of interfaces goes with it.
        self.ip(&["netns", "del", &self.name]);
    }
}

#[test]
fn the_command_of_the_ros2_side_is_not_for_the_command_line() {
    program::run(["ros2-side"]).exits(1).complains("no socket of a node");
    let help = program::run(["--help"]).exits(0);
    assert!(!help.stdout.contains("ros2-side"), "{}", help.stdout);
}

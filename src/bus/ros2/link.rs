//! One ROS 2 node with its subscriptions, on its own thread.

use std::collections::HashSet;
use std::net::Ipv4Addr;
use std::pin::Pin;
use std::sync::atomic::AtomicBool;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::{self, JoinHandle};

use ros2_client::{
    Context, Message, MessageTypeName, Name, Node, NodeName, Publisher, QosProfile, Server, ServiceMapping,
    ServiceTypeName,
};
use rustdds::policy::{History, Lifespan, Reliability, ResourceLimits};
use rustdds::{DomainParticipantBuilder, Duration, QosPolicies, QosPolicyBuilder, Topic, TopicKind};
use serde::Serialize;
use serde::de::DeserializeOwned;
use tokio::sync::oneshot;

pub(super) use rustdds::policy::Durability;

use super::super::received::{Counters, Counts, Gaps, Received};
use super::loopback::keep_to_loopback;
use super::qos_conflicts::QosConflicts;
use super::subscriptions::{Refused, Subscriptions};
use super::{Parameters, Ros2Error, Ros2Options, parameters, received};
use crate::bus::log::{KEPT_LINES, Line, ROSOUT, Severity};
use crate::bus::qos_overrides::{Chosen, QosOverrides, Role};
use crate::msgs::topic;

/// Samples that may wait for the thread that reads a subscription; RustDDS acknowledges samples beyond it and drops
/// them. After a loss a reliable subscription delivers nothing until the sample is retransmitted, and then everything
/// at once. Fast DDS retransmits with its next heartbeat, by default after 3 s: at 2 kHz, 6000 samples wait for that.
pub(super) const MAX_WAITING: i32 = 8192;
/// As [`MAX_WAITING`], of blocks of samples: at most 64 MiB.
pub(super) const MAX_BLOCKS_WAITING: i32 = 1024;
/// Messages that a reader may leave unacknowledged before publishing fails. A killed reader is only forgotten after its
/// lease, usually less than a minute. RustDDS's default of 8192 would be exhausted after 16 s at 500 Hz, for all
/// readers.
pub(super) const MAX_UNANSWERED: i32 = 1 << 15;

/// How long lines of `/rosout` are kept for later readers, as in every ROS 2 node.
const LOG_LIFESPAN: Duration = Duration::from_secs(10);
/// Requests of a service that may wait for its answer.
const REQUESTS_WAITING: i32 = 1000;
/// Largest answer of a service that arrives, bytes of CDR: RustDDS sends an answer that does not fit into one datagram in a
/// malformed form.
pub(super) const MAX_ANSWER: usize = 1200;
/// Pause after a request that could not be read.
const AFTER_FAILURE: std::time::Duration = std::time::Duration::from_millis(50);

/// A node that its services share with its [`Link`].
#[derive(Clone)]
pub(super) struct SharedNode(Arc<Mutex<Node>>);

impl SharedNode {
    pub(super) fn lock(&self) -> MutexGuard<'_, Node> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// The future that reads one subscription, or answers a service, on the node's thread.
pub(super) type Hearing = Pin<Box<dyn Future<Output = ()> + Send>>;

/// A node, and the thread that serves its parameters, reads its main topic with messages `M` and any other
/// subscriptions.
pub(super) struct Link<M> {
    options: Ros2Options,
    name: NodeName,
    subscriptions: Option<Arc<Subscriptions<M>>>,
    conflicts: QosConflicts,
    overrides: QosOverrides,
    parameter_services: Option<parameters::Services>,
    node: SharedNode,
    context: Context,
    counters: Arc<Counters>,
    running: Option<(oneshot::Sender<()>, JoinHandle<()>)>,
}

impl<M: DeserializeOwned + Send + Sync + 'static> Link<M> {
    /// Joins the network with a node. Changes of its `parameters` are passed on once `started` is set.
    pub(super) fn join(
        options: &Ros2Options,
        default_name: &str,
        parameters: Parameters,
        started: Arc<AtomicBool>,
    ) -> Result<Self, Ros2Error> {
        let base_name = options.args.node_name(default_name);
        let namespace = options.args.namespace(&base_name, "/");
        let (overrides, _) = options.args.qos_overrides(&namespace, &base_name)?;
        let (node, parameter_services) = parameters.declare(started, &overrides);
        let full_name = format!("{}/{base_name}", namespace.trim_end_matches('/'));
        let failed = |reason: String| Ros2Error::Node { name: full_name.clone(), reason };

        let bad_name = |error: ros2_client::names::NameError| Ros2Error::Name {
            name: full_name.clone(),
            reason: error.to_string(),
        };
        let name = NodeName::new(&namespace, &base_name).map_err(bad_name)?;
        // The names of its services begin with this name and must satisfy stricter rules.
        Name::parse(&full_name).map_err(bad_name)?;

        let mut participant = DomainParticipantBuilder::new(options.domain_id);
        if options.loopback_only {
            participant = participant.with_only_networks([Ipv4Addr::LOCALHOST]);
        }
        let participant = participant.build().map_err(|e| failed(e.to_string()))?;
        if options.loopback_only {
            keep_to_loopback().map_err(|e| failed(format!("cannot keep to the loopback interface: {e}")))?;
        }
        let context = Context::from_domain_participant(participant).map_err(|e| failed(e.to_string()))?;
        let node = context.new_node(name.clone(), node).map_err(|e| failed(e.to_string()))?;
        Ok(Self {
            options: options.clone(),
            name,
            conflicts: QosConflicts::new(&context),
            overrides,
            parameter_services: Some(parameter_services),
            context,
            node: SharedNode(Arc::new(Mutex::new(node))),
            subscriptions: None,
            counters: Arc::new(Counters::default()),
            running: None,
        })
    }

    /// A reliable publisher that never blocks. Publishing fails once a reader has left `max_unanswered` messages
    /// unacknowledged.
    pub(super) fn publisher<P: Serialize>(
        &mut self,
        name: &'static str,
        kind: MessageTypeName,
        durability: Durability,
        max_unanswered: i32,
    ) -> Result<Publisher<P>, Ros2Error> {
        let limits =
            ResourceLimits { max_samples: max_unanswered, max_instances: 1, max_samples_per_instance: max_unanswered };
        // Late subscribers get the latest message only.
        let depth = if durability == Durability::TransientLocal { 1 } else { topic::DEPTH };
        let chosen = self.overrides.of(Role::Publisher, &self.full_name(name));
        let reliability = if chosen.best_effort == Some(true) { Reliability::BestEffort } else { RELIABLE };
        let qos = qos(chosen, durability, reliability, depth).resource_limits(limits).build();
        let predicts = name == topic::PREDICTION;
        let (topic, name) = self.topic(name, &kind, &qos)?;
        self.conflicts.published(&topic, &name);
        if predicts {
            self.conflicts.predictions(&topic, &name);
        }
        self.node().create_publisher(&topic, None).map_err(|e| Ros2Error::Topic { name, reason: e.to_string() })
    }

    /// The publisher of log lines; `None` if the user has switched it off.
    pub(super) fn rosout(&mut self) -> Result<Option<Publisher<Line>>, Ros2Error> {
        if self.options.args.log_level().is_none() {
            return Ok(None);
        }
        let limits =
            ResourceLimits { max_samples: MAX_UNANSWERED, max_instances: 1, max_samples_per_instance: MAX_UNANSWERED };
        let qos = qos(Chosen::default(), Durability::TransientLocal, RELIABLE, KEPT_LINES)
            .lifespan(Lifespan { duration: LOG_LIFESPAN })
            .resource_limits(limits)
            .build();
        let (topic, name) = self.topic(ROSOUT, &MessageTypeName::new("rcl_interfaces", "Log"), &qos)?;
        let failed = |e: ros2_client::CreateError| Ros2Error::Topic { name, reason: e.to_string() };
        self.node().create_publisher(&topic, None).map(Some).map_err(failed)
    }

    /// Adds a service of the node. Its requests are answered while the future runs.
    pub(super) fn service<Q, A>(
        &mut self,
        name: &str,
        kind: &ServiceTypeName,
        mut answer: impl FnMut(Q) -> A + Send + 'static,
    ) -> Result<Hearing, Ros2Error>
    where
        Q: Message + Clone + Send + Sync + 'static,
        A: Message + Send + Sync + 'static,
    {
        let full_name = self.name.fully_qualified_name();
        let failed = |reason: String| Ros2Error::Topic { name: format!("{full_name}/{name}"), reason };
        let service = Name::new(&full_name, name).map_err(|e| failed(e.to_string()))?;
        let depth = usize::try_from(REQUESTS_WAITING).unwrap_or(1);
        let profile = QosProfile::publisher_default().history(ros2_client::qos::History::KeepLast { depth });
        let server: Server<Q, A> = self
            .node()
            .create_server(ServiceMapping::Enhanced, &service, kind, profile.clone(), profile)
            .map_err(|e| failed(e.to_string()))?;
        Ok(Box::pin(async move {
            loop {
                match server.async_receive_request().await {
                    // The client repeats its request if no answer comes.
                    Ok((id, request)) => drop(server.async_send_response(id, answer(request)).await),
                    Err(_) => tokio::time::sleep(AFTER_FAILURE).await,
                }
            }
        }))
    }

    /// The node, for the services.
    pub(super) fn shared_node(&self) -> SharedNode {
        self.node.clone()
    }

    /// Subscribes and starts the thread, which also reads the subscriptions in `aside`.
    pub(super) fn listen(
        &mut self,
        topic: &'static str,
        kind: MessageTypeName,
        seq: fn(&M) -> u64,
        sink: impl FnMut(Received<M>) + Send + 'static,
        aside: Option<Hearing>,
    ) -> Result<(), Ros2Error> {
        let subscriptions = Arc::new(self.subscribe::<M>(topic, &kind, MAX_WAITING)?);
        let parameters = self.parameter_services.take().map(|services| services.add(self)).transpose()?;
        let failed = |reason: String| Ros2Error::Topic { name: topic.to_owned(), reason };
        let spinner = self.node().spinner().map_err(|e| failed(e.to_string()))?;
        let namesakes = self.node().status_receiver();

        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
        let (stop, stopped) = oneshot::channel();
        self.subscriptions = Some(Arc::clone(&subscriptions));
        let counters = Arc::clone(&self.counters);
        let conflicts = self.conflicts.clone();
        let full_name = self.name.fully_qualified_name();
        let thread = thread::Builder::new().name(format!("ros2 {}", self.name.base_name())).spawn(move || {
            runtime.block_on(async {
                for hearing in aside.into_iter().chain(parameters) {
                    tokio::spawn(hearing);
                }
                if let Some(namesakes) = namesakes {
                    let (conflicts, mut known) = (conflicts.clone(), HashSet::new());
                    tokio::spawn(async move {
                        while let Ok(event) = namesakes.recv().await {
                            conflicts.namesakes(&event, &full_name, &mut known);
                        }
                    });
                }
                let spin = async {
                    if spinner.spin().await.is_err() {
                        counters.failure();
                    }
                    // The parameter service has ended, but messages are still received.
                    std::future::pending::<()>().await
                };
                tokio::select! {
                    _ = stopped => (),
                    () = spin => (),
                    () = conflicts.watch(&counters) => (),
                    () = hear(&subscriptions, seq, sink, &counters) => (),
                }
            });
        })?;
        self.running = Some((stop, thread));
        Ok(())
    }

    /// Adds a subscription to another topic, whose messages have no sequence numbers, to the thread of
    /// [`Link::listen`]. At most `max_waiting` messages wait for it.
    pub(super) fn aside<N: DeserializeOwned + Send + Sync + 'static>(
        &mut self,
        topic: &'static str,
        kind: MessageTypeName,
        max_waiting: i32,
        sink: impl FnMut(Received<N>) + Send + 'static,
        counters: Arc<Counters>,
    ) -> Result<Hearing, Ros2Error> {
        let subscriptions = self.subscribe::<N>(topic, &kind, max_waiting)?;
        Ok(Box::pin(async move {
            hear(&subscriptions, |_| 0, sink, &counters).await;
        }))
    }

    fn subscribe<N: DeserializeOwned + 'static>(
        &mut self,
        topic: &'static str,
        kind: &MessageTypeName,
        max_waiting: i32,
    ) -> Result<Subscriptions<N>, Ros2Error> {
        let chosen = self.overrides.of(Role::Subscription, &self.full_name(topic));
        let requested = qos(chosen, Durability::Volatile, RELIABLE, max_waiting).build();
        let (reliable, name) = self.topic(topic, kind, &requested)?;
        let least = qos(chosen, Durability::Volatile, Reliability::BestEffort, max_waiting).build();
        let (best_effort, _) = self.topic(topic, kind, &least)?;
        let wants = |best_effort: bool| chosen.best_effort.is_none_or(|only| only == best_effort);
        self.conflicts.subscribed(if wants(true) { &best_effort } else { &reliable }, &name);
        let failed =
            |error: ros2_client::CreateError| Ros2Error::Topic { name: name.clone(), reason: error.to_string() };
        let mut node = self.node.lock();
        // The reliable one first: it then knows every publisher that the other one knows.
        let reliable = wants(false).then(|| node.create_subscription(&reliable, None)).transpose().map_err(failed)?;
        let best_effort =
            wants(true).then(|| node.create_subscription(&best_effort, None)).transpose().map_err(failed)?;
        drop(node);
        Ok(Subscriptions::new(reliable, requested, best_effort, self.context.domain_participant()))
    }

    /// The absolute name of a topic after remapping. Log lines are one topic for all namespaces.
    fn full_name(&self, topic: &'static str) -> String {
        let relative = if topic == ROSOUT { topic } else { topic::relative(topic) };
        self.options.args.topic(relative, self.name.namespace(), self.name.base_name())
    }

    /// Whether the user wants lines of this severity on `/rosout`.
    pub(super) fn logs(&self, severity: Severity) -> bool {
        self.options.args.log_level().is_some_and(|least| severity >= least)
    }

    /// The remapped topic, and its name.
    fn topic(
        &self,
        name: &'static str,
        kind: &MessageTypeName,
        qos: &QosPolicies,
    ) -> Result<(Topic, String), Ros2Error> {
        let full = self.full_name(name);
        let bad_name =
            |error: ros2_client::names::NameError| Ros2Error::Name { name: full.clone(), reason: error.to_string() };
        let name = Name::parse(&full).map_err(bad_name)?;
        // Not created through the node, which offers no limit on unacknowledged samples.
        self.context
            .domain_participant()
            .create_topic(name.to_dds_name("rt", &self.name, ""), kind.dds_msg_type(), qos, TopicKind::NoKey)
            .map(|topic| (topic, full.clone()))
            .map_err(|e| Ros2Error::Topic { name: full, reason: e.to_string() })
    }

    pub(super) fn counts(&self) -> Counts {
        self.counters.counts()
    }

    pub(super) fn writers(&self) -> usize {
        self.subscriptions.as_ref().map_or(0, |subscriptions| subscriptions.publishers(&self.node.lock()))
    }
}

impl<M> Link<M> {
    pub(super) fn node(&self) -> MutexGuard<'_, Node> {
        self.node.lock()
    }
}

impl<M> Drop for Link<M> {
    fn drop(&mut self) {
        if let Some((stop, thread)) = self.running.take() {
            let _ = stop.send(());
            // A panic of the sink was reported on that thread.
            let _ = thread.join();
        }
    }
}

async fn hear<M: DeserializeOwned + 'static>(
    subscriptions: &Subscriptions<M>,
    seq: fn(&M) -> u64,
    mut sink: impl FnMut(Received<M>),
    counters: &Counters,
) {
    let mut gaps = Gaps::new();
    let mut refused = Refused::new();
    loop {
        match subscriptions.next(&mut refused).await {
            Ok((message, info)) => {
                counters.received(gaps.note(info.publisher_gid(), seq(&message)));
                sink(received(message));
            }
            Err(ros2_client::ReadError::Deserialization { .. } | ros2_client::ReadError::Malformed) => {
                counters.malformed();
            }
            Err(ros2_client::ReadError::Closed) => {
                counters.failure();
                return;
            }
            Err(_) => {
                counters.failure();
                tokio::time::sleep(std::time::Duration::from_millis(50)).await;
            }
        }
    }
}

/// Reliable, and publishing never blocks.
const RELIABLE: Reliability = Reliability::Reliable { max_blocking_time: Duration::ZERO };

/// The given policies, except those that the user has chosen. Reliability is up to the caller.
fn qos(chosen: Chosen, durability: Durability, reliability: Reliability, depth: i32) -> QosPolicyBuilder {
    let durability = match chosen.transient_local {
        Some(true) => Durability::TransientLocal,
        Some(false) => Durability::Volatile,
        None => durability,
    };
    let history = match chosen.keep_all {
        Some(true) => History::KeepAll,
        Some(false) | None => History::KeepLast { depth: chosen.depth.unwrap_or(depth) },
    };
    QosPolicyBuilder::new().durability(durability).reliability(reliability).history(history)
}

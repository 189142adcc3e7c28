//! A node on Zenoh: its session, publishers, subscriptions and liveliness tokens.

use std::collections::HashMap;
use std::sync::atomic::{AtomicI64, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};

use ::zenoh::liveliness::LivelinessToken;
use ::zenoh::pubsub::{Publisher, Subscriber};
use ::zenoh::qos::{CongestionControl, Reliability};
use ::zenoh::sample::{Sample, SampleKind};
use ::zenoh::{Session, Wait};
use serde::Serialize;
use serde::de::DeserializeOwned;
use zenoh_ext::{
    AdvancedPublisher, AdvancedPublisherBuilderExt, AdvancedSubscriber, AdvancedSubscriberBuilderExt, CacheConfig,
    HistoryConfig,
};

use super::graph::{Graph, Own};
use super::names::{Attachment, Endpoint, Gid, Kind, NodeKey, all_tokens, dds_type, gid, topic_key};
use super::parameters::Store;
use super::service_types::{self, LOG};
use super::services::Server;
use super::{Receivers, Take, config, linger};
use crate::bus::log::{KEPT_LINES, Line, ROSOUT, Severity};
use crate::bus::managed::Managed;
use crate::bus::qos_overrides::{Chosen, QosOverrides, Role};
use crate::bus::received::{Counters, Counts, Gaps, Received};
use crate::bus::ros2::{NOTE, Parameters, Ros2Error, Ros2Options};
use crate::bus::{Bus, Outgoing};
use crate::msgs::schema::Topic;
use crate::msgs::{SessionEvent, SessionEventKind, from_cdr, to_cdr, topic};
use crate::system::clock;

/// A node with its endpoints. It leaves when it is dropped.
pub(super) struct ZenohNode {
    // Declared in the order in which they have to go.
    publishers: HashMap<Topic, Out>,
    _subscribers: Vec<In>,
    _servers: Vec<Server>,
    /// Of log lines, and the least severity of those that are wanted; `None` of a rig or a replay.
    rosout: Option<(Out, Severity)>,
    /// Its parameters; `None` of a rig or a replay.
    store: Option<Arc<Store>>,
    _token: LivelinessToken,
    _peers: Subscriber<()>,
    graph: Arc<Graph>,
    /// Of operating points or, in a rig, of predictions.
    counters: Arc<Counters>,
    waveform_counters: Arc<Counters>,
    looks: AtomicU64,
    key: NodeKey,
    _session: Session,
}

/// What a node offers beside its topics.
pub(super) struct Offered {
    pub parameters: Parameters,
    pub managed: Option<Managed>,
}

/// A publisher and its token.
pub(super) struct Out {
    _token: LivelinessToken,
    publisher: Sender,
    gid: Gid,
    /// Of the latest message.
    sequence: AtomicI64,
}

enum Sender {
    Plain(Publisher<'static>),
    /// Keeps its latest message for late subscribers.
    Latched(AdvancedPublisher<'static>),
}

/// A subscriber and its token.
struct In {
    _token: LivelinessToken,
    _subscriber: Receiver,
}

enum Receiver {
    Plain {
        _subscriber: Subscriber<()>,
    },
    /// Asks publishers for the messages that they keep.
    Latched {
        _subscriber: AdvancedSubscriber<()>,
    },
}

/// Declares the endpoints of a node.
pub(super) struct Builder<'a> {
    pub(super) session: &'a Session,
    pub(super) key: &'a NodeKey,
    /// Numbers of endpoints; the node itself is number 0.
    next: u32,
}

pub(super) fn failed(what: &str) -> impl Fn(::zenoh::Error) -> Ros2Error {
    move |error| Ros2Error::Zenoh(format!("{what}: {error}"))
}

impl ZenohNode {
    /// Joins with a node that publishes these topics and receives what `receivers` take. With `offered` it has the services
    /// and the log of a node.
    pub(super) fn join(
        options: &Ros2Options,
        default_name: &str,
        published: &[Topic],
        receivers: Receivers,
        offered: Option<Offered>,
    ) -> Result<Self, Ros2Error> {
        let name = options.args.node_name(default_name);
        let namespace = options.args.namespace(&name, "/");
        for part in namespace.split('/').filter(|part| !part.is_empty()).chain([name.as_str()]) {
            check_name(part)?;
        }
        let session = ::zenoh::open(config::session(options)?).wait().map_err(failed("session"))?;
        linger::avoid(&session).map_err(failed("links"))?;
        let key = NodeKey {
            domain: options.domain_id,
            session: session.zid().to_string(),
            number: 0,
            namespace: namespace.clone(),
            name: name.clone(),
        };
        let overrides = match offered {
            Some(_) => options.args.qos_overrides(&namespace, &name)?.0,
            None => QosOverrides::default(),
        };
        let own = |topic: Topic, kind| -> Result<Own, Ros2Error> {
            let name = options.args.topic(topic::relative(topic.name()), &namespace, &name);
            name.split('/').skip(1).try_for_each(check_name)?;
            let chosen = overrides.of(Role::of_node(topic), &name);
            Ok(Own { topic, kind, endpoint: endpoint(topic, name, chosen) })
        };
        let received = receivers.topics();
        let published: Vec<Own> =
            published.iter().map(|&topic| own(topic, Kind::Publisher)).collect::<Result<_, _>>()?;
        let received: Vec<Own> =
            received.iter().map(|&topic| own(topic, Kind::Subscriber)).collect::<Result<_, _>>()?;

        let graph = Arc::new(Graph::new(key.session.clone(), [published.clone(), received.clone()].concat()));
        let peers = watch(&session, options.domain_id, graph.clone())?;
        let token = session.liveliness().declare_token(key.token()).wait().map_err(failed("node"))?;
        let mut builder = Builder { session: &session, key: &key, next: 1 };
        let publishers =
            published.iter().map(|own| Ok((own.topic, builder.publisher(own)?))).collect::<Result<_, Ros2Error>>()?;
        let (counters, waveform_counters) = (Arc::<Counters>::default(), Arc::<Counters>::default());
        let subscribers = builder.subscribe_all(&received, receivers, &counters, &waveform_counters)?;
        let (mut store, mut servers, mut rosout) = (None, vec![], None);
        if let Some(Offered { parameters, managed }) = offered {
            let parameters = Arc::new(Store::new(parameters, &overrides));
            servers = builder.services(options, &parameters)?;
            if let Some(managed) = managed {
                servers.extend(builder.lifecycle(options, managed)?);
            }
            rosout = options
                .args
                .log_level()
                .map(|least| Ok::<_, Ros2Error>((builder.rosout(options)?, least)))
                .transpose()?;
            store = Some(parameters);
        }
        Ok(Self {
            publishers,
            _subscribers: subscribers,
            _servers: servers,
            rosout,
            store,
            _token: token,
            _peers: peers,
            graph,
            counters,
            waveform_counters,
            looks: AtomicU64::new(0),
            key,
            _session: session,
        })
    }

    /// Publishes a message, unless its topic is not one of this node. What a slow peer cannot take is lost for that peer.
    pub(super) fn publish(&self, message: Outgoing<'_>) -> Result<(), Ros2Error> {
        match message {
            Outgoing::OperatingPoint(message) => self.put(Topic::OperatingPoint, message),
            Outgoing::Prediction(message) => self.put(Topic::Prediction, message),
            Outgoing::SessionEvent(message) => self.put(Topic::SessionEvent, message),
            Outgoing::RigInfo(message) => self.put(Topic::RigInfo, message),
            Outgoing::Sensitivity(message) => self.put(Topic::Sensitivity, message),
            Outgoing::Diagnostics(message) => self.put(Topic::Diagnostics, message),
            Outgoing::Vibration(message) => self.put(Topic::Vibration, message),
            Outgoing::Waveform(message) => self.put(Topic::Waveform, message),
            Outgoing::Heard(message) => self.put(Topic::Heard, message),
            Outgoing::Temperature(message) => self.put(Topic::Temperature, message),
            Outgoing::Log(severity, text) => self.log(severity, text),
        }
    }

    fn put(&self, topic: Topic, message: &impl Serialize) -> Result<(), Ros2Error> {
        self.publishers.get(&topic).map_or(Ok(()), |out| out.put(topic.name(), message))
    }

    /// Writes a line to `/rosout`, unless the user wants only more severe ones.
    fn log(&self, severity: Severity, text: &str) -> Result<(), Ros2Error> {
        match &self.rosout {
            Some((out, least)) if severity >= *least => out.put(ROSOUT, &Line::new(&self.full_name(), severity, text)),
            _ => Ok(()),
        }
    }

    /// Number of subscribers of a topic that this node publishes.
    pub(super) fn readers(&self, topic: Topic) -> usize {
        self.graph.readers(topic)
    }

    /// Number of publishers of a topic that this node receives.
    pub(super) fn writers(&self, topic: Topic) -> usize {
        self.graph.writers(topic)
    }

    pub(super) fn counts(&self) -> Counts {
        self.counters.set_incompatible(self.graph.incompatible() as u64);
        self.counters.set_rivals(self.graph.rivals() as u64);
        self.counters.counts()
    }

    pub(super) fn waveform_counts(&self) -> Counts {
        self.waveform_counters.counts()
    }

    /// Grows with every call: Zenoh has no single thread whose beat would show that it receives.
    pub(super) fn beats(&self) -> u64 {
        self.looks.fetch_add(1, Ordering::Relaxed)
    }

    /// Takes over a parameter that was set elsewhere.
    pub(super) fn take_setting(&self, event: &SessionEvent) {
        if let Some(store) = &self.store
            && SessionEventKind::of(event) == Some(SessionEventKind::Parameter)
        {
            store.take_over(&event.name, event.value);
        }
    }

    pub(super) fn full_name(&self) -> String {
        format!("{}/{}", self.key.namespace.trim_end_matches('/'), self.key.name)
    }
}

impl Out {
    /// Publishes a message. `topic` names it in errors.
    pub(super) fn put(&self, topic: &'static str, message: &impl Serialize) -> Result<(), Ros2Error> {
        let refused = |reason: String| Ros2Error::Publish { topic, reason };
        let bytes = to_cdr(message).map_err(|error| refused(error.to_string()))?;
        let attachment = Attachment {
            sequence: self.sequence.fetch_add(1, Ordering::Relaxed) + 1,
            published_ns: clock::now_ns(),
            publisher: self.gid,
        };
        let attachment = attachment.to_bytes().to_vec();
        let put = match &self.publisher {
            Sender::Plain(publisher) => publisher.put(bytes).attachment(attachment).wait(),
            Sender::Latched(publisher) => publisher.put(bytes).attachment(attachment).wait(),
        };
        put.map_err(|error| refused(error.to_string()))
    }
}

/// Follows the liveliness tokens of a domain.
fn watch(session: &Session, domain: u16, graph: Arc<Graph>) -> Result<Subscriber<()>, Ros2Error> {
    let look = move |sample: Sample| match sample.kind() {
        SampleKind::Put => {
            if let Some(what) = graph.appeared(sample.key_expr().as_str()) {
                note!("{NOTE}{what}");
            }
        }
        SampleKind::Delete => graph.disappeared(sample.key_expr().as_str()),
    };
    let subscriber = session.liveliness().declare_subscriber(all_tokens(domain)).history(true).callback(look);
    subscriber.wait().map_err(failed("peers"))
}

fn endpoint(topic: Topic, name: String, chosen: Chosen) -> Endpoint {
    let latched = chosen.transient_local.unwrap_or(topic.is_latched());
    // Late subscribers get the latest message only.
    let depth = if topic.is_latched() { 1 } else { topic::DEPTH };
    Endpoint {
        name,
        dds_type: dds_type(topic.type_name()),
        hash: topic.type_hash(),
        latched,
        depth: chosen.depth.unwrap_or(depth),
        best_effort: chosen.best_effort.unwrap_or(false),
        keep_all: chosen.keep_all.unwrap_or(false),
    }
}

/// The endpoint of a message that is not among our topics, `package/Type`.
pub(super) fn message_endpoint(short: &str, name: String) -> Result<Endpoint, Ros2Error> {
    let found = service_types::message(short).map_err(|error| Ros2Error::Zenoh(format!("{name}: {error}")))?;
    let (type_name, hash) = found;
    Ok(Endpoint { name, dds_type: dds_type(&type_name), hash, depth: topic::DEPTH, ..Endpoint::default() })
}

/// A part of a name: letters, digits and underscores, not beginning with a digit.
fn check_name(part: &str) -> Result<(), Ros2Error> {
    let is_valid = part.starts_with(|first: char| first.is_ascii_alphabetic() || first == '_')
        && part.bytes().all(|byte| byte.is_ascii_alphanumeric() || byte == b'_');
    let reason = || "parts of names are letters, digits and underscores, and begin with no digit".to_owned();
    if is_valid { Ok(()) } else { Err(Ros2Error::Name { name: part.to_owned(), reason: reason() }) }
}

impl Builder<'_> {
    /// Declares the token of an endpoint; returns it with its text.
    pub(super) fn token(&mut self, kind: Kind, endpoint: &Endpoint) -> Result<(LivelinessToken, String), Ros2Error> {
        let text = self.key.endpoint_token(self.next, kind, endpoint);
        self.next += 1;
        let token = self.session.liveliness().declare_token(text.clone()).wait();
        Ok((token.map_err(failed(&endpoint.name))?, text))
    }

    /// The key expression of an endpoint.
    pub(super) fn key(&self, endpoint: &Endpoint) -> String {
        let Endpoint { name, dds_type, hash, .. } = endpoint;
        topic_key(self.key.domain, name, dds_type, hash)
    }

    fn publisher(&mut self, own: &Own) -> Result<Out, Ros2Error> {
        self.out(own.kind, &own.endpoint)
    }

    /// The publisher of log lines, one topic for all namespaces.
    fn rosout(&mut self, options: &Ros2Options) -> Result<Out, Ros2Error> {
        let name = options.args.topic(ROSOUT, &self.key.namespace, &self.key.name);
        let endpoint = Endpoint { latched: true, depth: KEPT_LINES, ..message_endpoint(LOG, name)? };
        self.out(Kind::Publisher, &endpoint)
    }

    /// Declares a publisher.
    pub(super) fn out(&mut self, kind: Kind, endpoint: &Endpoint) -> Result<Out, Ros2Error> {
        let failed = failed(&endpoint.name);
        let reliability = if endpoint.best_effort { Reliability::BestEffort } else { Reliability::Reliable };
        // A peer that does not read must delay nobody: what does not fit into the queue to it is dropped.
        let publisher = self.session.declare_publisher(self.key(endpoint));
        let publisher = publisher.congestion_control(CongestionControl::Drop).reliability(reliability);
        let publisher = if endpoint.latched {
            let kept = CacheConfig::default().max_samples(endpoint.depth as usize);
            Sender::Latched(publisher.cache(kept).publisher_detection().wait().map_err(&failed)?)
        } else {
            Sender::Plain(publisher.wait().map_err(&failed)?)
        };
        // The token last: who sees it may subscribe at once.
        let (token, text) = self.token(kind, endpoint)?;
        Ok(Out { _token: token, publisher, gid: gid(&text), sequence: AtomicI64::new(0) })
    }

    fn subscribe_all(
        &mut self,
        received: &[Own],
        receivers: Receivers,
        counters: &Arc<Counters>,
        waveform_counters: &Arc<Counters>,
    ) -> Result<Vec<In>, Ros2Error> {
        let Receivers { input, vibration, temperature, waveform, prediction } = receivers;
        let of = |topic| received.iter().find(|own| own.topic == topic);
        let mut all = vec![];
        if let (Some(own), Some(take)) = (of(Topic::OperatingPoint), input) {
            all.push(self.subscriber(own, |point| point.seq, take, counters.clone())?);
        }
        if let (Some(own), Some(take)) = (of(Topic::Vibration), vibration) {
            all.push(self.subscriber(own, |_| 0, take, Arc::default())?);
        }
        if let (Some(own), Some(take)) = (of(Topic::Temperature), temperature) {
            all.push(self.subscriber(own, |_| 0, take, Arc::default())?);
        }
        if let (Some(own), Some(take)) = (of(Topic::Waveform), waveform) {
            all.push(self.subscriber(own, |_| 0, take, waveform_counters.clone())?);
        }
        if let (Some(own), Some(take)) = (of(Topic::Prediction), prediction) {
            all.push(self.subscriber(own, |prediction| prediction.input_seq, take, counters.clone())?);
        }
        Ok(all)
    }

    /// Subscribes. `seq` is the sequence number in a message, 0 if it has none.
    fn subscriber<M: DeserializeOwned + Send + 'static>(
        &mut self,
        own: &Own,
        seq: fn(&M) -> u64,
        take: Take<M>,
        counters: Arc<Counters>,
    ) -> Result<In, Ros2Error> {
        // Zenoh calls from several threads, one for each peer.
        let receiver = Mutex::new((Gaps::new(), take));
        let hear = move |sample: Sample| {
            if sample.kind() != SampleKind::Put {
                return;
            }
            let attachment = sample.attachment().and_then(|bytes| Attachment::from_bytes(&bytes.to_bytes()));
            let message = from_cdr::<M>(&sample.payload().to_bytes());
            let (Some(attachment), Ok(message)) = (attachment, message) else {
                counters.malformed();
                return;
            };
            let mut receiver = receiver.lock().unwrap_or_else(PoisonError::into_inner);
            let (gaps, take) = &mut *receiver;
            counters.received(gaps.note(attachment.publisher, seq(&message)));
            take(Received::now(Bus::Zenoh, message));
        };
        let Endpoint { name, latched, depth, .. } = &own.endpoint;
        let subscriber = self.session.declare_subscriber(self.key(&own.endpoint)).callback(hear);
        let subscriber = if *latched {
            let history = HistoryConfig::default().detect_late_publishers().max_samples(*depth as usize);
            Receiver::Latched { _subscriber: subscriber.history(history).wait().map_err(failed(name))? }
        } else {
            Receiver::Plain { _subscriber: subscriber.wait().map_err(failed(name))? }
        };
        Ok(In { _token: self.token(own.kind, &own.endpoint)?.0, _subscriber: subscriber })
    }
}

impl Receivers {
    /// The topics that are taken.
    fn topics(&self) -> Vec<Topic> {
        let Self { input, vibration, temperature, waveform, prediction } = self;
        let all = [
            (Topic::OperatingPoint, input.is_some()),
            (Topic::Vibration, vibration.is_some()),
            (Topic::Temperature, temperature.is_some()),
            (Topic::Waveform, waveform.is_some()),
            (Topic::Prediction, prediction.is_some()),
        ];
        all.into_iter().filter(|(_, taken)| *taken).map(|(topic, _)| topic).collect()
    }
}

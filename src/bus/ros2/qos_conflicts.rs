//! Finds peers that DDS does not connect because their quality of service is incompatible, and peers that publish
//! predictions on the topic of this node, or have its name. DDS reports none of these.

use std::collections::{HashMap, HashSet};
use std::time::Duration;

use ros2_client::{Context, Gid, NodeEvent};
use rustdds::qos::{HasQoSPolicy, QosPolicies};
use rustdds::{DomainParticipant, GUID, RTPSEntity, Topic};

use super::super::received::Counters;
use super::NOTE;

/// Interval between checks of the discovered peers.
const LOOK_EVERY: Duration = Duration::from_secs(5);
/// Number of conflicts that are described; all are counted.
const MAX_DESCRIBED: usize = 32;

/// A topic of the node: its name, its DDS name, and the quality of service that the node offers or requests.
#[derive(Clone)]
struct Endpoint {
    name: String,
    dds_name: String,
    qos: QosPolicies,
}

impl Endpoint {
    fn new(topic: &Topic, name: &str) -> Self {
        use rustdds::TopicDescription;
        Self { name: name.to_owned(), dds_name: topic.name(), qos: topic.qos() }
    }
}

/// The topics of a node, compared with the quality of service of peers.
#[derive(Clone)]
pub(super) struct QosConflicts {
    participant: DomainParticipant,
    own: Gid,
    published: Vec<Endpoint>,
    subscribed: Vec<Endpoint>,
    /// The topic of predictions: its name and its DDS name.
    predictions: Option<(String, String)>,
}

impl QosConflicts {
    pub(super) fn new(context: &Context) -> Self {
        Self {
            participant: context.domain_participant(),
            own: context.participant_entities_info().gid(),
            published: Vec::new(),
            subscribed: Vec::new(),
            predictions: None,
        }
    }

    /// Adds a topic that the node publishes.
    pub(super) fn published(&mut self, topic: &Topic, name: &str) {
        self.published.push(Endpoint::new(topic, name));
    }

    /// Names the topic that the node publishes predictions on.
    pub(super) fn predictions(&mut self, topic: &Topic, name: &str) {
        use rustdds::TopicDescription;
        self.predictions = Some((name.to_owned(), topic.name()));
    }

    /// Adds a topic that the node subscribes to.
    pub(super) fn subscribed(&mut self, topic: &Topic, name: &str) {
        self.subscribed.push(Endpoint::new(topic, name));
    }

    /// Checks regularly which peers cannot be connected, and which publish predictions too. Counts them and reports each
    /// once.
    pub(super) async fn watch(self, counters: &Counters) {
        let mut known = HashMap::new();
        let mut look = tokio::time::interval(LOOK_EVERY);
        loop {
            look.tick().await;
            // With thousands of peers this takes milliseconds, during which inputs would have to wait.
            let looking = self.clone();
            let found = tokio::task::spawn_blocking(move || (looking.find(), looking.rivals())).await;
            let Ok((mut found, rivals)) = found else { continue };
            counters.set_incompatible(found.len() as u64);
            counters.set_rivals(rivals.len() as u64);
            found.extend(rivals);
            for (_, what) in found.iter().filter(|(peer, _)| !known.contains_key(*peer)).take(MAX_DESCRIBED) {
                note!("{NOTE}{what}");
            }
            known = found;
        }
    }

    /// Reports the nodes of another participant that have the `name` of this one. `known` are those reported before.
    pub(super) fn namesakes(&self, event: &NodeEvent, name: &str, known: &mut HashSet<Gid>) {
        let NodeEvent::ParticipantEntities(info) = event else { return };
        let is_namesake = info.nodes().iter().any(|node| node.fully_qualified_name() == name);
        if is_namesake && info.gid() != self.own && known.len() < MAX_DESCRIBED && known.insert(info.gid()) {
            note!(
                "{NOTE}another node is named {name} too, tools cannot tell them apart; -r __node:=NAME or \
                 -r __ns:=/NAME gives this one another name"
            );
        }
    }

    /// The publishers of other participants on the topic of predictions, and what to do about them.
    fn rivals(&self) -> HashMap<GUID, String> {
        let Some((name, dds_name)) = &self.predictions else { return HashMap::new() };
        let own = self.participant.guid_prefix();
        let writers = self.participant.discovered_writers().into_iter();
        let rivals = writers.map(|writer| writer.publication_topic_data);
        let rivals = rivals.filter(|peer| peer.topic_name == *dds_name && peer.key.prefix != own);
        let what = format!(
            "another program publishes on {name} too, whose subscribers get the predictions of all; a namespace \
             (-r __ns:=/NAME) keeps nodes apart"
        );
        rivals.map(|peer| (peer.key, what.clone())).collect()
    }

    /// The peers that cannot be connected, and why.
    fn find(&self) -> HashMap<GUID, String> {
        let mut found = HashMap::new();
        for writer in self.participant.discovered_writers() {
            let peer = &writer.publication_topic_data;
            let Some(ours) = self.subscribed.iter().find(|ours| ours.dds_name == peer.topic_name) else { continue };
            if let Some(policy) = peer.qos().compliance_failure_wrt(&ours.qos) {
                let what =
                    format!("a publisher of {} is not connected: its {policy:?} policy is incompatible", ours.name);
                found.insert(peer.key, what);
            }
        }
        for reader in self.participant.discovered_readers() {
            let peer = &reader.subscription_topic_data;
            let Some(ours) = self.published.iter().find(|ours| ours.dds_name == peer.topic_name) else { continue };
            if let Some(policy) = ours.qos.compliance_failure_wrt(&peer.qos()) {
                let what = format!(
                    "a subscriber of {} is not connected: it requests a {policy:?} policy that is not offered",
                    ours.name
                );
                found.insert(reader.reader_proxy.remote_reader_guid, what);
            }
        }
        found
    }
}

//! Finds peers that DDS does not connect because their quality of service is incompatible. DDS reports this to neither
//! program.

use std::collections::HashMap;
use std::time::Duration;

use rustdds::qos::{HasQoSPolicy, QosPolicies};
use rustdds::{DomainParticipant, GUID, Topic};

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
    published: Vec<Endpoint>,
    subscribed: Vec<Endpoint>,
}

impl QosConflicts {
    pub(super) fn new(participant: DomainParticipant) -> Self {
        Self { participant, published: Vec::new(), subscribed: Vec::new() }
    }

    /// Adds a topic that the node publishes.
    pub(super) fn published(&mut self, topic: &Topic, name: &str) {
        self.published.push(Endpoint::new(topic, name));
    }

    /// Adds a topic that the node subscribes to.
    pub(super) fn subscribed(&mut self, topic: &Topic, name: &str) {
        self.subscribed.push(Endpoint::new(topic, name));
    }

    /// Checks regularly which peers cannot be connected. Counts them and reports each once.
    pub(super) async fn watch(self, counters: &Counters) {
        let mut known = HashMap::new();
        let mut look = tokio::time::interval(LOOK_EVERY);
        loop {
            look.tick().await;
            // With thousands of peers this takes milliseconds, during which inputs would have to wait.
            let looking = self.clone();
            let Ok(found) = tokio::task::spawn_blocking(move || looking.find()).await else { continue };
            counters.set_incompatible(found.len() as u64);
            for (_, what) in found.iter().filter(|(peer, _)| !known.contains_key(*peer)).take(MAX_DESCRIBED) {
                note!("{NOTE}{what}");
            }
            known = found;
        }
    }

    /// The peers that cannot be connected, and why.
    fn find(&self) -> HashMap<GUID, String> {
        let mut found = HashMap::new();
        for writer in self.participant.discovered_writers() {
            let peer = &writer.publication_topic_data;
            let Some(ours) = self.subscribed.iter().find(|ours| ours.dds_name == peer.topic_name) else { continue };
            if let Some(policy) = peer.qos().compliance_failure_wrt(&ours.qos) {
                let what = format!("a publisher of {} is not heard: its {policy:?} policy is incompatible", ours.name);
                found.insert(peer.key, what);
            }
        }
        for reader in self.participant.discovered_readers() {
            let peer = &reader.subscription_topic_data;
            let Some(ours) = self.published.iter().find(|ours| ours.dds_name == peer.topic_name) else { continue };
            if let Some(policy) = ours.qos.compliance_failure_wrt(&peer.qos()) {
                let what = format!(
                    "a subscriber of {} gets nothing: it requests a {policy:?} policy that is not offered",
                    ours.name
                );
                found.insert(reader.reader_proxy.remote_reader_guid, what);
            }
        }
        found
    }
}

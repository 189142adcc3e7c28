//! Hearing every publisher of a topic: the reliable ones and, unlike a reliable subscription by itself, the best-effort ones.

use std::collections::HashMap;

use ros2_client::{Gid, MessageInfo, Node, ReadError, Subscription};
use rustdds::{DomainParticipant, QosPolicies};
use serde::de::{Deserialize, DeserializeOwned, Deserializer};

/// At most this many publishers are remembered; beyond that all are looked up again.
const MAX_PUBLISHERS: usize = 256;

/// A reliable and a best-effort subscription to one topic.
///
/// RustDDS keeps the samples of a topic in one cache: the best-effort subscription is handed those of reliable publishers too,
/// at once and out of order where some were lost. They are dropped here, for the reliable one delivers them.
pub(super) struct Ears<M> {
    reliable: Subscription<M>,
    best_effort: Subscription<Tried<M>>,
    /// What the reliable subscription asks of a publisher.
    requested: QosPolicies,
    participant: DomainParticipant,
}

/// Which publishers the reliable subscription refuses, as far as they were looked up.
pub(super) type Refused = HashMap<Gid, bool>;

impl<M: DeserializeOwned + 'static> Ears<M> {
    pub(super) fn new(
        (reliable, requested): (Subscription<M>, QosPolicies),
        best_effort: Subscription<Tried<M>>,
        participant: DomainParticipant,
    ) -> Self {
        Self { reliable, best_effort, requested, participant }
    }

    /// The next message, each once: in order and without gaps from a reliable publisher, as it comes from any other.
    ///
    /// # Errors
    /// A sample that is no message, or a failure of DDS.
    pub(super) async fn next(&self, refused: &mut Refused) -> Result<(M, MessageInfo), ReadError> {
        loop {
            tokio::select! {
                biased;
                taken = self.reliable.async_take() => return taken,
                taken = self.best_effort.async_take() => {
                    let (Tried(message), info) = taken?;
                    if self.is_refused(info.publisher_gid(), refused) {
                        return message.map(|message| (message, info)).ok_or(ReadError::Malformed);
                    }
                }
            }
        }
    }

    /// How many publishers are known. The best-effort subscription refuses none of them.
    pub(super) fn publishers(&self, node: &Node) -> usize {
        self.best_effort.get_publisher_count(node)
    }

    fn is_refused(&self, publisher: Gid, refused: &mut Refused) -> bool {
        if let Some(&refused) = refused.get(&publisher) {
            return refused;
        }
        // Samples are only taken from publishers that were discovered; one that is gone by now is not remembered.
        let writers = self.participant.discovered_writers();
        let Some(writer) = writers.iter().find(|writer| Gid::from(writer.publication_topic_data.key) == publisher)
        else {
            return false;
        };
        let is_refused = writer.publication_topic_data.qos().compliance_failure_wrt(&self.requested).is_some();
        if refused.len() >= MAX_PUBLISHERS {
            refused.clear();
        }
        refused.insert(publisher, is_refused);
        is_refused
    }
}

/// A message, or nothing where the sample is none: an error would not say whose sample it is.
pub(super) struct Tried<M>(Option<M>);

impl<'de, M: Deserialize<'de>> Deserialize<'de> for Tried<M> {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        Ok(Self(M::deserialize(deserializer).ok()))
    }
}

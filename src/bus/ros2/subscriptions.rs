//! Receives from every publisher of a topic, reliable or best-effort. A reliable subscription alone would not match
//! best-effort publishers.

use std::collections::HashMap;

use ros2_client::{Gid, MessageInfo, Node, ReadError, Subscription};
use rustdds::{DomainParticipant, QosPolicies};
use serde::de::{Deserialize, DeserializeOwned, Deserializer};

/// Number of publishers that are remembered; beyond it all are looked up again.
const MAX_PUBLISHERS: usize = 256;

/// A reliable and a best-effort subscription to one topic.
///
/// RustDDS keeps the samples of a topic in one cache. The best-effort subscription therefore gets those of reliable
/// publishers too, immediately and out of order after a loss. They are dropped here, because the reliable subscription
/// delivers them.
pub(super) struct Subscriptions<M> {
    /// At least one of the two; the user may have chosen a single one.
    reliable: Option<Subscription<M>>,
    best_effort: Option<Subscription<Tried<M>>>,
    /// The quality of service that the reliable subscription requests.
    requested: QosPolicies,
    participant: DomainParticipant,
}

/// Publishers looked up so far, and whether the reliable subscription rejects them.
pub(super) type Refused = HashMap<Gid, bool>;

impl<M: DeserializeOwned + 'static> Subscriptions<M> {
    pub(super) fn new(
        reliable: Option<Subscription<M>>,
        requested: QosPolicies,
        best_effort: Option<Subscription<Tried<M>>>,
        participant: DomainParticipant,
    ) -> Self {
        Self { reliable, best_effort, requested, participant }
    }

    /// The next message; none is returned twice. Messages of a reliable publisher come in order and without gaps,
    /// others as they arrive.
    ///
    /// # Errors
    /// A sample that cannot be decoded, or an error of DDS.
    pub(super) async fn next(&self, refused: &mut Refused) -> Result<(M, MessageInfo), ReadError> {
        loop {
            tokio::select! {
                biased;
                taken = take(self.reliable.as_ref()) => return taken,
                taken = take(self.best_effort.as_ref()) => {
                    let (Tried(message), info) = taken?;
                    if self.is_refused(info.publisher_gid(), refused) {
                        return message.map(|message| (message, info)).ok_or(ReadError::Malformed);
                    }
                }
            }
        }
    }

    /// Number of known publishers. The best-effort subscription matches all of them.
    pub(super) fn publishers(&self, node: &Node) -> usize {
        match (&self.best_effort, &self.reliable) {
            (Some(subscription), _) => subscription.get_publisher_count(node),
            (None, Some(subscription)) => subscription.get_publisher_count(node),
            (None, None) => 0,
        }
    }

    /// Whether the reliable subscription does not deliver the messages of `publisher`.
    fn is_refused(&self, publisher: Gid, refused: &mut Refused) -> bool {
        if self.reliable.is_none() {
            return true;
        }
        if let Some(&refused) = refused.get(&publisher) {
            return refused;
        }
        // Samples only come from discovered publishers. A publisher that has disappeared since is not remembered.
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

/// The next message of a subscription; never, if there is none.
async fn take<M: DeserializeOwned + 'static>(
    subscription: Option<&Subscription<M>>,
) -> Result<(M, MessageInfo), ReadError> {
    match subscription {
        Some(subscription) => subscription.async_take().await,
        None => std::future::pending().await,
    }
}

/// A message, or nothing if the sample cannot be decoded. An error would not tell which publisher the sample came from.
pub(super) struct Tried<M>(Option<M>);

impl<'de, M: Deserialize<'de>> Deserialize<'de> for Tried<M> {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        Ok(Self(M::deserialize(deserializer).ok()))
    }
}

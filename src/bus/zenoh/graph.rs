//! The endpoints of peers on our topics, according to their liveliness tokens.

use std::collections::HashMap;
use std::sync::{Mutex, MutexGuard, PoisonError};

use super::names::{Endpoint, Kind, Peer};
use crate::msgs::schema::Topic;

/// Number of peers that are remembered; further ones are not counted.
const MAX_PEERS: usize = 4096;
/// Number of conflicts that are described; all are counted.
const MAX_DESCRIBED: usize = 32;

/// One of our endpoints.
#[derive(Clone, Debug)]
pub(super) struct Own {
    pub topic: Topic,
    pub kind: Kind,
    pub endpoint: Endpoint,
}

/// What an endpoint of a peer is to us.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Relation {
    Reader(Topic),
    Writer(Topic),
    /// Another type, or another definition of the type.
    Incompatible,
    /// Publishes predictions on our topic.
    Rival,
}

/// The graph as far as it concerns us.
pub(super) struct Graph {
    session: String,
    own: Vec<Own>,
    known: Mutex<Known>,
}

#[derive(Default)]
struct Known {
    peers: HashMap<String, Relation>,
    described: usize,
}

impl Graph {
    /// The graph around these endpoints of ours, which belong to `session`.
    pub(super) fn new(session: String, own: Vec<Own>) -> Self {
        Self { session, own, known: Mutex::default() }
    }

    fn known(&self) -> MutexGuard<'_, Known> {
        self.known.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Takes a token that was declared. Returns what to tell about it.
    pub(super) fn appeared(&self, token: &str) -> Option<String> {
        let peer = Peer::of_token(token)?;
        if peer.session == self.session {
            return None;
        }
        let (relation, what) = self.relation(&peer)?;
        let mut known = self.known();
        if known.peers.len() >= MAX_PEERS || known.peers.insert(token.to_owned(), relation).is_some() {
            return None;
        }
        known.described += usize::from(what.is_some());
        what.filter(|_| known.described <= MAX_DESCRIBED)
    }

    /// Takes a token that has gone.
    pub(super) fn disappeared(&self, token: &str) {
        self.known().peers.remove(token);
    }

    /// What a peer is to us, and what to tell about it.
    fn relation(&self, peer: &Peer<'_>) -> Option<(Relation, Option<String>)> {
        let mut of_topic = self.own.iter().filter(|own| own.endpoint.name == peer.topic);
        let name = &peer.topic;
        let Some(own) = of_topic.clone().find(|own| own.kind != peer.kind) else {
            let rival = of_topic.any(|own| own.topic == Topic::Prediction && own.kind == Kind::Publisher);
            let what = || {
                format!(
                    "another program publishes on {name} too, whose subscribers get the predictions of all; a namespace \
                     (-r __ns:=/NAME) keeps nodes apart"
                )
            };
            return rival.then(|| (Relation::Rival, Some(what())));
        };
        if (peer.dds_type, peer.hash) != (own.endpoint.dds_type.as_str(), own.endpoint.hash.as_str()) {
            let whose = match peer.kind {
                Kind::Publisher => "publisher",
                Kind::Subscriber => "subscriber",
                Kind::Server => return None,
            };
            let Endpoint { dds_type, hash, .. } = &own.endpoint;
            let what = format!(
                "a {whose} of {name} is not connected: its type is {} with hash {}, ours {dds_type} with hash {hash}",
                peer.dds_type, peer.hash
            );
            return Some((Relation::Incompatible, Some(what)));
        }
        Some(match peer.kind {
            Kind::Publisher => (Relation::Writer(own.topic), None),
            Kind::Subscriber => (Relation::Reader(own.topic), None),
            Kind::Server => return None,
        })
    }

    fn count(&self, relation: Relation) -> usize {
        self.known().peers.values().filter(|known| **known == relation).count()
    }

    pub(super) fn readers(&self, topic: Topic) -> usize {
        self.count(Relation::Reader(topic))
    }

    pub(super) fn writers(&self, topic: Topic) -> usize {
        self.count(Relation::Writer(topic))
    }

    pub(super) fn incompatible(&self) -> usize {
        self.count(Relation::Incompatible)
    }

    pub(super) fn rivals(&self) -> usize {
        self.count(Relation::Rival)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::bus::zenoh::names::{NodeKey, dds_type};

    fn endpoint(topic: Topic) -> Endpoint {
        let (name, hash) = (topic.name().to_owned(), topic.type_hash());
        Endpoint { name, dds_type: dds_type(topic.type_name()), hash, depth: 64, ..Endpoint::default() }
    }

    #[test]
    fn peers_are_counted_and_conflicts_told_once() {
        let own = [(Topic::Prediction, Kind::Publisher), (Topic::OperatingPoint, Kind::Subscriber)];
        let own = own.map(|(topic, kind)| Own { topic, kind, endpoint: endpoint(topic) });
        let graph = Graph::new("aa".to_owned(), own.into());
        let node = |session: &str| NodeKey {
            domain: 3,
            session: session.to_owned(),
            number: 0,
            namespace: "/".to_owned(),
            name: "n".to_owned(),
        };
        let reader = node("bb").endpoint_token(1, Kind::Subscriber, &endpoint(Topic::Prediction));
        let writer = node("bb").endpoint_token(2, Kind::Publisher, &endpoint(Topic::OperatingPoint));
        let rival = node("bb").endpoint_token(3, Kind::Publisher, &endpoint(Topic::Prediction));
        let other = Endpoint { hash: "RIHS01_00".to_owned(), ..endpoint(Topic::OperatingPoint) };
        let other = node("bb").endpoint_token(4, Kind::Publisher, &other);
        let beside = node("bb").endpoint_token(5, Kind::Publisher, &endpoint(Topic::Vibration));
        let ours = node("aa").endpoint_token(1, Kind::Subscriber, &endpoint(Topic::Prediction));
        for token in [&reader, &reader, &writer, &beside, &ours] {
            assert_eq!(graph.appeared(token), None, "{token}");
        }
        let told = graph.appeared(&other).expect("told");
        assert!(told.contains("/rig/operating_point is not connected") && told.contains("RIHS01_00"), "{told}");
        assert_eq!(graph.appeared(&other), None, "told before");
        assert!(graph.appeared(&rival).is_some_and(|told| told.contains("publishes on /squealcast/prediction too")));
        assert_eq!((graph.readers(Topic::Prediction), graph.writers(Topic::OperatingPoint)), (1, 1));
        assert_eq!((graph.incompatible(), graph.rivals()), (1, 1));
        for token in [&reader, &writer, &rival, &other] {
            graph.disappeared(token);
        }
        assert_eq!((graph.readers(Topic::Prediction), graph.incompatible(), graph.rivals()), (0, 0, 0));
        for k in 0..2 * MAX_PEERS {
            graph.appeared(&node("cc").endpoint_token(k as u32, Kind::Subscriber, &endpoint(Topic::Prediction)));
        }
        assert_eq!(graph.readers(Topic::Prediction), MAX_PEERS);
    }
}

//! Names and attachments on Zenoh, as the design document of rmw_zenoh defines them.

use xxhash_rust::xxh3::xxh3_128;

/// First part of every liveliness token.
const TOKENS: &str = "@ros2_lv";
/// Bytes of an attachment: sequence number, time, length of the identity, identity.
const ATTACHMENT_BYTES: usize = 33;

/// Identity of a publisher.
pub(super) type Gid = [u8; 16];

/// `package::msg::dds_::Type_` of `package/msg/Type`.
pub(super) fn dds_type(type_name: &str) -> String {
    let (package, name) = type_name.rsplit_once('/').unwrap_or(("", type_name));
    format!("{}::dds_::{name}_", package.replace('/', "::"))
}

/// The key expression of a topic with this absolute name.
pub(super) fn topic_key(domain: u16, name: &str, dds_type: &str, hash: &str) -> String {
    format!("{domain}/{}/{dds_type}/{hash}", name.trim_matches('/'))
}

/// The key expression of all liveliness tokens of a domain.
pub(super) fn all_tokens(domain: u16) -> String {
    format!("{TOKENS}/{domain}/**")
}

/// Kind of an endpoint.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Kind {
    Publisher,
    Subscriber,
    /// Of a service.
    Server,
}

impl Kind {
    fn code(self) -> &'static str {
        match self {
            Self::Publisher => "MP",
            Self::Subscriber => "MS",
            Self::Server => "SS",
        }
    }
}

/// A node on Zenoh, with the identity of its session.
#[derive(Clone, Debug)]
pub(super) struct NodeKey {
    pub domain: u16,
    pub session: String,
    /// Number of the node in the session.
    pub number: u32,
    pub namespace: String,
    pub name: String,
}

impl NodeKey {
    /// Its liveliness token.
    pub(super) fn token(&self) -> String {
        self.token_of(self.number, "NN")
    }

    /// The liveliness token of its endpoint with this number.
    pub(super) fn endpoint_token(&self, number: u32, kind: Kind, endpoint: &Endpoint) -> String {
        let Endpoint { name, dds_type, hash, latched, depth, best_effort, keep_all } = endpoint;
        // Numbers of the policies in rmw; those of its default are left out.
        let reliability = if *best_effort { "2" } else { "" };
        let durability = if *latched { "1" } else { "" };
        let history = if *keep_all { "2" } else { "" };
        let qos = format!("{reliability}:{durability}:{history},{depth}:,:,:,,");
        format!("{}/{}/{dds_type}/{hash}/{qos}", self.token_of(number, kind.code()), mangled(name))
    }

    fn token_of(&self, number: u32, kind: &str) -> String {
        let Self { domain, session, number: node, namespace, name } = self;
        format!("{TOKENS}/{domain}/{session}/{node}/{number}/{kind}/%/{}/{}", mangled(namespace), mangled(name))
    }
}

/// A topic, or service, as one endpoint of a node offers or requests it.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(super) struct Endpoint {
    /// Absolute, after remapping.
    pub name: String,
    pub dds_type: String,
    pub hash: String,
    /// Whether late subscribers get the last messages: transient local.
    pub latched: bool,
    pub depth: i32,
    pub best_effort: bool,
    pub keep_all: bool,
}

/// A publisher or subscriber of a peer, according to its token.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Peer<'a> {
    pub session: &'a str,
    pub kind: Kind,
    /// Absolute name of the topic.
    pub topic: String,
    pub dds_type: &'a str,
    pub hash: &'a str,
}

impl<'a> Peer<'a> {
    /// `None` if the token is of something else, or of another design.
    pub(super) fn of_token(token: &'a str) -> Option<Self> {
        let parts: Vec<&str> = token.split('/').collect();
        let [TOKENS, _, session, _, _, kind, _, _, _, topic, dds_type, hash, ..] = parts[..] else { return None };
        let kind = [Kind::Publisher, Kind::Subscriber].into_iter().find(|known| known.code() == kind)?;
        Some(Self { session, kind, topic: topic.replace('%', "/"), dds_type, hash })
    }
}

fn mangled(name: &str) -> String {
    if name.is_empty() { "%".to_owned() } else { name.replace('/', "%") }
}

/// The identity of the endpoint with this token.
pub(super) fn gid(token: &str) -> Gid {
    xxh3_128(token.as_bytes()).to_le_bytes()
}

/// What a message carries beside its content.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Attachment {
    pub sequence: i64,
    /// When it was published, ns since the epoch.
    pub published_ns: i64,
    pub publisher: Gid,
}

impl Attachment {
    pub(super) fn to_bytes(self) -> [u8; ATTACHMENT_BYTES] {
        let mut bytes = [0; ATTACHMENT_BYTES];
        bytes[..8].copy_from_slice(&self.sequence.to_le_bytes());
        bytes[8..16].copy_from_slice(&self.published_ns.to_le_bytes());
        bytes[16] = self.publisher.len() as u8;
        bytes[17..].copy_from_slice(&self.publisher);
        bytes
    }

    /// `None` if the bytes are no attachment of rmw_zenoh.
    pub(super) fn from_bytes(bytes: &[u8]) -> Option<Self> {
        let (sequence, rest) = bytes.split_first_chunk::<8>()?;
        let (published_ns, rest) = rest.split_first_chunk::<8>()?;
        let [16, publisher @ ..] = rest else { return None };
        Some(Self {
            sequence: i64::from_le_bytes(*sequence),
            published_ns: i64::from_le_bytes(*published_ns),
            publisher: publisher.try_into().ok()?,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const HASH: &str = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18";

    /// The examples of the design document of rmw_zenoh.
    #[test]
    fn names_are_those_of_the_design_document() {
        assert_eq!(dds_type("std_msgs/msg/String"), "std_msgs::msg::dds_::String_");
        let key = |name| topic_key(0, name, "std_msgs::msg::dds_::String_", HASH);
        assert_eq!(key("/chatter"), format!("0/chatter/std_msgs::msg::dds_::String_/{HASH}"));
        assert_eq!(key("/robot1/chatter"), format!("0/robot1/chatter/std_msgs::msg::dds_::String_/{HASH}"));
        let session = "8b20917502ee955ac4476e0266340d5c".to_owned();
        let node = NodeKey { domain: 0, session, number: 0, namespace: String::new(), name: "talker".to_owned() };
        assert_eq!(node.token(), "@ros2_lv/0/8b20917502ee955ac4476e0266340d5c/0/0/NN/%/%/talker");
        let mut endpoint = Endpoint {
            name: "/chatter".to_owned(),
            dds_type: "std_msgs::msg::dds_::String_".to_owned(),
            hash: HASH.to_owned(),
            depth: 7,
            ..Endpoint::default()
        };
        let token = node.endpoint_token(10, Kind::Publisher, &endpoint);
        assert_eq!(
            token,
            format!(
                "@ros2_lv/0/8b20917502ee955ac4476e0266340d5c/0/10/MP/%/%/talker/%chatter/\
                 std_msgs::msg::dds_::String_/{HASH}/::,7:,:,:,,"
            )
        );
        let peer = Peer::of_token(&token).expect("a publisher");
        assert_eq!((peer.kind, peer.topic.as_str(), peer.hash), (Kind::Publisher, "/chatter", HASH));
        assert_eq!(peer.session, node.session);
        endpoint.latched = true;
        assert!(node.endpoint_token(10, Kind::Subscriber, &endpoint).ends_with("/:1:,7:,:,:,,"));
        let endpoint = Endpoint { best_effort: true, keep_all: true, ..endpoint };
        assert!(node.endpoint_token(10, Kind::Subscriber, &endpoint).ends_with("/2:1:2,7:,:,:,,"));
        let left = NodeKey { namespace: "/left".to_owned(), ..node };
        assert!(left.token().ends_with("/NN/%/%left/talker"), "{}", left.token());
    }

    #[test]
    fn other_tokens_are_no_endpoints() {
        for token in
            ["", "@ros2_lv/0/a/0/0/NN/%/%/talker", "@ros2_lv/0/a/0/1/SS/%/%/n/%s/T/H/q", "x/0/a/0/1/MP/%/%/n/%s/T/H/q"]
        {
            assert_eq!(Peer::of_token(token), None, "{token}");
        }
    }

    #[test]
    fn attachments_are_33_bytes() {
        let attachment = Attachment { sequence: 7, published_ns: 0x0102_0304_0506_0708, publisher: [0xab; 16] };
        let bytes = attachment.to_bytes();
        let expected = [&[7, 0, 0, 0, 0, 0, 0, 0, 8, 7, 6, 5, 4, 3, 2, 1, 16][..], &[0xab; 16]].concat();
        assert_eq!(bytes[..], expected[..]);
        assert_eq!(Attachment::from_bytes(&bytes), Some(attachment));
        for bad in [&bytes[..32], &[&bytes[..], &[0]].concat(), &[0; 33], &[]] {
            assert_eq!(Attachment::from_bytes(bad), None);
        }
    }
}

//! Decides which topics of a recording are read as which of the node's topics. The topic's name decides, because
//! several topics may have the same type.
//!
//! In order of precedence: a topic chosen by the user, assigned by its type; the node's own name; that name in one
//! namespace (`/cell2/squealcast/prediction`). A topic of the right type under any other name is not read; the reason
//! explains how to choose it.

use std::collections::{BTreeMap, BTreeSet};

use super::record_walker::Channel;
use crate::msgs::schema::{MESSAGE_ENCODING, SCHEMA_ENCODING, Topic, field_difference};

/// Why a topic is not read.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum Unread {
    #[error("{topic} is not read: its type is {type_name}, expected {expected}")]
    Type { topic: String, type_name: String, expected: &'static str },
    #[error("{topic} is not read: its messages are encoded as {encoding:?}, expected {MESSAGE_ENCODING:?}")]
    Encoding { topic: String, encoding: String },
    #[error("{topic} is not read: {type_name} has other fields in this version of squealcast: {difference}")]
    Fields { topic: String, type_name: &'static str, difference: String },
    #[error("{} are not read: each may be {wanted}; choose one with --read-topic TOPIC", .topics.join(", "))]
    Several { wanted: &'static str, topics: Vec<String> },
    #[error(
        "{} not read: the recording holds no {wanted}; --read-topic TOPIC reads another topic of its type in its place",
        names_are(.topics)
    )]
    OtherName { wanted: &'static str, topics: Vec<String> },
}

fn names_are(topics: &[String]) -> String {
    format!("{} {}", topics.join(", "), if topics.len() == 1 { "is" } else { "are" })
}

/// Why the user's choice of topics is invalid.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum ChoiceError {
    #[error("holds no topic {topic} of a type squealcast reads; it holds {}", if .known.is_empty() { "none".to_owned() } else { .known.join(", ") })]
    NotThere { topic: String, known: Vec<String> },
    #[error("{first} and {second} are both of the type of {topic}: choose one")]
    Twice { topic: &'static str, first: String, second: String },
}

/// The topics of a recording that are read, and those that are not.
#[derive(Clone, Debug, Default)]
pub struct RecordedTopics {
    names: BTreeMap<Topic, String>,
    unread: Vec<Unread>,
}

impl RecordedTopics {
    /// Decides for all `channels` of a recording. Topics in `chosen` are read instead of the node's own topics of the
    /// same types.
    ///
    /// # Errors
    /// [`ChoiceError`].
    pub fn decide(channels: &[Channel], chosen: &[String]) -> Result<Self, ChoiceError> {
        let mut decided = Self::default();
        let mut known = BTreeSet::new();
        for topic in Topic::ALL {
            // A topic that has the name of another of the node's topics, with the wrong type, is not a candidate.
            let candidate = |name: &str| Topic::ALL.into_iter().all(|own| own == topic || own.name() != name);
            let of_type: BTreeSet<&str> = channels
                .iter()
                .filter(|channel| type_name(channel) == topic.type_name() && candidate(&channel.topic))
                .map(|channel| &*channel.topic)
                .collect();
            known.extend(of_type.iter().map(|&name| name.to_owned()));
            match choose(topic, &of_type, chosen)? {
                Ok(Some(name)) => drop(decided.names.insert(topic, name.to_owned())),
                Ok(None) => {}
                Err(unread) => decided.unread.push(unread),
            }
        }
        if let Some(topic) = chosen.iter().find(|topic| !known.contains(*topic)) {
            return Err(ChoiceError::NotThere { topic: topic.clone(), known: known.into_iter().collect() });
        }
        for channel in channels {
            if let Err(unread) = decided.read_as(channel)
                && !decided.unread.contains(&unread)
            {
                decided.unread.push(unread);
            }
        }
        Ok(decided)
    }

    /// Which of the node's topics a channel is read as; `None` for other topics.
    ///
    /// # Errors
    /// The channel has the name of one of the node's topics but cannot be read, or has its type only.
    pub fn read_as(&self, channel: &Channel) -> Result<Option<Topic>, Unread> {
        let topic = || channel.topic.clone();
        let Some((&read_as, _)) = self.names.iter().find(|(_, name)| **name == channel.topic) else {
            // One of the node's names with a type of another program.
            return match Topic::ALL.into_iter().find(|own| own.name() == channel.topic) {
                Some(own) if !self.names.contains_key(&own) => Err(Unread::Type {
                    topic: topic(),
                    type_name: type_name(channel).to_owned(),
                    expected: own.type_name(),
                }),
                _ => Ok(None),
            };
        };
        if type_name(channel) != read_as.type_name() {
            let type_name = type_name(channel).to_owned();
            return Err(Unread::Type { topic: topic(), type_name, expected: read_as.type_name() });
        }
        if channel.message_encoding != MESSAGE_ENCODING {
            return Err(Unread::Encoding { topic: topic(), encoding: channel.message_encoding.clone() });
        }
        let schema = channel.schema.as_ref().filter(|schema| schema.encoding == SCHEMA_ENCODING);
        let difference = schema.and_then(|s| field_difference(&read_as.schema(), &String::from_utf8_lossy(&s.data)));
        match difference {
            Some(difference) => Err(Unread::Fields { topic: topic(), type_name: read_as.type_name(), difference }),
            None => Ok(Some(read_as)),
        }
    }

    /// The recorded name of one of the node's topics; `None` if the recording does not contain it.
    pub fn name_of(&self, topic: Topic) -> Option<&str> {
        self.names.get(&topic).map(String::as_str)
    }

    /// The topics that are not read, and why.
    pub fn unread(&self) -> &[Unread] {
        &self.unread
    }
}

fn type_name(channel: &Channel) -> &str {
    channel.schema.as_ref().map_or("", |schema| &schema.name)
}

/// The topic among `of_type` that is read as `topic`; `None` if there is none.
fn choose<'a>(
    topic: Topic,
    of_type: &BTreeSet<&'a str>,
    chosen: &[String],
) -> Result<Result<Option<&'a str>, Unread>, ChoiceError> {
    let owned = |names: &[&str]| names.iter().map(|&name| name.to_owned()).collect();
    let wanted = topic.name();
    let mut choices = of_type.iter().copied().filter(|name| chosen.iter().any(|chosen| chosen == name));
    if let Some(first) = choices.next() {
        return match choices.next() {
            None => Ok(Ok(Some(first))),
            Some(second) => {
                Err(ChoiceError::Twice { topic: wanted, first: first.to_owned(), second: second.to_owned() })
            }
        };
    }
    if let Some(own) = of_type.get(wanted) {
        return Ok(Ok(Some(own)));
    }
    let in_namespace: Vec<&str> = of_type.iter().copied().filter(|name| name.ends_with(wanted)).collect();
    Ok(match (&in_namespace[..], of_type.is_empty()) {
        ([one], _) => Ok(Some(one)),
        ([], true) => Ok(None),
        // Other programs publish diagnostics of this type too.
        ([], false) if !topic.is_own_type() => Ok(None),
        ([], false) => {
            let topics = of_type.iter().map(|&name| name.to_owned()).collect();
            Err(Unread::OtherName { wanted, topics })
        }
        (several, _) => Err(Unread::Several { wanted, topics: owned(several) }),
    })
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::super::record_walker::Schema;
    use super::*;

    fn channel(topic: &str, of: Topic) -> Channel {
        let schema = Schema {
            name: of.type_name().to_owned(),
            encoding: SCHEMA_ENCODING.to_owned(),
            data: of.schema().into_bytes(),
        };
        Channel {
            id: 0,
            topic: topic.to_owned(),
            message_encoding: MESSAGE_ENCODING.to_owned(),
            metadata: BTreeMap::new(),
            schema: Some(Arc::new(schema)),
        }
    }

    fn decide(topics: &[&str], chosen: &[&str]) -> Result<RecordedTopics, ChoiceError> {
        let channels: Vec<Channel> = topics.iter().map(|topic| channel(topic, Topic::OperatingPoint)).collect();
        RecordedTopics::decide(&channels, &chosen.iter().map(|&name| name.to_owned()).collect::<Vec<_>>())
    }

    fn conditions(topics: &[&str], chosen: &[&str]) -> (Option<String>, Vec<String>) {
        let decided = decide(topics, chosen).expect("a sound choice");
        let unread = decided.unread().iter().map(ToString::to_string).collect();
        (decided.name_of(Topic::OperatingPoint).map(str::to_owned), unread)
    }

    #[test]
    fn the_name_decides_between_topics_of_one_type() {
        let read = |name: &str| (Some(name.to_owned()), vec![]);
        assert_eq!(conditions(&["/brake1/operating_point", "/rig/operating_point"], &[]), read("/rig/operating_point"));
        assert_eq!(conditions(&["/cell2/rig/operating_point", "/b/point"], &[]), read("/cell2/rig/operating_point"));
        let chosen = ["/brake1/operating_point"];
        assert_eq!(conditions(&["/brake1/operating_point", "/rig/operating_point"], &chosen), read(chosen[0]));
        assert_eq!(conditions(&[], &[]), (None, vec![]));
    }

    #[test]
    fn a_topic_under_another_name_is_named_and_not_read() {
        let (name, unread) = conditions(&["/brake1/operating_point"], &[]);
        assert_eq!(name, None);
        let [reason] = &unread[..] else { panic!("{unread:?}") };
        assert!(
            reason.contains("/brake1/operating_point is not read")
                && reason.contains("no /rig/operating_point")
                && reason.contains("--read-topic"),
            "{reason}"
        );
        let (name, unread) = conditions(&["/a/rig/operating_point", "/b/rig/operating_point"], &[]);
        assert_eq!(name, None);
        assert!(unread[0].contains("/a/rig/operating_point, /b/rig/operating_point are not read"), "{unread:?}");
        let aggregated = channel("/diagnostics_agg", Topic::Diagnostics);
        assert_eq!(RecordedTopics::decide(&[aggregated], &[]).expect("no choice").unread(), []);
    }

    #[test]
    fn a_choice_that_is_not_there_or_twice_is_an_error() {
        let error = decide(&["/brake1/operating_point"], &["/brake2/operating_point"]).unwrap_err().to_string();
        assert!(
            error.contains("/brake2/operating_point") && error.contains("it holds /brake1/operating_point"),
            "{error}"
        );
        assert!(matches!(decide(&["/a", "/b"], &["/a", "/b"]), Err(ChoiceError::Twice { .. })));
    }

    #[test]
    fn an_unreadable_topic_of_the_node_is_reported_with_the_reason() {
        let read = |channel: Channel| {
            let decided = RecordedTopics::decide(std::slice::from_ref(&channel), &[]).expect("no choice");
            let unread: Vec<String> = decided.unread().iter().map(ToString::to_string).collect();
            assert_eq!(decided.read_as(&channel).is_err(), unread.len() == 1, "{unread:?}");
            unread.into_iter().next()
        };
        let prediction = || channel(Topic::Prediction.name(), Topic::Prediction);
        assert_eq!(read(prediction()), None);
        let with_text = |from: &str, to: &str| {
            let text = Topic::Prediction.schema();
            assert!(text.contains(from));
            let mut channel = prediction();
            let schema = channel.schema.as_deref().cloned().expect("one");
            channel.schema = Some(Arc::new(Schema { data: text.replace(from, to).into_bytes(), ..schema }));
            read(channel).expect("it cannot be read")
        };
        assert!(with_text("float64 friction_margin_error\n", "").contains("has no `float64 friction_margin_error`"));
        assert!(with_text("bool reused\n", "bool reused\nbool extra\n").contains("has `bool extra`"));
        // A message nested in the message.
        assert!(with_text("float64 pad_participation\n", "").contains("Mode has no `float64 pad_participation`"));
        let json = Channel { message_encoding: "json".to_owned(), ..prediction() };
        assert!(read(json).expect("not cdr").contains("\"json\""));
        let foreign = channel(Topic::Prediction.name(), Topic::RigInfo);
        assert!(read(foreign).expect("another type").contains("its type is squealcast_msgs/msg/RigInfo, expected"));
    }
}

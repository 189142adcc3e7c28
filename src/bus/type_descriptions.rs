//! The service `~/get_type_description` of a ROS 2 node: describes the types of its topics to programs that do not have them.

use serde::{Deserialize, Serialize};

use crate::msgs::schema::Topic;
use crate::msgs::type_description::TypeDescription;
use crate::msgs::{KeyValue, to_cdr};

/// Its name after that of the node.
pub const SERVICE: &str = "get_type_description";
/// Package and name of its type.
pub const SERVICE_TYPE: (&str, &str) = ("type_description_interfaces", "GetTypeDescription");

/// Request of `type_description_interfaces/GetTypeDescription`.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Request {
    /// `package/msg/Type`.
    pub type_name: String,
    /// `RIHS01_…`.
    pub type_hash: String,
    pub include_type_sources: bool,
}

/// Response of `type_description_interfaces/GetTypeDescription`.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Response {
    pub successful: bool,
    /// Empty if successful.
    pub failure_reason: String,
    pub type_description: TypeDescription,
    /// Of the type and of all types it refers to.
    pub type_sources: Vec<TypeSource>,
    pub extra_information: Vec<KeyValue>,
}

/// `type_description_interfaces/TypeSource`.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct TypeSource {
    pub type_name: String,
    /// Language of the definition: `msg`.
    pub encoding: String,
    pub raw_file_contents: String,
}

/// The response to a request for the type of one of our topics; as of rcl, others are refused.
pub fn answer(request: &Request) -> Response {
    let refused = |failure_reason: String| Response { failure_reason, ..Response::default() };
    let Some(topic) = Topic::ALL.into_iter().find(|topic| topic.type_name() == request.type_name) else {
        return refused(format!("{:?} is not the type of a topic of this node", request.type_name));
    };
    let type_description = topic.type_description();
    let hash = type_description.hash();
    if request.type_hash != hash {
        return refused(format!("{} has the hash {hash}, not {:?}", request.type_name, request.type_hash));
    }
    let sources = topic.definitions().into_iter().filter(|_| request.include_type_sources);
    let type_sources = sources.map(|(type_name, text)| TypeSource {
        type_name,
        encoding: "msg".to_owned(),
        raw_file_contents: text.to_owned(),
    });
    Response { successful: true, type_description, type_sources: type_sources.collect(), ..Response::default() }
}

/// As [`answer`], for a bus that delivers no answer longer than `limit` bytes of CDR: the texts of the definitions are left
/// out where they do not fit, and a description that does not fit is refused.
pub fn short_answer(request: &Request, limit: usize) -> Response {
    let fits = |response: &Response| to_cdr(response).is_ok_and(|cdr| cdr.len() <= limit);
    let whole = answer(request);
    if fits(&whole) {
        return whole;
    }
    let without_sources = Response { type_sources: vec![], ..whole };
    if fits(&without_sources) {
        return without_sources;
    }
    let failure_reason = format!("the description of {} is longer than {limit} bytes", request.type_name);
    Response { failure_reason, ..Response::default() }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_does_not_fit_is_left_out_or_refused() {
        for (topic, described) in [(Topic::OperatingPoint, true), (Topic::Prediction, false)] {
            let request = Request {
                type_name: topic.type_name().to_owned(),
                type_hash: topic.type_hash(),
                include_type_sources: true,
            };
            assert_eq!(short_answer(&request, 1 << 20), answer(&request));
            let short = short_answer(&request, 800);
            assert_eq!((short.successful, short.type_sources.len()), (described, 0), "{topic:?}");
            assert_eq!(short.failure_reason.contains("longer than 800 bytes"), !described, "{topic:?}");
        }
    }

    #[test]
    fn types_are_described_by_name_and_hash() {
        for topic in Topic::ALL {
            let request = Request {
                type_name: topic.type_name().to_owned(),
                type_hash: topic.type_hash(),
                include_type_sources: true,
            };
            let response = answer(&request);
            assert!(response.successful, "{}", response.failure_reason);
            assert_eq!(response.type_description.hash(), request.type_hash);
            let described = response.type_description.referenced_type_descriptions.iter().map(|known| &known.type_name);
            let mut described: Vec<&String> = described.chain([&request.type_name]).collect();
            let mut sources: Vec<&String> = response.type_sources.iter().map(|source| &source.type_name).collect();
            described.sort();
            sources.sort();
            assert_eq!(described, sources);
            let without = answer(&Request { include_type_sources: false, ..request });
            assert!(without.successful && without.type_sources.is_empty());
        }
    }

    #[test]
    fn other_types_and_hashes_are_refused_with_a_reason() {
        let unknown = answer(&Request { type_name: "std_msgs/msg/String".to_owned(), ..Request::default() });
        assert!(!unknown.successful && unknown.failure_reason.contains("std_msgs/msg/String"), "{unknown:?}");
        let type_name = Topic::Prediction.type_name().to_owned();
        let other = answer(&Request { type_name, type_hash: "RIHS01_00".to_owned(), include_type_sources: true });
        assert!(other.failure_reason.contains(&Topic::Prediction.type_hash()), "{other:?}");
        assert!(other.type_sources.is_empty());
    }
}

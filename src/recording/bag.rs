//! `metadata.yaml` (version 8), which makes a directory of MCAP files a rosbag2 recording.

use std::{collections::BTreeMap, fmt::Write as _, io::Write as _, path::Path};

use crate::files::whole_file::{WholeFileError, write_whole};

/// Name of the file.
pub const METADATA_FILE: &str = "metadata.yaml";

/// Keys in the metadata of a channel, as the MCAP storage of rosbag2 names them.
pub const QOS_KEY: &str = "offered_qos_profiles";
pub const TYPE_HASH_KEY: &str = "topic_type_hash";

/// Entry of a topic in `metadata.yaml`.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct TopicInfo {
    pub name: String,
    /// `package/msg/Type`.
    pub type_name: String,
    pub message_encoding: String,
    /// Must equal the text in the channel, or `rosbags` finds no messages.
    pub qos_profiles: String,
    /// Hash of the type (REP-2016); empty if the channel has none.
    pub type_hash: String,
}

impl TopicInfo {
    /// The entry of a channel.
    pub fn of_channel(
        name: &str,
        type_name: Option<&str>,
        message_encoding: &str,
        metadata: &BTreeMap<String, String>,
    ) -> Self {
        let value = |key| metadata.get(key).cloned().unwrap_or_default();
        Self {
            name: name.to_owned(),
            type_name: type_name.unwrap_or_default().to_owned(),
            message_encoding: message_encoding.to_owned(),
            qos_profiles: value(QOS_KEY),
            type_hash: value(TYPE_HASH_KEY),
        }
    }
}

/// Entry of an MCAP file in `metadata.yaml`.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct FileSummary {
    /// File name without directory.
    pub name: String,
    /// First and last log time, ns; `None` without messages.
    pub span_ns: Option<(u64, u64)>,
    /// Number of messages by topic.
    pub topics: BTreeMap<TopicInfo, u64>,
}

impl FileSummary {
    /// Counts a message.
    pub fn count(&mut self, topic: &TopicInfo, log_time_ns: u64) {
        match self.topics.get_mut(topic) {
            Some(count) => *count += 1,
            None => drop(self.topics.insert(topic.clone(), 1)),
        }
        let (first, last) = self.span_ns.unwrap_or((log_time_ns, log_time_ns));
        self.span_ns = Some((first.min(log_time_ns), last.max(log_time_ns)));
    }

    /// Total number of messages.
    pub fn messages(&self) -> u64 {
        self.topics.values().sum()
    }
}

/// The text of `metadata.yaml` for the files of a recording.
pub fn metadata_yaml(files: &[FileSummary]) -> String {
    let mut topics = BTreeMap::new();
    for (topic, count) in files.iter().flat_map(|file| &file.topics) {
        *topics.entry(topic).or_insert(0) += count;
    }
    let spans = || files.iter().filter_map(|file| file.span_ns);
    let first = spans().map(|(first, _)| first).min().unwrap_or(0);
    let last = spans().map(|(_, last)| last).max().unwrap_or(first);
    let messages: u64 = topics.values().sum();

    let mut yaml = String::new();
    yaml.push_str("rosbag2_bagfile_information:\n  version: 8\n  storage_identifier: mcap\n");
    let _ = write!(yaml, "  duration:\n    nanoseconds: {}\n", last - first);
    let _ = write!(yaml, "  starting_time:\n    nanoseconds_since_epoch: {first}\n  message_count: {messages}\n");
    list(&mut yaml, "topics_with_message_count", topics.iter(), |yaml, (topic, count)| {
        let TopicInfo { name, type_name, message_encoding, qos_profiles, type_hash } = topic;
        let _ = write!(
            yaml,
            "    - topic_metadata:\n        name: {}\n        type: {}\n        serialization_format: {}\n        \
             offered_qos_profiles: {}\n        type_description_hash: {}\n      message_count: {count}\n",
            quoted(name),
            quoted(type_name),
            quoted(message_encoding),
            quoted(qos_profiles),
            quoted(type_hash),
        );
    });
    yaml.push_str("  compression_format: \"\"\n  compression_mode: \"\"\n");
    list(&mut yaml, "relative_file_paths", files.iter(), |yaml, file| {
        let _ = writeln!(yaml, "    - {}", quoted(&file.name));
    });
    list(&mut yaml, "files", files.iter(), |yaml, file| {
        let (first, last) = file.span_ns.unwrap_or((0, 0));
        let _ = write!(
            yaml,
            "    - path: {}\n      starting_time:\n        nanoseconds_since_epoch: {first}\n      duration:\n        \
             nanoseconds: {}\n      message_count: {}\n",
            quoted(&file.name),
            last - first,
            file.messages(),
        );
    });
    yaml.push_str("  custom_data: ~\n  ros_distro: \"\"\n");
    yaml
}

/// Writes `metadata.yaml` into a directory. An existing file is kept until the new one is complete.
///
/// # Errors
///
/// [`WholeFileError`].
pub fn write_metadata(directory: &Path, files: &[FileSummary]) -> Result<(), WholeFileError> {
    write_whole(&directory.join(METADATA_FILE), |out| out.write_all(metadata_yaml(files).as_bytes()))
}

/// A YAML list under a key; `[]` if empty.
fn list<T>(yaml: &mut String, key: &str, items: impl ExactSizeIterator<Item = T>, item: impl Fn(&mut String, T)) {
    let _ = writeln!(yaml, "  {key}:{}", if items.len() == 0 { " []" } else { "" });
    for element in items {
        item(yaml, element);
    }
}

/// A double-quoted YAML scalar; JSON strings are valid ones.
fn quoted(text: &str) -> String {
    serde_json::Value::from(text).to_string()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_empty_recording_and_odd_names_are_still_yaml() {
        assert!(metadata_yaml(&[]).contains("topics_with_message_count: []\n"));
        let mut file = FileSummary { name: "a \"b\"\n_0.mcap".to_owned(), ..FileSummary::default() };
        let topic = TopicInfo {
            name: "/t".to_owned(),
            type_name: "p/msg/T".to_owned(),
            message_encoding: "cdr".to_owned(),
            qos_profiles: "- history: 1\n  depth: 2".to_owned(),
            type_hash: "RIHS01_0".to_owned(),
        };
        file.count(&topic, 30);
        file.count(&topic, 10);
        let yaml = metadata_yaml(&[file]);
        assert!(yaml.contains(r#"    - "a \"b\"\n_0.mcap""#), "{yaml}");
        assert!(yaml.contains(r#"offered_qos_profiles: "- history: 1\n  depth: 2""#), "{yaml}");
        assert!(yaml.contains("type_description_hash: \"RIHS01_0\"\n"), "{yaml}");
        assert!(yaml.contains("nanoseconds: 20\n") && yaml.contains("nanoseconds_since_epoch: 10\n"), "{yaml}");
    }
}

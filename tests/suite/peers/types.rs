//! Hashes of our message types, compared with those that rosidl and rosbags compute from the same definitions.

use std::collections::HashMap;
use std::fs;
use std::path::{Path, PathBuf};

use super::{Node, RIG, alone, peer, peer_program, peer_program_in, say, say_versions};
use serde_json::Value;
use squealcast::msgs::schema::Topic;
use squealcast::msgs::to_cdr;
use tempfile::TempDir;

/// The type description that rosidl wrote for a type of ROS 2, or of our package.
pub(super) fn file_of_rosidl(peers: &Path, type_name: &str) -> Value {
    let (package, rest) = type_name.split_once('/').expect("package/msg/Type");
    let prefix = if package == "squealcast_msgs" { "msgs" } else { "ros" };
    let file = peers.join(prefix).join("share").join(package).join(format!("{rest}.json"));
    let text = fs::read_to_string(&file).unwrap_or_else(|error| panic!("{}: {error}", file.display()));
    serde_json::from_str(&text).expect("JSON")
}

/// The hashes in it.
fn of_rosidl(peers: &Path, type_name: &str) -> HashMap<String, String> {
    let json = file_of_rosidl(peers, type_name);
    let hashes = json["type_hashes"].as_array().expect("hashes").iter();
    let text = |value: &Value| value.as_str().expect("text").to_owned();
    hashes.map(|entry| (text(&entry["type_name"]), text(&entry["hash_string"]))).collect()
}

#[test]
fn hashes_of_all_types_are_those_of_rosidl() {
    for (suffix, distribution) in [("", "Kilted"), ("-jazzy", "Jazzy")] {
        let Some(python) = peer_program_in(suffix, "ros-python") else { continue };
        let peers = folder_of(&python);
        for topic in Topic::ALL {
            let theirs = of_rosidl(&peers, topic.type_name());
            assert_eq!(topic.type_hash(), theirs[topic.type_name()], "{distribution} {}", topic.type_name());
            // Every type it refers to, and no other.
            let description = topic.type_description();
            let mut referenced: Vec<&str> =
                description.referenced_type_descriptions.iter().map(|known| known.type_name.as_str()).collect();
            referenced.push(topic.type_name());
            referenced.sort_unstable();
            let mut expected: Vec<&str> = theirs.keys().map(String::as_str).collect();
            expected.sort_unstable();
            assert_eq!(referenced, expected, "{distribution}");
        }
        say(&format!("{} types have the hashes of ROS 2 {distribution}", Topic::ALL.len()));
    }
}

/// The folder that a program of the peers is in.
pub(super) fn folder_of(program: &Path) -> PathBuf {
    program.parent().and_then(Path::parent).expect("a folder").to_owned()
}

#[test]
fn rclpy_gets_the_descriptions_that_rosidl_wrote() {
    for (suffix, distribution) in [("", "Kilted"), ("-jazzy", "Jazzy")] {
        let Some(python) = peer_program_in(suffix, "ros-python") else { continue };
        let _alone = alone();
        let mut node = Node::start(RIG, false);
        let folder = TempDir::new().expect("a folder");
        let mut wanted: HashMap<&str, String> = Topic::ALL.map(|topic| (topic.type_name(), topic.type_hash())).into();
        wanted.insert(
            "std_msgs/msg/String",
            "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18".to_owned(),
        );
        let file = folder.path().join("types.json");
        fs::write(&file, serde_json::to_string(&wanted).expect("JSON")).expect("written");
        let file = file.display().to_string();
        let theirs = peer(&python, "rclpy_types.py", &["--domain", &node.domain(), &file]);
        node.interrupt();
        let mut described = vec![];
        for topic in Topic::ALL {
            let answer = &theirs[topic.type_name()];
            let error = answer["error"].as_str().expect("text");
            if error.contains("longer than 1200 bytes") {
                // RustDDS does not deliver it.
                assert!(to_cdr(&topic.type_description()).expect("encoded").len() > 1100, "{topic:?}: {error}");
                continue;
            }
            assert_eq!(error, "", "{distribution} {topic:?}");
            described.push(topic);
            let written = &file_of_rosidl(&folder_of(&python), topic.type_name())["type_description_msg"];
            assert_eq!(answer["description"], *written, "{distribution} {topic:?}");
        }
        assert!(described.contains(&Topic::OperatingPoint) && described.contains(&Topic::RigInfo), "{described:?}");
        let unknown = theirs["std_msgs/msg/String"]["error"].as_str().expect("text");
        assert!(unknown.contains("not the type of a topic"), "{unknown}");
    }
}

#[test]
fn hashes_of_all_types_are_those_of_rosbags() {
    let Some(python) = peer_program("python") else { return };
    say_versions(&python, &["rosbags"]);
    let folder = TempDir::new().expect("a folder");
    let schemas: HashMap<&str, String> = Topic::ALL.map(|topic| (topic.type_name(), topic.schema())).into();
    let file = folder.path().join("schemas.json");
    fs::write(&file, serde_json::to_string(&schemas).expect("JSON")).expect("written");
    let theirs = peer(&python, "type_hashes.py", &[&file.display().to_string()]);
    for topic in Topic::ALL {
        assert_eq!(theirs[topic.type_name()], Value::from(topic.type_hash()), "{}", topic.type_name());
    }
}

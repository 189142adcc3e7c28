//! A managed node, brought through its states by rclpy.

use super::{Content, Node, RIG, alone, peer, peer_program_in, say, say_versions, verify};
use serde_json::{Value, json};

#[test]
fn a_managed_node_follows_rclpy_of_kilted() {
    a_managed_node_follows("");
}

#[test]
fn a_managed_node_follows_rclpy_of_jazzy() {
    a_managed_node_follows("-jazzy");
}

/// It predicts only while it is active, and what it recorded replays to the same bits across the gaps.
fn a_managed_node_follows(ros: &str) {
    let Some(ros_python) = peer_program_in(ros, "ros-python") else { return };
    let _alone = alone();
    say_versions(&ros_python, &["ros-rclpy", "ros-lifecycle-msgs"]);
    let mut node = Node::start_with(RIG, true, &["--managed", "--plain"]);
    // The script fails unless every state is the expected one and predictions come only while the node is active.
    let report = peer(&ros_python, "rclpy_managed.py", &["--domain", &node.domain()]);
    say(&format!("phases: {}", report["phases"]));
    assert_eq!((&report["first"], &report["available"]), (&json!("unconfigured"), &json!(["configure", "shutdown"])));
    let successes: Vec<&Value> =
        report["phases"].as_array().expect("phases").iter().map(|one| &one["success"]).collect();
    assert_eq!(successes[0], false, "it cannot be activated before it is configured");
    assert!(successes[1..].iter().all(|success| **success == true), "{report}");
    assert_eq!(report["states"]["finalized"], 4, "{report}");
    assert_eq!(report["graph"], 7 + 5, "{report}");
    let events = report["events"].as_array().expect("events");
    assert_eq!(events[0], json!(["unconfigured", "configure", "configuring"]), "{report}");
    assert_eq!(events[1], json!(["configuring", "transition_success", "inactive"]), "{report}");
    assert_eq!(events.len(), 2 * (successes.len() - 1), "{report}");
    let described = "WARN when the margin to the critical friction coefficient is below this";
    assert_eq!(report["described"], json!([described, 0.0, 100.0]), "{report}");
    let log = report["log"].as_array().expect("lines");
    let inactive = "squealcast: predictions: INACTIVE; inactive: it waits to be activated over ROS 2";
    assert!(log.contains(&json!(["squealcast", 20, "the node is active"])), "{report}");
    assert!(log.contains(&json!(["squealcast", 20, inactive])), "{report}");
    node.interrupt();
    let said = node.said();
    assert!(said.contains("INACTIVE") && said.contains("it waits to be activated"), "{said}");
    let content = Content::read(&node.recording());
    let sent = report["sent"].as_u64().expect("a number");
    assert!(content.count("messages_while_not_active") > sent / 3, "{report}");
    verify(&node.recording());
}

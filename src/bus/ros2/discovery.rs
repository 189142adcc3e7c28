//! ROS 2 environment variables for discovery: `ROS_AUTOMATIC_DISCOVERY_RANGE`, `ROS_LOCALHOST_ONLY`,
//! `ROS_STATIC_PEERS`, with the rules of rcl. RustDDS discovers by multicast and on this machine. Settings it does not
//! support are refused or reported.

use super::Ros2Error;

const RANGE: &str = "ROS_AUTOMATIC_DISCOVERY_RANGE";
const LOCALHOST_ONLY: &str = "ROS_LOCALHOST_ONLY";
const STATIC_PEERS: &str = "ROS_STATIC_PEERS";

/// Which participants are discovered.
#[derive(Debug, Default, PartialEq, Eq)]
pub(super) struct Discovery {
    /// Participants on this machine only.
    pub loopback_only: bool,
    /// Requested settings that are not supported.
    pub warnings: Vec<String>,
}

impl Discovery {
    /// The settings of the environment variables; an empty variable counts as unset.
    ///
    /// # Errors
    /// An invalid value, or `OFF`, which RustDDS does not support.
    pub(super) fn from_variables(variable: impl Fn(&str) -> Option<String>) -> Result<Self, Ros2Error> {
        let value =
            |name: &'static str| variable(name).map(|text| text.trim().to_owned()).filter(|text| !text.is_empty());
        let refused = |name: &'static str, value: String, reason: &'static str| {
            Err(Ros2Error::Discovery { variable: name, value, reason })
        };
        let mut discovery = Self::default();
        match value(LOCALHOST_ONLY) {
            // It overrides the others, as in rcl.
            Some(text) if text == "1" => {
                discovery.loopback_only = true;
                return Ok(discovery);
            }
            Some(text) if text != "0" => return refused(LOCALHOST_ONLY, text, "expected 0 or 1"),
            _ => {}
        }
        if let Some(text) = value(RANGE) {
            match text.to_ascii_uppercase().as_str() {
                "SUBNET" | "SYSTEM_DEFAULT" => {}
                "LOCALHOST" => discovery.loopback_only = true,
                "OFF" => {
                    return refused(RANGE, text, "this node cannot join without being discovered; --no-ros stays off");
                }
                _ => return refused(RANGE, text, "expected SUBNET, LOCALHOST, OFF or SYSTEM_DEFAULT"),
            }
        }
        if let Some(peers) = value(STATIC_PEERS) {
            discovery.warnings.push(format!(
                "{STATIC_PEERS}={peers} is not used: this node cannot call on peers beyond the reach of multicast; \
                 name this machine in theirs"
            ));
        }
        Ok(discovery)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn discovery(variables: &[(&str, &str)]) -> Result<Discovery, Ros2Error> {
        Discovery::from_variables(|name| {
            variables.iter().find(|(known, _)| *known == name).map(|(_, value)| (*value).to_owned())
        })
    }

    fn loopback_only(variables: &[(&str, &str)]) -> bool {
        let found = discovery(variables).expect("valid");
        assert_eq!(found.warnings, Vec::<String>::new());
        found.loopback_only
    }

    #[test]
    fn the_range_of_discovery_is_that_of_the_variables() {
        assert!(!loopback_only(&[]));
        for range in ["", " ", "SUBNET", "subnet", "SYSTEM_DEFAULT"] {
            assert!(!loopback_only(&[(RANGE, range)]), "{range}");
        }
        assert!(loopback_only(&[(RANGE, "LOCALHOST")]));
        assert!(loopback_only(&[(RANGE, "localhost")]));
        assert!(!loopback_only(&[(LOCALHOST_ONLY, "0")]));
        assert!(loopback_only(&[(LOCALHOST_ONLY, "1")]));
        assert!(loopback_only(&[(LOCALHOST_ONLY, "1"), (RANGE, "SUBNET"), (STATIC_PEERS, "10.0.0.1")]), "it wins");
        assert!(loopback_only(&[(LOCALHOST_ONLY, "0"), (RANGE, "LOCALHOST")]));
    }

    #[test]
    fn impossible_requests_are_refused_or_reported() {
        let error = |variables: &[(&str, &str)]| discovery(variables).expect_err("refused").to_string();
        let off =
            "ROS_AUTOMATIC_DISCOVERY_RANGE=OFF: this node cannot join without being discovered; --no-ros stays off";
        assert_eq!(error(&[(RANGE, "OFF")]), off);
        let range = "ROS_AUTOMATIC_DISCOVERY_RANGE=near: expected SUBNET, LOCALHOST, OFF or SYSTEM_DEFAULT";
        assert_eq!(error(&[(RANGE, "near")]), range);
        assert_eq!(error(&[(LOCALHOST_ONLY, "yes")]), "ROS_LOCALHOST_ONLY=yes: expected 0 or 1");
        let peers = discovery(&[(STATIC_PEERS, "10.0.0.1;10.0.0.2")]).expect("valid");
        assert!(!peers.loopback_only);
        assert!(peers.warnings[0].starts_with("ROS_STATIC_PEERS=10.0.0.1;10.0.0.2 is not used"), "{peers:?}");
    }
}

//! Settings of a Zenoh session: those of rmw_zenoh, from the same environment variables.

use std::path::Path;

use ::zenoh::Config;

use crate::bus::ros2::{Ros2Error, Ros2Options};
use crate::files::input_file;

/// File with the settings of the session instead of [`DEFAULTS`], JSON5.
const FILE: &str = "ZENOH_SESSION_CONFIG_URI";
/// Changes to the settings: `key=value;key=value`, values in JSON5.
const OVERRIDE: &str = "ZENOH_CONFIG_OVERRIDE";

/// The session settings of rmw_zenoh that differ from Zenoh's own, and a limit on what a message may allocate. Participants
/// listen on this machine only and find each other through a router on it; routers connect machines.
const DEFAULTS: [(&str, &str); 8] = [
    ("mode", "\"peer\""),
    ("connect/endpoints", "[\"tcp/localhost:7447\"]"),
    ("listen/endpoints", "[\"tcp/localhost:0\"]"),
    ("scouting/multicast/enabled", "false"),
    ("scouting/gossip/target", "{router: [\"router\", \"peer\"], peer: [\"router\"]}"),
    ("scouting/gossip/autoconnect_strategy", "{peer: {to_router: \"always\", to_peer: \"greater-zid\"}}"),
    // The publisher that keeps its latest message needs it.
    ("timestamping/enabled", "true"),
    ("transport/link/rx/max_message_size", "1048576"),
];

/// The settings for a participant with these options.
///
/// # Errors
/// A file or setting that is not valid, or one that leaves this machine although the options forbid it.
pub(super) fn session(options: &Ros2Options) -> Result<Config, Ros2Error> {
    let variable = |name: &str| std::env::var(name).ok().filter(|text| !text.trim().is_empty());
    with_variables(options.loopback_only, variable)
}

fn with_variables(loopback_only: bool, variable: impl Fn(&str) -> Option<String>) -> Result<Config, Ros2Error> {
    let invalid = |name: &str, reason: String| Ros2Error::Zenoh(format!("{name}: {reason}"));
    let mut config = match variable(FILE) {
        Some(path) => {
            let path = Path::new(path.trim());
            let text = input_file::read_text(path, input_file::PARAMETERS)
                .map_err(|error| invalid(FILE, format!("{}: {error}", path.display())))?;
            Config::from_json5(&text).map_err(|error| invalid(FILE, format!("{}: {error}", path.display())))?
        }
        None => {
            let mut config = Config::default();
            for (key, value) in DEFAULTS {
                config.insert_json5(key, value).map_err(|error| invalid(key, error.to_string()))?;
            }
            config
        }
    };
    let changes = variable(OVERRIDE).unwrap_or_default();
    for change in changes.split(';').map(str::trim).filter(|change| !change.is_empty()) {
        let (key, value) =
            change.split_once('=').ok_or_else(|| invalid(OVERRIDE, format!("{change:?} is no key=value")))?;
        let set = config.insert_json5(key.trim(), value.trim());
        set.map_err(|error| invalid(OVERRIDE, format!("{change:?}: {error}")))?;
    }
    if loopback_only {
        keep_to_loopback(&mut config)?;
    }
    Ok(config)
}

/// Refuses endpoints that are not on this machine. What a router on this machine forwards is not in our hands.
fn keep_to_loopback(config: &mut Config) -> Result<(), Ros2Error> {
    let failed = |key: &str, reason: String| Ros2Error::Zenoh(format!("{key}: {reason}"));
    for key in ["connect/endpoints", "listen/endpoints"] {
        let text = config.get_json(key).map_err(|error| failed(key, error.to_string()))?;
        let value: serde_json::Value = serde_json::from_str(&text).map_err(|error| failed(key, error.to_string()))?;
        for endpoint in strings(&value).into_iter().filter(|text| text.contains('/')) {
            let address = endpoint.split_once('/').map_or("", |(_, address)| address);
            let is_local = endpoint.starts_with("unixsock-stream/")
                || ["localhost:", "127.", "[::1]:"].iter().any(|local| address.starts_with(local));
            if !is_local {
                return Err(failed(key, format!("{endpoint} is not on this machine, as --loopback demands")));
            }
        }
    }
    let key = "scouting/multicast/enabled";
    config.insert_json5(key, "false").map_err(|error| failed(key, error.to_string()))
}

/// All texts in a JSON value.
fn strings(value: &serde_json::Value) -> Vec<&str> {
    use serde_json::Value::{Array, Bool, Null, Number, Object, String};
    match value {
        String(text) => vec![text],
        Array(values) => values.iter().flat_map(strings).collect(),
        Object(values) => values.values().flat_map(strings).collect(),
        Null | Bool(_) | Number(_) => vec![],
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn config(loopback_only: bool, changes: &str) -> Result<Config, Ros2Error> {
        with_variables(loopback_only, |name| (name == OVERRIDE).then(|| changes.to_owned()))
    }

    #[test]
    fn settings_follow_the_variables_of_rmw_zenoh() {
        let value = |config: &Config, key| config.get_json(key).expect("a key");
        let plain = config(false, "").expect("valid");
        assert_eq!(value(&plain, "connect/endpoints"), "[\"tcp/localhost:7447\"]");
        assert_eq!(value(&plain, "scouting/multicast/enabled"), "false");
        let changed = config(true, "connect/endpoints=[\"tcp/127.0.0.1:9\"]; mode=\"client\";").expect("valid");
        assert_eq!(value(&changed, "connect/endpoints"), "[\"tcp/127.0.0.1:9\"]");
        assert_eq!(value(&changed, "mode"), "\"client\"");
        for (changes, reason) in [
            ("mode", "no key=value"),
            ("mode=\"king\"", "mode"),
            ("nonsense=1", "nonsense"),
            ("connect/endpoints=[\"tcp/192.0.2.1:7447\"]", "192.0.2.1:7447 is not on this machine"),
        ] {
            let error = config(true, changes).expect_err(changes).to_string();
            assert!(error.contains(reason), "{error}");
        }
        assert!(config(false, "connect/endpoints=[\"tcp/192.0.2.1:7447\"]").is_ok());
    }

    #[test]
    fn a_file_replaces_the_defaults() {
        let folder = tempfile::TempDir::new().expect("a folder");
        let path = folder.path().join("session.json5");
        let read = || with_variables(false, |name| (name == FILE).then(|| path.display().to_string()));
        std::fs::write(&path, "{ mode: \"client\", connect: { endpoints: [\"tcp/localhost:5\"] } }").expect("written");
        assert_eq!(read().expect("valid").get_json("mode").expect("a key"), "\"client\"");
        std::fs::write(&path, "{ mode: ").expect("written");
        assert!(read().expect_err("malformed").to_string().contains("session.json5"));
        std::fs::remove_file(&path).expect("removed");
        assert!(read().expect_err("missing").to_string().contains("session.json5"));
    }
}

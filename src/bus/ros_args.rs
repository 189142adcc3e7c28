//! ROS 2 command-line arguments: `--ros-args -r from:=to -p name:=value --params-file F ... --`.
//!
//! Implemented here because it is little code, whereas the crate `ros2args` depends on a regex engine. The rules are
//! those of rcl: an argument for one node begins with that node's name and a colon, later arguments override earlier
//! ones, and the first matching remapping rule applies.

use std::path::PathBuf;

use serde::{Deserialize, Serialize};
use thiserror::Error;

use super::log::Severity;
use super::params_file::{self, ParamsFileError};
use super::qos_overrides::{QosOverrides, Role, is_override};
use crate::msgs::schema::Topic;
use crate::msgs::topic;

/// An invalid ROS argument.
#[derive(Debug, Error)]
pub enum RosArgsError {
    #[error("unknown ROS argument {0:?}")]
    Unknown(String),
    #[error("ROS argument {0} needs a value")]
    ValueMissing(String),
    #[error("{rule:?} is no remapping rule from:=to")]
    Rule { rule: String },
    #[error("{text:?} is no parameter name:=value")]
    Parameter { text: String },
    #[error("parameter {name}: {value:?} is no number")]
    NotANumber { name: String, value: String },
    #[error("parameter {parameter}: {value:?}, expected {expected}")]
    Qos { parameter: String, value: String, expected: &'static str },
    #[error("{value:?} is no log level, expected DEBUG, INFO, WARN, ERROR or FATAL, or LOGGER:= and one of them")]
    LogLevel { value: String },
    #[error(transparent)]
    File(#[from] ParamsFileError),
}

/// A remapping rule.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
struct Rule {
    /// The node the rule is for; `None` for all nodes.
    node: Option<String>,
    from: String,
    to: String,
}

/// A source of parameter values; sources are kept in the order given.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
enum ParameterSource {
    Value { node: Option<String>, name: String, value: String },
    File(PathBuf),
}

/// The ROS 2 arguments of a command line.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct RosArgs {
    rules: Vec<Rule>,
    sources: Vec<ParameterSource>,
    /// The least severity of lines on `/rosout`; `None` if not given.
    log_level: Option<Severity>,
    without_rosout: bool,
}

/// Parameters by name.
type Values = Vec<(String, f64)>;

impl RosArgs {
    /// Separates the ROS arguments from a command line: those between each `--ros-args` and the next `--` or the end.
    /// Returns them and the remaining arguments, which are for the program itself.
    ///
    /// # Errors
    /// The first unknown or malformed argument.
    pub fn split(args: impl IntoIterator<Item = String>) -> Result<(Self, Vec<String>), RosArgsError> {
        let mut ros = Self::default();
        let mut rest = Vec::new();
        let mut args = args.into_iter();
        while let Some(arg) = args.next() {
            if arg == "--ros-args" {
                ros.take_section(&mut args)?;
            } else {
                rest.push(arg);
            }
        }
        Ok((ros, rest))
    }

    fn take_section(&mut self, args: &mut impl Iterator<Item = String>) -> Result<(), RosArgsError> {
        while let Some(arg) = args.next() {
            let mut value = || args.next().ok_or_else(|| RosArgsError::ValueMissing(arg.clone()));
            match arg.as_str() {
                "--" => return Ok(()),
                // Consecutive sections need no `--` between them.
                "--ros-args" => {}
                "-r" | "--remap" => self.rules.push(Rule::parse(&value()?)?),
                "-p" | "--param" => self.sources.push(parse_parameter(&value()?)?),
                "--params-file" => self.sources.push(ParameterSource::File(value()?.into())),
                "--log-level" => self.log_level = Some(parse_log_level(&value()?)?),
                "--enable-rosout-logs" => self.without_rosout = false,
                "--disable-rosout-logs" => self.without_rosout = true,
                "--log-config-file" | "--log-file-name" | "-e" | "--enclave" => drop(value()?),
                _ if LOG_SWITCHES.iter().any(|switch| {
                    ["--enable-", "--disable-"].iter().any(|on_off| arg.strip_prefix(on_off) == Some(switch))
                }) => {}
                _ => return Err(RosArgsError::Unknown(arg)),
            }
        }
        Ok(())
    }

    /// These arguments, which override `others`.
    pub fn over(mut self, others: Self) -> Self {
        // The first rule that applies counts, and the last value of a parameter.
        self.rules.extend(others.rules);
        self.sources.splice(0..0, others.sources);
        self.log_level = self.log_level.or(others.log_level);
        self.without_rosout |= others.without_rosout;
        self
    }

    /// The same arguments with the node renamed to `name`, overriding its `__node` rules.
    pub fn renamed(mut self, name: &str) -> Self {
        self.rules.retain(|rule| !matches!(rule.from.as_str(), "__node" | "__name"));
        self.rules.push(Rule { node: None, from: "__node".to_owned(), to: name.to_owned() });
        self
    }

    /// The name of the node after `__node` rules.
    pub fn node_name(&self, default: &str) -> String {
        self.special(default, &["__node", "__name"]).unwrap_or(default).to_owned()
    }

    /// The namespace of the node with this name after `__ns` rules; absolute, without a trailing slash.
    pub fn namespace(&self, node_name: &str, default: &str) -> String {
        let namespace = self.special(node_name, &["__ns"]).unwrap_or(default);
        format!("/{}", namespace.trim_matches('/'))
    }

    fn special(&self, node: &str, names: &[&str]) -> Option<&str> {
        let rule = self.rules.iter().find(|rule| names.contains(&rule.from.as_str()) && rule.is_for(node))?;
        Some(&rule.to)
    }

    /// The absolute name of a topic after remapping, for a node with this namespace and name, to which its own
    /// remapping rules have been applied. Topics may be absolute, relative or private (`~/topic`).
    pub fn topic(&self, topic: &str, namespace: &str, node: &str) -> String {
        let full = expand(topic, namespace, node);
        self.rules
            .iter()
            .filter(|rule| !rule.from.starts_with("__") && rule.is_for(node))
            .find(|rule| expand(rule.from.trim_start_matches("rostopic://"), namespace, node) == full)
            .map_or(full, |rule| expand(&rule.to, namespace, node))
    }

    /// Values for the declared parameters: their defaults, then files and `-p` for this node, in the order given.
    /// Undeclared parameters are ignored as in rclcpp, because launch files give parameters to every node. They are
    /// returned as sentences to report, so that a misspelt name does not go unnoticed.
    ///
    /// # Errors
    /// A file cannot be read, or the value of a declared parameter is not a number.
    pub fn parameters(
        &self,
        declared: &[(&str, f64)],
        namespace: &str,
        node: &str,
    ) -> Result<(Values, Vec<String>), RosArgsError> {
        let mut values: Vec<(String, f64)> = declared.iter().map(|&(name, value)| (name.to_owned(), value)).collect();
        let mut ignored = Vec::new();
        for (name, value) in self.given(namespace, node)? {
            match (values.iter_mut().find(|(known, _)| *known == name), value.trim().parse()) {
                (Some(slot), Ok(number)) => slot.1 = number,
                (Some(_), Err(_)) => return Err(RosArgsError::NotANumber { name, value }),
                (None, _) if is_override(&name) => {}
                (None, _) if name == USE_SIM_TIME => {
                    if value != "false" {
                        ignored.push(format!("{USE_SIM_TIME} is ignored: times are those of this machine"));
                    }
                }
                (None, _) => {
                    let known = declared.iter().map(|(name, _)| *name).collect::<Vec<_>>().join(", ");
                    ignored.push(format!("parameter {name} is ignored, there are: {known}"));
                }
            }
        }
        Ok((values, ignored))
    }

    /// The quality of service that a user has chosen for the topics of a node, and the parameters that are for other
    /// topics, as sentences to report.
    ///
    /// # Errors
    /// A file cannot be read, or a policy does not have the value.
    pub fn qos_overrides(&self, namespace: &str, node: &str) -> Result<(QosOverrides, Vec<String>), RosArgsError> {
        let mut overrides = QosOverrides::default();
        for (name, value) in self.given(namespace, node)? {
            if is_override(&name) {
                overrides.take(name, value)?;
            }
        }
        let topics =
            Topic::ALL.map(|known| (Role::of_node(known), self.topic(topic::relative(known.name()), namespace, node)));
        let dropped = overrides.keep(|role, topic| topics.iter().any(|known| (known.0, &*known.1) == (role, topic)));
        let ignored =
            dropped.into_iter().map(|name| format!("parameter {name} is ignored: no such topic of this node"));
        Ok((overrides, ignored.collect()))
    }

    /// The least severity of the lines on `/rosout`; `None` if there are to be none.
    pub fn log_level(&self) -> Option<Severity> {
        (!self.without_rosout).then(|| self.log_level.unwrap_or(Severity::Info))
    }

    /// The parameters given for a node, as text, in the order given.
    fn given(&self, namespace: &str, node: &str) -> Result<Vec<(String, String)>, RosArgsError> {
        let mut given = Vec::new();
        for source in &self.sources {
            match source {
                ParameterSource::Value { node: only, name, value } => {
                    if only.as_deref().is_none_or(|only| only == node) {
                        given.push((name.clone(), value.clone()));
                    }
                }
                ParameterSource::File(path) => given.extend(params_file::read(path, namespace, node)?),
            }
        }
        Ok(given)
    }
}

/// Accepted without effect: lines on standard error are for the user who started the program.
const LOG_SWITCHES: [&str; 2] = ["stdout-logs", "external-lib-logs"];

/// A parameter that every ROS 2 node has; this node does not support simulated time.
pub(super) const USE_SIM_TIME: &str = "use_sim_time";

/// `LEVEL` or `LOGGER:=LEVEL`; the node has one logger.
fn parse_log_level(text: &str) -> Result<Severity, RosArgsError> {
    let level = text.split_once(":=").map_or(text, |(_, level)| level);
    Severity::parse(level).ok_or_else(|| RosArgsError::LogLevel { value: text.to_owned() })
}

impl Rule {
    fn parse(rule: &str) -> Result<Self, RosArgsError> {
        let malformed = || RosArgsError::Rule { rule: rule.to_owned() };
        let (from, to) = rule.split_once(":=").ok_or_else(malformed)?;
        let (node, from) = split_node(from);
        if from.is_empty() || to.is_empty() {
            return Err(malformed());
        }
        Ok(Self { node, from: from.to_owned(), to: to.to_owned() })
    }

    fn is_for(&self, node: &str) -> bool {
        self.node.as_deref().is_none_or(|only| only == node)
    }
}

fn parse_parameter(text: &str) -> Result<ParameterSource, RosArgsError> {
    let malformed = || RosArgsError::Parameter { text: text.to_owned() };
    let (name, value) = text.split_once(":=").ok_or_else(malformed)?;
    let (node, name) = split_node(name);
    if name.is_empty() {
        return Err(malformed());
    }
    Ok(ParameterSource::Value { node, name: name.to_owned(), value: value.to_owned() })
}

/// The node that an argument is for, if given, and the rest: `node:rest`. The colon of `scheme://` does not count.
fn split_node(text: &str) -> (Option<String>, &str) {
    match text.split_once(':') {
        Some((node, rest)) if !rest.starts_with("//") && !node.is_empty() => (Some(node.to_owned()), rest),
        _ => (None, text),
    }
}

/// The absolute form of a name.
fn expand(name: &str, namespace: &str, node: &str) -> String {
    let namespace = namespace.trim_end_matches('/');
    match (name.strip_prefix('~'), name.starts_with('/')) {
        (Some(rest), _) => format!("{namespace}/{node}/{}", rest.trim_start_matches('/')),
        (None, true) => name.to_owned(),
        (None, false) => format!("{namespace}/{name}"),
    }
}

#[cfg(test)]
mod tests {
    use std::io::Write;

    use super::*;

    fn split(line: &str) -> Result<(RosArgs, Vec<String>), RosArgsError> {
        RosArgs::split(line.split_whitespace().map(str::to_owned))
    }

    fn ros(line: &str) -> RosArgs {
        split(line).expect("well formed").0
    }

    #[test]
    fn the_rest_is_left_to_the_program() {
        let (ros, rest) =
            split("run a.toml --ros-args -r __node:=x -- --record d --ros-args --log-level debug").unwrap();
        assert_eq!(rest, ["run", "a.toml", "--record", "d"]);
        assert_eq!(ros.node_name("squealcast"), "x");
        assert_eq!(split("run a.toml").unwrap().0, RosArgs::default());
    }

    #[test]
    fn names_are_remapped() {
        let args = ros("--ros-args -r __node:=left -r __ns:=/rigs -r other:__ns:=/no");
        assert_eq!(args.node_name("squealcast"), "left");
        assert_eq!(args.namespace("squealcast", "/"), "/rigs");
        let args = ros("--ros-args -r squealcast:__ns:=a/b/");
        assert_eq!(args.namespace("squealcast", "/"), "/a/b");
        assert_eq!(args.namespace("rig", "/"), "/");
    }

    #[test]
    fn topics_are_remapped() {
        let args =
            ros("--ros-args -r /rig/operating_point:=/cell2/point --remap prediction:=out -r ~/rig:=/r -r rig:/x:=/y \
             -r rostopic:///a:=/b");
        let topic = |name| args.topic(name, "/ns", "squealcast");
        assert_eq!(topic("/rig/operating_point"), "/cell2/point");
        assert_eq!(topic("/ns/prediction"), "/ns/out");
        assert_eq!(topic("/ns/squealcast/rig"), "/r");
        assert_eq!(topic("/x"), "/x");
        assert_eq!(topic("/a"), "/b");
        assert_eq!(topic("/diagnostics"), "/diagnostics");
        assert_eq!(args.topic("/x", "/", "rig"), "/y");
    }

    #[test]
    fn the_first_rule_counts() {
        let args = ros("--ros-args -r /a:=/b -r /a:=/c -r /b:=/d");
        assert_eq!(args.topic("/a", "/", "n"), "/b");
    }

    #[test]
    fn later_parameters_win() {
        let mut file = tempfile::NamedTempFile::new().unwrap();
        write!(file, "/**:\n  ros__parameters:\n    use_sim_time: false\n    warn_margin: 0.2\n    dead_band: 3\n")
            .unwrap();
        let path = file.path().display();
        let declared = [("warn_margin", 0.05), ("dead_band", 0.0), ("silence_s", 1.0)];
        let args = ros(&format!(
            "--ros-args -p warn_margin:=0.1 --params-file {path} -p squealcast:dead_band:=4 -p rig:dead_band:=5 \
             -p use_sim_time:=false"
        ));
        let (values, ignored) = args.parameters(&declared, "/", "squealcast").unwrap();
        assert_eq!(ignored, Vec::<String>::new());
        assert_eq!(
            values,
            [("warn_margin".to_owned(), 0.2), ("dead_band".to_owned(), 4.0), ("silence_s".to_owned(), 1.0)]
        );
    }

    #[test]
    fn undeclared_parameters_are_ignored_and_said() {
        let mut file = tempfile::NamedTempFile::new().unwrap();
        let text = "/**:\n  ros__parameters:\n    start_type_description_service: false\n    frames: [a, b]\n    warn_margin: 0.2\n\
                    \x20   qos_overrides: {/parameter_events: {publisher: {depth: 10}}}\n";
        write!(file, "{text}").unwrap();
        let path = file.path().display();
        let args = ros(&format!("--ros-args --params-file {path} -p warn_margn:=wide -p use_sim_time:=true"));
        let (values, ignored) = args.parameters(&[("warn_margin", 0.0)], "/", "n").unwrap();
        assert_eq!(values, [("warn_margin".to_owned(), 0.2)]);
        assert_eq!(
            ignored,
            [
                "parameter start_type_description_service is ignored, there are: warn_margin",
                "parameter frames is ignored, there are: warn_margin",
                "parameter warn_margn is ignored, there are: warn_margin",
                "use_sim_time is ignored: times are those of this machine",
            ]
        );
    }

    #[test]
    fn quality_of_service_is_chosen_for_topics_of_the_node() {
        let args = ros(
            "--ros-args -r rig/operating_point:=conditions -p qos_overrides./left/conditions.subscription.depth:=7 \
             -p qos_overrides./parameter_events.publisher.depth:=10",
        );
        let (overrides, ignored) = args.qos_overrides("/left", "squealcast").expect("valid");
        assert_eq!(overrides.of(Role::Subscription, "/left/conditions").depth, Some(7));
        let name = "qos_overrides./parameter_events.publisher.depth";
        assert_eq!(ignored, [format!("parameter {name} is ignored: no such topic of this node")]);
    }

    #[test]
    fn lines_on_rosout_have_a_least_severity() {
        assert_eq!(ros("").log_level(), Some(Severity::Info));
        assert_eq!(ros("--ros-args --log-level squealcast:=warn").log_level(), Some(Severity::Warn));
        assert_eq!(ros("--ros-args --disable-rosout-logs").log_level(), None);
    }

    #[test]
    fn a_declared_parameter_must_be_a_number() {
        let error = |line: &str| ros(line).parameters(&[("x", 0.0)], "/", "n").expect_err("refused").to_string();
        assert_eq!(error("--ros-args -p x:=wide"), "parameter x: \"wide\" is no number");
        let mut file = tempfile::NamedTempFile::new().unwrap();
        write!(file, "/**: {{ros__parameters: {{x: [1, 2]}}}}").unwrap();
        let line = format!("--ros-args --params-file {}", file.path().display());
        assert_eq!(error(&line), "parameter x: \"a list, or nothing\" is no number");
    }

    #[test]
    fn malformed_arguments_are_refused_with_a_reason() {
        let error = |line: &str| split(line).expect_err("malformed").to_string();
        assert_eq!(error("--ros-args --nonsense"), "unknown ROS argument \"--nonsense\"");
        assert_eq!(error("--ros-args -r"), "ROS argument -r needs a value");
        assert_eq!(error("--ros-args -r a=b"), "\"a=b\" is no remapping rule from:=to");
        assert_eq!(error("--ros-args -r :=b"), "\":=b\" is no remapping rule from:=to");
        assert_eq!(error("--ros-args -p x"), "\"x\" is no parameter name:=value");
        let level = "expected DEBUG, INFO, WARN, ERROR or FATAL, or LOGGER:= and one of them";
        for wrong in ["nonsense", "squealcast:=loud", ""] {
            let error = RosArgs::split(["--ros-args", "--log-level", wrong].map(str::to_owned)).expect_err("malformed");
            assert_eq!(error.to_string(), format!("{wrong:?} is no log level, {level}"));
        }
        assert!(split("--ros-args --log-level info --log-level squealcast:=WARN").is_ok());
        assert!(split("--ros-args --disable-rosout-logs --enable-stdout-logs -e /x").is_ok());
    }

    proptest::proptest! {
        #[test]
        fn no_arguments_panic(args: Vec<String>) {
            let _ = RosArgs::split(std::iter::once("--ros-args".to_owned()).chain(args));
        }

        #[test]
        fn no_rule_panics(rule: String, name: String) {
            if let Ok((args, _)) = RosArgs::split(["--ros-args".to_owned(), "-r".to_owned(), rule]) {
                args.topic(&name, "/", "n");
            }
        }
    }
}

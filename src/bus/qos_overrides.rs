//! Quality of service that a user chooses for a topic, by parameters as in rclcpp:
//!
//! ```yaml
//! qos_overrides:
//!   /rig/operating_point:
//!     subscription: {reliability: best_effort, depth: 10}
//! ```

use super::ros_args::RosArgsError;
use crate::msgs::schema::Topic;

/// What the names of these parameters begin with.
const PREFIX: &str = "qos_overrides.";
/// Greatest depth of a history that is accepted.
const MAX_DEPTH: i32 = 1 << 15;
/// Policies that rclcpp knows and that are not selectable here.
const NOT_SELECTABLE: [&str; 5] =
    ["deadline", "lifespan", "liveliness", "liveliness_lease_duration", "avoid_ros_namespace_conventions"];

/// Which end of a topic is meant.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Role {
    Publisher,
    Subscription,
}

impl Role {
    /// The end of `topic` that a node has.
    pub fn of_node(topic: Topic) -> Self {
        match topic {
            Topic::OperatingPoint | Topic::Vibration | Topic::Waveform | Topic::Temperature => Self::Subscription,
            Topic::Prediction
            | Topic::SessionEvent
            | Topic::RigInfo
            | Topic::Sensitivity
            | Topic::Diagnostics
            | Topic::Heard => Self::Publisher,
        }
    }

    fn name(self) -> &'static str {
        match self {
            Self::Publisher => "publisher",
            Self::Subscription => "subscription",
        }
    }
}

/// The policies chosen for one end of a topic; `None` keeps the node's own.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Chosen {
    pub best_effort: Option<bool>,
    pub transient_local: Option<bool>,
    pub keep_all: Option<bool>,
    pub depth: Option<i32>,
}

/// One parameter: its name and value, and the end of the topic it is for.
#[derive(Clone, Debug, PartialEq, Eq)]
struct Override {
    parameter: String,
    value: String,
    topic: String,
    role: Role,
    chosen: Chosen,
}

/// The policies that a user has chosen.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct QosOverrides(Vec<Override>);

/// Whether a parameter chooses a quality of service.
pub(super) fn is_override(parameter: &str) -> bool {
    parameter.starts_with(PREFIX)
}

impl QosOverrides {
    /// Takes a parameter whose name [`is_override`]. A later value overrides an earlier one.
    ///
    /// # Errors
    /// A value that the policy does not have.
    pub(super) fn take(&mut self, parameter: String, value: String) -> Result<(), RosArgsError> {
        if let Some(found) = Override::parse(parameter, value)? {
            self.0.retain(|other| other.parameter != found.parameter);
            self.0.push(found);
        }
        Ok(())
    }

    /// What was chosen for one end of a topic, whose name is absolute and remapped.
    pub fn of(&self, role: Role, topic: &str) -> Chosen {
        let of_topic = self.0.iter().filter(|one| one.role == role && one.topic == topic);
        of_topic.fold(Chosen::default(), |sum, one| Chosen {
            best_effort: one.chosen.best_effort.or(sum.best_effort),
            transient_local: one.chosen.transient_local.or(sum.transient_local),
            keep_all: one.chosen.keep_all.or(sum.keep_all),
            depth: one.chosen.depth.or(sum.depth),
        })
    }

    /// Drops what is for other topics than those a node `has`. Returns the names of these parameters.
    pub(super) fn keep(&mut self, has: impl Fn(Role, &str) -> bool) -> Vec<String> {
        let foreign = |one: &Override| !has(one.role, &one.topic);
        let dropped = self.0.iter().filter(|one| foreign(one)).map(|one| one.parameter.clone()).collect();
        self.0.retain(|one| !foreign(one));
        dropped
    }

    /// The parameters, by name, with their values.
    pub fn parameters(&self) -> impl Iterator<Item = (&str, &str)> {
        self.0.iter().map(|one| (one.parameter.as_str(), one.value.as_str()))
    }
}

impl Override {
    /// `qos_overrides./topic.subscription.policy`, where the subscription may have an id: `subscription_id`. `None` if
    /// the value keeps the node's own policy, or for another parameter.
    fn parse(parameter: String, value: String) -> Result<Option<Self>, RosArgsError> {
        let refused =
            |expected: &'static str| RosArgsError::Qos { parameter: parameter.clone(), value: value.clone(), expected };
        const SHAPE: &str = "a name qos_overrides./TOPIC.publisher.POLICY or qos_overrides./TOPIC.subscription.POLICY";
        let rest = parameter.strip_prefix(PREFIX).ok_or_else(|| refused(SHAPE))?;
        let (rest, policy) = rest.rsplit_once('.').ok_or_else(|| refused(SHAPE))?;
        let (topic, entity) = rest.rsplit_once('.').ok_or_else(|| refused(SHAPE))?;
        let is = |role: Role| entity == role.name() || entity.starts_with(&format!("{}_", role.name()));
        let role = [Role::Publisher, Role::Subscription].into_iter().find(|role| is(*role));
        let role = role.ok_or_else(|| refused(SHAPE))?;
        let one_of = |no: &'static str, yes: &'static str, expected| match value.as_str() {
            text if text == no => Ok(Some(false)),
            text if text == yes => Ok(Some(true)),
            "system_default" => Ok(None),
            _ => Err(refused(expected)),
        };
        let mut chosen = Chosen::default();
        match policy {
            "reliability" => chosen.best_effort = one_of("reliable", "best_effort", "reliable or best_effort")?,
            "durability" => {
                chosen.transient_local = one_of("volatile", "transient_local", "volatile or transient_local")?;
            }
            "history" => chosen.keep_all = one_of("keep_last", "keep_all", "keep_last or keep_all")?,
            "depth" => {
                let depth = value.parse().ok().filter(|depth| (1..=MAX_DEPTH).contains(depth));
                chosen.depth = Some(depth.ok_or_else(|| refused("a whole number from 1 to 32768"))?);
            }
            policy if NOT_SELECTABLE.contains(&policy) => {
                return Err(refused("reliability, durability, history or depth; other policies cannot be chosen"));
            }
            _ => return Err(refused("a policy: reliability, durability, history or depth")),
        }
        let topic = topic.to_owned();
        Ok((chosen != Chosen::default()).then_some(Self { parameter, value, topic, role, chosen }))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn overrides(parameters: &[(&str, &str)]) -> Result<QosOverrides, RosArgsError> {
        let mut found = QosOverrides::default();
        for (name, value) in parameters {
            found.take(format!("{PREFIX}{name}"), (*value).to_owned())?;
        }
        Ok(found)
    }

    #[test]
    fn policies_are_chosen_for_one_end_of_one_topic() {
        let found = overrides(&[
            ("/rig/operating_point.subscription.reliability", "reliable"),
            ("/rig/operating_point.subscription.depth", "10"),
            ("/rig/operating_point.subscription.reliability", "best_effort"),
            ("/left/squealcast/prediction.publisher.history", "keep_all"),
            ("/left/squealcast/prediction.publisher.durability", "transient_local"),
            ("/left/squealcast/prediction.publisher.reliability", "system_default"),
        ])
        .expect("valid");
        let input = found.of(Role::Subscription, "/rig/operating_point");
        assert_eq!(input, Chosen { best_effort: Some(true), depth: Some(10), ..Chosen::default() });
        let output = found.of(Role::Publisher, "/left/squealcast/prediction");
        assert_eq!(output, Chosen { keep_all: Some(true), transient_local: Some(true), ..Chosen::default() });
        assert_eq!(found.of(Role::Publisher, "/rig/operating_point"), Chosen::default());
    }

    #[test]
    fn what_is_for_other_topics_is_dropped_and_named() {
        let mut found =
            overrides(&[("/parameter_events.publisher.depth", "1000"), ("/x.subscription_mine.depth", "1")])
                .expect("valid");
        assert_eq!(
            found.keep(|role, topic| (role, topic) == (Role::Subscription, "/x")),
            ["qos_overrides./parameter_events.publisher.depth"]
        );
        assert_eq!(found.parameters().collect::<Vec<_>>(), [("qos_overrides./x.subscription_mine.depth", "1")]);
    }

    #[test]
    fn values_that_a_policy_does_not_have_are_refused() {
        for (name, value) in [
            ("/x.subscription.reliability", "fast"),
            ("/x.subscription.depth", "0"),
            ("/x.subscription.depth", "many"),
            ("/x.subscription.deadline", "5"),
            ("/x.subscription.colour", "red"),
            ("/x.reader.depth", "5"),
            ("/x", "5"),
        ] {
            let error = overrides(&[(name, value)]).expect_err(name).to_string();
            assert!(error.starts_with(&format!("parameter {PREFIX}{name}: \"{value}\", expected ")), "{error}");
        }
    }
}

//! The parameters of a node, and the services that list, describe, get and set them. Those of ros2-client know neither
//! descriptions nor ranges.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use ros2_client::parameters::raw::{FloatingPointRange, ParameterDescriptor, ParameterType};
use ros2_client::rcl_interfaces::{
    DescribeParametersRequest, DescribeParametersResponse, GetParameterTypesRequest, GetParameterTypesResponse,
    GetParametersRequest, GetParametersResponse, ListParametersRequest, ListParametersResponse, ListParametersResult,
    SetParametersAtomicallyResponse, SetParametersRequest, SetParametersResponse,
};
use ros2_client::{NodeOptions, Parameter, ParameterValue, ServiceTypeName};
use serde::de::DeserializeOwned;

use super::Ros2Error;
use super::link::{Hearing, Link, MAX_ANSWER, SharedNode};
use crate::bus::qos_overrides::QosOverrides;
use crate::bus::ros_args::USE_SIM_TIME;

/// Validates a parameter value before it is accepted; the error text is sent to the peer.
pub type Validate = Box<dyn Fn(&str, f64) -> Result<(), String> + Send + Sync>;
/// Receives a parameter value after it was accepted.
pub type Accepted = Box<dyn Fn(&str, f64) + Send + Sync>;
/// What a parameter is, and the closed range of its values; `None` for one that has no description.
pub type Describe = fn(&str) -> Option<(&'static str, [f64; 2])>;

/// The parameters of the node.
pub struct Parameters {
    /// Names and initial values (see [`RosArgs::parameters`]).
    ///
    /// [`RosArgs::parameters`]: crate::bus::ros_args::RosArgs::parameters
    pub values: Vec<(String, f64)>,
    pub describe: Describe,
    /// Called for every value, including the initial ones.
    pub validate: Validate,
    /// Called on the node's thread for every value that a peer has set and `validate` accepted.
    pub accepted: Accepted,
}

/// Decides whether a parameter may get a value.
type Judge = dyn Fn(&str, &ParameterValue) -> Result<(), String> + Send + Sync;

impl Parameters {
    /// No parameters.
    pub fn none() -> Self {
        Self {
            values: Vec::new(),
            describe: |_| None,
            validate: Box::new(|_, _| Ok(())),
            accepted: Box::new(|_, _| ()),
        }
    }

    /// Node options with these parameters and those of `overrides`, which cannot be changed. `accepted` is only called
    /// once `started` is set: before that the node sets the initial values.
    pub(super) fn declare(self, started: Arc<AtomicBool>, overrides: &QosOverrides) -> (NodeOptions, Services) {
        let Self { values, describe, validate, accepted } = self;
        let read_only: Vec<String> = overrides.parameters().map(|(name, _)| name.to_owned()).collect();
        let (at_start, kept) = (started.clone(), read_only.clone());
        let judge: Arc<Judge> = Arc::new(move |name, value| match value {
            _ if kept.iter().any(|known| known == name) => {
                if at_start.load(Ordering::Acquire) {
                    Err(format!("{name} is read-only"))
                } else {
                    Ok(())
                }
            }
            ParameterValue::Double(value) if !value.is_finite() => Err(format!("{name}: {value} is not finite")),
            ParameterValue::Double(value) => validate(name, *value),
            ParameterValue::NotSet => Err(format!("{name} cannot be removed")),
            _ => Err(format!("{name} is a double")),
        });
        let judged = judge.clone();
        let options = NodeOptions::new()
            // Its own has a history of one line.
            .enable_rosout(false)
            .start_parameter_services(false)
            .parameter_validator(Box::new(move |name, value| judged(name, value)))
            .parameter_set_action(Box::new(move |name, value| {
                if let (ParameterValue::Double(value), true) = (value, started.load(Ordering::Acquire)) {
                    accepted(name, *value);
                }
                Ok(())
            }));
        let options = values
            .iter()
            .filter(|(name, _)| name != USE_SIM_TIME)
            .fold(options, |options, (name, value)| options.declare_parameter(name, ParameterValue::Double(*value)));
        let options = overrides.parameters().fold(options, |options, (name, value)| {
            let value =
                value.parse().map_or_else(|_| ParameterValue::String(value.to_owned()), ParameterValue::Integer);
            options.declare_parameter(name, value)
        });
        (options, Services { judge, describe, read_only })
    }
}

/// What the parameter services need beside the node, which holds the values.
#[derive(Clone)]
pub(super) struct Services {
    judge: Arc<Judge>,
    describe: Describe,
    read_only: Vec<String>,
}

impl Services {
    /// Adds the six services to the node of `link`; they answer while the future runs.
    pub(super) fn add<M: DeserializeOwned + Send + Sync + 'static>(
        self,
        link: &mut Link<M>,
    ) -> Result<Hearing, Ros2Error> {
        fn kind(name: &str) -> ServiceTypeName {
            ServiceTypeName::new("rcl_interfaces", name)
        }
        let node = link.shared_node();
        let list = link.service("list_parameters", &kind("ListParameters"), {
            let node = node.clone();
            move |asked: ListParametersRequest| {
                let names = node.lock().list_parameters();
                ListParametersResponse { result: listed(names, &asked.prefixes, asked.depth) }
            }
        })?;
        let get = link.service("get_parameters", &kind("GetParameters"), {
            let node = node.clone();
            move |asked: GetParametersRequest| {
                let node = node.lock();
                let value = |name: &String| node.get_parameter(name).unwrap_or(ParameterValue::NotSet).into();
                GetParametersResponse { values: asked.names.iter().map(value).collect() }
            }
        })?;
        let types = link.service("get_parameter_types", &kind("GetParameterTypes"), {
            let node = node.clone();
            move |asked: GetParameterTypesRequest| {
                let node = node.lock();
                GetParameterTypesResponse { values: asked.names.iter().map(|name| type_of(&node, name)).collect() }
            }
        })?;
        let describe = link.service("describe_parameters", &kind("DescribeParameters"), {
            let (node, services) = (node.clone(), self.clone());
            move |asked: DescribeParametersRequest| {
                let node = node.lock();
                let values = asked.names.into_iter().map(|name| services.descriptor(&node, name)).collect();
                short_enough(DescribeParametersResponse { values })
            }
        })?;
        let set = link.service("set_parameters", &kind("SetParameters"), {
            let node = node.clone();
            move |asked: SetParametersRequest| {
                let results = asked.parameter.into_iter().map(|wish| set(&node, wish.into()).into()).collect();
                SetParametersResponse { results }
            }
        })?;
        let atomically = link.service(
            "set_parameters_atomically",
            &kind("SetParametersAtomically"),
            move |asked: SetParametersRequest| {
                let wishes: Vec<Parameter> = asked.parameter.into_iter().map(Parameter::from).collect();
                SetParametersAtomicallyResponse { result: self.set_all(&node, wishes).into() }
            },
        )?;
        Ok(Box::pin(async move {
            tokio::join!(list, get, types, describe, set, atomically);
        }))
    }

    fn descriptor(&self, node: &ros2_client::Node, name: String) -> ParameterDescriptor {
        let r#type = type_of(node, &name);
        let (description, range) = match (self.describe)(&name) {
            Some((description, [from_value, to_value])) => {
                // A step of 0: every value of the range.
                (description, vec![FloatingPointRange { from_value, to_value, step: 0.0 }])
            }
            None if name == USE_SIM_TIME => ("not supported: times are those of this machine", vec![]),
            None if self.read_only.contains(&name) => ("quality of service, chosen at the start", vec![]),
            None => ("", vec![]),
        };
        ParameterDescriptor {
            r#type,
            description: description.to_owned(),
            additional_constraints: String::new(),
            read_only: name == USE_SIM_TIME || self.read_only.contains(&name),
            dynamic_typing: false,
            integer_range: vec![],
            floating_point_range: range,
            name,
        }
    }

    /// Sets all parameters, or none if one of them is refused.
    fn set_all(&self, node: &SharedNode, wishes: Vec<Parameter>) -> Result<(), String> {
        for Parameter { name, value } in &wishes {
            if !node.lock().has_parameter(name) {
                return Err(undeclared(name));
            }
            if name == USE_SIM_TIME { sim_time(value) } else { (self.judge)(name, value) }?;
        }
        wishes.into_iter().try_for_each(|wish| set(node, wish))
    }
}

fn set(node: &SharedNode, Parameter { name, value }: Parameter) -> Result<(), String> {
    if name == USE_SIM_TIME {
        return sim_time(&value);
    }
    let node = node.lock();
    if node.has_parameter(&name) { node.set_parameter(&name, value) } else { Err(undeclared(&name)) }
}

fn undeclared(name: &str) -> String {
    format!("there is no parameter {name}")
}

/// The answer without descriptions, if it is too long with them.
fn short_enough(mut answer: DescribeParametersResponse) -> DescribeParametersResponse {
    if crate::msgs::to_cdr(&answer).is_ok_and(|cdr| cdr.len() > MAX_ANSWER) {
        answer.values.iter_mut().for_each(|value| value.description.clear());
    }
    answer
}

/// `use_sim_time` stays false.
fn sim_time(value: &ParameterValue) -> Result<(), String> {
    match value {
        ParameterValue::Boolean(false) => Ok(()),
        _ => Err(format!("{USE_SIM_TIME} is not supported: times are those of this machine")),
    }
}

fn type_of(node: &ros2_client::Node, name: &str) -> u8 {
    node.get_parameter(name).map_or(ParameterType::NOT_SET, |value| value.to_parameter_type() as u8)
}

/// The names below one of the `prefixes`, with fewer than `depth` dots after it, as rclcpp lists them; all names without
/// prefixes, and any depth if that is 0.
fn listed(names: Vec<String>, prefixes: &[String], depth: u64) -> ListParametersResult {
    let within = |name: &str| depth == 0 || (name.matches('.').count() as u64) < depth;
    let below = |name: &str, prefix: &String| {
        name == prefix || name.strip_prefix(prefix).and_then(|rest| rest.strip_prefix('.')).is_some_and(within)
    };
    let wanted = |name: &String| match prefixes {
        [] => within(name),
        prefixes => prefixes.iter().any(|prefix| below(name, prefix)),
    };
    let names: Vec<String> = names.into_iter().filter(wanted).collect();
    let mut prefixes: Vec<String> = names.iter().filter_map(|name| Some(name.rsplit_once('.')?.0.to_owned())).collect();
    prefixes.sort_unstable();
    prefixes.dedup();
    ListParametersResult { names, prefixes }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn descriptions_are_left_out_of_an_answer_that_would_be_too_long() {
        let value = |k: usize| ParameterDescriptor {
            name: format!("parameter_{k}"),
            r#type: ParameterType::DOUBLE,
            description: "what it is, in a sentence of some length that says it all".to_owned(),
            additional_constraints: String::new(),
            read_only: false,
            dynamic_typing: false,
            integer_range: vec![],
            floating_point_range: vec![FloatingPointRange { from_value: 0.0, to_value: 1.0, step: 0.0 }],
        };
        for (count, described) in [(1, true), (6, true), (10, false)] {
            let answer = short_enough(DescribeParametersResponse { values: (0..count).map(value).collect() });
            assert_eq!(answer.values.iter().all(|value| value.description.is_empty()), !described, "{count}");
            let bytes = crate::msgs::to_cdr(&answer).expect("encoded").len();
            assert!(bytes <= MAX_ANSWER, "{count}: {bytes}");
        }
    }

    #[test]
    fn names_are_listed_by_prefix_and_depth() {
        let names = ["a", "b.c", "b.d.e", "bc.d"].map(str::to_owned).to_vec();
        let list = |prefixes: &[&str], depth| {
            let prefixes: Vec<String> = prefixes.iter().map(|prefix| (*prefix).to_owned()).collect();
            let found = listed(names.clone(), &prefixes, depth);
            (found.names.join(" "), found.prefixes.join(" "))
        };
        let expect = |names: &str, prefixes: &str| (names.to_owned(), prefixes.to_owned());
        assert_eq!(list(&[], 0), expect("a b.c b.d.e bc.d", "b b.d bc"));
        assert_eq!(list(&[], 1), expect("a", ""));
        assert_eq!(list(&[], 2), expect("a b.c bc.d", "b bc"));
        assert_eq!(list(&["b"], 0), expect("b.c b.d.e", "b b.d"));
        assert_eq!(list(&["b"], 1), expect("b.c", "b"));
        assert_eq!(list(&["a", "bc"], 1), expect("a bc.d", "bc"));
    }
}

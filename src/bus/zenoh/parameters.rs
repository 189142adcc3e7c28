//! The parameter services of a node, answered from its parameters: numbers that can be set, and the choice of quality of
//! service, which cannot.

use std::sync::{Mutex, MutexGuard, PoisonError};

use serde::{Deserialize, Serialize};

use crate::bus::qos_overrides::QosOverrides;
use crate::bus::ros2::Parameters;

/// Numbers of types in `rcl_interfaces/ParameterType`.
const NOT_SET: u8 = 0;
const INTEGER: u8 = 2;
const DOUBLE: u8 = 3;
const STRING: u8 = 4;

/// `rcl_interfaces/ParameterValue`.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub(super) struct Value {
    pub kind: u8,
    pub bool_value: bool,
    pub integer_value: i64,
    pub double_value: f64,
    pub string_value: String,
    pub byte_array_value: Vec<u8>,
    pub bool_array_value: Vec<bool>,
    pub integer_array_value: Vec<i64>,
    pub double_array_value: Vec<f64>,
    pub string_array_value: Vec<String>,
}

/// `rcl_interfaces/Parameter`.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub(super) struct Parameter {
    pub name: String,
    pub value: Value,
}

/// `rcl_interfaces/SetParametersResult`.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct Outcome {
    pub successful: bool,
    pub reason: String,
}

/// `rcl_interfaces/FloatingPointRange`.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub(super) struct FloatingPointRange {
    from_value: f64,
    to_value: f64,
    step: f64,
}

/// `rcl_interfaces/IntegerRange`.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct IntegerRange {
    from_value: i64,
    to_value: i64,
    step: u64,
}

/// `rcl_interfaces/ParameterDescriptor`.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub(super) struct Descriptor {
    pub name: String,
    pub kind: u8,
    pub description: String,
    pub additional_constraints: String,
    pub read_only: bool,
    pub dynamic_typing: bool,
    pub floating_point_range: Vec<FloatingPointRange>,
    pub integer_range: Vec<IntegerRange>,
}

/// Request of the services that take names.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub(super) struct Names {
    pub names: Vec<String>,
}

/// Request of `ListParameters`.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub(super) struct Prefixes {
    pub prefixes: Vec<String>,
    /// Levels of names below a prefix; ours have one level.
    pub depth: u64,
}

/// Response of `ListParameters`.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct Listed {
    pub names: Vec<String>,
    pub prefixes: Vec<String>,
}

/// Request of the services that set parameters.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub(super) struct Wishes {
    pub parameters: Vec<Parameter>,
}

/// The parameters of a node.
pub(super) struct Store {
    parameters: Parameters,
    /// Present values.
    values: Mutex<Vec<(String, f64)>>,
    read_only: Vec<(String, Value)>,
}

impl Store {
    pub(super) fn new(mut parameters: Parameters, overrides: &QosOverrides) -> Self {
        let values = Mutex::new(std::mem::take(&mut parameters.values));
        let value = |text: &str| match text.parse() {
            Ok(integer_value) => Value { kind: INTEGER, integer_value, ..Value::default() },
            Err(_) => Value { kind: STRING, string_value: text.to_owned(), ..Value::default() },
        };
        let read_only = overrides.parameters().map(|(name, text)| (name.to_owned(), value(text))).collect();
        Self { parameters, values, read_only }
    }

    fn values(&self) -> MutexGuard<'_, Vec<(String, f64)>> {
        self.values.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Takes over a value that was set elsewhere, without passing it on.
    pub(super) fn take_over(&self, name: &str, value: f64) {
        if let Some((_, slot)) = self.values().iter_mut().find(|(known, _)| known == name) {
            *slot = value;
        }
    }

    /// The value of a parameter; one of the type `NOT_SET` if there is none of this name.
    fn value(&self, name: &str) -> Value {
        let read_only = || self.read_only.iter().find(|(known, _)| known == name).map(|(_, value)| value.clone());
        match self.values().iter().find(|(known, _)| known == name) {
            Some(&(_, double_value)) => Value { kind: DOUBLE, double_value, ..Value::default() },
            None => read_only().unwrap_or(Value { kind: NOT_SET, ..Value::default() }),
        }
    }

    pub(super) fn get(&self, request: &Names) -> Vec<Value> {
        request.names.iter().map(|name| self.value(name)).collect()
    }

    pub(super) fn types(&self, request: &Names) -> Vec<u8> {
        request.names.iter().map(|name| self.value(name).kind).collect()
    }

    pub(super) fn list(&self, request: &Prefixes) -> Listed {
        let wanted = |name: &str| request.prefixes.is_empty() || request.prefixes.iter().any(|prefix| prefix == name);
        let values = self.values();
        let all = values.iter().map(|(name, _)| name).chain(self.read_only.iter().map(|(name, _)| name));
        Listed { names: all.filter(|name| wanted(name)).cloned().collect(), prefixes: vec![] }
    }

    pub(super) fn describe(&self, request: &Names) -> Vec<Descriptor> {
        let kinds = self.types(request);
        let described = request.names.iter().zip(kinds);
        described.map(|(name, kind)| self.descriptor(name, kind)).collect()
    }

    fn descriptor(&self, name: &str, kind: u8) -> Descriptor {
        let (description, range) = (self.parameters.describe)(name).filter(|_| kind != NOT_SET).unzip();
        let range = range.map(|[from_value, to_value]| FloatingPointRange { from_value, to_value, step: 0.0 });
        Descriptor {
            name: name.to_owned(),
            kind,
            description: description.unwrap_or_default().to_owned(),
            floating_point_range: range.into_iter().collect(),
            read_only: self.read_only.iter().any(|(known, _)| known == name),
            ..Descriptor::default()
        }
    }

    /// Sets each parameter that can be set.
    pub(super) fn set(&self, request: &Wishes) -> Vec<Outcome> {
        request.parameters.iter().map(|parameter| self.set_all(std::slice::from_ref(parameter))).collect()
    }

    /// Sets all parameters, or none.
    pub(super) fn set_all(&self, parameters: &[Parameter]) -> Outcome {
        // Held throughout, so that changes are passed on in their order.
        let mut values = self.values();
        for parameter in parameters {
            if let Err(reason) = self.check(&values, parameter) {
                return Outcome { successful: false, reason };
            }
        }
        for Parameter { name, value } in parameters {
            if let Some((_, slot)) = values.iter_mut().find(|(known, _)| known == name) {
                *slot = value.double_value;
                (self.parameters.accepted)(name, value.double_value);
            }
        }
        Outcome { successful: true, reason: String::new() }
    }

    fn check(&self, values: &[(String, f64)], parameter: &Parameter) -> Result<(), String> {
        let Parameter { name, value } = parameter;
        if self.read_only.iter().any(|(known, _)| known == name) {
            return Err(format!("{name} is read-only"));
        }
        if !values.iter().any(|(known, _)| known == name) {
            return Err(format!("{name} is no parameter of this node"));
        }
        match value.kind {
            DOUBLE if value.double_value.is_finite() => (self.parameters.validate)(name, value.double_value),
            DOUBLE => Err(format!("{name}: {} is not finite", value.double_value)),
            NOT_SET => Err(format!("{name} cannot be removed")),
            _ => Err(format!("{name} is a double")),
        }
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;

    fn wish(name: &str, double_value: f64) -> Parameter {
        Parameter { name: name.to_owned(), value: Value { kind: DOUBLE, double_value, ..Value::default() } }
    }

    #[test]
    fn parameters_are_set_together_or_not_at_all() {
        let accepted = Arc::new(Mutex::new(vec![]));
        let seen = accepted.clone();
        let parameters = Parameters {
            values: vec![("a".to_owned(), 1.0), ("b".to_owned(), 2.0)],
            describe: |name| (name == "a").then_some(("the first", [0.0, 10.0])),
            validate: Box::new(|name, value| if value < 10.0 { Ok(()) } else { Err(format!("{name} too large")) }),
            accepted: Box::new(move |name, value| seen.lock().expect("a lock").push((name.to_owned(), value))),
        };
        let store = Store::new(parameters, &QosOverrides::default());
        let names = |names: &[&str]| Names { names: names.iter().map(|&name| name.to_owned()).collect() };
        let outcomes = store.set(&Wishes { parameters: vec![wish("a", 3.0), wish("b", 11.0), wish("c", 0.0)] });
        assert_eq!(outcomes.iter().map(|outcome| outcome.successful).collect::<Vec<_>>(), [true, false, false]);
        assert_eq!(
            (outcomes[1].reason.as_str(), outcomes[2].reason.as_str()),
            ("b too large", "c is no parameter of this node")
        );
        assert!(!store.set_all(&[wish("a", 4.0), wish("b", f64::NAN)]).successful);
        let text = Parameter { value: Value { kind: 4, ..Value::default() }, ..wish("a", 0.0) };
        assert_eq!(store.set_all(&[text]).reason, "a is a double");
        assert!(store.set_all(&[wish("a", 5.0), wish("b", 6.0)]).successful);
        let values: Vec<(u8, f64)> =
            store.get(&names(&["b", "x", "a"])).iter().map(|value| (value.kind, value.double_value)).collect();
        assert_eq!(values, [(DOUBLE, 6.0), (NOT_SET, 0.0), (DOUBLE, 5.0)]);
        assert_eq!(store.types(&names(&["x", "a"])), [NOT_SET, DOUBLE]);
        let described = store.describe(&names(&["a", "x"]));
        assert_eq!((described[0].kind, described[0].description.as_str()), (DOUBLE, "the first"));
        assert_eq!(described[0].floating_point_range[0].to_value, 10.0);
        assert_eq!((described[1].kind, described[1].floating_point_range.len()), (NOT_SET, 0));
        let listed = |prefixes: &[&str]| {
            store.list(&Prefixes { prefixes: prefixes.iter().map(|&p| p.to_owned()).collect(), depth: 0 }).names
        };
        assert_eq!((listed(&[]), listed(&["b", "z"])), (vec!["a".to_owned(), "b".to_owned()], vec!["b".to_owned()]));
        store.take_over("b", 7.0);
        assert_eq!(store.get(&names(&["b"]))[0].double_value, 7.0);
        let expected = [("a", 3.0), ("a", 5.0), ("b", 6.0)].map(|(name, value)| (name.to_owned(), value));
        assert_eq!(*accepted.lock().expect("a lock"), expected);
    }

    #[test]
    fn a_chosen_quality_of_service_is_listed_and_kept() {
        let mut overrides = QosOverrides::default();
        for (name, value) in [("depth", "10"), ("reliability", "best_effort")] {
            let name = format!("qos_overrides./x.publisher.{name}");
            overrides.take(name, value.to_owned()).expect("valid");
        }
        let store = Store::new(Parameters::none(), &overrides);
        let listed = store.list(&Prefixes::default()).names;
        assert_eq!(listed.len(), 2);
        let names = Names { names: listed.clone() };
        assert_eq!(store.types(&names), [INTEGER, STRING]);
        assert_eq!((store.get(&names)[0].integer_value, &*store.get(&names)[1].string_value), (10, "best_effort"));
        assert!(store.describe(&names).iter().all(|described| described.read_only));
        let refused = store.set_all(&[wish(&listed[0], 5.0)]);
        assert_eq!(refused.reason, format!("{} is read-only", listed[0]));
    }
}

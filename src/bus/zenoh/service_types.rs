//! The services of a node, and the hashes of their types and of messages that are not among our topics.

use crate::bus::{managed, type_descriptions};
use crate::msgs::type_description::{DefinitionError, TypeDescription};

/// A service that a node offers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Service {
    GetParameters,
    GetParameterTypes,
    SetParameters,
    SetParametersAtomically,
    ListParameters,
    DescribeParameters,
    GetTypeDescription,
    ChangeState,
    GetState,
    GetAvailableStates,
    GetAvailableTransitions,
    GetTransitionGraph,
}

/// These messages, and those that requests and responses refer to.
const MESSAGES: [(&str, &str); 20] = [
    ("builtin_interfaces/Time", "int32 sec\nuint32 nanosec"),
    (
        "service_msgs/ServiceEventInfo",
        "uint8 event_type\nbuiltin_interfaces/Time stamp\nchar[16] client_gid\nint64 sequence_number",
    ),
    ("rcl_interfaces/Parameter", "string name\nParameterValue value"),
    (
        "rcl_interfaces/ParameterValue",
        "uint8 type\nbool bool_value\nint64 integer_value\nfloat64 double_value\nstring string_value\n\
         byte[] byte_array_value\nbool[] bool_array_value\nint64[] integer_array_value\nfloat64[] double_array_value\n\
         string[] string_array_value",
    ),
    (
        "rcl_interfaces/ParameterDescriptor",
        "string name\nuint8 type\nstring description\nstring additional_constraints\nbool read_only false\n\
         bool dynamic_typing false\nFloatingPointRange[<=1] floating_point_range\nIntegerRange[<=1] integer_range",
    ),
    ("rcl_interfaces/FloatingPointRange", "float64 from_value\nfloat64 to_value\nfloat64 step"),
    ("rcl_interfaces/IntegerRange", "int64 from_value\nint64 to_value\nuint64 step"),
    ("rcl_interfaces/ListParametersResult", "string[] names\nstring[] prefixes"),
    ("rcl_interfaces/SetParametersResult", "bool successful\nstring reason"),
    (
        "type_description_interfaces/FieldType",
        "uint8 type_id 0\nuint64 capacity\nuint64 string_capacity\nstring<=255 nested_type_name",
    ),
    ("type_description_interfaces/Field", "string name\nFieldType type\nstring default_value"),
    ("type_description_interfaces/IndividualTypeDescription", "string<=255 type_name\nField[] fields"),
    (
        "type_description_interfaces/TypeDescription",
        "IndividualTypeDescription type_description\nIndividualTypeDescription[] referenced_type_descriptions",
    ),
    ("type_description_interfaces/TypeSource", "string type_name\nstring encoding\nstring raw_file_contents"),
    ("type_description_interfaces/KeyValue", "string key\nstring value"),
    (
        "rcl_interfaces/Log",
        "builtin_interfaces/Time stamp\nuint8 level\nstring name\nstring msg\nstring file\nstring function\nuint32 line",
    ),
    ("lifecycle_msgs/State", "uint8 id\nstring label"),
    ("lifecycle_msgs/Transition", "uint8 id\nstring label"),
    ("lifecycle_msgs/TransitionDescription", "Transition transition\nState start_state\nState goal_state"),
    ("lifecycle_msgs/TransitionEvent", "uint64 timestamp\nTransition transition\nState start_state\nState goal_state"),
];

/// What rosidl makes of an empty request.
const NOTHING: &str = "uint8 structure_needs_at_least_one_member";
/// Messages that a node publishes beside its topics.
pub(super) const LOG: &str = "rcl_interfaces/Log";
pub(super) const EVENT: &str = "lifecycle_msgs/TransitionEvent";

/// `package/msg/Type` and the hash of one of [`MESSAGES`], given as `package/Type`.
pub(super) fn message(short: &str) -> Result<(String, String), DefinitionError> {
    let name = short.replace('/', "/msg/");
    let definition = MESSAGES.iter().find(|(known, _)| *known == short).map(|(_, definition)| *definition);
    let definition = definition.ok_or_else(|| DefinitionError::Undefined(name.clone()))?;
    let hash = TypeDescription::of_message(&name, definition, &MESSAGES)?.hash();
    Ok((name, hash))
}

impl Service {
    /// Its name after that of the node.
    pub(super) fn name(self) -> &'static str {
        match self {
            Self::GetParameters => "get_parameters",
            Self::GetParameterTypes => "get_parameter_types",
            Self::SetParameters => "set_parameters",
            Self::SetParametersAtomically => "set_parameters_atomically",
            Self::ListParameters => "list_parameters",
            Self::DescribeParameters => "describe_parameters",
            Self::GetTypeDescription => type_descriptions::SERVICE,
            Self::ChangeState => managed::CHANGE_STATE,
            Self::GetState => managed::GET_STATE,
            Self::GetAvailableStates => managed::GET_AVAILABLE_STATES,
            Self::GetAvailableTransitions => managed::GET_AVAILABLE_TRANSITIONS,
            Self::GetTransitionGraph => managed::GET_TRANSITION_GRAPH,
        }
    }

    /// `package/srv/Type`, and the definitions of request and response.
    fn definition(self) -> (&'static str, &'static str, &'static str) {
        match self {
            Self::GetParameters => ("rcl_interfaces/srv/GetParameters", "string[] names", "ParameterValue[] values"),
            Self::GetParameterTypes => ("rcl_interfaces/srv/GetParameterTypes", "string[] names", "uint8[] types"),
            Self::SetParameters => {
                ("rcl_interfaces/srv/SetParameters", "Parameter[] parameters", "SetParametersResult[] results")
            }
            Self::SetParametersAtomically => {
                ("rcl_interfaces/srv/SetParametersAtomically", "Parameter[] parameters", "SetParametersResult result")
            }
            Self::ListParameters => {
                ("rcl_interfaces/srv/ListParameters", "string[] prefixes\nuint64 depth", "ListParametersResult result")
            }
            Self::DescribeParameters => {
                ("rcl_interfaces/srv/DescribeParameters", "string[] names", "ParameterDescriptor[] descriptors")
            }
            Self::GetTypeDescription => (
                "type_description_interfaces/srv/GetTypeDescription",
                "string type_name\nstring type_hash\nbool include_type_sources true",
                "bool successful\nstring failure_reason\nTypeDescription type_description\nTypeSource[] type_sources\n\
                 KeyValue[] extra_information",
            ),
            Self::ChangeState => ("lifecycle_msgs/srv/ChangeState", "Transition transition", "bool success"),
            Self::GetState => ("lifecycle_msgs/srv/GetState", NOTHING, "State current_state"),
            Self::GetAvailableStates => ("lifecycle_msgs/srv/GetAvailableStates", NOTHING, "State[] available_states"),
            Self::GetAvailableTransitions | Self::GetTransitionGraph => {
                ("lifecycle_msgs/srv/GetAvailableTransitions", NOTHING, "TransitionDescription[] available_transitions")
            }
        }
    }

    /// `package/srv/Type`.
    pub(super) fn type_name(self) -> &'static str {
        self.definition().0
    }

    pub(super) fn hash(self) -> Result<String, DefinitionError> {
        let (name, request, response) = self.definition();
        Ok(TypeDescription::of_service(name, request, response, &MESSAGES)?.hash())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Those of ROS 2 Kilted and Jazzy (`share/PACKAGE/srv/TYPE.json`).
    #[test]
    fn hashes_of_services_are_those_of_rosidl() {
        for (service, hash) in [
            (Service::GetParameters, "RIHS01_bf9803d5c74cf989a5de3e0c2e99444599a627c7ff75f97b8c05b01003675cbc"),
            (Service::GetParameterTypes, "RIHS01_da199c878688b3e530bdfe3ca8f74cb9fa0c303101e980a9e8f260e25e1c80ca"),
            (Service::SetParameters, "RIHS01_56eed9a67e169f9cb6c1f987bc88f868c14a8fc9f743a263bc734c154015d7e0"),
            (
                Service::SetParametersAtomically,
                "RIHS01_0e192ef259c07fc3c07a13191d27002222e65e00ccec653ca05e856f79285fcd",
            ),
            (Service::ListParameters, "RIHS01_3e6062bfbb27bfb8730d4cef2558221f51a11646d78e7bb30a1e83afac3aad9d"),
            (Service::DescribeParameters, "RIHS01_845b484d71eb0673dae682f2e3ba3c4851a65a3dcfb97bddd82c5b57e91e4cff"),
            (Service::GetTypeDescription, "RIHS01_69b9c19c1021405984cc60dbbb1edceb147a6538b411d812ba6afabeed962cd5"),
            (Service::ChangeState, "RIHS01_356fe34f0475a43acf54542013af4167b0e729f77ea22ffb045c6ad8e20668e5"),
            (Service::GetState, "RIHS01_800a0a5aae599782b02932de0caf563f6dc4e7e94b794eadde075ba2cbef9795"),
            (Service::GetAvailableStates, "RIHS01_00a07d79d2207d71e81a8cbc1880e5d924cc16d4688ea8e8e06e443dc8f8aa1d"),
            (
                Service::GetAvailableTransitions,
                "RIHS01_59b7ecefce0982a8a844b9f2c4f14764c1c4543cc55e72924e2aa4adad83e9bc",
            ),
        ] {
            assert_eq!(service.hash().expect("described"), hash, "{service:?}");
        }
        for (short, hash) in [
            (LOG, "RIHS01_e28ce254ca8abc06abf92773b74602cdbf116ed34fbaf294fb9f81da9f318eac"),
            (EVENT, "RIHS01_d5f8873a2f0146498f812d7885c7327ce27e463d36811d8792f35ee38c0d6c38"),
        ] {
            assert_eq!(message(short).expect("described").1, hash, "{short}");
        }
    }
}

//! The services of a node, and the hashes of their types.

use crate::bus::type_descriptions;
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
}

/// Messages that the requests and responses refer to.
const MESSAGES: [(&str, &str); 15] = [
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
];

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
        ] {
            assert_eq!(service.hash().expect("described"), hash, "{service:?}");
        }
    }
}

//! Descriptions of message types and their hashes, as REP-2016 defines them (`RIHS01`): what ROS 2 compares to see whether
//! two programs mean the same type.
//!
//! The hash is the SHA-256 of a JSON text that `rosidl_generator_type_description` makes of the definition. Comments,
//! constants and default values do not count.
//!
//! ```
//! use squealcast_msgs::type_description::TypeDescription;
//!
//! let string = TypeDescription::of_message("std_msgs/msg/String", "string data", &[])?;
//! assert_eq!(string.hash(), "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18");
//! # Ok::<(), squealcast_msgs::type_description::DefinitionError>(())
//! ```

use std::fmt::Write as _;

use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use thiserror::Error;

/// `type_description_interfaces/TypeDescription`: a type and all types that it refers to.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct TypeDescription {
    /// The type itself.
    pub type_description: IndividualTypeDescription,
    /// The types it refers to, directly or not, by name.
    pub referenced_type_descriptions: Vec<IndividualTypeDescription>,
}

/// `type_description_interfaces/IndividualTypeDescription`.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct IndividualTypeDescription {
    /// `package/msg/Type`.
    pub type_name: String,
    /// Its fields in their order.
    pub fields: Vec<Field>,
}

/// `type_description_interfaces/Field`.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Field {
    /// Name of the field.
    pub name: String,
    /// Its type.
    pub kind: FieldType,
    /// Its default value as written in the definition, or empty.
    pub default_value: String,
}

/// `type_description_interfaces/FieldType`.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct FieldType {
    /// Number of the type, as `FieldType.msg` lists them.
    pub type_id: u8,
    /// Number of elements of an array or bounded sequence, else 0.
    pub capacity: u64,
    /// Length limit of a bounded string, else 0.
    pub string_capacity: u64,
    /// `package/msg/Type` of a nested message, else empty.
    pub nested_type_name: String,
}

/// A definition that cannot be described.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
pub enum DefinitionError {
    /// A line that is neither a field nor a constant.
    #[error("{type_name}: no field: {line:?}")]
    Line {
        /// The type whose definition contains it.
        type_name: String,
        /// The line.
        line: String,
    },
    /// A type without definition.
    #[error("{0} is not defined")]
    Undefined(String),
}

/// Numbers of the primitive types in `FieldType.msg`. rosidl takes a `char` for a `uint8`.
const PRIMITIVES: [(&str, u8); 15] = [
    ("int8", 2),
    ("uint8", 3),
    ("char", 3),
    ("int16", 4),
    ("uint16", 5),
    ("int32", 6),
    ("uint32", 7),
    ("int64", 8),
    ("uint64", 9),
    ("float32", 10),
    ("float64", 11),
    ("bool", 15),
    ("byte", 16),
    ("string", 17),
    ("wstring", 18),
];
const NESTED: u8 = 1;
/// Added to the number of a bounded string.
const BOUNDED: u8 = 4;
/// Added to the number of the elements of an array, a bounded and an unbounded sequence.
const ARRAY: u8 = 48;
const BOUNDED_SEQUENCE: u8 = 96;
const UNBOUNDED_SEQUENCE: u8 = 144;

impl TypeDescription {
    /// The description of the message `package/msg/Type` with this `definition` (the text of its `.msg` file). `others` are the
    /// messages that it may refer to, as `package/Type` and definition.
    ///
    /// # Errors
    /// A line that cannot be read, or a type that is not among `others`.
    pub fn of_message(name: &str, definition: &str, others: &[(&str, &str)]) -> Result<Self, DefinitionError> {
        let type_description =
            IndividualTypeDescription { type_name: name.to_owned(), fields: fields(name, definition)? };
        Self { type_description, referenced_type_descriptions: vec![] }.complete(others)
    }

    /// The description of the service `package/srv/Type` with these definitions of request and response: rosidl makes a type
    /// of three messages of it. `others` as for [`Self::of_message`].
    ///
    /// # Errors
    /// As [`Self::of_message`].
    pub fn of_service(
        name: &str,
        request: &str,
        response: &str,
        others: &[(&str, &str)],
    ) -> Result<Self, DefinitionError> {
        let [request_name, response_name, event_name] =
            ["Request", "Response", "Event"].map(|part| format!("{name}_{part}"));
        let one = |type_name: String, fields| IndividualTypeDescription { type_name, fields };
        let event = vec![
            Field::nested("info", "service_msgs/msg/ServiceEventInfo", 0),
            Field::nested("request", &request_name, 1),
            Field::nested("response", &response_name, 1),
        ];
        let own = vec![
            Field::nested("request_message", &request_name, 0),
            Field::nested("response_message", &response_name, 0),
            Field::nested("event_message", &event_name, 0),
        ];
        let (request, response) = (fields(&request_name, request)?, fields(&response_name, response)?);
        Self {
            type_description: one(name.to_owned(), own),
            referenced_type_descriptions: vec![
                one(request_name, request),
                one(response_name, response),
                one(event_name, event),
            ],
        }
        .complete(others)
    }

    /// Adds all types that are referred to and not yet among the referenced ones, and sorts those.
    fn complete(mut self, others: &[(&str, &str)]) -> Result<Self, DefinitionError> {
        let known = &mut self.referenced_type_descriptions;
        let own = self.type_description.fields.iter().chain(known.iter().flat_map(|known| &known.fields));
        let mut wanted: Vec<String> = own.map(|field| field.kind.nested_type_name.clone()).collect();
        while let Some(name) = wanted.pop() {
            if name.is_empty() || known.iter().any(|known| known.type_name == name) {
                continue;
            }
            let found = others.iter().find(|(short, _)| message_name(short, "") == name);
            let (_, definition) = found.ok_or_else(|| DefinitionError::Undefined(name.clone()))?;
            let fields = fields(&name, definition)?;
            wanted.extend(fields.iter().map(|field| field.kind.nested_type_name.clone()));
            known.push(IndividualTypeDescription { type_name: name, fields });
        }
        known.sort_by(|a, b| a.type_name.cmp(&b.type_name));
        Ok(self)
    }

    /// The hash of the type, `RIHS01_` and 64 hexadecimal digits.
    pub fn hash(&self) -> String {
        let digest = Sha256::digest(self.hashed_text());
        digest.iter().fold("RIHS01_".to_owned(), |mut text, byte| {
            let _ = write!(text, "{byte:02x}");
            text
        })
    }

    /// The JSON text that is hashed, to the byte. Names consist of letters that need no escape.
    fn hashed_text(&self) -> String {
        let referenced: Vec<String> =
            self.referenced_type_descriptions.iter().map(IndividualTypeDescription::hashed_text).collect();
        format!(
            "{{\"type_description\": {}, \"referenced_type_descriptions\": [{}]}}",
            self.type_description.hashed_text(),
            referenced.join(", ")
        )
    }
}

impl IndividualTypeDescription {
    fn hashed_text(&self) -> String {
        let fields = self.fields.iter().map(|Field { name, kind, default_value: _ }| {
            let FieldType { type_id, capacity, string_capacity, nested_type_name } = kind;
            format!(
                "{{\"name\": \"{name}\", \"type\": {{\"type_id\": {type_id}, \"capacity\": {capacity}, \
                 \"string_capacity\": {string_capacity}, \"nested_type_name\": \"{nested_type_name}\"}}}}"
            )
        });
        let fields: Vec<String> = fields.collect();
        format!("{{\"type_name\": \"{}\", \"fields\": [{}]}}", self.type_name, fields.join(", "))
    }
}

impl Field {
    /// A field with a message or, with a capacity, with a sequence of at most so many.
    fn nested(name: &str, type_name: &str, capacity: u64) -> Self {
        let type_id = if capacity == 0 { NESTED } else { NESTED + BOUNDED_SEQUENCE };
        let kind = FieldType { type_id, capacity, string_capacity: 0, nested_type_name: type_name.to_owned() };
        Self { name: name.to_owned(), kind, default_value: String::new() }
    }
}

/// The fields of a definition. `owner` is `package/msg/Type`.
fn fields(owner: &str, definition: &str) -> Result<Vec<Field>, DefinitionError> {
    let package = owner.split('/').next().unwrap_or_default();
    let lines = definition.lines().map(|line| line.split('#').next().unwrap_or_default().trim());
    let mut fields = vec![];
    for line in lines.filter(|line| !line.is_empty()) {
        let bad = || DefinitionError::Line { type_name: owner.to_owned(), line: line.to_owned() };
        let (kind, rest) = line.split_once(char::is_whitespace).ok_or_else(bad)?;
        let (name, default_value) = rest.trim().split_once(char::is_whitespace).unwrap_or((rest.trim(), ""));
        if name.contains('=') || default_value.trim_start().starts_with('=') {
            continue; // a constant
        }
        if !name.starts_with(|first: char| first.is_ascii_lowercase()) || !name.bytes().all(is_of_name) {
            return Err(bad());
        }
        let kind = FieldType::parse(kind, package).ok_or_else(bad)?;
        fields.push(Field { name: name.to_owned(), kind, default_value: default_value.trim().to_owned() });
    }
    if fields.is_empty() {
        // rosidl adds a field, because IDL has no empty structures.
        let kind = FieldType { type_id: 3, ..FieldType::default() };
        fields.push(Field {
            name: "structure_needs_at_least_one_member".to_owned(),
            kind,
            default_value: String::new(),
        });
    }
    Ok(fields)
}

fn is_of_name(byte: u8) -> bool {
    byte.is_ascii_alphanumeric() || byte == b'_'
}

/// `package/msg/Type` of a name as definitions write it: `Type`, `package/Type` or `package/msg/Type`.
fn message_name(name: &str, package: &str) -> String {
    match name.split_once('/') {
        Some((package, rest)) => format!("{package}/msg/{}", rest.trim_start_matches("msg/")),
        None => format!("{package}/msg/{name}"),
    }
}

impl FieldType {
    /// A type as written in a definition of `package`; `None` if it is none.
    fn parse(text: &str, package: &str) -> Option<Self> {
        let (element, added, capacity) = match text.strip_suffix(']').map(|text| text.split_once('[')) {
            None => (text, 0, 0),
            Some(None) => return None,
            Some(Some((element, ""))) => (element, UNBOUNDED_SEQUENCE, 0),
            Some(Some((element, size))) => match size.strip_prefix("<=") {
                Some(limit) => (element, BOUNDED_SEQUENCE, limit.parse().ok()?),
                None => (element, ARRAY, size.parse().ok()?),
            },
        };
        let (element, limit) = element.split_once("<=").map_or((element, None), |(kind, limit)| (kind, Some(limit)));
        let primitive = PRIMITIVES.iter().find(|(name, _)| *name == element).map(|(_, number)| *number);
        let (type_id, nested_type_name) = match (primitive, limit) {
            (Some(number), None) => (number, String::new()),
            (Some(number), Some(_)) if element.ends_with("string") => (number + BOUNDED, String::new()),
            (None, None) if element.bytes().all(|byte| is_of_name(byte) || byte == b'/') && !element.is_empty() => {
                (NESTED, message_name(element, package))
            }
            _ => return None,
        };
        let string_capacity = limit.map_or(Some(0), |limit| limit.parse().ok())?;
        Some(Self { type_id: type_id + added, capacity, string_capacity, nested_type_name })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::schema::Topic;

    /// The `json.dumps` of `rosidl_generator_type_description` 4.9.5 for this definition.
    #[test]
    fn the_hashed_text_is_that_of_rosidl() {
        let header = ("std_msgs/Header", "builtin_interfaces/Time stamp\nstring frame_id");
        let time = ("builtin_interfaces/Time", "int32 sec\nuint32 nanosec");
        let described = TypeDescription::of_message(
            "p/msg/T",
            "std_msgs/Header h # a\n\nuint8 A=1\nuint8 B = 2\nbool[] b",
            &[header, time],
        );
        assert_eq!(
            described.expect("described").hashed_text(),
            "{\"type_description\": {\"type_name\": \"p/msg/T\", \"fields\": [{\"name\": \"h\", \"type\": {\"type_id\": 1, \
             \"capacity\": 0, \"string_capacity\": 0, \"nested_type_name\": \"std_msgs/msg/Header\"}}, {\"name\": \"b\", \
             \"type\": {\"type_id\": 159, \"capacity\": 0, \"string_capacity\": 0, \"nested_type_name\": \"\"}}]}, \
             \"referenced_type_descriptions\": [{\"type_name\": \"builtin_interfaces/msg/Time\", \"fields\": [{\"name\": \
             \"sec\", \"type\": {\"type_id\": 6, \"capacity\": 0, \"string_capacity\": 0, \"nested_type_name\": \"\"}}, \
             {\"name\": \"nanosec\", \"type\": {\"type_id\": 7, \"capacity\": 0, \"string_capacity\": 0, \
             \"nested_type_name\": \"\"}}]}, {\"type_name\": \"std_msgs/msg/Header\", \"fields\": [{\"name\": \"stamp\", \
             \"type\": {\"type_id\": 1, \"capacity\": 0, \"string_capacity\": 0, \"nested_type_name\": \
             \"builtin_interfaces/msg/Time\"}}, {\"name\": \"frame_id\", \"type\": {\"type_id\": 17, \"capacity\": 0, \
             \"string_capacity\": 0, \"nested_type_name\": \"\"}}]}]}"
        );
    }

    #[test]
    fn every_form_of_a_type_is_known() {
        let parsed = |text| {
            FieldType::parse(text, "p")
                .map(|kind| (kind.type_id, kind.capacity, kind.string_capacity, kind.nested_type_name))
        };
        let plain = |number, capacity, string_capacity| Some((number, capacity, string_capacity, String::new()));
        assert_eq!(parsed("float64[9]"), plain(59, 9, 0));
        assert_eq!(parsed("uint8[<=3]"), plain(99, 3, 0));
        assert_eq!(parsed("string<=255"), plain(21, 0, 255));
        assert_eq!(parsed("wstring<=5[<=2]"), plain(118, 2, 5));
        assert_eq!(parsed("byte"), plain(16, 0, 0));
        assert_eq!(parsed("Mode[]"), Some((145, 0, 0, "p/msg/Mode".to_owned())));
        assert_eq!(parsed("q/msg/M"), Some((1, 0, 0, "q/msg/M".to_owned())));
        for bad in ["", "[]", "float64[", "float64[x]", "int8<=4", "string<=", "a b", "é"] {
            assert_eq!(parsed(bad), None, "{bad:?}");
        }
    }

    #[test]
    fn definitions_that_cannot_be_described_are_refused_by_name() {
        let described = |text| TypeDescription::of_message("p/msg/T", text, &[]);
        assert_eq!(described("Other x"), Err(DefinitionError::Undefined("p/msg/Other".to_owned())));
        for bad in ["float64", "float64 9x", "float64 x\u{e4}", "int8<=4 x"] {
            assert!(matches!(described(bad), Err(DefinitionError::Line { .. })), "{bad:?}");
        }
        let with_default = described("int32 count 5\nstring name \"a b\"").expect("described");
        assert_eq!(with_default.type_description.fields[1].default_value, "\"a b\"");
        assert_eq!(with_default.hash(), described("int32 count\nstring name").expect("described").hash());
    }

    /// Hashes of ROS 2 Kilted and Jazzy (`share/PACKAGE/msg/TYPE.json`).
    #[test]
    fn hashes_of_published_types_are_those_of_ros() {
        let hash = |topic: Topic| topic.type_description().hash();
        assert_eq!(hash(Topic::Diagnostics), "RIHS01_5a8a36efb05fb25070fa0fb3810290c0e6cd4862b54a8fb975a1ee8dc55a333e");
        assert_eq!(hash(Topic::Temperature), "RIHS01_72514a14126ab9f8a9abec974c78e5610a367b59db5da355ff1fb982d5bad4b8");
        for topic in Topic::ALL {
            assert_eq!(hash(topic).len(), 71, "{topic:?}");
        }
    }
}

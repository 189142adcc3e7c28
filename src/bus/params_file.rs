//! ROS 2 parameter files:
//!
//! ```yaml
//! /**:                       # every node; also `squealcast:`, `/ns/squealcast:`, or `/ns:` with `squealcast:` inside
//!   ros__parameters:
//!     warn_margin: 0.05
//!     silence:               # nested names are joined with dots: silence.limit_s
//!       limit_s: 0.5
//! ```

use std::path::{Path, PathBuf};

use saphyr::{LoadableYamlNode, Scalar, Yaml};
use saphyr_parser::{Event, Parser};
use thiserror::Error;

use crate::files::input_file;

/// Deepest nesting of names that is accepted.
const MAX_DEPTH: usize = 32;
/// Deepest nesting of YAML that is accepted; building the document recurses as deep.
const MAX_NESTING: usize = 64;

const PARAMETERS: &str = "ros__parameters";

/// Why a parameter file cannot be read.
#[derive(Debug, Error)]
pub enum ParamsFileError {
    #[error("parameter file {path}: {source}")]
    Read { path: PathBuf, source: std::io::Error },
    #[error("parameter file {path}: {source}")]
    Yaml { path: PathBuf, source: saphyr::ScanError },
    #[error("parameter file {path}: {at}: {problem}")]
    Shape { path: PathBuf, at: String, problem: &'static str },
}

/// The parameters that a file contains for a node, as text, in file order.
///
/// # Errors
/// The file cannot be read, is not YAML, or does not have the layout above.
pub fn read(path: &Path, namespace: &str, node: &str) -> Result<Vec<(String, String)>, ParamsFileError> {
    let failed = |source| ParamsFileError::Read { path: path.to_owned(), source };
    let text = input_file::read_text(path, input_file::PARAMETERS).map_err(failed)?;
    parse(&text, namespace, node).map_err(|error| match error {
        ParseError::Yaml(source) => ParamsFileError::Yaml { path: path.to_owned(), source },
        ParseError::Shape { at, problem } => ParamsFileError::Shape { path: path.to_owned(), at, problem },
    })
}

#[derive(Debug)]
enum ParseError {
    Yaml(saphyr::ScanError),
    Shape { at: String, problem: &'static str },
}

fn shape(at: &[String], problem: &'static str) -> ParseError {
    ParseError::Shape { at: if at.is_empty() { "top level".to_owned() } else { at.join(" / ") }, problem }
}

/// Refuses text that would need excessive memory or stack to build: deep nesting, and aliases, each of which represents
/// a copy of its target. ROS does not read aliases either.
fn check_events(text: &str) -> Result<(), ParseError> {
    let mut depth = 0_usize;
    for event in Parser::new_from_str(text) {
        let (event, span) = event.map_err(ParseError::Yaml)?;
        let refuse = |problem| Err(ParseError::Shape { at: format!("line {}", span.start.line()), problem });
        match event {
            Event::SequenceStart(..) | Event::MappingStart(..) if depth == MAX_NESTING => {
                return refuse("nested too deep");
            }
            Event::SequenceStart(..) | Event::MappingStart(..) => depth += 1,
            Event::SequenceEnd | Event::MappingEnd => depth = depth.saturating_sub(1),
            Event::Alias(_) => return refuse("an alias (`*name`): write its value instead"),
            _ => {}
        }
    }
    Ok(())
}

fn parse(text: &str, namespace: &str, node: &str) -> Result<Vec<(String, String)>, ParseError> {
    check_events(text)?;
    let documents = Yaml::load_from_str(text).map_err(ParseError::Yaml)?;
    let tokens: Vec<&str> = namespace.split('/').chain([node]).filter(|token| !token.is_empty()).collect();
    let mut values = Vec::new();
    for document in &documents {
        nodes(document, &mut Vec::new(), &tokens, &mut values)?;
    }
    Ok(values)
}

/// Descends through node names to parameters.
fn nodes(
    yaml: &Yaml,
    at: &mut Vec<String>,
    node: &[&str],
    values: &mut Vec<(String, String)>,
) -> Result<(), ParseError> {
    let mapping = yaml.as_mapping().ok_or_else(|| shape(at, "expected a mapping of node names"))?;
    for (key, value) in mapping {
        let key = key.as_str().ok_or_else(|| shape(at, "expected a node name"))?;
        if key == PARAMETERS {
            let pattern: Vec<&str> = at.iter().flat_map(|name| name.split('/')).filter(|t| !t.is_empty()).collect();
            if pattern.is_empty() {
                return Err(shape(at, "ros__parameters without a node name above"));
            }
            if matches(&pattern, node) {
                parameters(value, "", at, values)?;
            }
            continue;
        }
        if at.len() >= MAX_DEPTH {
            return Err(shape(at, "nested too deep"));
        }
        at.push(key.to_owned());
        nodes(value, at, node, values)?;
        at.pop();
    }
    Ok(())
}

/// Descends through nested parameter names to values.
fn parameters(yaml: &Yaml, prefix: &str, at: &[String], values: &mut Vec<(String, String)>) -> Result<(), ParseError> {
    let mapping = yaml.as_mapping().ok_or_else(|| shape(at, "expected a mapping of parameters"))?;
    for (key, value) in mapping {
        let key = key.as_str().ok_or_else(|| shape(at, "expected a parameter name"))?;
        let name = if prefix.is_empty() { key.to_owned() } else { format!("{prefix}.{key}") };
        match value {
            Yaml::Mapping(_) if name.matches('.').count() >= MAX_DEPTH => return Err(shape(at, "nested too deep")),
            Yaml::Mapping(_) => parameters(value, &name, at, values)?,
            Yaml::Value(Scalar::Integer(number)) => values.push((name, number.to_string())),
            Yaml::Value(Scalar::FloatingPoint(number)) => values.push((name, number.into_inner().to_string())),
            Yaml::Value(Scalar::Boolean(truth)) => values.push((name, truth.to_string())),
            Yaml::Value(Scalar::String(text)) => values.push((name, text.to_string())),
            // Not a parameter of this node, but perhaps of another node that uses the same file.
            _ => values.push((name, "a list, or nothing".to_owned())),
        }
    }
    Ok(())
}

/// Whether a pattern of node-name tokens matches: `*` is one token, `**` any number of tokens.
fn matches(pattern: &[&str], node: &[&str]) -> bool {
    match pattern.split_first() {
        None => node.is_empty(),
        Some((&"**", rest)) => (0..=node.len()).any(|skip| node.get(skip..).is_some_and(|left| matches(rest, left))),
        Some((token, rest)) => {
            node.split_first().is_some_and(|(first, left)| (*token == "*" || token == first) && matches(rest, left))
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn values(text: &str, namespace: &str) -> Vec<(String, String)> {
        parse(text, namespace, "squealcast").expect("well formed")
    }

    fn problem(text: &str) -> String {
        match parse(text, "/", "squealcast").expect_err("malformed") {
            ParseError::Yaml(_) => "no YAML".to_owned(),
            ParseError::Shape { at, problem } => format!("{at}: {problem}"),
        }
    }

    #[test]
    fn the_usual_layout_is_read() {
        let text = "
/**:
  ros__parameters:
    warn_margin: 0.05
squealcast:
  ros__parameters:
    silence: {limit_s: 1, deep: {er: 1e-3}}
other:
  ros__parameters:
    warn_margin: 7
";
        let expected = [("warn_margin", "0.05"), ("silence.limit_s", "1"), ("silence.deep.er", "0.001")];
        assert_eq!(values(text, "/"), expected.map(|(name, value)| (name.to_owned(), value.to_owned())));
        assert_eq!(values(text, "/ns").len(), 1, "`squealcast:` is `/squealcast`, not `/ns/squealcast`");
    }

    #[test]
    fn namespaces_and_wildcards_match() {
        for name in ["/a/b/squealcast", "/*/b/squealcast", "/a/**", "/**/squealcast", "/**", "/a/*/*", "a/b/squealcast"]
        {
            assert_eq!(values(&format!("{name}: {{ros__parameters: {{x: 1}}}}"), "/a/b").len(), 1, "{name}");
        }
        for name in ["squealcast", "/*", "/a/squealcast", "/a/b/other", "/a/b/squealcast/c"] {
            assert_eq!(values(&format!("{name}: {{ros__parameters: {{x: 1}}}}"), "/a/b").len(), 0, "{name}");
        }
        let text = "/**: {ros__parameters: {x: [1], y: ~}}";
        assert_eq!(values(text, "/"), ["x", "y"].map(|name| (name.to_owned(), "a list, or nothing".to_owned())));
        assert_eq!(values("/**/squealcast: {ros__parameters: {x: 1}}", "/").len(), 1, "** also matches no token");
        assert_eq!(values("/a: {b: {squealcast: {ros__parameters: {x: 1}}}}", "/a/b").len(), 1);
    }

    #[test]
    fn another_layout_is_refused() {
        assert_eq!(problem("ros__parameters: {x: 1}"), "top level: ros__parameters without a node name above");
        assert_eq!(problem("[1, 2]"), "top level: expected a mapping of node names");
        assert_eq!(problem("squealcast: 3"), "squealcast: expected a mapping of node names");
        assert_eq!(problem("squealcast: {ros__parameters: 3}"), "squealcast: expected a mapping of parameters");
        assert_eq!(problem("a: [1, 2"), "no YAML");
        assert!(values("", "/").is_empty());
    }

    #[test]
    fn deep_nesting_is_refused() {
        let nested = format!("{}1{}", "{a: ".repeat(100), "}".repeat(100));
        assert!(problem(&nested).ends_with("nested too deep"));
        assert!(problem(&format!("n: {{ros__parameters: {nested}}}").replace("n:", "squealcast:")).ends_with("deep"));
        // The deepest nesting that fits into a file must not overflow the stack.
        for (start, end) in [("[", ""), ("[", "]"), ("{a: ", ""), ("- ", ""), ("? ", "")] {
            let nested = format!("{}{}", start.repeat(200_000 / start.len()), end.repeat(200_000 / start.len()));
            assert!(parse(&nested, "/", "squealcast").is_err(), "{start}");
        }
    }

    /// Every level doubles the number of values: 2^40 in a few lines.
    #[test]
    fn aliases_are_refused() {
        let mut text = "a0: &a0 [x, x]\n".to_owned();
        for level in 1..40 {
            text += &format!("a{level}: &a{level} [*a{0}, *a{0}]\n", level - 1);
        }
        assert_eq!(problem(&text), "line 2: an alias (`*name`): write its value instead");
    }

    proptest::proptest! {
        #[test]
        fn no_text_panics(text: String) {
            let _ = parse(&text, "/", "squealcast");
        }

        #[test]
        fn no_mutation_panics(at in 0usize..60, byte in 32u8..127) {
            let mut text = *b"/**:\n  ros__parameters:\n    warn_margin: 0.05\n    b: {c: 1}\n  ";
            text[at] = byte;
            let _ = parse(std::str::from_utf8(&text).expect("ASCII"), "/", "squealcast");
        }
    }
}

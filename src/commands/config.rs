//! The configuration file of `run`: TOML whose keys are the options of the command, with `_` for `-`.
//!
//! A file is turned into arguments, which are parsed in front of those of the command line. So it knows every option that
//! the command line knows, with the same values and limits, and the same meaning.

use std::path::{Path, PathBuf};

use clap::builder::ValueRange;
use clap::error::ErrorKind;
use clap::parser::ValueSource;
use clap::{Arg, ArgAction, Command, CommandFactory, Parser};
use toml::Value;

use super::Cli;
use crate::bus::ros_args::{RosArgs, RosArgsError};
use crate::files::input_file;

/// The command that has a configuration file, the option that names it, and the one that leaves keys of it out.
const COMMAND: &str = "run";
const OPTION: &str = "config";
const UNSET: &str = "unset";
/// Options that a file cannot contain.
const OF_THE_COMMAND_LINE: [&str; 5] = [OPTION, UNSET, "check_config", "help", "version"];
/// The key of what follows `--ros-args` on a command line.
const ROS_ARGS: &str = "ros_args";

/// Why a configuration file is refused.
#[derive(Debug, thiserror::Error)]
pub enum ConfigError {
    #[error("{}: {source}", .file.display())]
    Read { file: PathBuf, source: std::io::Error },
    #[error("{}, line {line}: {message}", .file.display())]
    Syntax { file: PathBuf, line: usize, message: String },
    #[error("{}: unknown key {key}{}", .file.display(), .near.as_ref().map(|near| format!(", did you mean {near}?")).unwrap_or_default())]
    Unknown { file: PathBuf, key: String, near: Option<String> },
    #[error("{}: {key} = {value}: expected {expected}", .file.display())]
    Kind { file: PathBuf, key: String, value: String, expected: &'static str },
    #[error("{}: {key}: {message}", .file.display())]
    Value { file: PathBuf, key: String, message: String },
    #[error("{}: {ROS_ARGS}: {source}", .file.display())]
    RosArgs { file: PathBuf, source: RosArgsError },
    #[error("--unset {key}: no key of a configuration file{}", .near.as_ref().map(|near| format!(", did you mean {near}?")).unwrap_or_default())]
    Unset { key: String, near: Option<String> },
    #[error("{} with the command line: {message}", .file.display())]
    Together { file: PathBuf, message: String },
}

/// The arguments of a process.
#[derive(Clone, Debug)]
pub struct Given {
    pub arguments: Vec<String>,
    pub ros_args: RosArgs,
}

/// The keys of a configuration file that the command line does not override, with their arguments.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Config {
    pub file: PathBuf,
    entries: Vec<Entry>,
}

#[derive(Clone, Debug, PartialEq, Eq)]
struct Entry {
    key: String,
    arguments: Vec<String>,
}

impl Given {
    /// Parses the command line, with those of the configuration file that it names. Wrong usage ends the process.
    ///
    /// # Errors
    /// A faulty configuration file.
    pub fn parse(&self) -> Result<(Cli, RosArgs, Option<Config>), ConfigError> {
        match self.config_file() {
            Some(file) => self.with_file(&file).map(|(cli, ros_args, config)| (cli, ros_args, Some(config))),
            None => Ok((Cli::parse_from(&self.arguments), self.ros_args.clone(), None)),
        }
    }

    /// The file that `run --config` names, if it is given.
    fn config_file(&self) -> Option<PathBuf> {
        let arguments = self.of_command()?;
        let matches = command().ignore_errors(true).try_get_matches_from(arguments).ok()?;
        matches.get_one::<PathBuf>(OPTION).cloned()
    }

    /// The command's name and what follows it.
    fn of_command(&self) -> Option<&[String]> {
        self.arguments.get(1..).filter(|arguments| arguments.first().is_some_and(|name| name == COMMAND))
    }

    /// Parses the command line with the configuration `file`, for the first time or again.
    ///
    /// # Errors
    /// A faulty configuration file.
    pub fn with_file(&self, file: &Path) -> Result<(Cli, RosArgs, Config), ConfigError> {
        let table = read(file)?;
        let command = command();
        let own = self.of_command().unwrap_or_default();
        let given = command.clone().ignore_errors(true).try_get_matches_from(own).ok();
        let is_given = |arg: &Arg| {
            let source = given.as_ref().and_then(|given| given.value_source(arg.get_id().as_str()));
            source == Some(ValueSource::CommandLine)
        };
        let unset: Vec<String> =
            given.iter().flat_map(|given| given.get_many::<String>(UNSET)).flatten().cloned().collect();
        if let Some(key) = unset.iter().find(|key| *key != ROS_ARGS && find(&command, key).is_none()) {
            return Err(ConfigError::Unset { key: key.clone(), near: near(&command, key) });
        }
        let mut config = Config { file: file.to_owned(), entries: vec![] };
        let mut of_file = RosArgs::default();
        for (key, value) in table.iter().filter(|(key, _)| !unset.contains(key)) {
            if key == ROS_ARGS {
                let arguments = texts(file, key, value)?;
                let marked = std::iter::once("--ros-args".to_owned()).chain(arguments.iter().cloned());
                let split =
                    RosArgs::split(marked).map_err(|source| ConfigError::RosArgs { file: file.to_owned(), source })?;
                of_file = split.0;
                config.entries.push(Entry { key: key.clone(), arguments });
                continue;
            }
            let arg = find(&command, key).ok_or_else(|| unknown(file, &command, key))?;
            let arguments = arguments(file, key, arg, value)?;
            check(file, key, &command, &arguments)?;
            let excluded = |other: &Arg| excludes(&command, arg, other) && is_given(other);
            let overridden = is_given(arg) && !is_list(arg) || command.get_arguments().any(excluded);
            if !overridden {
                config.entries.push(Entry { key: key.clone(), arguments });
            }
        }
        let of_config = config.entries.iter().filter(|entry| entry.key != ROS_ARGS).flat_map(|entry| &entry.arguments);
        let (head, rest) = self.arguments.split_at(self.arguments.len().min(2));
        let all = head.iter().chain(of_config).chain(rest);
        let cli = Cli::try_parse_from(all)
            .map_err(|error| ConfigError::Together { file: file.to_owned(), message: message_of(&error) })?;
        Ok((cli, self.ros_args.clone().over(of_file), config))
    }
}

impl Config {
    /// The arguments that the file stands for.
    pub fn arguments(&self) -> impl Iterator<Item = &str> {
        self.entries.iter().flat_map(|entry| {
            let mark = (entry.key == ROS_ARGS).then_some("--ros-args");
            mark.into_iter().chain(entry.arguments.iter().map(String::as_str))
        })
    }

    /// The keys whose values differ between two readings of a file.
    pub fn differences<'a>(&'a self, other: &'a Self) -> Vec<&'a str> {
        let in_only = |a: &'a Self, b: &'a Self| {
            a.entries.iter().filter(|entry| !b.entries.contains(entry)).map(|entry| entry.key.as_str())
        };
        let mut keys: Vec<&str> = in_only(self, other).chain(in_only(other, self)).collect();
        keys.sort_unstable();
        keys.dedup();
        keys
    }
}

/// The command with its options as clap knows them.
fn command() -> Command {
    let mut cli = Cli::command();
    cli.build();
    cli.find_subcommand(COMMAND).cloned().unwrap_or_default()
}

fn read(file: &Path) -> Result<toml::Table, ConfigError> {
    let text = input_file::read_text(file, input_file::TOML)
        .map_err(|source| ConfigError::Read { file: file.to_owned(), source })?;
    text.parse().map_err(|error: toml::de::Error| {
        let begin = error.span().unwrap_or_default().start;
        let line = 1 + text.bytes().take(begin).filter(|byte| *byte == b'\n').count();
        ConfigError::Syntax { file: file.to_owned(), line, message: error.message().trim().replace('\n', ", ") }
    })
}

/// The key of an option: its long name, or the name of a positional argument.
fn key_of(arg: &Arg) -> String {
    arg.get_long().unwrap_or(arg.get_id().as_str()).replace('-', "_")
}

/// The keys that a file may contain, besides [`ROS_ARGS`].
fn keys(command: &Command) -> impl Iterator<Item = (String, &Arg)> {
    let all = command.get_arguments().map(|arg| (key_of(arg), arg));
    all.filter(|(key, _)| !OF_THE_COMMAND_LINE.contains(&key.as_str()))
}

fn find<'a>(command: &'a Command, key: &str) -> Option<&'a Arg> {
    keys(command).find(|(known, _)| known == key).map(|(_, arg)| arg)
}

fn unknown(file: &Path, command: &Command, key: &str) -> ConfigError {
    ConfigError::Unknown { file: file.to_owned(), key: key.to_owned(), near: near(command, key) }
}

/// The key that is most like another word.
fn near(command: &Command, key: &str) -> Option<String> {
    let known = keys(command).map(|(known, _)| known).chain([ROS_ARGS.to_owned()]);
    let near = known.map(|known| (strsim::jaro_winkler(key, &known), known)).max_by(|a, b| a.0.total_cmp(&b.0));
    // The likeness from which on clap offers a name.
    near.filter(|(likeness, _)| *likeness > 0.7).map(|(_, known)| known)
}

fn is_flag(arg: &Arg) -> bool {
    arg.get_num_args() == Some(ValueRange::EMPTY)
}

fn is_list(arg: &Arg) -> bool {
    matches!(arg.get_action(), ArgAction::Append)
}

/// Whether either of two options excludes the other.
fn excludes(command: &Command, one: &Arg, other: &Arg) -> bool {
    let names = |a: &Arg, b: &Arg| command.get_arg_conflicts_with(a).iter().any(|found| found.get_id() == b.get_id());
    names(one, other) || names(other, one)
}

/// The arguments that a key with this value stands for.
fn arguments(file: &Path, key: &str, arg: &Arg, value: &Value) -> Result<Vec<String>, ConfigError> {
    let kind =
        |expected| ConfigError::Kind { file: file.to_owned(), key: key.to_owned(), value: value.to_string(), expected };
    let option = |text: String| match arg.get_long() {
        Some(long) => format!("--{long}={text}"),
        None => text,
    };
    if arg.is_positional() && value.as_str().is_some_and(|text| text.starts_with('-')) {
        return Err(kind("a name that does not begin with -"));
    }
    if is_flag(arg) {
        let given = value.as_bool().ok_or_else(|| kind("true or false"))?;
        let long = arg.get_long().unwrap_or_default();
        return Ok(given.then(|| format!("--{long}")).into_iter().collect());
    }
    Ok(match value {
        Value::Table(table) if is_list(arg) => {
            let text = |(name, value): (&String, &Value)| Some(option(format!("{name}={}", text(value)?)));
            table.iter().map(text).collect::<Option<_>>().ok_or_else(|| kind("a table of numbers or texts"))?
        }
        Value::Array(_) if is_list(arg) => texts(file, key, value)?.into_iter().map(option).collect(),
        single => vec![option(text(single).ok_or_else(|| kind("a number or a text"))?)],
    })
}

/// A list of texts.
fn texts(file: &Path, key: &str, value: &Value) -> Result<Vec<String>, ConfigError> {
    let all = value.as_array().and_then(|values| values.iter().map(text).collect());
    all.ok_or_else(|| ConfigError::Kind {
        file: file.to_owned(),
        key: key.to_owned(),
        value: value.to_string(),
        expected: "a list of texts",
    })
}

/// A text or a number as an argument.
fn text(value: &Value) -> Option<String> {
    match value {
        Value::String(text) => Some(text.clone()),
        Value::Integer(number) => Some(number.to_string()),
        Value::Float(number) => Some(number.to_string()),
        Value::Boolean(_) | Value::Datetime(_) | Value::Array(_) | Value::Table(_) => None,
    }
}

/// Checks the arguments of one key by themselves, so that an error names the key.
fn check(file: &Path, key: &str, command: &Command, arguments: &[String]) -> Result<(), ConfigError> {
    let all = std::iter::once(COMMAND).chain(arguments.iter().map(String::as_str));
    match command.clone().try_get_matches_from(all) {
        Err(error) => match error.kind() {
            // Judged together with the other keys and the command line.
            ErrorKind::MissingRequiredArgument | ErrorKind::ArgumentConflict => Ok(()),
            _ => Err(ConfigError::Value { file: file.to_owned(), key: key.to_owned(), message: message_of(&error) }),
        },
        Ok(_) => Ok(()),
    }
}

/// The first paragraph of clap's message, on one line.
fn message_of(error: &clap::Error) -> String {
    let text = error.to_string();
    let first = text.split("\n\n").next().unwrap_or_default();
    let words: Vec<&str> = first.trim_start_matches("error: ").split_whitespace().collect();
    words.join(" ")
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::session::settings::PARAMETERS;

    fn given(line: &str) -> Given {
        let all = line.split_whitespace().map(str::to_owned);
        let (ros_args, arguments) = RosArgs::split(all).expect("well formed");
        Given { arguments, ros_args }
    }

    /// The file's arguments, as a command line.
    fn read(text: &str, line: &str) -> Result<(RosArgs, String), String> {
        let file = tempfile::NamedTempFile::with_suffix(".toml").expect("a file");
        std::fs::write(file.path(), text).expect("writable");
        let name = file.path().display().to_string();
        let parsed = given(&format!("squealcast run --config {name} {line}")).parse();
        let shown = |error: ConfigError| error.to_string().replace(&name, "FILE");
        let (_, ros_args, config) = parsed.map_err(shown)?;
        let config = config.expect("a configuration file");
        Ok((ros_args, config.arguments().collect::<Vec<_>>().join(" ")))
    }

    fn arguments_of(text: &str, line: &str) -> String {
        read(text, line).unwrap_or_else(|error| panic!("{error}")).1
    }

    fn refused(text: &str, line: &str) -> String {
        read(text, line).expect_err("faulty")
    }

    /// A value that the option accepts.
    fn valid(key: &str) -> &'static str {
        match key {
            "set" => "{ warn_margin = 0.1 }",
            "ros_args" => "['-r', '__ns:=/left']",
            "display" => "'127.0.0.1:0'",
            "band_hz" => "'1000:9000'",
            "log_format" => "'json'",
            "rmw" => "'dds'",
            "rig" | "record" | "shm_prefix" => "'name'",
            _ => "5",
        }
    }

    /// Every option of the command, those added later included.
    #[test]
    fn a_file_can_contain_every_option_of_the_command() {
        let command = command();
        let found: Vec<(String, &Arg)> = keys(&command).collect();
        assert!(found.len() > 15 && found.iter().any(|(key, _)| key == "rig"), "{found:?}");
        for (key, arg) in found {
            let value = if is_flag(arg) { "true" } else { valid(&key) };
            // What one option requires of another.
            let beside = if key == "record_sound" { "record = 'x'\n" } else { "" };
            let text = format!("{beside}{key} = {value}");
            let expected = arg.get_long().map_or("name".to_owned(), |long| format!("--{long}"));
            assert!(arguments_of(&text, "").contains(&expected), "{text}");
        }
    }

    /// The file that is installed with the package contains every key, as a comment or not, with a value that is valid.
    #[test]
    fn the_installed_file_lists_every_key_and_setting() {
        let text = include_str!("../../launch/squealcast.toml");
        let lines = text.lines().map(|line| line.strip_prefix("#").unwrap_or(line));
        let settings: String = lines.filter(|line| !line.starts_with(' ')).map(|line| format!("{line}\n")).collect();
        let table: toml::Table = settings.parse().expect("valid without the marks of comments");
        let command = command();
        let all = keys(&command).map(|(key, _)| key).chain([ROS_ARGS.to_owned()]);
        let missing: Vec<String> = all.filter(|key| !table.contains_key(key)).collect();
        assert!(missing.is_empty(), "not in launch/squealcast.toml: {missing:?}");
        let set = table["set"].as_table().expect("a table");
        let missing: Vec<&str> = PARAMETERS.iter().map(|p| p.name).filter(|name| !set.contains_key(*name)).collect();
        assert!(missing.is_empty(), "not in [set] of launch/squealcast.toml: {missing:?}");
        for (key, value) in table {
            let line = toml::to_string(&toml::Table::from_iter([(key.clone(), value)])).expect("TOML");
            let beside = if key == "record_sound" { "record = 'x'\n" } else { "" };
            read(&format!("{beside}{line}"), "").unwrap_or_else(|error| panic!("{error}"));
        }
        read(text, "").expect("as it is installed");
    }

    #[test]
    fn the_command_line_wins() {
        let file = "rig = 'tribometer'\nrecord = 'sessions'\ndomain = 3\nno_display = true\n";
        assert_eq!(arguments_of(file, ""), "--domain=3 --no-display --record=sessions tribometer");
        assert_eq!(arguments_of(file, "nine-dof --domain 4"), "--no-display --record=sessions");
        // Options that exclude each other.
        assert_eq!(arguments_of(file, "--display 127.0.0.1:0"), "--domain=3 --record=sessions tribometer");
        // A flag has no other way to be cleared; a key that the file does not have is none the less left out.
        let line = "--unset no_display --unset domain --unset managed";
        assert_eq!(arguments_of(file, line), "--record=sessions tribometer");
        assert_eq!(
            refused(file, "--unset no_displ"),
            "--unset no_displ: no key of a configuration file, did you mean no_display?"
        );
        // Of the values of a list, the later win: the command line's follow the file's.
        assert_eq!(arguments_of("[set]\nwarn_margin = 0.1\n", "--set warn_margin=0.2"), "--set=warn_margin=0.1");
        let (ros_args, _) =
            read("ros_args = ['-r', '__ns:=/left', '-r', 'a:=b']", "--ros-args -r __ns:=/right").expect("valid");
        assert_eq!(ros_args.namespace("squealcast", "/"), "/right");
        assert_eq!(ros_args.topic("a", "/right", "squealcast"), "/right/b");
    }

    #[test]
    fn what_is_wrong_is_named_with_file_key_and_limit() {
        assert_eq!(refused("recrd = 'x'", ""), "FILE: unknown key recrd, did you mean record?");
        assert_eq!(refused("xyz = 1", ""), "FILE: unknown key xyz");
        assert_eq!(refused("config = 'x'", ""), "FILE: unknown key config");
        assert_eq!(refused("no_ros = 3", ""), "FILE: no_ros = 3: expected true or false");
        assert_eq!(refused("record = ['a', 'b']", ""), "FILE: record = [\"a\", \"b\"]: expected a number or a text");
        assert_eq!(
            refused("domain = 300", ""),
            "FILE: domain: invalid value '300' for '--domain <N>': 300 is not in 0..=232"
        );
        let error = refused("[set]\nwarn_margn = 1", "");
        assert!(
            error.starts_with("FILE: set: invalid value 'warn_margn=1'") && error.contains("there are warn_margin"),
            "{error}"
        );
        let error = refused("[set]\nwarn_margin = 1e9", "");
        assert!(error.contains("warn_margin` = 1000000000: expected a number from"), "{error}");
        assert!(refused("rig = 'x'\n\nrecord == 2", "").starts_with("FILE, line 3: "));
        assert_eq!(refused("ros_args = ['--nonsense']", ""), "FILE: ros_args: unknown ROS argument \"--nonsense\"");
        assert_eq!(
            refused("rig = '--no-ros'", ""),
            "FILE: rig = \"--no-ros\": expected a name that does not begin with -"
        );
        assert_eq!(
            refused("record_sound = true", ""),
            "FILE with the command line: the following required arguments were not provided: --record <DIR>"
        );
    }

    #[test]
    fn changed_keys_are_named() {
        let config = |entries: &[(&str, &str)]| Config {
            file: "f".into(),
            entries: entries
                .iter()
                .map(|(key, value)| Entry { key: (*key).to_owned(), arguments: vec![(*value).to_owned()] })
                .collect(),
        };
        let (one, other) =
            (config(&[("a", "1"), ("b", "2"), ("c", "3")]), config(&[("a", "1"), ("b", "3"), ("d", "4")]));
        assert_eq!(one.differences(&other), ["b", "c", "d"]);
        assert!(one.differences(&one).is_empty());
    }
}

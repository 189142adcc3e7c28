//! Log lines of a node as ROS 2 has them: on `/rosout`, with a severity.

use serde::{Deserialize, Serialize};

use crate::msgs::Time;
use crate::system::clock;

/// The topic of log lines, one for all namespaces.
pub(super) const ROSOUT: &str = "/rosout";
/// Lines of `/rosout` that are kept for later readers, as in every ROS 2 node.
pub(super) const KEPT_LINES: i32 = 1000;

/// `rcl_interfaces/Log`.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct Line {
    stamp: Time,
    level: u8,
    /// The logger: the node's name with its namespace, by dots.
    name: String,
    msg: String,
    file: String,
    function: String,
    line: u32,
}

impl Line {
    /// A line of now, of the node with this full name.
    pub(super) fn new(node: &str, severity: Severity, text: &str) -> Self {
        Self {
            stamp: Time::from_ns(clock::now_ns()),
            level: severity as u8,
            name: node.trim_start_matches('/').replace('/', "."),
            msg: text.to_owned(),
            file: String::new(),
            function: String::new(),
            line: 0,
        }
    }
}

/// How serious a log line is. The values are those of `rcl_interfaces/Log`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[repr(u8)]
pub enum Severity {
    Debug = 10,
    Info = 20,
    Warn = 30,
    Error = 40,
    Fatal = 50,
}

impl Severity {
    const ALL: [Self; 5] = [Self::Debug, Self::Info, Self::Warn, Self::Error, Self::Fatal];

    /// The severity with this name, in upper or lower case.
    pub fn parse(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|severity| severity.name().eq_ignore_ascii_case(name))
    }

    /// Its name in ROS 2.
    pub fn name(self) -> &'static str {
        match self {
            Self::Debug => "DEBUG",
            Self::Info => "INFO",
            Self::Warn => "WARN",
            Self::Error => "ERROR",
            Self::Fatal => "FATAL",
        }
    }
}

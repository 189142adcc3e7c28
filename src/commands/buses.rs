//! Options for the buses that a command joins.

use std::sync::Arc;

use anyhow::{Context, ensure};
use clap::{Args, ValueEnum};

use crate::bus::lifecycle::State;
use crate::bus::ros_args::RosArgs;
use crate::bus::ros2::{NODE_NAME, Ros2Error, Ros2NodeConnection, Ros2Options, Ros2ReplayConnection, Ros2Source};
use crate::bus::shm::ShmOptions;
use crate::bus::{Bus, Connection, ShmConnection, Sink, zenoh};
use crate::msgs::shm::{Form, OperatingPointForm};
use crate::msgs::topic;
use crate::node::NodeName;
use crate::node::status::InputSources;
use crate::session::settings::Settings;

/// Which buses to join, and how
#[derive(Clone, Debug, Args)]
pub struct BusOptions {
    /// Do not join ROS 2
    #[arg(long)]
    no_ros: bool,
    /// What carries ROS 2 [default: zenoh if RMW_IMPLEMENTATION is rmw_zenoh_cpp, else dds]
    #[arg(long, value_name = "RMW", conflicts_with = "no_ros")]
    rmw: Option<Rmw>,
    /// Do not join shared memory
    #[arg(long)]
    no_shm: bool,
    /// ROS 2 domain, 0 to 232 [default: ROS_DOMAIN_ID, else 0]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(0..=232))]
    domain: Option<u16>,
    /// Announce on 127.0.0.1 only, and receive through the loopback interface only
    #[arg(long)]
    loopback: bool,
    /// Prefix of the names of the shared-memory services
    #[arg(long, value_name = "PREFIX", default_value = "")]
    shm_prefix: String,
}

/// What carries ROS 2
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum Rmw {
    /// DDS
    Dds,
    /// Zenoh, as rmw_zenoh_cpp
    Zenoh,
    /// Both at once
    Both,
}

/// Names what carries ROS 2 in ROS 2 programs.
const RMW_IMPLEMENTATION: &str = "RMW_IMPLEMENTATION";
const RMW_ZENOH: &str = "rmw_zenoh_cpp";

impl Rmw {
    /// The one that the environment of a ROS 2 program demands.
    fn of_environment() -> Self {
        let wanted = std::env::var(RMW_IMPLEMENTATION).is_ok_and(|name| name == RMW_ZENOH);
        match (wanted, zenoh::BUILT_IN) {
            (true, true) => Self::Zenoh,
            (true, false) => {
                note!("ROS 2 over DDS in spite of {RMW_IMPLEMENTATION}={RMW_ZENOH}: built without Zenoh");
                Self::Dds
            }
            (false, _) => Self::Dds,
        }
    }
}

impl BusOptions {
    /// The options for `demo`, which must not be mistaken for a rig: visible on this machine only, with its own
    /// shared-memory names.
    pub fn for_demo(&self) -> Self {
        let shm_prefix = if self.shm_prefix.is_empty() { "demo/".to_owned() } else { self.shm_prefix.clone() };
        Self { loopback: true, shm_prefix, ..self.clone() }
    }

    /// Checks the options of every bus.
    ///
    /// # Errors
    /// A ROS 2 domain or environment variable that is not valid.
    pub fn resolve(&self, args: RosArgs) -> Result<Buses, Ros2Error> {
        let shm = (!self.no_shm).then(|| ShmOptions { service_prefix: self.shm_prefix.clone(), ..Default::default() });
        let (mut ros2, mut zenoh) = (None, None);
        if !self.no_ros {
            let rmw = self.rmw.unwrap_or_else(Rmw::of_environment);
            if matches!(rmw, Rmw::Dds | Rmw::Both) {
                ros2 = Some(Ros2Options::new(self.domain, self.loopback, args.clone())?);
            }
            if matches!(rmw, Rmw::Zenoh | Rmw::Both) {
                let options = Ros2Options::over_zenoh(self.domain, self.loopback, args)?;
                zenoh = Some(Ros2Options { is_managed_elsewhere: ros2.is_some(), ..options });
            }
        }
        Ok(Buses { shm, ros2, zenoh, options: self.clone() })
    }
}

/// The buses that a command joins; `None` for those it does not.
pub struct Buses {
    options: BusOptions,
    shm: Option<ShmOptions>,
    ros2: Option<Ros2Options>,
    zenoh: Option<Ros2Options>,
}

/// How a node starts on its buses.
pub struct NodeStart {
    pub name: NodeName,
    pub settings: Settings,
    /// Names and values of the parameters, those of the settings included.
    pub parameters: Vec<(String, f64)>,
}

/// What tells a user how to do without a bus that cannot be joined.
const SHM_FAILED: &str = "shared memory; --no-shm stays off it";
const ROS2_FAILED: &str = "ROS 2; --no-ros stays off it";
const MANAGED_ALONE: &str = "--managed needs ROS 2, over which the node is configured";
const ZENOH_FAILED: &str = "Zenoh; --rmw dds stays off it";
const NO_BUS: &str = "no bus to publish on: --no-shm and --no-ros are both given";

impl Buses {
    /// How ROS 2 is joined, by whatever carries it: names and arguments are the same.
    fn ros(&self) -> Option<&Ros2Options> {
        self.ros2.as_ref().or(self.zenoh.as_ref())
    }

    /// How a node with these `settings` starts: the arguments of ROS 2 may name it and change settings.
    ///
    /// # Errors
    /// A parameter that is not known, or whose value is not valid.
    pub fn node(&self, mut settings: Settings) -> anyhow::Result<NodeStart> {
        let Some(ros2) = self.ros() else {
            return Ok(NodeStart { name: NodeName::default(), settings, parameters: vec![] });
        };
        let declared: Vec<(&str, f64)> = settings.values().collect();
        let name = ros2.args.node_name(NODE_NAME);
        let namespace = ros2.args.namespace(&name, "/");
        let (values, ignored) = ros2.args.parameters(&declared, &namespace, &name)?;
        let (_, of_other_topics) = ros2.args.qos_overrides(&namespace, &name)?;
        for what in ignored.into_iter().chain(of_other_topics) {
            note!("ROS 2: {what}");
        }
        for (name, value) in &values {
            settings.set(name, *value)?;
        }
        Ok(NodeStart { name: NodeName::new(&namespace, &name), settings, parameters: values })
    }

    /// Joins the buses as a node with these `parameters`, which starts in `state` and receives into `sink`.
    ///
    /// # Errors
    /// A bus cannot be joined.
    pub fn join_as_node(
        &self,
        parameters: &[(String, f64)],
        state: State,
        sink: &Arc<dyn Sink>,
    ) -> anyhow::Result<Vec<Box<dyn Connection>>> {
        ensure!(state == State::Active || self.ros().is_some(), MANAGED_ALONE);
        self.join(|bus| match bus {
            Bus::Shm => boxed(self.shm.as_ref().map(|shm| ShmConnection::of_node(shm, sink)), SHM_FAILED),
            Bus::Ros2 => {
                let start = |ros2| Ros2NodeConnection::start(ros2, parameters.to_vec(), state, sink);
                boxed(self.ros2.as_ref().map(start), ROS2_FAILED)
            }
            Bus::Zenoh => {
                let start = |zenoh| Ros2NodeConnection::start(zenoh, parameters.to_vec(), state, sink);
                boxed(self.zenoh.as_ref().map(start), ZENOH_FAILED)
            }
            Bus::Simulator => Ok(None),
        })
    }

    /// Joins the buses as a rig, which publishes operating points and, if it measures them, vibration and
    /// sound.
    ///
    /// # Errors
    /// A bus cannot be joined, or all are switched off.
    pub fn join_as_rig(
        &self,
        measures_vibration: bool,
        measures_sound: bool,
    ) -> anyhow::Result<Vec<Box<dyn Connection>>> {
        self.join_some(|bus| match bus {
            Bus::Shm => boxed(
                self.shm.as_ref().map(|shm| ShmConnection::of_rig(shm, measures_vibration, measures_sound)),
                SHM_FAILED,
            ),
            Bus::Ros2 => boxed(self.ros2.as_ref().map(|ros2| Ros2Source::start(ros2, |_| {})), ROS2_FAILED),
            Bus::Zenoh => self.zenoh.as_ref().map(zenoh::rig).transpose().context(ZENOH_FAILED),
            Bus::Simulator => Ok(None),
        })
    }

    /// Joins the buses as a replay, which publishes the messages of a rig and of its node.
    ///
    /// # Errors
    /// A bus cannot be joined, or all are switched off.
    pub fn join_as_replay(&self) -> anyhow::Result<Vec<Box<dyn Connection>>> {
        self.join_some(|bus| match bus {
            Bus::Shm => boxed(self.shm.as_ref().map(ShmConnection::of_replay), SHM_FAILED),
            Bus::Ros2 => boxed(self.ros2.as_ref().map(Ros2ReplayConnection::start), ROS2_FAILED),
            Bus::Zenoh => self.zenoh.as_ref().map(zenoh::replay).transpose().context(ZENOH_FAILED),
            Bus::Simulator => Ok(None),
        })
    }

    fn join(
        &self,
        join: impl Fn(Bus) -> anyhow::Result<Option<Box<dyn Connection>>>,
    ) -> anyhow::Result<Vec<Box<dyn Connection>>> {
        Bus::ALL.into_iter().filter_map(|bus| join(bus).transpose()).collect()
    }

    /// As [`Self::join`], for a command that has nothing to do without a bus.
    fn join_some(
        &self,
        join: impl Fn(Bus) -> anyhow::Result<Option<Box<dyn Connection>>>,
    ) -> anyhow::Result<Vec<Box<dyn Connection>>> {
        let joined = self.join(join)?;
        ensure!(!joined.is_empty(), NO_BUS);
        Ok(joined)
    }

    /// Where a node on these buses expects its inputs, and the command that simulates them.
    pub fn sources(&self) -> InputSources {
        let Self { options, ros2, zenoh, shm } = self;
        let ros = self.ros();
        let topic = ros.map(|ros| {
            let name = ros.args.node_name(NODE_NAME);
            ros.args.topic(topic::relative(topic::OPERATING_POINT), &ros.args.namespace(&name, "/"), &name)
        });
        // The bus of most rigs first.
        let places = Bus::ALL.into_iter().rev().filter_map(|bus| match bus {
            Bus::Shm => {
                let shm = shm.as_ref()?;
                Some(format!("{}{} (shared memory)", shm.service_prefix, OperatingPointForm::SERVICE))
            }
            Bus::Ros2 => Some(format!("{} (ROS 2, domain {})", topic.as_ref()?, ros2.as_ref()?.domain_id)),
            Bus::Zenoh => Some(format!("{} (ROS 2 over Zenoh, domain {})", topic.as_ref()?, zenoh.as_ref()?.domain_id)),
            Bus::Simulator => None,
        });
        let places: Vec<String> = places.collect();
        let start = (!places.is_empty()).then(|| {
            let mut command = "squealcast simulate".to_owned();
            for (given, option) in
                [(options.no_ros, "--no-ros"), (options.no_shm, "--no-shm"), (options.loopback, "--loopback")]
            {
                if given {
                    command += &format!(" {option}");
                }
            }
            match (ros2, zenoh) {
                (Some(_), Some(_)) => command += " --rmw both",
                (None, Some(_)) => command += " --rmw zenoh",
                (_, None) => {}
            }
            if let Some(ros) = ros.filter(|ros| ros.domain_id != 0) {
                command += &format!(" --domain {}", ros.domain_id);
            }
            if let Some(shm) = shm.as_ref().filter(|shm| !shm.service_prefix.is_empty()) {
                command += &format!(" --shm-prefix {}", shm.service_prefix);
            }
            if let Some(topic) = topic.as_ref().filter(|topic| *topic != topic::OPERATING_POINT) {
                command += &format!(" --ros-args -r {}:={topic}", topic::OPERATING_POINT);
            }
            command
        });
        InputSources { places, start }
    }
}

/// A connection that was joined, if one was requested.
fn boxed<C: Connection + 'static, E: std::error::Error + Send + Sync + 'static>(
    joined: Option<Result<C, E>>,
    failed: &'static str,
) -> anyhow::Result<Option<Box<dyn Connection>>> {
    let joined = joined.transpose().context(failed)?;
    Ok(joined.map(|connection| -> Box<dyn Connection> { Box::new(connection) }))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn options() -> BusOptions {
        BusOptions {
            no_ros: false,
            rmw: Some(Rmw::Dds),
            no_shm: false,
            domain: Some(7),
            loopback: true,
            shm_prefix: "cell2/".to_owned(),
        }
    }

    #[test]
    fn the_simulator_command_publishes_on_the_topic_of_the_node() {
        let arguments = ["--ros-args", "-r", "/rig/operating_point:=/brake1/point"].map(str::to_owned);
        let (args, _) = RosArgs::split(arguments).expect("rules");
        let sources = options().resolve(args).expect("a domain").sources();
        assert_eq!(sources.places, ["/brake1/point (ROS 2, domain 7)", "cell2/rig/operating_point (shared memory)"]);
        assert_eq!(
            sources.start.as_deref(),
            Some(
                "squealcast simulate --loopback --domain 7 --shm-prefix cell2/ --ros-args -r \
                 /rig/operating_point:=/brake1/point"
            )
        );
        let deaf = BusOptions { no_ros: true, no_shm: true, ..options() };
        assert_eq!(deaf.resolve(RosArgs::default()).expect("no buses").sources(), InputSources::default());
    }
}

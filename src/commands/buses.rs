//! Options for the buses that a command joins.

use clap::Args;

use crate::bus::ros_args::RosArgs;
use crate::bus::ros2::{NODE_NAME, Ros2Error, Ros2Options};
use crate::bus::shm::ShmOptions;
use crate::msgs::shm::{Form, OperatingPointForm};
use crate::msgs::topic;
use crate::node::status::InputSources;

/// Which buses to join, and how
#[derive(Clone, Debug, Args)]
pub struct BusOptions {
    /// Do not join ROS 2
    #[arg(long)]
    no_ros: bool,
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

impl BusOptions {
    /// The options for `demo`, which must not be mistaken for a rig: visible on this machine only, with its own
    /// shared-memory names.
    pub fn for_demo(&self) -> Self {
        let shm_prefix = if self.shm_prefix.is_empty() { "demo/".to_owned() } else { self.shm_prefix.clone() };
        Self { loopback: true, shm_prefix, ..self.clone() }
    }

    /// Options of ROS 2; `None` if the command does not join it.
    pub fn ros2(&self, args: RosArgs) -> Result<Option<Ros2Options>, Ros2Error> {
        if self.no_ros { Ok(None) } else { Ros2Options::new(self.domain, self.loopback, args).map(Some) }
    }

    /// Options of shared memory; `None` if the command does not join it.
    pub fn shm(&self) -> Option<ShmOptions> {
        (!self.no_shm).then(|| ShmOptions { service_prefix: self.shm_prefix.clone(), ..Default::default() })
    }

    /// Where a node with these options and with `ros2` expects its inputs, and the command that simulates them.
    pub fn sources(&self, ros2: Option<&Ros2Options>) -> InputSources {
        let topic = ros2.map(|ros2| {
            let name = ros2.args.node_name(NODE_NAME);
            ros2.args.topic(topic::relative(topic::OPERATING_POINT), &ros2.args.namespace(&name, "/"), &name)
        });
        let service = self.shm().map(|shm| format!("{}{}", shm.service_prefix, OperatingPointForm::SERVICE));
        let start = (topic.is_some() || service.is_some()).then(|| {
            let mut command = "squealcast simulate".to_owned();
            for (given, option) in [(self.no_ros, "--no-ros"), (self.no_shm, "--no-shm"), (self.loopback, "--loopback")]
            {
                if given {
                    command += &format!(" {option}");
                }
            }
            if let Some(ros2) = ros2.filter(|ros2| ros2.domain_id != 0) {
                command += &format!(" --domain {}", ros2.domain_id);
            }
            if !self.no_shm && !self.shm_prefix.is_empty() {
                command += &format!(" --shm-prefix {}", self.shm_prefix);
            }
            if let Some(topic) = topic.as_ref().filter(|topic| *topic != topic::OPERATING_POINT) {
                command += &format!(" --ros-args -r {}:={topic}", topic::OPERATING_POINT);
            }
            command
        });
        InputSources { topic, domain: ros2.map(|ros2| ros2.domain_id), service, start }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn options() -> BusOptions {
        BusOptions { no_ros: false, no_shm: false, domain: Some(7), loopback: true, shm_prefix: "cell2/".to_owned() }
    }

    #[test]
    fn the_simulator_command_publishes_on_the_topic_of_the_node() {
        let arguments = ["--ros-args", "-r", "/rig/operating_point:=/brake1/point"].map(str::to_owned);
        let (args, _) = RosArgs::split(arguments).expect("rules");
        let buses = options();
        let ros2 = buses.ros2(args).expect("a domain");
        let sources = buses.sources(ros2.as_ref());
        assert_eq!((sources.topic.as_deref(), sources.domain), (Some("/brake1/point"), Some(7)));
        assert_eq!(sources.service.as_deref(), Some("cell2/rig/operating_point"));
        assert_eq!(
            sources.start.as_deref(),
            Some(
                "squealcast simulate --loopback --domain 7 --shm-prefix cell2/ --ros-args -r \
                 /rig/operating_point:=/brake1/point"
            )
        );
        let deaf = BusOptions { no_ros: true, no_shm: true, ..options() };
        assert_eq!(deaf.sources(None), InputSources::default());
    }
}

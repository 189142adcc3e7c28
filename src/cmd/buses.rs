//! The buses a command joins, by option.

use clap::Args;

use crate::io::ros_args::RosArgs;
use crate::io::ros2::{Ros2Error, Ros2Options};
use crate::io::shm::ShmOptions;

/// Which buses to join, and how
#[derive(Clone, Debug, Args)]
pub struct BusOptions {
    /// Stay off ROS 2
    #[arg(long)]
    no_ros: bool,
    /// Stay off shared memory
    #[arg(long)]
    no_shm: bool,
    /// ROS 2 domain, 0 to 232 [default: ROS_DOMAIN_ID, else 0]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(0..=232))]
    domain: Option<u16>,
    /// Announce on 127.0.0.1 only, and hear nothing but the loopback interface
    #[arg(long)]
    loopback: bool,
    /// Put this before the names of the shared-memory services
    #[arg(long, value_name = "PREFIX", default_value = "")]
    shm_prefix: String,
}

impl BusOptions {
    /// A demonstration must not pass for a rig: on this machine only, under shared-memory names of its own.
    pub fn for_demo(&self) -> Self {
        let shm_prefix = if self.shm_prefix.is_empty() { "demo/".to_owned() } else { self.shm_prefix.clone() };
        Self { loopback: true, shm_prefix, ..self.clone() }
    }

    /// ROS 2 as asked for; `None` where the command is to stay off it.
    pub fn ros2(&self, args: RosArgs) -> Result<Option<Ros2Options>, Ros2Error> {
        if self.no_ros { Ok(None) } else { Ros2Options::new(self.domain, self.loopback, args).map(Some) }
    }

    /// Shared memory as asked for; `None` where the command is to stay off it.
    pub fn shm(&self) -> Option<ShmOptions> {
        (!self.no_shm).then(|| ShmOptions { service_prefix: self.shm_prefix.clone(), ..Default::default() })
    }
}

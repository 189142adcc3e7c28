use clap::Args;

use super::Outcome;
use crate::bus::ros2::side;
use crate::session::settings;

/// The ROS 2 side of a node, which `run` and `demo` start: not for the command line
#[derive(Debug, Args)]
pub struct Options {}

impl Options {
    pub fn run(self) -> anyhow::Result<Outcome> {
        side::serve(
            |name, value| settings::validate(name, value).map(drop).map_err(|error| error.to_string()),
            |name| settings::find(name).map(|known| (known.description, [known.low, known.high])),
        )?;
        Ok(Outcome::Done)
    }
}

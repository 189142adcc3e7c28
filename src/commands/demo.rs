use std::sync::Arc;
use std::time::{Duration, Instant};

use clap::Args;

use super::buses::BusOptions;
use super::run::{Inputs, NodeOptions, serve};
use super::simulate::{Measuring, VibrationOption, period, rate_hz};
use super::simulated_sound::LiveSound;
use super::{Outcome, not_negative};
use crate::bus::ros_args::RosArgs;
use crate::bus::{Bus, Received, Sink};
use crate::node::{Incoming, Inlet, Watch};
use crate::rig::{EMBEDDED, Rig};
use crate::simulator::{Profile, Simulator};
use crate::system::clock;

const EXAMPLES: &str = "\
Examples:
  squealcast demo                                   a simulated session, with a page and a table
  squealcast demo nine-dof-case-2 --no-ros --plain  another rig, on shared memory only, as a log";

/// Run the node with a simulated rig, to try it out: modes that are predicted to be unstable sound, and the node hears
/// them. It takes no other inputs and is visible on this machine only
#[derive(Debug, Args)]
#[command(after_help = super::with_ros_args(EXAMPLES))]
pub struct Options {
    /// Rig file, or the name of an embedded rig
    #[arg(default_value = EMBEDDED[0].name, value_parser = super::RigName, hide_possible_values = true)]
    rig: String,
    /// Measurements per second
    #[arg(long, value_name = "HZ", value_parser = rate_hz, default_value = "100")]
    rate: f64,
    /// Seed of the noise
    #[arg(long, value_name = "N", default_value_t = 1)]
    seed: u64,
    /// Stop after this many seconds
    #[arg(long, value_name = "S", value_parser = not_negative)]
    duration: Option<f64>,
    #[command(flatten)]
    vibration: VibrationOption,
    #[command(flatten)]
    buses: BusOptions,
    #[command(flatten)]
    shown: NodeOptions,
}

impl Options {
    pub fn run(self, ros_args: RosArgs) -> anyhow::Result<Outcome> {
        let rig = Arc::new(Rig::load(&self.rig)?);
        let period = period(self.rate);
        let mut measuring = Measuring::new(Simulator::new(Profile::demo(), self.seed), self.vibration, period);
        let (duration, seed) = (self.duration, self.seed);
        let simulate = move |node: Inlet, watch: Watch| {
            let started = Instant::now();
            let mut microphone = LiveSound::new(seed, clock::now_ns());
            for seq in 0u32.. {
                let time_s = measuring.time_s(seq);
                if duration.is_some_and(|duration| time_s >= duration) {
                    node.stop();
                    return;
                }
                let due = started + Duration::from_secs_f64(time_s);
                std::thread::sleep(due.saturating_duration_since(Instant::now()));
                while let Some(block) = microphone.next_before(time_s, || watch.snapshot().prediction) {
                    node.waveform(Received::now(Bus::Simulator, block));
                }
                let (conditions, vibration) = measuring.measure(seq, clock::now_ns());
                let conditions = Incoming::Input(Received::now(Bus::Simulator, conditions));
                let vibration = vibration.map(|measured| Incoming::Vibration(Received::now(Bus::Simulator, measured)));
                for measured in std::iter::once(conditions).chain(vibration) {
                    if !node.send(measured) {
                        return;
                    }
                }
            }
        };
        let inputs = Inputs::Simulator(Box::new(simulate));
        serve(&rig, &self.buses.for_demo(), &self.shown, ros_args, inputs, None)
    }
}

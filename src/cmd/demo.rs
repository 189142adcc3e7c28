use std::sync::Arc;
use std::time::{Duration, Instant};

use clap::Args;

use super::buses::BusOptions;
use super::run::{Listening, NodeOptions, serve};
use super::simulate::{period, rate_hz};
use super::{Outcome, not_negative};
use crate::io::clock;
use crate::io::heard::{Bus, Heard};
use crate::io::ros_args::RosArgs;
use crate::node::{self, Incoming};
use crate::rig::Rig;
use crate::simulator::{Profile, Simulator};
use crate::wire::{Header, OperatingPoint, Time};

/// Run the node with a simulated rig: what to try first. It hears nobody else, and announces itself on this machine only
#[derive(Debug, Args)]
pub struct Options {
    /// Rig file, or the name of an embedded rig
    #[arg(default_value = "nine-dof-case-2")]
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
    buses: BusOptions,
    #[command(flatten)]
    shown: NodeOptions,
}

impl Options {
    pub fn run(self, ros_args: RosArgs) -> anyhow::Result<Outcome> {
        let rig = Arc::new(Rig::load(&self.rig)?);
        let (sender, receiver) = node::channel();
        let period = period(self.rate);
        let mut simulator = Simulator::new(Profile::paper(), self.seed);
        let (measurements, duration) = (sender.clone(), self.duration);
        std::thread::spawn(move || {
            let started = Instant::now();
            for seq in 0u32.. {
                let time_s = period.as_secs_f64() * f64::from(seq);
                if duration.is_some_and(|duration| time_s >= duration) {
                    let _ = measurements.send(Incoming::Stop);
                    return;
                }
                let due = started + Duration::from_secs_f64(time_s);
                std::thread::sleep(due.saturating_duration_since(Instant::now()));
                let message = measurement(&mut simulator, time_s, u64::from(seq), clock::now_ns());
                if measurements.send(Incoming::Input(Heard::now(Bus::Simulator, message))).is_err() {
                    return;
                }
            }
        });
        serve(&rig, &self.buses.for_demo(), &self.shown, ros_args, Listening::ToNobody, (sender, receiver))
    }
}

/// What the simulated rig measures, as a message.
pub fn measurement(simulator: &mut Simulator, time_s: f64, seq: u64, stamp_ns: i64) -> OperatingPoint {
    let point = simulator.measure(time_s);
    OperatingPoint {
        header: Header { stamp: Time::from_ns(stamp_ns), frame_id: "simulated".to_owned() },
        seq,
        normal_load_n: point.normal_load_n,
        disc_speed_rad_s: point.disc_speed_rad_s,
        friction_coefficient: point.friction_coefficient,
    }
}

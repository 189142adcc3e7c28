use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use anyhow::{Context, ensure};
use clap::Args;

use super::buses::BusOptions;
use super::demo::measurement;
use super::{Outcome, finite, not_negative, signals};
use crate::io::clock;
use crate::io::ros_args::RosArgs;
use crate::io::ros2::Ros2Source;
use crate::io::shm::ShmSource;
use crate::offline;
use crate::rig::Rig;
use crate::simulator::{Profile, Simulator};

/// Publish simulated conditions, or record a simulated session
#[derive(Debug, Args)]
pub struct Options {
    /// Profile of load, speed and friction coefficient, TOML [default: the paper's test, then a ramp from 0 to 1]
    #[arg(long, value_name = "FILE")]
    profile: Option<PathBuf>,
    /// Seed of the noise
    #[arg(long, value_name = "N", default_value_t = 1)]
    seed: u64,
    /// Measurements per second
    #[arg(long, value_name = "HZ", value_parser = rate_hz, default_value = "100")]
    rate: f64,
    /// Stop after this many seconds [default: never; with --record after one round of the profile]
    #[arg(long, value_name = "S", value_parser = not_negative)]
    duration: Option<f64>,
    /// Publish nothing; predict with --rig as fast as possible and record the session into this directory
    #[arg(long, value_name = "DIR", requires = "rig")]
    record: Option<PathBuf>,
    /// Rig file, or the name of an embedded rig, for --record
    #[arg(long, value_name = "RIG", requires = "record")]
    rig: Option<String>,
    #[command(flatten)]
    buses: BusOptions,
}

/// The highest rate of measurements, 1/s.
const MAX_RATE_HZ: f64 = 1e5;

/// A rate of measurements in 1/s, for clap.
pub fn rate_hz(text: &str) -> Result<f64, String> {
    let rate = finite(text)?;
    if rate > 0.0 && rate <= MAX_RATE_HZ {
        Ok(rate)
    } else {
        Err(format!("{rate} is not more than 0 up to {MAX_RATE_HZ}"))
    }
}

/// Time between measurements at a [`rate_hz`].
pub fn period(rate_hz: f64) -> Duration {
    Duration::from_secs_f64(1.0 / rate_hz)
}

impl Options {
    pub fn run(self, ros_args: RosArgs) -> anyhow::Result<Outcome> {
        let profile = self.profile.as_deref().map(Profile::load).transpose()?.unwrap_or_else(Profile::paper);
        let period = period(self.rate);
        if let (Some(directory), Some(rig)) = (&self.record, &self.rig) {
            let rig = Arc::new(Rig::load(rig)?);
            let duration_s = self.duration.unwrap_or(profile.duration_s());
            let mut simulator = Simulator::new(profile, self.seed);
            let measurements = (0u32..).map(|seq| (seq, period.as_secs_f64() * f64::from(seq)));
            let inputs = measurements.take_while(|&(_, time_s)| time_s < duration_s).map(|(seq, time_s)| {
                let stamp_ns = offline::START_NS + (time_s * 1e9).round() as i64;
                measurement(&mut simulator, time_s, u64::from(seq), stamp_ns)
            });
            let written = offline::record(&rig, inputs, directory)?;
            eprintln!("{}", written.display());
            return Ok(Outcome::Done);
        }
        self.publish(profile, period, ros_args)
    }

    fn publish(&self, profile: Profile, period: Duration, ros_args: RosArgs) -> anyhow::Result<Outcome> {
        let shm = self.buses.shm().map(|shm| ShmSource::new(&shm)).transpose();
        let shm = shm.context("shared memory; --no-shm stays off it")?;
        let ros2 = self.buses.ros2(ros_args)?.map(|ros2| Ros2Source::start(&ros2, |_| {})).transpose();
        let ros2 = ros2.context("ROS 2; --no-ros stays off it")?;
        ensure!(shm.is_some() || ros2.is_some(), "nothing to publish to: both --no-shm and --no-ros are given");
        let stopped = Arc::new(AtomicBool::new(false));
        let stop = stopped.clone();
        signals::on_stop(move || stop.store(true, Ordering::Relaxed))?;
        let mut simulator = Simulator::new(profile, self.seed);
        let started = Instant::now();
        for seq in 0u32.. {
            let time_s = period.as_secs_f64() * f64::from(seq);
            if self.duration.is_some_and(|duration| time_s >= duration) {
                break;
            }
            signals::wait_until(started + Duration::from_secs_f64(time_s), &stopped);
            if stopped.load(Ordering::Relaxed) {
                break;
            }
            let message = measurement(&mut simulator, time_s, u64::from(seq), clock::now_ns());
            if let Some(shm) = &shm {
                shm.publish(&message)?;
            }
            if let Some(ros2) = &ros2 {
                ros2.publish(&message)?;
            }
        }
        Ok(Outcome::Done)
    }
}

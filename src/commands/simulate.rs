use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use clap::Args;

use super::buses::BusOptions;
use super::simulated_modes::SimulatedModes;
use super::simulated_sound::{LiveSound, SoundOptions};
use super::{Outcome, finite, not_negative, positive, signals};
use crate::bus::Outgoing;
use crate::bus::ros_args::RosArgs;
use crate::msgs::{Header, OperatingPoint, Time, Vibration};
use crate::offline::{self, Measured, Quantity};
use crate::rig::Rig;
use crate::simulator::{self, Peak, Profile, Simulator, Tone};
use crate::system::clock;

const EXAMPLES: &str = "\
Examples:
  squealcast simulate --rate 200                           conditions for a node on this machine
  squealcast simulate --record simulated --rig tribometer  a recorded session, as fast as possible";

/// Publish simulated conditions, or record a simulated session
#[derive(Debug, Args)]
#[command(after_help = super::with_ros_args(EXAMPLES))]
pub struct Options {
    /// Profile of load, speed and friction coefficient, TOML [default: the paper's test, then a ramp from 0 to 1]
    #[arg(long, value_name = "PROFILE.toml")]
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
    /// Publish nothing; predict with --rig as fast as possible and record the session in this directory
    #[arg(long, value_name = "DIR", requires = "rig")]
    record: Option<PathBuf>,
    /// Rig file, or the name of an embedded rig, for --record
    #[arg(long, value_name = "RIG", requires = "record")]
    rig: Option<String>,
    /// Also publish what a microphone hears, in Pa on /rig/waveform: modes of this rig that are unstable at the conditions grow
    /// at their rates up to 95 dB(A)
    #[arg(long, value_name = "RIG", conflicts_with = "record")]
    sound_of: Option<String>,
    #[command(flatten)]
    sound: SoundOptions,
    #[command(flatten)]
    vibration: VibrationOption,
    #[command(flatten)]
    buses: BusOptions,
}

/// Whether the simulated rig measures its vibration.
#[derive(Clone, Copy, Debug, Args)]
pub struct VibrationOption {
    /// Also measure the vibration, 20 times a second: 95 dB at HZ while friction is above MU, else noise of 50 dB
    #[arg(long = "vibration", value_name = "MU:HZ", value_parser = tone)]
    pub tone: Option<Tone>,
}

fn tone(text: &str) -> Result<Tone, String> {
    let (mu, hz) = text.split_once(':').ok_or("not a friction coefficient and a frequency, such as 0.36:1500")?;
    Ok(Tone { above_mu: finite(mu)?, frequency_hz: positive(hz)? })
}

/// Interval between measurements of the vibration, s.
const VIBRATION_EVERY_S: f64 = 0.05;

/// A simulated rig with its measurements.
pub struct Measuring {
    simulator: Simulator,
    tone: Option<Tone>,
    period_s: f64,
}

impl Measuring {
    /// A rig that measures the operating point every `period` and, if requested, the vibration.
    pub fn new(simulator: Simulator, vibration: VibrationOption, period: Duration) -> Self {
        Self { simulator, tone: vibration.tone, period_s: period.as_secs_f64() }
    }

    /// Time of a measurement, s since the start.
    pub fn time_s(&self, seq: u32) -> f64 {
        self.period_s * f64::from(seq)
    }

    /// The messages of a measurement.
    pub fn measure(&mut self, seq: u32, stamp_ns: i64) -> (OperatingPoint, Option<Vibration>) {
        let time_s = self.time_s(seq);
        let header = Header { stamp: Time::from_ns(stamp_ns), frame_id: simulator::FRAME_ID.to_owned() };
        let every = (VIBRATION_EVERY_S / self.period_s).round().max(1.0) as u32;
        let tone = self.tone.filter(|_| seq.is_multiple_of(every));
        let vibration = tone.map(|tone| {
            let Peak { frequency_hz, level_db } = self.simulator.measure_vibration(tone, time_s);
            Vibration { header: header.clone(), frequency_hz, level_db }
        });
        let point = self.simulator.measure(time_s);
        let point = OperatingPoint {
            header,
            seq: seq.into(),
            normal_load_n: point.normal_load_n,
            disc_speed_rad_s: point.disc_speed_rad_s,
            friction_coefficient: point.friction_coefficient,
        };
        (point, vibration)
    }
}

/// Highest rate of measurements, 1/s.
const MAX_RATE_HZ: f64 = 1e5;

/// Parses a rate of measurements in 1/s, for clap.
pub fn rate_hz(text: &str) -> Result<f64, String> {
    let rate = finite(text)?;
    if rate > 0.0 && rate <= MAX_RATE_HZ {
        Ok(rate)
    } else {
        Err(format!("{rate} is not more than 0 up to {MAX_RATE_HZ}"))
    }
}

/// Time between measurements at a rate in 1/s.
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
            let mut measuring = Measuring::new(Simulator::new(profile, self.seed), self.vibration, period);
            let measured = (0u32..).map_while(|seq| {
                let time_s = measuring.time_s(seq);
                let stamp_ns = offline::START_NS + (time_s * 1e9).round() as i64;
                (time_s < duration_s).then(|| measuring.measure(seq, stamp_ns))
            });
            let measured = measured.flat_map(|(conditions, vibration)| {
                let vibration = vibration.map(|vibration| Measured::at_its_stamp(Quantity::Vibration(vibration)));
                vibration.into_iter().chain([Measured::at_its_stamp(Quantity::Conditions(conditions))])
            });
            // A simulation cannot be run twice, so no inputs are known in advance.
            let predicted = offline::record(&rig, None, std::iter::empty(), measured, None, directory)?;
            note!("{}", predicted.directory.display());
            self.sound.write(&predicted.directory, self.seed)?;
            return Ok(Outcome::Done);
        }
        self.publish(profile, period, ros_args)
    }

    fn publish(&self, profile: Profile, period: Duration, ros_args: RosArgs) -> anyhow::Result<Outcome> {
        let mut buses =
            self.buses.resolve(ros_args)?.join_as_rig(self.vibration.tone.is_some(), self.sound_of.is_some())?;
        let rig = self.sound_of.as_deref().map(Rig::load).transpose()?.map(Arc::new);
        let stopped = Arc::new(AtomicBool::new(false));
        let stop = stopped.clone();
        signals::on_stop(move || stop.store(true, Ordering::Relaxed))?;
        let mut measuring = Measuring::new(Simulator::new(profile, self.seed), self.vibration, period);
        let mut microphone = rig.map(|rig| (SimulatedModes::start(rig), LiveSound::new(self.seed, clock::now_ns())));
        let started = Instant::now();
        for seq in 0u32.. {
            let time_s = measuring.time_s(seq);
            if self.duration.is_some_and(|duration| time_s >= duration) {
                break;
            }
            signals::wait_until(started + Duration::from_secs_f64(time_s), &stopped);
            if stopped.load(Ordering::Relaxed) {
                break;
            }
            let (conditions, vibration) = measuring.measure(seq, clock::now_ns());
            if let Some((modes, sound)) = &mut microphone {
                while let Some(block) = sound.next_before(time_s, || modes.latest()) {
                    for bus in &mut buses {
                        bus.publish(Outgoing::Waveform(&block))?;
                    }
                }
                modes.measured(&conditions);
            }
            for bus in &mut buses {
                bus.publish(Outgoing::OperatingPoint(&conditions))?;
                if let Some(vibration) = &vibration {
                    bus.publish(Outgoing::Vibration(vibration))?;
                }
            }
        }
        Ok(Outcome::Done)
    }
}

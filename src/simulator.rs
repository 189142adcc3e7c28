//! The rig simulator: load, speed and friction coefficient over time and the resulting vibration, with seeded noise.

use serde::Deserialize;

use crate::files::input_file;
use crate::physics::OperatingPoint;
use crate::random::Random;

/// The `frame_id` of simulated measurements, by which recordings and displays recognise them.
pub const FRAME_ID: &str = "simulated";

/// Conditions over time: linear between points, with noise added.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Profile {
    /// Points in ascending time. Before the first and after the last the value is constant.
    pub point: Vec<ProfilePoint>,
    /// Standard deviations of the noise.
    #[serde(default)]
    pub noise: Noise,
}

/// One point of a profile.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ProfilePoint {
    pub time_s: f64,
    pub normal_load_n: f64,
    pub disc_speed_rad_s: f64,
    pub friction_coefficient: f64,
}

/// Standard deviations of the measured values around the profile.
#[derive(Clone, Copy, Debug, Default, PartialEq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Noise {
    pub normal_load_n: f64,
    pub disc_speed_rad_s: f64,
    pub friction_coefficient: f64,
}

/// Why a profile was refused.
#[derive(Debug, thiserror::Error)]
pub enum ProfileError {
    #[error("{file}: {source}")]
    Read { file: String, source: std::io::Error },
    #[error("{file}: {source}")]
    Parse { file: String, source: Box<toml::de::Error> },
    #[error("{file}: `point` is empty, expected at least one [[point]]")]
    Empty { file: String },
    #[error("{file}: `{field}` of point {point} is {value}, expected a finite number")]
    NotFinite { file: String, field: &'static str, point: usize, value: f64 },
    #[error("{file}: `time_s` of point {point} is {time_s}, expected more than {before} of the point before")]
    Order { file: String, point: usize, time_s: f64, before: f64 },
    #[error("{file}: noise `{field}` is {value}, expected a finite number of at least 0")]
    Noise { file: String, field: &'static str, value: f64 },
}

impl Profile {
    /// The paper's test (500 N, 13 rad/s, friction coefficients between 0.3 and 0.4), then a ramp from 0 to 1.
    pub fn paper() -> Self {
        Self::of_friction(&[
            (0.0, 0.30),
            (3.0, 0.40),
            (6.0, 0.32),
            (9.0, 0.38),
            (12.0, 0.30),
            (14.0, 0.0),
            (24.0, 1.0),
            (27.0, 1.0),
            (30.0, 0.30),
        ])
    }

    /// The same parts in an order that soon reaches squeal: a ramp up to 1 and back, then the paper's test.
    pub fn demo() -> Self {
        Self::of_friction(&[
            (0.0, 0.35),
            (3.0, 0.40),
            (10.0, 1.0),
            (13.0, 1.0),
            (18.0, 0.30),
            (21.0, 0.40),
            (24.0, 0.32),
            (27.0, 0.38),
            (30.0, 0.35),
        ])
    }

    /// A profile with the paper's load and speed and the given friction coefficients `(time_s, value)`, with noise.
    fn of_friction(corners: &[(f64, f64)]) -> Self {
        let point = |&(time_s, friction_coefficient): &(f64, f64)| ProfilePoint {
            time_s,
            normal_load_n: 500.0,
            disc_speed_rad_s: 13.0,
            friction_coefficient,
        };
        let noise = Noise { normal_load_n: 2.0, disc_speed_rad_s: 0.02, friction_coefficient: 0.002 };
        Self { point: corners.iter().map(point).collect(), noise }
    }

    /// Loads a profile from a TOML file.
    ///
    /// # Errors
    /// [`ProfileError`], naming file, field, value and limit.
    pub fn load(path: &std::path::Path) -> Result<Self, ProfileError> {
        let file = path.display().to_string();
        let text = input_file::read_text(path, input_file::TOML)
            .map_err(|source| ProfileError::Read { file: file.clone(), source })?;
        Self::parse(&file, &text)
    }

    fn parse(file: &str, text: &str) -> Result<Self, ProfileError> {
        let file = file.to_owned();
        let profile: Self = toml::from_str(text)
            .map_err(|source| ProfileError::Parse { file: file.clone(), source: Box::new(source) })?;
        if profile.point.is_empty() {
            return Err(ProfileError::Empty { file });
        }
        let mut before = f64::NEG_INFINITY;
        for (point, corner) in profile.point.iter().enumerate() {
            let fields = [
                ("time_s", corner.time_s),
                ("normal_load_n", corner.normal_load_n),
                ("disc_speed_rad_s", corner.disc_speed_rad_s),
                ("friction_coefficient", corner.friction_coefficient),
            ];
            if let Some((field, value)) = fields.into_iter().find(|(_, value)| !value.is_finite()) {
                return Err(ProfileError::NotFinite { file, field, point, value });
            }
            if corner.time_s <= before {
                return Err(ProfileError::Order { file, point, time_s: corner.time_s, before });
            }
            before = corner.time_s;
        }
        let noise = profile.noise;
        let fields = [
            ("normal_load_n", noise.normal_load_n),
            ("disc_speed_rad_s", noise.disc_speed_rad_s),
            ("friction_coefficient", noise.friction_coefficient),
        ];
        match fields.into_iter().find(|(_, value)| !(value.is_finite() && *value >= 0.0)) {
            Some((field, value)) => Err(ProfileError::Noise { file, field, value }),
            None => Ok(profile),
        }
    }

    /// Length, s.
    pub fn duration_s(&self) -> f64 {
        self.point.last().map_or(0.0, |last| last.time_s)
    }

    /// The conditions at a time without noise; `None` for an empty profile.
    fn at(&self, time_s: f64) -> Option<OperatingPoint> {
        let after = self.point.partition_point(|corner| corner.time_s <= time_s);
        let left = self.point.get(after.saturating_sub(1))?;
        let right = self.point.get(after).unwrap_or(left);
        let span = right.time_s - left.time_s;
        let s = if span > 0.0 { ((time_s - left.time_s) / span).clamp(0.0, 1.0) } else { 0.0 };
        let between = |a: f64, b: f64| a + s * (b - a);
        Some(OperatingPoint {
            normal_load_n: between(left.normal_load_n, right.normal_load_n),
            disc_speed_rad_s: between(left.disc_speed_rad_s, right.disc_speed_rad_s),
            friction_coefficient: between(left.friction_coefficient, right.friction_coefficient),
        })
    }
}

/// Squeal of the simulated rig: a tone of this frequency while the friction coefficient (without noise) exceeds
/// `above_mu`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Tone {
    pub above_mu: f64,
    pub frequency_hz: f64,
}

/// Highest peak of a measured vibration spectrum.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Peak {
    pub frequency_hz: f64,
    pub level_db: f64,
}

/// Level of the tone, and of the background noise, dB.
const TONE_DB: f64 = 95.0;
const BACKGROUND_DB: f64 = 50.0;
/// Standard deviation of both levels.
const LEVEL_NOISE_DB: f64 = 2.0;

/// A simulated rig. Equal seeds give equal measurements.
#[derive(Clone, Debug)]
pub struct Simulator {
    profile: Profile,
    noise: Random,
    /// A separate random stream, so that measuring vibration does not change the conditions.
    vibration_noise: Random,
}

impl Simulator {
    /// A rig that repeats `profile` periodically.
    pub fn new(profile: Profile, seed: u64) -> Self {
        Self { profile, noise: Random::new(seed), vibration_noise: Random::stream(seed, 1) }
    }

    /// The conditions at a time since the start, without noise.
    fn truth(&self, time_s: f64) -> OperatingPoint {
        let period = self.profile.duration_s();
        let phase = if period > 0.0 { time_s.rem_euclid(period) } else { 0.0 };
        let nothing = OperatingPoint { normal_load_n: 0.0, disc_speed_rad_s: 0.0, friction_coefficient: 0.0 };
        self.profile.at(phase).unwrap_or(nothing)
    }

    /// The highest peak of the vibration spectrum at a time since the start. While the tone sounds, within 0.2 % of its
    /// frequency; otherwise uniformly distributed up to twice that frequency.
    pub fn measure_vibration(&mut self, tone: Tone, time_s: f64) -> Peak {
        let sounds = self.truth(time_s).friction_coefficient > tone.above_mu;
        let place = self.vibration_noise.uniform();
        let level_noise_db = LEVEL_NOISE_DB * self.vibration_noise.normal();
        if sounds {
            let frequency_hz = tone.frequency_hz * (1.0 + 0.004 * (place - 0.5));
            Peak { frequency_hz, level_db: TONE_DB + level_noise_db }
        } else {
            Peak { frequency_hz: 2.0 * tone.frequency_hz * place, level_db: BACKGROUND_DB + level_noise_db }
        }
    }

    /// The measured conditions at a time since the start. Each call draws new noise.
    pub fn measure(&mut self, time_s: f64) -> OperatingPoint {
        let point = self.truth(time_s);
        let Noise { normal_load_n, disc_speed_rad_s, friction_coefficient } = self.profile.noise;
        OperatingPoint {
            normal_load_n: (point.normal_load_n + normal_load_n * self.noise.normal()).max(0.0),
            disc_speed_rad_s: point.disc_speed_rad_s + disc_speed_rad_s * self.noise.normal(),
            friction_coefficient: (point.friction_coefficient + friction_coefficient * self.noise.normal()).max(0.0),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn follows_the_profile_and_repeats_with_the_seed() {
        let mut quiet = Profile::paper();
        quiet.noise = Noise::default();
        let mut simulator = Simulator::new(quiet, 1);
        assert!((simulator.measure(19.0).friction_coefficient - 0.5).abs() < 1e-12);
        assert!((simulator.measure(49.0).friction_coefficient - 0.5).abs() < 1e-12, "it repeats after 30 s");
        let run = |seed| {
            let mut simulator = Simulator::new(Profile::paper(), seed);
            (0..100).map(|k| simulator.measure(0.01 * f64::from(k)).normal_load_n).collect::<Vec<_>>()
        };
        assert_eq!(run(7), run(7));
        assert_ne!(run(7), run(8));
        let mean = run(7).iter().sum::<f64>() / 100.0;
        assert!((mean - 500.0).abs() < 1.0, "2 N of noise, a hundred times: {mean}");
    }

    #[test]
    fn it_sounds_above_the_limit_and_the_conditions_do_not_depend_on_whether_that_is_measured() {
        let tone = Tone { above_mu: 0.5, frequency_hz: 1500.0 };
        let (mut heard, mut unheard) = (Simulator::new(Profile::paper(), 3), Simulator::new(Profile::paper(), 3));
        for k in 0..3000 {
            // Sampled between hundredths of a second: at 19 s the friction coefficient equals the limit up to rounding.
            let time_s = 0.01 * f64::from(k) + 0.005;
            let peak = heard.measure_vibration(tone, time_s);
            // The ramp from 0 at 14 s to 1 at 24 s, and back from 27 s to 0.3 at 30 s.
            let sounds = (19.0..27.0 + 3.0 * 0.5 / 0.7).contains(&time_s);
            assert_eq!(peak.level_db > 70.0, sounds, "{peak:?} at {time_s} s");
            assert!(!sounds || (peak.frequency_hz / 1500.0 - 1.0).abs() <= 0.002, "{peak:?}");
            assert_eq!(heard.measure(time_s), unheard.measure(time_s));
        }
    }

    #[test]
    fn bad_profiles_name_field_value_and_limit() {
        let corner = "[[point]]\ntime_s = 0\nnormal_load_n = 1\ndisc_speed_rad_s = 1\nfriction_coefficient = 0.1\n";
        let error = |text: &str| Profile::parse("p.toml", text).unwrap_err().to_string();
        assert!(error("point = []").contains("p.toml: `point` is empty"));
        assert!(error(&format!("{corner}{corner}")).contains("`time_s` of point 1 is 0, expected more than 0"));
        assert!(error(&corner.replace("0.1", "nan")).contains("`friction_coefficient` of point 0 is NaN"));
        assert!(error(&format!("{corner}[noise]\nnormal_load_n = -1")).contains("noise `normal_load_n` is -1"));
        assert!(error(&format!("{corner}loud = 1")).contains("unknown field `loud`"));
    }
}

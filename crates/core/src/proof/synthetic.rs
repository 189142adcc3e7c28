//! Random rigs with the structure of a tribometer, reproducible from a seed, for tests and benchmarks. They do not
//! represent a real rig, but have disc doublets, smooth shapes on a patch of contact pairs and frequencies from 0.3
//! to 10 kHz.

use faer::Mat;

use crate::physics::{ContactLaw, ContactPairs, Law, Model, ModelError, Term};

/// A pseudo-random stream, uniform in `[-1, 1)` (Marsaglia's xorshift, 2003), identical on every machine.
#[derive(Clone, Debug)]
pub struct Uniform(u64);

impl Uniform {
    /// The stream of a seed.
    pub fn new(seed: u64) -> Self {
        Self(seed.wrapping_add(1).wrapping_mul(0x9E37_79B9_7F4A_7C15) | 1)
    }

    /// The next number of the stream.
    pub fn draw(&mut self) -> f64 {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        (self.0 >> 11) as f64 / (1u64 << 52) as f64 - 1.0
    }
}

/// Parameters of a synthetic rig.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Synthetic {
    /// Total number of modes, half of them the pad's and half the disc's.
    pub modes: usize,
    /// Number of contact pairs.
    pub pairs: usize,
    /// Damping ratio of every mode; 0 for an undamped rig.
    pub damping_ratio: f64,
    /// Parameters of contact and friction.
    pub contact_law: ContactLaw,
    /// Seed of the random stream: the same seed gives the same rig.
    pub seed: u64,
}

/// Total contact stiffness of all pairs, N/m.
const STIFFNESS_N_PER_M: f64 = 4e7;
/// Amplitude of a mass-normalised shape, kg^-1/2: that of a part of about 2 kg.
const AMPLITUDE: f64 = 0.7;

/// Builds the rig.
///
/// # Errors
/// [`ModelError`] if `contact_law` is not valid.
pub fn rig(synthetic: &Synthetic) -> Result<Model, ModelError> {
    let Synthetic { modes, pairs, damping_ratio, contact_law, seed } = *synthetic;
    let mut uniform = Uniform::new(seed);
    let pad = modes / 2;
    let disc = modes - pad;
    let between = |low: f64, high: f64, share: f64| std::f64::consts::TAU * low * (high / low).powf(share);
    let mut omega: Vec<f64> =
        (0..pad).map(|k| between(300.0, 1e4, (k as f64 + 0.5 + 0.4 * uniform.draw()) / pad as f64)).collect();
    for k in 0..disc {
        // Doublets, split by up to 5e-4, relative.
        let split = if k % 2 == 1 { 1.0 + 5e-4 * uniform.draw().abs() } else { 1.0 };
        let rank = (k - k % 2) as f64 + 0.5;
        omega.push(between(400.0, 1e4, rank / disc as f64) * split);
    }
    // The contact patch is a sector of a ring, 0.08 to 0.12 m from the axis and 0.5 rad wide.
    let place: Vec<(f64, f64)> = (0..pairs).map(|_| (0.25 * uniform.draw(), 0.1 + 0.02 * uniform.draw())).collect();
    let (mut normal, mut sliding, mut lateral) =
        (Mat::zeros(pairs, modes), Mat::zeros(pairs, modes), Mat::zeros(pairs, modes));
    for k in 0..modes {
        let on_disc = k >= pad;
        let wave = if on_disc { 1.0 + ((k - pad) / 2) as f64 % 9.0 } else { 2.0 + 6.0 * uniform.draw().abs() };
        let phase = if on_disc && (k - pad) % 2 == 1 { 0.5 * std::f64::consts::PI } else { 0.0 };
        let (tilt, turn) = (uniform.draw(), if on_disc { 0.0 } else { uniform.draw() });
        let (along_t, along_b) = (0.6 * uniform.draw(), 0.4 * uniform.draw());
        let sign = if on_disc { -AMPLITUDE } else { AMPLITUDE };
        for (pair, &(angle, radius)) in place.iter().enumerate() {
            let (sin, cos) = (wave * angle + phase + turn).sin_cos();
            normal[(pair, k)] = sign * (cos + 4.0 * tilt * (radius - 0.1));
            sliding[(pair, k)] = sign * along_t * (cos + 0.5 * sin);
            lateral[(pair, k)] = sign * along_b * sin;
        }
    }
    let diagonal = |value: &dyn Fn(f64) -> f64| Term {
        matrix: Mat::from_fn(modes, modes, |i, j| if i == j { value(omega[i]) } else { 0.0 }),
        law: Law::Constant,
    };
    let contact = ContactPairs {
        normal,
        sliding,
        lateral,
        stiffness_n_per_m: vec![STIFFNESS_N_PER_M / pairs as f64; pairs],
        damping_n_s_per_m: vec![0.0; pairs],
        radius_m: place.iter().map(|&(_, radius)| radius).collect(),
    };
    let stiffness = vec![diagonal(&|w| w * w)];
    let damping = vec![diagonal(&|w| 2.0 * damping_ratio * w)];
    Model::new(modes, stiffness, damping, contact_law, Some(pad))?.with_contact(&contact)
}

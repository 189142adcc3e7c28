//! Random rigs with the structure of a tribometer, reproducible from a seed, for tests and benchmarks. They do not
//! represent a real rig, but have disc doublets, smooth shapes on a patch of contact pairs and frequencies from 0.3
//! to 10 kHz.

use faer::Mat;

use crate::contact::{FreeModes, MeasuredLoad, PressureLaw, StaticResponse, Statics, StaticsError, StaticsParts};
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
pub const STIFFNESS_N_PER_M: f64 = 4e7;
/// Amplitude of a mass-normalised shape, kg^-1/2: that of a part of about 2 kg.
const AMPLITUDE: f64 = 0.7;

/// A synthetic rig before pad and disc are joined.
#[derive(Clone, Debug)]
pub struct Parts {
    /// The model without contact.
    pub free: Model,
    /// The contact pairs, undamped.
    pub pairs: ContactPairs,
    /// Angular frequency of each mode, rad/s; none is 0.
    pub omega: Vec<f64>,
}

/// Builds the rig, with springs that are always closed.
///
/// # Errors
/// [`ModelError`] if `contact_law` is not valid.
pub fn rig(synthetic: &Synthetic) -> Result<Model, ModelError> {
    let Parts { free, pairs, .. } = parts(synthetic)?;
    free.with_contact(&pairs)
}

/// Builds the parts of the rig.
///
/// # Errors
/// [`ModelError`] if `contact_law` is not valid.
pub fn parts(synthetic: &Synthetic) -> Result<Parts, ModelError> {
    build(synthetic, false)
}

/// Builds the parts of the rig with a disc that turns in the frame of the pad. In this frame, a shape `q` of a doublet of
/// `m` waves changes at the rate `q̇ + Ω P q` with `P = [0 m; -m 0]`, so its frequencies are `ω ± m Ω`:
///
/// ```text
/// q̈ + 2 Ω P q̇ + (Ω² P² + ω²) q = 0
/// ```
///
/// # Errors
/// [`ModelError`] if `contact_law` is not valid.
pub fn turning_parts(synthetic: &Synthetic) -> Result<Parts, ModelError> {
    build(synthetic, true)
}

/// Number of waves around the disc of its `k`-th shape; two shapes in a row are a doublet.
fn waves(k: usize) -> f64 {
    1.0 + (k / 2 % 9) as f64
}

/// The terms of a disc of `disc` shapes that turns, after the `pad` shapes of the pad: of stiffness and of damping.
fn turning(pad: usize, disc: usize) -> [Term; 2] {
    let n = pad + disc;
    let (mut spin, mut gyroscopic) = (Mat::zeros(n, n), Mat::zeros(n, n));
    for k in (0..disc.saturating_sub(1)).step_by(2) {
        let (one, other, m) = (pad + k, pad + k + 1, waves(k));
        (spin[(one, one)], spin[(other, other)]) = (-m * m, -m * m);
        (gyroscopic[(one, other)], gyroscopic[(other, one)]) = (2.0 * m, -2.0 * m);
    }
    let by_speed = |matrix, power| Term { matrix, law: Law::DiscSpeed { power } };
    [by_speed(spin, 2), by_speed(gyroscopic, 1)]
}

fn build(synthetic: &Synthetic, turns: bool) -> Result<Parts, ModelError> {
    let Synthetic { modes, pairs: count, damping_ratio, contact_law, seed } = *synthetic;
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
    let place: Vec<(f64, f64)> = (0..count).map(|_| (0.25 * uniform.draw(), 0.1 + 0.02 * uniform.draw())).collect();
    let (mut normal, mut sliding, mut lateral) =
        (Mat::zeros(count, modes), Mat::zeros(count, modes), Mat::zeros(count, modes));
    for k in 0..modes {
        let on_disc = k >= pad;
        let wave = if on_disc { waves(k - pad) } else { 2.0 + 6.0 * uniform.draw().abs() };
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
    let pairs = ContactPairs {
        normal,
        sliding,
        lateral,
        stiffness_n_per_m: vec![STIFFNESS_N_PER_M / count as f64; count],
        damping_n_s_per_m: vec![0.0; count],
        radius_m: place.iter().map(|&(_, radius)| radius).collect(),
    };
    let mut stiffness = vec![diagonal(&|w| w * w)];
    let mut damping = vec![diagonal(&|w| 2.0 * damping_ratio * w)];
    if turns {
        let [spin, gyroscopic] = turning(pad, disc);
        stiffness.push(spin);
        damping.push(gyroscopic);
    }
    let free = Model::new(modes, stiffness, damping, contact_law, Some(pad))?;
    Ok(Parts { free, pairs, omega })
}

/// Statics of the parts of a rig in steady sliding with contact law `law`, all pairs with a factor of 1. The load presses
/// the pad at its contact points, the initial gaps grow from 0 at the first pair to `gap_m` at the last one.
///
/// # Errors
/// [`StaticsError`] if `law` or `gap_m` is not valid.
///
/// # Panics
/// If the parts do not fit together: they come from [`parts`].
pub fn statics(parts: &Parts, law: PressureLaw, gap_m: f64) -> Result<Statics, StaticsError> {
    let Parts { free, pairs, omega } = parts;
    let (n, c) = (omega.len(), pairs.normal.nrows());
    let pad = free.pad_modes().unwrap_or(n);
    let mean = |k: usize| (0..c).map(|i| pairs.normal[(i, k)]).sum::<f64>() / c as f64;
    let load: Vec<f64> = (0..n).map(|k| if k < pad { -mean(k) } else { 0.0 }).collect();
    let omega_squared: Vec<f64> = omega.iter().map(|omega| omega * omega).collect();
    let [normal, sliding] = [&pairs.normal, &pairs.sliding].map(|rows| rows.as_ref());
    let modes = FreeModes { omega_squared: &omega_squared, normal, sliding, load: &load };
    let response = StaticResponse::from_modes(&modes, None).expect("every mode has a row and a frequency");
    let gap = |i: usize| gap_m * i as f64 / c.max(2).saturating_sub(1) as f64;
    let gap_m = (0..c).map(gap).collect();
    Statics::new(StaticsParts { law, area: vec![1.0; c], gap_m, response, measured: MeasuredLoad::Back })
}

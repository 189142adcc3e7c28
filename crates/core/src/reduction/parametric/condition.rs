//! How much a root changes with the matrices, from its vectors.

use faer::c64;

use crate::physics::Spectrum;

/// How much a root changes with the matrices.
pub struct Condition {
    /// `‖y‖_M ‖x‖_M / (|yᴴ Q' x| |λ|)`, s²: `|Δλ|/|λ|` is at most this times the norm of the change of `Q`. It is `1/(2|λ|²)`
    /// for a real mode and unbounded where two roots merge.
    pub relative: f64,
    lambda: c64,
    lengths: [f64; 2],
}

impl Condition {
    /// `lengths`: `‖x‖_M` and `‖y‖_M`; `slope`: `yᴴ Q' x`.
    pub fn new(lambda: c64, lengths: [f64; 2], slope: c64) -> Self {
        Self { relative: lengths[0] * lengths[1] / (slope.norm() * lambda.norm()), lambda, lengths }
    }

    /// Of a root of a reduced model, whose mass matrix is the identity.
    pub fn of(spectrum: &Spectrum, root: usize) -> Self {
        let lengths = [&spectrum.shapes, &spectrum.left].map(|shapes| shapes.col(root).norm_l2());
        Self::new(spectrum.roots[root].lambda, lengths, slope(spectrum, root))
    }

    /// Factors on the right and the left vector with which a component `d` omitted from both moves the root by about `dᵀ S d`
    /// times `|λ|`. They are bounded where roots merge.
    pub fn scales(&self) -> [f64; 2] {
        let scale = self.relative.sqrt().min(10.0 / self.lambda.norm());
        self.lengths.map(|length| scale / length)
    }
}

/// `yᴴ Q' x`: left vectors are normalised to 1 for a damped spectrum and to `2λ` for an undamped one.
pub fn slope(spectrum: &Spectrum, root: usize) -> c64 {
    if spectrum.undamped { spectrum.roots[root].lambda * 2.0 } else { c64::ONE }
}

//! The static response of the parts without contact: to contact forces and to the load.

use faer::{Mat, MatRef};

use super::shape::{ShapeError, check_shape};

/// `ω²` up to this share of the largest one belong to rigid motions: a rounding error of the modes.
const RIGID: f64 = 1e-11;

/// How the gaps of `c` contact pairs respond to contact forces and to the load, without contact springs.
#[derive(Clone, Debug)]
pub struct StaticResponse {
    /// `G_nn = B_n K_0⁻¹ B_nᵀ`, `c×c`, m/N, symmetric: change of the gaps by forces along the normals.
    pub normal_flexibility: Mat<f64>,
    /// `G_nt = B_n K_0⁻¹ B_tᵀ`, `c×c`, m/N: change of the gaps by forces on the pad along the sliding direction.
    pub sliding_flexibility: Mat<f64>,
    /// `a = B_n K_0⁻¹ p`, `c`, m/N: change of the gaps by a load of 1 N, negative where it closes them.
    pub gap_per_load: Vec<f64>,
    /// Motions of parts that nothing but the contact supports.
    pub rigid: RigidMotions,
}

/// Rigid motions `Φ_r` of free-floating parts, `r` in number. Each has an unknown amplitude in `ρ` and one equation of
/// balance. With `r = 0` every part is supported.
#[derive(Clone, Debug)]
pub struct RigidMotions {
    /// `B_n Φ_r`, `c×r`: change of the gaps.
    pub normal: Mat<f64>,
    /// `B_t Φ_r`, `c×r`: displacement along the sliding direction.
    pub sliding: Mat<f64>,
    /// `p_r = Φ_rᵀ p`, `r`: work of the load of 1 N.
    pub load: Vec<f64>,
}

/// Modes of the parts without contact, `n` in number, mass-normalised.
#[derive(Clone, Copy, Debug)]
pub struct FreeModes<'a> {
    /// `Ω²`, `n`, rad²/s².
    pub omega_squared: &'a [f64],
    /// `B_n`, `c×n`, kg^-1/2.
    pub normal: MatRef<'a, f64>,
    /// `B_t`, `c×n`, kg^-1/2.
    pub sliding: MatRef<'a, f64>,
    /// `Φᵀ p`, `n`, kg^-1/2: the load of 1 N in modal coordinates.
    pub load: &'a [f64],
}

/// Static response of truncated modes, to be added to that of the modes kept.
#[derive(Clone, Copy, Debug)]
pub struct TruncatedResponse<'a> {
    /// `R_nn`, `c×c`, m/N.
    pub normal: MatRef<'a, f64>,
    /// `R_nt`, `c×c`, m/N.
    pub sliding: MatRef<'a, f64>,
    /// Residual response of the gaps to the load, `c`, m/N.
    pub gap_per_load: &'a [f64],
}

/// Why the static response cannot be computed from modes.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum ResponseError {
    /// A matrix or list has the wrong shape.
    #[error(transparent)]
    Shape(#[from] ShapeError),
    /// A mode has a negative squared frequency beyond rounding.
    #[error("mode {mode}: squared frequency is {value:e}, expected a finite number of at least -{limit:e}")]
    Frequency {
        /// Index of the mode.
        mode: usize,
        /// Its `ω²`, rad²/s².
        value: f64,
        /// Magnitude accepted as rounding, rad²/s².
        limit: f64,
    },
}

impl StaticResponse {
    /// The response of `modes`, plus that of truncated ones:
    ///
    /// ```text
    /// G_nn = B_n Ω⁻² B_nᵀ + R_nn,   G_nt = B_n Ω⁻² B_tᵀ + R_nt,   a = B_n Ω⁻² Φᵀp + R_n p
    /// ```
    ///
    /// over modes with stiffness. Modes without (`Ω²` at most 1e-11 of the largest) are rigid motions.
    ///
    /// # Errors
    /// [`ResponseError`].
    pub fn from_modes(modes: &FreeModes<'_>, truncated: Option<&TruncatedResponse<'_>>) -> Result<Self, ResponseError> {
        let (c, n) = modes.normal.shape();
        let mut shapes = vec![
            ("squared frequencies", (modes.omega_squared.len(), 1), (n, 1)),
            ("sliding rows", modes.sliding.shape(), (c, n)),
            ("load on modes", (modes.load.len(), 1), (n, 1)),
        ];
        if let Some(truncated) = truncated {
            shapes.extend([
                ("residual flexibility", truncated.normal.shape(), (c, c)),
                ("sliding residual flexibility", truncated.sliding.shape(), (c, c)),
                ("residual gap per load", (truncated.gap_per_load.len(), 1), (c, 1)),
            ]);
        }
        for (what, found, expected) in shapes {
            check_shape(what, found, expected)?;
        }
        let largest = modes.omega_squared.iter().fold(0.0f64, |largest, value| largest.max(value.abs()));
        let limit = RIGID * largest;
        let (mut elastic, mut free) = (vec![], vec![]);
        for (mode, &value) in modes.omega_squared.iter().enumerate() {
            match value {
                _ if !value.is_finite() || value < -limit => {
                    return Err(ResponseError::Frequency { mode, value, limit });
                }
                _ if value <= limit => free.push(mode),
                _ => elastic.push(mode),
            }
        }
        let on = |rows: MatRef<'_, f64>, list: &[usize]| Mat::from_fn(c, list.len(), |k, j| rows[(k, list[j])]);
        let (normal, sliding) = (on(modes.normal, &elastic), on(modes.sliding, &elastic));
        let compliant = Mat::from_fn(c, elastic.len(), |k, j| normal[(k, j)] / modes.omega_squared[elastic[j]]);
        let load = Mat::from_fn(elastic.len(), 1, |j, _| modes.load[elastic[j]]);
        let (nn, nt, gap) = (&compliant * normal.transpose(), &compliant * sliding.transpose(), &compliant * load);
        let residual = |of: Option<MatRef<'_, f64>>, i: usize, j: usize| of.map_or(0.0, |matrix| matrix[(i, j)]);
        let (more_nn, more_nt) = (truncated.map(|more| more.normal), truncated.map(|more| more.sliding));
        Ok(Self {
            // Symmetric up to rounding; made exactly symmetric.
            normal_flexibility: Mat::from_fn(c, c, |i, j| {
                0.5 * (nn[(i, j)] + nn[(j, i)]) + 0.5 * (residual(more_nn, i, j) + residual(more_nn, j, i))
            }),
            sliding_flexibility: Mat::from_fn(c, c, |i, j| nt[(i, j)] + residual(more_nt, i, j)),
            gap_per_load: (0..c).map(|k| gap[(k, 0)] + truncated.map_or(0.0, |more| more.gap_per_load[k])).collect(),
            rigid: RigidMotions {
                normal: on(modes.normal, &free),
                sliding: on(modes.sliding, &free),
                load: free.iter().map(|&mode| modes.load[mode]).collect(),
            },
        })
    }
}

//! Modes of a substructure at its contact interface, from any file format.

use faer::Mat;

use super::{RigError, npz, uff};
use crate::reduction::PartMatrices;

/// Modes of a part at the `c` nodes of its contact interface.
#[derive(Clone, Debug, PartialEq)]
pub struct ModalData {
    /// `ω` of the `i` modes, rad/s.
    pub omega_rad_s: Vec<f64>,
    /// `Φ`, kg^-1/2, of shape `(c, 3, i)` in C order: the mode index varies fastest.
    pub phi: Vec<f64>,
    /// Positions of the `c` nodes, m.
    pub nodes_m: Vec<[f64; 3]>,
    /// Damping ratio `ζ` of each mode, if given.
    pub damping_ratio: Option<Vec<f64>>,
    /// This part's contribution `V_pᵀ M_p V_p` to the unit mass matrix, `i×i`, if given. Used if the columns of `phi`
    /// are motions of both parts.
    pub mass_share: Option<Mat<f64>>,
    /// Generalised force of a load of 1 N on this part in each mode, kg^-1/2, if given.
    pub load: Option<Vec<f64>>,
    /// Damping and rotation of this part, `i×i`.
    pub matrices: PartMatrices,
    /// Residual flexibility of the modes above these, if given.
    pub residual: Option<Residual>,
}

/// Residual flexibility and inertia of the truncated modes, `3c×3c`, symmetric. Rows are x, y and z of each node.
#[derive(Clone, Debug, PartialEq)]
pub struct Residual {
    /// `R = Σ φ φᵀ / ω²`, m/N.
    pub flexibility: Mat<f64>,
    /// `Q = Σ φ φᵀ / ω⁴`, s²·m/N.
    pub inertia: Option<Mat<f64>>,
}

impl ModalData {
    /// Reads modal data. Names that end with `.unv` or `.uff` are Universal Files, all others `.npz` archives.
    ///
    /// # Errors
    /// Those of [`npz::read`] and [`uff::read`].
    pub fn read(file: &str, bytes: &[u8]) -> Result<Self, RigError> {
        let lower = file.to_ascii_lowercase();
        if lower.ends_with(".unv") || lower.ends_with(".uff") { uff::read(file, bytes) } else { npz::read(file, bytes) }
    }

    /// Displacement (x, y, z) of `node` in `mode`, kg^-1/2; 0 if either does not exist.
    pub fn shape(&self, node: usize, mode: usize) -> [f64; 3] {
        let modes = self.omega_rad_s.len();
        [0, 1, 2].map(|axis| self.phi.get((3 * node + axis) * modes + mode).copied().unwrap_or(0.0))
    }

    /// Residual flexibility of all modes except `kept`: that of the data plus the contribution of the modes of the data
    /// that are not kept. `None` if the data has none.
    ///
    /// # Errors
    /// Index of the first rigid-body motion that is not kept: its flexibility is infinite.
    pub fn residual_beyond(&self, kept: &[usize]) -> Result<Option<Residual>, usize> {
        let Some(residual) = &self.residual else { return Ok(None) };
        let modes = self.omega_rad_s.len();
        let out: Vec<usize> = (0..modes).filter(|mode| !kept.contains(mode)).collect();
        let largest = self.omega_rad_s.iter().fold(0.0, |largest: f64, &omega| largest.max(omega));
        if let Some(&rigid) = out.iter().find(|&&mode| self.omega_rad_s[mode] <= RIGID * largest) {
            return Err(rigid);
        }
        let weighted = |power: i32| {
            let rows = Mat::from_fn(3 * self.nodes_m.len(), out.len(), |row, k| {
                self.phi[row * modes + out[k]] / self.omega_rad_s[out[k]].powi(power)
            });
            // Exactly symmetric by construction, because the solver tests for symmetry.
            let product = &rows * rows.transpose();
            Mat::from_fn(product.nrows(), product.ncols(), |i, j| product[(i.max(j), i.min(j))])
        };
        Ok(Some(Residual {
            flexibility: &residual.flexibility + weighted(1),
            inertia: residual.inertia.as_ref().map(|inertia| inertia + weighted(2)),
        }))
    }
}

/// A mode is a rigid-body motion if its `ω` is at most this times the largest.
const RIGID: f64 = 1e-4;

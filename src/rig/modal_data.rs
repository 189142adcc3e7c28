//! Modes of a substructure at its contact interface, whatever format they came in.

use faer::Mat;

use super::{RigError, npz, uff};

/// Modes at the nodes of a contact interface.
#[derive(Clone, Debug, PartialEq)]
pub struct ModalData {
    /// `ω`, rad/s, one for each of `i` modes.
    pub omega_rad_s: Vec<f64>,
    /// `Φ`, kg^-1/2, `(c, 3, i)` with the mode running fastest.
    pub phi: Vec<f64>,
    /// Positions of the `c` nodes, m.
    pub nodes_m: Vec<[f64; 3]>,
    /// `ζ`, one for each mode, where given.
    pub damping_ratio: Option<Vec<f64>>,
    /// `(i, i)`: this side's part of the unit mass matrix, where the columns of `phi` move other sides too and it is given.
    pub mass_share: Option<Mat<f64>>,
    /// What the modes beyond these do at the nodes, where given.
    pub residual: Option<Residual>,
}

/// Residuals of the modes left out, between x, y and z of every node: `3c×3c`, node by node, symmetric.
#[derive(Clone, Debug, PartialEq)]
pub struct Residual {
    /// `R = Σ φ φᵀ / ω²`, m/N.
    pub flexibility: Mat<f64>,
    /// `Q = Σ φ φᵀ / ω⁴`, s²·m/N.
    pub inertia: Option<Mat<f64>>,
}

impl ModalData {
    /// Reads modal data in the format that the name of the file says: `.unv` and `.uff` are Universal Files, everything
    /// else is an `.npz` archive.
    ///
    /// # Errors
    /// Those of [`npz::read`] and [`uff::read`].
    pub fn read(file: &str, bytes: &[u8]) -> Result<Self, RigError> {
        let lower = file.to_ascii_lowercase();
        if lower.ends_with(".unv") || lower.ends_with(".uff") { uff::read(file, bytes) } else { npz::read(file, bytes) }
    }

    /// Displacement of `node` in `mode`, kg^-1/2; 0 outside.
    pub fn shape(&self, node: usize, mode: usize) -> [f64; 3] {
        let modes = self.omega_rad_s.len();
        [0, 1, 2].map(|axis| self.phi.get((3 * node + axis) * modes + mode).copied().unwrap_or(0.0))
    }

    /// The residual of all modes but those `kept`: what came with the data and what the others add to it. `None` where
    /// none came with the data.
    ///
    /// # Errors
    /// The first mode left out that is a rigid-body motion: it has no flexibility.
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
            // Symmetric by construction: the solver looks for it.
            let product = &rows * rows.transpose();
            Mat::from_fn(product.nrows(), product.ncols(), |i, j| product[(i.max(j), i.min(j))])
        };
        Ok(Some(Residual {
            flexibility: &residual.flexibility + weighted(1),
            inertia: residual.inertia.as_ref().map(|inertia| inertia + weighted(2)),
        }))
    }
}

/// A mode with `ω` of at most this times the largest is a rigid-body motion.
const RIGID: f64 = 1e-4;

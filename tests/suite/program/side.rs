//! Made-up modes of pad or disc at nodes.

use super::npz_bytes;

/// An array of an archive: name, shape and values in C order.
pub type Array = (&'static str, Vec<u64>, Vec<f64>);

/// An archive of arrays.
pub fn archive(arrays: &[Array]) -> Vec<u8> {
    let borrowed: Vec<(&str, &[u64], &[f64])> =
        arrays.iter().map(|(name, shape, values)| (*name, shape.as_slice(), values.as_slice())).collect();
    npz_bytes(&borrowed)
}

/// A side with all its modes, of which archives hold some, and the rest as residuals.
pub struct Side {
    pub nodes: Vec<[f64; 3]>,
    pub omega: Vec<f64>,
    /// Of every node and axis, for every mode.
    pub phi: Vec<Vec<f64>>,
}

impl Side {
    pub fn new(nodes: Vec<[f64; 3]>, modes: usize, step: f64, phase: f64) -> Self {
        let value = |row: usize, mode: usize| (phase + 1.7 * row as f64 + 2.3 * (mode * mode) as f64).sin();
        Self {
            omega: (1..=modes).map(|k| step * k as f64).collect(),
            phi: (0..3 * nodes.len()).map(|row| (0..modes).map(|mode| value(row, mode)).collect()).collect(),
            nodes,
        }
    }

    /// The arrays of the first `kept` modes, with residuals of the rest if requested.
    pub fn arrays(&self, kept: usize, flexibility: bool, inertia: bool) -> Vec<Array> {
        let rows = self.phi.len();
        let (nodes, modes) = (self.nodes.len() as u64, kept as u64);
        let mut arrays = vec![
            ("omega_rad_s", vec![modes], self.omega[..kept].to_vec()),
            ("phi", vec![nodes, 3, modes], self.phi.iter().flat_map(|row| row[..kept].to_vec()).collect()),
            ("nodes_m", vec![nodes, 3], self.nodes.iter().flatten().copied().collect()),
        ];
        for (name, power, asked) in [("residual_flexibility", 2, flexibility), ("residual_inertia", 4, inertia)] {
            let entry = |i: usize, j: usize| -> f64 {
                let rest = kept..self.omega.len();
                rest.map(|k| self.phi[i][k] * self.phi[j][k] / self.omega[k].powi(power)).sum()
            };
            if asked {
                let all = (0..rows).flat_map(|i| (0..rows).map(move |j| (i, j))).map(|(i, j)| entry(i, j));
                arrays.push((name, vec![3 * nodes; 2], all.collect()));
            }
        }
        arrays
    }

    /// An archive of [`Self::arrays`].
    pub fn archive(&self, kept: usize, flexibility: bool, inertia: bool) -> Vec<u8> {
        archive(&self.arrays(kept, flexibility, inertia))
    }
}

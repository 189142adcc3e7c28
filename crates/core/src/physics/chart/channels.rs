//! Expansions of many functions in one basis, evaluated together as a product of the basis values with a matrix.

use super::fit::Basis;

/// Expansions of several functions (channels) on a box.
#[derive(Clone, Debug)]
pub struct Channels {
    /// Number of channels with coefficients of each total degree. Channels are in descending order of degree.
    pub widths: Vec<usize>,
    /// Coefficients by degree, then polynomial, then channel (fastest).
    pub coefficients: Vec<f64>,
}

impl Channels {
    /// Channels from functions, each given by its total degree and its coefficients in `basis`, in descending order
    /// of degree.
    pub fn new(basis: &Basis, functions: &[(usize, Vec<f64>)]) -> Self {
        let width = |degree: usize| functions.iter().take_while(|(last, _)| *last >= degree).count();
        let widths: Vec<usize> = (0..=basis.degree()).map(width).collect();
        let mut coefficients = vec![];
        for (degree, &width) in widths.iter().enumerate() {
            for row in basis.of_degree(degree) {
                coefficients.extend(functions[..width].iter().map(|(_, coefficients)| coefficients[row]));
            }
        }
        Self { widths, coefficients }
    }

    /// Values of all channels at the point where the polynomials of `basis` have `values`.
    pub fn evaluate(&self, basis: &Basis, values: &[f64], out: &mut Vec<f64>) {
        out.clear();
        out.resize(self.widths[0], 0.0);
        // Uses the widest vector registers available. The result does not depend on their width: each channel is
        // summed separately, in the same order.
        pulp::Arch::new().dispatch(
            #[inline(always)]
            || {
                let mut coefficients = self.coefficients.as_slice();
                for (degree, &width) in self.widths.iter().enumerate().filter(|(_, width)| **width > 0) {
                    let weights = &values[basis.of_degree(degree)];
                    let (block, rest) = coefficients.split_at(weights.len() * width);
                    accumulate(&mut out[..width], weights, block);
                    coefficients = rest;
                }
            },
        );
    }
}

/// Adds `weights` times `rows` to `sums`, four rows at a time, which divides loads and stores of the sums by four.
#[inline(always)]
fn accumulate(sums: &mut [f64], weights: &[f64], rows: &[f64]) {
    let width = sums.len();
    let whole = weights.len() / 4 * 4;
    for (w, four) in weights.chunks_exact(4).zip(rows.chunks_exact(4 * width)) {
        let (a, rest) = four.split_at(width);
        let (b, rest) = rest.split_at(width);
        let (c, d) = rest.split_at(width);
        for ((((sum, a), b), c), d) in sums.iter_mut().zip(a).zip(b).zip(c).zip(d) {
            *sum += w[0] * a + w[1] * b + w[2] * c + w[3] * d;
        }
    }
    for (w, row) in weights[whole..].iter().zip(rows[whole * width..].chunks_exact(width)) {
        for (sum, value) in sums.iter_mut().zip(row) {
            *sum += w * value;
        }
    }
}

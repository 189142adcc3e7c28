//! Products of dense matrices on the calling thread.

use faer::linalg::matmul::matmul;
use faer::{Accum, Mat, MatRef, Par};

/// `a b`, on the calling thread only: a prediction uses one thread.
pub(crate) fn product(a: MatRef<'_, f64>, b: MatRef<'_, f64>) -> Mat<f64> {
    let mut out = Mat::zeros(a.nrows(), b.ncols());
    matmul(&mut out, Accum::Replace, a, b, 1.0, Par::Seq);
    out
}

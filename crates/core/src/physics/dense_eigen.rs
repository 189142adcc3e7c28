//! The dense eigenvalue problem, symmetric or unsymmetric, with its vectors in LAPACK's packing.

use faer::dyn_stack::{MemBuffer, MemStack, StackReq};
use faer::linalg::evd::{
    ComputeEigenvectors, EvdParams, SelfAdjointEvdParams, evd_real, evd_scratch, self_adjoint_evd,
    self_adjoint_evd_scratch,
};
use faer::{Auto, Col, Mat, MatRef, Par, Spec, c64};

use super::spectrum::{SolveError, Vectors};

/// Workspace and result of the dense eigenvalue problem: eigenvalues, and vectors in LAPACK's packing, in which a
/// complex conjugate pair takes two columns, for real and imaginary part.
pub struct Dense {
    pub values: Vec<c64>,
    pub left: Mat<f64>,
    pub right: Mat<f64>,
    memory: MemBuffer,
}

impl Dense {
    /// A workspace with nothing allocated yet.
    pub fn new() -> Self {
        Self { values: vec![], left: Mat::new(), right: Mat::new(), memory: MemBuffer::new(StackReq::EMPTY) }
    }

    /// Allocates the workspace for matrices of `dimension`, if it has another size.
    fn fit(&mut self, dimension: usize) {
        if self.right.nrows() != dimension {
            use ComputeEigenvectors::Yes;
            let unsymmetric = evd_scratch::<f64>(dimension, Yes, Yes, Par::Seq, unsymmetric_params());
            let symmetric = self_adjoint_evd_scratch::<f64>(dimension, Yes, Par::Seq, symmetric_params());
            self.memory = MemBuffer::new(unsymmetric.or(symmetric));
            self.right = Mat::zeros(dimension, dimension);
            self.left = Mat::zeros(dimension, dimension);
        }
        self.values.clear();
    }

    /// Computes the eigenvalues of a symmetric `matrix`, and its vectors if requested.
    pub fn symmetric_eigen(&mut self, matrix: MatRef<'_, f64>, vectors: Vectors) -> Result<(), SolveError> {
        let dimension = matrix.nrows();
        self.fit(dimension);
        let mut kappa = Col::<f64>::zeros(dimension);
        // faer's iteration stops at an absolute tolerance near 1e-16. The entries are scaled to near 1 by a power of
        // two, which is exact.
        let exponent = matrix.norm_max().log2().ceil();
        let unit = if exponent.is_finite() { exponent.exp2() } else { 1.0 };
        self_adjoint_evd(
            (matrix * faer::Scale(unit.recip())).as_ref(),
            kappa.as_mut().as_diagonal_mut(),
            (vectors != Vectors::None).then(|| self.right.as_mut()),
            Par::Seq,
            MemStack::new(&mut self.memory),
            symmetric_params(),
        )
        .map_err(|_| SolveError::NoConvergence { dimension })?;
        self.values.extend(kappa.iter().map(|kappa| c64::new(kappa * unit, 0.0)));
        Ok(())
    }

    /// Computes the eigenvalues of `matrix`, whose Frobenius norm is `norm`, and the requested vectors.
    pub fn eigen(&mut self, matrix: MatRef<'_, f64>, norm: f64, vectors: Vectors) -> Result<(), SolveError> {
        let dimension = matrix.nrows();
        self.fit(dimension);
        let mut re = Col::<f64>::zeros(dimension);
        let mut im = Col::<f64>::zeros(dimension);
        evd_real(
            matrix,
            re.as_mut().as_diagonal_mut(),
            im.as_mut().as_diagonal_mut(),
            (vectors == Vectors::Both).then(|| self.left.as_mut()),
            (vectors != Vectors::None).then(|| self.right.as_mut()),
            Par::Seq,
            MemStack::new(&mut self.memory),
            unsymmetric_params(),
        )
        .map_err(|_| SolveError::NoConvergence { dimension })?;
        #[cfg(test)]
        if crate::spoil::spoilt(crate::spoil::Spoil::Value) {
            re[0] += 1e-6 * norm;
        }
        #[cfg(test)]
        if crate::spoil::spoilt(crate::spoil::Spoil::Vector) && vectors != Vectors::None {
            self.right[(0, 0)] += 1e-3;
        }
        self.values.extend(re.iter().zip(im.iter()).map(|(&re, &im)| c64::new(re, im)));
        // faer does not report whether the iteration converged, so the result is checked by traces.
        let rounding = 64.0 * dimension as f64 * f64::EPSILON;
        let mut trace_of_square = 0.0;
        for j in 0..dimension {
            trace_of_square += matrix[(j, j)] * matrix[(j, j)];
            trace_of_square += 2.0 * (0..j).map(|i| matrix[(i, j)] * matrix[(j, i)]).sum::<f64>();
        }
        let traces = [
            (1, (0..dimension).map(|i| matrix[(i, i)]).sum(), re.iter().sum::<f64>(), rounding * norm),
            (2, trace_of_square, self.values.iter().map(|z| (z * z).re).sum(), rounding * norm * norm),
        ];
        for (power, expected, found, limit) in traces {
            if (found - expected).abs() > limit || !found.is_finite() {
                return Err(SolveError::Trace { power, found, expected, limit });
            }
        }
        Ok(())
    }
}

fn unsymmetric_params() -> Spec<EvdParams, f64> {
    <EvdParams as Auto<f64>>::auto().into()
}

fn symmetric_params() -> Spec<SelfAdjointEvdParams, f64> {
    <SelfAdjointEvdParams as Auto<f64>>::auto().into()
}

/// Columns of a vector in LAPACK's packing: the vector is `re + i sign im`, or `re` if there is no `im`.
#[derive(Clone, Copy)]
pub struct Packing {
    pub re: usize,
    pub im: Option<usize>,
    sign: f64,
}

/// Columns of the vectors of `values`. The two columns of a complex conjugate pair hold real and imaginary part of
/// the first vector; the second vector is its conjugate.
pub fn packing(values: &[c64]) -> impl Iterator<Item = Packing> {
    let mut second = false;
    values.iter().enumerate().map(move |(k, value)| {
        if value.im == 0.0 {
            return Packing { re: k, im: None, sign: 0.0 };
        }
        second = !second;
        if second {
            Packing { re: k, im: Some(k + 1), sign: 1.0 }
        } else {
            Packing { re: k - 1, im: Some(k), sign: -1.0 }
        }
    })
}

/// A complex vector in LAPACK's packing.
#[derive(Clone, Copy)]
pub struct Packed<'a> {
    re: &'a [f64],
    /// Empty for a real vector.
    im: &'a [f64],
    sign: f64,
}

impl<'a> Packed<'a> {
    pub fn new(matrix: &'a Mat<f64>, packing: Packing) -> Self {
        let im = packing.im.map_or(&[][..], |k| matrix.col_as_slice(k));
        Self { re: matrix.col_as_slice(packing.re), im, sign: packing.sign }
    }

    /// The vector restricted to some rows.
    pub fn rows(self, rows: impl std::slice::SliceIndex<[f64], Output = [f64]> + Clone) -> Self {
        let im = if self.im.is_empty() { self.im } else { &self.im[rows.clone()] };
        Self { re: &self.re[rows], im, sign: self.sign }
    }

    /// Entry `i`.
    pub fn at(self, i: usize) -> c64 {
        c64::new(self.re[i], if self.im.is_empty() { 0.0 } else { self.sign * self.im[i] })
    }

    /// `selfᴴ other`.
    pub fn dot(self, other: Self) -> c64 {
        if self.im.is_empty() {
            return c64::new(dot(self.re, other.re), 0.0);
        }
        let re = dot(self.re, other.re) + dot(self.im, other.im);
        c64::new(re, self.sign * (dot(self.re, other.im) - dot(self.im, other.re)))
    }

    pub fn norm_sqr(self) -> f64 {
        dot(self.re, self.re) + dot(self.im, self.im)
    }

    pub fn norm(self) -> f64 {
        self.norm_sqr().sqrt()
    }
}

/// `Σ aᵢ bᵢ`, in eight independent partial sums.
fn dot(a: &[f64], b: &[f64]) -> f64 {
    let mut sums = [0.0; 8];
    let (mut a, mut b) = (a.chunks_exact(8), b.chunks_exact(8));
    for (a, b) in (&mut a).zip(&mut b) {
        for ((sum, a), b) in sums.iter_mut().zip(a).zip(b) {
            *sum += a * b;
        }
    }
    sums.iter().sum::<f64>() + a.remainder().iter().zip(b.remainder()).map(|(a, b)| a * b).sum::<f64>()
}

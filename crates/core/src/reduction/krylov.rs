//! What the Lanczos and the Krylov-Schur iteration share: an orthonormal basis `V` that grows by blocks, the
//! orthogonalisation of new vectors against it, and its replacement by linear combinations of its vectors.

use std::convert::Infallible;

use faer::traits::ComplexField;
use faer::{Mat, MatMut, MatRef, c64};

use super::ReductionError;
use super::dense::symmetric_eigen;
use super::threads::{on_threads, row_blocks, shared, threads_for};

/// Number of rows of a basis worked on at a time, which bounds the memory taken besides the basis. This and the next are
/// smaller in tests, whose bases are small.
const ROWS_TOGETHER: usize = if cfg!(test) { 100 } else { 4096 };
/// Number of entries of a basis below which threads do not share an orthogonalisation.
const DIVIDED: usize = if cfg!(test) { 1 << 10 } else { 1 << 22 };

/// Scalar type of a basis: real or complex.
pub(super) trait Number: ComplexField<Real = f64> + Copy + std::ops::Mul<Output = Self> {
    /// Converts to a complex number.
    fn complex(self) -> c64;
    /// Converts from a complex number; a real type takes the real part.
    fn from_complex(value: c64) -> Self;
    /// `Aᴴ B`.
    fn inner(a: MatRef<'_, Self>, b: MatRef<'_, Self>) -> Mat<Self>;
    /// `A B`.
    fn product(a: MatRef<'_, Self>, b: MatRef<'_, Self>) -> Mat<Self>;
    /// Whether the type is real, so that subspaces must be closed under conjugation.
    const REAL: bool;
    /// Basis of this type for the span of `q`, which has orthonormal columns; the result has them too.
    fn basis_of(q: MatRef<'_, c64>) -> Result<Mat<Self>, ReductionError>;
}

impl Number for f64 {
    const REAL: bool = true;
    fn complex(self) -> c64 {
        c64::new(self, 0.0)
    }
    fn from_complex(value: c64) -> Self {
        value.re
    }
    fn inner(a: MatRef<'_, f64>, b: MatRef<'_, f64>) -> Mat<f64> {
        a.transpose() * b
    }
    fn product(a: MatRef<'_, f64>, b: MatRef<'_, f64>) -> Mat<f64> {
        a * b
    }
    fn basis_of(q: MatRef<'_, c64>) -> Result<Mat<f64>, ReductionError> {
        let projector = q * q.adjoint();
        let m = q.nrows();
        let real = Mat::from_fn(m, m, |i, j| 0.5 * (projector[(i, j)].re + projector[(j, i)].re));
        let (_, vectors) = symmetric_eigen("projector", real.as_ref())?;
        // The projector has the eigenvalues 0 and 1, in ascending order.
        Ok(vectors.subcols(m - q.ncols(), q.ncols()).to_owned())
    }
}

impl Number for c64 {
    const REAL: bool = false;
    fn complex(self) -> c64 {
        self
    }
    fn from_complex(value: c64) -> Self {
        value
    }
    fn inner(a: MatRef<'_, c64>, b: MatRef<'_, c64>) -> Mat<c64> {
        a.adjoint() * b
    }
    fn product(a: MatRef<'_, c64>, b: MatRef<'_, c64>) -> Mat<c64> {
        a * b
    }
    fn basis_of(q: MatRef<'_, c64>) -> Result<Mat<c64>, ReductionError> {
        Ok(q.to_owned())
    }
}

/// Orthonormal basis of a Krylov space. Its memory is allocated once, for all the vectors it may hold.
pub(super) struct Basis<T: Number> {
    vectors: Mat<T>,
    size: usize,
}

impl<T: Number> Basis<T> {
    /// An empty basis of at most `capacity` vectors of length `n`.
    pub(super) fn new(n: usize, capacity: usize) -> Self {
        Self { vectors: Mat::zeros(n, capacity), size: 0 }
    }

    /// Number of vectors.
    pub(super) fn size(&self) -> usize {
        self.size
    }

    /// The last `width` vectors.
    pub(super) fn last_block(&self, width: usize) -> Mat<T> {
        self.vectors.subcols(self.size - width, width).to_owned()
    }

    /// Orthogonalises `w` against the basis, twice, and passes the coefficients of each pass to `add`.
    pub(super) fn project_out(&self, w: &mut Mat<T>, mut add: impl FnMut(&Mat<T>)) {
        for _ in 0..2 {
            add(&self.make_orthogonal(w, 0));
        }
    }

    /// Orthogonalises vectors against the basis from column `from` on; returns the coefficients.
    pub(super) fn make_orthogonal(&self, vectors: &mut Mat<T>, from: usize) -> Mat<T> {
        let held = self.vectors.subcols(from, self.size - from);
        let n = held.nrows();
        let firsts: Vec<usize> = (0..n).step_by(ROWS_TOGETHER).collect();
        let parallel = n * held.ncols() >= DIVIDED;
        let mut threads = vec![(); if parallel { threads_for(firsts.len()) } else { 1 }];
        let products = on_threads(&mut threads, &firsts, &mut |()| (), &|(), &first, _| {
            let rows = ROWS_TOGETHER.min(n - first);
            Ok::<_, Infallible>(T::inner(held.subrows(first, rows), vectors.subrows(first, rows)))
        });
        let Ok(products) = products;
        let zero = Mat::zeros(held.ncols(), vectors.ncols());
        let coefficients = products.into_iter().fold(zero, |sum, product| sum + product);
        shared(row_blocks(vectors.as_mut(), ROWS_TOGETHER), parallel, |(first, mut rows): (usize, MatMut<'_, T>)| {
            rows -= T::product(held.subrows(first, rows.nrows()), coefficients.as_ref());
        });
        coefficients
    }

    /// Divides a vector by its norm.
    pub(super) fn normalise(vector: &mut Mat<T>) {
        let scale = T::from_complex(c64::new(1.0 / vector.norm_l2(), 0.0));
        vector.col_mut(0).iter_mut().for_each(|value| *value *= scale);
    }

    /// Appends a vector, which is orthogonal to the basis and has norm 1.
    pub(super) fn push(&mut self, vector: &Mat<T>) {
        self.vectors.subcols_mut(self.size, 1).copy_from(vector);
        self.size += 1;
    }

    /// Replaces the basis by `V S`; the columns of `S` are orthonormal, and at most as many as the vectors.
    pub(super) fn recombine(&mut self, s: MatRef<'_, T>) {
        let vectors = self.vectors.subcols_mut(0, self.size);
        let parallel = vectors.nrows() * vectors.ncols() >= DIVIDED;
        shared(row_blocks(vectors, ROWS_TOGETHER), parallel, |(_, rows): (usize, MatMut<'_, T>)| {
            let recombined = T::product(rows.as_ref(), s);
            rows.subcols_mut(0, s.ncols()).copy_from(&recombined);
        });
        self.size = s.ncols();
    }

    /// The vectors `V S` of a complex `S`, as a new matrix.
    pub(super) fn combined(&self, s: MatRef<'_, c64>) -> Mat<c64> {
        let n = self.vectors.nrows();
        let mut vectors = Mat::zeros(n, s.ncols());
        let parallel = n * self.size >= DIVIDED;
        let blocks = row_blocks(vectors.as_mut(), ROWS_TOGETHER);
        shared(blocks, parallel, |(first, mut rows): (usize, MatMut<'_, c64>)| {
            let part = self.vectors.submatrix(first, 0, rows.nrows(), self.size);
            let part = Mat::from_fn(rows.nrows(), self.size, |i, j| part[(i, j)].complex());
            rows.copy_from(part * s);
        });
        vectors
    }

    /// The vectors, in the memory allocated for the whole basis.
    pub(super) fn into_vectors(mut self) -> Mat<T> {
        self.vectors.truncate(self.vectors.nrows(), self.size);
        self.vectors
    }
}

/// Pseudo-random numbers in [-1, 1), reproducible (SplitMix64, Steele et al. 2014).
pub(super) fn random_block(n: usize, columns: usize, seed: u64) -> Mat<f64> {
    let mut state = seed.wrapping_mul(0x2545_f491_4f6c_dd1d).wrapping_add(0x1234_5678);
    let mut next = || {
        state = state.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = state;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        ((z ^ (z >> 31)) >> 11) as f64 / (1_u64 << 52) as f64 - 1.0
    };
    Mat::from_fn(n, columns, |_, _| next())
}

/// Pseudo-random numbers in [-1, 1), real or complex, reproducible.
pub(super) fn random<T: Number>(n: usize, columns: usize, seed: u64) -> Mat<T> {
    let (re, im) = (random_block(n, columns, seed), random_block(if T::REAL { 0 } else { n }, columns, seed ^ 0x5a5a));
    Mat::from_fn(n, columns, |i, j| T::from_complex(c64::new(re[(i, j)], if T::REAL { 0.0 } else { im[(i, j)] })))
}

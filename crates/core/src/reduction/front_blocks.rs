//! Dense elimination of the columns of a front, in blocks that several threads share.

use faer::dyn_stack::{MemBuffer, MemStack};
use faer::linalg::matmul::matmul;
use faer::linalg::matmul::triangular::{self, BlockStructure};
use faer::linalg::triangular_solve::{solve_lower_triangular_in_place, solve_unit_lower_triangular_in_place};
use faer::linalg::{cholesky::ldlt, cholesky::llt};
use faer::{Accum, Mat, MatMut, MatRef, Par};

use super::threads::{row_blocks, shared};

/// Number of columns of a block of a front.
const BLOCK: usize = 192;

/// Why a matrix could not be eliminated.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Broken {
    /// It is not positive definite.
    Indefinite,
    /// A pivot is zero or not finite.
    Pivot,
}

/// Factorises the columns of a front: the top becomes `L₁₁`, the rest `L₂₁`.
pub(super) fn positive(mut panel: MatMut<'_, f64>, parallel: bool) -> Result<(), Broken> {
    let columns = panel.ncols();
    for first in (0..columns).step_by(BLOCK) {
        let width = BLOCK.min(columns - first);
        let (left, mut right) = panel.as_mut().split_at_col_mut(first + width);
        let (mut top, mut below) =
            left.subcols_mut(first, width).subrows_mut(first, right.nrows() - first).split_at_row_mut(width);
        let mut memory =
            MemBuffer::new(llt::factor::cholesky_in_place_scratch::<f64>(width, Par::Seq, Default::default()));
        llt::factor::cholesky_in_place(
            top.as_mut(),
            Default::default(),
            Par::Seq,
            MemStack::new(&mut memory),
            Default::default(),
        )
        .map_err(|_| Broken::Indefinite)?;
        let top = top.as_ref();
        shared(row_blocks(below.as_mut(), BLOCK), parallel, |(_, rows): (usize, MatMut<'_, f64>)| {
            solve_lower_triangular_in_place(top, rows.transpose_mut(), Par::Seq);
        });
        let below = below.as_ref();
        let wide = right.ncols();
        if wide > 0 {
            let rest = right.as_mut().subrows_mut(first + width, below.nrows());
            subtract_lower(rest, below, below, parallel);
        }
    }
    Ok(())
}

/// Eliminates the columns of a front by `L D Lᵀ` and updates what remains; the number of negative pivots, or `None` if
/// one is zero or not finite.
pub(super) fn signed(mut panel: MatMut<'_, f64>, update: MatMut<'_, f64>, parallel: bool) -> Option<usize> {
    let columns = panel.ncols();
    let (mut negative, height) = (0, panel.nrows());
    let mut scaled = Mat::<f64>::zeros(height, columns);
    for first in (0..columns).step_by(BLOCK) {
        let width = BLOCK.min(columns - first);
        let (left, mut right) = panel.as_mut().split_at_col_mut(first + width);
        let (mut top, mut below) =
            left.subcols_mut(first, width).subrows_mut(first, height - first).split_at_row_mut(width);
        let mut memory =
            MemBuffer::new(ldlt::factor::cholesky_in_place_scratch::<f64>(width, Par::Seq, Default::default()));
        ldlt::factor::cholesky_in_place(
            top.as_mut(),
            Default::default(),
            Par::Seq,
            MemStack::new(&mut memory),
            Default::default(),
        )
        .ok()?;
        let top = top.as_ref();
        let pivots: Vec<f64> = (0..width).map(|k| top[(k, k)]).collect();
        if pivots.iter().any(|pivot| !pivot.is_finite() || *pivot == 0.0) {
            return None;
        }
        negative += pivots.iter().filter(|pivot| **pivot < 0.0).count();
        let product = scaled.submatrix_mut(first + width, first, height - first - width, width);
        // `L₂₁ D` is kept beside `L₂₁`.
        let pairs = blocks_of_two(below.as_mut(), product);
        shared(pairs, parallel, |(mut rows, mut product): (MatMut<'_, f64>, MatMut<'_, f64>)| {
            solve_unit_lower_triangular_in_place(top, rows.as_mut().transpose_mut(), Par::Seq);
            product.copy_from(rows.as_ref());
            for (k, pivot) in pivots.iter().enumerate() {
                rows.as_mut().col_mut(k).iter_mut().for_each(|value| *value /= pivot);
            }
        });
        if right.ncols() > 0 {
            let (below, product) =
                (below.as_ref(), scaled.as_ref().submatrix(first + width, first, height - first - width, width));
            let rest = right.as_mut().subrows_mut(first + width, below.nrows());
            subtract_lower(rest, below, product, parallel);
        }
    }
    let remaining = height - columns;
    let (below, product) = (panel.as_ref().subrows(columns, remaining), scaled.as_ref().subrows(columns, remaining));
    subtract_lower(update, below, product, parallel);
    Some(negative)
}

/// Divides two matrices into the same blocks of rows.
fn blocks_of_two<'m>(a: MatMut<'m, f64>, b: MatMut<'m, f64>) -> Vec<(MatMut<'m, f64>, MatMut<'m, f64>)> {
    let blocks = row_blocks(a, BLOCK).into_iter().zip(row_blocks(b, BLOCK));
    blocks.map(|((_, a), (_, b))| (a, b)).collect()
}

/// `U ← U - A Bᵀ` in the lower triangle of a square matrix, or of the first columns of one.
pub(super) fn subtract_lower(mut update: MatMut<'_, f64>, a: MatRef<'_, f64>, b: MatRef<'_, f64>, parallel: bool) {
    let mut blocks = vec![];
    let mut first = 0;
    while update.ncols() > 0 {
        let (block, rest) = {
            let at = BLOCK.min(update.ncols());
            update.split_at_col_mut(at)
        };
        let width = block.ncols();
        blocks.push((first, block));
        first += width;
        update = rest;
    }
    shared(blocks, parallel, |(first, block): (usize, MatMut<'_, f64>)| {
        let (rows, width) = block.shape();
        let (mut diagonal, mut below) = block.subrows_mut(first, rows - first).split_at_row_mut(width);
        let b = b.subrows(first, width).transpose();
        triangular::matmul(
            diagonal.as_mut(),
            BlockStructure::TriangularLower,
            Accum::Add,
            a.subrows(first, width),
            BlockStructure::Rectangular,
            b,
            BlockStructure::Rectangular,
            -1.0,
            Par::Seq,
        );
        let a = a.subrows(first + width, rows - first - width);
        matmul(below.as_mut(), Accum::Add, a, b, -1.0, Par::Seq);
    });
}

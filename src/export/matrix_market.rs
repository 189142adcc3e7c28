//! Writes symmetric and skew sparse matrices and dense matrices as Matrix Market files.
//!
//! Source: Boisvert, Pozo, Remington, "The Matrix Market exchange formats", NISTIR 5935 (1996).

use std::io::{self, Write};

use crate::reduction::SparseMatrix;

/// Writes the lower triangle of a symmetric matrix in coordinate format. Values have enough digits to be read back
/// exactly.
///
/// # Errors
/// Those of the writer.
pub fn write_symmetric(matrix: &SparseMatrix, comment: &str, out: &mut impl Write) -> io::Result<()> {
    write_lower(matrix, "symmetric", comment, out)
}

/// Writes a skew matrix like [`write_symmetric`], without its diagonal.
///
/// # Errors
/// Those of the writer.
pub fn write_skew(matrix: &SparseMatrix, comment: &str, out: &mut impl Write) -> io::Result<()> {
    write_lower(matrix, "skew-symmetric", comment, out)
}

fn write_lower(matrix: &SparseMatrix, kind: &str, comment: &str, out: &mut impl Write) -> io::Result<()> {
    let lower = || matrix.as_ref().triplet_iter().filter(|entry| entry.row >= entry.col && *entry.val != 0.0);
    writeln!(out, "%%MatrixMarket matrix coordinate real {kind}")?;
    writeln!(out, "% {comment}")?;
    writeln!(out, "{} {} {}", matrix.nrows(), matrix.ncols(), lower().count())?;
    for entry in lower() {
        writeln!(out, "{} {} {:e}", entry.row + 1, entry.col + 1, entry.val)?;
    }
    Ok(())
}

/// Writes a dense matrix in array format, by columns. Values have enough digits to be read back exactly.
///
/// # Errors
/// Those of the writer.
pub fn write_array(matrix: &faer::Mat<f64>, comment: &str, out: &mut impl Write) -> io::Result<()> {
    writeln!(out, "%%MatrixMarket matrix array real general")?;
    writeln!(out, "% {comment}")?;
    writeln!(out, "{} {}", matrix.nrows(), matrix.ncols())?;
    for column in 0..matrix.ncols() {
        for row in 0..matrix.nrows() {
            writeln!(out, "{:e}", matrix[(row, column)])?;
        }
    }
    Ok(())
}

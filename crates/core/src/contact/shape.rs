//! Shapes of matrices and lists.

/// A matrix or list has the wrong shape.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{what} is {rows}x{columns}, expected {expected_rows}x{expected_columns}")]
pub struct ShapeError {
    /// Which matrix or list.
    pub what: &'static str,
    /// Number of rows found.
    pub rows: usize,
    /// Number of columns found.
    pub columns: usize,
    /// Number of rows expected.
    pub expected_rows: usize,
    /// Number of columns expected.
    pub expected_columns: usize,
}

/// Checks the numbers of rows and columns of a matrix.
pub(super) fn check_shape(
    what: &'static str,
    (rows, columns): (usize, usize),
    (expected_rows, expected_columns): (usize, usize),
) -> Result<(), ShapeError> {
    if (rows, columns) == (expected_rows, expected_columns) {
        return Ok(());
    }
    Err(ShapeError { what, rows, columns, expected_rows, expected_columns })
}

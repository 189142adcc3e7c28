//! Collects the entries of a large sparse matrix and compresses them.

use faer::sparse::SymbolicSparseColMat;

use crate::reduction::SparseMatrix;

/// Upper limit of rows and columns of a matrix.
pub const MOST_ROWS: usize = u32::MAX as usize;

/// Entries `(row, column, value)` in any order, 16 bytes each.
#[derive(Default)]
pub struct Entries {
    places: Vec<(u32, u32, f64)>,
}

impl Entries {
    /// Adds an entry. Row and column count from 0 and are below [`MOST_ROWS`].
    pub fn push(&mut self, row: usize, column: usize, value: f64) {
        let index = |index: usize| u32::try_from(index).expect("callers keep rows and columns below MOST_ROWS");
        self.places.push((index(row), index(column), value));
    }

    /// Number of entries.
    pub fn len(&self) -> usize {
        self.places.len()
    }

    /// The `n×n` matrix of the entries, multiplied by `factor`. If `mirrored` is a sign, off-diagonal entries are also
    /// stored transposed with that sign. Entries at the same position add up.
    pub fn compress(self, n: usize, mirrored: Option<i8>, factor: f64) -> SparseMatrix {
        let sign = f64::from(mirrored.unwrap_or(0));
        let again = |row: u32, column: u32| mirrored.is_some() && row != column;
        let mut starts = vec![0_usize; n + 1];
        for &(row, column, _) in &self.places {
            starts[column as usize + 1] += 1;
            if again(row, column) {
                starts[row as usize + 1] += 1;
            }
        }
        for column in 0..n {
            starts[column + 1] += starts[column];
        }
        let mut next = starts.clone();
        let (mut rows, mut values) = (vec![0_usize; starts[n]], vec![0.0; starts[n]]);
        let mut put = |row: u32, column: u32, value: f64| {
            let place = &mut next[column as usize];
            rows[*place] = row as usize;
            values[*place] = factor * value;
            *place += 1;
        };
        for (row, column, value) in self.places {
            put(row, column, value);
            if again(row, column) {
                put(column, row, sign * value);
            }
        }
        // Each column is sorted and its duplicates summed in place; later columns move forward into the space this
        // frees.
        let (mut kept, mut from, mut column_entries) = (0, 0, vec![]);
        for column in 0..n {
            let to = starts[column + 1];
            column_entries.clear();
            column_entries.extend((from..to).map(|k| (rows[k], values[k])));
            column_entries.sort_by_key(|entry| entry.0);
            let first = kept;
            for &(row, value) in &column_entries {
                if kept > first && rows[kept - 1] == row {
                    values[kept - 1] += value;
                } else {
                    rows[kept] = row;
                    values[kept] = value;
                    kept += 1;
                }
            }
            from = to;
            starts[column + 1] = kept;
        }
        rows.truncate(kept);
        values.truncate(kept);
        SparseMatrix::new(SymbolicSparseColMat::new_checked(n, n, starts, None, rows), values)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn entries_add_up_and_are_mirrored() {
        let mut entries = Entries::default();
        for (row, column, value) in [(2, 0, 1.0), (1, 1, 4.0), (2, 0, 2.0), (0, 0, 5.0), (2, 1, -1.0)] {
            entries.push(row, column, value);
        }
        assert_eq!(entries.len(), 5);
        let dense = entries.compress(3, Some(1), 2.0).to_dense();
        assert_eq!(dense, faer::mat![[10.0, 0.0, 6.0], [0.0, 8.0, -2.0], [6.0, -2.0, 0.0]]);
    }
}

//! The files between this program and the ranks: sparse matrices as PETSc binary, blocks of vectors as raw numbers.

use std::fs::File;
use std::io::{self, BufWriter, Read, Write};
use std::path::Path;

use faer::sparse::SparseRowMat;
use faer::{Mat, c64};

use crate::reduction::SparseMatrix;

/// Identifies a sparse matrix in PETSc's binary format, whose numbers are big-endian.
const MATRIX: i32 = 1_211_216;

/// Number of 64-bit floating-point numbers that make up a number of a block.
pub trait Number: Copy {
    const WORDS: usize;
    /// Kind of numbers that PETSc is built for.
    const SCALAR: &'static str;
    fn words(self) -> [f64; 2];
    fn of(words: &[f64]) -> Self;
}

impl Number for f64 {
    const WORDS: usize = 1;
    const SCALAR: &'static str = "real";
    fn words(self) -> [f64; 2] {
        [self, 0.0]
    }
    fn of(words: &[f64]) -> Self {
        words[0]
    }
}

impl Number for c64 {
    const WORDS: usize = 2;
    const SCALAR: &'static str = "complex";
    fn words(self) -> [f64; 2] {
        [self.re, self.im]
    }
    fn of(words: &[f64]) -> Self {
        c64::new(words[0], words[1])
    }
}

/// The upper triangle of one of two symmetric matrices, on the pattern of both; rows ascend in every column.
pub fn write_upper(path: &Path, one: &SparseMatrix, other: &SparseMatrix) -> io::Result<()> {
    let n = one.nrows();
    // The lower triangle by columns is the upper one by rows.
    let each = |visit: &mut dyn FnMut(usize, usize, f64) -> io::Result<()>| -> io::Result<()> {
        for row in 0..n {
            let column = |matrix: &SparseMatrix| {
                let range = matrix.col_ptr()[row]..matrix.col_ptr()[row + 1];
                let first = matrix.row_idx()[range.clone()].partition_point(|&index| index < row);
                range.start + first..range.end
            };
            let (mut a, mut b) = (column(one), column(other));
            let index = |matrix: &SparseMatrix, range: &std::ops::Range<usize>| {
                if range.is_empty() { usize::MAX } else { matrix.row_idx()[range.start] }
            };
            loop {
                let (of_one, of_other) = (index(one, &a), index(other, &b));
                let next = of_one.min(of_other);
                if next == usize::MAX {
                    break;
                }
                visit(row, next, if of_one == next { one.val()[a.start] } else { 0.0 })?;
                a.start += usize::from(of_one == next);
                b.start += usize::from(of_other == next);
            }
        }
        Ok(())
    };
    let mut lengths = vec![0_usize; n];
    each(&mut |row, _, _| {
        lengths[row] += 1;
        Ok(())
    })?;
    let mut out = head(path, n, &lengths)?;
    each(&mut |_, column, _| out.write_all(&int(column)?))?;
    each(&mut |_, _, value| out.write_all(&value.to_be_bytes()))?;
    out.flush()
}

/// A matrix of any symmetry.
pub fn write_rows<T: Number>(path: &Path, matrix: &SparseRowMat<usize, T>) -> io::Result<()> {
    let n = matrix.nrows();
    let lengths: Vec<usize> = matrix.row_ptr().windows(2).map(|pair| pair[1] - pair[0]).collect();
    let mut out = head(path, n, &lengths)?;
    matrix.col_idx().iter().try_for_each(|&column| out.write_all(&int(column)?))?;
    for value in matrix.val() {
        for word in &value.words()[..T::WORDS] {
            out.write_all(&word.to_be_bytes())?;
        }
    }
    out.flush()
}

/// Begins the file of an `n×n` matrix with rows of the given lengths.
fn head(path: &Path, n: usize, lengths: &[usize]) -> io::Result<BufWriter<File>> {
    let mut out = BufWriter::with_capacity(1 << 20, File::create_new(path)?);
    out.write_all(&MATRIX.to_be_bytes())?;
    for number in [n, n, lengths.iter().sum()] {
        out.write_all(&int(number)?)?;
    }
    lengths.iter().try_for_each(|&length| out.write_all(&int(length)?))?;
    Ok(out)
}

/// An index as PETSc has it unless it is built with `--with-64-bit-indices`.
fn int(value: usize) -> io::Result<[u8; 4]> {
    let reason = || io::Error::other(format!("{value} is too large for the 32-bit indices of PETSc's files"));
    i32::try_from(value).map(i32::to_be_bytes).map_err(|_| reason())
}

/// A block of vectors, column by column.
pub fn write_block<T: Number>(path: &Path, block: &Mat<T>) -> io::Result<()> {
    let mut out = BufWriter::with_capacity(1 << 20, File::create_new(path)?);
    for column in 0..block.ncols() {
        for row in 0..block.nrows() {
            for word in &block[(row, column)].words()[..T::WORDS] {
                out.write_all(&word.to_le_bytes())?;
            }
        }
    }
    out.flush()
}

/// A block of `columns` vectors that the ranks have written, each its rows: `ranges` has the first row of every rank and,
/// last, the number of rows, which must be `n`. `part` names the file of a rank.
///
/// # Errors
/// The file of a rank is missing, or is not as long as its rows.
pub fn read_block<T: Number>(
    n: usize,
    columns: usize,
    ranges: &[usize],
    part: &dyn Fn(usize) -> std::path::PathBuf,
    block: &mut Mat<T>,
) -> Result<(), String> {
    if ranges.first() != Some(&0) || ranges.last() != Some(&n) || !ranges.is_sorted() {
        return Err(format!("the ranks answered with the rows {ranges:?}, expected ranges from 0 to {n}"));
    }
    let size = size_of::<f64>() * T::WORDS;
    for (rank, range) in ranges.windows(2).enumerate() {
        let (path, rows) = (part(rank), range[1] - range[0]);
        let failed = |error: &dyn std::fmt::Display| format!("{}: {error}", path.display());
        let mut file = File::open(&path).map_err(|error| failed(&error))?;
        let (found, expected) =
            (file.metadata().map_err(|error| failed(&error))?.len(), (rows * columns * size) as u64);
        if found != expected {
            return Err(failed(&format!("{found} bytes, expected {expected}: {columns} columns of {rows} rows")));
        }
        let mut bytes = vec![0; rows * size];
        for column in 0..columns {
            file.read_exact(&mut bytes).map_err(|error| failed(&error))?;
            for (row, number) in bytes.chunks_exact(size).enumerate() {
                let mut words = [0.0; 2];
                for (word, bytes) in words.iter_mut().zip(number.chunks_exact(8)) {
                    *word = f64::from_le_bytes(bytes.try_into().expect("eight bytes"));
                }
                block[(range[0] + row, column)] = T::of(&words);
            }
        }
    }
    Ok(())
}

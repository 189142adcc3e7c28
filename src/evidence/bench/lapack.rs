//! LAPACK for comparison: a child process with scipy that solves the same matrices as the program.

use std::io::{self, BufRead, BufReader, Read, Write};
use std::path::Path;
use std::process::{Child, ChildStdin, ChildStdout, Command, Stdio};

use faer::{MatRef, c64};

/// Source of the Python program that the child runs.
const SCRIPT: &str = include_str!("../../../tests/peers/lapack.py");

/// Why LAPACK gave no answer.
#[derive(Debug, thiserror::Error)]
pub enum LapackError {
    /// Python did not start.
    #[error("{python}: cannot start")]
    Start {
        /// The program.
        python: String,
        /// Why.
        source: io::Error,
    },
    /// Python has no scipy.
    #[error("{python}: has no scipy")]
    NoScipy {
        /// The program.
        python: String,
    },
    /// The child ended before it answered.
    #[error("scipy has ended")]
    Ended(#[source] io::Error),
}

/// A Python process with scipy that solves eigenvalue problems.
pub struct Lapack {
    child: Child,
    stdin: Option<ChildStdin>,
    stdout: BufReader<ChildStdout>,
    /// The versions that the child reports.
    pub versions: String,
}

impl Lapack {
    /// Starts `python`.
    ///
    /// # Errors
    /// [`LapackError`]: `Start`, `NoScipy`, `Ended`.
    pub fn start(python: &Path) -> Result<Self, LapackError> {
        let mut child = Command::new(python)
            .args(["-c", SCRIPT])
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .map_err(|source| LapackError::Start { python: python.display().to_string(), source })?;
        let stdin = child.stdin.take();
        let mut stdout = BufReader::new(child.stdout.take().expect("standard output is piped"));
        let mut versions = String::new();
        stdout.read_line(&mut versions).map_err(LapackError::Ended)?;
        let peer = Self { child, stdin, stdout, versions: versions.trim().to_owned() };
        if peer.versions.is_empty() {
            return Err(LapackError::NoScipy { python: python.display().to_string() });
        }
        Ok(peer)
    }

    /// Computes the eigenvalues of `matrix`, and its left and right vectors if `vectors`. Returns the time taken in s,
    /// then the eigenvalues.
    ///
    /// # Errors
    /// [`LapackError::Ended`].
    pub fn solve(&mut self, matrix: MatRef<'_, f64>, vectors: bool) -> Result<(f64, Vec<c64>), LapackError> {
        let n = matrix.nrows();
        let stdin = self.stdin.as_mut().expect("standard input is piped until the child is dropped");
        let mut message = Vec::with_capacity(16 + 8 * n * n);
        message.extend((n as u64).to_le_bytes());
        message.extend(u64::from(vectors).to_le_bytes());
        for j in 0..n {
            (0..n).for_each(|i| message.extend(matrix[(i, j)].to_le_bytes()));
        }
        stdin.write_all(&message).and_then(|()| stdin.flush()).map_err(LapackError::Ended)?;
        let mut answer = vec![0; 8 * (1 + 2 * n)];
        self.stdout.read_exact(&mut answer).map_err(LapackError::Ended)?;
        let number = |k: usize| {
            let mut bytes = [0; 8];
            bytes.copy_from_slice(&answer[8 * k..8 * (k + 1)]);
            f64::from_le_bytes(bytes)
        };
        Ok((number(0), (0..n).map(|k| c64::new(number(1 + k), number(1 + n + k))).collect()))
    }
}

impl Drop for Lapack {
    fn drop(&mut self) {
        self.stdin = None; // its loop ends with its input
        let _ = self.child.wait();
    }
}

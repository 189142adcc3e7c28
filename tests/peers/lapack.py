"""Eigenvalues by LAPACK's dgeev, as scipy calls it, one thread: timed by `squealcast bench --lapack PYTHON` for comparison.

Standard input: matrix after matrix, each as two little-endian 64-bit integers (dimension; 0 values alone, 1 both vectors) and the
entries by columns. Standard output: first a line of versions; for each matrix the seconds of the call alone, then real and
imaginary parts of the eigenvalues. The size of the workspace is queried from LAPACK once; the input is not checked.
"""

import os

os.environ["OPENBLAS_NUM_THREADS"] = "1"  # before numpy is loaded

import struct
import sys
import time

import numpy as np
import scipy
from scipy.linalg import lapack


def main():
    stdin, stdout = sys.stdin.buffer, sys.stdout.buffer
    stdout.write(f"scipy {scipy.__version__}, numpy {np.__version__}\n".encode())
    stdout.flush()
    workspace = {}
    while head := stdin.read(16):
        n, vectors = struct.unpack("<qq", head)
        matrix = np.frombuffer(stdin.read(8 * n * n), dtype="<f8").reshape((n, n), order="F")
        if (n, vectors) not in workspace:
            workspace[n, vectors] = int(lapack.dgeev_lwork(n, compute_vl=vectors, compute_vr=vectors)[0])
        lwork = workspace[n, vectors]
        begun = time.perf_counter()
        re, im, _, _, info = lapack.dgeev(matrix, compute_vl=vectors, compute_vr=vectors, lwork=lwork)
        seconds = time.perf_counter() - begun
        if info != 0:
            sys.exit(f"dgeev: info {info}")
        stdout.write(struct.pack("<d", seconds) + re.astype("<f8").tobytes() + im.astype("<f8").tobytes())
        stdout.flush()


if __name__ == "__main__":
    main()

"""The lowest modes of K x = w2 M x by SLEPc with MUMPS: slepc_modes.py FOLDER COUNT SHIFT.

FOLDER holds compressed rows of both symmetric matrices as raw little-endian arrays: K.starts, K.rows (32 bits), K.values
(64 bits) and M likewise. Prints JSON: seconds from matrices to modes, largest memory, squares ascending.
Needs Debian's python3-slepc4py (written against 3.18); where Python does not find it, PYTHONPATH names the dist-packages
below /usr/lib/petscdir and /usr/lib/slepcdir.
"""

import json
import sys
import time

import numpy as np
import petsc4py

petsc4py.init(["slepc_modes"])
from petsc4py import PETSc  # noqa: E402
from slepc4py import SLEPc  # noqa: E402

folder, count, shift = sys.argv[1], int(sys.argv[2]), float(sys.argv[3])


def matrix(name):
    starts, rows = (np.fromfile(f"{folder}/{name}.{part}", "<i4") for part in ("starts", "rows"))
    values = np.fromfile(f"{folder}/{name}.values", "<f8")
    made = PETSc.Mat().createAIJ((len(starts) - 1,) * 2, csr=(starts, rows, values))
    made.setOption(PETSc.Mat.Option.SYMMETRIC, True)
    made.assemble()
    return made


stiffness, mass = matrix("K"), matrix("M")
with open("/proc/self/clear_refs", "w") as file:
    file.write("5")
began = time.perf_counter()
problem = SLEPc.EPS().create()
problem.setOperators(stiffness, mass)
problem.setProblemType(SLEPc.EPS.ProblemType.GHEP)
problem.setDimensions(count)
problem.setTolerances(1e-12)
problem.setWhichEigenpairs(SLEPc.EPS.Which.TARGET_MAGNITUDE)
problem.setTarget(shift)
transform = problem.getST()
transform.setType("sinvert")
transform.setShift(shift)
solver = transform.getKSP()
solver.setType("preonly")
factor = solver.getPC()
factor.setType("cholesky")
factor.setFactorSolverType("mumps")
problem.setFromOptions()
problem.solve()
squares = sorted(problem.getEigenvalue(k).real for k in range(problem.getConverged()))[:count]
seconds = time.perf_counter() - began
assert len(squares) == count, f"{len(squares)} of {count} converged"
status = open("/proc/self/status").read()
peak_mb = float(status.split("VmHWM:")[1].split()[0]) / 1024
print(json.dumps({"seconds": seconds, "peak_mb": peak_mb, "omega_squared": squares}))

"""Sparse factors, solves and modes by PETSc, SLEPc and MUMPS, for `squealcast --engine slepc`.

    mpiexec -n N python3 ranks.py FOLDER real|complex

Every rank waits for FOLDER/command-K.json, K = 1, 2, ..., and rank 0 answers each with FOLDER/reply-K.json. Matrices come
as PETSc binary files, a symmetric one as its upper triangle; each rank reads its range of rows. Blocks of vectors are raw
little-endian numbers, column by column. A rank writes its rows of an answer to FOLDER/FILE.RANK.

The ranks end when the command says so, when FOLDER is gone, or when FOLDER/alive does not change for a minute: the
program that started them is then gone too.

Written against PETSc and SLEPc 3.18 with petsc4py and slepc4py, as in Debian 12.
"""

import glob
import json
import os
import shutil
import sys
import time
import traceback

FOLDER, SCALAR = sys.argv[1:3]
GONE_S = 60.0


def reply(number, **values):
    """Answers a command; the file appears whole."""
    path = f"{FOLDER}/reply-{number}.json"
    with open(f"{path}.{os.getpid()}", "w") as file:
        json.dump(values, file)
    os.replace(f"{path}.{os.getpid()}", path)


def refuse(reason):
    """Ends this rank before it is ready."""
    reply(0, error=reason)
    sys.exit(reason)


# Debian keeps its builds beside each other, outside the path of Python; the version sorts last.
for library in ("petsc", "slepc"):
    sys.path[1:1] = sorted(glob.glob(f"/usr/lib/{library}dir/*/*-{SCALAR}/lib/python3/dist-packages"), reverse=True)
try:
    import numpy as np
    import petsc4py

    petsc4py.init(["squealcast"])
    from petsc4py import PETSc
    from slepc4py import SLEPc
except ImportError as error:
    refuse(
        f"{sys.executable}: {error}; expected petsc4py and slepc4py for {SCALAR} numbers "
        f"(Debian: python3-petsc4py-{SCALAR} and python3-slepc4py-{SCALAR}), or another --python"
    )

COMM = PETSc.COMM_WORLD
KIND = "complex" if np.dtype(PETSc.ScalarType).kind == "c" else "real"
if KIND != SCALAR:
    refuse(f"PETSc is built for {KIND} numbers, expected {SCALAR} ones: python3-slepc4py-{SCALAR}, or another --python")
if np.dtype(PETSc.RealType) != np.float64:
    refuse(f"PETSc is built for {np.dtype(PETSc.RealType)}, expected double precision")
if not PETSc.Sys.hasExternalPackage("mumps"):
    refuse("PETSc is built without MUMPS, expected a build with it (Debian's has it)")

# Of the factors of SLEPc: see `mumps`.
PETSC_OPTIONS = PETSc.Options()
PETSC_OPTIONS["st_mat_mumps_icntl_13"] = 1
PETSC_OPTIONS["st_mat_mumps_icntl_14"] = 100

FACTORS = {}


class Failed(Exception):
    """What the program is told; it is the same on all ranks."""


def matrix(name, symmetric):
    made = PETSc.Mat().create(COMM)
    made.setType("sbaij" if symmetric else "aij")
    viewer = PETSc.Viewer().createBinary(f"{FOLDER}/{name}", "r", comm=COMM)
    made.load(viewer)
    viewer.destroy()
    if symmetric:
        made.setOption(PETSc.Mat.Option.SYMMETRIC, True)
    return made


def shifted(command):
    """K + s M of the files `stiffness` and `mass`."""
    made = matrix(command["stiffness"], True)
    mass = matrix(command["mass"], True)
    made.axpy(command["shift"], mass, structure=PETSc.Mat.Structure.SAME_NONZERO_PATTERN)
    mass.destroy()
    return made


def mumps(pc, symmetric, room):
    """Lets `pc` factorise by MUMPS; `room` is the percentage of memory beyond its estimate."""
    pc.setType("cholesky" if symmetric else "lu")
    pc.setFactorSolverType("mumps")
    pc.setFactorSetUpSolverType()
    made = pc.getFactorMatrix()
    made.setMumpsIcntl(13, 1)  # the root is factorised by one rank, so that negative pivots are counted
    made.setMumpsIcntl(14, room)
    return made


class Factor:
    """A factor of a matrix, with the number of its negative pivots if it is symmetric."""

    def __init__(self, made, symmetric):
        self.matrix, self.negative = made, None
        for room in (30, 100, 400):
            self.ksp = PETSc.KSP().create(COMM)
            self.ksp.setOperators(made)
            self.ksp.setType("preonly")
            self.factor = mumps(self.ksp.getPC(), symmetric, room)
            self.ksp.setUp()
            code = self.factor.getMumpsInfog(1)
            if code not in (-8, -9):
                break
            self.ksp.destroy()
        if code < 0:
            raise Failed(f"MUMPS ended with INFOG(1) = {code}, INFOG(2) = {self.factor.getMumpsInfog(2)}")
        if symmetric:
            self.negative = self.factor.getMumpsInfog(12)

    def solve(self, local, columns, transposed):
        rows = self.matrix.getLocalSize()[0], self.matrix.getSize()[0]
        right = PETSc.Mat().createDense((rows, (None, columns)), array=local, comm=COMM)
        left = PETSc.Mat().createDense((rows, (None, columns)), comm=COMM)
        for dense in (right, left):
            dense.setUp()
            dense.assemble()
        self.factor.setMumpsIcntl(9, 0 if transposed else 1)
        self.factor.matSolve(right, left)
        answer = np.array(left.getDenseArray(), copy=True)
        right.destroy()
        left.destroy()
        return answer

    def destroy(self):
        self.ksp.destroy()
        self.matrix.destroy()


def write(name, local):
    """Writes the rows of this rank, column by column."""
    with open(f"{FOLDER}/{name}.{COMM.rank}", "wb") as file:
        file.write(np.asfortranarray(local).tobytes(order="F"))


def ranges(of):
    return [int(row) for row in of.getOwnershipRanges()]


def do_factor(command):
    symmetric = command["symmetric"]
    made = shifted(command) if symmetric else matrix(command["matrix"], False)
    factor = Factor(made, symmetric)
    if command["keep"]:
        FACTORS[command["name"]] = factor
    else:
        factor.destroy()
    return {"negative": factor.negative}


def do_solve(command):
    factor, columns = FACTORS[command["name"]], command["columns"]
    first, last = factor.matrix.getOwnershipRange()
    total = factor.matrix.getSize()[0]
    given = np.memmap(f"{FOLDER}/{command['in']}", PETSc.ScalarType, "r", shape=(total, columns), order="F")
    local = np.array(given[first:last], order="F")
    write(command["out"], factor.solve(local, columns, command["transposed"]))
    return {"ranges": ranges(factor.matrix)}


def do_drop(command):
    FACTORS.pop(command["name"]).destroy()
    return {}


def do_modes(command):
    stiffness, mass = matrix(command["stiffness"], True), matrix(command["mass"], True)
    problem = SLEPc.EPS().create(COMM)
    problem.setOperators(stiffness, mass)
    problem.setProblemType(SLEPc.EPS.ProblemType.GHEP)
    count = min(command["count"], stiffness.getSize()[0])
    problem.setDimensions(count)
    problem.setTolerances(1e-12, 1000)
    problem.setWhichEigenpairs(SLEPc.EPS.Which.TARGET_MAGNITUDE)
    problem.setTarget(-command["shift"])
    transform = problem.getST()
    transform.setType("sinvert")
    transform.setMatStructure(PETSc.Mat.Structure.SAME_NONZERO_PATTERN)
    solver = transform.getKSP()
    solver.setType("preonly")
    solver.getPC().setType("cholesky")
    solver.getPC().setFactorSolverType("mumps")
    problem.setUp()
    factor = solver.getPC().getFactorMatrix()
    if factor.getMumpsInfog(1) < 0:
        raise Failed(f"MUMPS ended with INFOG(1) = {factor.getMumpsInfog(1)}, INFOG(2) = {factor.getMumpsInfog(2)}")
    if factor.getMumpsInfog(12) > 0:
        problem.destroy()
        return {"negative": factor.getMumpsInfog(12)}
    start = stiffness.createVecRight()
    first, last = start.getOwnershipRange()
    stream = np.random.default_rng([command["seed"], COMM.rank])
    start.setArray(stream.uniform(-1.0, 1.0, last - first))
    problem.setInitialSpace(start)
    problem.solve()
    found = problem.getConverged()
    if found < count:
        raise Failed(f"{found} of {count} modes converged in {problem.getIterationNumber()} iterations")
    vectors, squares = np.empty((last - first, found), order="F"), []
    for k in range(found):
        squares.append(problem.getEigenpair(k, start).real)
        vectors[:, k] = start.getArray()
    order = np.argsort(squares, kind="stable")
    write(command["out"], vectors[:, order])
    answer = {"negative": 0, "squares": [squares[k] for k in order], "ranges": ranges(stiffness)}
    for made in (problem, stiffness, mass, start):
        made.destroy()
    return answer


COMMANDS = {"factor": do_factor, "solve": do_solve, "drop": do_drop, "modes": do_modes}


def alive():
    """What the program writes to show that it runs; `None` if that is gone."""
    try:
        with open(f"{FOLDER}/alive") as file:
            return file.read()
    except OSError:
        return None


def next_command(number):
    """Waits for a command; ends this rank if nobody gives one any more."""
    path, seen, changed, pause = f"{FOLDER}/command-{number}.json", alive(), time.monotonic(), 0.001
    while True:
        try:
            with open(path) as file:
                text = file.read()
            if text.endswith("\n"):
                return json.loads(text)
        except FileNotFoundError:
            pass
        time.sleep(pause)
        pause = min(1.05 * pause, 0.05)
        if time.monotonic() - changed > GONE_S / 2:
            now = alive()
            if now is not None and now != seen:
                seen, changed = now, time.monotonic()
            elif now is None or time.monotonic() - changed > GONE_S:
                shutil.rmtree(FOLDER, ignore_errors=True)
                sys.exit("the program that started these ranks is gone")


def peak_mb():
    with open("/proc/self/status") as file:
        return float(file.read().split("VmHWM:")[1].split()[0]) / 1024.0


def main():
    version = ".".join(map(str, PETSc.Sys.getVersion()))
    COMM.barrier()
    if COMM.rank == 0:
        slepc = ".".join(map(str, SLEPc.Sys.getVersion()))
        reply(0, ranks=COMM.size, petsc=version, slepc=slepc)
    number = 0
    while True:
        number += 1
        command = next_command(number)
        if command["do"] == "end":
            return
        try:
            answer = COMMANDS[command["do"]](command)
        except Failed as error:
            answer = {"error": str(error)}
        # Every rank has written its rows.
        COMM.barrier()
        if COMM.rank == 0:
            reply(number, peak_mb=peak_mb(), **answer)


try:
    main()
except BaseException as error:
    if not isinstance(error, SystemExit):
        traceback.print_exc()
    sys.stdout.flush()
    sys.stderr.flush()
    # Without waiting for the other ranks: the launcher ends them.
    os._exit(0 if isinstance(error, SystemExit) and not error.code else 1)

"""A million charted predictions of the tribometer by one call, beside the same from Rust in the same run:

    cargo build --release --example predict_many
    target/python/tools/bin/python crates/python/benches/predict_many.py [COUNT [RIG]]

Checks first that both give the same bits. Times are per prediction, the least of three runs each, in turn.
"""

import pathlib
import subprocess
import sys
import tempfile
import time

import numpy as np
import squealcast

ROOT = pathlib.Path(__file__).parents[3]
EXAMPLE = ROOT / "target/release/examples/predict_many"
# As in examples/predict_many.rs.
STEPS = (0.8191725133961645, 0.6710436067037893, 0.5497004779019707)


def points(rig, count):
    """The operating points of the example: friction coefficients, loads, speeds, for a rig with the usual `[chart]`."""
    ranges = ((0.0, rig.mu_max), (50.0, 2000.0), (1.0, 60.0))
    k = np.arange(count, dtype=float)
    return [low + (high - low) * np.fmod(k * step, 1.0) for (low, high), step in zip(ranges, STEPS)]


def main(count=1_000_000, name="tribometer"):
    count = int(count)
    rig = squealcast.Rig.load(name)
    chart = rig.chart()
    mu, load_n, speed_rad_s = points(rig, count)
    conditions = {"mu": mu, "load_n": load_n, "speed_rad_s": speed_rad_s, "chart": chart}
    lines, mine, parallel = [], [], []
    with tempfile.TemporaryDirectory() as folder:
        file = pathlib.Path(folder) / "eigenvalues"
        for run in range(3):
            words = [EXAMPLE, name, str(count), file] if run == 0 else [EXAMPLE, name, str(count)]
            done = subprocess.run(words, check=True, capture_output=True, text=True)
            lines.append([float(line.split()[-5]) for line in done.stdout.splitlines()])
            for threads, times in ((1, mine), (None, parallel)):
                began = time.perf_counter()
                found = rig.predict(**conditions, threads=threads)
                times.append((time.perf_counter() - began) * 1e6 / count)
        theirs = np.fromfile(file, np.complex128).reshape(count, -1)
    assert found.eigenvalue_per_s.tobytes() == theirs.tobytes(), "eigenvalues differ from those of Rust"
    charted = np.count_nonzero(found.route == squealcast.Route.CHARTED)
    print(f"{name}: {count} predictions, {charted} charted, {theirs.shape[1]} modes each; the same bits")
    evaluated, many = (min(times) for times in zip(*lines))
    for what, us in (
        ("Rust, evaluated one after the other", evaluated),
        ("Rust, analysis::many on one thread", many),
        ("Python, one call on one thread", min(mine)),
        ("Python, one call on all processors", min(parallel)),
    ):
        print(f"{what:38} {us:7.2f} us each")


if __name__ == "__main__":
    main(*sys.argv[1:])

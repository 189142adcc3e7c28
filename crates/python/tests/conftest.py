"""What the tests share: the program to compare with, named by SQUEALCAST or built by `cargo build --release`."""

import json
import os
import pathlib
import subprocess

import pytest

ROOT = pathlib.Path(__file__).parents[3]
PROGRAM = pathlib.Path(os.environ.get("SQUEALCAST", ROOT / "target/release/squealcast"))


@pytest.fixture(scope="session")
def program():
    """Runs the program; gives its standard output, or its last line of standard error if it fails."""
    if not PROGRAM.is_file():
        if "SQUEALCAST" in os.environ:
            pytest.fail(f"{PROGRAM}: no such program")
        pytest.skip(f"{PROGRAM} is not built")

    def run(*arguments):
        done = subprocess.run([PROGRAM, *map(str, arguments)], capture_output=True, text=True)
        return done.stdout if done.returncode == 0 else done.stderr.strip().splitlines()[-1]

    return run


@pytest.fixture(scope="session")
def predicted(program):
    """The output of `predict --json`."""

    def run(rig, **options):
        words = [word for name, value in options.items() for word in (f"--{name}", repr(float(value)))]
        return json.loads(program("predict", rig, "--json", *words))

    return run

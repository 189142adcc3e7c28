"""Charted predictions equal those of the Rust library to the last bit."""

import importlib.util
import os
import subprocess

import numpy as np
import pytest
import squealcast
from conftest import ROOT

SPEC = importlib.util.spec_from_file_location("predict_many", ROOT / "crates/python/benches/predict_many.py")
BENCH = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(BENCH)


def test_charted_predictions_are_those_of_the_library_to_the_last_bit(tmp_path):
    if not BENCH.EXAMPLE.is_file():
        if "SQUEALCAST" in os.environ:
            pytest.fail(f"{BENCH.EXAMPLE} is not built: cargo build --release --example predict_many")
        pytest.skip("the example is not built")
    count = 20_000
    subprocess.run([BENCH.EXAMPLE, "tribometer", str(count), tmp_path / "file"], check=True)
    theirs = np.fromfile(tmp_path / "file", np.complex128)
    rig = squealcast.Rig.load("tribometer")
    mu, load_n, speed_rad_s = BENCH.points(rig, count)
    found = rig.predict(mu=mu, load_n=load_n, speed_rad_s=speed_rad_s, chart=rig.chart(), threads=2)
    assert (found.route == squealcast.Route.CHARTED).all()
    assert found.eigenvalue_per_s.ravel().tobytes() == theirs.tobytes()

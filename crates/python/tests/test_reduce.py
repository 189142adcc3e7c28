"""Reduction of a full model that the program writes."""

import signal
import threading

import numpy as np
import pytest
import squealcast


@pytest.fixture(scope="module")
def full(program, tmp_path_factory):
    folder = tmp_path_factory.mktemp("full")
    program("tribometer", "--dof", "5000", "--output", folder)
    return folder / "tribometer.toml"


def test_a_reduced_rig_is_the_program_s(full, tmp_path, program):
    options = {"modes": "12+12", "points": 0, "residual": False}
    rig, complete = squealcast.reduce(full, tmp_path / "mine.toml", **options)
    assert complete and rig.dimension == 24 and rig.path == tmp_path / "mine.toml"
    again = squealcast.Rig.load(tmp_path / "mine.toml")
    assert again.content_hash == rig.content_hash
    (tmp_path / "theirs").mkdir()
    program("reduce", full, "--quiet", "--modes", "12+12", "--points", "0", "--no-residual", "-o", tmp_path / "theirs/mine.toml")
    theirs = squealcast.Rig.load(tmp_path / "theirs/mine.toml")
    assert theirs.content_hash == rig.content_hash
    assert np.isfinite(rig.predict(mu=0.2).frequency_hz).all()


def test_refused_as_by_the_program(full, tmp_path, program):
    with pytest.raises(squealcast.ReductionError) as raised:
        squealcast.reduce(full, tmp_path / "no/rig.toml")
    assert f"error: {raised.value}" == program("reduce", full, "-o", tmp_path / "no/rig.toml")
    with pytest.raises(squealcast.ReductionError, match="counts such as 80\\+80"):
        squealcast.reduce(full, tmp_path / "rig.toml", modes="many")


def test_control_c_ends_it_and_nothing_is_written(full, tmp_path):
    timer = threading.Timer(0.5, signal.raise_signal, [signal.SIGINT])
    timer.start()
    with pytest.raises(KeyboardInterrupt):
        squealcast.reduce(full, tmp_path / "rig.toml")
    timer.join()
    assert list(tmp_path.iterdir()) == []

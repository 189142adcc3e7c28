"""Predictions equal those of the program to the last bit, in any shape, order and number of threads."""

import csv
import io
import json
import signal
import threading
import time

import numpy as np
import pytest
import squealcast
from conftest import ROOT

FIELDS = {
    "frequency_hz": "frequency_hz",
    "growth_rate_per_s": "growth_rate_per_s",
    "damping_ratio": "damping_ratio",
    "mode_id": "id",
    "pad_participation": "pad_participation",
    "residual": "residual",
}


def same_bits(mine, theirs):
    """Whether arrays are equal bit by bit; the program writes NaN as null."""
    theirs = np.array([np.nan if value is None else value for value in theirs], float)
    return np.array_equal(np.asarray(mine, float).view(np.uint64), theirs.view(np.uint64)) or np.array_equal(
        mine, theirs, equal_nan=True
    )


@pytest.mark.parametrize("name", ["nine-dof-case-2", "rough-pad", "nine-dof-4+2", "tribometer", "tribometer-lining"])
def test_predictions_are_those_of_the_program_to_the_last_bit(name, predicted):
    rig = squealcast.Rig.load(name)
    low, high = rig.limits["load_n"]
    loads = np.clip([rig.reference.load_n, 137.0, 611.5], low, high)
    speeds = np.array([rig.reference.speed_rad_s, 7.25, -13.0])
    frictions = np.linspace(0.05, min(rig.mu_max, 0.9), 4)
    if name == "tribometer-lining":  # the program takes seconds for each
        loads, speeds, frictions = loads[1:2], speeds[1:2], frictions[1:3]
    found = rig.predict(load_n=loads[:, None], speed_rad_s=speeds[:, None], mu=frictions)
    assert found.shape == (len(loads), len(frictions))
    for i, (load, speed) in enumerate(zip(loads, speeds)):
        for j, mu in enumerate(frictions):
            report = predicted(name, load=load, speed=speed, mu=mu)
            count = len(report["modes"])
            assert (found.mode_id[i, j, count:] == -1).all() and np.isnan(found.frequency_hz[i, j, count:]).all()
            for mine, theirs in FIELDS.items():
                ours = getattr(found, mine)[i, j, :count]
                assert same_bits(ours, [mode[theirs] for mode in report["modes"]]), (mine, load, speed, mu)
            assert found.unstable_modes[i, j] == report["unstable_modes"]
            assert same_bits([found.max_growth_rate_per_s[i, j]], [report["max_growth_rate_per_s"]])


def test_order_shape_threads_and_gaps_do_not_change_a_prediction():
    rig = squealcast.Rig.load("rough-pad")
    random = np.random.default_rng(1)
    loads, frictions = random.choice([200.0, 300.0], (40, 60)), random.uniform(0.0, 0.6, (40, 60))
    found = rig.predict(load_n=loads, mu=frictions, threads=3)
    order = random.permutation(loads.size)
    shuffled = rig.predict(load_n=loads.ravel()[order], mu=frictions.ravel()[order], threads=1)
    back = np.argsort(order)
    for name in ("eigenvalue_per_s", "mode_id", "residual", "growth_rate_error_per_s"):
        assert getattr(found, name).reshape(2400, -1).tobytes() == getattr(shuffled, name)[back].tobytes(), name
    for name in ("level", "friction_margin", "critical_friction", "unstable_modes", "worst_frequency_hz"):
        assert getattr(found, name).ravel().tobytes() == getattr(shuffled, name)[back].tobytes(), name
    strided = rig.predict(load_n=loads[::7, ::5], mu=frictions[::7, ::5])
    assert strided.eigenvalue_per_s.tobytes() == found.eigenvalue_per_s[::7, ::5].tobytes()
    totals = rig.predict(load_n=loads, mu=frictions, modes=False)
    assert totals.mode_id.shape == (40, 60, 0)
    assert totals.max_growth_rate_per_s.tobytes() == found.max_growth_rate_per_s.tobytes()


def test_a_single_condition_gives_numbers():
    rig = squealcast.Rig.load("nine-dof-case-2")
    found = rig.predict(mu=0.6)
    assert found.shape == () and isinstance(found.max_growth_rate_per_s, float)
    assert found.frequency_hz.shape == (9,)
    assert found.level == squealcast.Level.SQUEAL and found.route == squealcast.Route.SOLVED
    inside = found.critical_friction - found.mu
    assert found.friction_margin == pytest.approx(-abs(inside), abs=1e-9)
    with pytest.raises(TypeError):
        len(found)


def test_charted_predictions_agree_with_solved_ones_within_their_bounds():
    rig = squealcast.Rig.load("nine-dof-case-2")
    chart = rig.chart(mu=(0.0, 1.0), threads=2)
    mu = np.random.default_rng(2).uniform(0.0, 1.0, 2000)
    charted, solved = rig.predict(mu=mu, chart=chart), rig.predict(mu=mu)
    assert (charted.route == squealcast.Route.CHARTED).all() and (solved.route == squealcast.Route.SOLVED).all()
    assert (charted.mode_id == solved.mode_id).all()
    off = np.abs(charted.frequency_hz - solved.frequency_hz)
    assert (off <= charted.frequency_error_hz + solved.frequency_error_hz).all()
    off = np.abs(charted.growth_rate_per_s - solved.growth_rate_per_s)
    assert (off <= charted.growth_rate_error_per_s + solved.growth_rate_error_per_s).all()
    beyond = rig.predict(mu=[0.5, 1.5], chart=chart)
    assert beyond.route.tolist() == [squealcast.Route.CHARTED, squealcast.Route.SOLVED]
    with pytest.raises(squealcast.ConditionError, match="the chart is of nine-dof-case-2, expected one of nine-dof"):
        squealcast.Rig.load("nine-dof").predict(mu=0.5, chart=chart)


def test_a_chart_is_kept_beside_the_rig_file(tmp_path):
    file = tmp_path / "own.toml"
    file.write_text((ROOT / "launch/rigs/nine-dof-3+2.toml").read_text())
    rig = squealcast.Rig.load(file)
    first = rig.chart(threads=2)
    assert first.path.parent == tmp_path and first.path.is_file() and first.path.suffix == ".chart"
    stored = first.path.stat().st_mtime_ns
    again = rig.chart(threads=1)
    assert again.solves == first.solves and again.leaves == first.leaves
    assert first.path.stat().st_mtime_ns == stored, "it is read, not built again"
    mu = np.linspace(*rig.limits["mu"], 50)
    first, again = rig.predict(mu=mu, chart=first), rig.predict(mu=mu, chart=again)
    assert first.eigenvalue_per_s.tobytes() == again.eigenvalue_per_s.tobytes()


def test_windows_and_critical_are_those_of_the_program(program):
    for name in ["nine-dof-case-2", "tribometer", "rough-pad"]:
        rig = squealcast.Rig.load(name)
        report = json.loads(program("critical", name, "--json"))
        windows = rig.windows()
        mine = [(w.mode_ids, w.mu_from, w.mu_to, w.frequency_hz, w.kind, w.at_jump) for w in windows]
        theirs = [
            (w["mode_ids"], w["mu_from"], w["mu_to"], w["frequency_hz"], w["kind"], w.get("at_jump", False))
            for w in report["windows"]
        ]
        assert mine == theirs and len(mine) > 0
        assert windows.critical_friction == report["critical_friction"] == rig.critical()
        assert windows.narrowest_window == report["narrowest_window"] and windows.complete == report["complete"]
    loads = np.array([[100.0, 200.0], [300.0, 400.0]])
    critical = rig.critical(load_n=loads)
    assert critical.shape == (2, 2)
    assert critical[1, 0] == rig.windows(load_n=300.0).critical_friction
    assert np.isnan(rig.critical(load_n=300.0, mu_max=0.001))


def test_sweeps_are_the_program_s_table(program):
    rig = squealcast.Rig.load("nine-dof-case-2")
    sweep = rig.sweep(mu=np.arange(101) * 0.01)
    assert sweep.to_csv() == program("sweep", "nine-dof-case-2", "--mu", "0:1:0.01")
    rows = list(csv.DictReader(io.StringIO(sweep.to_csv())))
    assert [float(row["frequency_hz"]) for row in rows] == sweep.frequency_hz.tolist()
    assert [int(row["mode_id"]) for row in rows] == sweep.mode_id.tolist()
    rig = squealcast.Rig.load("rough-pad")
    sweep = rig.sweep(load_n=100.0 + 50.0 * np.arange(11), mu=0.4)
    assert sweep.to_csv() == program("sweep", "rough-pad", "--load", "100:600:50", "--mu", "0.4")
    assert sweep.condition == "load_n" and sweep.missing == []


def test_figures_are_the_program_s(tmp_path, program):
    rig = squealcast.Rig.load("nine-dof-case-2")
    program("critical", "nine-dof-case-2", "--svg", tmp_path / "map.svg")
    assert rig.windows()._repr_svg_() == (tmp_path / "map.svg").read_text()
    program("sweep", "nine-dof-case-2", "--mu", "0:1:0.1", "--svg", tmp_path / "sweep.svg")
    assert rig.sweep(mu=np.arange(11) * 0.1)._repr_svg_() == (tmp_path / "sweep.svg").read_text()
    assert "<table" in rig._repr_html_() and "nine-dof-case-2" in rig._repr_html_()


def test_other_threads_go_on_meanwhile():
    rig = squealcast.Rig.load("tribometer")
    counted, done = [0], threading.Event()

    def count():
        while not done.is_set():
            counted[0] += 1
            time.sleep(0.001)

    thread = threading.Thread(target=count)
    thread.start()
    before = counted[0]
    rig.predict(mu=np.linspace(0.0, 1.0, 100), threads=1)
    after = counted[0]
    done.set()
    thread.join()
    # At least one step, whatever else the machine does: a call that holds the GIL allows none.
    assert after - before > 1


def test_control_c_ends_a_long_call():
    rig = squealcast.Rig.load("tribometer")
    mu = np.random.default_rng(3).uniform(0.0, 1.0, 10_000_000)
    timer = threading.Timer(0.3, signal.raise_signal, [signal.SIGINT])
    timer.start()
    # Solving them all would take hours.
    with pytest.raises(KeyboardInterrupt):
        rig.predict(mu=mu, modes=False)
    timer.join()


def test_pandas_tables():
    pandas = pytest.importorskip("pandas")
    rig = squealcast.Rig.load("nine-dof-case-2")
    frame = rig.predict(mu=[0.2, 0.6]).to_pandas()
    assert isinstance(frame, pandas.DataFrame) and len(frame) == 18
    assert (frame.groupby("mu").growth_rate_per_s.max() > 1e-3).tolist() == [False, True]
    assert len(rig.predict(mu=0.2).to_pandas()) == 9
    sweep = rig.sweep(mu=[0.1, 0.2])
    assert sweep.to_pandas().to_csv(index=False).count("\n") == 1 + 18

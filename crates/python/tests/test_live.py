"""The client beside a running node of the program, over shared memory under names of its own."""

import os
import signal
import subprocess
import threading
import time

import numpy as np
import pytest
import squealcast
from conftest import PROGRAM

RIG = "nine-dof-case-2"


@pytest.fixture
def node(program, tmp_path):
    """A running node; gives its prefix."""
    prefix = f"python{os.getpid()}/"
    command = [PROGRAM, "run", RIG, "--no-ros", "--no-display", "--no-chart-cache", "--shm-prefix", prefix]
    with open(tmp_path / "node.log", "wb") as log:
        running = subprocess.Popen(command, stdout=log, stderr=log)
        try:
            yield prefix
        finally:
            running.send_signal(signal.SIGINT)
            assert running.wait(30) == 0, (tmp_path / "node.log").read_text()


@pytest.fixture
def live(node):
    with squealcast.Live(prefix=node) as client:
        deadline = time.monotonic() + 30.0
        while client.nodes == 0:
            assert time.monotonic() < deadline, "no node within 30 s"
            time.sleep(0.01)
        yield client


def test_a_node_answers_with_its_predictions(live, predicted):
    for mu in (0.1, 0.3, 0.6, 0.9):
        answer = live.predict(load_n=500.0, speed_rad_s=13.0, mu=mu, timeout_s=30.0)
        report = predicted(RIG, load=500.0, speed=13.0, mu=mu)
        assert answer["unstable_modes"] == report["unstable_modes"]
        assert (answer["level"] == squealcast.Level.SQUEAL) == (report["unstable_modes"] > 0)
        found = squealcast.Rig.load(RIG).predict(load_n=500.0, speed_rad_s=13.0, mu=mu)
        # The node may have charted it: within the bounds of both.
        for name, unit in (("frequency", "_hz"), ("growth_rate", "_per_s")):
            bounds = answer[f"{name}_error{unit}"] + getattr(found, f"{name}_error{unit}")
            assert (np.abs(answer[name + unit] - getattr(found, name + unit)) <= bounds).all()
    assert live.counts["sent"] == 4 and live.counts["missed"] == 0


def test_predictions_are_received_in_order_and_counted(live):
    live.predict(load_n=500.0, speed_rad_s=13.0, mu=0.2, timeout_s=30.0)
    sent = []
    for mu in np.linspace(0.1, 0.5, 50):
        sent.append(live.send(load_n=500.0, speed_rad_s=13.0, mu=float(mu)))
        time.sleep(0.002)
    received = []
    while received[-1:] != sent[-1:]:
        answer = live.receive(timeout_s=30.0)
        assert answer is not None
        received.append(int(answer["input_seq"]))
    # What a node passes over under load it does not answer, and the newest it does. After a second without input it says so,
    # with the number of the last one.
    assert received == sorted(received) and set(received) <= {1, *sent}
    assert live.counts["received"] >= 1 + len(received)


def test_stamps_are_kept_and_a_fault_says_why(live):
    answer = live.predict(load_n=500.0, speed_rad_s=13.0, mu=float("nan"), stamp_ns=1_700_000_000_000_000_001, timeout_s=30.0)
    assert answer["stamp_ns"] == 1_700_000_000_000_000_001
    assert answer["level"] == squealcast.Level.FAULT and "expected a finite number" in answer["reason"]


def test_without_a_node_nothing_comes():
    with squealcast.Live(prefix=f"alone{os.getpid()}/") as live:
        assert live.nodes == 0 and live.other_sources == 0
        with pytest.raises(squealcast.LiveError, match="no prediction for input 1 within 0.05 s"):
            live.predict(load_n=1.0, speed_rad_s=1.0, mu=0.1, timeout_s=0.05)
    with pytest.raises(squealcast.LiveError, match="the client is closed"):
        live.send(load_n=1.0, speed_rad_s=1.0, mu=0.1)
    with pytest.raises(squealcast.LiveError, match="timeout_s is -1, expected 0 to 2e9"):
        live.receive(timeout_s=-1.0)


def test_control_c_ends_a_wait():
    with squealcast.Live(prefix=f"wait{os.getpid()}/") as live:
        timer = threading.Timer(0.2, signal.raise_signal, [signal.SIGINT])
        timer.start()
        with pytest.raises(KeyboardInterrupt):
            live.receive(timeout_s=600.0)
        timer.join()

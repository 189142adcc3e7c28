"""Measures the exchange of a node with each peer and prints the table of launch/ROS2.md, "Peers".

    table.py PROGRAM PEERS [--rate 500] [--seconds 10]

PROGRAM is squealcast, PEERS the folder that setup.sh made; rclpy of Jazzy is in PEERS-jazzy. Each peer gets a node of its
own, in a domain of its own. Below the table: what the node and the peers wrote to their logs.
"""

import argparse
import collections
import json
import os
import re
import signal
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path

HERE = Path(__file__).resolve().parent
RIG = "nine-dof-case-2"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("program", type=Path)
    parser.add_argument("peers", type=Path)
    parser.add_argument("--rate", type=int, default=500)
    parser.add_argument("--seconds", type=int, default=10)
    parser.add_argument("--domain", type=int, default=71, help="first of the domains used")
    options = parser.parse_args()
    jazzy = options.peers.with_name(options.peers.name + "-jazzy")
    ros, tools = options.peers / "bin/ros-python", options.peers / "bin/python"
    every = ["--rate", str(options.rate), "--seconds", str(options.seconds)]
    count = ["--rate", str(options.rate), "--count", str(options.rate * options.seconds), "--first-seq", "1", "--patience", "15"]
    peers = [
        ("rclpy of Kilted, Fast DDS", ros, "rclpy_peer.py", every),
        ("rclpy of Jazzy, Fast DDS", jazzy / "bin/ros-python", "rclpy_peer.py", every),
        ("CycloneDDS, Python", tools, "cyclone_peer.py", every),
        ("Zenoh, Python, through its router", tools, "zenoh_peer.py", every),
        ("iceoryx2, Python (shared memory)", tools, "shm_peer.py", count),
    ]
    logs = collections.Counter()
    print("| peer | inputs | not answered | round trip p50, p99, largest | checked beside answers |")
    print("|---|---|---|---|---|")
    for k, (name, python, script, arguments) in enumerate(peers):
        print(row(options, name, python, script, arguments, options.domain + k, logs), flush=True)
    print()
    for (who, line), times in sorted(logs.items()):
        print(f"{who}, {times} times: {line}")
    return 0


def row(options, name: str, python: Path, script: str, arguments: list[str], domain: int, logs) -> str:
    with tempfile.TemporaryDirectory() as folder:
        prefix = f"table-{os.getpid()}-{domain}/"
        command = [options.program, "run", RIG, "--loopback", "--plain", "--no-display", "--domain", str(domain)]
        errors = Path(folder, "stderr").open("w+")
        where = ["--prefix", prefix] if script == "shm_peer.py" else ["--domain", str(domain)]
        environment, router = dict(os.environ), None
        if script == "zenoh_peer.py":
            router, port = start_router(python)
            command += ["--rmw", "zenoh"]
            where += ["--router", port]
            environment["ZENOH_CONFIG_OVERRIDE"] = f'connect/endpoints=["tcp/127.0.0.1:{port}"]'
        command += ["--shm-prefix", prefix]
        node = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=errors, env=environment)
        time.sleep(1)
        peer = subprocess.run([python, HERE / script, *where, *arguments], capture_output=True, text=True)
        if router:
            router.stdin.close()
            router.wait()
        node.send_signal(signal.SIGINT)
        node.wait()
        errors.seek(0)
        note(logs, "node", errors.read())
        note(logs, name, peer.stderr)
        if not peer.stdout.strip():
            return f"| {name} | failed: {peer.stderr.strip().splitlines()[-1:]} | | | |"
        report = json.loads(peer.stdout)
    if "latency_us" in report:
        of, unit = report["latency_us"], 1e-3
        checked = ""
    else:
        of, unit = report["latency_ms"], 1.0
        checked = ", ".join(part for part in ("rig", "parameters", "diagnostics") if report.get(part))
    times = ", ".join(f"{unit * of[key]:.2f}" for key in ("p50", "p99", "max") if key in of)
    return f"| {name} | {report['sent']} | {report['sent'] - report['answered']} | {times} ms | {checked} |"


def start_router(python: Path) -> tuple[subprocess.Popen, str]:
    """A router of Zenoh on a free port."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = str(free.getsockname()[1])
    pipe = subprocess.PIPE
    router = subprocess.Popen([python, HERE / "zenoh_router.py", port], stdin=pipe, stdout=pipe, text=True)
    router.stdout.readline()
    return router, port


def note(logs, who: str, text: str) -> None:
    """Counts lines of a log, without what differs from run to run."""
    for line in text.splitlines():
        line = re.sub(r"\x1b\[[0-9;]*m", "", line).strip()
        line = re.sub(r"^(\[\w+\] )?\[\d+\.\d+\]", r"\1", line)
        line = re.sub(r"/\S+/(\S+)", r"\1", line)
        line = re.sub(r"\b[0-9a-f.:]{20,}\b|\b\d{4,}\b", "N", line)
        if line and not line.startswith(("recorded ", "recording into", "display:")):
            logs[who, line] += 1


if __name__ == "__main__":
    sys.exit(main())

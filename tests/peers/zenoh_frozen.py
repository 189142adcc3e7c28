"""What a frozen participant costs others on Zenoh, without squealcast: one publishes numbers, one answers each with 900
bytes, and a third, which subscribes to the answers, is frozen. All are Zenoh's Python binding, through a router.

Usage: zenoh_frozen.py PORT SECONDS

Prints the numbers that were not answered, and the threads that waited in close(2) for longer than a second (Linux).
ZENOH_RUNTIME, if it is set, is that of the one that answers.
"""

import json
import os
import signal
import struct
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

RATE = 500
CLOSE = "3"  # the system call, on x86-64
QUESTION, ANSWER = b"q" * 100, b"a" * 900


def join(port: str):
    import zenoh

    config = zenoh.Config()
    config.insert_json5("connect/endpoints", f'["tcp/127.0.0.1:{port}"]')
    config.insert_json5("listen/endpoints", '["tcp/127.0.0.1:0"]')
    config.insert_json5("scouting/multicast/enabled", "false")
    return zenoh.open(config)


def number(sample) -> int:
    return struct.unpack_from("<q", sample.payload.to_bytes())[0]


def answer(port: str) -> None:
    session = join(port)
    publisher = session.declare_publisher("answer")
    _subscriber = session.declare_subscriber(
        "question", lambda sample: publisher.put(struct.pack("<q", number(sample)) + ANSWER)
    )
    print("ready", flush=True)
    sys.stdin.read()
    os._exit(0)


def listen(port: str) -> None:
    session = join(port)
    _subscriber = session.declare_subscriber("answer", number)
    time.sleep(1)
    print("ready", flush=True)
    sys.stdin.read()


def ask(port: str, seconds: str) -> None:
    answered = set()
    with join(port) as session:
        publisher = session.declare_publisher("question")
        _subscriber = session.declare_subscriber("answer", lambda sample: answered.add(number(sample)))
        time.sleep(1.5)
        start, count = time.monotonic(), int(RATE * float(seconds))
        for k in range(count):
            time.sleep(max(start + k / RATE - time.monotonic(), 0))
            publisher.put(struct.pack("<q", k) + QUESTION)
        time.sleep(3)
    missing = [k for k in range(count) if k not in answered]
    print(json.dumps({"sent": count, "not_answered": len(missing), "first": missing[:1]}), flush=True)


def closing(process: subprocess.Popen) -> list[str]:
    """The threads of a process that are in close(2)."""
    names = []
    for task in Path(f"/proc/{process.pid}/task").glob("*"):
        try:
            if (task / "syscall").read_text().split()[0] == CLOSE:
                names.append((task / "comm").read_text().strip())
        except OSError:
            pass
    return names


def run(port: str, seconds: str) -> None:
    def start(role: str, *more: str, environment=os.environ) -> subprocess.Popen:
        command = [sys.executable, __file__, role, port, *more]
        pipe = subprocess.PIPE
        return subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True, env=environment)

    plain = {name: value for name, value in os.environ.items() if name != "ZENOH_RUNTIME"}
    command = [sys.executable, Path(__file__).with_name("zenoh_router.py"), port]
    router = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=plain)
    router.stdout.readline()
    answering, frozen = start("answer"), start("listen", environment=plain)
    for process in (answering, frozen):
        process.stdout.readline()
    frozen.send_signal(signal.SIGSTOP)
    asking, waited = start("ask", seconds, environment=plain), Counter()
    while asking.poll() is None:
        for name, process in (("router", router), ("answering", answering), ("asking", asking)):
            waited.update(f"{name} {thread}" for thread in closing(process))
        time.sleep(0.1)
    print(json.dumps({**json.loads(asking.stdout.read()), "in_close_s": {k: n / 10 for k, n in waited.items() if n > 10}}))
    for process in (frozen, answering, router):
        process.kill()


if __name__ == "__main__":
    {"answer": answer, "listen": listen, "ask": ask}.get(sys.argv[1], lambda *_: run(*sys.argv[1:]))(*sys.argv[2:])

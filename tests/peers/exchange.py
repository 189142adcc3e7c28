"""Shared by all peers: publish conditions at a rate, and record the answers."""

import argparse
import json
import os
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

LEVELS = ("OK", "WARN", "SQUEAL", "FAULT")
FAULT = 3
DEPTH = 64  # of every queue: reliable, keep last 64, by default
PARAMETERS = Path(__file__).parents[2] / "launch" / "params.yaml"


def parameters() -> dict[str, float]:
    """The node's parameters with their defaults, as the file that users are given lists them."""
    import yaml  # rclpy needs it too; other peers need no parameters

    return yaml.safe_load(PARAMETERS.read_text())["/**/squealcast"]["ros__parameters"]


def arguments(description: str) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--domain", type=int, required=True, help="DDS domain, 0 to 101; use a private one")
    parser.add_argument("--rate", type=float, default=500.0, help="inputs per second")
    parser.add_argument("--seconds", type=float, default=30.0, help="how long to publish")
    parser.add_argument("--load", type=float, default=500.0, help="normal load, N")
    parser.add_argument("--speed", type=float, default=13.0, help="disc speed, rad/s")
    parser.add_argument("--mu-from", type=float, default=0.3, help="friction coefficient at the start")
    parser.add_argument("--mu-to", type=float, default=0.4, help="friction coefficient at the end")
    parser.add_argument("--first-seq", type=int, default=1, help="sequence number of the first input")
    parser.add_argument("--wait", type=float, default=15.0, help="seconds to wait for the node to appear")
    parser.add_argument("--settle", type=float, default=1.0, help="seconds between discovery and the first input")
    parser.add_argument("--drain", type=float, default=5.0, help="seconds to wait for the last answers")
    parser.add_argument("--expect-modes", type=int, help="number of modes in every prediction")
    parser.add_argument(
        "--expect-unstable-above",
        type=float,
        metavar="MU",
        help="unstable modes above this friction coefficient, none below (but for 1e-6 about it)",
    )
    parser.add_argument("--depth", type=int, default=DEPTH, help="how many messages each queue of the peer keeps")
    parser.add_argument(
        "--allow-passed-over",
        action="store_true",
        help="inputs may stay unanswered (a large rig passes over what it cannot predict in time)",
    )
    parser.add_argument(
        "--allow-silence",
        action="store_true",
        help="the node may miss inputs that are under way (a link that loses some holds up all behind them)",
    )
    return parser


@dataclass
class Answer:
    """The fields of a prediction that are checked."""

    seq: int
    stamp_ns: int
    level: int
    reason: str
    modes: int
    unstable_modes: int
    reused: bool

    @classmethod
    def of(cls, message) -> "Answer":
        """Of a message in Python, whichever library decoded it."""
        stamp = message.header.stamp
        return cls(
            seq=message.input_seq,
            stamp_ns=stamp.sec * 1_000_000_000 + stamp.nanosec,
            level=message.level,
            reason=message.reason,
            modes=len(message.modes),
            unstable_modes=message.unstable_modes,
            reused=message.reused,
        )


@dataclass
class Sent:
    stamp_ns: int
    friction_coefficient: float
    at: float  # monotonic, s
    answers: int = 0
    answered_at: float = 0.0  # monotonic, s; the first time


@dataclass
class Exchange:
    """The record of one run. Answers may come on another thread than inputs."""

    args: argparse.Namespace
    inputs: dict[int, Sent] = field(default_factory=dict)
    latencies_s: list[float] = field(default_factory=list)
    levels: dict[str, int] = field(default_factory=dict)
    counts: dict[str, int] = field(default_factory=dict)
    failures: list[str] = field(default_factory=list)
    silence_faults: int = 0
    reused: int = 0
    span_s: float = 0.0
    began: float = field(default_factory=time.monotonic)
    discovery_s: float = 0.0
    newest_answer: int = -1
    lock: threading.Lock = field(default_factory=threading.Lock)

    def fail(self, kind: str, what: str) -> None:
        """Counts a failure; of each kind only the first three are spelt out."""
        self.counts[kind] = self.counts.get(kind, 0) + 1
        if self.counts[kind] <= 3:
            self.failures.append(f"{kind}: {what}")

    def discover(self, matched: Callable[[], bool], seen: Callable[[], str]) -> bool:
        """Waits for the node, then until its own discovery has had time; `seen` says what there was instead."""
        if not wait_until(matched, self.args.wait):
            self.fail("discovery", f"no node on domain {self.args.domain} within {self.args.wait:.0f} s: {seen()}")
            return False
        self.discovery_s = time.monotonic() - self.began
        time.sleep(self.args.settle)
        return True

    def points(self) -> Iterator[tuple[int, int, float]]:
        """Yields (seq, stamp in ns, friction coefficient) when due; the caller publishes it.

        After a stall it catches up at no more than twice the rate: a burst would test the queue, not the node.
        """
        args = self.args
        period = 1.0 / args.rate
        total = round(args.rate * args.seconds)
        start = time.monotonic()
        last, stamp = start - period, 0
        for k in range(total):
            pause = max(start + k * period, last + period / 2) - time.monotonic()
            if pause > 0:
                time.sleep(pause)
            last = time.monotonic()
            stamp = max(time.time_ns(), stamp + 1)
            mu = args.mu_from + (args.mu_to - args.mu_from) * k / max(total - 1, 1)
            with self.lock:
                self.inputs[args.first_seq + k] = Sent(stamp, mu, last)
            yield args.first_seq + k, stamp, mu
        self.span_s = time.monotonic() - start

    def answer(self, got: Answer) -> None:
        now = time.monotonic()
        with self.lock:
            self._account(got, now)

    def _account(self, got: Answer, now: float) -> None:
        if is_silence_fault(got):
            if not self.inputs:
                return  # about an earlier publisher
            since = now - max(sent.at for sent in self.inputs.values())
            if since < 0.5 and not self.args.allow_silence:
                self.fail("silence", f"reported {since:.3f} s after an input: {got.reason!r}")
            self.silence_faults += 1
            return
        sent = self.inputs.get(got.seq)
        if sent is None:
            self.fail("foreign", f"answer to seq {got.seq}, which was never sent")
            return
        sent.answers += 1
        if sent.answers > 1:
            self.fail("duplicate", f"seq {got.seq} answered {sent.answers} times")
            return
        if got.seq < self.newest_answer:
            self.fail("out_of_order", f"seq {got.seq} answered after {self.newest_answer}")
        sent.answered_at = now
        self.newest_answer = max(self.newest_answer, got.seq)
        self.latencies_s.append(now - sent.at)
        level = LEVELS[got.level] if got.level < len(LEVELS) else str(got.level)
        self.levels[level] = self.levels.get(level, 0) + 1
        self.reused += got.reused
        if got.stamp_ns != sent.stamp_ns:
            self.fail("stamp", f"seq {got.seq} was stamped {sent.stamp_ns}, its answer {got.stamp_ns}")
        if got.level >= FAULT:
            self.fail("fault", f"seq {got.seq}: level {level}, {got.reason!r}")
            return
        args, mu = self.args, sent.friction_coefficient
        if args.expect_modes is not None and got.modes != args.expect_modes:
            self.fail("modes", f"seq {got.seq}: {got.modes} modes instead of {args.expect_modes}")
        critical = args.expect_unstable_above
        if critical is not None and abs(mu - critical) > 1e-6 and (got.unstable_modes > 0) != (mu > critical):
            self.fail("stability", f"seq {got.seq}: {got.unstable_modes} unstable modes at {mu:.6f}")

    def first_answer_s(self) -> float | None:
        """From the first input that was sent to the first answer."""
        with_answer = [sent.answered_at for sent in self.inputs.values() if sent.answers]
        if not with_answer:
            return None
        return round(min(with_answer) - next(iter(self.inputs.values())).at, 3)

    def drain(self) -> None:
        """Waits until everything sent is answered, or for `--drain` seconds."""
        until = time.monotonic() + self.args.drain
        while time.monotonic() < until and any(not sent.answers for sent in self.inputs.values()):
            time.sleep(0.02)

    def finish(self, peer: str, more: dict[str, object]) -> int:
        """Prints the one line of JSON; returns the exit code."""
        with self.lock:
            missing = [seq for seq, sent in self.inputs.items() if not sent.answers]
            answered = len(self.inputs) - len(missing)
            if missing and not self.args.allow_passed_over:
                shown = ", ".join(map(str, missing[:3]))
                self.fail("missing", f"{len(missing)} of {len(self.inputs)} inputs unanswered, first: {shown}")
            if self.inputs and not answered:
                self.fail("missing", "nothing was answered")
            waits = sorted(self.latencies_s)
            report = {
                "peer": peer,
                "ok": not self.failures,
                "domain": self.args.domain,
                "sent": len(self.inputs),
                "answered": answered,
                "missing": len(missing),
                "first_answer_s": self.first_answer_s(),
                "rate_hz": round(len(self.inputs) / self.span_s, 1) if self.span_s else None,
                "discovery_s": round(self.discovery_s, 3),
                "latency_ms": {
                    name: round(1e3 * waits[min(int(share * len(waits)), len(waits) - 1)], 3)
                    for name, share in (("p50", 0.5), ("p99", 0.99), ("max", 1.0))
                    if waits
                },
                "levels": self.levels,
                "reused": self.reused,
                "silence_faults": self.silence_faults,
                **more,
                "failure_counts": self.counts,
                "failures": self.failures,
            }
        print(json.dumps(report), flush=True)
        return 0 if report["ok"] else 1


def is_silence_fault(got: Answer) -> bool:
    """The node's own report that inputs stopped coming: a FAULT that answers nothing."""
    return got.level == FAULT and any(word in got.reason.lower() for word in ("silen", "stale"))


def wait_until(condition: Callable[[], bool], seconds: float) -> bool:
    until = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > until:
            return False
        time.sleep(0.01)
    return True


def bound_run_time(seconds: float) -> None:
    """Ends the process with exit code 1 should anything hang."""

    def give_up() -> None:
        print(f"peer: not finished after {seconds:.0f} s, giving up", file=sys.stderr, flush=True)
        os._exit(1)

    timer = threading.Timer(seconds, give_up)
    timer.daemon = True
    timer.start()


def run_time_limit(args: argparse.Namespace) -> float:
    """More than a run that works can take."""
    return args.wait + args.settle + 2 * args.seconds + args.drain + 40.0

"""Two network namespaces with nothing between them but a link that loses, delays and reorders frames.

    bad_link.py [--loss 0.05] [--delay-ms 50] [--jitter-ms 5] [--seed 1]

Prints one line of JSON, {"near": PID, "far": PID}: `nsenter --net --target PID COMMAND` runs a command at that end, which
has the address 10.77.0.1 or 10.77.0.2. Ends when its standard input does, prints a second line (what became of the frames),
and takes the namespaces with it. Needs root, iproute2, util-linux and /dev/net/tun, and no queueing discipline of the kernel.

A frame is lost with a probability; any other is handed on after the delay, give or take the jitter, so that frames sent
within the jitter of each other overtake each other. Each end is a tap device, and this program carries the frames between
them.
"""

import argparse
import fcntl
import heapq
import itertools
import json
import os
import random
import select
import struct
import subprocess
import sys
import time

TUNSETIFF, IFF_TAP, IFF_NO_PI = 0x400454CA, 0x0002, 0x1000
ADDRESSES = {"near": "10.77.0.1/24", "far": "10.77.0.2/24"}
MAX_FRAME = 65_536


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--loss", type=float, default=0.05, help="share of frames that are lost, each way")
    parser.add_argument("--delay-ms", type=float, default=50.0, help="mean delay, each way")
    parser.add_argument("--jitter-ms", type=float, default=5.0, help="the delay is up to this much shorter or longer")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    if "BAD_LINK_APART" not in os.environ:
        # The taps are made in a namespace of this program's own, where nothing else runs.
        os.environ["BAD_LINK_APART"] = "yes"
        os.execvp("unshare", ["unshare", "--net", sys.executable, os.path.abspath(__file__), *sys.argv[1:]])

    # Each end lives as long as its `cat`, which ends with this program.
    holders = {end: subprocess.Popen(["unshare", "--net", "cat"], stdin=subprocess.PIPE) for end in ADDRESSES}
    try:
        taps = {end: join(end, holders[end].pid) for end in ADDRESSES}
        print(json.dumps({end: holder.pid for end, holder in holders.items()}), flush=True)
        counts = carry(taps, options)
    finally:
        for holder in holders.values():
            holder.kill()
            holder.wait()
    print(json.dumps(counts), flush=True)
    return 0


def join(end: str, pid: int) -> int:
    """A tap device within the namespace of a process; the file that its frames come from and go to."""
    own = os.readlink("/proc/self/ns/net")
    until = time.monotonic() + 10
    while os.readlink(f"/proc/{pid}/ns/net") == own:
        if time.monotonic() > until:
            raise TimeoutError("unshare --net does nothing")
        time.sleep(0.01)
    tap = os.open("/dev/net/tun", os.O_RDWR | os.O_NONBLOCK)
    fcntl.ioctl(tap, TUNSETIFF, struct.pack("16sH22x", end.encode(), IFF_TAP | IFF_NO_PI))
    ip("link", "set", end, "netns", str(pid))
    there = ["nsenter", "--net", "--target", str(pid)]
    ip("address", "add", ADDRESSES[end], "dev", end, there=there)
    ip("link", "set", "lo", "up", there=there)
    ip("link", "set", end, "up", "multicast", "on", "txqueuelen", "10000", there=there)
    ip("route", "add", "default", "dev", end, there=there)
    return tap


def ip(*arguments: str, there: list[str] = []) -> None:
    subprocess.run([*there, "ip", *arguments], check=True, stdout=subprocess.DEVNULL)


def carry(taps: dict[str, int], options: argparse.Namespace) -> dict[str, int]:
    """Until standard input ends."""
    chance = random.Random(options.seed)
    ends = list(taps)
    opposite = {taps[end]: taps[ends[1 - k]] for k, end in enumerate(ends)}
    waiting: list[tuple[float, int, int, bytes]] = []
    order = itertools.count()
    counts = dict.fromkeys(("carried", "lost", "overtaken", "refused"), 0)
    newest = dict.fromkeys(opposite, -1)
    delay, jitter = options.delay_ms / 1e3, options.jitter_ms / 1e3
    poll = select.poll()
    for file in (*opposite, sys.stdin.fileno()):
        poll.register(file, select.POLLIN)
    while True:
        now = time.monotonic()
        while waiting and waiting[0][0] <= now:
            _, number, to, frame = heapq.heappop(waiting)
            counts["overtaken"] += number < newest[to]
            newest[to] = max(newest[to], number)
            try:
                os.write(to, frame)
                counts["carried"] += 1
            except OSError:  # that end is down, or full
                counts["refused"] += 1
        pause = 1e3 * (waiting[0][0] - now) if waiting else 100
        for file, _ in poll.poll(max(pause, 0)):
            if file not in opposite:
                return counts
            for frame in frames(file):
                if chance.random() < options.loss:
                    counts["lost"] += 1
                    continue
                due = time.monotonic() + delay + chance.uniform(-jitter, jitter)
                heapq.heappush(waiting, (due, next(order), opposite[file], frame))


def frames(tap: int):
    """What waits there, but not for ever."""
    for _ in range(64):
        try:
            yield os.read(tap, MAX_FRAME)
        except OSError:
            return


if __name__ == "__main__":
    sys.exit(main())

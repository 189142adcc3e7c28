"""A crowd of rclpy participants that come and go around a node: 20 at a time.

15 of them (three processes) join, publish operating points for some seconds, wait until all are acknowledged and leave. Three
more are killed without notice and replaced. One subscribes to the predictions and is frozen (SIGSTOP). One publishes all the
time. Every publisher has sequence numbers of its own, a million apart. Prints one line of JSON: what each has sent, and
whether all of it was acknowledged. Run it with the `ros-python` that setup.sh installs.

    crowd.py --domain 42 --seconds 60
"""

import argparse
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

# Sequence numbers of one publisher.
ROOM = 1_000_000
ACKNOWLEDGED_WITHIN_S = 60


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--domain", type=int, required=True)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--member", help="what this process does in a crowd: visit, stay, listen")
    parser.add_argument("--participants", type=int, default=1)
    parser.add_argument("--first", type=int, default=0, help="number of the first publisher")
    parser.add_argument("--account", type=Path)
    args = parser.parse_args()
    if args.member:
        return member(args)

    chance = random.Random(args.seed)
    with tempfile.TemporaryDirectory() as folder:
        numbers = iter(range(1, ROOM))
        members: list[tuple[subprocess.Popen, Path]] = []

        def start(member: str, participants: int, seconds: float) -> subprocess.Popen:
            first = next(numbers) * 1000
            account = Path(folder, str(first))
            command = [sys.executable, __file__, "--domain", str(args.domain), "--seconds", str(seconds)]
            command += ["--member", member, "--participants", str(participants), "--first", str(first)]
            process = subprocess.Popen([*command, "--account", str(account), "--seed", str(first)])
            members.append((process, account))
            return process

        frozen = start("listen", 1, 10 * args.seconds)
        visitors = [start("visit", 5, args.seconds) for _ in range(3)]
        visitors.append(start("stay", 1, args.seconds))
        doomed = [(start("stay", 1, 10 * args.seconds), time.monotonic() + 15) for _ in range(3)]
        begun = time.monotonic()
        killed, is_frozen = 0, False
        while time.monotonic() < begun + args.seconds:
            time.sleep(0.1)
            now = time.monotonic()
            if not is_frozen and now > begun + 10:
                frozen.send_signal(signal.SIGSTOP)
                is_frozen = True
            for k, (process, until) in enumerate(doomed):
                if now > until:
                    process.kill()
                    process.wait()
                    killed += 1
                    doomed[k] = (start("stay", 1, 10 * args.seconds), now + chance.uniform(10, 20))
        for process, _ in doomed:
            process.kill()
            killed += 1
        frozen.kill()
        failed = 0
        for process in visitors:
            failed += process.wait(timeout=args.seconds + 2 * ACKNOWLEDGED_WITHIN_S) != 0
        for process, _ in members:
            process.wait()
        accounts = [json.loads(line) for _, path in members if path.exists() for line in lines(path)]
    # Of a publisher that was killed, the last line counts.
    last = {account["first"]: account for account in accounts}
    print(json.dumps({"publishers": list(last.values()), "killed": killed, "failed": failed}))
    return 0


def lines(path: Path) -> list[str]:
    """The whole lines: the last of a process that was killed may be cut off."""
    return [line for line in path.read_text().split("\n")[:-1] if line]


def member(args: argparse.Namespace) -> int:
    os.environ["ROS_DOMAIN_ID"] = str(args.domain)
    if args.member == "listen":
        return listen(args)
    visits = args.member == "visit"
    ends = time.monotonic() + args.seconds
    with args.account.open("w", buffering=1) as account:
        threads = [
            threading.Thread(target=participant, args=(args, k, visits, ends, account)) for k in range(args.participants)
        ]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    return 0


def participant(args: argparse.Namespace, k: int, visits: bool, ends: float, account) -> None:
    """Joins, publishes, leaves; a visitor again and again."""
    import rclpy
    from rclpy.duration import Duration
    from rclpy.qos import QoSProfile
    from squealcast_msgs.msg import OperatingPoint

    chance = random.Random(1000 * args.seed + k)
    number = args.first + 100 * k
    while time.monotonic() < ends:
        context = rclpy.Context()
        rclpy.init(args=[], context=context)
        node = rclpy.create_node(f"crowd_{number}", context=context)
        publisher = node.create_publisher(OperatingPoint, "/rig/operating_point", QoSProfile(depth=20_000))
        until = time.monotonic() + 30
        # The node has a reliable and a best-effort subscription.
        while publisher.get_subscription_count() < 2 and time.monotonic() < min(until, ends):
            time.sleep(0.05)
        known = publisher.get_subscription_count() >= 2
        leaves = min(ends, time.monotonic() + chance.uniform(3, 10)) if visits else ends
        sent = 0
        while known and time.monotonic() < leaves:
            point = OperatingPoint(
                seq=number * ROOM + sent, normal_load_n=500.0, disc_speed_rad_s=13.0, friction_coefficient=chance.random() / 3
            )
            point.header.stamp = node.get_clock().now().to_msg()
            publisher.publish(point)
            sent += 1
            if not visits:
                tell(account, number, sent, False)
            time.sleep(0.05 if visits else 0.02)
        acknowledged = publisher.wait_for_all_acked(Duration(seconds=ACKNOWLEDGED_WITHIN_S))
        tell(account, number, sent, acknowledged)
        node.destroy_node()
        context.shutdown()
        number += 1


def tell(account, number: int, sent: int, acknowledged: bool) -> None:
    account.write(json.dumps({"first": number * ROOM, "sent": sent, "acknowledged": acknowledged}) + "\n")


def listen(args: argparse.Namespace) -> int:
    from spinning import spinning
    from squealcast_msgs.msg import Prediction

    with spinning("crowd_frozen") as node:
        node.create_subscription(Prediction, "/squealcast/prediction", lambda _: None, 10)
        time.sleep(args.seconds)
    return 0


if __name__ == "__main__":
    sys.exit(main())

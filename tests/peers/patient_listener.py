"""Receives the same operating points as the node, with a queue that never overflows: those the node could have received.

Prints "listening" once it does. When its standard input ends it prints one line of JSON: how many it received, how many
different ones, the longest wait for one, and how many waits were longer than `--silence` seconds.
"""

import argparse
import json
import os
import sys
import threading
import time


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--domain", type=int, required=True)
    parser.add_argument("--silence", type=float, default=1.0, help="seconds without an input that count as a silence")
    args = parser.parse_args()
    os.environ["ROS_DOMAIN_ID"] = str(args.domain)

    import rclpy  # only now: it reads the environment
    from rclpy.executors import SingleThreadedExecutor
    from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
    from squealcast_msgs.msg import OperatingPoint

    rclpy.init(args=[])
    node = rclpy.create_node("patient_listener")
    received: list[tuple[float, int]] = []
    qos = QoSProfile(reliability=ReliabilityPolicy.RELIABLE, history=HistoryPolicy.KEEP_LAST, depth=20_000)
    receive = lambda message: received.append((time.monotonic(), message.seq))  # noqa: E731
    node.create_subscription(OperatingPoint, "/rig/operating_point", receive, qos)
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    ended = threading.Event()
    threading.Thread(target=lambda: (sys.stdin.read(), ended.set()), daemon=True).start()
    print("listening", flush=True)
    while not ended.is_set():
        executor.spin_once(timeout_sec=0.1)
    executor.shutdown()
    node.destroy_node()
    rclpy.try_shutdown()

    waits = [later - earlier for (earlier, _), (later, _) in zip(received, received[1:], strict=False)]
    report = {
        "heard": len(received),
        "different": len({seq for _, seq in received}),
        "longest_wait_s": round(max(waits, default=0.0), 3),
        "silences": sum(wait > args.silence for wait in waits),
    }
    print(json.dumps(report), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())

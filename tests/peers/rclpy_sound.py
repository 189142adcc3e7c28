"""Publishes samples of a microphone over ROS 2 with rclpy and receives the squeal that the node finds in them.

Prints one line of JSON; exit code 0 if the end of a squeal was published. Run it with the `ros-python` that setup.sh
installs.
"""

import json
import os
import sys
import time

from sound_blocks import RATE_HZ, arguments, blocks, report
from spinning import spinning


def main() -> int:
    parser = arguments(__doc__.splitlines()[0])
    parser.add_argument("--domain", type=int, required=True)
    args = parser.parse_args()
    os.environ["ROS_DOMAIN_ID"] = str(args.domain)
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")

    from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
    from squealcast_msgs.msg import Heard, Waveform

    qos = QoSProfile(reliability=ReliabilityPolicy.RELIABLE, history=HistoryPolicy.KEEP_LAST, depth=1000)
    heard: list[dict] = []

    def on_heard(message) -> None:
        heard.append({name: getattr(message, name) for name in ("channel", "number", "state", "verdict", "quantity")})
        heard[-1] |= {name: getattr(message, name) for name in ("frequency_hz", "level_db")}
        for name, stamp in (("onset_ns", message.header.stamp), ("end_ns", message.end_stamp)):
            heard[-1][name] = stamp.sec * 1_000_000_000 + stamp.nanosec

    def ended() -> bool:
        return any(one["state"] == Heard.ENDED for one in heard)

    with spinning("squealcast_test_microphone") as node:
        publisher = node.create_publisher(Waveform, "/rig/waveform", qos)
        node.create_subscription(Heard, "/squealcast/heard", on_heard, qos)
        deadline = time.monotonic() + args.patience
        # The node has a reliable and a best-effort subscription.
        while publisher.get_subscription_count() < 2 or node.count_publishers("/squealcast/heard") < 1:
            if time.monotonic() > deadline:
                sys.exit("the node was not discovered")
            time.sleep(0.05)
        time.sleep(1.0)  # for the node to discover this peer

        message = Waveform(channel="microphone", sample_rate_hz=float(RATE_HZ), unit="Pa")
        start_ns, sent = time.time_ns(), 0
        begun = time.monotonic()
        for after_s, samples in list(blocks(args.frequency_hz, args.amplitude)):
            stamp_ns = start_ns + round(after_s * 1e9)
            message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp_ns, 1_000_000_000)
            message.samples = samples
            time.sleep(max(0.0, begun + after_s - time.monotonic()))
            publisher.publish(message)
            sent += 1
        deadline = time.monotonic() + args.patience
        while not ended() and time.monotonic() < deadline:
            time.sleep(0.05)
    print(json.dumps(report(start_ns, heard, sent)))
    return 0 if ended() else 1


if __name__ == "__main__":
    sys.exit(main())

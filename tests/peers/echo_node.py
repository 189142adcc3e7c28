"""A stand-in of the node under test, only to check the peers themselves: it predicts nothing.

With `--defect` it has one intermittent defect, which the peers must find: see selftest.sh.
"""

import argparse
import math
import os
import sys
import time
from pathlib import Path

from exchange import parameters

DEFECTS = [
    *("none", "drop", "duplicate", "swap", "stamp", "seq", "fault"),  # of the answers
    *("accept-all", "no-reason", "no-rig", "no-diagnostics", "no-silence", "chatty-silence"),
]
EVERY = 100  # answers between two defects


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--domain", type=int, required=True)
    parser.add_argument("--defect", choices=DEFECTS, default="none")
    parser.add_argument("--modes", type=int, default=9)
    parser.add_argument(
        "--critical", type=float, default=0.35, help="friction coefficient of the pretended instability"
    )
    parser.add_argument("--seconds", type=float, default=120.0, help="ends by itself after this long")
    args = parser.parse_args()
    os.environ["ROS_DOMAIN_ID"] = str(args.domain)
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    os.environ["FASTDDS_DEFAULT_PROFILES_FILE"] = str(Path(__file__).with_suffix(".xml"))

    import rclpy
    from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
    from rcl_interfaces.msg import SetParametersResult
    from rclpy.executors import ExternalShutdownException
    from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
    from squealcast_msgs.msg import Mode, OperatingPoint, Prediction, RigInfo

    defect = args.defect
    rclpy.init(args=[])
    node = rclpy.create_node("squealcast")
    qos = QoSProfile(depth=64, reliability=ReliabilityPolicy.RELIABLE)
    latched = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    predictions = node.create_publisher(Prediction, "/squealcast/prediction", qos)
    rig = node.create_publisher(RigInfo, "/squealcast/rig", latched)
    diagnostics = node.create_publisher(DiagnosticArray, "/diagnostics", qos)

    received = {"count": 0, "at": None}
    held: list[Prediction] = []
    modes = [Mode(id=i, frequency_hz=100.0 * (i + 1)) for i in range(args.modes)]

    def on_point(point: OperatingPoint) -> None:
        received["count"] += 1
        received["at"] = time.monotonic()
        answer = Prediction(header=point.header, input_seq=point.seq, modes=modes, friction_margin=math.nan)
        answer.unstable_modes = int(point.friction_coefficient > args.critical)
        if received["count"] % EVERY == 0:
            if defect == "drop":
                return
            if defect == "duplicate":
                predictions.publish(answer)
            if defect == "swap":
                held.append(answer)
                return
            if defect == "stamp":
                answer.header.stamp.nanosec ^= 1
            if defect == "seq":
                answer.input_seq += 1_000_000
            if defect == "fault":
                answer.level, answer.reason = Prediction.FAULT, "solve failed"
        predictions.publish(answer)
        while held:
            predictions.publish(held.pop())

    def on_tick() -> None:
        silent = received["at"] is not None and time.monotonic() - received["at"] > 1.0
        if silent and defect != "no-silence":
            predictions.publish(Prediction(level=Prediction.FAULT, reason="silence: no input for 1 s"))
            received["at"] = time.monotonic() if defect == "chatty-silence" else None

    def on_second() -> None:
        if defect != "no-diagnostics":
            diagnostics.publish(DiagnosticArray(status=[DiagnosticStatus(name="squealcast: solver")]))

    def validate(parameters) -> SetParametersResult:
        for p in parameters:
            valid = isinstance(p.value, float) and math.isfinite(p.value)
            if valid and p.name != "squeal_damping_ratio":
                valid = p.value >= 0.0
            if not valid and defect != "accept-all":
                reason = "" if defect == "no-reason" else f"{p.name}: {p.value!r} is not a finite number in its range"
                return SetParametersResult(successful=False, reason=reason)
        return SetParametersResult(successful=True)

    for name, value in parameters().items():
        node.declare_parameter(name, value)
    node.add_on_set_parameters_callback(validate)
    node.create_subscription(OperatingPoint, "/rig/operating_point", on_point, qos)
    node.create_timer(0.1, on_tick)
    node.create_timer(1.0, on_second)
    if defect != "no-rig":
        rig.publish(RigInfo(name="stand-in", content_hash="0", version="0", mode_count=args.modes))

    until = time.monotonic() + args.seconds
    try:
        while rclpy.ok() and time.monotonic() < until:
            rclpy.spin_once(node, timeout_sec=0.2)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        node.destroy_node()
        rclpy.try_shutdown()
    return 0


if __name__ == "__main__":
    sys.exit(main())

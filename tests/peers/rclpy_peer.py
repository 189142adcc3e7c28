"""Drives the node under test over ROS 2 with rclpy, as a rig's own program would.

Publishes conditions and checks that each is answered once, in order, under its own stamp and sequence number; then, as
a late joiner, reads the rig; then the parameters; then the diagnostics. Prints one line of JSON; exit code 0 only if
every check passes. Run it with the `ros-python` that setup.sh installs.
"""

import argparse
import math
import os
import sys
import time

from exchange import Answer, Exchange, arguments, bound_run_time, parameters, run_time_limit, wait_until
from spinning import spinning

# The node's parameters, all doubles.
PARAMETERS = tuple(parameters())
CALL_TIMEOUT_S = 5.0


def options() -> argparse.Namespace:
    parser = arguments(__doc__.splitlines()[0])
    parser.add_argument("--node", default="squealcast", help="name of the node under test")
    parser.add_argument("--expect-rig", help="name of the rig that /squealcast/rig must say")
    parser.add_argument("--only-exchange", action="store_true", help="leave out rig, parameters, diagnostics, silence")
    return parser.parse_args()


def main() -> int:
    args = options()
    bound_run_time(run_time_limit(args))
    os.environ["ROS_DOMAIN_ID"] = str(args.domain)
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")

    exchange = Exchange(args)
    with spinning("squealcast_test_peer") as node:
        return Peer(exchange, node).run()


class Peer:
    def __init__(self, exchange: Exchange, node) -> None:
        from diagnostic_msgs.msg import DiagnosticArray
        from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
        from squealcast_msgs.msg import OperatingPoint, Prediction

        self.exchange, self.args, self.node = exchange, exchange.args, node
        self.diagnostics: list[DiagnosticArray] = []
        reliable = {"reliability": ReliabilityPolicy.RELIABLE, "history": HistoryPolicy.KEEP_LAST, "depth": self.args.depth}
        qos = QoSProfile(**reliable, durability=DurabilityPolicy.VOLATILE)
        self.latched = QoSProfile(**reliable, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.publisher = node.create_publisher(OperatingPoint, "/rig/operating_point", qos)
        self.subscription = node.create_subscription(Prediction, "/squealcast/prediction", self.on_prediction, qos)
        self.others = [node.create_subscription(DiagnosticArray, "/diagnostics", self.diagnostics.append, qos)]

    def run(self) -> int:
        exchange = self.exchange
        if not self.discover():
            return exchange.finish("rclpy", {})
        self.publish()
        more = {}
        if not self.args.only_exchange:
            more["rig"] = self.check_rig()
            more["parameters"] = self.check_parameters()
            more["diagnostics"] = self.check_diagnostics()
            self.check_silence()
        return exchange.finish("rclpy", more)

    def discover(self) -> bool:
        inputs = self.publisher.get_subscription_count
        answers = lambda: self.node.count_publishers(self.subscription.topic)  # noqa: E731
        return self.exchange.discover(
            lambda: inputs() > 0 and answers() > 0,
            lambda: f"{inputs()} subscribers of /rig/operating_point, {answers()} publishers of /squealcast/prediction",
        )

    def publish(self) -> None:
        from squealcast_msgs.msg import OperatingPoint

        message = OperatingPoint()
        message.header.frame_id = "rig"
        message.normal_load_n = self.args.load
        message.disc_speed_rad_s = self.args.speed
        for seq, stamp_ns, mu in self.exchange.points():
            message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp_ns, 1_000_000_000)
            message.seq = seq
            message.friction_coefficient = mu
            self.publisher.publish(message)
        self.exchange.drain()

    def on_prediction(self, message) -> None:
        self.exchange.answer(Answer.of(message))

    def check_rig(self) -> dict[str, object] | None:
        """A late joiner must get the latched rig."""
        from squealcast_msgs.msg import RigInfo

        got: list[RigInfo] = []
        self.others.append(self.node.create_subscription(RigInfo, "/squealcast/rig", got.append, self.latched))
        if not wait_until(lambda: bool(got), CALL_TIMEOUT_S):
            self.exchange.fail("rig", f"no /squealcast/rig within {CALL_TIMEOUT_S:.0f} s of joining late")
            return None
        rig = got[-1]
        if not rig.name or not rig.content_hash or not rig.version or not rig.mode_count:
            self.exchange.fail("rig", f"left empty: {rig}")
        if self.args.expect_rig not in (None, rig.name):
            self.exchange.fail("rig", f"{rig.name!r} instead of {self.args.expect_rig!r}")
        return {
            "name": rig.name,
            "content_hash": rig.content_hash,
            "version": rig.version,
            "mode_count": rig.mode_count,
        }

    def check_parameters(self) -> dict[str, object]:
        """List, get, describe, set; invalid values are refused with a reason and change nothing."""
        from rclpy.parameter import Parameter
        from rclpy.parameter_client import AsyncParameterClient

        fail = lambda what: self.exchange.fail("parameters", what)  # noqa: E731
        client = AsyncParameterClient(self.node, self.args.node)
        if not wait_until(client.services_are_ready, CALL_TIMEOUT_S):
            fail(f"no parameter services of /{self.args.node}")
            return {}

        def call(what: str, future):
            if wait_until(future.done, CALL_TIMEOUT_S) and future.result() is not None:
                return future.result()
            raise TimeoutError(f"{what}: no answer within {CALL_TIMEOUT_S:.0f} s")

        def get(name: str) -> float:
            return call(f"get {name}", client.get_parameters([name])).values[0].double_value

        def set_one(name: str, value: object):
            return call(f"set {name}", client.set_parameters([Parameter(name, value=value)])).results[0]

        try:
            listed = call("list", client.list_parameters([], 0)).result.names
            if absent := sorted(set(PARAMETERS) - set(listed)):
                fail(f"not listed: {', '.join(absent)}")
            values = call("get", client.get_parameters(list(PARAMETERS))).values
            wrong = [name for name, value in zip(PARAMETERS, values, strict=False) if value.type != 3]
            if wrong or len(values) != len(PARAMETERS):
                fail(f"{len(values)} values got for {len(PARAMETERS)} names; not doubles: {', '.join(wrong) or 'none'}")
            described = call("describe", client.describe_parameters(list(PARAMETERS))).descriptors
            if [(d.name, d.type) for d in described] != [(name, 3) for name in PARAMETERS]:
                fail(f"described as {[(d.name, d.type) for d in described]}")

            before = get("warn_margin")
            result = set_one("warn_margin", before + 0.125)
            after = get("warn_margin")
            if not result.successful or after != before + 0.125:
                fail(f"warn_margin {before} set to {before + 0.125}: {result.reason!r}, then got {after}")
            set_one("warn_margin", before)

            refused = {}
            for name, value in (
                ("warn_margin", math.nan),
                ("dead_band_load_n", -1.0),
                ("warn_margin", "wide"),
                ("no_such_parameter", 1.0),
            ):
                held = get(name) if name in PARAMETERS else None
                result = set_one(name, value)
                refused[f"{name}={value}"] = result.reason
                if result.successful or not result.reason:
                    fail(f"{name}={value}: successful={result.successful}, reason={result.reason!r}")
                if held is not None and get(name) != held:
                    fail(f"{name}={value} was refused but changed {held} to {get(name)}")
        except (TimeoutError, IndexError) as error:
            fail(str(error))
            return {}
        return {"listed": len(listed), "values": [v.double_value for v in values], "refused": refused}

    def check_diagnostics(self) -> int:
        if not wait_until(lambda: bool(self.diagnostics), 3.0):
            self.exchange.fail("diagnostics", "nothing on /diagnostics")
            return 0
        due = int(0.5 * self.args.seconds)
        if len(self.diagnostics) < due:
            self.exchange.fail("diagnostics", f"{len(self.diagnostics)} in {self.args.seconds} s, 1 Hz expected")
        if not all(array.status and all(status.name for status in array.status) for array in self.diagnostics):
            self.exchange.fail("diagnostics", "without a status, or a status without a name")
        return len(self.diagnostics)

    def check_silence(self) -> None:
        """Inputs have stopped: the node reports it once. (1 s is the default of silence_timeout_s.)"""
        wait_until(lambda: self.exchange.silence_faults > 0, 4.0)
        time.sleep(1.5)
        if self.exchange.silence_faults != 1:
            self.exchange.fail("silence", f"{self.exchange.silence_faults} FAULTs for silence instead of 1")


if __name__ == "__main__":
    sys.exit(main())

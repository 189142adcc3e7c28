"""Manages a node started with `run --managed` as ROS 2's lifecycle tools do, with rclpy.

Publishes operating points all the time, brings the node through its states over the lifecycle services, and counts the
predictions that come in each. Also reads the node's lines on /rosout and the descriptions of its parameters. Prints one
line of JSON. Run it with the `ros-python` that setup.sh installs.
"""

import argparse
import json
import os
import sys
import threading
import time

from spinning import spinning

NAME = "/squealcast"
# Request, and the state afterwards; the numbers of lifecycle_msgs/State.
STEPS = [
    ("activate", "unconfigured"),  # refused: it is not configured
    ("configure", "inactive"),
    ("activate", "active"),
    ("deactivate", "inactive"),
    ("activate", "active"),
    ("deactivate", "inactive"),
    ("cleanup", "unconfigured"),
    ("configure", "inactive"),
    ("shutdown", "finalized"),
]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--domain", type=int, required=True)
    parser.add_argument("--seconds", type=float, default=1.0, help="in each state")
    parser.add_argument("--patience", type=float, default=30.0, help="seconds for an answer")
    args = parser.parse_args()
    os.environ["ROS_DOMAIN_ID"] = str(args.domain)
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")

    from lifecycle_msgs.msg import TransitionEvent
    from lifecycle_msgs.srv import ChangeState, GetAvailableStates, GetAvailableTransitions, GetState
    from rcl_interfaces.msg import Log
    from rcl_interfaces.srv import DescribeParameters
    from rclpy.qos import DurabilityPolicy, QoSProfile
    from squealcast_msgs.msg import OperatingPoint, Prediction

    heard: list[int] = []
    events: list[list[str]] = []
    lines: list[list] = []
    clients: dict = {}
    stop = threading.Event()

    with spinning("squealcast_test_manager") as node:

        def call(kind, name, request):
            # Kept: the first answer to a new client may take 3 s (launch/ROS2.md, "Limits").
            client = clients.get(name) or clients.setdefault(name, node.create_client(kind, f"{NAME}/{name}"))
            if not client.wait_for_service(timeout_sec=args.patience):
                raise TimeoutError(f"no service {name}")
            # The first request may be lost while both sides discover each other.
            deadline = time.monotonic() + args.patience
            while time.monotonic() < deadline:
                future = client.call_async(request)
                until = time.monotonic() + 5
                while not future.done() and time.monotonic() < until:
                    time.sleep(0.002)
                if future.done():
                    return future.result()
            raise TimeoutError(f"no answer of {name}")

        def state() -> str:
            return call(GetState, "get_state", GetState.Request()).current_state.label

        def available() -> list[str]:
            answer = call(GetAvailableTransitions, "get_available_transitions", GetAvailableTransitions.Request())
            return sorted(found.transition.label for found in answer.available_transitions)

        node.create_subscription(Prediction, "/squealcast/prediction", lambda m: heard.append(m.input_seq), 1000)
        node.create_subscription(
            TransitionEvent,
            f"{NAME}/transition_event",
            lambda m: events.append([m.start_state.label, m.transition.label, m.goal_state.label]),
            100,
        )
        rosout = QoSProfile(depth=1000, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        node.create_subscription(Log, "/rosout", lambda m: lines.append([m.name, m.level, m.msg]), rosout)
        publisher = node.create_publisher(OperatingPoint, "/rig/operating_point", 100)

        sent = 0

        def publish() -> None:
            nonlocal sent
            while not stop.wait(0.01):
                point = OperatingPoint(
                    seq=sent, normal_load_n=500.0, disc_speed_rad_s=13.0, friction_coefficient=0.2 + 1e-6 * sent
                )
                point.header.stamp = node.get_clock().now().to_msg()
                publisher.publish(point)
                sent += 1

        report = {"first": state(), "available": available()}
        threading.Thread(target=publish, daemon=True).start()
        time.sleep(args.seconds)
        phases = []
        for label, _ in STEPS:
            request = ChangeState.Request()
            request.transition.label = label
            success = call(ChangeState, "change_state", request).success
            now = state()
            # What was predicted before the change may still be on its way.
            time.sleep(0.3)
            before = len(heard)
            time.sleep(args.seconds)
            phases.append({"asked": label, "success": success, "state": now, "predictions": len(heard) - before})
        stop.set()
        report["phases"] = phases
        states = call(GetAvailableStates, "get_available_states", GetAvailableStates.Request()).available_states
        report["states"] = {found.label: found.id for found in states}
        graph = call(GetAvailableTransitions, "get_transition_graph", GetAvailableTransitions.Request())
        report["graph"] = len(graph.available_transitions)
        described = call(DescribeParameters, "describe_parameters", DescribeParameters.Request(names=["warn_margin"]))
        margin = described.descriptors[0]
        report["described"] = [
            margin.description,
            margin.floating_point_range[0].from_value,
            margin.floating_point_range[0].to_value,
        ]
        # Log lines come once a second.
        time.sleep(1.5)
        report |= {"sent": sent, "events": events, "log": [line for line in lines if line[0] == "squealcast"]}

    expected = [(label, expected) for label, expected in STEPS]
    right = [(phase["asked"], phase["state"]) for phase in phases] == expected
    silent = all((phase["predictions"] > 0) == (phase["state"] == "active") for phase in phases)
    print(json.dumps(report))
    return 0 if right and silent else 1


if __name__ == "__main__":
    sys.exit(main())

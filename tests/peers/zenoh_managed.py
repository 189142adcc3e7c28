"""Manages a node started with `run --managed --rmw zenoh`, as rclpy_managed.py does over DDS: over the lifecycle services,
with Zenoh's own Python binding. Publishes operating points all the time and counts the predictions that come in each state.
Reads the node's lines on /rosout, late, and the parameters that choose quality of service. Prints one line of JSON.

Run it with the `python` that setup.sh installs, beside a router (zenoh_router.py).
"""

import argparse
import json
import sys
import threading
import time
from pathlib import Path

from exchange import bound_run_time, wait_until
from zenoh_peer import Client, Node, session, typestore

# Request, and the state afterwards.
STEPS = [
    ("activate", "unconfigured"),  # refused: it is not configured
    ("configure", "inactive"),
    ("activate", "active"),
    ("deactivate", "inactive"),
    ("cleanup", "unconfigured"),
    ("shutdown", "finalized"),
]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--router", type=int, required=True, help="port of the router on 127.0.0.1")
    parser.add_argument("--domain", type=int, required=True)
    parser.add_argument("--services", type=Path, required=True, help="JSON of types and their hashes")
    parser.add_argument("--seconds", type=float, default=1.0, help="in each state")
    args = parser.parse_args()
    bound_run_time(60.0)
    hashes = json.loads(args.services.read_text())
    store = typestore()
    Point = store.types["squealcast_msgs/msg/OperatingPoint"]
    Header, Time = store.types["std_msgs/msg/Header"], store.types["builtin_interfaces/msg/Time"]
    heard, events, lines, stop = [], [], [], threading.Event()

    with session(args.router) as joined:
        node = Node(joined, store, args.domain, "zenoh_manager")
        client = Client(node, "squealcast", hashes)
        kinds = ("squealcast_msgs/msg/OperatingPoint", "squealcast_msgs/msg/Prediction")
        publish = node.publisher("/rig/operating_point", kinds[0])
        _predictions = node.subscribe("/squealcast/prediction", kinds[1], lambda m: heard.append(m.input_seq))
        _events = node.subscribe(
            "/squealcast/transition_event",
            "lifecycle_msgs/msg/TransitionEvent",
            lambda m: events.append([m.start_state.label, m.transition.label, m.goal_state.label]),
        )
        if not wait_until(lambda: bool(node.peers("MP", "/squealcast/prediction", kinds[1])), 15.0):
            print("no node", file=sys.stderr)
            return 1

        def call(name, kind, **fields):
            return client.call(name, f"lifecycle_msgs/srv/{kind}", **fields)

        def nothing(name, kind):
            return call(name, kind, structure_needs_at_least_one_member=0)

        def state():
            return nothing("get_state", "GetState").current_state.label

        def send() -> None:
            seq = 0
            while not stop.wait(0.01):
                stamp = Time(*divmod(time.time_ns(), 1_000_000_000))
                publish(Point(Header(stamp, "rig"), seq, 500.0, 13.0, 0.2 + 1e-6 * seq))
                seq += 1

        available = nothing("get_available_transitions", "GetAvailableTransitions").available_transitions
        report = {"first": state(), "available": sorted(found.transition.label for found in available)}
        threading.Thread(target=send, daemon=True).start()
        phases = []
        for label, _ in STEPS:
            asked = store.types["lifecycle_msgs/msg/Transition"](0, label)
            success = bool(call("change_state", "ChangeState", transition=asked).success)
            now = state()
            time.sleep(0.3)  # what was predicted before the change may still be on its way
            before = len(heard)
            time.sleep(args.seconds)
            phases.append({"asked": label, "success": success, "state": now, "predictions": len(heard) - before})
        stop.set()
        states = nothing("get_available_states", "GetAvailableStates").available_states
        graph = nothing("get_transition_graph", "GetAvailableTransitions").available_transitions
        # A late joiner gets the lines that were written before.
        _log = node.subscribe_latched(
            "/rosout", "rcl_interfaces/msg/Log", lambda m: lines.append([m.name, m.level, m.msg]), depth=1000
        )
        wait_until(lambda: any(line[2] == "the node is active" for line in lines), 5.0)
        names = client.call("list_parameters", "rcl_interfaces/srv/ListParameters", prefixes=[], depth=0).result.names
        chosen = [name for name in names if name.startswith("qos_overrides")]
        values = client.call("get_parameters", "rcl_interfaces/srv/GetParameters", names=chosen).values
        tokens = []
        # On a busy machine an answer may come after the time that Zenoh gives a query.
        wait_until(lambda: tokens.extend(node.peers("MP", "/squealcast/prediction", kinds[1])) or tokens, 15.0)
        report |= {
            "phases": phases,
            "states": {found.label: found.id for found in states},
            "graph": len(graph),
            "events": events,
            "log": lines,
            "overrides": {name: value.integer_value or value.string_value for name, value in zip(chosen, values)},
            "qos": tokens[0].rsplit("/", 1)[1],
        }
    right = [(phase["asked"], phase["state"]) for phase in phases] == STEPS
    silent = all((phase["predictions"] > 0) == (phase["state"] == "active") for phase in phases)
    print(json.dumps(report))
    return 0 if right and silent else 1


if __name__ == "__main__":
    sys.exit(main())

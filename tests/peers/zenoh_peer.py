"""The exchange of rclpy_peer.py over Zenoh, by Zenoh's own Python binding, without anything of ROS: names, tokens and
attachments follow the design document of rmw_zenoh, types and their hashes come from rosbags.

Run it with the `python` that setup.sh installs, beside a router (zenoh_router.py). Prints one line of JSON; exit code 0 only if
every check passes.
"""

import json
import struct
import sys
import threading
import time
from pathlib import Path

import zenoh
from exchange import DEPTH, Answer, Exchange, arguments, bound_run_time, run_time_limit
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

MSGS = Path(__file__).parents[2] / "msgs" / "msg"


def typestore():
    """The types of ROS 2 Jazzy and those of msgs/."""
    store = get_typestore(Stores.ROS2_JAZZY)
    types = {}
    for file in MSGS.glob("*.msg"):
        types.update(get_types_from_msg(file.read_text(), f"squealcast_msgs/msg/{file.stem}"))
    store.register(types)
    return store


class Node:
    """A node on Zenoh, as rmw_zenoh makes one."""

    def __init__(self, session, store, domain, name):
        self.session, self.store, self.domain, self.name = session, store, domain, name
        self.zid, self.number, self.tokens = str(session.zid()), 0, []
        self.tokens.append(session.liveliness().declare_token(f"{self.prefix('NN', 0)}"))

    def prefix(self, kind, number):
        return f"@ros2_lv/{self.domain}/{self.zid}/0/{number}/{kind}/%/%/{self.name}"

    def type_of(self, kind):
        package, _, name = kind.split("/")
        return f"{package}::msg::dds_::{name}_", self.store.hash_rihs01(kind)

    def key(self, topic, kind):
        return "/".join([str(self.domain), topic.strip("/"), *self.type_of(kind)])

    def token(self, code, topic, kind, durability="", depth=DEPTH):
        self.number += 1
        mangled = topic.replace("/", "%")
        qos = f":{durability}:,{depth}:,:,:,,"
        token = "/".join([self.prefix(code, self.number), mangled, *self.type_of(kind), qos])
        self.tokens.append(self.session.liveliness().declare_token(token))

    def publisher(self, topic, kind):
        publisher = self.session.declare_publisher(self.key(topic, kind))
        self.token("MP", topic, kind)
        gid, count = struct.pack("<QQ", hash(self.zid) & 0xFFFF, self.number), 0

        def publish(message):
            nonlocal count
            count += 1
            attachment = struct.pack("<qqB16s", count, time.time_ns(), 16, gid)
            publisher.put(bytes(self.store.serialize_cdr(message, kind)), attachment=attachment)

        return publish

    def subscribe(self, topic, kind, take):
        def hear(sample):
            # Every message of a ROS 2 publisher carries one.
            sequence, _stamp, length, _gid = struct.unpack("<qqB16s", sample.attachment.to_bytes())
            assert sequence > 0 and length == 16
            take(self.store.deserialize_cdr(sample.payload.to_bytes(), kind))

        subscriber = self.session.declare_subscriber(self.key(topic, kind), hear)
        self.token("MS", topic, kind)
        return subscriber

    def subscribe_latched(self, topic, kind, take, depth=1):
        """As a transient-local subscription: it asks publishers for what they keep."""
        import zenoh.ext

        hear = lambda sample: take(self.store.deserialize_cdr(sample.payload.to_bytes(), kind))  # noqa: E731
        history = zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=depth)
        subscriber = zenoh.ext.declare_advanced_subscriber(self.session, self.key(topic, kind), hear, history=history)
        self.token("MS", topic, kind, durability="1", depth=depth)
        return subscriber

    def peers(self, code, topic, kind):
        """Tokens of endpoints of other sessions on a topic."""
        end = "/".join([topic.replace("/", "%"), *self.type_of(kind)])
        tokens = [str(reply.ok.key_expr) for reply in self.session.liveliness().get(f"@ros2_lv/{self.domain}/**")]
        return [token for token in tokens if f"/{code}/" in token and f"/{end}/" in token and self.zid not in token]


NOTHING = "uint8 structure_needs_at_least_one_member"  # what rosidl makes of an empty request
# Requests and responses of services, which rosbags does not have.
SERVICES = {
    "rcl_interfaces/srv/ListParameters": ("string[] prefixes\nuint64 depth", "ListParametersResult result"),
    "rcl_interfaces/srv/GetParameters": ("string[] names", "ParameterValue[] values"),
    "rcl_interfaces/srv/GetParameterTypes": ("string[] names", "uint8[] types"),
    "rcl_interfaces/srv/DescribeParameters": ("string[] names", "ParameterDescriptor[] descriptors"),
    "rcl_interfaces/srv/SetParameters": ("Parameter[] parameters", "SetParametersResult[] results"),
    "rcl_interfaces/srv/SetParametersAtomically": ("Parameter[] parameters", "SetParametersResult result"),
    "type_description_interfaces/srv/GetTypeDescription": (
        "string type_name\nstring type_hash\nbool include_type_sources",
        "bool successful\nstring failure_reason\nTypeDescription type_description\nTypeSource[] type_sources\n"
        "KeyValue[] extra_information",
    ),
    "lifecycle_msgs/srv/ChangeState": ("Transition transition", "bool success"),
    "lifecycle_msgs/srv/GetState": (NOTHING, "State current_state"),
    "lifecycle_msgs/srv/GetAvailableStates": (NOTHING, "State[] available_states"),
    "lifecycle_msgs/srv/GetAvailableTransitions": (NOTHING, "TransitionDescription[] available_transitions"),
}


def message_of(kind, part):
    package, _, name = kind.split("/")
    return f"{package}/msg/{name}_{part}"


class Client:
    """Calls the services of a node. The hashes of their types are rosidl's."""

    def __init__(self, node, of, hashes):
        self.node, self.of, self.hashes, self.count = node, of, hashes, 0
        types = {}
        for kind, parts in SERVICES.items():
            for part, text in zip(("Request", "Response"), parts):
                types.update(get_types_from_msg(text, message_of(kind, part)))
        node.store.register(types)

    def call(self, service, kind, **fields):
        store, (package, _, name) = self.node.store, kind.split("/")
        request = store.types[message_of(kind, "Request")](**fields)
        key = f"{self.node.domain}/{self.of}/{service}/{package}::srv::dds_::{name}_/{self.hashes[kind]}"
        self.count += 1
        gid = b"0123456789abcdef"
        replies = self.node.session.get(
            key,
            payload=bytes(store.serialize_cdr(request, message_of(kind, "Request"))),
            attachment=struct.pack("<qqB16s", self.count, time.time_ns(), 16, gid),
            target=zenoh.QueryTarget.ALL_COMPLETE,
            timeout=10.0,
        )
        [reply] = [reply.ok for reply in replies]
        sequence, _stamp, length, back = struct.unpack("<qqB16s", reply.attachment.to_bytes())
        assert (sequence, length, back) == (self.count, 16, gid), reply.attachment
        return store.deserialize_cdr(reply.payload.to_bytes(), message_of(kind, "Response"))

    def check(self, exchange):
        """Parameters listed, got, described, set and refused; a type described."""
        import numpy

        store, rcl = self.node.store, "rcl_interfaces/srv/"
        Value = store.types["rcl_interfaces/msg/ParameterValue"]
        Parameter = store.types["rcl_interfaces/msg/Parameter"]
        empty = lambda kind: numpy.array([], dtype=kind)  # noqa: E731
        double = lambda name, value: Parameter(  # noqa: E731
            name,
            Value(3, False, 0, value, "", empty("u1"), empty("bool"), empty("i8"), empty("f8"), []),
        )
        expect = lambda holds, what: holds or exchange.fail("parameters", what)  # noqa: E731
        get = lambda: self.call("get_parameters", rcl + "GetParameters", names=["warn_margin"]).values[0].double_value  # noqa: E731
        names = self.call("list_parameters", rcl + "ListParameters", prefixes=[], depth=0).result.names
        expect("warn_margin" in names and len(names) > 5, f"listed {names}")
        before = get()
        kinds = list(self.call("get_parameter_types", rcl + "GetParameterTypes", names=["warn_margin", "none"]).types)
        expect(kinds == [3, 0], f"types {kinds}")
        [described] = self.call("describe_parameters", rcl + "DescribeParameters", names=["warn_margin"]).descriptors
        expect((described.name, described.type) == ("warn_margin", 3), f"described {described}")
        [first, second] = self.call(
            "set_parameters",
            rcl + "SetParameters",
            parameters=[double("warn_margin", before + 0.01), double("warn_margin", -1.0)],
        ).results
        expect(first.successful, f"not set: {first.reason}")
        expect(not second.successful and "warn_margin" in second.reason, f"not refused: {second}")
        expect(abs(get() - before - 0.01) < 1e-12, f"{get()} after {before + 0.01} was set")
        atomically = self.call(
            "set_parameters_atomically",
            rcl + "SetParametersAtomically",
            parameters=[double("warn_margin", before), double("none", 1.0)],
        ).result
        expect(not atomically.successful and get() != before, f"set in part: {atomically}")
        self.call("set_parameters", rcl + "SetParameters", parameters=[double("warn_margin", before)])
        expect(get() == before, "not set back")
        kind = "squealcast_msgs/msg/Prediction"
        answer = self.call(
            "get_type_description",
            "type_description_interfaces/srv/GetTypeDescription",
            type_name=kind,
            type_hash=store.hash_rihs01(kind),
            include_type_sources=False,
        )
        fields = [field.name for field in answer.type_description.type_description.fields]
        expect(answer.successful and "friction_margin" in fields, f"not described: {answer.failure_reason}")


def session(router, lease_ms=10_000):
    """A session of a participant as rmw_zenoh opens it."""
    config = zenoh.Config()
    for key, value in (
        ("mode", '"peer"'),
        ("connect/endpoints", f'["tcp/127.0.0.1:{router}"]'),
        ("listen/endpoints", '["tcp/127.0.0.1:0"]'),
        ("scouting/multicast/enabled", "false"),
        ("timestamping/enabled", "true"),
        ("transport/link/tx/lease", str(lease_ms)),
    ):
        config.insert_json5(key, value)
    return zenoh.open(config)


def main() -> int:
    parser = arguments(__doc__.splitlines()[0])
    parser.add_argument("--router", type=int, required=True, help="port of the router on 127.0.0.1")
    parser.add_argument("--expect-rig", help="name of the rig that a late joiner is told")
    parser.add_argument("--lease-ms", type=int, default=10_000, help="silence after which others take it for gone")
    parser.add_argument("--services", type=Path, help="JSON of service types and their hashes: calls the services")
    args = parser.parse_args()
    bound_run_time(run_time_limit(args))
    exchange = Exchange(args)
    store = typestore()
    Point = store.types["squealcast_msgs/msg/OperatingPoint"]
    Header, Time = store.types["std_msgs/msg/Header"], store.types["builtin_interfaces/msg/Time"]

    def read(message) -> None:
        exchange.answer(Answer.of(message))

    with session(args.router, args.lease_ms) as joined:
        node = Node(joined, store, args.domain, "zenoh_peer")
        publish = node.publisher("/rig/operating_point", "squealcast_msgs/msg/OperatingPoint")
        _predictions = node.subscribe("/squealcast/prediction", "squealcast_msgs/msg/Prediction", read)
        inputs = lambda: node.peers("MS", "/rig/operating_point", "squealcast_msgs/msg/OperatingPoint")  # noqa: E731
        answers = lambda: node.peers("MP", "/squealcast/prediction", "squealcast_msgs/msg/Prediction")  # noqa: E731
        if not exchange.discover(lambda: bool(inputs() and answers()), lambda: f"{inputs()}, {answers()}"):
            return exchange.finish("zenoh", {})
        told, rig, asked = threading.Event(), {}, time.monotonic()

        def take(message) -> None:
            rig.update(name=message.name, version=message.version, after_s=round(time.monotonic() - asked, 3))
            told.set()

        # A late joiner: the node published its rig long ago.
        _rig = node.subscribe_latched("/squealcast/rig", "squealcast_msgs/msg/RigInfo", take)
        if not told.wait(10.0) or (args.expect_rig and rig["name"] != args.expect_rig):
            exchange.fail("rig", f"{rig or 'none'} instead of {args.expect_rig}")
        if args.services:
            Client(node, "squealcast", json.loads(args.services.read_text())).check(exchange)
        for seq, stamp_ns, mu in exchange.points():
            header = Header(Time(*divmod(stamp_ns, 1_000_000_000)), "rig")
            publish(Point(header, seq, args.load, args.speed, mu))
        exchange.drain()
        return exchange.finish("zenoh", {"rig": rig})


if __name__ == "__main__":
    sys.exit(main())

"""Reads a recording with PyPI `mcap` + `mcap-ros2-support` and with `rosbags`, and prints what each found as JSON.

Usage: read_recording.py [--summary] RECORDING_DIRECTORY

With --summary: counts instead of messages, and whether both readers found the same.
"""

import collections
import importlib.metadata
import json
import math
import sys
from pathlib import Path

from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore


def plain(value):
    """A message as the JSON the Rust side makes of it: field names to values, NaN and infinities null."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, bytes):
        return value[0] if len(value) == 1 else list(value)
    if isinstance(value, (bool, int, str)):
        return value
    if hasattr(value, "__slots__"):
        return {name: plain(getattr(value, name)) for name in value.__slots__ if not name.startswith("_")}
    if hasattr(value, "__dataclass_fields__"):
        names = [name for name in value.__dataclass_fields__ if name != "__msgtype__" and not name.isupper()]
        return {name: plain(getattr(value, name)) for name in names}
    if hasattr(value, "tolist"):
        return value.tolist()
    return [plain(element) for element in value]


def split_index(path):
    return int(path.stem.rsplit("_", 1)[1])


def with_mcap(files):
    messages, attachments = [], []
    for file in files:
        with file.open("rb") as stream:
            # Checks every CRC on its way.
            reader = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
            assert reader.get_header().profile == "ros2"
            for _schema, channel, message, decoded in reader.iter_decoded_messages():
                messages.append(
                    {"topic": channel.topic, "log_time": message.log_time, "message": plain(decoded)}
                )
            attachments = [attachment.name for attachment in reader.iter_attachments()]
    return messages, attachments


def with_rosbags(directory):
    typestore = get_typestore(Stores.ROS2_HUMBLE)
    messages = []
    with Reader(directory) as reader:
        for connection in reader.connections:
            typestore.register(get_types_from_msg(connection.msgdef.data, connection.msgtype))
            # The hash in metadata.yaml and the one of the channel's definition.
            assert connection.digest == typestore.hash_rihs01(connection.msgtype), connection
        # The counts in metadata.yaml and those of the files.
        assert reader.message_count == sum(connection.msgcount for connection in reader.connections)
        for connection, timestamp, raw in reader.messages():
            decoded = typestore.deserialize_cdr(raw, connection.msgtype)
            messages.append({"topic": connection.topic, "log_time": timestamp, "message": plain(decoded)})
        assert len(messages) == reader.message_count
        assert reader.start_time == messages[0]["log_time"]
        assert reader.end_time == messages[-1]["log_time"] + 1
    return messages


def summary(messages, others):
    """Messages by topic, and how many inputs have how many predictions of their stamp and sequence number."""
    key = lambda message, seq: (*message["header"]["stamp"].values(), message[seq])  # noqa: E731
    inputs = [key(m["message"], "seq") for m in messages if m["topic"] == "/rig/operating_point"]
    predicted = collections.Counter(
        key(m["message"], "input_seq") for m in messages if m["topic"] == "/squealcast/prediction"
    )
    return {
        "versions": {name: importlib.metadata.version(name) for name in ("mcap", "mcap-ros2-support", "rosbags")},
        "same": messages == others,
        "topics": collections.Counter(m["topic"] for m in messages),
        "inputs": len(set(inputs)),
        "predictions_of_an_input": collections.Counter(predicted[key] for key in set(inputs)),
    }


def main():
    directory = Path(sys.argv[-1])
    messages, attachments = with_mcap(sorted(directory.glob("*.mcap"), key=split_index))
    others = with_rosbags(directory)
    if "--summary" in sys.argv[1:-1]:
        json.dump({**summary(messages, others), "attachments": attachments}, sys.stdout)
    else:
        json.dump({"mcap": messages, "rosbags": others, "attachments": attachments}, sys.stdout)


main()

"""Writes recordings of operating points as other programs do: a rosbag2 directory by `rosbags`, and next to it a file
with LZ4 chunks and one without chunks by `mcap`, and three directories in forms that are not read: compressed message by
message (of the node's own topic), compressed as a whole, and in the sqlite3 format.

Usage: write_recording.py DIRECTORY
"""

import sys
from pathlib import Path

from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

POINT = "squealcast_msgs/msg/OperatingPoint"
TEXT = "std_msgs/msg/String"
MSGS = Path(__file__).parents[2] / "msgs" / "msg"
START_NS = 1_700_000_000_000_000_000
COUNT = 100

TYPESTORE = get_typestore(Stores.ROS2_JAZZY)
TYPESTORE.register(get_types_from_msg((MSGS / "OperatingPoint.msg").read_text(), POINT))


def messages():
    """Stamp, CDR of an operating point and CDR of a text."""
    types = TYPESTORE.types
    header, time = types["std_msgs/msg/Header"], types["builtin_interfaces/msg/Time"]
    for seq in range(COUNT):
        stamp = START_NS + seq * 2_000_000
        point = types[POINT](
            header=header(stamp=time(sec=stamp // 10**9, nanosec=stamp % 10**9), frame_id=""),
            seq=seq,
            normal_load_n=500.0 + seq,
            disc_speed_rad_s=13.0,
            friction_coefficient=0.3,
        )
        yield stamp, TYPESTORE.serialize_cdr(point, POINT), TYPESTORE.serialize_cdr(types[TEXT](data="hello"), TEXT)


def with_rosbags(directory, topic, storage, compression=CompressionMode.NONE):
    bag = Writer(directory, version=9, storage_plugin=storage)
    if compression != CompressionMode.NONE:
        bag.set_compression(compression, CompressionFormat.ZSTD)
    with bag as writer:
        points = writer.add_connection(topic, POINT, typestore=TYPESTORE)
        texts = writer.add_connection("/chatter", TEXT, typestore=TYPESTORE)
        for stamp, point, text in messages():
            writer.write(points, stamp, point)
            writer.write(texts, stamp, text)


def with_mcap(path, **options):
    writer = McapWriter(str(path), **options)
    writer.start(profile="ros2", library="peer")
    channels = []
    for topic, name in (("/lab/conditions", POINT), ("/chatter", TEXT)):
        definition, _ = TYPESTORE.generate_msgdef(name, ros_version=2)
        schema = writer.register_schema(name=name, encoding="ros2msg", data=definition.encode())
        channels.append(writer.register_channel(topic=topic, message_encoding="cdr", schema_id=schema))
    for stamp, *contents in messages():
        for channel, content in zip(channels, contents):
            writer.add_message(channel, log_time=stamp, data=bytes(content), publish_time=stamp)
    writer.finish()


def main():
    directory = Path(sys.argv[1])
    with_rosbags(directory, "/lab/conditions", StoragePlugin.MCAP)
    sibling = lambda kind: directory.with_name(f"{directory.name}-{kind}")
    with_rosbags(sibling("message"), "/rig/operating_point", StoragePlugin.MCAP, CompressionMode.MESSAGE)
    with_rosbags(sibling("file"), "/rig/operating_point", StoragePlugin.MCAP, CompressionMode.FILE)
    with_rosbags(sibling("sqlite3"), "/rig/operating_point", StoragePlugin.SQLITE3)
    with_mcap(directory.parent / "lz4.mcap", compression=CompressionType.LZ4)
    with_mcap(directory.parent / "plain.mcap", use_chunking=False)


main()

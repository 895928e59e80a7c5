"""Recordings as other tools make them, written by rosbags and by mcap; and what rosbags reads of them."""

from __future__ import annotations

import json
import shutil
import struct
import tempfile
from pathlib import Path

import numpy as np
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from rosbags.rosbag2 import CompressionFormat, Reader, StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

BEGIN = 1_790_000_000_000_000_000
CUSTOM = "my_msgs/msg/Custom"
DEFINITION = """std_msgs/Header header
float64[] values
geometry_msgs/Point[] points
uint8[4] quad
string name
bool flag
"""
STORE = get_typestore(Stores.ROS2_JAZZY)
STORE.register(get_types_from_msg(DEFINITION, CUSTOM))
TOPICS = {
    "/cmd_vel": "geometry_msgs/msg/Twist",
    "/scan": "sensor_msgs/msg/LaserScan",
    "/custom": CUSTOM,
    "/text": "std_msgs/msg/String",
    "/tf_static": "tf2_msgs/msg/TFMessage",
}
IDL = """================================================================================
IDL: my_msgs/msg/Inner
module my_msgs { module msg { struct Inner { double x; long n; }; }; };
================================================================================
IDL: my_msgs/msg/Outer
module my_msgs { module msg { struct Outer {
  my_msgs::msg::Inner inner; sequence<float> list; string s;
}; }; };
"""
"""As a ``ros2idl`` schema has it."""


def messages(count=100, begin=BEGIN):
    """Yield time, topic and value of each message."""
    kind = STORE.types
    vector, point = kind["geometry_msgs/msg/Vector3"], kind["geometry_msgs/msg/Point"]
    transform, quaternion = kind["geometry_msgs/msg/Transform"], kind["geometry_msgs/msg/Quaternion"]
    for number in range(count):
        now = begin + number * 20_000_000
        stamp = kind["builtin_interfaces/msg/Time"](now // 10**9, now % 10**9)
        header = kind["std_msgs/msg/Header"](stamp, "base")
        yield now, "/cmd_vel", kind[TOPICS["/cmd_vel"]](vector(number / 10, 0.0, 0.0), vector(0.0, 0.0, -1.5))
        if number % 2 == 0:
            ranges = np.arange(number % 7, dtype=np.float32)
            nothing = np.zeros(0, np.float32)
            scan = kind[TOPICS["/scan"]](header, -1.0, 1.0, 0.1, 0.0, 0.05, 0.1, 10.0, ranges, nothing)
            yield now + 1_000_000, "/scan", scan
            points = [point(1.0, 2.0, float(number))] * (number % 3)
            values = np.arange(number % 5, dtype=np.float64)
            quad = np.array([1, 2, 3, number % 256], np.uint8)
            custom = kind[CUSTOM](header, values, points, quad, f"n{number}", number % 4 == 0)
            yield now + 2_000_000, "/custom", custom
        if number % 25 == 0:
            yield now + 3_000_000, "/text", kind[TOPICS["/text"]](f"hello {number}")
        if number == 1:
            pose = transform(vector(1.0, 2.0, 3.0), quaternion(0.0, 0.0, 0.0, 1.0))
            stamped = kind["geometry_msgs/msg/TransformStamped"](header, "child", pose)
            yield now + 4_000_000, "/tf_static", kind[TOPICS["/tf_static"]]([stamped])


def write_bag(path, plugin=StoragePlugin.MCAP, count=100, begin=BEGIN, packed=None):
    """Write a rosbag2 directory with rosbags; return its path."""
    writer = Writer(path, version=9, storage_plugin=plugin)
    if packed is not None:
        writer.set_compression(packed, CompressionFormat.ZSTD)
    with writer:
        topics = {name: writer.add_connection(name, kind, typestore=STORE) for name, kind in TOPICS.items()}
        for time_ns, topic, value in messages(count, begin):
            writer.write(topics[topic], time_ns, STORE.serialize_cdr(value, TOPICS[topic]))
    return path


def read_bag(path):
    """Return time, topic, type and bytes of each message, as rosbags reads them."""
    with Reader(path) as reader:
        return [
            (time_ns, connection.topic, connection.msgtype, bytes(data))
            for connection, time_ns, data in reader.messages()
        ]


def values_of(message):
    """Return a message that rosbags read, in the shape of ``sniff --json``."""
    if isinstance(message, np.ndarray):
        return message.tolist()
    if isinstance(message, list):
        return [values_of(item) for item in message]
    if hasattr(message, "__msgtype__"):
        names = [name for name in vars(message) if not name.startswith("__")]
        return {name: values_of(getattr(message, name)) for name in names}
    return message


def write_studio(path, count=20, begin=BEGIN, **options):
    """Write an MCAP file with every kind of schema, as Foxglove and its SDK may; return its path."""
    with path.open("wb") as file:
        writer = McapWriter(file, **{"compression": CompressionType.LZ4, **options})
        writer.start("", "some other tool")
        twist = STORE.generate_msgdef("geometry_msgs/msg/Twist")[0].encode()
        kinds = {
            "/status": ("json", "Status", "jsonschema", b'{"type": "object"}'),
            "/proto": ("protobuf", "foo.Bar", "protobuf", b"\x0a\x00"),
            "/cmd_vel": ("cdr", "geometry_msgs/msg/Twist", "ros2msg", twist),
            "/outer": ("cdr", "my_msgs/msg/Outer", "ros2idl", IDL.encode()),
            "/raw": ("cdr", "", "", b""),
        }
        channels = {}
        for topic, (encoding, name, schema_encoding, data) in kinds.items():
            schema = writer.register_schema(name, schema_encoding, data) if name else 0
            channels[topic] = writer.register_channel(topic, encoding, schema, {"about": topic})
        for number in range(count):
            for place, topic in enumerate(kinds):
                now = begin + number * 100_000_000 + place
                writer.add_message(channels[topic], now, studio_message(topic, number), now - 5, number)
        writer.finish()
    return path


def studio_message(topic, number):
    """Return the bytes of a message of ``write_studio``."""
    if topic == "/status":
        return json.dumps({"ok": number % 2 == 0, "n": number, "who": {"list": [1, 2]}}).encode()
    if topic == "/proto":
        return b"\x08" + bytes([number])
    if topic == "/cmd_vel":
        return b"\0\1\0\0" + struct.pack("<6d", number, 0, 0, 0, 0, 0)
    if topic == "/outer":
        return b"\0\1\0\0" + struct.pack("<diI2fI3s", number / 2, number, 2, 1.5, 2.5, 3, b"hi\0")
    return b"\0\1\0\0some"


def write_sample(path):
    """Write ``samples/recordings/robot.mcap`` again: the file of a directory that rosbags wrote."""
    with tempfile.TemporaryDirectory() as folder:
        bag = write_bag(Path(folder) / "bag", count=60)
        shutil.copy(next(bag.glob("*.mcap")), path)


if __name__ == "__main__":
    write_sample(Path(__file__).parents[2] / "samples/recordings/robot.mcap")

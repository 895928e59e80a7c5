"""What ``info`` says of recordings of other tools, beside plain sums over their messages."""

import statistics

import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from edoras_tools.errors import RouteError
from edoras_tools.mission.model import RecordedTopic
from edoras_tools.pipelines.capture.info import inspect
from edoras_tools.pipelines.messages import message_bench, open_inputs
from edoras_tools.pipelines.selection import Selection
from edoras_tools.pipelines.workbench import Settings

STORE = get_typestore(Stores.ROS2_JAZZY)
BEGIN = 1_790_000_000_000_000_000
TWISTS = BEGIN + np.cumsum(np.random.default_rng(1).integers(5_000_000, 15_000_000, 40_000))
TEXTS = [BEGIN + 7, BEGIN + 10**9 + 7]


@pytest.fixture(scope="module", params=[StoragePlugin.SQLITE3, StoragePlugin.MCAP], ids=["db3", "mcap"])
def bag(request, tmp_path_factory):
    """40,000 Twist at irregular times, and two String of different length; one topic is empty."""
    path = tmp_path_factory.mktemp("bag") / "bag"
    with Writer(path, version=9, storage_plugin=request.param) as writer:
        names = {
            "/cmd_vel": "geometry_msgs/msg/Twist",
            "/text": "std_msgs/msg/String",
            "/empty": "std_msgs/msg/String",
        }
        topics = {name: writer.add_connection(name, kind, typestore=STORE) for name, kind in names.items()}
        for time_ns in TWISTS.tolist():
            writer.write(topics["/cmd_vel"], time_ns, bytes([0, 1, 0, 0]) + bytes(48))
        for time_ns, text in zip(TEXTS, (b"a", b"more"), strict=True):
            size = (len(text) + 1).to_bytes(4, "little")
            writer.write(topics["/text"], time_ns, bytes([0, 1, 0, 0]) + size + text + b"\0")
    return path


def counted(bag, topics=()):
    source, bench = open_inputs([bag], Settings())
    return inspect(source, bench, selection=Selection(topics=topics)).summary()


def test_counts_rates_and_sizes(bag):
    found = counted(bag)
    assert (found["messages"], found["datagrams"], found["capture_drops"]) == (40_002, 0, None)
    assert (found["start_ns"], found["end_ns"]) == (TEXTS[0], int(TWISTS.max()))
    twist, text, empty = (
        next(item for item in found["routes"] if item["topic"] == name)
        for name in ("/cmd_vel", "/text", "/empty")
    )
    steps = np.diff(TWISTS) / 1e6
    assert twist["rate_hz"] == pytest.approx(1000 / statistics.fmean(steps), abs=1e-3)
    assert twist["jitter_ms"] == pytest.approx(statistics.pstdev(steps), abs=1e-3)
    assert (twist["count"], twist["bytes"], twist["gaps"]) == (40_000, 52 * 40_000, None)
    assert (text["count"], text["rate_hz"], text["bytes_min"], text["bytes_max"]) == (2, 1.0, 10, 13)
    assert (empty["count"], empty["type"]) == (0, "std_msgs/msg/String")


def test_some_topics(bag):
    (row,) = counted(bag, ["t*"])["routes"]
    assert (row["topic"], row["count"]) == ("/text", 2)
    with pytest.raises(RouteError, match="did you mean /cmd_vel"):
        counted(bag, ["cmd_vle"])
    (row,) = counted(bag, ["/empty"])["routes"]
    assert (row["topic"], row["count"]) == ("/empty", 0)


IDL = """// generated from rosidl_adapter/resource/msg.idl.em
// with input from my_msgs/msg/Nothing.msg
// generated code does not contain a copyright notice


module my_msgs {
  module msg {
    struct Nothing {
      uint8 structure_needs_at_least_one_member;
    };
  };
};
"""
"""What rosidl writes of an empty message, as in ``share/test_msgs/msg/Empty.idl``."""


def test_an_empty_message_of_an_own_package_with_an_idl_schema_is_read():
    name = "my_msgs/msg/Nothing"
    schema = f"{'=' * 80}\nIDL: {name}\n{IDL}".encode()
    bench = message_bench([RecordedTopic("/nothing", name, "cdr", "ros2idl", schema)], Settings())
    assert [item.unread for item in bench.mission.recorded] == [""]
    assert bench.types.decode(name, b"\0\1\0\0\0") == {}
    assert bench.types.encode(name, {}) == b"\0\1\0\0\0"

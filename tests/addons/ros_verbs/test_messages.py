"""Messages by topic, against what their recording holds; their figures, against what ros2cli prints."""

import numpy as np
import pytest
from mcap.reader import make_reader
from places import SAMPLES

from edoras_tools.addons.ros_verbs.playing import (
    MessageBlock,
    TopicFigures,
    rate_table,
    read_topics,
    topics_in,
)
from edoras_tools.errors import ConfigError, RouteError
from edoras_tools.pipelines.capture.record import Target, record
from edoras_tools.pipelines.messages import open_inputs
from edoras_tools.pipelines.workbench import Settings
from edoras_tools.ros import TypeStore

MISSION = (SAMPLES / "missions/rover_ground.yaml",)
INPUTS = {
    "rover": (SAMPLES / "captures/a_rover.pcap", Settings(MISSION), "/cmd_vel"),
    "dds": (SAMPLES / "rtps/cyclone_sender.pcap.gz", Settings(), "/cmd_vel"),
    "bag": (SAMPLES / "recordings/robot.mcap", Settings(), "/custom"),
}


@pytest.mark.parametrize("name", INPUTS)
def test_they_are_those_of_a_recording(name, tmp_path):
    path, settings, topic = INPUTS[name]
    record(*open_inputs([path], settings), Target(tmp_path / "x.mcap"))
    with (tmp_path / "x.mcap").open("rb") as file:
        expected = [(item.log_time, item.data) for *_, item in make_reader(file).iter_messages(topic)]
    blocks = [block for some in read_topics(*open_inputs([path], settings), (topic,)) for block in some]
    found = [(int(at), block.cdr(row)) for block in blocks for row, at in enumerate(block.time_ns)]
    assert found == expected != []
    assert {block.topic for block in blocks} == {topic}


def test_a_filter_and_a_topic_that_there_is_not():
    path, settings, _ = INPUTS["bag"]
    rows = read_topics(*open_inputs([path], settings), ("/cmd_vel",), "linear.x > 5.5")
    assert sum(len(block.time_ns) for some in rows for block in some) == 4
    with pytest.raises(RouteError, match=r"no topic is called '/cmd_ve'; did you mean /cmd_vel\?"):
        list(read_topics(*open_inputs([path], settings), ("/cmd_ve",)))


def test_topics_with_their_publishers():
    found = {item[0].name: item for item in topics_in(*open_inputs([INPUTS["bag"][0]], Settings()))}
    assert {name: item[0].type for name, item in found.items()}["/scan"] == "sensor_msgs/msg/LaserScan"
    assert all(item[2] for item in found.values())
    found = {
        item[0].name: item[2] for item in topics_in(*open_inputs([INPUTS["rover"][0]], INPUTS["rover"][1]))
    }
    assert {"/cmd_vel", "/telemetry_pose", "/edoras/events", "/cfs/TO_LAB_HkTlm"} <= found.keys()
    assert "/edoras/link_statistics" not in found


def test_types_without_a_header_have_no_stamps():
    source, bench = open_inputs([INPUTS["dds"][0]], Settings())
    blocks = [block for some in read_topics(source, bench, ("/cmd_vel",)) for block in some]
    assert {block.stamps(bench.types) for block in blocks} == {None}
    assert all(np.all(block.sequence > 0) for block in blocks)


TYPES, STAMPED, SECOND = TypeStore(), "geometry_msgs/msg/TwistStamped", 10**9


def block(times, kind=STAMPED, topic="/a", ages=None, size=0):
    """Return messages that came at some times, as old as is said."""
    ages = ages or [0.25] * len(times)
    messages = []
    for time, age in zip(times, ages, strict=True):
        nanoseconds = round((time - age) * SECOND)
        stamp = {"sec": nanoseconds // SECOND, "nanosec": nanoseconds % SECOND}
        values = {"header": {"stamp": stamp}} if kind == STAMPED else {"data": "x" * size}
        messages.append(TYPES.encode(kind, values))
    length = np.array([len(item) for item in messages], np.int64)
    at = np.array([round(time * SECOND) for time in times], np.int64)
    data = np.frombuffer(b"".join(messages), np.uint8)
    return MessageBlock(
        topic, kind, at, at, np.zeros(len(at), np.uint32), data, np.cumsum(length) - length, length
    )


@pytest.mark.parametrize(
    ("kind", "window", "times", "text"),
    [
        ("hz", 10, [], ""),
        ("hz", 10, [5.0], ""),
        (
            "hz",
            10,
            [5.0, 5.1, 5.3],
            "average rate: 6.667\n\tmin: 0.100s max: 0.200s std dev: 0.05000s window: 2",
        ),
        (
            "hz",
            1,
            [5.0, 5.1, 5.3],
            "average rate: 5.000\n\tmin: 0.200s max: 0.200s std dev: 0.00000s window: 1",
        ),
        ("bw", 9, [5.0], ""),
        ("bw", 9, [5.0, 5.5, 6.0], "136 B/s from 3 messages\n\tMessage size mean: 68 B min: 68 B max: 68 B"),
        (
            "bw",
            2,
            [5.0, 5.1, 5.15],
            "1.36 KB/s from 2 messages\n\tMessage size mean: 0.07 KB min: 0.07 KB max: 0.07 KB",
        ),
        ("delay", 9, [5.0], "average delay: 0.250\n\tmin: 0.250s max: 0.250s std dev: 0.00000s window: 1"),
    ],
)
def test_what_ros2_prints(kind, window, times, text):
    figures = TopicFigures(kind, "/a", window)
    for time in times:
        figures.add(block([time]), TYPES)
    assert figures.text() == text


def test_batches_make_no_difference():
    times = [1 + number * 0.013 % 1 for number in range(40)]
    whole, parts = TopicFigures("hz", "/a", 7), TopicFigures("hz", "/a", 7)
    whole.add(block(sorted(times)), TYPES)
    for first in range(0, 40, 9):
        parts.add(block(sorted(times)[first : first + 9]), TYPES)
    assert whole.as_json() == parts.as_json()
    assert whole.as_json()["messages"] == 40


def test_several_topics_are_a_table_and_silent_ones_have_no_row():
    figures = [TopicFigures("hz", name, 100) for name in ("/a", "/longer/name", "/silent")]
    for item in figures[:2]:
        item.add(block([1.0, 1.5, 2.0]), TYPES)
    lines = rate_table(figures).splitlines()
    assert [line.split() for line in lines] == [
        ["topic", "rate", "min_delta", "max_delta", "std_dev", "window"],
        ["=" * len(lines[0])],
        ["/a", "2.000", "0.500", "0.500", "0.00000", "2"],
        ["/longer/name", "2.000", "0.500", "0.500", "0.00000", "2"],
    ]
    assert rate_table(figures[2:]) == ""


def test_a_delay_needs_a_header():
    with pytest.raises(ConfigError, match="/a: std_msgs/msg/String has no header"):
        TopicFigures("delay", "/a", 9).add(block([1.0], "std_msgs/msg/String"), TYPES)
    assert TopicFigures("delay", "/a", 9).as_json()["mean_s"] is None


def test_the_stamp_of_a_big_endian_message():
    ours = block([5.0])
    cdr = TYPES.encode(STAMPED, TYPES.decode(STAMPED, ours.cdr(0)), big_endian=True)
    other = ours._replace(data=np.frombuffer(cdr, np.uint8))
    assert other.stamps(TYPES).tolist() == ours.stamps(TYPES).tolist() == [4_750_000_000]

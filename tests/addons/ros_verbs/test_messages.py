"""The messages of captures and recordings by topic, against what their recording holds."""

import numpy as np
import pytest
from mcap.reader import make_reader
from places import SAMPLES

from edoras_tools.addons.ros_verbs.messages import read_topics, topics_in
from edoras_tools.errors import RouteError
from edoras_tools.pipelines.capture.record import Target, record
from edoras_tools.pipelines.messages import open_inputs
from edoras_tools.pipelines.workbench import Settings

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

from __future__ import annotations

import pytest
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_typestore
from ruamel.yaml import YAML

from edoras_tools.errors import CaptureError
from edoras_tools.io import RecordingOptions
from edoras_tools.io.formats.rosbag2.writer import Rosbag2Sink
from edoras_tools.model import SourceStatistics
from edoras_tools.ros import TypeStore


def record(path, mission, types, info, pairs, **options):
    sink = Rosbag2Sink(path, mission, types, info, RecordingOptions(**options))
    for batch, columns in pairs:
        sink.write(batch, columns)
        sink.flush()
    sink.close(SourceStatistics())
    sink.close(SourceStatistics())


def test_rosbags_reads_the_directory(tmp_path, types, capture):
    rover = capture("a_rover", "rover_ground")
    path = tmp_path / "bag"
    record(path, rover.mission, types, rover.info, rover.pairs)
    assert sorted(item.name for item in path.iterdir()) == ["bag_0.mcap", "metadata.yaml"]
    with Reader(path) as reader:
        counts = {connection.topic: connection.msgcount for connection in reader.connections}
        assert reader.message_count == sum(counts.values())
    assert (counts["/cmd_vel"], counts["/telemetry_pose"]) == (600, 63)
    with AnyReader([path]) as reader:
        chosen = [item for item in reader.connections if item.topic == "/telemetry_pose"]
        poses = [reader.deserialize(raw, item.msgtype) for item, _, raw in reader.messages(chosen)]
    assert poses[2].pose.position.y == 0.5


def test_a_split_bag_is_one_bag(tmp_path, types, mission, info, made_up):
    path = tmp_path / "bag"
    batch, columns = made_up(1, [100] * 100, step_ns=100_000_000)
    record(path, mission, types, info, [(batch, columns)], split_ns=2_000_000_000)
    metadata = YAML(typ="safe").load(path / "metadata.yaml")["rosbag2_bagfile_information"]
    assert metadata["relative_file_paths"] == [item["path"] for item in metadata["files"]]
    assert len(metadata["files"]) >= 2
    assert metadata["starting_time"]["nanoseconds_since_epoch"] == batch.time_ns[0]
    assert metadata["duration"]["nanoseconds"] == batch.time_ns[-1] - batch.time_ns[0]
    with Reader(path) as reader:
        assert sum(1 for _ in reader.messages()) == metadata["message_count"]


@pytest.mark.quick("humble*", "kilted*")
@pytest.mark.parametrize(
    ("distro", "version"),
    [("foxy", 5), ("humble", 5), ("iron", 8), ("jazzy", 9), ("kilted", 9), ("rolling", 9)],
)
def test_metadata_is_that_of_the_distribution(tmp_path, mission, info, made_up, distro, version):
    path, types = tmp_path / "bag", TypeStore(distro)
    record(path, mission, types, info, [made_up(1, [100] * 10)])
    metadata = YAML(typ="safe").load(path / "metadata.yaml")["rosbag2_bagfile_information"]
    assert (metadata["version"], metadata.get("ros_distro")) == (version, distro if version > 7 else None)
    topics = [item["topic_metadata"] for item in metadata["topics_with_message_count"]]
    assert topics
    store = get_typestore(Stores.ROS2_KILTED)
    for topic in topics:
        assert isinstance(topic["offered_qos_profiles"], list if version > 8 else str)
        assert ("type_description_hash" in topic) == (version > 6)
        if version > 6 and topic["type"] in store.fielddefs:
            assert topic["type_description_hash"] == store.hash_rihs01(topic["type"])
    with Reader(path) as reader:
        for connection in reader.connections:
            (offered,) = connection.ext.offered_qos_profiles
            assert (offered.reliability.name, offered.durability.name) == ("RELIABLE", "VOLATILE")
            assert (offered.history.name, offered.depth) == ("KEEP_LAST", 10)


def test_an_empty_bag(tmp_path, types, mission, info):
    record(tmp_path / "bag", mission, types, info, [])
    with Reader(tmp_path / "bag") as reader:
        assert reader.message_count == 0


def test_a_directory_that_holds_something_is_refused(tmp_path, types, mission, info):
    (tmp_path / "file").touch()
    with pytest.raises(CaptureError, match="is not empty"):
        Rosbag2Sink(tmp_path, mission, types, info)
    with pytest.raises(CaptureError, match="cannot be made a directory"):
        Rosbag2Sink(tmp_path / "file", mission, types, info)

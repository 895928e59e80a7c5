"""Recordings of other tools: written by rosbags and by mcap, read here."""

from __future__ import annotations

import sqlite3
from contextlib import suppress

import pytest
import zstandard
from hypothesis import given
from hypothesis import strategies as st
from mcap.writer import CompressionType, IndexType, Writer
from others import write_bag
from rosbags.rosbag2 import CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as BagWriter
from rosbags.typesys import Stores, get_typestore

from edoras_tools.errors import CaptureError
from edoras_tools.io.formats.rosbag2.reader import open_rosbag, readable

STORE = get_typestore(Stores.ROS2_HUMBLE)
TWIST, POSE = "geometry_msgs/msg/Twist", "geometry_msgs/msg/PoseStamped"
TOPICS = {"/cmd_vel": TWIST, "/pose": POSE}


def cdr(index):
    return bytes.fromhex("00010000") + index.to_bytes(4, "little") * 12


@pytest.fixture(params=[StoragePlugin.SQLITE3, StoragePlugin.MCAP], ids=["db3", "mcap"])
def bag(request, tmp_path):
    """A directory that rosbags wrote: two topics in turn, ten messages, 10 ms apart."""
    path = tmp_path / "bag"
    with BagWriter(path, version=9, storage_plugin=request.param) as writer:
        connections = [writer.add_connection(topic, name, typestore=STORE) for topic, name in TOPICS.items()]
        for index in range(10):
            writer.write(connections[index % 2], 1_000_000_000 + index * 10_000_000, cdr(index))
    return path


def write_mcap(path, encoding="cdr", **options):
    with path.open("wb") as file:
        writer = Writer(file, **options)
        writer.start("ros2", "some other tool")
        schema = writer.register_schema(TWIST, "ros2msg", b"Vector3 linear\n")
        channel = writer.register_channel("/cmd_vel", encoding, schema)
        for index in range(5):
            writer.add_message(channel, index * 1000, cdr(index), index * 1000)
        writer.finish()
    return path


def test_a_directory_gives_its_topics_and_messages_in_order(bag):
    opened = open_rosbag(bag)
    assert opened.topics() == TOPICS
    messages = list(opened.messages(TOPICS))
    assert [item.cdr for item in messages] == [cdr(index) for index in range(10)]
    assert [item.time_ns for item in messages] == [10**9 + index * 10**7 for index in range(10)]
    assert {(item.topic, item.type) for item in messages} == set(TOPICS.items())


def test_only_the_topics_asked_for(bag):
    messages = list(open_rosbag(bag).messages(["/pose"]))
    assert [item.cdr for item in messages] == [cdr(index) for index in range(1, 10, 2)]


def test_one_file_of_a_directory_does(bag):
    (file,) = [item for item in bag.iterdir() if item.suffix != ".yaml"]
    assert len(list(open_rosbag(file).messages(TOPICS))) == 10


def test_files_come_in_the_order_of_the_metadata(tmp_path):
    for name in ("b", "a"):
        write_mcap(tmp_path / f"{name}.mcap")
    (tmp_path / "metadata.yaml").write_text(
        "rosbag2_bagfile_information:\n  relative_file_paths: [b.mcap, a.mcap]\n"
    )
    assert [file.name for file in open_rosbag(tmp_path).files] == ["b.mcap", "a.mcap"]
    (tmp_path / "metadata.yaml").write_text("nothing: [\n")
    assert [file.name for file in open_rosbag(tmp_path).files] == ["a.mcap", "b.mcap"]


@pytest.mark.parametrize("compression", CompressionType)
def test_any_mcap_does(tmp_path, compression):
    opened = open_rosbag(write_mcap(tmp_path / "x.mcap", compression=compression))
    assert [item.cdr for item in opened.messages(["/cmd_vel"])] == [cdr(index) for index in range(5)]


def test_an_mcap_without_a_summary_does_too(tmp_path):
    bare = dict.fromkeys(
        ("repeat_channels", "repeat_schemas", "use_statistics", "use_summary_offsets"), False
    ) | {"index_types": IndexType.NONE}
    opened = open_rosbag(write_mcap(tmp_path / "x.mcap", **bare))
    assert opened.topics() == {"/cmd_vel": TWIST}
    assert len(list(opened.messages(["/cmd_vel"]))) == 5


@pytest.mark.parametrize("plugin", StoragePlugin)
def test_messages_that_rosbag2_compressed_one_by_one_are_unpacked(plugin, tmp_path):
    plain = open_rosbag(write_bag(tmp_path / "plain", plugin))
    packed = open_rosbag(write_bag(tmp_path / "packed", plugin, packed=CompressionMode.MESSAGE))
    assert packed.topics() == plain.topics()
    assert list(packed.messages(plain.topics())) == list(plain.messages(plain.topics()))


def test_what_is_no_cdr_is_left_out(tmp_path):
    opened = open_rosbag(write_mcap(tmp_path / "x.mcap", encoding="json"))
    assert opened.topics() == {}
    assert list(opened.messages(["/cmd_vel"])) == []


def test_what_is_no_recording_of_messages(tmp_path):
    cases = {
        "x.pcap": (b"\xd4\xc3\xb2\xa1" + bytes(20), "contains no ROS messages"),
        "x.mcap.zstd": (b"\x28\xb5\x2f\xfd", "unpack it first: zstd -d x.mcap.zstd"),
        "empty": (b"", "contains no ROS messages"),
        "bad.db3": (b"SQLite format 3\0" + bytes(100), "is not a readable rosbag2 database"),
    }
    for name, (content, words) in cases.items():
        (tmp_path / name).write_bytes(content)
        with pytest.raises(CaptureError, match=words):
            open_rosbag(tmp_path / name).topics()
    with pytest.raises(CaptureError, match="No such file"):
        open_rosbag(tmp_path / "missing")
    (tmp_path / "folder").mkdir()
    with pytest.raises(CaptureError, match="is not a rosbag2 directory"):
        open_rosbag(tmp_path / "folder")


def test_another_database_is_one_clear_line(tmp_path):
    path = tmp_path / "other.db3"
    with sqlite3.connect(path) as database:
        database.execute("CREATE TABLE songs (name TEXT)")
    database.close()
    with pytest.raises(CaptureError, match="is not a readable rosbag2 database: no such table"):
        open_rosbag(path).topics()


@given(st.data())
def test_a_damaged_file_gives_nothing_but_the_documented_error(tmp_path_factory, data):
    folder = tmp_path_factory.mktemp("damaged")
    content = bytearray(write_mcap(folder / "x.mcap").read_bytes())
    cut = data.draw(st.integers(8, len(content)))
    for _ in range(data.draw(st.integers(0, 4))):
        content[data.draw(st.integers(8, len(content) - 1))] = data.draw(st.integers(0, 255))
    (folder / "x.mcap").write_bytes(content[:cut])
    opened = open_rosbag(folder / "x.mcap")
    for read in (opened.topics, lambda: list(opened.messages(["/cmd_vel"]))):
        with suppress(CaptureError):
            read()


@pytest.mark.parametrize("failure", [MemoryError(), zstandard.ZstdError("no such frame"), KeyError("x")])
def test_whatever_the_reader_of_summaries_stumbles_over_the_file_is_read_without_one(
    tmp_path, monkeypatch, failure
):
    def stumble(*_arguments, **_options):
        raise failure

    monkeypatch.setattr("mcap.reader.SeekingReader.get_summary", stumble)
    path = write_mcap(tmp_path / "x.mcap")
    with pytest.raises(CaptureError, match="is damaged or cut off: "), readable(path) as reader:
        reader.get_summary()
    messages = list(open_rosbag(path).messages(["/cmd_vel"]))
    assert [item.cdr for item in messages] == [cdr(index) for index in range(5)]

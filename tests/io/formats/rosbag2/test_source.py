"""Recordings of other tools as rows of messages, beside what rosbags and mcap read."""

from __future__ import annotations

from contextlib import closing

import numpy as np
import pytest
from effort import examples
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import CompressionType, IndexType, Writer
from others import STORE, read_bag, studio_message, write_bag, write_studio
from rosbags.rosbag2 import CompressionMode, StoragePlugin

from edoras_tools.errors import CaptureError, NoDatagramsError
from edoras_tools.io.formats.open import open_file
from edoras_tools.io.formats.rosbag2.reader import MessageSource, NumberedTopics

BARE = dict.fromkeys(
    ("repeat_channels", "repeat_schemas", "use_statistics", "use_summary_offsets"), False
) | {"index_types": IndexType.NONE}


def opened(path):
    """Return a source of messages, and its topics."""
    with pytest.raises(NoDatagramsError) as found:
        open_file(path)
    table = NumberedTopics()
    return MessageSource(str(path), found.value.files, table), table.topics


def rows(path):
    """Return time, topic, type and bytes of each row, and why reading ended."""
    source, topics = opened(path)
    found, failure = [], None
    with closing(source):
        try:
            for batch in source.batches():
                for number in range(len(batch)):
                    item = batch[number]
                    topic = topics[item.topic]
                    found.append((item.time_ns, topic.topic, topic.type, item.payload))
        except CaptureError as error:
            failure = error
    return found, failure


def one_topic(path, times, **options):
    with path.open("wb") as file:
        writer = Writer(file, **options)
        writer.start("ros2", "some other tool")
        text = STORE.generate_msgdef("std_msgs/msg/Header")[0].encode()
        schema = writer.register_schema("std_msgs/msg/Header", "ros2msg", text)
        channels = [writer.register_channel(f"/{name}", "cdr", schema) for name in "ab"]
        for number, time_ns in enumerate(times):
            writer.add_message(channels[number % 2], time_ns, number.to_bytes(8, "big"), time_ns)
        writer.finish()
    return path


@pytest.mark.parametrize("plugin", StoragePlugin)
def test_rows_are_what_rosbags_reads(plugin, tmp_path):
    path = write_bag(tmp_path / "bag", plugin)
    found, failure = rows(path)
    assert (found, failure) == (read_bag(path), None)
    assert len(found) == 100 + 50 + 50 + 4 + 1


@pytest.mark.each(3)
@pytest.mark.parametrize("mode", [CompressionMode.FILE, CompressionMode.MESSAGE])
@pytest.mark.parametrize("plugin", StoragePlugin)
def test_what_rosbag2_compressed_is_unpacked(plugin, mode, tmp_path):
    path = write_bag(tmp_path / "bag", plugin, packed=mode)
    found, failure = rows(path)
    assert (found, failure) == (rows(write_bag(tmp_path / "plain", plugin))[0], None)
    assert len(found) == 205


@pytest.mark.parametrize("compression", CompressionType)
@pytest.mark.parametrize("index", [{}, BARE, {"use_chunking": False}, {"use_chunking": False, **BARE}])
def test_every_form_of_mcap(compression, index, tmp_path):
    path = write_studio(tmp_path / "x.mcap", compression=compression, chunk_size=500, **index)
    found, failure = rows(path)
    assert failure is None
    with path.open("rb") as file:
        expected = [
            (message.log_time, channel.topic, schema.name if schema else "", message.data)
            for schema, channel, message in make_reader(file).iter_messages()
        ]
    assert found == expected
    assert len(found) == 100


def test_what_the_recording_says_besides_is_kept(tmp_path):
    source, topics = opened(write_studio(tmp_path / "x.mcap"))
    with closing(source):
        (batch,) = source.batches()
    assert batch.recorded["sequence"].tolist() == [number for number in range(20) for _ in range(5)]
    assert (batch.time_ns - batch.recorded["publish_ns"] == 5).all()
    assert [(item.encoding, item.schema_encoding, item.metadata["about"]) for item in topics] == [
        ("json", "jsonschema", "/status"),
        ("protobuf", "protobuf", "/proto"),
        ("cdr", "ros2msg", "/cmd_vel"),
        ("cdr", "ros2idl", "/outer"),
        ("cdr", "", "/raw"),
    ]
    assert source.statistics.datagrams == 100
    assert source.statistics.position == source.statistics.total_bytes


@settings(max_examples=examples(60))
@given(
    st.lists(st.integers(1, 50), min_size=1, max_size=60),
    st.integers(40, 2000),
    st.sampled_from([{}, BARE, {"use_chunking": False}]),
)
def test_rows_are_in_order_of_time_in_whatever_order_they_were_written(
    tmp_path_factory, times, size, options
):
    path = one_topic(tmp_path_factory.mktemp("order") / "x.mcap", times, chunk_size=size, **options)
    found, failure = rows(path)
    assert failure is None
    said = sorted((time_ns, number.to_bytes(8, "big")) for number, time_ns in enumerate(times))
    assert sorted((time_ns, data) for time_ns, _, _, data in found) == said
    if not options:  # without an index, chunks come as they are
        assert [item[0] for item in found] == sorted(times)


def test_of_a_file_that_is_cut_off_all_before_is_read(tmp_path):
    whole = write_studio(tmp_path / "whole.mcap", chunk_size=500)
    data = whole.read_bytes()
    expected, _ = rows(whole)
    cut = tmp_path / "cut.mcap"
    for part in (0.3, 0.6):
        cut.write_bytes(data[: int(len(data) * part)])
        found, failure = rows(cut)
        assert "is cut off at byte" in str(failure)
        assert 0 < len(found) < len(expected)
        assert found == expected[: len(found)]


def test_a_damaged_chunk_is_told_after_all_others(tmp_path):
    path = write_studio(tmp_path / "x.mcap", chunk_size=500, compression=CompressionType.NONE)
    data = bytearray(path.read_bytes())
    data[data.index(studio_message("/cmd_vel", 9))] ^= 0xFF
    path.write_bytes(data)
    found, failure = rows(path)
    assert "is damaged" in str(failure)
    assert 80 < len(found) < 100


@settings(max_examples=examples(60))
@given(st.data())
def test_bytes_that_were_changed_raise_nothing_else(tmp_path_factory, data):
    folder = tmp_path_factory.mktemp("bytes")
    content = bytearray(write_studio(folder / "x.mcap", count=3).read_bytes())
    for _ in range(data.draw(st.integers(1, 4))):
        content[data.draw(st.integers(8, len(content) - 1))] = data.draw(st.integers(0, 255))
    (folder / "x.mcap").write_bytes(content)
    try:
        rows(folder / "x.mcap")
    except CaptureError:
        pass
    except pytest.fail.Exception:  # it opened: damage made it look like a file that is cut off
        pass


def test_files_of_a_directory_follow_each_other_in_time(tmp_path):
    bag = tmp_path / "bag"
    bag.mkdir()
    late = write_studio(bag / "a.mcap", begin=2_000_000_000_000_000_000)
    early = write_studio(bag / "b.mcap")
    (bag / "metadata.yaml").write_text("rosbag2_bagfile_information: {relative_file_paths: [a.mcap, b.mcap]}")
    found, _ = rows(bag)
    assert found == rows(early)[0] + rows(late)[0]


def test_topics_that_are_alike_have_one_number(tmp_path):
    table = NumberedTopics()
    for name in ("a", "b"):
        with pytest.raises(NoDatagramsError) as found:
            open_file(write_bag(tmp_path / name))
        with closing(MessageSource(name, found.value.files, table)) as source:
            numbers = np.unique(np.concatenate([batch.recorded["topic"] for batch in source.batches()]))
        assert numbers.tolist() == [0, 1, 2, 3, 4]
    assert len(table.topics) == 5

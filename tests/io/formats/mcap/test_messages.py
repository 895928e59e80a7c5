"""Messages by columns are those that the mcap library reads one by one."""

from contextlib import closing

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.records import Channel, Header, Message
from mcap.writer import CompressionType, IndexType, Writer

from edoras_tools.errors import CaptureError, NoDatagramsError
from edoras_tools.io.formats.mcap.file import MOST_IDLE, record_bytes
from edoras_tools.io.formats.mcap.messages import SelectedMessages, chunk_content, is_indexed, scanned
from edoras_tools.io.formats.mcap.reader import McapSource
from edoras_tools.io.formats.rosbag2.reader import open_rosbag
from edoras_tools.io.topics.messages import DATAGRAMS_TOPIC, MAGIC


def write(path, *, count=1000, **options):
    """Write a file of two topics, its times not in order, some messages empty."""
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=4096, **options)
        writer.start()
        schema = writer.register_schema("x/msg/X", "ros2msg", b"uint8[] x")
        channels = [writer.register_channel(topic, "cdr", schema) for topic in ("/a", "/b")]
        for row in range(count):
            time_ns = 10**18 + row // 5 * 5 + 4 - row % 5
            writer.add_message(channels[row % 3 == 0], time_ns, bytes([row % 256]) * (row % 7), time_ns)
        writer.finish()
    return path


def by_column(path, topics):
    return [
        (topic, int(time_ns), block.data[start : start + length].tobytes())
        for block in open_rosbag(path).blocks(topics)
        for topic, time_ns, start, length in zip(
            [block.topic] * len(block.time_ns), block.time_ns, block.offset, block.length, strict=True
        )
    ]


def one_by_one(path, topics):
    with path.open("rb") as file:
        return [
            (channel.topic, message.log_time, message.data)
            for _, channel, message in make_reader(file).iter_messages(topics, log_time_order=False)
        ]


@pytest.mark.parametrize("compression", list(CompressionType))
@pytest.mark.parametrize("topics", [["/a"], ["/b"], ["/a", "/b"], ["/c"]])
def test_the_same_messages(tmp_path, compression, topics):
    path = write(tmp_path / "a.mcap", compression=compression)
    assert sorted(by_column(path, topics)) == sorted(one_by_one(path, topics))
    for topic in topics:
        alone = [item for item in by_column(path, topics) if item[0] == topic]
        in_file = [item for item in one_by_one(path, topics) if item[0] == topic]
        assert alone == sorted(in_file, key=lambda item: item[1])


@pytest.mark.parametrize("options", [{"index_types": IndexType.NONE}, {"use_chunking": False}])
def test_what_no_index_leads_to_is_read_one_by_one(tmp_path, options):
    path = write(tmp_path / "a.mcap", **options)
    with path.open("rb") as file:
        assert not is_indexed(make_reader(file).get_summary())
    assert sorted(by_column(path, ["/a", "/b"])) == sorted(one_by_one(path, ["/a", "/b"]))


def test_a_damaged_chunk_is_one_line_after_all_before_it(tmp_path):
    path = write(tmp_path / "a.mcap", compression=CompressionType.ZSTD)
    whole = by_column(path, ["/a"])
    with path.open("rb") as file:
        third = sorted(item.chunk_start_offset for item in make_reader(file).get_summary().chunk_indexes)[2]
    data = bytearray(path.read_bytes())
    data[third + 100] ^= 0xFF
    path.write_bytes(data)
    found = []
    with pytest.raises(CaptureError, match=rf"the chunk at byte {third} is damaged; all before was read"):
        found.extend(len(block.time_ns) for block in open_rosbag(path).blocks(["/a"]))
    assert 0 < sum(found) < len(whole)


@pytest.mark.each(5)
@pytest.mark.parametrize("seed", range(60))
def test_any_damage_is_a_capture_error(tmp_path, seed):
    path = write(tmp_path / "a.mcap", compression=CompressionType.NONE, count=200)
    random = np.random.default_rng(seed)
    data = np.frombuffer(path.read_bytes(), np.uint8).copy()
    places = random.integers(0, len(data), 20)
    if seed % 2:  # the summary, where indices are
        places = len(data) - 1 - random.integers(0, 600, 5)
    data[places] = random.integers(0, 256, len(places))
    path.write_bytes(data.tobytes())
    try:
        by_column(path, ["/a", "/b"])
    except CaptureError as error:
        assert "\n" not in str(error)  # noqa: PT017  whole files are as good


def test_nothing_is_read_of_topics_that_are_not_wanted(tmp_path):
    path = write(tmp_path / "a.mcap")
    with path.open("rb") as file:
        index = make_reader(file).get_summary().chunk_indexes[0]
        assert len(chunk_content(file, "a", index, {99}).log_time) == 0


@pytest.mark.parametrize(("junk", "records"), [(bytes(9), 0), (b"\x80" + bytes(8), MOST_IDLE)])
def test_what_is_no_record_for_long_ends_a_file(tmp_path, junk, records):
    good = MAGIC + record_bytes(Header("", ""), Channel(1, "/a", "cdr", {}, 0), Message(1, 7, b"abc", 7, 0))
    (path := tmp_path / "bomb.mcap").write_bytes(good + junk * (MOST_IDLE + 9))
    found = []
    with pytest.raises(CaptureError, match=f"is cut off at byte {len(good) + 9 * records} of"):
        found.extend(scanned(path, "bomb.mcap"))
    assert [item.channel_id.tolist() for item in found if isinstance(item, SelectedMessages)] == [[1]]
    with pytest.raises(NoDatagramsError, match="its topics are /a"):
        McapSource(path)


def test_damaged_records_are_told_once(tmp_path):
    topic = record_bytes(Header("", ""), Channel(1, DATAGRAMS_TOPIC, "cdr", {}, 0))
    (path := tmp_path / "bomb.mcap").write_bytes(MAGIC + topic + (b"\x0c" + bytes(8)) * 1000)
    with closing(McapSource(path)) as source:
        with pytest.raises(CaptureError, match="is cut off at byte"):
            list(source.batches())
        assert source.statistics.warnings == [f"{path}: a METADATA record is damaged"]

from __future__ import annotations

import struct

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType, Writer

from edoras_tools.errors import CaptureError
from edoras_tools.model import SourceStatistics
from edoras_tools.sinks.mcap import McapSink
from edoras_tools.sinks.recover import recover


def everything(path):
    """All messages of a whole file, read by the mcap library with every CRC checked; then its summary."""
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        summary = reader.get_summary()
        found = [
            (channel.topic, message.log_time, message.data)
            for _, channel, message in reader.iter_messages(log_time_order=False)
        ]
    assert summary.statistics.message_count == len(found)
    assert sum(summary.statistics.channel_message_counts.values()) == len(found)
    with path.open("rb") as file:
        streamed = [
            item
            for item in StreamReader(file, validate_crcs=True).records
            if type(item).__name__ == "Message"
        ]
    assert len(streamed) == len(found)
    return found, summary


@pytest.fixture(scope="module")
def recording(tmp_path_factory, types, mission, info, made_up):
    path = tmp_path_factory.mktemp("recover") / "whole.mcap"
    sink = McapSink(path, mission, types, info)
    for seed in range(4):
        sink.write(*made_up(seed, [60, 250, 900] * 15))
        sink.flush()
    sink.close(SourceStatistics())
    return path


@pytest.fixture(scope="module")
def foreign(tmp_path_factory):
    """A function: what the mcap library's own writer makes, which puts schemas and channels into chunks."""

    def make(compression=CompressionType.ZSTD, *, chunked=True):
        path = tmp_path_factory.mktemp("foreign") / "foreign.mcap"
        with path.open("wb") as file:
            writer = Writer(file, chunk_size=2000, compression=compression, use_chunking=chunked)
            writer.start("ros2", "another")
            schema = writer.register_schema("std_msgs/msg/String", "ros2msg", b"string data")
            channels = [writer.register_channel(f"/chatter_{index}", "cdr", schema) for index in range(2)]
            for index in range(200):
                writer.add_message(
                    channels[index % 2], index * 1000, struct.pack("<I60s", index, b"x"), index * 1000
                )
            writer.add_attachment(0, 0, "a.txt", "text/plain", b"attached")
            writer.finish()
        return path

    return make


@settings(max_examples=80, deadline=None)
@given(st.floats(0, 1))
def test_whatever_byte_it_was_cut_at(tmp_path_factory, recording, share):
    raw = recording.read_bytes()
    whole, _ = everything(recording)
    folder = tmp_path_factory.mktemp("cut")
    cut = folder / "cut.mcap"
    cut.write_bytes(raw[: int(share * (len(raw) - 1))])
    try:
        report = recover(cut, folder / "made.mcap")
    except CaptureError as error:
        assert share < 0.01
        assert "nothing to recover" in str(error) or "no MCAP" in str(error)  # noqa: PT017  either will do
        return
    found, summary = everything(folder / "made.mcap")
    assert found == whole[: len(found)]
    assert len(found) / len(whole) >= share - 0.35
    topics = {}
    for topic, _, _ in found:
        topics[topic] = topics.get(topic, 0) + 1
    assert report.messages == topics
    assert report.chunks == len(summary.chunk_indexes)
    assert not report.whole
    assert recover(folder / "made.mcap", folder / "again.mcap").whole


def test_everything_but_the_last_chunk_is_kept_byte_for_byte(tmp_path, recording):
    raw = recording.read_bytes()
    cut, made = tmp_path / "cut.mcap", tmp_path / "made.mcap"
    with recording.open("rb") as file:
        chunk = make_reader(file).get_summary().chunk_indexes[2]
    cut.write_bytes(raw[: chunk.chunk_start_offset + 60])
    report = recover(cut, made)
    assert made.read_bytes()[: chunk.chunk_start_offset] == raw[: chunk.chunk_start_offset]
    assert (report.salvaged, report.lost_bytes, report.chunks) == (0, 60, 2)


def test_messages_are_taken_out_of_a_cut_chunk(tmp_path, types, capture):
    whole, cut, made = (tmp_path / f"{name}.mcap" for name in ("whole", "cut", "made"))
    rover = capture("a_rover", "rover_ground")
    sink = McapSink(whole, rover.mission, types, rover.info)
    for pair in rover.pairs:
        sink.write(*pair)
    sink.close(SourceStatistics())
    with whole.open("rb") as file:
        chunk = make_reader(file).get_summary().chunk_indexes[0]
    cut.write_bytes(whole.read_bytes()[: chunk.chunk_start_offset + chunk.chunk_length * 3 // 4])
    report = recover(cut, made)
    assert report.salvaged == sum(report.messages.values()) > 1000
    assert everything(made)[0] == everything(whole)[0][: report.salvaged]


def test_the_metadata_of_a_recording_is_made_whole(tmp_path, recording):
    cut, made = tmp_path / "cut.mcap", tmp_path / "made.mcap"
    cut.write_bytes(recording.read_bytes()[:-2000])
    recover(cut, made)
    with made.open("rb") as file:
        reader = make_reader(file)
        metadata = {item.name: item.metadata for item in reader.iter_metadata()}
        assert [item.name for item in reader.iter_attachments()] == ["rover.yaml"]
    assert metadata["edoras"].items() >= metadata["edoras_opening"].items()


@pytest.mark.parametrize("chunked", [True, False])
@pytest.mark.parametrize("compression", [CompressionType.ZSTD, CompressionType.LZ4, CompressionType.NONE])
@pytest.mark.parametrize("share", [0.3, 0.6, 0.9, 0.999])
def test_any_mcap(tmp_path, foreign, compression, chunked, share):
    path = foreign(compression, chunked=chunked)
    raw, (whole, _) = path.read_bytes(), everything(path)
    cut, made = tmp_path / "cut.mcap", tmp_path / "made.mcap"
    cut.write_bytes(raw[: int(len(raw) * share)])
    report = recover(cut, made)
    found, _ = everything(made)
    assert found == whole[: len(found)]
    assert sum(report.messages.values()) == len(found) > 0


def test_a_damaged_chunk_costs_only_itself(tmp_path, recording):
    whole, summary = everything(recording)
    raw = bytearray(recording.read_bytes())
    chunk = summary.chunk_indexes[1]
    middle = chunk.chunk_start_offset + chunk.chunk_length // 2
    raw[middle : middle + 50] = bytes(50)
    cut, made = tmp_path / "cut.mcap", tmp_path / "made.mcap"
    cut.write_bytes(raw[:-100])
    report = recover(cut, made)
    found, _ = everything(made)
    assert report.lost_bytes == chunk.chunk_length + chunk.message_index_length
    assert len(found) == len(whole) - len(set(whole) - set(found)) < len(whole)
    assert found[-50:] == whole[-50:]


def test_a_whole_file_is_left_alone(tmp_path, recording):
    report = recover(recording, tmp_path / "made.mcap")
    assert report.whole
    assert str(report).startswith("whole already")
    assert not (tmp_path / "made.mcap").exists()
    assert sum(report.messages.values()) == len(everything(recording)[0])


def test_what_cannot_be_recovered(tmp_path, recording):
    for name, content, message in (
        ("empty", b"", "no MCAP file"),
        ("text", b"hello, I am a text file", "no MCAP file"),
        ("magic", recording.read_bytes()[:8], "nothing to recover"),
        ("header", recording.read_bytes()[:20], "nothing to recover"),
    ):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(CaptureError, match=message):
            recover(tmp_path / name, tmp_path / "made.mcap")
        assert not (tmp_path / "made.mcap").exists()
    with pytest.raises(CaptureError, match="cannot be read: No such file"):
        recover(tmp_path / "missing", tmp_path / "made.mcap")
    with pytest.raises(CaptureError, match="cannot be read: Is a directory"):
        recover(tmp_path, tmp_path / "made.mcap")
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(recording.read_bytes()[:-1000])
    with pytest.raises(CaptureError, match="name another file"):
        recover(cut, cut)
    with pytest.raises(CaptureError, match="cannot be created"):
        recover(cut, tmp_path / "no" / "made.mcap")


@settings(max_examples=100, deadline=None)
@given(st.lists(st.tuples(st.floats(0, 0.999), st.binary(min_size=1, max_size=12)), min_size=1, max_size=4))
def test_damage_anywhere_raises_nothing_else(tmp_path_factory, recording, damages):
    raw = bytearray(recording.read_bytes())
    for share, junk in damages:
        place = int(share * len(raw))
        raw[place : place + len(junk)] = junk
    folder = tmp_path_factory.mktemp("damaged")
    (folder / "bad.mcap").write_bytes(raw[: len(raw) - 10])
    try:
        recover(folder / "bad.mcap", folder / "made.mcap")
    except CaptureError as error:
        assert "\n" not in str(error)  # noqa: PT017  it may also succeed

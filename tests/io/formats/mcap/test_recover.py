from __future__ import annotations

import re
import struct
import time
from pathlib import Path
from zlib import crc32

import damage
import pytest
from damage import damaged, messages
from effort import LONG, examples
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import NonSeekingReader, make_reader
from mcap.records import Channel, Chunk, Header, Message, Schema
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType, Writer

from edoras_tools.errors import CaptureError, ConfigError
from edoras_tools.io.formats.mcap import chunks as mcap_chunks
from edoras_tools.io.formats.mcap.file import record_bytes
from edoras_tools.io.formats.mcap.recovery.records import KnownTopics
from edoras_tools.io.formats.mcap.writer import McapSink
from edoras_tools.io.formats.recover import repair
from edoras_tools.io.topics.messages import MAGIC
from edoras_tools.io.topics.streams import OWN_TOPICS
from edoras_tools.model import SourceStatistics


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
    for seed in range(20):
        sink.write(*made_up(seed, [60, 250, 900] * 3))
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


@settings(max_examples=examples(80), deadline=None)
@given(st.floats(0, 1))
def test_whatever_byte_it_was_cut_at(tmp_path_factory, recording, share):
    raw = recording.read_bytes()
    whole, _ = everything(recording)
    folder = tmp_path_factory.mktemp("cut")
    cut = folder / "cut.mcap"
    cut.write_bytes(raw[: int(share * (len(raw) - 1))])
    try:
        report = repair(cut, folder / "made.mcap")
    except CaptureError as error:
        assert share < 0.2
        assert "nothing to recover" in str(error) or "not an MCAP" in str(error)  # noqa: PT017  either will do
        return
    found, summary = everything(folder / "made.mcap")
    assert found == whole[: len(found)]
    assert len(found) / len(whole) >= share - 0.25
    topics = {}
    for topic, _, _ in found:
        topics[topic] = topics.get(topic, 0) + 1
    assert report.messages == topics
    assert report.chunks == len(summary.chunk_indexes)
    assert not report.whole
    assert report.proved == len(found)
    assert report.lost or len(found) == len(whole)
    assert repair(folder / "made.mcap", folder / "again.mcap").whole


def test_everything_but_the_last_chunk_is_kept_byte_for_byte(tmp_path, recording):
    raw = recording.read_bytes()
    cut, made = tmp_path / "cut.mcap", tmp_path / "made.mcap"
    with recording.open("rb") as file:
        chunk = make_reader(file).get_summary().chunk_indexes[2]
    cut.write_bytes(raw[: chunk.chunk_start_offset + 60])
    report = repair(cut, made)
    assert made.read_bytes()[: chunk.chunk_start_offset] == raw[: chunk.chunk_start_offset]
    assert (report.salvaged, report.lost_bytes, report.chunks, report.lost) == (0, 60, 2, True)
    assert report.lost_messages is None
    (loss,) = report.losses
    assert (loss.start_ns, loss.end_ns) == (chunk.message_start_time, chunk.message_end_time)


def test_of_a_cut_chunk_is_kept_what_is_asked_for(tmp_path, types, capture, monkeypatch):
    monkeypatch.setattr(mcap_chunks, "CHUNK_BYTES", 512 << 10)  # several blocks of zstd
    whole, cut, made = (tmp_path / f"{name}.mcap" for name in ("whole", "cut", "made"))
    rover = capture("a_rover", "rover_ground")
    sink = McapSink(whole, rover.mission, types, rover.info)
    for pair in rover.pairs:
        sink.write(*pair)
    sink.close(SourceStatistics())
    with whole.open("rb") as file:
        _, second = make_reader(file).get_summary().chunk_indexes[:2]
    cut.write_bytes(whole.read_bytes()[: second.chunk_start_offset + second.chunk_length * 3 // 4])
    report = repair(cut, made)
    assert report.salvaged == 0
    assert report.left_out > 200
    kept = everything(made)[0]
    assert everything(whole)[0][: len(kept)] == kept
    asked = repair(cut, made, unproved=True)
    assert (asked.salvaged, asked.unproved, asked.left_out) == (report.left_out, report.left_out, 0)
    assert everything(made)[0] == everything(whole)[0][: len(kept) + report.left_out]
    assert report.lost
    assert asked.lost


def test_the_metadata_of_a_recording_is_made_whole(tmp_path, recording):
    cut, made = tmp_path / "cut.mcap", tmp_path / "made.mcap"
    cut.write_bytes(recording.read_bytes()[:-2000])
    repair(cut, made)
    with made.open("rb") as file:
        reader = make_reader(file)
        metadata = {item.name: item.metadata for item in reader.iter_metadata()}
        assert [item.name for item in reader.iter_attachments()] == ["rover.yaml"]
    assert metadata["edoras"].items() >= metadata["edoras_opening"].items()


@pytest.mark.each(5)
@pytest.mark.parametrize("chunked", [True, False])
@pytest.mark.parametrize("compression", [CompressionType.ZSTD, CompressionType.LZ4, CompressionType.NONE])
@pytest.mark.parametrize("share", [0.3, 0.6, 0.9, 0.999])
def test_any_mcap(tmp_path, foreign, compression, chunked, share):
    path = foreign(compression, chunked=chunked)
    raw, (whole, _) = path.read_bytes(), everything(path)
    cut, made = tmp_path / "cut.mcap", tmp_path / "made.mcap"
    cut.write_bytes(raw[: int(len(raw) * share)])
    report = repair(cut, made)
    found, _ = everything(made)
    assert found == whole[: len(found)]
    assert sum(report.messages.values()) == len(found) > 0
    assert (report.proved, report.unproved) == ((len(found), 0) if chunked else (0, len(found)))


def test_a_damaged_chunk_costs_only_itself(tmp_path, recording):
    whole, summary = everything(recording)
    raw = bytearray(recording.read_bytes())
    chunk = summary.chunk_indexes[1]
    middle = chunk.chunk_start_offset + chunk.chunk_length // 2
    raw[middle : middle + 50] = bytes(50)
    cut, made = tmp_path / "cut.mcap", tmp_path / "made.mcap"
    cut.write_bytes(raw[:-100])
    report = repair(cut, made)
    found, _ = everything(made)
    assert report.lost_bytes == chunk.chunk_length + chunk.message_index_length
    assert report.lost_messages is None
    assert [loss.messages for loss in report.losses] == [len(whole) - len(found)]
    assert len(found) == len(whole) - len(set(whole) - set(found)) < len(whole)
    assert found[-50:] == whole[-50:]


def test_a_whole_file_is_left_alone(tmp_path, recording):
    report = repair(recording, tmp_path / "made.mcap")
    assert report.whole
    assert report.text(written=True).startswith("intact: ")
    assert (report.unproved, report.lost) == (0, False)
    assert not (tmp_path / "made.mcap").exists()
    assert sum(report.messages.values()) == len(everything(recording)[0])


def test_what_cannot_be_recovered(tmp_path, recording):
    for name, content, message in (
        ("empty", b"", "not an MCAP file"),
        ("text", b"hello, I am a text file", "not an MCAP file"),
        ("magic", recording.read_bytes()[:8], "nothing to recover"),
        ("header", recording.read_bytes()[:20], "nothing to recover"),
    ):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(CaptureError, match=message):
            repair(tmp_path / name, tmp_path / "made.mcap")
        assert not (tmp_path / "made.mcap").exists()
    with pytest.raises(CaptureError, match="there is no such file; check the name"):
        repair(tmp_path / "missing", tmp_path / "made.mcap")
    with pytest.raises(CaptureError, match="cannot be opened: Is a directory"):
        repair(tmp_path, tmp_path / "made.mcap")
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(recording.read_bytes()[:-1000])
    with pytest.raises(ConfigError, match="name another file"):
        repair(cut, cut)
    with pytest.raises(CaptureError, match=r"no/made\.mcap: cannot be written"):
        repair(cut, tmp_path / "no" / "made.mcap")
    for full in (Path("/dev/full"), tmp_path / "full"):
        before = (tmp_path / "full").symlink_to("/dev/full") if full != Path("/dev/full") else None
        assert before is None
        with pytest.raises(CaptureError, match=f"^{full}: cannot be written: No space left on device; name "):
            repair(cut, full)
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(
        ["cut.mcap", "empty", "full", "header", "magic", "text"]
    )


@settings(max_examples=examples(100), deadline=None)
@given(st.lists(st.tuples(st.floats(0, 0.999), st.binary(min_size=1, max_size=12)), min_size=1, max_size=4))
def test_damage_anywhere_raises_nothing_else(tmp_path_factory, recording, damages):
    raw = bytearray(recording.read_bytes())
    for share, junk in damages:
        place = int(share * len(raw))
        raw[place : place + len(junk)] = junk
    folder = tmp_path_factory.mktemp("damaged")
    (folder / "bad.mcap").write_bytes(raw[: len(raw) - 10])
    try:
        repair(folder / "bad.mcap", folder / "made.mcap")
    except CaptureError as error:
        assert "\n" not in str(error)  # noqa: PT017  it may also succeed


@pytest.fixture(scope="module")
def wholes(tmp_path_factory, types, capture):
    """Recordings to damage: one with a chunk every second, two with chunks of full size."""
    made = []
    for name, mission, step in (
        ("a_rover", "rover_ground", 120),
        ("f_sbn_disconnect", "two_rovers_ground", 90),
        ("a_rover", "rover_ground", 1 << 20),
    ):
        path, read = tmp_path_factory.mktemp("wholes") / "whole.mcap", capture(name, mission)
        sink = McapSink(path, read.mission, types, read.info)
        for batch, columns in read.pairs:
            for first in range(0, len(batch), step):
                rows = slice(first, first + step)
                sink.write(batch.take(rows), columns.take(rows))
                sink.flush()
        sink.close(SourceStatistics())
        made.append(path.read_bytes())
    return made


@pytest.mark.long
@pytest.mark.parametrize("part", range(8))
def test_damaged_in_eight_ways(tmp_path, wholes, part):
    """Nothing is altered, exit codes are right, what is in chunks whose CRC is right is kept and indexed."""
    rows = damage.tried(damage.by_library, wholes, 80, tmp_path, f"{damage.SEED} {part}")
    for way, row in rows.items():
        print(f"{way:15} {dict(row)}")
        assert row["kept"] >= row["in sound chunks"] > 0
        assert (row["less than a scan"], row["altered"], row["exit code"]) == (0, 0, 0), way
        assert row["written"] > row["unlike its index"] == 0, way


@pytest.mark.quick("removed bytes")
@pytest.mark.parametrize("way", [way for way in damage.WAYS if way != "two joined"])
def test_damage_inside_is_never_called_whole(tmp_path, recording, way):
    """Of a file of ours each byte is covered by a checksum."""
    source, raw = tmp_path / "damaged.mcap", recording.read_bytes()
    for seed in range(40 if LONG else 8):
        for found, data, _ in damaged([raw], 8, f"inside {seed}"):
            source.write_bytes(data)
            if found == way and data != raw:
                try:
                    assert not repair(source, None).whole
                except CaptureError as error:
                    assert "nothing to recover" in str(error) or "not an MCAP" in str(error)  # noqa: PT017


@pytest.mark.parametrize("missing", [3, 8, 16, 32])
def test_a_message_index_that_lost_bytes_hides_no_chunk(tmp_path, recording, missing):
    """The length in its head then reaches into the chunk that follows."""
    source, made, raw = tmp_path / "cut.mcap", tmp_path / "made.mcap", recording.read_bytes()
    chunk = everything(recording)[1].chunk_indexes[2]
    end = chunk.chunk_start_offset + chunk.chunk_length + chunk.message_index_length
    source.write_bytes(raw[: end - missing] + raw[end:])
    report = repair(source, made)
    assert (report.whole, report.lost_messages) == (False, 0)
    assert messages(made.read_bytes()) == messages(raw)


@pytest.mark.long
def test_files_one_after_the_other(tmp_path, wholes, foreign):
    """Channels with the same number and another topic keep their topics."""
    source, made = tmp_path / "joined.mcap", tmp_path / "made.mcap"
    files = [wholes[0], foreign().read_bytes(), wholes[1]]
    source.write_bytes(b"".join(files))
    report = repair(source, made)
    assert (report.whole, report.lost, report.lost_messages, report.lost_bytes) == (False, False, 0, 0)
    expected = sum((messages(data) for data in files), start=messages(files[0]) - messages(files[0]))
    assert messages(made.read_bytes()) == expected
    assert len(everything(made)[0]) == expected.total()


@pytest.mark.parametrize("ended", [True, False])
def test_a_file_that_was_truncated_while_it_was_written(tmp_path, recording, ended):
    """Its start is a hole; with a summary the channels are known, without one those of our recorder."""
    whole, summary = everything(recording)
    chunk = summary.chunk_indexes[3]
    raw = bytearray(recording.read_bytes())
    raw[: chunk.chunk_start_offset + 20] = bytes(chunk.chunk_start_offset + 20)
    source, made = tmp_path / "hole.mcap", tmp_path / "made.mcap"
    source.write_bytes(raw if ended else raw[:-3000])
    report = repair(source, made)
    found, _ = everything(made)
    assert "zeros" in str(report.losses[0])
    # The chunk's own head is gone, but not its frame, which proves itself.
    assert report.chunks == len(summary.chunk_indexes) - 3
    if ended:
        assert found == whole[-len(found) :]
        assert report.lost_messages == len(whole) - len(found)
        return
    assert report.lost
    plain = [(topic, *rest) for topic, *rest in found if not topic.startswith("/unknown/")]
    assert {topic for topic, *_ in plain} == {"/edoras/datagrams", "/edoras/link_statistics"}
    assert [item[1:] for item in found] == [item[1:] for item in whole[-len(found) :]]
    assert "the description of 3 channels is lost: /unknown/N has their messages" in report.reasons


@pytest.mark.each(3)
@pytest.mark.parametrize("size", [512, 4096, 65_536])
@pytest.mark.parametrize("ended", [True, False])
def test_a_beginning_of_zeros_costs_what_was_in_it(tmp_path, wholes, size, ended):
    """Every chunk whose checksum is right is kept, with its topics if the second chunk is."""
    raw = wholes[0]
    before = messages(raw)
    data = bytes(size) + raw[size : len(raw) if ended else len(raw) * 9 // 10]
    source, made = tmp_path / "bad.mcap", tmp_path / "made.mcap"
    source.write_bytes(data)
    report = repair(source, made)
    kept = messages(made.read_bytes())
    assert damage.without_topics(kept) == damage.plain_scan(data)
    assert ended or report.lost
    unknown = {item for item in kept if item[0].startswith("/unknown/")}
    assert {*kept} - unknown <= {*before}
    assert not unknown or size == 65_536


def test_what_describes_a_recording_of_ours_can_be_given(tmp_path, wholes, types, capture):
    """Without any description: the datagrams are known by heart, the mission's topics with it."""
    raw, before = wholes[2], messages(wholes[2])
    at = [match.start() for match in re.finditer(rb"\x06.{7}\0.{28}\x04\0\0\0zstd", raw, re.DOTALL)]
    source, made = tmp_path / "bad.mcap", tmp_path / "made.mcap"
    source.write_bytes(bytes(at[2]) + raw[at[2] : at[4]])
    report = repair(source, made)
    assert {topic for topic in report.messages if not topic.startswith("/unknown/")} == {
        topic.name for topic in OWN_TOPICS
    } & {*report.messages}
    assert "/edoras/datagrams" in report.messages
    known = repair(
        source, tmp_path / "known.mcap", topics=KnownTopics(capture("a_rover", "rover_ground").mission, types)
    )
    kept = messages((tmp_path / "known.mcap").read_bytes())
    assert damage.without_topics(kept) == damage.plain_scan(source.read_bytes())
    assert {"/cmd_vel", "/telemetry_pose"} <= {*known.messages}
    assert {item for item in kept if not item[0].startswith("/unknown/")} <= {*before}


def test_one_wrong_bit_in_the_first_chunk_costs_names_only(tmp_path, foreign):
    """Another tool's first chunk has all schemas and channels; unproved they can be had."""
    raw = bytearray(foreign().read_bytes())
    raw = raw[: len(raw) * 9 // 10]
    raw[raw.index(b"\x28\xb5\x2f\xfd") + 60] ^= 4
    source, made = tmp_path / "bad.mcap", tmp_path / "made.mcap"
    source.write_bytes(raw)
    report = repair(source, made)
    kept = messages(made.read_bytes())
    assert damage.without_topics(kept) == damage.plain_scan(raw) != {}
    assert {*report.messages} == {"/unknown/1", "/unknown/2"}
    assert report.lost
    source.write_bytes(foreign(CompressionType.NONE).read_bytes()[:-3000].replace(b"\0\0\0x", b"\0\0\0y", 1))
    assert {*repair(source, made, unproved=True).messages} == {"/chatter_0", "/chatter_1"}


@pytest.mark.parametrize("opcodes", [b"\x05", b"\x06", b"\x0f", bytes(range(3, 16)) + b"\x80", b"\x80"])
def test_a_flood_of_empty_records_is_one_place(tmp_path, foreign, opcodes):
    """None but private ones can be empty; neither costs a search, or a line, each."""
    raw = foreign(chunked=False).read_bytes()
    at = [match.start() for match in re.finditer(rb"(?s)\x05\x56\0{7}", raw)][100]
    flood = b"".join(bytes([opcode]) + bytes(8) for opcode in opcodes) * (60_000 // len(opcodes))
    source, made = tmp_path / "bad.mcap", tmp_path / "made.mcap"
    source.write_bytes(raw[:at] + flood + raw[at:])
    began = time.process_time()
    report = repair(source, made)
    assert time.process_time() - began < 2
    assert sum(report.messages.values()) == len(everything(made)[0]) == 200
    assert (len(report.losses), report.lost_bytes) == ((0, 0) if opcodes == b"\x80" else (1, len(flood)))


@pytest.mark.parametrize("bit", [8, 11, 12, 13])
def test_a_length_that_covers_other_messages_is_refused(tmp_path, foreign, bit):
    """Without chunks nothing has a checksum: one wrong length must cost one message."""
    raw = bytearray(foreign(chunked=False).read_bytes())
    at = [match.start() for match in re.finditer(rb"(?s)\x05\x56\0{7}", raw)]
    raw[at[20] + 1 + bit // 8] ^= 1 << bit % 8
    source, made = tmp_path / "bad.mcap", tmp_path / "made.mcap"
    source.write_bytes(raw)
    report = repair(source, made)
    assert (sum(report.messages.values()), report.lost_messages, report.lost_bytes) == (199, 1, 95)
    assert len(everything(made)[0]) == 199


def test_a_wrong_checksum_in_the_head_of_a_sound_chunk_is_not_kept(tmp_path, recording):
    """Its frame proves itself; a reader that checks the head's CRC would refuse the result."""
    raw, summary = bytearray(recording.read_bytes()), everything(recording)[1]
    raw[summary.chunk_indexes[1].chunk_start_offset + 9 + 24] ^= 4
    source, made = tmp_path / "bad.mcap", tmp_path / "made.mcap"
    source.write_bytes(raw)
    report = repair(source, made)
    assert repair(source, None) == report
    assert (report.lost, "the head of a chunk is damaged" in report.reasons) == (False, True)
    assert everything(made)[0] == everything(recording)[0]


def test_messages_beside_chunks_are_put_into_one(tmp_path, foreign):
    """An indexed reader does not see them, so a file with both is not intact."""
    raw, loose = foreign().read_bytes(), foreign(chunked=False).read_bytes()
    first = re.search(rb"\x05\x56\0{7}", loose).start()
    place = raw.index(b"\x0f\x04\0\0\0\0\0\0\0")
    source, made = tmp_path / "both.mcap", tmp_path / "made.mcap"
    source.write_bytes(raw[:place] + loose[first : first + 100 * 95] + raw[place:])
    report = repair(source, made)
    assert (sum(report.messages.values()), report.unproved) == (300, 100)
    assert "messages stand beside its chunks, where no index leads" in report.reasons
    assert len(everything(made)[0]) == 300
    assert sum(index.chunk_length > 0 for index in everything(made)[1].chunk_indexes) == report.chunks


def test_a_channel_that_stands_behind_its_messages_is_written_before_them(tmp_path):
    """A chunk that is kept byte for byte may have it there; a reader from the beginning needs it before."""
    schema = Schema(id=1, name="std_msgs/msg/String", encoding="ros2msg", data=b"string data")
    channel = Channel(id=1, topic="/late", message_encoding="cdr", metadata={}, schema_id=1)
    said = [Message(1, number, b"\0\1\0\0", number, number) for number in range(2)]
    for inside in (
        [schema, said[0], channel, said[1]],
        [channel, said[0], schema, said[1]],
        [*said, channel],
    ):
        raw = record_bytes(*inside)
        chunk = record_bytes(Chunk("", raw, 1, 0, crc32(raw), len(raw)))
        source, made = tmp_path / "late.mcap", tmp_path / "made.mcap"
        before = record_bytes(*(item for item in [schema] if item not in inside))
        source.write_bytes(MAGIC + record_bytes(Header("ros2", "x")) + before + chunk)
        report = repair(source, made)
        assert chunk in made.read_bytes()
        with made.open("rb") as file:
            found = [channel.topic for _, channel, _ in NonSeekingReader(file).iter_messages()]
        assert (found, report.messages) == (["/late"] * 2, {"/late": 2})


@pytest.mark.parametrize("crc", [True, False])
@pytest.mark.parametrize("compression", [CompressionType.ZSTD, CompressionType.LZ4, CompressionType.NONE])
def test_other_writers_are_told_what_proves_their_messages(tmp_path, compression, crc):
    path, made = tmp_path / "foreign.mcap", tmp_path / "made.mcap"
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=2000, compression=compression, enable_crcs=crc)
        writer.start("ros2", "another")
        channel = writer.register_channel("/chatter", "cdr", 0)
        for index in range(200):
            writer.add_message(channel, index, b"%060d" % index, index)
        writer.finish()
    report = repair(path, made)
    assert report.whole
    assert (report.proved, report.unproved) == ((200, 0) if crc else (0, 200))
    assert ("200 of them have no checksum" in report.text(written=True)) == (not crc)
    raw = path.read_bytes()
    path.write_bytes(raw[: len(raw) // 2])
    found = repair(path, made)
    assert (found.unproved > 0) != crc
    assert set(everything(made)[0]) < {("/chatter", index, b"%060d" % index) for index in range(200)}


def test_a_recording_inside_a_recording_is_not_taken_for_a_part_of_it(tmp_path, recording):
    """An attachment holds a recording; with its head damaged nothing of that is taken."""
    path, made = tmp_path / "outer.mcap", tmp_path / "made.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start("ros2", "another")
        channel = writer.register_channel("/chatter", "cdr", 0)
        writer.add_message(channel, 5, b"mine", 5)
        writer.add_attachment(0, 0, "inner.mcap", "application/octet-stream", recording.read_bytes())
        writer.add_message(channel, 6, b"mine too", 6)
        writer.finish()
    raw = path.read_bytes()
    place = raw.index(b"inner.mcap")
    path.write_bytes(raw[: place - 20] + bytes(40) + raw[place + 20 :])
    report = repair(path, made)
    assert [topic for topic, _, _ in everything(made)[0]] == ["/chatter"] * len(everything(made)[0])
    assert report.lost
    assert "its record inner.mcap is lost" in report.reasons


def test_chunks_say_their_checksum_and_are_of_one_size(tmp_path, types, mission, info, made_up):
    """Also of a batch that is far larger than a chunk."""
    path = tmp_path / "a.mcap"
    sink = McapSink(path, mission, types, info)
    sink.write(*made_up(1, [900] * 3000))
    sink.close(SourceStatistics())
    _, summary = everything(path)
    sizes = [chunk.uncompressed_size for chunk in summary.chunk_indexes]
    assert len(sizes) > 10
    # A few begin with schemas and channels.
    assert 1 <= sum(size > mcap_chunks.CHUNK_BYTES + 2000 for size in sizes) <= 3
    with path.open("rb") as file:
        records = list(StreamReader(file, emit_chunks=True).records)
    assert all(item.uncompressed_crc for item in records if type(item).__name__ == "Chunk")

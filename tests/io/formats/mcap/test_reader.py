from __future__ import annotations

import struct
from contextlib import closing

import numpy as np
import pytest
from effort import examples
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.writer import CompressionType, Writer
from places import CAPTURES

from edoras_tools.decode import ColumnDecoder, Context, Options
from edoras_tools.errors import CaptureError, NoDatagramsError
from edoras_tools.io.formats.mcap import chunks as mcap_chunks
from edoras_tools.io.formats.mcap.reader import McapSource
from edoras_tools.io.formats.mcap.writer import McapSink
from edoras_tools.io.formats.open import open_file
from edoras_tools.io.frames.frame_batch import FrameBatch
from edoras_tools.io.frames.linklayer import Demux
from edoras_tools.links.bare import CI
from edoras_tools.mission.model import Mission, Route
from edoras_tools.model import PacketBatch, SourceInfo, SourceStatistics, concatenate
from edoras_tools.ros import TypeStore

MISSION = Mission(
    routes=(Route("/cmd_vel", "geometry_msgs/msg/Twist", 0x1827, CI, "command"),),
    files={"rover.yaml": b"node: {}\n"},
)
TYPES = TypeStore()


def record(path, batches, info, flush=False):
    decoder = ColumnDecoder(Context(MISSION, TYPES, Options()))
    sink = McapSink(path, MISSION, TYPES, info)
    for batch in batches:
        sink.write(batch, decoder.decode(batch))
        if flush:
            sink.flush()
    sink.close(SourceStatistics())


def read(path):
    """The batches, and the error at the end if there is one."""
    source, batches = McapSource(path), []
    try:
        batches.extend(source.batches())
    except CaptureError as error:
        return batches, error
    finally:
        source.close()
    return batches, None


def same(one, other):
    assert len(one) == len(other)
    for row in range(len(one)):
        assert one[row] == other[row]


def test_what_the_recorder_lost_is_told(tmp_path):
    sink = McapSink(tmp_path / "a.mcap", MISSION, TYPES, SourceInfo("lo", "live"))
    sink.close(SourceStatistics(kernel_drops=63_784))
    with closing(open_file(tmp_path / "a.mcap")) as recording:
        assert list(recording.batches()) == []
    assert recording.statistics.kernel_drops == 63_784


@pytest.mark.each(3)
@pytest.mark.parametrize("name", ["a_rover", "b_arm_single", "e_ci_errors", "f_sbn_disconnect"])
def test_a_capture_comes_back(tmp_path, name):
    source = open_file(CAPTURES / f"{name}.pcap")
    batches = list(source.batches())
    source.close()
    record(tmp_path / "a.mcap", batches, source.info)
    recording = open_file(tmp_path / "a.mcap")
    same(concatenate(list(recording.batches())), concatenate(batches))
    recording.close()
    assert recording.info.kind == "mcap"
    assert recording.info.time_resolution_ns == source.info.time_resolution_ns
    assert recording.info.snap_length == source.info.snap_length
    assert recording.info.attachments == {"rover.yaml": b"node: {}\n"}
    assert recording.statistics.datagrams == source.statistics.datagrams
    assert (
        recording.statistics.position
        == recording.statistics.total_bytes
        == (tmp_path / "a.mcap").stat().st_size
    )


def ipv4(payload, fragment=0, protocol=17, identification=1):
    total = 20 + len(payload)
    return (
        struct.pack(
            ">BBHHHBBH4s4s",
            0x45,
            0,
            total,
            identification,
            fragment,
            64,
            protocol,
            0,
            bytes([10, 0, 0, 1]),
            bytes([10, 0, 0, 2]),
        )
        + payload
    )


def ipv6(payload):
    return (
        struct.pack(">IHBB16s16s", 6 << 28, len(payload), 17, 64, bytes(range(16)), bytes(range(1, 17)))
        + payload
    )


def udp(payload):
    return struct.pack(">HHHH", 5000, 1234, 8 + len(payload), 0) + payload


def frames(contents):
    """Frames of (capture time, original length beyond, bytes) one after another."""
    lengths = [len(item[2]) for item in contents]
    data = b"".join(item[2] for item in contents) + bytes(64)
    length = np.array(lengths, dtype=np.int32)
    return FrameBatch(
        data=np.frombuffer(data, dtype=np.uint8),
        number=np.arange(1, len(contents) + 1),
        time_ns=np.array([item[0] for item in contents], dtype=np.int64),
        link_type=np.full(len(contents), 1, dtype=np.uint16),
        offset=np.cumsum(length, dtype=np.int64) - length,
        length=length,
        original_length=(length + np.array([item[1] for item in contents], dtype=np.int32)).astype(np.int32),
    )


ETHERNET = b"\2" * 12
FRAMES = st.lists(
    st.tuples(
        st.integers(0, 2**62),
        st.sampled_from([0, 0, 5]),
        st.one_of(
            st.binary(max_size=300).map(lambda payload: ETHERNET + b"\x08\x00" + ipv4(udp(payload))),
            st.binary(max_size=300).map(lambda payload: ETHERNET + b"\x86\xdd" + ipv6(udp(payload))),
        ),
    ),
    max_size=40,
)


@settings(max_examples=examples(60), deadline=None)
@given(FRAMES, st.integers(0, 40), st.booleans(), st.sampled_from([4096, 1 << 20]))
def test_any_frames_come_back_in_their_order(tmp_path_factory, contents, cut, flush, chunk_bytes):
    path = tmp_path_factory.mktemp("any") / "any.mcap"
    parts = [frames(contents[:cut]), frames(contents[cut:])]
    batches = [Demux().demux(part) for part in parts]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(mcap_chunks, "CHUNK_BYTES", chunk_bytes)
        record(path, batches, SourceInfo("x", "pcap"), flush)
    found, error = read(path)
    assert error is None
    whole = concatenate(batches)
    if found:
        same(concatenate(found), whole)
    else:
        assert len(whole) == 0


def test_fragments_come_back_and_are_put_together_again(tmp_path):
    whole = udp(bytes(range(200)) * 4)
    pieces = [(whole[:400], 0x2000), (whole[400:], 50)]
    contents = [
        (1000 + index, 0, ETHERNET + b"\x08\x00" + ipv4(part, fragment))
        for index, (part, fragment) in enumerate(pieces)
    ]
    batch = Demux().demux(frames(contents))
    assert batch[1].payload == whole[8:]
    record(tmp_path / "a.mcap", [batch], SourceInfo("x", "pcap"))
    found, error = read(tmp_path / "a.mcap")
    assert error is None
    same(found[0], batch)


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """A recording of several chunks, and what is in it."""
    path = tmp_path_factory.mktemp("source") / "whole.mcap"
    source = open_file(CAPTURES / "e_ci_errors.pcap")
    batch = concatenate(list(source.batches()))
    source.close()
    record(
        path,
        [batch.take(slice(start, start + 200)) for start in range(0, len(batch), 200)],
        source.info,
        flush=True,
    )
    return path, batch


@settings(max_examples=examples(60), deadline=None)
@given(st.floats(0, 1, exclude_max=True))
def test_a_cut_off_recording_gives_what_is_whole_then_says_so(tmp_path_factory, recording, share):
    path, batch = recording
    raw = path.read_bytes()
    cut = tmp_path_factory.mktemp("cut") / "cut.mcap"
    cut.write_bytes(raw[: int(share * len(raw))])
    try:
        found, error = read(cut)
    except CaptureError as refused:
        assert share < 0.01
        assert "not an MCAP" in str(refused)  # noqa: PT017  only the shortest cuts are refused at once
        return
    if found:
        same(concatenate(found), batch.take(slice(0, sum(map(len, found)))))
    if sum(map(len, found)) < len(batch):
        assert "cut off" in str(error)
        assert "edoras recover" in str(error)


@settings(max_examples=examples(100), deadline=None)
@given(st.lists(st.tuples(st.floats(0, 0.999), st.binary(min_size=1, max_size=12)), min_size=1, max_size=4))
def test_damage_raises_nothing_else(tmp_path_factory, recording, damages):
    raw = bytearray(recording[0].read_bytes())
    for share, junk in damages:
        place = int(share * len(raw))
        raw[place : place + len(junk)] = junk
    path = tmp_path_factory.mktemp("damaged") / "bad.mcap"
    path.write_bytes(raw)
    try:
        _, error = read(path)
    except CaptureError as refused:
        error = refused
    assert error is None or "\n" not in str(error)


def test_a_damaged_chunk_is_left_out_and_reported_at_the_end(tmp_path, recording):
    path, batch = recording
    raw = bytearray(path.read_bytes())
    place = raw.index(b"zstd", len(raw) // 2)
    raw[place + 40 : place + 60] = bytes(20)
    (tmp_path / "bad.mcap").write_bytes(raw)
    found, error = read(tmp_path / "bad.mcap")
    assert sum(map(len, found)) == len(batch) - 200
    assert "damaged and was left out" in str(error)


@pytest.mark.each(3)
@pytest.mark.parametrize("compression", [CompressionType.ZSTD, CompressionType.LZ4, CompressionType.NONE])
@pytest.mark.parametrize("chunked", [True, False])
def test_recordings_that_other_tools_wrote_again(tmp_path, recording, compression, chunked):
    from mcap.reader import make_reader

    path, batch = recording
    again = tmp_path / "again.mcap"
    with path.open("rb") as file, again.open("wb") as output:
        reader = make_reader(file)
        writer = Writer(output, chunk_size=50_000, compression=compression, use_chunking=chunked)
        writer.start("ros2", "another")
        channels = {}
        for schema, channel, message in reader.iter_messages():
            if channel.id not in channels:
                schema_id = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.id] = writer.register_channel(channel.topic, "cdr", schema_id)
            writer.add_message(
                channels[channel.id], message.log_time, message.data, message.publish_time, message.sequence
            )
        for item in reader.iter_metadata():
            writer.add_metadata(item.name, item.metadata)
        writer.finish()
    found, error = read(again)
    assert error is None
    same(concatenate(found), batch)
    source = McapSource(again)
    source.close()
    assert source.info.time_resolution_ns == 1000


def test_a_recording_without_datagrams_names_its_topics(tmp_path):
    path = tmp_path / "other.mcap"
    with path.open("wb") as output:
        writer = Writer(output)
        writer.start()
        writer.add_message(writer.register_channel("/scan", "cdr", 0), 0, b"", 0)
        writer.finish()
    with pytest.raises(CaptureError, match=r"contains no /edoras/datagrams.*its topics are /scan"):
        McapSource(path)
    raw = path.read_bytes()
    (tmp_path / "cut.mcap").write_bytes(raw[: len(raw) - 20])
    with pytest.raises(NoDatagramsError, match="its topics are /scan"):
        McapSource(tmp_path / "cut.mcap")


def test_what_is_no_recording(tmp_path):
    with pytest.raises(CaptureError, match="cannot be opened: No such file"):
        McapSource(tmp_path / "missing.mcap")
    with pytest.raises(CaptureError, match="cannot be opened: Is a directory"):
        McapSource(tmp_path)
    (tmp_path / "text").write_text("hello")
    with pytest.raises(CaptureError, match="is not an MCAP file"):
        McapSource(tmp_path / "text")


def test_every_column_of_a_batch_is_compared():
    assert set(PacketBatch.__struct_fields__) >= {
        "number",
        "time_ns",
        "original_length",
        "capture_findings",
    }

from __future__ import annotations

import io
import os
import struct
from contextlib import closing, suppress

import numpy as np
import pytest
from captures import read
from effort import every, examples
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace
from places import CAPTURES
from scapy.layers.inet import IP, UDP
from scapy.layers.l2 import Ether
from scapy.packet import Raw
from scapy.utils import RawPcapReader, wrpcap

from edoras_tools.errors import CaptureError
from edoras_tools.io.formats import capture_file, pcap
from edoras_tools.io.formats.open import open_file
from edoras_tools.io.formats.pcap import PcapSink
from edoras_tools.io.frames import frame_batch as framing
from edoras_tools.model import PacketBatch, SourceStatistics
from edoras_tools.pipelines.capture.record import Target
from edoras_tools.pipelines.capture.record import record as record_all
from edoras_tools.pipelines.workbench import Settings

FRAME = bytes(Ether() / IP(src="127.0.0.1", dst="127.0.0.2") / UDP(sport=1, dport=2) / Raw(b"hello"))
RAW = bytes(IP(src="127.0.0.1", dst="127.0.0.2") / UDP(sport=1, dport=2) / Raw(b"hello"))


def header(order="<", magic=0xA1B2C3D4, link_type=1, snap_length=65535, version=(2, 4)):
    return struct.pack(f"{order}IHHiIII", magic, *version, 0, 0, snap_length, link_type)


def record(frame, seconds=1, rest=0, order="<", original=None):
    return struct.pack(f"{order}IIII", seconds, rest, len(frame), original or len(frame)) + frame


@pytest.mark.parametrize("suffix", ["pcap", "pcapng", "mcap"])
def test_a_garbled_length_on_the_wire_loses_no_datagram(tmp_path, suffix):
    whole = [record(FRAME), record(FRAME, original=0xFF000000 | len(FRAME)), record(FRAME)]
    (tmp_path / "a.pcap").write_bytes(header() + b"".join(whole))
    copy = tmp_path / f"copy.{suffix}"
    source = open_file(tmp_path / "a.pcap")
    recorded = record_all(source, Settings().workbench(source.info), Target(copy))
    assert recorded.ledger.datagrams == len(read(copy)[0]) == 3


def udp_frame(payload):
    """Raw IPv4 and UDP around a payload, without checksums."""
    total = 28 + len(payload)
    head = struct.pack(">BBHHHBBHII", 0x45, 0, total, 0, 0, 64, 17, 0, 0x7F000001, 0x7F000001)
    return head + struct.pack(">HHHH", 1, 2, 8 + len(payload), 0) + payload


@pytest.fixture(params=["default", "tiny"])
def _sizes(monkeypatch, request):
    """Once as it is, once so small that a few records take all the ways that millions do."""
    if request.param == "tiny":
        monkeypatch.setattr(capture_file, "FIRST", 300)
        monkeypatch.setattr(capture_file, "SLICE", 1000)
        monkeypatch.setattr(pcap, "_STRIDE", 64)
        monkeypatch.setattr(pcap, "_SIGHT", 64)
        monkeypatch.setattr(framing, "_LANES", 2)


@pytest.mark.parametrize("order", "<>")
@pytest.mark.parametrize(("magic", "unit"), [(0xA1B2C3D4, 1000), (0xA1B23C4D, 1)])
def test_both_resolutions_in_both_byte_orders(tmp_path, order, magic, unit):
    path = tmp_path / "a"
    path.write_bytes(
        header(order, magic)
        + record(FRAME, 0xFFFFFFFF, 999_999, order)
        + record(FRAME[:50], 2, 7, order, original=len(FRAME) + 3)
    )
    rows, error = read(path)
    assert not error
    assert [row.time_ns for row in rows] == [0xFFFFFFFF * 10**9 + 999_999 * unit, 2 * 10**9 + 7 * unit]
    assert [(row.number, row.frame, row.original_length) for row in rows] == [
        (1, FRAME, len(FRAME)),
        (2, FRAME[:50], len(FRAME) + 3),
    ]
    with closing(open_file(path)) as source:
        info = source.info
    assert (info.kind, info.time_resolution_ns, info.snap_length) == ("pcap", unit, 65535)


def test_bits_about_the_frame_check_sequence_are_no_link_type(tmp_path):
    path = tmp_path / "a"
    path.write_bytes(header(link_type=0x24000065) + record(RAW))
    ((row,), error) = read(path)
    assert (row.link_type, row.payload, error) == (101, b"hello", "")


@pytest.mark.each(3)
@pytest.mark.quick("default-*", "tiny-b_arm_single")
@pytest.mark.usefixtures("_sizes")
@pytest.mark.parametrize("name", ["a_rover", "b_arm_single", "e_ci_errors", "f_sbn_disconnect"])
def test_scapy_reads_the_same_of_real_captures(name):
    path = CAPTURES / f"{name}.pcap"
    rows, error = read(path)
    with RawPcapReader(str(path)) as reader:
        theirs = [(frame, (meta.sec * 1_000_000 + meta.usec) * 1000, meta.wirelen) for frame, meta in reader]
    assert not error
    assert [(row.frame, row.time_ns, row.original_length) for row in rows] == theirs
    assert [row.number for row in rows] == list(range(1, len(theirs) + 1))


def test_a_file_by_scapy(tmp_path):
    path = tmp_path / "a.pcap"
    wrpcap(str(path), [Ether(FRAME)] * 3)
    assert [row.payload for row in read(path)[0]] == [b"hello"] * 3


def imitation(order):
    """A payload that looks like records: plausible times and lengths, one after another."""
    return b"".join(record(b"\x01" * length, 1_700_000_000, 5, order) for length in (1, 0, 40, 7, 64)) * 3


@pytest.mark.each(2)
@pytest.mark.quick("tiny->", "default-<")
@pytest.mark.usefixtures("_sizes")
@pytest.mark.parametrize("order", "<>")
@settings(max_examples=examples(40, 4))
@given(data=st.data())
def test_hostile_payloads_and_times_change_nothing(tmp_path_factory, order, data):
    payloads = st.one_of(
        st.binary(max_size=30),
        st.integers(0, 200).map(bytes),
        st.integers(0, 200).map(lambda start: imitation(order)[start:]),
    )
    times = st.sampled_from([0, 1, 1_700_000_000, 1_700_000_001, 0xFFFFFFFF])
    drawn = data.draw(st.lists(st.tuples(payloads, times, st.integers(0, 999_999)), max_size=80))
    frames = [udp_frame(payload) for payload, _, _ in drawn]
    path = tmp_path_factory.mktemp("pcap") / "a"
    path.write_bytes(
        header(order, link_type=101)
        + b"".join(
            record(frame, seconds, rest, order)
            for frame, (_, seconds, rest) in zip(frames, drawn, strict=True)
        )
    )
    rows, error = read(path)
    assert not error
    assert [(row.frame, row.payload, row.time_ns) for row in rows] == [
        (frame, payload, seconds * 10**9 + rest * 1000)
        for frame, (payload, seconds, rest) in zip(frames, drawn, strict=True)
    ]


def test_a_large_file_of_mixed_sizes_takes_the_fast_way(tmp_path, monkeypatch):
    random = np.random.default_rng(3)
    frames = [udp_frame(random.bytes(size)) for size in random.integers(20, 300, 6000).tolist()]
    path = tmp_path / "a"
    path.write_bytes(header(link_type=101) + b"".join(record(frame, 1_700_000_000, 9) for frame in frames))
    singles = []
    original = framing.walk_records

    def counting(start, end, seeds, successor, step):
        return original(start, end, seeds, successor, lambda at: singles.append(at) or step(at))

    monkeypatch.setattr(pcap, "walk_records", counting)
    rows, _ = read(path)
    assert [row.frame for row in rows] == frames
    assert len(singles) < len(frames) / 4


@pytest.mark.each(2)
@pytest.mark.usefixtures("_sizes")
def test_a_file_cut_anywhere_gives_all_whole_records_first(tmp_path):
    path = tmp_path / "a.pcap"
    whole = header() + record(FRAME) * 20
    size = len(record(FRAME))
    for kept in every(11, range(24, len(whole))):
        path.write_bytes(whole[:kept])
        rows, error = read(path)
        count, rest = divmod(kept - 24, size)
        assert [row.frame for row in rows] == [FRAME] * count
        if rest:
            assert f"ends inside record {count + 1} at byte {24 + count * size};" in error
            assert "cut off while being written" in error
        else:
            assert not error


@pytest.mark.each(3)
@pytest.mark.usefixtures("_sizes")
@pytest.mark.parametrize("claim", [0x7FFFFFFF, 0xFFFFFFFF, 262145])
def test_an_absurd_length(tmp_path, claim):
    path = tmp_path / "a.pcap"
    good = header() + record(FRAME) * 16
    for tail in (b"", bytes(300_000)):
        path.write_bytes(good + struct.pack("<IIII", 1, 0, claim, claim) + tail)
        rows, error = read(path)
        assert len(rows) == 16
        assert error.startswith(f"{path}: record 17 at byte {len(good)} claims a frame of {claim} bytes")
        assert error.endswith("16 packets before it were read")


def test_a_frame_longer_than_the_snap_length_is_read_all_the_same(tmp_path):
    path = tmp_path / "a.pcap"
    frame = udp_frame(bytes(60_000))
    path.write_bytes(header(snap_length=96, link_type=101) + record(frame) * 2)
    rows, error = read(path)
    assert ([row.frame for row in rows], error) == ([frame] * 2, "")


@pytest.mark.parametrize(
    ("content", "what"),
    [
        (header()[:10], "ends inside the pcap file header, at byte 10 of 24"),
        (header(version=(7, 1)), "pcap version 7.1 is not supported; 2.4 is"),
        (header(magic=0xA1B2CD34), "a modified pcap (magic 34cdb2a1)"),
    ],
)
def test_headers_that_cannot_be_read(tmp_path, content, what):
    path = tmp_path / "a.pcap"
    path.write_bytes(content)
    with pytest.raises(CaptureError) as caught:
        open_file(path)
    assert what in str(caught.value)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_no_packets_and_no_datagrams(tmp_path):
    path = tmp_path / "a.pcap"
    path.write_bytes(header())
    assert read(path) == ([], "")
    path.write_bytes(header() + record(bytes(60)) * 5)
    source = open_file(path)
    assert list(source.batches()) == []
    statistics = source.statistics
    assert (statistics.frames, statistics.skipped, statistics.datagrams, statistics.bytes) == (5, 5, 0, 300)
    assert statistics.position == statistics.total_bytes == path.stat().st_size


def test_a_link_type_that_cannot_be_read_is_named(tmp_path):
    path = tmp_path / "a.pcap"
    path.write_bytes(header(link_type=105) + record(FRAME))
    source = open_file(path)
    assert list(source.batches()) == []
    assert source.statistics.warnings == [f"{path}: frames of link type 105 are not supported; skipped"]


@given(st.binary(max_size=400))
def test_garbage_behind_a_header(content):
    file = io.BytesIO(content)

    class Memory:
        name, total_bytes, position = "memory", len(content), 0

        def fill(self, view):
            return file.readinto(view)

        def close(self):
            pass

    source = pcap.PcapSource(capture_file.Window(Memory(), header()))
    with suppress(CaptureError):
        for batch in source.batches():
            assert len(batch)


@pytest.mark.parametrize("damage", ["noise", "zeros", "length"])
def test_behind_a_damaged_place_reading_goes_on(damage, tmp_path):
    """At the next record that surely is one; also behind a length that covers others."""
    content = bytearray((CAPTURES / "a_rover.pcap").read_bytes())
    whole = len(read(CAPTURES / "a_rover.pcap")[0])
    if damage == "length":
        at = 24 + 16 + int.from_bytes(content[32:36], "little")  # the second record
        content[at + 8 : at + 12] = (5000).to_bytes(4, "little")
    else:
        content[9000:9600] = bytes(600) if damage == "zeros" else bytes(range(1, 201)) * 3
    path = tmp_path / "x.pcap"
    path.write_bytes(content)
    rows, error = read(path)
    assert whole - 12 < len(rows) < whole
    assert " packets before it were read, and " in error or "1 packet before it were read, and " in error
    assert error.endswith(" bytes were left out")


def batch_of(frames, times=None, link_type=1, original=None):
    """A batch with gaps between its frames, and no payloads."""
    count = len(frames)
    lengths = np.array([len(frame) for frame in frames], dtype=np.int32)
    none = np.zeros(count, dtype=np.int64)
    return PacketBatch(
        data=np.frombuffer(b"".join(b"\xa5\xa5\xa5" + frame for frame in frames) + b"\xa5", dtype=np.uint8),
        number=np.arange(1, count + 1),
        time_ns=none if times is None else np.array(times, dtype=np.int64),
        link_type=np.full(count, link_type, dtype=np.uint16),
        frame_offset=np.cumsum(lengths + 3, dtype=np.int64) - lengths,
        frame_length=lengths,
        original_length=lengths if original is None else np.array(original, dtype=np.int32),
        offset=none,
        length=none.astype(np.int32),
        source_address=none.astype(np.uint32),
        source_port=none.astype(np.uint16),
        destination_address=none.astype(np.uint32),
        destination_port=none.astype(np.uint16),
        ip_version=none.astype(np.uint8) + np.uint8(4),
        capture_findings=none.astype(np.uint32),
    )


@pytest.mark.parametrize("name", ["a_rover", "b_arm_single", "e_ci_errors", "f_sbn_disconnect"])
def test_a_real_capture_comes_out_bit_for_bit(tmp_path, name):
    path, copied = CAPTURES / f"{name}.pcap", tmp_path / "a.pcap"
    with closing(open_file(path)) as source:
        sink = PcapSink(copied, nanosecond=False, snap_length=source.info.snap_length)
        for batch in source.batches():
            sink.write(batch, None)
        sink.close(source.statistics)
    assert copied.read_bytes() == path.read_bytes()


@given(
    st.lists(
        st.tuples(
            st.binary(max_size=40), st.integers(0, 0xFFFFFFFF * 10**9 + 999_999_999), st.integers(0, 9)
        ),
        min_size=1,
        max_size=20,
    ),
    st.booleans(),
)
def test_scapy_reads_what_was_written(tmp_path_factory, drawn, nanosecond):
    path = tmp_path_factory.mktemp("sink") / "a.pcap"
    frames, times, more = zip(*drawn, strict=True)
    batch = batch_of(
        frames, times, original=[len(frame) + extra for frame, extra in zip(frames, more, strict=True)]
    )
    sink = PcapSink(path, nanosecond=nanosecond, snap_length=77)
    sink.write(batch.take(slice(5)), None)
    sink.write(batch.take(slice(5, None)), None)
    sink.close(SourceStatistics())
    unit = 1 if nanosecond else 1000
    with RawPcapReader(str(path)) as reader:
        assert (reader.nano, reader.snaplen, reader.linktype) == (nanosecond, 77, 1)
        assert [(frame, meta.sec, meta.usec, meta.wirelen) for frame, meta in reader] == [
            (frame, time // 10**9, time % 10**9 // unit, len(frame) + extra) for frame, time, extra in drawn
        ]


def test_a_capture_without_packets(tmp_path):
    sink = PcapSink(tmp_path / "a.pcap")
    sink.write(batch_of([]))
    sink.close()
    sink.close()
    with closing(open_file(tmp_path / "a.pcap")) as source:
        assert list(source.batches()) == []


def test_a_second_link_type_asks_for_pcapng(tmp_path):
    sink = PcapSink(tmp_path / "a.pcap")
    sink.write(batch_of([b"one"]))
    with pytest.raises(CaptureError, match=r"a\.pcap: a pcap file has one link type.*write a \.pcapng file"):
        sink.write(batch_of([b"two"], link_type=101))
    sink.close()
    assert (tmp_path / "a.pcap").stat().st_size == 24 + 16 + 3


@pytest.mark.parametrize("time_ns", [-1, 2**32 * 10**9])
def test_a_time_that_does_not_fit(tmp_path, time_ns):
    sink = PcapSink(tmp_path / "a.pcap")
    with pytest.raises(CaptureError, match="does not fit a pcap file"):
        sink.write(batch_of([b"one"], [time_ns]))
    sink.close()


def test_an_open_file_is_flushed_and_left_open():
    file = io.BytesIO()
    sink = PcapSink(file)
    sink.write(batch_of([b"abc"]))
    sink.flush()
    sink.close()
    assert file.getvalue().endswith(b"abc")


def test_what_is_flushed_is_in_the_file(tmp_path):
    sink = PcapSink(tmp_path / "a.pcap")
    sink.write(batch_of([b"abc"]))
    sink.flush()
    assert (tmp_path / "a.pcap").read_bytes().endswith(b"abc")
    sink.close()


def test_a_path_that_cannot_be_written(tmp_path):
    with pytest.raises(
        CaptureError, match=r"a\.pcap: cannot be created: No such file or directory; name another"
    ):
        PcapSink(tmp_path / "missing" / "a.pcap")
    with pytest.raises(CaptureError, match="cannot be created: Is a directory"):
        PcapSink(tmp_path)


@pytest.mark.skipif(not os.access("/dev/full", os.W_OK), reason="/dev/full is Linux's")
def test_a_full_disk():
    sink = PcapSink("/dev/full")
    with pytest.raises(CaptureError, match="/dev/full: cannot be written: No space left on device"):
        sink.write(batch_of([b"abc"]))
    sink.close()


def test_columns_of_any_stride_are_written(tmp_path):
    batch = batch_of([b"a", b"bb", b"ccc", b"dd"])
    sink = PcapSink(tmp_path / "a.pcap")
    sink.write(batch.take(slice(None, None, -2)))
    sink.write(replace(batch, data=np.concatenate((batch.data, batch.data))[: batch.data.size]))
    sink.close()
    with RawPcapReader(str(tmp_path / "a.pcap")) as reader:
        assert [frame for frame, _ in reader] == [b"dd", b"bb", b"a", b"bb", b"ccc", b"dd"]

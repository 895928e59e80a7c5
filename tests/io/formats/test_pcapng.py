from __future__ import annotations

import io
import shutil
import struct
import subprocess
from contextlib import closing, suppress

import numpy as np
import pytest
from captures import read
from effort import every, examples
from hypothesis import given, settings
from hypothesis import strategies as st
from places import CAPTURES
from scapy.layers.inet import IP, UDP
from scapy.layers.l2 import Ether
from scapy.packet import Raw
from scapy.utils import RawPcapNgReader, wrpcapng

from edoras_tools.errors import CaptureError
from edoras_tools.io.formats import capture_file, pcapng
from edoras_tools.io.formats.open import open_file
from edoras_tools.io.formats.pcapng import PcapngSink, TimeScale
from edoras_tools.io.frames import frame_batch as framing
from edoras_tools.model import PacketBatch, SourceStatistics, concatenate

RAW = bytes(IP(src="127.0.0.1", dst="127.0.0.2") / UDP(sport=1, dport=2) / Raw(b"hello"))
FRAME = bytes(Ether())[:12] + b"\x08\x00" + RAW
RESOLUTION, OFFSET = 9, 14


def block(kind, body, order="<"):
    body += bytes(-len(body) % 4)
    size = struct.pack(f"{order}I", len(body) + 12)
    return struct.pack(f"{order}I", kind) + size + body + size


def section(order="<", version=(1, 0)):
    return block(0x0A0D0D0A, struct.pack(f"{order}IHHq", 0x1A2B3C4D, *version, -1), order)


def interface(order="<", link_type=1, snap_length=0, options=()):
    body = struct.pack(f"{order}HHI", link_type, 0, snap_length)
    for code, value in options:
        body += struct.pack(f"{order}HH", code, len(value)) + value + bytes(-len(value) % 4)
    return block(1, body, order)


def enhanced(frame, ticks=0, number=0, order="<", original=None, options=b""):
    head = struct.pack(
        f"{order}IIIII", number, ticks >> 32, ticks & 0xFFFFFFFF, len(frame), original or len(frame)
    )
    return block(6, head + frame + bytes(-len(frame) % 4) + options, order)


def obsolete(frame, ticks=0, number=0, order="<"):
    head = struct.pack(f"{order}HHIIII", number, 9, ticks >> 32, ticks & 0xFFFFFFFF, len(frame), len(frame))
    return block(2, head + frame, order)


def simple(frame, order="<", original=None):
    return block(3, struct.pack(f"{order}I", original or len(frame)) + frame, order)


def statistics(*drops, order="<", number=0, code=5):
    body = struct.pack(f"{order}III", number, 0, 5)
    options = b"".join(struct.pack(f"{order}HHQ", code, 8, item) for item in drops)
    return block(5, body + options + bytes(4), order)


LOST = {
    "none": ([enhanced(FRAME)], None),
    "not of drops": ([enhanced(FRAME), statistics(3, code=4)], None),
    "zero": ([enhanced(FRAME), statistics(0)], 0),
    "of the system": ([enhanced(FRAME), statistics(7, code=7)], 7),
    "the last of several": ([statistics(1), enhanced(FRAME), statistics(3)], 3),
    "of two interfaces": ([interface(), enhanced(FRAME), statistics(3), statistics(4, number=1)], 7),
    "of two sections": ([statistics(3), section(), interface(), enhanced(FRAME), statistics(4)], 7),
    "of no packet": ([statistics(3)], 3),
    "too short": ([enhanced(FRAME), block(5, bytes(8))], None),
    "cut": ([enhanced(FRAME), block(5, bytes(12) + struct.pack("<HH", 5, 8))], None),
}


@pytest.mark.parametrize("name", LOST)
def test_what_the_capture_lost_is_told_by_statistics(tmp_path, name):
    blocks, lost = LOST[name]
    (tmp_path / "a").write_bytes(section() + interface() + b"".join(blocks))
    with closing(open_file(tmp_path / "a")) as source:
        assert sum(map(len, source.batches())) == blocks.count(enhanced(FRAME))
        assert source.statistics.kernel_drops == lost


def test_statistics_in_the_other_byte_order(tmp_path):
    content = section(">") + interface(">") + enhanced(FRAME, order=">") + statistics(9, order=">")
    (tmp_path / "a").write_bytes(content)
    with closing(open_file(tmp_path / "a")) as source:
        assert sum(map(len, source.batches())) == 1
        assert source.statistics.kernel_drops == 9


@pytest.fixture(params=["default", "tiny"])
def _sizes(monkeypatch, request):
    if request.param == "tiny":
        monkeypatch.setattr(capture_file, "FIRST", 300)
        monkeypatch.setattr(capture_file, "SLICE", 1000)
        monkeypatch.setattr(pcapng, "_STRIDE", 64)
        monkeypatch.setattr(pcapng, "_SIGHT", 64)
        monkeypatch.setattr(framing, "_LANES", 2)


@pytest.mark.usefixtures("_sizes")
@pytest.mark.parametrize("order", "<>")
def test_every_packet_block(tmp_path, order):
    path = tmp_path / "a"
    path.write_bytes(
        section(order)
        + interface(order)
        + interface(order, link_type=101, snap_length=30)
        + enhanced(FRAME, 1_700_000_000_000_001, 0, order, options=struct.pack(f"{order}HHI", 2, 4, 0))
        + block(0x0BAD, b"custom", order)
        + obsolete(RAW, 1_700_000_000_000_002, 1, order)
        + enhanced(RAW[:30], 1_700_000_000_000_003, 1, order, original=len(RAW))
        + simple(FRAME, order)
        + block(4, bytes(40), order)
    )
    rows, error = read(path)
    assert not error
    assert [(row.number, row.link_type, row.frame, row.original_length, row.time_ns) for row in rows] == [
        (1, 1, FRAME, len(FRAME), 1_700_000_000_000_001_000),
        (2, 101, RAW, len(RAW), 1_700_000_000_000_002_000),
        (3, 101, RAW[:30], len(RAW), 1_700_000_000_000_003_000),
        (4, 1, FRAME, len(FRAME), 0),
    ]


def test_a_simple_packet_cut_at_the_snap_length(tmp_path):
    path = tmp_path / "a"
    path.write_bytes(section() + interface(snap_length=43) + simple(FRAME[:43], original=len(FRAME)))
    ((row,), error) = read(path)
    assert (row.frame, row.original_length, row.payload, error) == (FRAME[:43], len(FRAME), b"h", "")


@pytest.mark.usefixtures("_sizes")
@pytest.mark.parametrize("orders", ["<>", "><", "<<", "<><"])
def test_sections_begin_anew(tmp_path, orders):
    path = tmp_path / "a"
    path.write_bytes(
        b"".join(
            section(order)
            + interface(order, 1 if index % 2 else 101)
            + enhanced(FRAME if index % 2 else RAW, 5, 0, order) * 30
            for index, order in enumerate(orders)
        )
    )
    rows, error = read(path)
    assert not error
    assert [row.number for row in rows] == list(range(1, 30 * len(orders) + 1))
    assert [row.link_type for row in rows] == [
        1 if index % 2 else 101 for index in range(len(orders)) for _ in range(30)
    ]
    assert {row.payload for row in rows} == {b"hello"}


@pytest.mark.parametrize(
    ("options", "ticks", "time_ns"),
    [
        ([], 1_500_000, 1_500_000_000),
        ([(RESOLUTION, b"\x09")], 1_500_000, 1_500_000),
        ([(RESOLUTION, b"\x0c")], 1_999, 1),
        ([(RESOLUTION, b"\x00")], 3, 3_000_000_000),
        ([(RESOLUTION, b"\x8a")], 1536, 1_500_000_000),
        ([(OFFSET, struct.pack("<q", 100))], 1, 100_000_001_000),
        ([(2, b"eth0"), (RESOLUTION, b"\x03"), (OFFSET, struct.pack("<q", -1))], 2500, 1_500_000_000),
    ],
)
def test_time_scales(tmp_path, options, ticks, time_ns):
    path = tmp_path / "a"
    path.write_bytes(section() + interface(options=options) + enhanced(FRAME, ticks))
    assert read(path)[0][0].time_ns == time_ns


def test_info_knows_the_interfaces_in_front_of_the_packets(tmp_path):
    path = tmp_path / "a"
    path.write_bytes(
        section()
        + interface(snap_length=100)
        + interface(snap_length=200, options=[(RESOLUTION, b"\x09")])
        + enhanced(FRAME)
    )
    with closing(open_file(path)) as source:
        info = source.info
    assert (info.name, info.kind, info.time_resolution_ns, info.snap_length) == (str(path), "pcapng", 1, 200)


@pytest.mark.quick("default-*")
@pytest.mark.usefixtures("_sizes")
@pytest.mark.parametrize("name", ["a_rover", "e_ci_errors"])
def test_editcap_and_scapy_agree_on_real_captures(tmp_path, name):
    editcap = shutil.which("editcap")
    assert editcap, "the suite needs editcap, which comes with tshark: apt install tshark"
    path = tmp_path / "a.pcapng"
    subprocess.run(
        [editcap, "-F", "pcapng", CAPTURES / f"{name}.pcap", path], check=True, capture_output=True
    )
    rows, error = read(path)
    with RawPcapNgReader(str(path)) as reader:
        theirs = [(frame, (meta.tshigh << 32 | meta.tslow) * 1000, meta.wirelen) for frame, meta in reader]
    assert not error
    assert [(row.frame, row.time_ns, row.original_length) for row in rows] == theirs
    assert rows == [*read(CAPTURES / f"{name}.pcap")[0]]


def test_a_file_by_scapy(tmp_path):
    path = tmp_path / "a.pcapng"
    wrpcapng(str(path), [Ether(FRAME)] * 3)
    assert [row.payload for row in read(path)[0]] == [b"hello"] * 3


@pytest.mark.each(2)
@pytest.mark.usefixtures("_sizes")
def test_a_file_cut_anywhere_gives_all_whole_blocks_first(tmp_path):
    path = tmp_path / "a.pcapng"
    head = section() + interface()
    size = len(enhanced(FRAME))
    whole = head + enhanced(FRAME) * 12
    for kept in every(7, range(len(section()), len(whole))):
        path.write_bytes(whole[:kept])
        rows, error = read(path)
        count, rest = divmod(max(kept - len(head), 0), size)
        assert len(rows) == count
        assert bool(error) == bool(rest or len(section()) < kept < len(head))
        if rest:
            assert f"ends inside the block of record {count + 1} at byte {len(head) + count * size};" in error


def broken(at, value):
    damaged = bytearray(enhanced(FRAME))
    struct.pack_into("<I", damaged, at, value)
    return bytes(damaged)


@pytest.mark.usefixtures("_sizes")
@pytest.mark.parametrize(
    ("bad", "what"),
    [
        (broken(4, 0), "claims a length of 0 bytes"),
        (broken(4, 8), "claims a length of 8 bytes"),
        (broken(4, 0xFFFFFFF0), "claims a length of 4294967280 bytes"),
        (broken(4, 61), "claims a length of 61 bytes"),
        (broken(4, 28), "claims a length of 28 bytes"),
        (broken(len(enhanced(FRAME)) - 4, 4), "has two lengths that differ"),
        (broken(20, 10_000), "claims a frame of 10000 bytes"),
        (enhanced(FRAME, number=1), "uses an interface that the section does not describe"),
        (section(version=(2, 0)), "is pcapng 2.0, which is not supported"),
    ],
)
def test_damage_is_named_after_all_before_it(tmp_path, bad, what):
    path = tmp_path / "a.pcapng"
    good = section() + interface() + enhanced(FRAME) * 16
    path.write_bytes(good + bad + enhanced(FRAME) * 40)
    rows, error = read(path)
    assert len(rows) == 56
    assert what in error
    assert f"record 17 at byte {len(good)}" in error
    assert error.startswith(f"{path}: ")
    assert "16 packets before it were read, and 40 after it; " in error
    assert error.endswith(" bytes were left out")


def test_a_packet_without_any_interface(tmp_path):
    path = tmp_path / "a.pcapng"
    path.write_bytes(section() + simple(FRAME))
    assert "does not describe" in read(path)[1]


@pytest.mark.parametrize("content", [section()[:13], section()[:8] + bytes(20), section(version=(9, 0))])
def test_a_first_section_header_that_cannot_be_read(tmp_path, content):
    path = tmp_path / "a.pcapng"
    path.write_bytes(content)
    with pytest.raises(CaptureError, match="section"):
        open_file(path)


@pytest.mark.long
@pytest.mark.usefixtures("_sizes")
@settings(max_examples=examples(40, 4))
@given(data=st.data())
def test_payloads_that_imitate_blocks_change_nothing(tmp_path_factory, data):
    decoys = [
        enhanced(b"decoy" * 5),
        simple(b"x"),
        section(),
        section(">"),
        struct.pack("<III", 6, 32, 6) * 4,
    ]
    payloads = st.one_of(st.binary(max_size=30), st.sampled_from(decoys), st.integers(0, 300).map(bytes))
    frames = [
        bytes(RAW[:2])
        + struct.pack(">H", 28 + len(payload))
        + RAW[4:24]
        + struct.pack(">HH", 8 + len(payload), 0)
        + payload
        for payload in data.draw(st.lists(payloads, max_size=60))
    ]
    order = data.draw(st.sampled_from("<>"))
    path = tmp_path_factory.mktemp("pcapng") / "a"
    path.write_bytes(
        section(order) + interface(order, 101) + b"".join(enhanced(frame, 7, 0, order) for frame in frames)
    )
    rows, error = read(path)
    assert ([row.frame for row in rows], error) == (frames, "")


@given(
    st.lists(
        st.one_of(
            st.binary(max_size=60),
            st.sampled_from(
                [
                    section(),
                    section(">"),
                    interface(),
                    interface(">"),
                    enhanced(FRAME),
                    enhanced(FRAME, order=">"),
                    simple(FRAME),
                    obsolete(FRAME),
                    broken(4, 64),
                    interface(options=[(RESOLUTION, b"\xff")]),
                    interface()[:-4],
                ]
            ),
        ),
        max_size=12,
    ).map(b"".join)
)
def test_garbage_behind_a_section_header(tmp_path_factory, content):
    path = tmp_path_factory.mktemp("garbage") / "a"
    path.write_bytes(section() + content)
    with suppress(CaptureError), closing(open_file(path)) as source:
        for batch in source.batches():
            assert len(batch)


SECONDS = 1_700_000_000


@given(
    st.sampled_from([2, 10]),
    st.integers(0, 63),
    st.integers(0, SECONDS),
    st.fractions(0, 1),
    st.integers(-1000, 1000),
)
def test_exact_for_every_resolution(base, exponent, seconds, fraction, offset):
    ticks = int((seconds + fraction) * base**exponent) % 2**64
    expected = ticks * 10**9 // base**exponent + offset * 10**9
    scale = TimeScale(exponent, base, offset)
    assert scale.to_ns(np.array([ticks], dtype=np.uint64)).tolist() == [expected]


@given(st.sampled_from([2, 10]), st.integers(0, 127), st.integers(0, 2**64 - 1))
def test_nothing_raises(base, exponent, ticks):
    TimeScale(exponent, base).to_ns(np.array([ticks], dtype=np.uint64))


@pytest.mark.parametrize(
    ("scale", "resolution"),
    [
        (TimeScale(), 1000),
        (TimeScale(9), 1),
        (TimeScale(12), 1),
        (TimeScale(3), 10**6),
        (TimeScale(10, 2), 976562),
    ],
)
def test_resolution(scale, resolution):
    assert scale.resolution_ns == resolution


def batch_of(frames, times, link_types, original):
    count = len(frames)
    lengths = np.array([len(frame) for frame in frames], dtype=np.int32)
    none = np.zeros(count, dtype=np.int64)
    return PacketBatch(
        data=np.frombuffer(b"".join(frames), dtype=np.uint8),
        number=np.arange(1, count + 1),
        time_ns=np.array(times, dtype=np.int64),
        link_type=np.array(link_types, dtype=np.uint16),
        frame_offset=np.cumsum(lengths, dtype=np.int64) - lengths,
        frame_length=lengths,
        original_length=np.array(original, dtype=np.int32),
        offset=none,
        length=none.astype(np.int32),
        source_address=none.astype(np.uint32),
        source_port=none.astype(np.uint16),
        destination_address=none.astype(np.uint32),
        destination_port=none.astype(np.uint16),
        ip_version=none.astype(np.uint8),
        capture_findings=none.astype(np.uint32),
    )


@given(
    st.lists(
        st.tuples(
            st.binary(max_size=40),
            st.integers(0, 2**63 - 1),
            st.sampled_from([1, 101, 276]),
            st.integers(0, 9),
        ),
        min_size=1,
        max_size=20,
    ),
    st.booleans(),
)
def test_scapy_reads_what_was_written(tmp_path_factory, drawn, nanosecond):
    path = tmp_path_factory.mktemp("sink") / "a.pcapng"
    frames, times, link_types, more = zip(*drawn, strict=True)
    original = [len(frame) + extra for frame, extra in zip(frames, more, strict=True)]
    batch = batch_of(frames, times, link_types, original)
    sink = PcapngSink(path, nanosecond=nanosecond, snap_length=500)
    sink.write(batch.take(slice(5)), None)
    sink.write(batch.take(slice(5, None)), None)
    sink.close(SourceStatistics())
    unit, resolution = (1, 10**9) if nanosecond else (1000, 10**6)
    with RawPcapNgReader(str(path)) as reader:
        theirs = list(reader)
    assert [
        (frame, meta.tshigh << 32 | meta.tslow, meta.linktype, meta.wirelen, meta.tsresol)
        for frame, meta in theirs
    ] == [
        (frame, time // unit, link_type, length, resolution)
        for frame, time, link_type, length in zip(frames, times, link_types, original, strict=True)
    ]


@pytest.mark.parametrize("name", ["a_rover", "f_sbn_disconnect"])
@pytest.mark.parametrize("nanosecond", [True, False])
def test_a_real_capture_comes_back_whole(tmp_path, name, nanosecond):
    path, copied = CAPTURES / f"{name}.pcap", tmp_path / "a.pcapng"
    with closing(open_file(path)) as source:
        sink = PcapngSink(copied, nanosecond=nanosecond)
        before = concatenate(list(source.batches()))
        sink.write(before, None)
        sink.close(source.statistics)
    with closing(open_file(copied)) as source:
        after = concatenate(list(source.batches()))
        assert source.info.time_resolution_ns == (1 if nanosecond else 1000)
    assert list(after) == list(before)


def test_tshark_reads_what_was_written(tmp_path):
    tshark = shutil.which("tshark")
    assert tshark, "the suite needs tshark: apt install tshark"
    path = tmp_path / "a.pcapng"
    with closing(open_file(CAPTURES / "e_ci_errors.pcap")) as source:
        sink = PcapngSink(path)
        for batch in source.batches():
            sink.write(batch, None)
        sink.close(source.statistics)
    fields = ["-T", "fields", "-e", "frame.time_epoch", "-e", "frame.len", "-e", "udp.payload"]
    ours, theirs = (
        subprocess.run([tshark, "-r", str(file), *fields], capture_output=True, text=True, check=True).stdout
        for file in (path, CAPTURES / "e_ci_errors.pcap")
    )
    assert ours == theirs
    assert ours.count("\n") == 1377


def test_a_capture_without_packets(tmp_path):
    sink = PcapngSink(tmp_path / "a.pcapng")
    sink.close()
    sink.close()
    with closing(open_file(tmp_path / "a.pcapng")) as source:
        assert list(source.batches()) == []


@pytest.mark.parametrize("drops", [None, 0, 1 << 40])
def test_what_was_lost_is_told_at_the_end(tmp_path, drops):
    path = tmp_path / "a.pcapng"
    sink = PcapngSink(path)
    sink.write(batch_of([b"x" * 60], [5 << 33], [1], [60]))
    sink.close(SourceStatistics(kernel_drops=drops))
    with closing(open_file(path)) as source:
        assert len(list(source.batches())) <= 1
        assert source.statistics.kernel_drops == drops
    with RawPcapNgReader(str(path)) as other:
        assert [bytes(data) for data, _ in other] == [b"x" * 60]


def test_a_time_before_1970():
    sink = PcapngSink(io.BytesIO())
    with pytest.raises(CaptureError, match="a time before 1970 does not fit pcapng"):
        sink.write(batch_of([b"x"], [-1], [1], [1]))


def test_a_path_that_cannot_be_written(tmp_path):
    with pytest.raises(CaptureError, match="cannot be created: Is a directory"):
        PcapngSink(tmp_path)


def test_a_comment_is_read_by_tshark_and_changes_no_packet(tmp_path):
    program = shutil.which("capinfos")
    plain, told = tmp_path / "plain.pcapng", tmp_path / "told.pcapng"
    with closing(open_file(CAPTURES / "a_rover.pcap")) as source:
        batches = list(source.batches())
    for path, comment in ((plain, ""), (told, "edoras record --listen 5234 5235")):
        with closing(PcapngSink(path, comment=comment)) as sink:
            for batch in batches:
                sink.write(batch)
    with RawPcapNgReader(str(told)) as one, RawPcapNgReader(str(plain)) as other:
        assert list(one) == list(other)
    with closing(open_file(told)) as source:
        assert source.info.read_with == {"listened": "5234 5235"}
    if program:
        said = subprocess.run([program, "-k", told], capture_output=True, text=True, check=True).stdout
        assert "edoras record --listen 5234 5235" in said

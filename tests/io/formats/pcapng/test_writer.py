from __future__ import annotations

import io
import shutil
import subprocess
from contextlib import closing

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from places import CAPTURES
from scapy.utils import RawPcapNgReader

from edoras_tools.errors import CaptureError
from edoras_tools.io.formats.open import open_file
from edoras_tools.io.formats.pcapng.writer import PcapngSink
from edoras_tools.model import PacketBatch, SourceStatistics, concatenate


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

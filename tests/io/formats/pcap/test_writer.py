from __future__ import annotations

import io
import os
from contextlib import closing

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace
from places import CAPTURES
from scapy.utils import RawPcapReader

from edoras_tools.errors import CaptureError
from edoras_tools.io.formats.open import open_file
from edoras_tools.io.formats.pcap.writer import PcapSink
from edoras_tools.model import PacketBatch, SourceStatistics


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

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from places import CAPTURES

from edoras_tools.errors import CaptureError
from edoras_tools.io import SourceDefaults
from edoras_tools.io.formats.merge import merge_sources
from edoras_tools.io.formats.open import open_file
from edoras_tools.io.frames.frame_batch import FrameBatch
from edoras_tools.io.frames.linklayer import demux
from edoras_tools.model import SourceInfo, SourceStatistics


class Listed(SourceDefaults):
    """A source of given times; the payload of a datagram is its name and place."""

    def __init__(self, name, batches, error=None, version=4):
        self.info = SourceInfo(name, "pcap", 1000)
        self.statistics = SourceStatistics(frames=sum(map(len, batches)), warnings=[f"{name} warns"])
        self._batches, self._error, self._version = batches, error, version
        self.closed = False

    def _frame(self, place):
        payload = f"{self.info.name}{place}".encode()
        ports = b"\0\1\0\2" + (8 + len(payload)).to_bytes(2, "big") + b"\0\0"
        if self._version == 6:
            addresses = self.info.name.encode().ljust(16, b"\1") * 2
            return (
                b"\x60\0\0\0"
                + (8 + len(payload)).to_bytes(2, "big")
                + b"\x11\x40"
                + addresses
                + ports
                + payload
            )
        return (
            b"\x45\0"
            + (28 + len(payload)).to_bytes(2, "big")
            + bytes(5)
            + b"\x11"
            + bytes(10)
            + ports
            + payload
        )

    def batches(self):
        place = 0
        for times in self._batches:
            frames = [self._frame(place + index) for index in range(len(times))]
            place += len(times)
            length = np.array([len(frame) for frame in frames], dtype=np.int32)
            yield demux(
                FrameBatch(
                    data=np.frombuffer(b"".join(frames), dtype=np.uint8),
                    number=np.arange(len(times)),
                    time_ns=np.array(times, dtype=np.int64),
                    link_type=np.full(len(times), 101, dtype=np.uint16),
                    offset=np.cumsum(length, dtype=np.int64) - length,
                    length=length,
                    original_length=length,
                )
            )
        if self._error:
            raise CaptureError(self._error)

    def close(self):
        self.closed = True


def rows_of(source):
    return [row for batch in source.batches() for row in batch]


def expected(lists):
    """Times that never run backwards within a source, sorted; the source named first wins."""
    keyed = []
    for index, batches in enumerate(lists):
        times = [time for times in batches for time in times]
        for place, key in enumerate(np.maximum.accumulate(times).tolist() if times else []):
            keyed.append((key, index, place, times[place]))
    return [(f"{'ABCD'[index]}{place}".encode(), time) for _, index, place, time in sorted(keyed)]


@given(
    st.lists(
        st.lists(st.lists(st.integers(0, 30), min_size=1, max_size=6), max_size=5), min_size=1, max_size=4
    ),
    st.booleans(),
)
def test_order_of_time_and_of_each_source(lists, nearly_sorted):
    if nearly_sorted:
        lists = [
            [[time + 10 * index for time in times] for index, times in enumerate(batches)]
            for batches in lists
        ]
    sources = [
        Listed("ABCD"[index], batches, version=6 if index % 2 else 4) for index, batches in enumerate(lists)
    ]
    rows = rows_of(merge_sources(sources))
    assert [(row.payload, row.time_ns) for row in rows] == expected(lists)
    if len(sources) > 1:
        assert [row.number for row in rows] == list(range(1, len(rows) + 1))
    assert all(row.source.address.startswith("42") for row in rows if row.payload[:1] == b"B")


def test_one_source_is_itself():
    source = Listed("A", [[1]])
    assert merge_sources([source]) is source


def test_an_error_waits_for_the_other_sources():
    merged = merge_sources(
        [Listed("A", [[1, 5]], "A: ends early"), Listed("B", [[2, 9], [10]]), Listed("C", [], "C: gone")]
    )
    times = []
    with pytest.raises(CaptureError) as caught:  # noqa: PT012  the times before the error count
        for batch in merged.batches():
            times += batch.time_ns.tolist()
    assert str(caught.value) == "C: gone; A: ends early"
    assert times == [1, 2, 5, 9, 10]
    assert merged.statistics.frames == 5


def test_what_is_known_of_all_together():
    sources = [Listed("A", [[1]]), Listed("B", [[2, 3]])]
    merged = merge_sources(sources)
    assert (merged.info.name, merged.info.kind, merged.info.time_resolution_ns) == ("A, B", "pcap", 1000)
    assert merged.statistics.frames == 3
    assert merged.statistics.warnings == ["A warns", "B warns"]
    for drops, told in (([None, None], None), ([0, None], None), ([3, None], 3), ([0, 0], 0), ([3, 4], 7)):
        for source, count in zip(sources, drops, strict=True):
            source.statistics.kernel_drops = count
        assert merged.statistics.kernel_drops == told
    merged.close()
    assert all(source.closed for source in sources)


def test_real_captures():
    paths = sorted(CAPTURES.glob("*.pcap"))
    alone = [rows_of(open_file(path)) for path in paths]
    rows = rows_of(merge_sources([open_file(path) for path in paths]))
    assert len(rows) == sum(map(len, alone))
    assert all(first.time_ns <= second.time_ns for first, second in pairwise(rows))
    assert sorted(row.frame for row in rows) == sorted(row.frame for part in alone for row in part)

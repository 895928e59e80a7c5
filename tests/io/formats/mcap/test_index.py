from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from mcap.data_stream import RecordBuilder
from mcap.records import MessageIndex as Record

from edoras_tools.io.formats.mcap.index import MessageIndex

TIMES = st.integers(0, 2**63 - 1)
SIZE = 7


@given(
    st.lists(
        st.tuples(
            st.integers(1, 4) | st.none(),
            st.lists(st.tuples(st.integers(1, 4), TIMES), min_size=1, max_size=6),
        ),
        max_size=5,
    ),
    st.integers(1, 100),
)
def test_the_records_are_those_of_the_library(pieces, limit):
    """Whatever is added, in chunks of whatever size: each has just its own messages, and none is too long."""
    index = MessageIndex()
    added = []
    for one, messages in pieces:
        channels = [channel if one is None else one for channel, _ in messages]
        times = [time_ns for _, time_ns in messages]
        positions = [SIZE * (len(added) + place) for place in range(len(messages))]
        added += zip(channels, times, positions, strict=True)
        index.add(np.array(channels, np.uint16) if one is None else one, np.array(times), np.array(positions))
    size = SIZE * len(added)
    chunks = list(index.divide(size, limit))
    assert [chunk.start for chunk in chunks] == [0, *(chunk.end for chunk in chunks[:-1])]
    assert chunks[-1].end == size
    assert all(chunk.end - chunk.start < limit + SIZE for chunk in chunks)
    for chunk in chunks:
        expected = {}
        for channel, time_ns, position in added:
            if chunk.start <= position < chunk.end:
                expected.setdefault(channel, []).append((time_ns, position - chunk.start))
        places = dict(chunk.places.tolist())
        builder = RecordBuilder()
        for channel, entries in sorted(expected.items()):
            assert places[channel] == builder.count
            Record(channel, entries).write(builder)
        assert bytes(chunk.records) == builder.end()
        assert chunk.counts == {channel: len(entries) for channel, entries in expected.items()}
        every = [time_ns for entries in expected.values() for time_ns, _ in entries]
        assert (chunk.start_ns, chunk.end_ns) == (min(every, default=0), max(every, default=0))

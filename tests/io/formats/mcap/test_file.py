from __future__ import annotations

from collections import Counter
from itertools import pairwise

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from mcap.data_stream import RecordBuilder
from mcap.records import MessageIndex as Record

from edoras_tools.io.formats.mcap.file import MessageIndex

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
    chunks = index.divide(size, limit)
    edges = chunks.edges.tolist()
    assert (edges[0], edges[-1]) == (0, size)
    assert all(end - start < limit + SIZE for start, end in pairwise(edges))
    for at, (start, end) in enumerate(pairwise(edges)):
        expected = {}
        for channel, time_ns, position in added:
            if start <= position < end:
                expected.setdefault(channel, []).append((time_ns, position - start))
        places = dict(chunks.places[slice(*chunks.place_edges[at : at + 2])].tolist())
        assert list(places) == sorted(expected)
        builder = RecordBuilder()
        for channel, entries in sorted(expected.items()):
            assert places[channel] == builder.count
            Record(channel, entries).write(builder)
        assert chunks.records[slice(*chunks.record_edges[at : at + 2])].tobytes() == builder.end()
        every = [time_ns for entries in expected.values() for time_ns, _ in entries]
        assert chunks.start_ns[at] == min(every, default=0)
        assert chunks.end_ns[at] == max(every, default=0)
    assert chunks.counts == dict(sorted(Counter(channel for channel, _, _ in added).items()))

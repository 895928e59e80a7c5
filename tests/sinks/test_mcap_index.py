"""MessageIndex records: as the mcap library writes them, whatever order messages come in."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from mcap.data_stream import RecordBuilder
from mcap.records import MessageIndex as Record

from edoras_tools.sinks.mcap_index import MessageIndex

TIMES = st.integers(0, 2**63 - 1)


@given(
    st.lists(
        st.tuples(
            st.integers(1, 4) | st.none(),
            st.lists(st.tuples(st.integers(1, 4), TIMES), min_size=1, max_size=6),
        ),
        max_size=5,
    )
)
def test_the_records_are_those_of_the_library(pieces):
    index = MessageIndex()
    expected = {}
    position = 0
    for one, messages in pieces:
        channels, times, positions = [], [], []
        for channel, time_ns in messages:
            channels.append(channel if one is None else one)
            times.append(time_ns)
            positions.append(position)
            expected.setdefault(channels[-1], []).append((time_ns, position))
            position += 7
        index.add(np.array(channels, np.uint16) if one is None else one, np.array(times), np.array(positions))
    records, places = index.records()
    builder = RecordBuilder()
    for channel, entries in sorted(expected.items()):
        assert places[channel] == builder.count
        Record(channel, entries).write(builder)
    assert b"".join(bytes(record) for record in records) == builder.end()
    assert index.counts == {channel: len(entries) for channel, entries in expected.items()}
    every = [time_ns for entries in expected.values() for time_ns, _ in entries]
    assert (index.start_ns, index.end_ns) == (min(every, default=0), max(every, default=0))

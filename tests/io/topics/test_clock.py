from __future__ import annotations

from types import SimpleNamespace
from unittest import mock

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from edoras_tools.io.topics import clock as module
from edoras_tools.io.topics.clock import MissionClock

SECOND = 1_000_000_000
NOW = 1_795_000_000 * SECOND


def rows(*packets):
    """Packets as (link, processor, capture time, mission time)."""
    link, processor, captured, mission = zip(*packets, strict=True) if packets else ((), (), (), ())
    columns = SimpleNamespace(
        link=np.array(link, dtype=np.uint8),
        processor_id=np.array(processor, dtype=np.uint32),
        mission_time_ns=np.array(mission, dtype=np.int64),
    )
    return np.array(captured, dtype=np.int64), columns


def one_by_one(packets):
    """The rule, a packet at a time."""
    state, published = {}, []
    for link, processor, captured, mission in packets:
        if mission <= 0:
            published.append(captured)
            continue
        offset = captured - mission
        least, last = state.get((link, processor), (offset, offset))
        least = offset if abs(offset - last) > 5 * SECOND else min(least, offset)
        state[link, processor] = least, offset
        published.append(mission + least)
    return published


PACKETS = st.lists(
    st.tuples(
        st.sampled_from([2, 3]),
        st.sampled_from([0, 1, 70_000]),
        st.integers(0, 20 * SECOND).map(lambda value: NOW + value),
        st.one_of(st.just(-1), st.just(0), st.integers(1, 20 * SECOND).map(lambda value: 10**15 + value)),
    ),
    max_size=30,
)


@given(PACKETS, st.integers(0, 30), st.sampled_from([0, 128]))
def test_columns_follow_the_rule_however_the_packets_are_cut_into_batches(packets, cut, few):
    clock = MissionClock()
    parts = packets[:cut], packets[cut:]
    with mock.patch.object(module, "_FEW", few):
        published = [time for part in parts for time in clock.publish_times(*rows(*part)).tolist()]
    assert published == one_by_one(packets)


def test_delay_does_not_move_the_offset_and_a_restart_does():
    clock = MissionClock()
    packets = [(2, 0, NOW, 1000 * SECOND), (2, 0, NOW + 9 * SECOND // 10, 1000 * SECOND + SECOND // 2)]
    assert clock.publish_times(*rows(*packets)).tolist() == [NOW, NOW + SECOND // 2]
    assert clock.offsets() == {"to/0": NOW - 1000 * SECOND}
    assert clock.publish_times(*rows((2, 0, NOW + 60 * SECOND, SECOND))).tolist() == [NOW + 60 * SECOND]
    assert clock.offsets() == {"to/0": NOW + 59 * SECOND}


def test_no_packet_is_published_after_it_was_captured():
    random = np.random.default_rng(5)
    captured = NOW + np.cumsum(random.integers(0, SECOND, 1000))
    packets = [(2, 0, time, time - NOW + random.integers(0, SECOND)) for time in captured.tolist()]
    times, columns = rows(*packets)
    assert (MissionClock().publish_times(times, columns) <= times).all()

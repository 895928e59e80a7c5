"""More datagrams at once than SBN reads: what its socket drops is in no counter."""

from __future__ import annotations

import struct

import pytest

FIRST_S, STEP_S = 10.0, 0.0001
READ = 100
STATE = 0x1829


def burst(lab, msg_id, number):
    """Return SBN datagrams of one robot's poses, all different, one every 0.1 ms."""
    sent, _ = lab.simulate("two-rovers", seconds=20, hz=2.0, state_hz=4.0)
    like = next(item for item in sent if msg_id(item) == STATE and item.destination == lab.cfs)
    size = 56  # seven doubles: position and orientation
    return [
        like._replace(
            time_ns=lab.start_ns + int((FIRST_S + at * STEP_S) * 1e9),
            payload=like.payload[:-size] + struct.pack("<d", 1000.0 + at) + like.payload[8 - size :],
        )
        for at in range(number)
    ]


@pytest.mark.quick("*60*")
@pytest.mark.parametrize("dropped", [0, 60, 200])
def test_what_did_not_come_out_beyond_what_it_reads_is_lost_in_its_socket(lab, msg_id, dropped):
    items = burst(lab, msg_id, READ + dropped)
    feeds = tuple((FIRST_S + at * STEP_S, 2234, item.payload) for at, item in enumerate(items[:READ]))
    sent, counters = lab.simulate("two-rovers", seconds=20, hz=2.0, state_hz=4.0, feeds=feeds)
    found = lab.examine(lab.merged(sent, *items), lab.missions("two-rovers"))
    assert [row for row in found.balance if not row.adds_up] == []
    full = sum(row.lost.get("sbn_socket", 0) for row in found.balance)
    assert full == dropped
    assert found.lost == counters.msg_limits + counters.pipe_overflows + dropped
    assert found.unaccounted == 0

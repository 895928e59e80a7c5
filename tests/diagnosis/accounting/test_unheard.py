"""What cFS sends to an SBN peer that is silent: lost when it is given up, unaccounted while nobody knows."""

from __future__ import annotations

import pytest

from edoras_tools.wire import sbn

DEAD_S, GIVEN_UP_S = 15, 11
BRIDGE, CFS = 2236, 2234


def silent(lab, seconds):
    """Return datagrams whose bridge is dead from some time on, and how much it was sent after that."""
    sent, _ = lab.simulate("two-rovers", seconds=DEAD_S + seconds, hz=2.0)
    dead_ns = lab.start_ns + DEAD_S * 10**9
    given_up_ns = dead_ns + GIVEN_UP_S * 10**9
    kept = [
        item
        for item in sent
        if not (item.source.port == BRIDGE and item.time_ns > dead_ns)
        and not (item.destination.port == BRIDGE and item.time_ns > given_up_ns)
    ]
    last_ns = max(item.time_ns for item in kept if item.source.port == BRIDGE)
    end_ns = max(item.time_ns for item in kept)
    app = [
        item
        for item in kept
        if item.destination.port == BRIDGE
        and item.payload[2] == sbn.MsgType.APP
        and last_ns < item.time_ns < end_ns
    ]
    return kept, len(app)


@pytest.mark.parametrize(("seconds", "known"), [(9, False), (20, True)])
def test_none_of_it_is_said_to_have_arrived(lab, seconds, known):
    kept, unheard = silent(lab, seconds)
    assert unheard > 10
    found = lab.examine(kept, lab.missions("two-rovers"))
    assert [row for row in found.balance if not row.adds_up] == []
    peer = [row for row in found.balance if row.hop == "SBN peer 66:3"]
    assert sum(row.all_lost for row in peer) == (unheard if known else 0)
    assert sum(row.unaccounted for row in peer) == (0 if known else unheard)
    lines = [item for item in found.headlines if item.topic.endswith("cmd_vel") and item.arrived is not None]
    onward = [item for item in lines if not item.topic.endswith("ground/cmd_vel")]
    assert len(onward) == 2
    for line in onward:
        assert line.sent == line.arrived + line.lost + line.unaccounted + line.waiting + line.not_captured
    assert sum(line.lost + line.unaccounted for line in onward) == unheard
    (verdict,) = [item for item in found.verdicts if item.rule == "sbn_timeout"]
    assert (verdict.lost, verdict.of) == (unheard if known else None, unheard)

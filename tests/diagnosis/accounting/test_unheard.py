"""What cFS sends to an SBN peer that is silent: lost when it is given up, unaccounted while nobody knows."""

from __future__ import annotations

import pytest

from edoras_tools.model import Peer
from edoras_tools.wire import sbn
from tests.support.balance import arrived, ended, wrong_rows

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


@pytest.mark.each(2)
@pytest.mark.parametrize(("seconds", "known"), [(9, False), (20, True)])
def test_none_of_it_is_said_to_have_arrived(lab, seconds, known):
    kept, unheard = silent(lab, seconds)
    assert unheard > 10
    found = lab.examine(kept, lab.missions("two-rovers"))
    assert wrong_rows(found.balance) == []
    peer = [row for row in found.balance if row.hop == "SBN peer 66:3"]
    proven, early = (sum(getattr(row, name) for row in peer) for name in ("all_lost", "uncertain"))
    assert proven + early == unheard
    assert early <= 2 if known else not proven  # what came before its next datagram was due, or may have come
    assert not sum(row.unaccounted for row in peer)
    lines = [item for item in found.headlines if item.topic.endswith("cmd_vel") and arrived(item) is not None]
    onward = [item for item in lines if not item.topic.endswith("ground/cmd_vel")]
    assert len(onward) == 2
    for line in onward:
        ends = ended(line)
        left = ends["waiting"] + ends["not_captured"] + ends["uncertain"]
        assert line.sent == arrived(line) + line.missing + left
    assert sum(line.missing for line in onward) == unheard - early
    (verdict,) = [item for item in found.verdicts if item.rule == "sbn_timeout"]
    assert (verdict.lost, verdict.of) == (proven if known else None, unheard)


def restarted(lab, *, repeats):
    """Return datagrams whose bridge is dead for 4 s, and how many it was sent from its next one on.

    Args:
        repeats: whether the bridge repeats its SUBs and answers all that it is sent, as the public one does.
    """
    sent, _ = lab.simulate("two-rovers", seconds=30, hz=2.0)
    dead_ns, back_ns = (lab.start_ns + at * 10**9 for at in (15, 19))
    kept = [
        item
        for item in sent
        if item.source.port != BRIDGE
        or (
            not dead_ns < item.time_ns < back_ns
            and (repeats or item.payload[2] == sbn.MsgType.APP or item.time_ns < lab.start_ns + 10**9)
        )
    ]
    asks = sbn.emit_subscriptions([sbn.Subscription(0x82A), sbn.Subscription(0x82B)])
    again = sbn.emit(sbn.MsgType.SUB, Peer(0x42, 3), asks)
    first = min(item.time_ns for item in kept if item.source.port == BRIDGE and item.time_ns >= back_ns)
    kept = lab.merged(kept, lab.at((first - lab.start_ns) / 10**9 - 0.001, lab.bridge, lab.cfs, again))
    app = [
        item.time_ns
        for item in kept
        if item.destination.port == BRIDGE and item.payload[2] == sbn.MsgType.APP
    ]
    return (
        kept,
        sum(dead_ns < when < first for when in app),
        sum(dead_ns + 10**9 < when < first for when in app),
    )


@pytest.mark.quick("True")
@pytest.mark.parametrize("repeats", [False, True])
def test_what_a_peer_was_sent_that_started_again_before_it_was_given_up(lab, repeats):
    kept, most, least = restarted(lab, repeats=repeats)
    found = lab.examine(kept, lab.missions("two-rovers"))
    assert wrong_rows(found.balance) == []
    lost = sum(row.lost.get("sbn_peer_restart", 0) for row in found.balance)
    assert 4 < least <= lost <= most == lost + found.uncertain
    (verdict,) = [item for item in found.verdicts if item.rule == "sbn_peer_restart"]
    assert (verdict.lost, verdict.of) == (lost, most)


def test_a_peer_that_paused_and_then_answered_all_was_not_started_again(lab):
    """A slow network holds its datagrams back: they come in one burst."""
    sent, _ = lab.simulate("two-rovers", seconds=30, hz=2.0)
    held_ns, until_ns = (lab.start_ns + at * 10**9 for at in (15, 19))
    kept = [
        item._replace(time_ns=until_ns + place)
        if item.source.port == BRIDGE and held_ns < item.time_ns < until_ns
        else item
        for place, item in enumerate(sent)
    ]
    found = lab.examine(sorted(kept, key=lambda item: item.time_ns), lab.missions("two-rovers"))
    assert "sbn_peer_restart" not in {item.rule for item in found.verdicts}
    assert found.lost == 0

"""SBN connections as each cFS sees them: a peer that it said DISCONNECT to is not connected."""

from __future__ import annotations

import pytest
from places import ROOT

from edoras_tools.diagnosis.evidence.peers import SAID_GOODBYE
from edoras_tools.model import Peer
from edoras_tools.wire import sbn

CFS = Peer(0x42, 1)


def states(found):
    (row,) = found.peers
    return [(item["state"], item["time_ns"]) for item in row["states"]]


def test_after_a_failed_reload_the_peer_is_not_connected(lab):
    found = lab.read(ROOT / "tests/captures/f2_sbn_announce_reload.pcap.zst")
    (row,) = found.peers
    assert [item["state"] for item in row["states"]] == ["connected", "disconnected"]
    assert row["states"][-1]["why"] == SAID_GOODBYE
    goodbye = [item for item in found.verdicts if item.rule == "sbn_disconnected"]
    assert [item.start_ns for item in goodbye] == [row["states"][-1]["time_ns"]]


@pytest.mark.long("goes on later")
@pytest.mark.parametrize(
    ("answers", "expected"),
    [
        (lambda seconds: True, ["connected", "disconnected", "connected"]),
        (lambda seconds: seconds > 15, ["connected", "disconnected", "connected"]),
        (lambda seconds: False, ["connected", "disconnected"]),
    ],
    ids=["goes on at once", "goes on later", "sends nothing more"],
)
def test_it_is_connected_again_when_cfs_sends_to_it_again(lab, answers, expected):
    sent, _ = lab.simulate("two-rovers", seconds=25)
    goodbye = lab.at(10, lab.cfs, lab.bridge, sbn.emit(sbn.MsgType.DISCONNECT, CFS, b""))
    kept = [
        item
        for item in sent
        if item.source != lab.cfs
        or item.time_ns < goodbye.time_ns
        or answers((item.time_ns - lab.start_ns) / 1e9)
    ]
    found = states(lab.examine(lab.merged(kept, goodbye), lab.missions("two-rovers")))
    assert [state for state, _ in found] == expected
    assert found[1][1] == goodbye.time_ns
    if len(expected) > 2 and not answers(12):
        assert found[2][1] == pytest.approx(lab.start_ns + 15e9, abs=1e9)

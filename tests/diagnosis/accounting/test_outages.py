"""Times in which the capturing interface was away: what is missing there is not captured, and not lost."""

from __future__ import annotations

from collections import Counter

import pytest
from places import ROOT

from edoras_tools.addons.lab.emulator import WireDatagram
from edoras_tools.io.formats.open import open_file
from edoras_tools.model import InterfaceOutage
from tests.support.balance import arrived, ended, wrong_rows

SECOND = 10**9
TO_PORT, ROBOT_PORT, TWIST = 1235, 8585, 0x1827


def without(items, start_ns, end_ns):
    return [item for item in items if not start_ns <= item.time_ns < end_ns]


def outage(start_ns, end_ns):
    return InterfaceOutage("eth0", "down", start_ns, end_ns)


def lost_by(found):
    return sum((Counter(row.lost) for row in found.balance), Counter())


@pytest.mark.quick("20-21")
@pytest.mark.parametrize(("start_s", "end_s"), [(20, 30), (20, 21), (5, 50)])
def test_telemetry_that_is_missing_then_is_not_captured(lab, start_s, end_s):
    sent, _ = lab.simulate("rover", seconds=60)
    start_ns, end_ns = (lab.start_ns + at * SECOND for at in (start_s, end_s))
    kept = without(sent, start_ns, end_ns)
    gone = sum(item.destination.port == TO_PORT for item in sent) - sum(
        item.destination.port == TO_PORT for item in kept
    )
    found = lab.examine(kept, lab.mission("rover_ground"), outages=[outage(start_ns, end_ns)])
    assert wrong_rows(found.balance) == []
    assert (found.lost, found.unaccounted) == (0, 0)
    behind = [row for row in found.balance if row.hop == "between cFS and the capture"]
    assert sum(row.not_captured for row in behind) == gone > 5
    assert {item.rule for item in found.verdicts} <= {"not_examined", "lost_before_ci"}
    # Nothing at all was captured then, though both sides sent: that shows it without the recorder's word.
    assert lab.examine(kept, lab.mission("rover_ground")).lost == 0


@pytest.mark.quick("33*")
@pytest.mark.parametrize(("start_s", "end_s"), [(20, 30), (33.3, 34.1), (2, 60)])
def test_commands_before_and_after_it_are_told_as_ever(lab, start_s, end_s):
    items = [
        WireDatagram(item.time_ns, item.source, item.destination, bytes(item.payload))
        for batch in open_file(ROOT / "tests/captures/a_rover.pcap.zst").batches()
        for item in batch
    ]
    start_ns, end_ns = (items[0].time_ns + int(at * SECOND) for at in (start_s, end_s))
    got = {item.payload for item in items if item.destination.port == ROBOT_PORT}
    never = [
        item.time_ns for item in items if item.payload[:2] == b"\x18\x27" and item.payload[-48:] not in got
    ]
    kept = without(items, start_ns, end_ns)
    found = lab.examine(kept, outages=[outage(start_ns, end_ns)])
    assert wrong_rows(found.balance) == []
    here = [when for when in never if not start_ns <= when < end_ns]
    far = [when for when in here if not start_ns - 3 * SECOND <= when < end_ns]
    assert len(far) <= lost_by(found)["limit"] + found.unaccounted <= len(here)
    # What nothing explains is of those that were not captured, or of which nobody saw whether they came out.
    assert lost_by(found)["unknown"] <= len(never) - len(far)
    assert set(lost_by(found)) <= {"limit", "unknown"}
    (line,) = [item for item in found.headlines if item.topic == "0x1827"]
    ends = ended(line)
    rest = ends.total() - ends["uncertain"] - ends["shared"]
    assert line.sent == arrived(line) + rest


@pytest.mark.each(2)
@pytest.mark.parametrize("away_s", [9, 14])
def test_a_peer_that_was_out_of_sight_meanwhile_did_not_time_out(lab, away_s):
    sent, _ = lab.simulate("two-rovers", seconds=50)
    start_ns, end_ns = lab.start_ns + 20 * SECOND, lab.start_ns + (20 + away_s) * SECOND
    kept = without(sent, start_ns, end_ns)
    found = lab.examine(kept, lab.missions("two-rovers"), outages=[outage(start_ns, end_ns)])
    assert found.lost == 0
    assert [item["state"] for item in found.peers[0]["states"]] == ["connected"]
    assert "sbn_timeout" not in {item.rule for item in found.verdicts}


@pytest.mark.parametrize(
    ("end_s", "said"),
    [
        (40, "eth0 was away 10.0 s: what was sent then is not examined"),
        (None, "eth0 is away: what has been sent since is not examined"),
    ],
)
def test_a_verdict_says_how_long_only_when_it_is_over(lab, end_s, said):
    sent, _ = lab.simulate("rover", seconds=50)
    start_ns, end_ns = lab.start_ns + 30 * SECOND, lab.start_ns + end_s * SECOND if end_s else 0
    kept = without(sent, start_ns, end_ns or lab.start_ns + 60 * SECOND)
    found = lab.examine(kept, lab.mission("rover_ground"), outages=[outage(start_ns, end_ns)])
    assert [item.reason for item in found.verdicts if item.rule == "not_examined"] == [said]

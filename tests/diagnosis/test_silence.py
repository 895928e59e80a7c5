"""Topics that fall silent without a missing count: an estimate and what it rests on, or none."""

from __future__ import annotations

import random

import pytest

STATE, HZ = 0x827, 1.0
FROM_S, UNTIL_S, ALL_S = 60.0, 80.0, 110


def silent(lab, msg_id, until_s=None, chosen=lambda item: True):
    """Return a simulated rover whose robot falls silent: what follows goes on with the next count."""
    sent, _ = lab.simulate("rover", seconds=ALL_S)
    kept, gone = [], 0
    for item in sent:
        if item.destination.port != 1235 or msg_id(item) != STATE:
            kept.append(item)
            continue
        seconds = (item.time_ns - lab.start_ns) / 1e9
        if (seconds > FROM_S and (until_s is None or seconds < until_s)) or not chosen(item):
            gone += 1
            continue
        word = int.from_bytes(item.payload[2:4], "big")
        count = (word & 0xC000) | ((word - gone) & 0x3FFF)
        kept.append(item._replace(payload=item.payload[:2] + count.to_bytes(2, "big") + item.payload[4:]))
    return kept


def told(found):
    return [item for item in found.verdicts if item.rule == "topic_silent"]


@pytest.mark.parametrize("until_s", [UNTIL_S, None])
def test_what_is_missing_is_estimated_and_in_no_figure(lab, msg_id, until_s):
    found = lab.examine(silent(lab, msg_id, until_s), lab.mission("rover_ground"))
    (verdict,) = told(found)
    seconds = (until_s or ALL_S) - FROM_S
    assert verdict.estimated == pytest.approx(seconds * HZ, abs=2)
    assert (verdict.msg_id, verdict.lost) == (STATE, None)
    assert any("1 Hz from" in line and "s of silence" in line for line in verdict.evidence)
    assert (found.lost, found.unaccounted) == (0, 0)
    assert found.as_json()["verdicts"][0]["estimated"] == verdict.estimated


def test_what_came_irregularly_cannot_be_estimated(lab, msg_id):
    chance = random.Random(5)
    kept = silent(lab, msg_id, None, lambda item: chance.random() < 0.25)
    (verdict,) = told(lab.examine(kept, lab.mission("rover_ground")))
    assert verdict.estimated is None
    assert "cannot be estimated" in verdict.reason


def test_a_count_that_is_missing_is_not_estimated_too(lab, msg_id):
    sent, _ = lab.simulate("rover", seconds=ALL_S)
    start_ns, end_ns = (lab.start_ns + int(at * 1e9) for at in (FROM_S, UNTIL_S))
    kept = [item for item in sent if not (msg_id(item) == STATE and start_ns < item.time_ns < end_ns)]
    found = lab.examine(kept, lab.mission("rover_ground"))
    assert told(found) == []
    assert found.lost == len(sent) - len(kept)


def test_an_operator_who_pauses_is_no_silence(lab):
    sent, _ = lab.simulate("two-rovers", seconds=ALL_S, hz=2.0, count=20)
    assert told(lab.examine(sent, lab.missions("two-rovers"))) == []

"""Topics that fall silent without a missing count: told while others go on, with what ended them; no loss."""

from __future__ import annotations

import random
import re

import pytest
import truth
from places import ROOT

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
def test_a_silence_is_told_and_no_loss(lab, msg_id, until_s):
    found = lab.examine(silent(lab, msg_id, until_s), lab.mission("rover_ground"))
    (verdict,) = told(found)
    ended = r" for 2\d\.\d s" if until_s else " and did not come back"
    assert re.search(
        rf"stopped at (58|59|60)\.\d s{ended} \(1 Hz before\): the capture cannot show why", verdict.reason
    )
    assert (verdict.msg_id, verdict.lost) == (STATE, None)
    assert any("1 Hz from" in line for line in verdict.evidence)
    assert (found.lost, found.unaccounted, found.uncertain, found.bad) == (0, 0, 0, False)


def test_what_came_irregularly_is_told_without_a_rate(lab, msg_id):
    chance = random.Random(5)
    kept = silent(lab, msg_id, None, lambda item: chance.random() < 0.25)
    (verdict,) = told(lab.examine(kept, lab.mission("rover_ground")))
    assert " Hz" not in verdict.reason


def test_a_count_that_is_missing_is_no_silence(lab, msg_id):
    sent, _ = lab.simulate("rover", seconds=ALL_S)
    start_ns, end_ns = (lab.start_ns + int(at * 1e9) for at in (FROM_S, UNTIL_S))
    kept = [item for item in sent if not (msg_id(item) == STATE and start_ns < item.time_ns < end_ns)]
    found = lab.examine(kept, lab.mission("rover_ground"))
    assert told(found) == []
    assert found.lost == len(sent) - len(kept)


def test_where_everything_ends_a_silence_says_nothing(lab, msg_id):
    """Senders stop, cFS and its housekeeping go on: the end of a run, and nothing is missing."""
    sent = silent(lab, msg_id)
    end_ns = lab.start_ns + int(FROM_S * 1e9)
    kept = [item for item in sent if item.destination.port == 1235 or item.time_ns < end_ns]
    found = lab.examine(kept, lab.mission("rover_ground"))
    assert told(found) == []
    assert (found.lost, found.unaccounted, found.uncertain, found.bad) == (0, 0, 0, False)


def test_topics_that_an_application_took_with_it_are_one_sentence(lab):
    found = lab.read(ROOT / "tests/captures/n5_app_restarts.pcap.zst")
    (verdict,) = told(found)
    assert verdict.reason.startswith("2 topics (0x0827, 0x0826 (EDORAS_APP_HK)) stopped at 46.1 s")
    assert verdict.reason.endswith(": EDORAS_APP was stopped at 45.6 s")


@pytest.mark.parametrize(
    "name", ["f_sbn_disconnect", "season3/q04b_bridge_restarts_subscribes_one", "n1_to_remove_all"]
)
def test_what_was_unsubscribed_or_sent_to_nobody_is_no_silence(lab, name):
    assert told(lab.read(ROOT / f"tests/captures/{name}.pcap.zst")) == []


def test_an_operator_who_pauses_is_no_silence(lab):
    sent, _ = lab.simulate("two-rovers", seconds=ALL_S, hz=2.0, count=20)
    assert told(lab.examine(sent, lab.missions("two-rovers"))) == []


def test_what_falls_silent_with_its_peer_is_noted_under_that():
    path = ROOT / "tests/captures/season3/q04b_bridge_restarts_subscribes_one.pcap.zst"
    lines = [line for item in truth.examined(path).verdicts for line in item.evidence if "stopped at" in line]
    assert lines == [
        "4 topics (0x1829, 0x182a, 0x0828, 0x0829) stopped at 45.8 s for 16.3 s",
        "0x082b stopped at 55.9 s and did not come back (0.98 Hz before)",
    ]

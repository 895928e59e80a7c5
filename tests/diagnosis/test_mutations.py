"""Changed captures: what is proven is never above the truth of the capture as it is, and sums stay sums."""

from __future__ import annotations

import random
from collections import Counter
from functools import cache

import pytest
from effort import LONG
from mutations import CHANGES, changed, frames, write
from places import ROOT
from truth import FOLDER, REST, TRUTHS, bounds, diagnosed, sums

TOGETHER = "diagnoses"
LARGE = {"c1_tlm_rate_limit4", "c4_cmd_rate", "d3_cpu1_cpu2"}
CASES = [(name, change) for name in TRUTHS if name not in LARGE for change in CHANGES]
random.Random(30).shuffle(CASES)
CASES = CASES[: None if LONG else 30]
whole = cache(lambda name: frames(FOLDER / f"{name}.pcap.zst"))


@pytest.mark.each(6)
@pytest.mark.parametrize(("name", "change"), CASES)
def test_a_changed_capture_proves_no_more_than_was_lost(name, change, tmp_path):
    path = write(tmp_path / "x.pcap", changed(whole(name), change, 1))
    result = diagnosed(path, TRUTHS[name].options)
    assert sums(result) == []
    assert bounds(result)[0] <= TRUTHS[name].lost


MISSIONS = {
    "a rover": ("rover_ground",),
    "two arms": ("two_arms_ground", "two_arms_flight"),
    "an arm": ("single_arm_ground",),
    "two rovers": ("two_rovers_ground", "two_rovers_flight"),
}
"""Each is wrong for most captures: other types, other MsgIds, other links."""


def figures(result):
    """Return the figures of every row, by what it is about, but for names and causes."""
    found = Counter()
    for row in result["balance"]:
        key = row["link"], row["msg_id"], row["hop"], row["instance"]
        found.update({(key, name): row[name] or 0 for name in ("in", "out", "duplicated", *REST)})
    return +found


plain = cache(lambda name: figures(diagnosed(FOLDER / f"{name}.pcap.zst", TRUTHS[name].options)))


@pytest.mark.each(3)
@pytest.mark.quick(
    "b_arm*-a rover",
    "n5*-a rover",
    "season3/[np]*-two arms",
)
@pytest.mark.parametrize("mission", MISSIONS if LONG else list(MISSIONS)[:2])
@pytest.mark.parametrize("name", TRUTHS)
def test_a_mission_gives_names_and_moves_no_figure(name, mission):
    files = tuple(ROOT / f"samples/missions/{item}.yaml" for item in MISSIONS[mission])
    result = diagnosed(FOLDER / f"{name}.pcap.zst", TRUTHS[name].options, files)
    assert sums(result) == []
    assert figures(result) == plain(name)


def test_every_change_changes_something_and_is_repeatable():
    items = whole("a_rover")
    for name in CHANGES:
        first = changed(items, name, 1)
        assert first == changed(items, name, 1)
        assert first != items, name

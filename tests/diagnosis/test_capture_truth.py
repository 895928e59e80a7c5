"""The public result of each real capture of the third season, judged by what was counted when it was made."""

from __future__ import annotations

from copy import deepcopy

import pytest
from truth import TRUTHS, Truth, causes, diagnosis, judge

FAILS: dict[str, str] = {}
"""Captures of which the doctor says what is false today, and why: each goes with what mends it."""
TOGETHER = "diagnoses"
NAMES = [name for name in TRUTHS if name.startswith("season3/")]


@pytest.mark.each(3)
@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=pytest.mark.xfail(reason=FAILS[short], strict=True, raises=AssertionError))
        if (short := name.partition("/")[2]) in FAILS
        else name
        for name in NAMES
    ],
)
def test_what_is_said_is_what_was_counted(name):
    assert judge(diagnosis(name), TRUTHS[name]) == []


def test_what_the_first_count_has_of_a_capture_has_its_cause():
    """Of q22 24 were lost before the first 0x803, which has 37: 13 are older."""
    result = diagnosis("season3/q22_to_enabled_late_loss_at_the_end")
    assert causes(result) == {"limit": result["lost"]}
    assert result["unaccounted"] == 0
    (older,) = [item for item in result["verdicts"] if item["rule"] == "older_losses"]
    assert "13 losses counted by cFS 66:1 before 20.4 s, beside 24 of what is here" in str(older)


ROW = {
    **dict.fromkeys(("duplicated", "unaccounted", "superseded", "waiting", "not_captured"), 0),
    "msg_id": "0x1827",
    "hop": "software bus",
    "in": 100,
    "out": 80,
    "lost": 20,
    "lost_by": {"limit": 20},
}
RIGHT = {"lost": 20, "unaccounted": 0, "superseded": 0, "balance": [ROW], "verdicts": []}
TRUE = Truth(20, {"0x1827": 20}, causes=("limit",))


def changed(whole=(), row=(), **more):
    value = deepcopy(RIGHT)
    value.update(dict(whole), **more)
    value["balance"][0].update(dict(row))
    return value


@pytest.mark.parametrize(
    ("value", "fault"),
    [
        (changed(), None),
        (changed({"lost": 14, "uncertain": 6}, {"lost": 14, "uncertain": 6}), None),
        (changed({"lost": 13, "uncertain": 7}, {"lost": 13, "uncertain": 7}), "whole: the range is 7 wide"),
        (changed({"lost": 21}, {"lost": 21, "out": 79}), "whole: 21 to 21, truth 20"),
        (changed({"lost": 19}, {"lost": 19, "superseded": 1}), "superseded: whole 0, rows 1"),
        (changed(row={"out": 81}), "row 0x1827 software bus: 100 in, 101 accounted for"),
        (changed(row={"out": 81, "waiting": -1}), "row 0x1827 software bus: negative"),
        (changed({"lost": 21}), "lost: whole 21, rows 20"),
        (changed(row={"lost_by": {"unknown": 20}}), "cause not named: limit"),
        (changed(row={"msg_id": "0x1828"}), "0x1827: 0 to 0, truth 20"),
        (changed(verdicts=["it did not pass them on"]), "said: did not pass them on"),
    ],
)
def test_the_judge_finds_each_kind_of_fault(value, fault):
    faults = judge(value, TRUE)
    assert faults == [] if fault is None else fault in faults

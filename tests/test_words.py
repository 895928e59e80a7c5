"""Numbers, lists and suggestions in sentences."""

from __future__ import annotations

from edoras_tools.words import did_you_mean, listed, plural


def test_plural():
    assert [plural(number, "packet") for number in (0, 1, 1827)] == [
        "0 packets",
        "1 packet",
        "1,827 packets",
    ]


def test_listed():
    assert listed(["a", "b", "c"], 3) == "a, b, c"
    assert listed(["a", "b", "c"], 2) == "a, b, ..."


def test_did_you_mean():
    names = ["linear.x", "linear.y", "angular.z"]
    assert did_you_mean("LINAER.X", names, 1) == "did you mean linear.x?"
    assert did_you_mean("linaer.x", names) == "did you mean linear.x or linear.y?"
    assert did_you_mean("speed", names) == ""

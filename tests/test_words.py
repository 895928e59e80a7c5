"""Numbers, lists and suggestions in sentences."""

from __future__ import annotations

from edoras_tools.words import did_you_mean, listed, plural, seconds


def test_plural():
    assert [plural(number, "packet") for number in (0, 1, 1827)] == [
        "0 packets",
        "1 packet",
        "1,827 packets",
    ]


def test_seconds():
    assert [seconds(value) for value in (-0.06, 119.9, 120, 7200, 172_800, 1478876100.426)] == [
        "-0.1 s",
        "119.9 s",
        "120.0 s (2.0 minutes)",
        "7200.0 s (2.0 hours)",
        "172800.0 s (2.0 days)",
        "1478876100.4 s (46.9 years)",
    ]
    assert seconds(1478876100.426, 3) == "1478876100.426 s (46.9 years)"


def test_listed():
    assert listed(["a", "b", "c"], 3) == "a, b, c"
    assert listed(["a", "b", "c"], 2) == "a, b, ..."


def test_did_you_mean():
    names = ["linear.x", "linear.y", "angular.z"]
    assert did_you_mean("LINAER.X", names, 1) == "did you mean linear.x?"
    assert did_you_mean("linaer.x", names) == "did you mean linear.x or linear.y?"
    assert did_you_mean("speed", names) == ""

"""Figures in sentences."""

from __future__ import annotations

from edoras_tools.words import listed, plural


def test_plural():
    assert [plural(number, "packet") for number in (0, 1, 1827)] == [
        "0 packets",
        "1 packet",
        "1,827 packets",
    ]


def test_listed():
    assert listed(["a", "b", "c"], 3) == "a, b, c"
    assert listed(["a", "b", "c"], 2) == "a, b, ..."

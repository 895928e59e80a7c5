"""Interfaces that were away, in words."""

import pytest

from edoras_tools.model import InterfaceOutage
from edoras_tools.render.capture.outage import outage_lines, outage_news

S = 1_000_000_000
DOWN = InterfaceOutage("eth1", "down", 5 * S, 17 * S + S // 3)
SHORT = InterfaceOutage("eth1", "not there", 20 * S, 20 * S)
STILL = InterfaceOutage("eth1", "without carrier", 30 * S)
LONG = InterfaceOutage("wlan0\x1b", "not there", 5 * S, 3605 * S)


@pytest.mark.parametrize(
    ("outage", "line"),
    [
        (DOWN, "eth1 is back; it was away 12.3 s"),
        (SHORT, "eth1 is back; it was away 0.0 s"),
        (STILL, "eth1 is without carrier; waiting for it"),
        (LONG, "wlan0\\x1b is back; it was away 1:00:00"),
    ],
)
def test_news(outage, line):
    assert outage_news(outage) == line


@pytest.mark.parametrize(
    ("outages", "lines"),
    [
        ([], []),
        ([DOWN], ["eth1 was away 12.3 s"]),
        ([DOWN, LONG, SHORT], ["eth1 was away 12.3 s, 2 times", "wlan0\\x1b was away 1:00:00"]),
        ([STILL], ["eth1 was not back at the end"]),
        ([DOWN, STILL], ["eth1 was away 12.3 s and was not back at the end"]),
    ],
)
def test_summary(outages, lines):
    assert outage_lines(outages) == lines

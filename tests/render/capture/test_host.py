"""The kernel's counters as people see them: each figure, and what is not known as such."""

from __future__ import annotations

import pytest

from edoras_tools.model import HostCounters, InterfaceOutage, SocketCounters
from edoras_tools.render.capture.host import host_lines, outage_lines, outage_news

SOCKETS = (SocketCounters(2234, "::1", 2, 0, 0), SocketCounters(1234, "127.0.0.1", 1, 7488, 1091))


def test_sockets_are_listed_by_port_and_what_is_not_known_is_a_dash():
    host = HostCounters(0, SOCKETS, 1093, None, 0, 100, 5, 10, 212992, None)
    lines = list(host_lines(host, {1234: "ci", 2234: "sbn"}, 0.05, ["do this"]))
    assert [line.split() for line in lines[:3]] == [
        ["port", "link", "address", "waiting", "dropped"],
        ["1234", "ci", "127.0.0.1", "7.3", "KiB", "1,091"],
        ["2234", "sbn", "::1", "0", "B", "0"],
    ]
    figures = {line[14:]: line[:12].strip() for line in lines[4:]}
    assert figures["UDP datagrams dropped by full sockets, of all programs"] == "1,093"
    assert figures["IP packets whose fragments did not all come"] == "-"
    assert figures["frames dropped by interfaces"] == "0"
    assert figures["processor time that this machine's host kept (steal)"] == "5.0%"
    assert lines[-2:] == ["", "do this"]


def test_without_sockets():
    lines = list(host_lines(HostCounters(0, receive_buffer_errors=0), {}, None, []))
    assert lines[0] == "no program here listens on a UDP port of the links"


def test_without_counters_nothing_is_said_of_sockets():
    lines = list(host_lines(HostCounters(0), {}, None, []))
    assert lines[0] == "unknown what listens here: this system has no /proc/net that can be read"
    assert {line[:12].strip() for line in lines[2:]} == {"-"}


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

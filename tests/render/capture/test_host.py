"""The kernel's counters as people see them: each figure, and what is not known as such."""

from edoras_tools.model import HostCounters, SocketCounters
from edoras_tools.render.capture.host import host_lines

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


def test_without_sockets_and_counters():
    lines = list(host_lines(HostCounters(0), {}, None, []))
    assert lines[0] == "no program here listens on a UDP port of the links"
    assert {line[:12].strip() for line in lines[2:]} == {"-"}

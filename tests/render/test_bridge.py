"""Bridges as people see them."""

from __future__ import annotations

import io

import pytest
from rich.console import Console

from edoras_tools.render import bridge as view

LATENCY = {"p50": 41.0, "p99": 1234.0, "max": 2000.0}
WAY = {
    "datagrams": 9,
    "sent": 9,
    "queued": 0,
    "failed": 0,
    "reason": None,
    "overflowed": 0,
    "latency_us": LATENCY,
}


def route(topic, direction="to_cfs", **values):
    usual = {"topic": topic, "type": "a/msg/B", "msg_id": "0x1829", "direction": direction, "max_rate": None,
             "in": 2500, "out": 2500, "held": 0, "waiting": 0, "refused": {},
             "missed": 0, "overwritten": 0}  # fmt: skip
    return usual | values


@pytest.fixture
def summary():
    return {
        "ros": "dds",
        "bridges": [
            {
                "name": "flight", "kind": "flight", "listen": "0.0.0.0:2236", "target": "10.0.0.1:2234",
                "peer": "66:1", "connected": False, "losses": {"disconnect": 1, "timeout": 1},
                "refused": {"peer 66:9": 3}, "others": 0, "unreadable": 1, "graph_drops": 11,
                "to_cfs": WAY | {"failed": 2, "reason": "Network is unreachable", "overflowed": 4},
                "from_cfs": WAY | {"kernel_drops": 5},
                "routes": [
                    route("/robot/pose", max_rate=30.0, out=300, held=2200, missed=1),
                    route("/robot/cmd_vel", "from_cfs", refused={"no CDR": 7}, out=0, overwritten=9),
                ],
            }
        ],
        "inbox_overflowed": 6, "recorded": 10, "unrecorded": 8, "lost": 23, "notes": ["flight: it is said"],
    }  # fmt: skip


def text(renderable, width):
    console = Console(width=width, file=io.StringIO(), color_system=None)
    console.print(renderable)
    return console.file.getvalue()


@pytest.mark.parametrize("width", [60, 80, 200])
def test_the_table_keeps_its_first_columns_and_its_width(summary, width):
    shown = text(view.outcome(summary, width), width)
    table = [line for line in shown.splitlines() if "/robot" in line and ": " not in line]
    assert len(table) == 2
    assert all(len(line) <= width for line in shown.splitlines())
    if width == 200:
        assert "2,500  300  30.0 Hz  2,200        0  41 µs  1.23 ms" in table[0]
        assert "   -        -" in table[1]  # nothing went out: no latency
        assert "peer 66:1 not connected, connection lost 2 times" in shown


def test_what_was_lost_or_refused_is_told_a_line_each(summary):
    assert view.losses(summary) == [
        "flight: /robot/pose: 1 message lost: by their publisher's history or the network, before they came",
        "flight: /robot/cmd_vel: 7 messages refused: no CDR",
        "flight: /robot/cmd_vel: 9 messages lost: at most, overwritten here before a subscriber had them",
        "flight: 3 datagrams refused: peer 66:9",
        "flight: 1 datagram too short for a packet",
        "flight: 11 datagrams of ROS 2 dropped: the receive buffer was full; some may have come again",
        "flight: 2 datagrams not sent: Network is unreachable",
        "flight: 4 datagrams lost: the socket took no more",
        "flight: 5 datagrams lost before the bridge read them: the receive buffer was full",
        "6 messages lost: ROS 2 was faster than the bridge",
        "8 datagrams bridged, but not recorded",
    ]


def test_a_ground_bridge_says_whether_telemetry_arrives(summary):
    summary["bridges"][0] |= {"kind": "ground", "connected": False}
    assert "no telemetry" in text(view.outcome(summary, 100), 100)
    summary["bridges"][0]["connected"] = True
    assert "telemetry" not in text(view.outcome(summary, 100), 100)


def test_it_is_drawn_while_it_runs_with_the_last_notes(summary, monkeypatch):
    clock = iter(range(100))
    console = Console(width=100, file=io.StringIO(), force_terminal=True, color_system=None)

    class Running:
        def summary(self):
            for row in summary["bridges"][0]["routes"]:
                row["out"] += 30
            return summary

    table = view.live_table(console)
    monkeypatch.setattr(table, "_clock", lambda: float(next(clock)))
    with table:
        for _ in range(3):
            table.update(Running())
    drawn = console.file.getvalue()
    assert "30.0 Hz" in drawn
    assert "flight: it is said" in drawn
    assert "Ctrl-C ends" in drawn

"""A proxy as a table, at every width, and what is said of losses."""

import io

import pytest
from rich.console import Console

from edoras_tools.addons.proxy.views import live_table, notes, outcome, plan

LATENCY = {"p50": 41.2, "p99": 1420.4, "max": None}
WAY = {
    "name": "to 127.0.0.1:1234",
    "received": 12000,
    "bytes": 1,
    "sent": 10800,
    "queued": 0,
    "refused": 0,
    "failed": 0,
    "reason": None,
    "unclaimed": 0,
    "kernel_drops": 0,
    "overflowed": 0,
    "latency_us": LATENCY,
}
SUMMARY = {
    "link": "ci",
    "listen": "127.0.0.1:5234",
    "targets": ["127.0.0.1:1234"],
    "seed": 7,
    "ways": [WAY, {**WAY, "name": "to clients", "received": 0, "sent": 0}],
    "clients": [{"address": f"127.0.0.1:{port}", "received": 3, "answered": 0} for port in range(4000, 4010)],
    "clients_evicted": 0,
    "faults": [
        {"rule": "drop:0.1", "kind": "drop", "on": True, "struck": 1200},
        {"rule": "delay:1s\x1b[31m", "kind": "delay", "on": False, "struck": 0},
    ],
    "held": 0,
    "held_overflowed": 0,
    "recorded": 10800,
    "unrecorded": 0,
    "lost": 0,
}


def drawn(view, width):
    out = io.StringIO()
    Console(file=out, width=width, color_system=None).print(view)
    return out.getvalue()


@pytest.mark.parametrize("width", [60, 80, 120, 200])
def test_a_report_fits_its_width_and_has_what_matters(width):
    text = drawn(outcome(SUMMARY, width), width)
    assert max(map(len, text.splitlines())) <= width
    for part in (
        "to 127.0.0.1:1234",
        "12,000",
        "10,800",
        "drop:0.1",
        "1,200",
        "on",
        "off",
        "and 2 more clients",
    ):
        assert part in text
    assert "\x1b" not in text
    if width >= 80:
        assert "41 µs" in text
        assert "1.42 ms" in text


def test_nothing_is_noted_where_all_is_well():
    assert notes(SUMMARY) == []


def test_every_loss_and_refusal_is_noted():
    way = {
        **WAY,
        "refused": 2,
        "failed": 1,
        "reason": "why",
        "unclaimed": 3,
        "kernel_drops": 4,
        "overflowed": 5,
    }
    summary = {
        **SUMMARY,
        "ways": [way],
        "held": 6,
        "held_overflowed": 7,
        "unrecorded": 8,
        "clients_evicted": 9,
    }
    told = "\n".join(notes(summary))
    for part in (
        "refused 2 times",
        "1 datagram not sent: why",
        "3 datagrams for no",
        "4 datagrams lost before",
    ):
        assert part in told
    for part in ("5 datagrams lost: the queue", "6 datagrams still held", "7 datagrams lost: too much"):
        assert part in told
    assert "8 datagrams relayed, but not recorded" in told
    assert "9 clients forgotten" in told


def test_a_plan_is_told_in_lines(tmp_path):
    text = drawn(plan(SUMMARY, tmp_path / "a.mcap"), 200)
    assert "would relay ci 127.0.0.1:5234 → 127.0.0.1:1234; nothing was opened" in text
    assert "(off)" in text
    assert "a.mcap" in text


def test_a_live_table_is_drawn_on_a_terminal_only_so_often():
    out = io.StringIO()
    console = Console(file=out, width=100, force_terminal=True, color_system=None)

    class Proxy:
        asked = 0

        def summary(self):
            self.asked += 1
            return SUMMARY

    proxy = Proxy()
    with live_table(console, keys=True) as table:
        table.update(proxy)
        table.update(proxy)
    assert proxy.asked == 1
    assert "1 to 9 switch faults, q ends" in out.getvalue()

from __future__ import annotations

import io

from rich.console import Console

from edoras_tools.render.capture.info import view
from edoras_tools.render.terminal.live_table import Moment


def drawn(view, width=100):
    out = io.StringIO()
    Console(file=out, width=width, color_system=None, _environ={}).print(view)
    return out.getvalue()


def test_the_view_shows_counts_rates_drops_and_size(summary):
    now = {("ci", None, "0x1827", None, "/cmd_vel"): 10.0, None: 28.4}
    text = drawn(view("lo → a.mcap", Moment({**summary, "capture_drops": 7}, now, 65.1, 13_000_000, 100)))
    assert text.splitlines()[0].split() == ["lo", "→", "a.mcap", "65.1", "s"]
    assert "1,827 packets   28.4 packets/s   7 dropped   12.4 MiB written" in text
    (row,) = [line.split() for line in text.splitlines() if "/cmd_vel" in line]
    assert row[:6] == ["CI", "0x1827", "/cmd_vel", "10.0", "Hz", "600"]


def test_the_view_counts_the_routes_that_do_not_fit(summary):
    text = drawn(view("lo", Moment(summary, {}, 1.0, width=100, height=8)))
    assert "and 2 more routes" in text
    assert len(text.splitlines()) <= 8


def test_the_view_waits_for_the_first_packet():
    assert "waiting for the first packet" in drawn(view("lo", Moment({"routes": []}, {}, 1.0)))

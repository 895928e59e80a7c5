from __future__ import annotations

import io
import re
from dataclasses import dataclass, field

from rich.console import Console

from edoras_tools.model import SourceInfo, SourceStatistics
from edoras_tools.render.live import LiveTable, Rates, Snapshot


@dataclass
class Source:
    info: SourceInfo
    statistics: SourceStatistics = field(default_factory=SourceStatistics)


@dataclass
class Report:
    shown: dict
    source: Source = field(default_factory=lambda: Source(SourceInfo("eth0", "live")))
    asked: int = 0

    def summary(self):
        self.asked += 1
        return self.shown


class Clock:
    def __init__(self):
        self.now = 100.0

    def __call__(self):
        return self.now


def console(**options):
    return Console(file=io.StringIO(), width=100, height=20, _environ={"TERM": "xterm"}, **options)


def drawn(view, width=100):
    out = io.StringIO()
    Console(file=out, width=width, color_system=None, _environ={}).print(view)
    return out.getvalue()


def test_rates_look_back_two_seconds():
    rates = Rates()
    assert rates.add(0.0, {"a": 0}) == {"a": 0.0}
    for step in range(1, 21):
        seen = rates.add(step / 4, {"a": 10 * step})
        assert seen["a"] == 40.0
    for step in range(21, 30):
        seen = rates.add(step / 4, {"a": 200, "new": step - 20})
    assert seen["a"] == 0.0
    assert 3.5 <= seen["new"] <= 4.5


def test_snapshot_shows_counts_rates_drops_and_size(summary):
    now = {("ci", None, "0x1827", None, "/cmd_vel"): 10.0, None: 28.4}
    text = drawn(Snapshot("lo → a.mcap", {**summary, "capture_drops": 7}, now, 65.1, 13_000_000, 24))
    assert text.splitlines()[0].split() == ["lo", "→", "a.mcap", "65.1", "s"]
    assert "1,827 packets   28.4 packets/s   7 dropped   12.4 MiB written" in text
    (row,) = [line.split() for line in text.splitlines() if "/cmd_vel" in line]
    assert row[:6] == ["CI", "0x1827", "/cmd_vel", "10.0", "Hz", "600"]


def test_snapshot_counts_the_routes_that_do_not_fit(summary):
    text = drawn(Snapshot("lo", summary, {}, 1.0, None, 8))
    assert "and 2 more routes" in text
    assert len(text.splitlines()) <= 8


def test_snapshot_waits_for_the_first_packet():
    assert "waiting for the first packet" in drawn(Snapshot("lo", {"routes": []}, {}, 1.0, None, 24))


def test_updates_are_cheap_between_drawings(summary, tmp_path):
    clock, report = Clock(), Report(summary)
    output = tmp_path / "a.mcap"
    output.write_bytes(bytes(2048))
    screen = console(force_terminal=True)
    with LiveTable("lo", console=screen, output=output, clock=clock) as live:
        for _ in range(50):
            live.update(report)
            clock.now += 0.01
    assert 2 <= report.asked <= 5
    text = re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]", "", screen.file.getvalue())
    assert "/cmd_vel" in text
    assert "2.0 KiB written" in text


def test_nothing_is_drawn_where_there_is_no_terminal(summary):
    report, screen = Report(summary), console(force_terminal=False)
    with LiveTable("lo", console=screen) as live:
        live.update(report)
    assert screen.file.getvalue() == ""
    assert report.asked == 0

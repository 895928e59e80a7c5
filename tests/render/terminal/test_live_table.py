from __future__ import annotations

import io
import re
from dataclasses import dataclass

from rich.console import Console, Group
from rich.text import Text

from edoras_tools.render.terminal.live_table import LiveTable, LiveView, Moment, Rates, title_line

SUMMARY = {"recorded": 1827, "lost": 3}


@dataclass
class Run:
    asked: int = 0

    def summary(self):
        self.asked += 1
        return SUMMARY | {"count": 5 * self.asked}


class Clock:
    def __init__(self):
        self.now = 100.0

    def __call__(self):
        return self.now


def console(**options):
    return Console(file=io.StringIO(), width=100, height=20, _environ={"TERM": "xterm"}, **options)


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


def table(screen, **options):
    def show(_, moment):
        return Group(title_line("lo", moment), Text(f"{moment.rates['all']:.1f} a second"))

    return LiveTable(show, lambda summary: {"all": summary["count"]}, screen, **options)


def test_updates_are_cheap_between_drawings(tmp_path):
    clock, run = Clock(), Run()
    output = tmp_path / "a.mcap"
    output.write_bytes(bytes(2048))
    screen = console(force_terminal=True)
    with table(screen, output=output, clock=clock, transient=False) as live:
        for _ in range(65):
            live.update(run)
            clock.now += 1 / 64
    assert run.asked == 6
    text = re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]", "", screen.file.getvalue())
    assert "lo   1.0 s   1,827 datagrams recorded, 2.0 KiB   3 lost" in text
    assert "20.0 a second" in text


def test_the_last_state_stays_or_the_view_goes_away():
    for transient in (False, True):
        clock, screen, drawn = Clock(), console(force_terminal=True), []

        def show(run, now, drawn=drawn):
            drawn.append((run, now))
            return str(run)

        with LiveView(show, screen, transient=transient, clock=clock) as live:
            live.update("one")
            clock.now += 0.1
            live.update("two")
        assert drawn == [("one", 100.0)] + ([] if transient else [("two", 100.1)])


def test_nothing_is_drawn_where_there_is_no_terminal():
    run, screen = Run(), console(force_terminal=False)
    with table(screen) as live:
        live.update(run)
    assert screen.file.getvalue() == ""
    assert run.asked == 0


def test_a_run_that_is_over_has_no_clock():
    assert title_line("ci", Moment({"recorded": None, "lost": 0})).plain == "ci"

from __future__ import annotations

import io
import os
import pty
import re
import termios
import threading
from dataclasses import dataclass

import pytest
from rich.console import Console, Group
from rich.text import Text
from waiting import until

from edoras_tools.render.terminal.live_table import (
    BackgroundStream,
    LiveTable,
    LiveView,
    Moment,
    Rates,
    background,
    title_line,
)


@pytest.fixture
def terminal():
    """Both ends of a pseudo terminal; what is written to it is gathered."""
    master, slave = pty.openpty()
    drawn = []

    def read():
        try:
            while data := os.read(master, 65536):
                drawn.append(data)
        except OSError:  # nobody has the other end any more
            return

    threading.Thread(target=read, daemon=True).start()
    yield slave, drawn
    os.close(slave)


def test_what_is_written_comes_out_in_order(terminal):
    slave, drawn = terminal
    with open(slave, "w", closefd=False) as stream, background(Console(file=stream)) as out:
        for number in range(200):
            out.write(f"{number} ")
            out.flush()
    assert stream.closed
    until(lambda: b"".join(drawn).split() == [b"%d" % number for number in range(200)])


def test_a_stopped_one_does_not_hold_up_who_writes(terminal):
    slave, drawn = terminal
    termios.tcflow(slave, termios.TCOOFF)
    with open(slave, "w", closefd=False) as stream, background(Console(file=stream)) as out:
        out.write("later")
        out.flush()
        assert not out.idle
        termios.tcflow(slave, termios.TCOON)
    until(lambda: b"".join(drawn) == b"later")


def test_one_that_fails_is_told():
    class Closed(io.StringIO):
        def write(self, _):
            raise OSError(5, "Input/output error")

    out = BackgroundStream(Closed())
    out.write("x")
    out.flush()
    out.finish()
    with pytest.raises(OSError, match="Input/output error"):
        out.write("y")


def test_a_pipe_is_written_to_as_ever(tmp_path):
    with (tmp_path / "x").open("w") as stream, background(Console(file=stream)) as out:
        assert out is None


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

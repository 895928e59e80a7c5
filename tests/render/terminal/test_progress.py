from __future__ import annotations

import io
import re
from types import SimpleNamespace

import pytest
from rich.console import Console

from edoras_tools.model import SourceStatistics
from edoras_tools.render.terminal.progress import FileProgress, figures


def console(*, terminal, width=100):
    return Console(file=io.StringIO(), width=width, force_terminal=terminal, _environ={"TERM": "xterm"})


def run(screen, *, seconds, quiet=False, total=1_000_000, label="a_rover.pcap"):
    now = [0.0]
    statistics = SourceStatistics(total_bytes=total)
    report = SimpleNamespace(source=SimpleNamespace(statistics=statistics))
    with FileProgress(label, console=screen, quiet=quiet, clock=lambda: now[0]) as progress:
        for step in range(100):
            now[0] += seconds / 100
            statistics.position = min(total, 10_000 * (step + 1))
            statistics.datagrams = 100 * (step + 1)
            statistics.bytes = 10_000 * (step + 1)
            progress.update(report)
    return re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]", "", screen.file.getvalue())


def test_shows_share_bytes_rate_and_time_left():
    text = run(console(terminal=True), seconds=20)
    assert "a_rover.pcap" in text
    assert "50%  488.3 KiB  500 packets/s  10.0 s left" in text


def test_draws_at_most_ten_times_a_second():
    assert run(console(terminal=True), seconds=1).count("packets/s") <= 10


@pytest.mark.parametrize(
    "case",
    [
        {"terminal": False, "seconds": 10},
        {"terminal": True, "seconds": 10, "quiet": True},
        {"terminal": True, "seconds": 0.2},
    ],
)
def test_draws_nothing_in_files_when_quiet_or_when_done_at_once(case):
    screen = console(terminal=case.pop("terminal"))
    assert run(screen, **case) == ""


def test_an_input_without_an_end():
    text = run(console(terminal=True), seconds=10, total=0)
    assert "packets/s" in text
    assert "left" not in text
    assert "%" not in text


def test_a_hostile_name_and_a_narrow_terminal():
    screen = console(terminal=True, width=60)
    text = run(screen, seconds=10, label="\x1b]0;x\x07" + "very/long/" * 10 + "[red]file.pcap")
    assert "\x07" not in text
    assert "[red]file.pcap"[-8:] in text


@pytest.mark.parametrize(
    ("statistics", "expected"),
    [
        (
            SourceStatistics(datagrams=100, position=250, total_bytes=1000),
            "25%  250 B  50 packets/s  6.0 s left",
        ),
        (SourceStatistics(datagrams=0, position=0, total_bytes=1000), "0%  0 B  0 packets/s"),
        (
            SourceStatistics(datagrams=10, position=2000, total_bytes=1000),
            "100%  2.0 KiB  5 packets/s  0.0 s left",
        ),
        (SourceStatistics(datagrams=10, bytes=3000), "2.9 KiB  5 packets/s"),
    ],
)
def test_figures(statistics, expected):
    assert figures(statistics, 2.0) == expected


def test_what_comes_after_reading_is_shown_in_steps():
    screen, now = console(terminal=True), [0.0]
    with FileProgress("a_rover.pcap", console=screen, clock=lambda: now[0]) as progress:
        for done in range(1, 58):
            now[0] += 0.05
            progress.step("judging", done, 57)
    assert "judging, 57 of 57" in screen.file.getvalue()


def test_the_rate_of_the_second_of_two_files_is_its_own():
    screen, now = console(terminal=True), [0.0]
    with FileProgress("two", console=screen, clock=lambda: now[0]) as progress:
        for packets in (1_000, 5_000):
            source = SimpleNamespace(statistics=SourceStatistics(total_bytes=100))
            progress.read(source)
            now[0] += 10
            source.statistics.datagrams, source.statistics.position = packets, 100
            progress.read(source)
    text = screen.file.getvalue()
    assert "100 packets/s" in text
    assert "500 packets/s" in text

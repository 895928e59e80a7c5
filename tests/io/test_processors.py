"""How many processors are free, by what the kernel counts."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from waiting import until

from edoras_tools.io import processes
from edoras_tools.io import processes as module
from edoras_tools.io.processes import Precedence, jobs_for, spare_processors
from edoras_tools.model import SourceStatistics


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux tells")
@pytest.mark.parametrize(
    ("cores", "told", "spare"),
    [
        (2, "0.10 0.50 0.90 1/345 7890\n", 1),
        (2, "0.10 0.50 0.90 2/345 7890\n", 0),
        (2, "0.10 0.50 0.90 9/345 7890\n", -7),
        (8, "0.10 0.50 0.90 3/345 7890\n", 5),
        (8, "0.10 0.50 0.90 0/345 7890\n", 7),  # this process runs, whatever is said
        (4, "", 3),
        (4, "0.10 0.50 0.90\n", 3),
        (4, "0.10 0.50 0.90 many/345 7890\n", 3),
        (4, None, 3),
    ],
)
def test_those_that_run_are_counted(cores, told, spare, tmp_path, monkeypatch):
    monkeypatch.setattr(os, "cpu_count", lambda: cores)
    monkeypatch.setattr(processes, "_LOAD", tmp_path / "loadavg")
    if told is not None:
        (tmp_path / "loadavg").write_text(told)
    assert spare_processors() == spare


@pytest.mark.skipif(not Path("/proc/loadavg").exists(), reason="only Linux tells")
def test_one_that_computes_takes_a_processor():
    """Eight times as many as there are processors: others that run beside this test change less."""
    busy = [
        subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(8 * (os.cpu_count() or 1))
    ]
    try:
        until(lambda: spare_processors() <= -4 * (os.cpu_count() or 1))
    finally:
        for item in busy:
            item.kill()
            item.wait()


MS = 1_000_000
FIRST, USUAL = os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.SCHED_OTHER


@pytest.fixture
def system(monkeypatch):
    """Two processors, clocks that stand still, and what was asked for."""

    class System:
        asked, now, busy, error = [], 0, 0, None

        def after(self, busy_ms, ms=20):
            self.now += ms * MS
            self.busy += busy_ms * MS

    made = System()
    made.asked = []

    def take(_thread, policy, _parameter):
        if made.error:
            raise made.error
        made.asked.append(policy)

    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 1})
    monkeypatch.setattr(os, "sched_setscheduler", take)
    monkeypatch.setattr(processes.time, "monotonic_ns", lambda: made.now)
    monkeypatch.setattr(processes.time, "thread_time_ns", lambda: made.busy)
    return made


def test_who_takes_much_of_a_processor_loses_it_until_it_takes_little(system):
    with Precedence() as precedence:
        assert system.asked == [FIRST]
        for busy_ms, asked in [
            (2, []),
            (13, []),
            (15, [USUAL]),
            (13, []),
            (11, []),
            (9, [FIRST]),
            (19, [USUAL]),
        ]:
            before = len(system.asked)
            system.after(busy_ms)
            precedence.look()
            assert system.asked[before:] == asked
    assert system.asked[-1] == USUAL


def test_it_is_given_back_at_the_end_and_not_asked_for_again(system):
    with Precedence() as precedence:
        pass
    assert system.asked == [FIRST, USUAL]
    system.after(0)
    precedence.look()
    assert system.asked == [FIRST, USUAL]


def test_nothing_is_judged_from_a_short_time(system):
    with Precedence() as precedence:
        system.after(10, ms=10)
        precedence.look()
        assert system.asked == [FIRST]


def test_where_it_is_not_allowed_it_is_asked_for_once(system):
    system.error = PermissionError()
    with Precedence() as precedence:
        system.error = None
        system.after(0)
        precedence.look()
    assert system.asked == []


def test_the_only_processor_is_left_to_all(system, monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0})
    with Precedence():
        pass
    assert system.asked == []


def test_this_system_gives_it_or_not_and_has_it_back():
    before = os.sched_getscheduler(0)
    with Precedence():
        assert os.sched_getscheduler(0) in {before, FIRST}
    assert os.sched_getscheduler(0) == before


pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="there is one process elsewhere")
LARGE = 32 << 20


class _File:
    def __init__(self, size):
        self.statistics = SourceStatistics(total_bytes=size)


@pytest.mark.parametrize(
    ("size", "asked", "cores", "spare", "now", "ever"),
    [
        (LARGE, 0, 2, [1], 2, 2),
        (LARGE, 0, 2, [0, 0, 0, 0, 0], 1, 2),
        (LARGE, 0, 2, [-3, -1, 0, 1], 2, 2),  # something short ran at first
        (LARGE, 0, 8, [7], 3, 3),
        (LARGE, 0, 8, [0, 1, 0, 1, 1], 2, 3),
        (LARGE, 0, 1, [], 1, 1),
        (LARGE, 1, 2, [], 1, 1),
        (LARGE, 4, 2, [], 4, 4),  # what is asked for is done
        (LARGE - 1, 4, 2, [], 1, 1),
        (0, 0, 2, [], 1, 1),
    ],
)
def test_free_processors_are_shared(monkeypatch, size, asked, cores, spare, now, ever):
    left = iter(spare)
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(cores)))
    monkeypatch.setattr(module, "spare_processors", lambda: next(left))
    assert jobs_for(_File(size), asked) == now
    assert not [*left]
    assert jobs_for(_File(size), asked, fixed=False) == ever

from __future__ import annotations

from collections import deque

import pytest
from hypothesis import given
from hypothesis import strategies as st

from edoras_tools.addons.lab.emulator.scheduler import Receive, Scheduler, Sleep, SleepUntil, Work
from edoras_tools.cfs.profile import SimProfile


class Box(deque):
    def get(self):
        return self.popleft() if self else None


def scheduler(cores: int = 1, latency: int = 10) -> Scheduler:
    return Scheduler(SimProfile(cores=cores, latency_ns=(latency, latency), work_jitter=0), start_ns=0)


def test_tasks_share_a_processor_a_piece_of_work_at_a_time():
    log, clock = [], scheduler()

    def task(name):
        for step in range(3):
            yield Work(100)
            log.append((clock.now, name, step))

    clock.spawn(task("a"))
    clock.spawn(task("b"))
    clock.run(10_000)
    # Work done, a task goes on when the processor is its own again.
    assert log == [(200, "a", 0), (300, "b", 0), (400, "a", 1), (500, "b", 1), (600, "a", 2), (600, "b", 2)]


@pytest.mark.parametrize(("cores", "end"), [(1, 400), (2, 200), (4, 100)])
def test_more_processors_do_more_at_once(cores, end):
    ends, clock = [], scheduler(cores)

    def task():
        yield Work(100)
        ends.append(clock.now)

    for _ in range(4):
        clock.spawn(task())
    clock.run(10_000)
    assert max(ends) == end


def test_a_receive_ends_with_an_item_or_with_the_time_out():
    log, clock, box = [], scheduler(), Box()

    def task():
        while True:
            item = yield Receive(box, 500)
            log.append((clock.now, item))

    def put(item):
        box.append(item)
        clock.notify(box)

    clock.spawn(task())
    clock.call_at(200, put, "x")
    clock.call_at(200, put, "y")
    clock.run(1000)
    assert log == [(210, "x"), (210, "y"), (720, None)]


def test_a_delay_drifts_by_what_the_loop_takes_and_a_timer_does_not():
    delay, timer, clock = [], [], scheduler(2)

    def delaying():
        while True:
            yield Sleep(100)
            delay.append(clock.now)

    def timed():
        for index in range(1, 5):
            yield SleepUntil(100 * index)
            timer.append(clock.now)

    clock.spawn(delaying())
    clock.spawn(timed())
    clock.run(450)
    assert (delay, timer) == ([110, 220, 330, 440], [110, 210, 310, 410])


def test_a_task_that_ends_frees_its_processor():
    ran, clock = [], scheduler()

    def short(name):
        ran.append(name)
        return
        yield

    for name in range(5):
        clock.spawn(short(name))
    clock.run(100)
    assert ran == [0, 1, 2, 3, 4]


@given(st.integers(0, 1000), st.lists(st.integers(0, 10_000), max_size=30))
def test_one_seed_is_one_run_and_time_never_goes_back(seed, times):
    def run():
        clock, box, log = Scheduler(SimProfile(seed=seed), start_ns=0), Box(), []

        def task():
            while True:
                item = yield Receive(box, 3_000)
                log.append((clock.now, item))
                yield Work(500)

        def put(item):
            box.append(item)
            clock.notify(box)

        clock.spawn(task())
        clock.spawn(iter_work())
        for item in times:
            clock.call_at(item, put, item)
        clock.run(1_000_000)
        assert clock.now == 1_000_000
        return log

    def iter_work():
        while True:
            yield Work(700)
            yield Sleep(900)

    first, second = run(), run()
    assert first == second
    assert [when for when, _ in first] == sorted(when for when, _ in first)
    assert sorted(item for _, item in first if item is not None) == sorted(times)


def test_a_task_that_ends_itself_gets_no_item_that_it_asked_for():
    """As Executive Services do, whose command restarts the processor while more commands wait."""
    log, clock, box = [], scheduler(), Box([1, 2])

    def task():
        while True:
            log.append((yield Receive(box)))
            clock.end(running)

    running = clock.spawn(task())
    clock.run(10_000)
    assert log == [1]

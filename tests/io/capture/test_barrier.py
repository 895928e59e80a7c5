"""Waiting for the kernel, where it can be waited for."""

import platform
import select
import threading

import pytest
from waiting import PATIENCE_S

from edoras_tools.io.capture import barrier


@pytest.fixture(autouse=True)
def fresh():
    barrier.available.cache_clear()
    yield
    barrier.available.cache_clear()


def test_it_waits_where_it_says_so():
    assert barrier.available() == barrier.wait() or not barrier.available()


@pytest.mark.parametrize("known", [-1, 0, 0b110])
def test_a_kernel_without_the_call(monkeypatch, known):
    monkeypatch.setattr(barrier, "_call", lambda _: known)
    assert not barrier.available()


def test_an_unknown_machine(monkeypatch):
    monkeypatch.setattr(platform, "machine", lambda: "abacus")
    assert not barrier.available()


def test_a_real_time_kernel(monkeypatch, tmp_path):
    monkeypatch.setattr(barrier, "_REAL_TIME", tmp_path)
    assert not barrier.available()


@pytest.mark.parametrize("succeeds", [True, False])
def test_a_thread_waits_and_answers_once(monkeypatch, succeeds):
    end = threading.Event()
    monkeypatch.setattr(barrier, "wait", lambda: end.wait() and succeeds)
    one = barrier.Barrier()
    try:
        for _ in range(2):
            one.ask()
            assert one.answer() is None
            end.set()
            select.select([one.fileno()], [], [], PATIENCE_S)
            end.clear()
            assert [one.answer(), one.answer()] == [succeeds, None]
    finally:
        end.set()
        one.close()
    assert not one._thread.is_alive()

"""Ctrl-C ends work, whatever the main thread is at."""

from __future__ import annotations

import os
import pty
import signal
import termios
import threading
from types import SimpleNamespace

import pytest
from waiting import until

from edoras_tools.pipelines.reading import Keys, on_interrupt


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_stop_is_called_once(number):
    called = []
    with on_interrupt(lambda: called.append(threading.current_thread())) as asked:
        assert not asked.is_set()
        signal.raise_signal(number)
        until(lambda: called)
        assert asked.is_set()
        signal.raise_signal(signal.SIGHUP)
        if number != signal.SIGTERM:  # that of whoever ends a group comes with others
            signal.raise_signal(signal.SIGTERM)
        for again in (signal.SIGINT, signal.SIGTERM):
            with pytest.raises(KeyboardInterrupt):
                signal.raise_signal(again)
    assert len(called) == 1


def test_a_hang_up_that_is_ignored_stays_ignored():
    """As under nohup."""
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with on_interrupt(lambda: None) as asked:
            signal.raise_signal(signal.SIGHUP)
            assert not asked.is_set()
    finally:
        signal.signal(signal.SIGHUP, before)


def test_a_patient_one_takes_the_second_too():
    with on_interrupt(lambda: None, patient=True) as asked:
        for _ in range(3):
            signal.raise_signal(signal.SIGINT)
        assert asked.is_set()


def test_a_lock_that_the_main_thread_holds_does_not_stop_the_stop():
    lock, stopped = threading.Lock(), threading.Event()

    def stop():
        with lock:
            stopped.set()

    with on_interrupt(stop):
        with lock:
            signal.raise_signal(signal.SIGINT)
            assert not stopped.is_set()
        until(stopped.is_set)


def test_in_a_thread_signals_stay_as_they_are():
    before, seen = signal.getsignal(signal.SIGINT), []

    def run():
        with on_interrupt(lambda: None):
            seen.append(signal.getsignal(signal.SIGINT))

    thread = threading.Thread(target=run)
    thread.start()
    thread.join()
    assert seen == [before]


@pytest.fixture
def typed(monkeypatch):
    """A terminal as standard input; gives what types into it, and its settings."""
    master, slave = pty.openpty()
    monkeypatch.setattr("sys.stdin", SimpleNamespace(fileno=lambda: slave))
    yield lambda text: os.write(master, text), lambda: termios.tcgetattr(slave)[3]
    os.close(master)
    os.close(slave)


def test_keys_need_no_enter_and_the_terminal_is_given_back(typed):
    write, flags = typed
    before = flags()
    assert before & termios.ICANON
    with Keys() as keys:
        assert not flags() & (termios.ICANON | termios.ECHO)
        assert keys.pressed() == ""
        write(b"n Q")
        assert keys.pressed() == "n q"
        assert keys.pressed() == ""
    assert flags() == before


def test_from_a_pipe_until_its_end(monkeypatch):
    reading, writing = os.pipe()
    monkeypatch.setattr("sys.stdin", SimpleNamespace(fileno=lambda: reading))
    with Keys() as keys:
        assert keys.fileno() == reading
        os.write(writing, b"nn")
        assert keys.pressed() == "nn"
        os.close(writing)
        assert [keys.pressed(), keys.pressed()] == ["q", "q"]
    os.close(reading)

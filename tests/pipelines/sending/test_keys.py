from __future__ import annotations

import os
import pty
import termios
from types import SimpleNamespace

import pytest

from edoras_tools.pipelines.sending.keys import Keys


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

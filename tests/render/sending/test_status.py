"""The line that shows how far a replay is."""

import io
from types import SimpleNamespace

import pytest

from edoras_tools.render.sending import status
from edoras_tools.render.terminal.palette import Terminal


@pytest.mark.parametrize("interactive", [True, False])
def test_a_terminal_has_a_status_line(interactive, monkeypatch):
    out = io.StringIO()
    monkeypatch.setattr("sys.stderr", out)
    monkeypatch.setattr(
        status, "detect_terminal", lambda _: Terminal(80, colour=False, interactive=interactive)
    )
    ticks = iter([0.0, 0.1, 0.3, 0.4])
    monkeypatch.setattr(status, "time", SimpleNamespace(monotonic=lambda: next(ticks)))
    with status.send_status(1000, quiet=False, keys=True) as watcher:
        if interactive:
            for sent in (1, 2, 3):
                watcher.update(SimpleNamespace(sent=sent, achieved_hz=10.0))
    drawn = "\r\x1b[Ksent 2 of 1,000   10.0 Hz   space pauses, n next, q ends\r\x1b[K"
    assert out.getvalue() == (drawn if interactive else "")


def test_quiet_shows_nothing(monkeypatch):
    monkeypatch.setattr(status, "detect_terminal", lambda _: Terminal(80, colour=False, interactive=True))
    with status.send_status(None, quiet=True, keys=False) as watcher:
        assert watcher is None

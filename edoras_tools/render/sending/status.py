"""The progress of a running replay or inject; without rich, which takes long to import."""

from __future__ import annotations

import sys
import time
from contextlib import AbstractContextManager, nullcontext
from typing import Final, Protocol, TextIO

from edoras_tools import words
from edoras_tools.render.terminal.palette import detect_terminal

_REFRESH_S: Final = 0.2
_KEYS: Final = "space pauses, n next, q ends"


class _Sending(Protocol):
    """A replay or inject that is under way."""

    sent: int

    @property
    def achieved_hz(self) -> float | None:
        """Datagrams per second so far."""
        ...


class StatusLine(AbstractContextManager["StatusLine"]):
    """One line on standard error that shows the progress; nothing if standard error is not a terminal.

    Args:
        out: output stream.
        total: datagrams to send; None for no end.
    """

    def __init__(self, out: TextIO, total: int | None, *, keys: bool) -> None:
        self._out = out
        self._total = total
        self._keys = keys
        self._drawn = time.monotonic()

    def __exit__(self, *_: object) -> None:
        self._out.write("\r\x1b[K")
        self._out.flush()

    def update(self, report: _Sending) -> None:
        """Draw, five times a second at most."""
        now = time.monotonic()
        if now - self._drawn < _REFRESH_S:
            return
        self._drawn = now
        of = f" of {self._total:,}" if self._total else ""
        rate = f"   {words.rate(report.achieved_hz)}" if report.achieved_hz else ""
        self._out.write(f"\r\x1b[Ksent {report.sent:,}{of}{rate}{f'   {_KEYS}' if self._keys else ''}")
        self._out.flush()


def send_status(total: int | None, *, quiet: bool, keys: bool) -> AbstractContextManager[StatusLine | None]:
    """Return the view of a running replay, or None."""
    if quiet or not detect_terminal(sys.stderr).interactive:
        return nullcontext()
    return StatusLine(sys.stderr, total, keys=keys)

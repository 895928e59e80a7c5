"""Reads single keys from a terminal, without waiting for Enter; also works with a pipe."""

from __future__ import annotations

import os
import select
import sys
from contextlib import suppress
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from typing_extensions import Self


class Keys:
    """Standard input as a keyboard: a context manager that restores the terminal's mode."""

    def __init__(self) -> None:
        self._fileno = sys.stdin.fileno()
        self._before: list[Any] | None = None
        self._ended = False

    def __enter__(self) -> Self:
        if os.isatty(self._fileno):
            import termios
            import tty

            self._before = termios.tcgetattr(self._fileno)
            tty.setcbreak(self._fileno)
        return self

    def __exit__(self, *_: object) -> None:
        if self._before is not None:
            import termios

            termios.tcsetattr(self._fileno, termios.TCSADRAIN, self._before)

    def fileno(self) -> int:
        """Return the descriptor, which becomes readable when a key is pressed."""
        return self._fileno

    def pressed(self) -> str:
        """Return the keys pressed since the last call; always ``q`` once the input has ended."""
        with suppress(OSError, ValueError):
            while not self._ended and select.select((self._fileno,), (), (), 0)[0]:
                keys = os.read(self._fileno, 64).decode(errors="replace")
                self._ended = not keys
                if keys:
                    return keys.lower()
        return "q" if self._ended else ""

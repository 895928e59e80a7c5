"""Keeps other threads from delaying the one that moves datagrams."""

from __future__ import annotations

import sys
import threading
from contextlib import contextmanager
from typing import TYPE_CHECKING, Final, TypeVar

if TYPE_CHECKING:
    from collections.abc import Iterator

    from edoras_tools.render.terminal.run import Watcher

_SHOW_S: Final = 0.1
_SWITCH_S: Final = 0.0002
"""How long another thread may keep the interpreter while a datagram waits."""


_Run = TypeVar("_Run")


@contextmanager
def watched(run: _Run, watcher: Watcher[_Run] | None) -> Iterator[None]:
    """Update a watcher from a thread of its own, because drawing takes milliseconds."""
    if watcher is None:
        yield
        return
    finished = threading.Event()

    def show() -> None:
        while not finished.wait(_SHOW_S):
            watcher.update(run)

    thread = threading.Thread(target=show, name="display", daemon=True)
    thread.start()
    try:
        yield
    finally:
        finished.set()
        thread.join()
        watcher.update(run)


@contextmanager
def threads_take_turns() -> Iterator[None]:
    """Make busy threads switch soon to the one that moves datagrams."""
    before = sys.getswitchinterval()
    sys.setswitchinterval(_SWITCH_S)
    try:
        yield
    finally:
        sys.setswitchinterval(before)

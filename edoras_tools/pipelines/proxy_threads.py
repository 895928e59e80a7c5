"""Threads beside the one that moves datagrams: how they are kept from holding it up."""

from __future__ import annotations

import sys
import threading
from contextlib import contextmanager
from typing import TYPE_CHECKING, Final, Protocol, TypeVar

if TYPE_CHECKING:
    from collections.abc import Iterator

_SHOW_S: Final = 0.1
_SWITCH_S: Final = 0.0002
"""How long another thread may keep the interpreter to itself while a datagram waits."""


_Run = TypeVar("_Run")
_Seen_contra = TypeVar("_Seen_contra", contravariant=True)


class Watcher(Protocol[_Seen_contra]):
    """What looks on, from a thread of its own."""

    def update(self, run: _Seen_contra, /) -> None:
        """Show where things are."""


@contextmanager
def shown(run: _Run, watcher: Watcher[_Run] | None) -> Iterator[None]:
    """Have a watcher look on from a thread of its own: drawing takes milliseconds."""
    if watcher is None:
        yield
        return
    done = threading.Event()

    def show() -> None:
        while not done.wait(_SHOW_S):
            watcher.update(run)

    thread = threading.Thread(target=show, name="display", daemon=True)
    thread.start()
    try:
        yield
    finally:
        done.set()
        thread.join()
        watcher.update(run)


@contextmanager
def threads_take_turns() -> Iterator[None]:
    """Have a thread that works long give way soon to the one that moves datagrams."""
    before = sys.getswitchinterval()
    sys.setswitchinterval(_SWITCH_S)
    try:
        yield
    finally:
        sys.setswitchinterval(before)

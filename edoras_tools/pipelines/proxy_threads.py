"""Threads beside the one that moves datagrams: how they are kept from holding it up."""

from __future__ import annotations

import sys
import threading
from contextlib import contextmanager
from typing import TYPE_CHECKING, Final, Protocol

if TYPE_CHECKING:
    from collections.abc import Iterator

    from edoras_tools.pipelines.proxy import Proxy

_SHOW_S: Final = 0.1
_SWITCH_S: Final = 0.0002
"""How long another thread may keep the interpreter to itself while a datagram waits."""


class Watcher(Protocol):
    """What looks on, from a thread of its own."""

    def update(self, proxy: Proxy) -> None:
        """Show where things are."""


@contextmanager
def shown(proxy: Proxy, watcher: Watcher | None) -> Iterator[None]:
    """Have a watcher look on from a thread of its own: drawing takes milliseconds."""
    if watcher is None:
        yield
        return
    done = threading.Event()

    def show() -> None:
        while not done.wait(_SHOW_S):
            watcher.update(proxy)

    thread = threading.Thread(target=show, name="proxy display", daemon=True)
    thread.start()
    try:
        yield
    finally:
        done.set()
        thread.join()
        watcher.update(proxy)


@contextmanager
def threads_take_turns() -> Iterator[None]:
    """Have a thread that works long give way soon to the one that moves datagrams."""
    before = sys.getswitchinterval()
    sys.setswitchinterval(_SWITCH_S)
    try:
        yield
    finally:
        sys.setswitchinterval(before)

"""Ctrl-C that ends work cleanly: what was captured is written, what was counted is shown."""

from __future__ import annotations

import signal
import threading
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from types import FrameType

    from edoras_tools.model import PacketBatch
    from edoras_tools.sources import Source


@contextmanager
def on_interrupt(stop: Callable[[], None], *, patient: bool = False) -> Iterator[threading.Event]:
    """Call ``stop`` at the first Ctrl-C or SIGTERM; a second one interrupts at once.

    Args:
        stop: ends the work.
        patient: a second one says nothing new: a program that others end gets Ctrl-C from the terminal and
            SIGTERM from them.

    Yields:
        an event that is set once it was called. Outside the main thread signals stay as they are.
    """
    asked = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield asked
        return

    def handle(_signal: int, _frame: FrameType | None) -> None:
        if asked.is_set():
            if patient:
                return
            raise KeyboardInterrupt
        asked.set()
        stop()

    before = {number: signal.signal(number, handle) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield asked
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def interruptible(source: Source) -> Iterator[tuple[Iterator[PacketBatch], threading.Event]]:
    """Let Ctrl-C end the batches of a source: a live one's after all that arrived, a file's or a pipe's now.

    Yields:
        the batches, and an event that is set once they were interrupted.
    """
    stop = getattr(source, "stop", None)
    waiting = False

    def interrupt() -> None:
        # Only the wait for more may be cut short, never the work on what came.
        if waiting:
            raise KeyboardInterrupt

    def batches() -> Iterator[PacketBatch]:
        nonlocal waiting
        given = source.batches()
        while not asked.is_set():
            waiting = True
            try:
                batch = next(given, None)
            except KeyboardInterrupt:
                if asked.is_set():
                    return
                raise
            finally:
                waiting = False
            if batch is None:
                return
            yield batch

    with on_interrupt(stop or interrupt) as asked:
        yield source.batches() if stop else batches(), asked

"""Ends work cleanly at Ctrl-C: captured data is written, and counts are shown. Also reads single keys.

A signal handler runs in the main thread, between any two of its steps: if that thread holds a lock, a
handler that needs the same lock waits for ever. ``stop`` may take locks (of an ``Event``, of a socket), so
it is called in a thread of its own.

When its terminal is closed, a process gets SIGHUP, and every later write to the terminal fails. Output to
the terminal is then discarded, so that the work can still end normally.
"""

from __future__ import annotations

import _thread
import errno
import os
import select
import signal
import sys
import threading
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, Any, Final, TypeVar

from edoras_tools.errors import InterruptError
from edoras_tools.io.outputs import ENDING

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from types import FrameType

    from typing_extensions import Self

    from edoras_tools.io import Source
    from edoras_tools.model import PacketBatch
    from edoras_tools.render.terminal.text import Watcher


_SHOW_S: Final = 0.1
_SWITCH_S: Final = 0.0002
"""Longest time that another thread may hold the interpreter while a datagram waits."""


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


_HANG_UP = getattr(signal, "SIGHUP", None)


@contextmanager
def on_interrupt(
    stop: Callable[[], None], *, patient: bool = False, in_handler: bool = False
) -> Iterator[threading.Event]:
    """Call ``stop`` at the first Ctrl-C, SIGTERM or SIGHUP; a second Ctrl-C or SIGTERM interrupts at once.

    SIGHUP requests a clean end, however often it comes. So does one SIGTERM after another signal, because
    closing a terminal or ending a process group sends several. A SIGHUP that is ignored, as under ``nohup``,
    stays ignored.

    Args:
        stop: ends the work; called in a thread of its own.
        patient: ignore second signals: a program that another program ends gets Ctrl-C from the terminal and
            SIGTERM from that program.
        in_handler: call ``stop`` inside the handler instead: it must take no lock, and may raise.

    Yields:
        An event that is set once ``stop`` was called. Outside the main thread, signals are not handled.
    """
    interrupted = threading.Event()
    terminated = False
    if threading.current_thread() is not threading.main_thread():
        yield interrupted
        return

    def handle(number: int, _frame: FrameType | None) -> None:
        nonlocal terminated
        if number == _HANG_UP:
            _leave_terminal()
        again, terminated = terminated, terminated or number == signal.SIGTERM
        if interrupted.is_set():
            if patient or not (number == signal.SIGINT or (number == signal.SIGTERM and again)):
                return
            raise KeyboardInterrupt
        interrupted.set()
        if in_handler:
            stop()
        else:
            _thread.start_new_thread(stop, ())

    before = {
        number: signal.signal(number, handle)
        for number in ENDING
        if number != _HANG_UP or signal.getsignal(number) is not signal.SIG_IGN
    }
    try:
        yield interrupted
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _leave_terminal() -> None:
    """Redirect output to a closed terminal to the null device."""
    import termios

    for fileno in (1, 2):
        try:
            termios.tcgetattr(fileno)
        except termios.error as error:
            if error.args[0] == errno.EIO:
                os.dup2(os.open(os.devnull, os.O_WRONLY), fileno)


def interrupted(source: Source) -> InterruptError:
    """Return the error that a file or pipe ends with after Ctrl-C."""
    return InterruptError(f"{source.info.name}: interrupted; everything before was read")


@contextmanager
def interruptible(
    source: Source, *, patient: bool = False
) -> Iterator[tuple[Iterator[PacketBatch], threading.Event]]:
    """Let Ctrl-C end the batches of a source: a live one after all that has arrived, a file or pipe at once.

    Args:
        patient: see ``on_interrupt``.

    Yields:
        The batches, and an event that is set once they were interrupted. Those of a file or pipe then end
        with an ``InterruptError``.
    """
    live, waiting = source.live, False

    def interrupt() -> None:
        # Interrupt only the wait for the next batch, never the work on one.
        if waiting:
            raise KeyboardInterrupt

    def batches() -> Iterator[PacketBatch]:
        nonlocal waiting
        batches_of = source.batches()
        while not stop_event.is_set():
            waiting = True
            try:
                batch = next(batches_of, None)
            except KeyboardInterrupt:
                if stop_event.is_set():
                    break
                raise
            finally:
                waiting = False
            if batch is None:
                return
            yield batch
        raise interrupted(source)

    with on_interrupt(source.stop if live else interrupt, patient=patient, in_handler=not live) as stop_event:
        yield source.batches() if live else batches(), stop_event


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

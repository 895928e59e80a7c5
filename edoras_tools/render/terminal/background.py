"""A terminal that keeps nobody waiting: Ctrl-S or a shell that hangs stops drawing, nothing else."""

from __future__ import annotations

import io
import threading
from contextlib import contextmanager
from typing import IO, TYPE_CHECKING, Final, cast

if TYPE_CHECKING:
    from collections.abc import Iterator

    from rich.console import Console

_LAST_S: Final = 2.0
"""How long the end waits for a terminal that takes nothing."""


class BackgroundStream(io.TextIOBase):
    """A text stream whose writes a thread hands on to another one.

    Args:
        stream: the other one.
    """

    def __init__(self, stream: IO[str]) -> None:
        self._stream = stream
        self._parts: list[str] = []
        self._changed = threading.Condition()
        self._waiting = ""
        self._writing = False
        self._failure: OSError | None = None
        self._thread: threading.Thread | None = None

    @property
    def encoding(self) -> str:  # type: ignore[override]
        """That of the other stream."""
        return str(getattr(self._stream, "encoding", "utf-8"))

    def isatty(self) -> bool:
        """Tell whether the other stream is a terminal."""
        return self._stream.isatty()

    def fileno(self) -> int:
        """Return the file descriptor of the other stream."""
        return self._stream.fileno()

    @property
    def idle(self) -> bool:
        """Whether everything is handed on."""
        return not (self._waiting or self._writing)

    def write(self, text: str) -> int:
        """Take text.

        Raises:
            OSError: the other stream has failed.
        """
        if self._failure:
            raise self._failure
        self._parts.append(text)
        return len(text)

    def flush(self) -> None:
        """Have the thread hand on what was taken; do not wait for it."""
        if self._parts:
            with self._changed:
                self._waiting += "".join(self._parts)
                self._changed.notify_all()
            self._parts.clear()
            if self._thread is None:
                self._thread = threading.Thread(target=self._run, name="terminal", daemon=True)
                self._thread.start()

    def finish(self) -> None:
        """Wait until all is handed on, but not for ever."""
        self.flush()
        with self._changed:
            self._changed.wait_for(lambda: self.idle, _LAST_S)

    def _run(self) -> None:
        while True:
            with self._changed:
                self._writing = False
                self._changed.notify_all()
                self._changed.wait_for(lambda: self._waiting)
                text, self._waiting, self._writing = self._waiting, "", True
            try:
                if not self._failure:
                    self._stream.write(text)
                    self._stream.flush()
            except OSError as error:
                self._failure = error


@contextmanager
def background(console: Console) -> Iterator[BackgroundStream | None]:
    """Have a console's terminal written to by a thread; yield what does, None where it is no terminal."""
    stream = console.file
    if not stream.isatty():
        yield None
        return
    made = BackgroundStream(stream)
    console.file = cast("IO[str]", made)  # all that rich needs of it
    try:
        yield made
    finally:
        made.finish()
        console.file = stream

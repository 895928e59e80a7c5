"""The errors of this package, a small tree, and ``OnFailure``, which undoes what was begun before one.

::

    EdorasError
    ├── WireError          bytes that cannot be read or values that cannot be written
    │   ├── TruncatedError     a layer needs more bytes than there are
    │   └── FieldError         a value does not fit its field
    ├── ConfigError        a mission file, or an option, that cannot be honoured
    ├── RouteError         a topic, type or MsgId that is not configured or not known
    └── CaptureError       a capture, a recording or an interface that cannot be read or written

Every message is one line (``ConfigError``: one line a mistake) that says what, where and what to do.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple


class EdorasError(Exception):
    """Root of every error that this package raises on purpose.

    Attributes:
        exit_code: exit code of a command that ends with this error: 1 failed, 2 usage, 130
            interrupted.
    """

    exit_code = 1


class WireError(EdorasError):
    """Bytes that cannot be read, or values that cannot be written."""


class TruncatedError(WireError):
    """A layer needs more bytes than there are.

    Attributes:
        layer: name of the layer, as in the decode tree.
        offset: where the layer starts, in bytes from the start of the datagram.
        need: bytes the layer needs.
        have: bytes that are there.
    """

    def __init__(self, layer: str, offset: int, need: int, have: int) -> None:
        super().__init__(f"{layer} at byte {offset} needs {need} bytes, {have} are there")
        self.layer = layer
        self.offset = offset
        self.need = need
        self.have = have


class FieldError(WireError):
    """A value does not fit its field.

    Attributes:
        layer: name of the layer.
        field: name of the field.
    """

    def __init__(self, layer: str, field: str, why: str) -> None:
        super().__init__(f"{layer}.{field}: {why}")
        self.layer = layer
        self.field = field


class ConfigError(EdorasError):
    """A configuration that cannot be honoured: all of its mistakes at once.

    Attributes:
        mistakes: one line each, ``FILE:LINE: KEY: what is wrong; what is allowed``.
    """

    exit_code = 2

    def __init__(self, *mistakes: str) -> None:
        super().__init__("\n".join(mistakes))
        self.mistakes: Sequence[str] = mistakes


class RouteError(EdorasError):
    """A topic, type or MsgId that is not configured or not known."""


class CaptureError(EdorasError):
    """A capture, a recording or an interface that cannot be read or written.

    A source raises it only *after* it has handed over everything that could be read.
    """


class InterruptError(CaptureError):
    """Ctrl-C, SIGTERM or SIGHUP ended the reading of a file or pipe before its end."""

    exit_code = 130


class NoDatagramsError(CaptureError):
    """A recording of topics, as other tools make it: it holds messages and no datagrams.

    Attributes:
        path: path as it was named.
        files: files of the recording, each a ``SettledFile``; a reader that reads no topics ignores them.
    """

    path: str = ""
    files: Sequence[Any] = ()


@contextmanager
def os_errors(failure: str) -> Iterator[None]:
    """Turn an ``OSError`` inside into a ``CaptureError`` with ``failure`` and the system's reason.

    Raises:
        CaptureError: there was an ``OSError``.
    """
    try:
        yield
    except OSError as error:
        raise CaptureError(f"{failure}: {error.strerror or error}") from error


class OnFailure(NamedTuple):
    """Calls ``undo`` if what is inside fails; the error goes on. ``ExitStack.pop_all`` undoes several."""

    undo: Callable[[], object]

    def __enter__(self) -> None:
        """Begin what may fail."""

    def __exit__(self, kind: object, *_: object) -> None:
        if kind is not None:
            self.undo()

"""The progress of a run on standard error, and the line printed at its end; the live table is in ``info``."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence, Sized
from contextlib import contextmanager
from time import monotonic
from typing import TYPE_CHECKING, Any, Final, TypeVar

from edoras_tools import words
from edoras_tools.io import Source, SourceOver
from edoras_tools.io.outputs import output_name
from edoras_tools.render.terminal.palette import detect_terminal
from edoras_tools.render.terminal.text import clean, size_of
from edoras_tools.words import plural

if TYPE_CHECKING:
    from pathlib import Path

    from edoras_tools.io.formats.watched import Keep
    from edoras_tools.model import PacketBatch
    from edoras_tools.render.terminal.progress import FileProgress


_Printed = TypeVar("_Printed", bound="Sized")
_PATIENCE_S: Final = 0.3
"""Time from which work shows a bar, s."""


class Followed(SourceOver):
    """A source that shows the progress of reading on a terminal, if reading takes long."""

    def __init__(self, source: Source, *, quiet: bool) -> None:
        super().__init__(source)
        self._shows = not quiet and detect_terminal(sys.stderr).interactive
        self._since = monotonic()
        self._bar: FileProgress | None = None

    def batches(self) -> Iterator[PacketBatch]:
        """Yield the source's batches; the bar vanishes at their end."""
        try:
            for batch in self._source.batches():
                if self._shows and monotonic() - self._since > _PATIENCE_S:
                    self._read()
                yield batch
        finally:
            self._clear()

    def printed(self, blocks: Iterable[_Printed]) -> Iterator[_Printed]:
        """Yield blocks to print; the bar disappears before each, and waits again."""
        for block in blocks:
            if len(block):
                self._clear()
            yield block

    def _read(self) -> None:
        from edoras_tools.render.terminal.palette import error_console
        from edoras_tools.render.terminal.progress import FileProgress

        self._bar = self._bar or FileProgress(self._source.info.name, console=error_console())
        self._bar.read(self._source)

    def _clear(self) -> None:
        if self._bar is not None:
            self._bar.__exit__()
        self._bar, self._since = None, monotonic()


@contextmanager
def byte_progress(path: Path, *, quiet: bool) -> Iterator[Callable[[int, int], None]]:
    """Show the checked bytes of a file on standard error; yield a function of checked and all bytes."""
    if quiet or not detect_terminal(sys.stderr).interactive:
        yield lambda _count, _all: None
        return
    from edoras_tools.render.terminal.palette import error_console
    from edoras_tools.render.terminal.progress import FileProgress

    with FileProgress(path.name, console=error_console()) as bar:
        yield lambda count, of: bar.step("checking", count, of, words.size)


def recorded(summary: Mapping[str, Any], outputs: Sequence[Path], keep: Keep | None = None) -> str:
    """Return the line about the contents of a recording.

    Args:
        summary: in the shape of ``info --json``.
        outputs: written files, or the directory; at least one.
        keep: deleted parts of it.
    """
    rows = summary.get("routes", ())
    topics = [row.get("count", 0) for row in rows if row.get("topic")]
    topics += [count for row in rows for count in row.get("topics", {}).values()]
    messages = sum(topics)
    total = summary.get("messages") or summary.get("datagrams")
    over = f" over {words.duration((summary['end_ns'] - summary['start_ns']) / 1e9)}" if total else ""
    on = f"{plural(messages, 'message')} on {plural(len(topics), 'topic')}"
    if samples := summary.get("samples"):
        on += f", {plural(sum(row['count'] for row in samples), 'sample')} of DDS"
    if "messages" in summary:  # a recording without datagrams
        noun, parts = "message", [on + over]
    else:
        noun, parts = "datagram", [plural(summary.get("datagrams", 0), "datagram"), on]
        parts[0] += over
    if written := sum(map(size_of, outputs)):
        parts.append(words.size(written))
    if keep and keep.deleted:
        parts.append(f"{plural(keep.deleted, 'older file')} with {plural(keep.datagrams, noun)} deleted")
    name = output_name(outputs[0]) if len(outputs) == 1 else f"{outputs[0]} to {outputs[-1].name}"
    return f"{clean(name)}: {', '.join(parts)}"

"""What is shown of a run on standard error, and the line printed at its end."""

from __future__ import annotations

import sys
from contextlib import AbstractContextManager, contextmanager, nullcontext
from time import monotonic
from typing import TYPE_CHECKING, Any, Final, TypeVar

from edoras_tools.io.outputs import output_name
from edoras_tools.render import units
from edoras_tools.render.terminal.run import CountedSource, ReadingRun, Watcher, size_of
from edoras_tools.render.terminal.terminal import look
from edoras_tools.render.terminal.text import clean
from edoras_tools.words import plural

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence, Sized
    from pathlib import Path

    from edoras_tools.io import Source
    from edoras_tools.io.formats.watched import Keep
    from edoras_tools.model import PacketBatch
    from edoras_tools.render.terminal.progress import FileProgress

_Printed = TypeVar("_Printed", bound="Sized")
_PATIENCE_S: Final = 0.3
"""Shorter work shows no bar."""


def watcher(
    source: CountedSource, output: Path | None, *, quiet: bool, live: bool
) -> AbstractContextManager[Watcher[ReadingRun] | None]:
    """Return what shows a run on standard error: a live table, a progress bar, or nothing.

    Args:
        output: what is written, if anything is.
        quiet: show nothing; neither is anything shown where standard error is no terminal.
        live: the source is live, so there is no end for a progress bar.
    """
    if quiet or not look(sys.stderr).interactive:
        return nullcontext()
    from edoras_tools.render.terminal.console import error_console

    name = source.info.name
    if not live:
        from edoras_tools.render.terminal.progress import FileProgress

        return FileProgress(name, console=error_console())
    from edoras_tools.render.capture.live import live_table

    title = f"{name} → {output}" if output else name
    return live_table(title, error_console(), output)


class Followed:
    """A source that shows how far it is read, where standard error is a terminal and that takes a while.

    All else is the source's own.
    """

    def __init__(self, source: Source, *, quiet: bool) -> None:
        self._source = source
        self._shows = not quiet and look(sys.stderr).interactive
        self._since = monotonic()
        self._bar: FileProgress | None = None

    def __getattr__(self, name: str) -> Any:
        return getattr(self._source, name)

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
        """Yield what is about to be printed: the bar gives way to it, and waits again."""
        for block in blocks:
            if len(block):
                self._clear()
            yield block

    def _read(self) -> None:
        from edoras_tools.render.terminal.console import error_console
        from edoras_tools.render.terminal.progress import FileProgress

        self._bar = self._bar or FileProgress(self._source.info.name, console=error_console())
        self._bar.read(self._source)

    def _clear(self) -> None:
        if self._bar is not None:
            self._bar.__exit__()
        self._bar, self._since = None, monotonic()


@contextmanager
def byte_progress(path: Path, *, quiet: bool) -> Iterator[Callable[[int, int], None]]:
    """Show on standard error how many bytes of a file are checked: yield what takes them and all."""
    if quiet or not look(sys.stderr).interactive:
        yield lambda _count, _all: None
        return
    from edoras_tools.render.terminal.console import error_console
    from edoras_tools.render.terminal.progress import FileProgress

    with FileProgress(path.name, console=error_console()) as bar:
        yield lambda count, of: bar.step("checking", count, of, units.size)


def recorded(summary: Mapping[str, Any], outputs: Sequence[Path], keep: Keep | None = None) -> str:
    """Return the line that says what a recording holds.

    Args:
        summary: in the shape of ``info --json``.
        outputs: the files or the directory written, at least one.
        keep: what was deleted of it again.
    """
    topics = [row for row in summary.get("routes", ()) if row.get("topic")]
    messages = sum(row.get("count", 0) for row in topics)
    total = summary.get("messages") or summary.get("datagrams")
    over = f" over {units.duration((summary['end_ns'] - summary['start_ns']) / 1e9)}" if total else ""
    on = f"{plural(messages, 'message')} on {plural(len(topics), 'topic')}"
    if samples := summary.get("samples"):
        on += f", {plural(sum(row['count'] for row in samples), 'sample')} of DDS"
    if "messages" in summary:  # of a recording without datagrams
        what, words = "message", [on + over]
    else:
        what, words = "datagram", [plural(summary.get("datagrams", 0), "datagram"), on]
        words[0] += over
    written = sum(map(size_of, outputs))
    if written:
        words.append(units.size(written))
    if keep and keep.deleted:
        words.append(f"{plural(keep.deleted, 'older file')} with {plural(keep.datagrams, what)} deleted")
    name = output_name(outputs[0]) if len(outputs) == 1 else f"{outputs[0]} to {outputs[-1].name}"
    return f"{clean(name)}: {', '.join(words)}"

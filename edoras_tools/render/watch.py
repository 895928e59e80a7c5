"""What a run shows while it goes on, and the line that it leaves behind."""

from __future__ import annotations

import sys
from contextlib import nullcontext
from typing import TYPE_CHECKING, Any, Protocol

from edoras_tools.render import units
from edoras_tools.render.terminal import look
from edoras_tools.render.text import clean

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from contextlib import AbstractContextManager
    from pathlib import Path

    from edoras_tools.model import SourceInfo, SourceStatistics


class Source(Protocol):
    """Something that counts what it reads."""

    @property
    def info(self) -> SourceInfo:
        """What it is."""
        ...

    @property
    def statistics(self) -> SourceStatistics:
        """The counts, as they are now."""
        ...


class Report(Protocol):
    """A run that is under way."""

    @property
    def source(self) -> Source:
        """Where the datagrams come from."""
        ...

    def summary(self) -> Mapping[str, Any]:
        """Return what there is so far, in the shape of ``info --json``."""
        ...


class Watcher(Protocol):
    """Looks on; cheap enough to be called for every batch."""

    def update(self, report: Report) -> None:
        """Show where things are."""


def watcher(
    source: Source, output: Path | None, *, quiet: bool, live: bool
) -> AbstractContextManager[Watcher | None]:
    """Return what shows a run on standard error: a live table, a progress bar, or nothing.

    Args:
        source: what is read.
        output: what is written, if anything is.
        quiet: show nothing; neither is anything shown where standard error is no terminal.
        live: the source is live: it has no end that a bar could show.
    """
    if quiet or not look(sys.stderr).interactive:
        return nullcontext()
    from edoras_tools.render.console import error_console

    name = source.info.name
    if not live:
        from edoras_tools.render.progress import FileProgress

        return FileProgress(name, console=error_console())
    from edoras_tools.render.live import LiveTable

    title = f"{name} → {output}" if output else name
    return LiveTable(title, console=error_console(), output=output)


def recorded(summary: Mapping[str, Any], outputs: Sequence[Path]) -> str:
    """Return the line that says what a recording holds.

    Args:
        summary: in the shape of ``info --json``.
        outputs: the files or the directory written, at least one.
    """
    topics = [row for row in summary.get("routes", ()) if row.get("topic")]
    messages = sum(row.get("count", 0) for row in topics)
    words = [units.plural(summary.get("datagrams", 0), "datagram")]
    if summary.get("datagrams"):
        words[0] += f" over {units.duration((summary['end_ns'] - summary['start_ns']) / 1e9)}"
    words.append(f"{units.plural(messages, 'message')} on {units.plural(len(topics), 'topic')}")
    written = sum(map(size_of, outputs))
    if written:
        words.append(units.size(written))
    name = str(outputs[0]) if len(outputs) == 1 else f"{outputs[0]} to {outputs[-1].name}"
    return f"{clean(name)}: {', '.join(words)}"


def size_of(path: Path) -> int:
    """Return the bytes of a file, or of a directory's files; 0 while there is none."""
    try:
        return sum(item.stat().st_size for item in path.iterdir()) if path.is_dir() else path.stat().st_size
    except OSError:
        return 0

"""The interfaces between a running command and the view that shows it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Protocol, TypeVar

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from edoras_tools.model import SourceInfo, SourceStatistics


_Run_contra = TypeVar("_Run_contra", contravariant=True)


class CountedSource(Protocol):
    """A source and its counts."""

    @property
    def info(self) -> SourceInfo:
        """What it is."""
        ...

    @property
    def statistics(self) -> SourceStatistics:
        """The counts, as they are now."""
        ...


class Progress(Protocol):
    """Receives the progress of long work; cheap to call."""

    def read(self, source: CountedSource) -> None:
        """Take how far a source is read."""
        ...

    def step(self, activity: str, count: int, of: int) -> None:
        """Take how far other work is, as ``judging``, 3, 57."""
        ...


class ReadingRun(Protocol):
    """A run that reads a source."""

    @property
    def source(self) -> CountedSource:
        """Where the datagrams come from."""
        ...

    def summary(self) -> Mapping[str, Any]:
        """Return what there is so far, in the shape of ``info --json``."""
        ...


class Watcher(Protocol[_Run_contra]):
    """A view that is shown a run again and again; cheap enough to be called for every batch."""

    def update(self, run: _Run_contra, /) -> None:
        """Show the run as it is now."""


def size_of(path: Path) -> int:
    """Return the bytes of a file, or of a directory's files; 0 while there is none."""
    try:
        return sum(item.stat().st_size for item in path.iterdir()) if path.is_dir() else path.stat().st_size
    except OSError:
        return 0

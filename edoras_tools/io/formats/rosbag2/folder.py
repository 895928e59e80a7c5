"""Reads a rosbag2 directory of ours as one capture: its parts in order of time."""

from __future__ import annotations

from contextlib import ExitStack, closing
from dataclasses import replace
from itertools import chain
from typing import TYPE_CHECKING

from edoras_tools.io.formats.merge import MergedSource, recorded_host
from edoras_tools.io.formats.rosbag2.reader import METADATA, files_of

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from edoras_tools.io import Source
    from edoras_tools.model import HostCounters, SourceInfo


class FolderSource(MergedSource):
    """A rosbag2 directory.

    Args:
        path: of the directory.
        parts: its files, in order.
    """

    def __init__(self, path: Path, parts: Sequence[Source]) -> None:
        super().__init__(parts)
        self._path = path

    @property
    def info(self) -> SourceInfo:
        """Information on all parts, under the name of the directory."""
        return replace(super().info, name=str(self._path), kind="rosbag2")

    def host(self) -> list[HostCounters]:
        """Return the kernel's counters of the recording host, of all parts."""
        return [*chain.from_iterable(map(recorded_host, self._sources))]


def open_folder(path: Path, open_part: Callable[[Path], Source]) -> Source | None:
    """Open a directory; None if it is not one recording: it has no metadata, or no part is there.

    Args:
        path: of the directory.
        open_part: opens one of its files.

    Raises:
        CaptureError: a part cannot be read.
        NoDatagramsError: it is another tool's, and holds topics only.
    """
    files = files_of(path) if (path / METADATA).exists() else []
    if not files:
        return None
    with ExitStack() as opened:
        parts = [opened.enter_context(closing(open_part(file))) for file in files]
        opened.pop_all()
    return FolderSource(path, parts)

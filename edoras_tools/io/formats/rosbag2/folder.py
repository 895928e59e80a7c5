"""Reads a rosbag2 directory of ours as one capture: its parts in order of time."""

from __future__ import annotations

from contextlib import ExitStack, closing
from dataclasses import replace
from itertools import chain
from typing import TYPE_CHECKING, Any

from edoras_tools.errors import CaptureError, NoDatagramsError
from edoras_tools.io.formats.merge import MergedSource, recorded_host
from edoras_tools.io.formats.rosbag2.reader import METADATA, files_of

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence
    from pathlib import Path

    from edoras_tools.io import Source
    from edoras_tools.model import HostCounters, SourceInfo


class FolderSource(MergedSource):
    """A rosbag2 directory.

    Args:
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
        open_part: opens one of its files.

    Raises:
        CaptureError: a part cannot be read.
        NoDatagramsError: it is another tool's, and holds topics only.
    """
    files = files_of(path)
    whole = (path / METADATA).exists()
    if not files or not (whole or len(files) == 1):
        return None
    with ExitStack() as opened:
        parts = [opened.enter_context(closing(part)) for part in _parts(path, files, open_part)]
        if not whole:
            return None
        opened.pop_all()
    return FolderSource(path, parts)


def _parts(path: Path, files: Sequence[Path], open_part: Callable[[Path], Source]) -> Iterator[Source]:
    """Open the files of a directory: all hold datagrams, or all hold topics only."""
    topics: list[Any] = []
    reasons: list[str] = []
    for number, file in enumerate(files):
        try:
            part = open_part(file)
        except NoDatagramsError as error:
            topics += error.files
            reasons.append(str(error))
            part = None
        if part is not None:
            yield part
        if len(reasons) not in {0, number + 1}:
            raise CaptureError(
                f"{path}: some files hold datagrams and others topics only; name them one by one"
            )
    if reasons:
        refusal = NoDatagramsError(reasons[0])
        refusal.files = topics
        raise refusal

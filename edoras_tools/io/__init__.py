"""Where datagrams come from and where they go: files, live capture, sockets, recordings.

A ``Source`` yields packet batches, a ``Sink`` writes them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from collections.abc import Iterator

    from edoras_tools.model import Columns, PacketBatch, SourceInfo, SourceStatistics

__all__ = ["Sink", "Source"]


class Source(Protocol):
    """Yields datagrams, one batch at a time."""

    @property
    def info(self) -> SourceInfo:
        """Information on the source."""
        ...

    @property
    def statistics(self) -> SourceStatistics:
        """The counts so far; the same object each time."""
        ...

    def batches(self) -> Iterator[PacketBatch]:
        """Yield all datagrams, once.

        Raises:
            CaptureError: the input is damaged; raised after everything that could be read.
        """
        ...

    def close(self) -> None:
        """Close files and sockets; may be called at any time, and twice."""
        ...


class LiveSource(Source, Protocol):
    """A source without an end."""

    def stop(self) -> None:
        """Let ``batches`` end after what has arrived; may be called from a signal handler."""
        ...


class Sink(Protocol):
    """The interface of every sink."""

    def write(self, batch: PacketBatch, columns: Columns) -> None:
        """Write a batch and its columns; the caller must not change them afterwards.

        Raises:
            CaptureError: the output cannot be written.
        """

    def flush(self) -> None:
        """Write everything received so far to the file; called at least once a second when live.

        Raises:
            CaptureError: the output cannot be written.
        """

    def close(self, statistics: SourceStatistics) -> None:
        """Complete the output and close it; closing twice does nothing.

        Args:
            statistics: the source's counts, for formats that can store them.

        Raises:
            CaptureError: the output cannot be written.
        """

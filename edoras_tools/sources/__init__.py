"""Where datagrams come from: files, pipes, live capture, sockets. Each is a ``Source`` of packet batches."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from edoras_tools.model import PacketBatch, SourceInfo, SourceStatistics


class Source(Protocol):
    """Hands over datagrams, a batch at a time."""

    @property
    def info(self) -> SourceInfo:
        """What the source is."""
        ...

    @property
    def statistics(self) -> SourceStatistics:
        """What it counted so far; the same object each time."""
        ...

    def batches(self) -> Iterator[PacketBatch]:
        """Hand over all datagrams, once.

        Raises:
            CaptureError: the input is not sound; raised after everything that could be read.
        """
        ...

    def close(self) -> None:
        """Let go of files and sockets; may be called at any time, and twice."""
        ...


def open_file(path: str | Path) -> Source:
    """Open a capture or a recording, told by its content: pcap, pcapng (gzip or zstd around them) or MCAP.

    Args:
        path: a file, a named pipe, or ``-`` for standard input.

    Raises:
        CaptureError: there is nothing at ``path`` that can be read.
    """
    from edoras_tools.sources.files import open_capture

    return open_capture(path)

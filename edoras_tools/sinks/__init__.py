"""Where datagrams go: recordings and captures, written batch by batch."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from edoras_tools.model import Columns, PacketBatch, SourceStatistics

__all__ = ["Sink"]


class Sink(Protocol):
    """What every sink is."""

    def write(self, batch: PacketBatch, columns: Columns) -> None:
        """Take a batch and what was read from it; nobody may write into them afterwards.

        Raises:
            CaptureError: the output cannot be written.
        """

    def flush(self) -> None:
        """Get everything taken so far to the file; called at least once a second when live.

        Raises:
            CaptureError: the output cannot be written.
        """

    def close(self, statistics: SourceStatistics) -> None:
        """Make the output whole and close it; closing twice does nothing.

        Args:
            statistics: what the source counted, for formats that can hold it.

        Raises:
            CaptureError: the output cannot be written.
        """

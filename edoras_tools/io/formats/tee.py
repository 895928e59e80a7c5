"""Writes one stream of batches to several sinks."""

from __future__ import annotations

from contextlib import ExitStack
from typing import TYPE_CHECKING

from edoras_tools.io import Sink

if TYPE_CHECKING:
    from collections.abc import Sequence

    from edoras_tools.model import Columns, PacketBatch, SourceStatistics
    from edoras_tools.sessions.faults.fault import Fault


class Tee(Sink):
    """A ``Sink`` that forwards to others, in order; an error of one ends it for all.

    Args:
        sinks: the sinks to write to.

    Raises:
        CaptureError: from every method: a sink cannot be written.
    """

    def __init__(self, sinks: Sequence[Sink]) -> None:
        self._sinks = tuple(sinks)

    def write(self, batch: PacketBatch, columns: Columns) -> None:
        """Write a batch to all sinks."""
        for sink in self._sinks:
            sink.write(batch, columns)

    def write_faults(self, faults: Sequence[Fault]) -> None:
        """Write injected faults to all sinks."""
        for sink in self._sinks:
            sink.write_faults(faults)

    def flush(self) -> None:
        """Flush all sinks."""
        for sink in self._sinks:
            sink.flush()

    def close(self, statistics: SourceStatistics) -> None:
        """Close all sinks, even if one fails."""
        with ExitStack() as stack:
            for sink in self._sinks:
                stack.callback(sink.close, statistics)

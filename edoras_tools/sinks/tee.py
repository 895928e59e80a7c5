"""One stream of batches into several sinks."""

from __future__ import annotations

from contextlib import ExitStack
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Sequence

    from edoras_tools.model import Columns, PacketBatch, SourceStatistics
    from edoras_tools.sessions.faults import Fault
    from edoras_tools.sinks import Sink


class Tee:
    """A ``Sink`` that hands on to others, in their order; one that fails ends it for all.

    Args:
        sinks: where batches go.

    Raises:
        CaptureError: from every method: one of them cannot be written.
    """

    def __init__(self, sinks: Sequence[Sink]) -> None:
        self._sinks = tuple(sinks)

    def write(self, batch: PacketBatch, columns: Columns) -> None:
        """Hand a batch on."""
        for sink in self._sinks:
            sink.write(batch, columns)

    def write_faults(self, faults: Sequence[Fault]) -> None:
        """Hand what was done on purpose to those that hold it."""
        for sink in self._sinks:
            take = getattr(sink, "write_faults", None)
            if take is not None:
                take(faults)

    def flush(self) -> None:
        """Have all get what they took to where it goes."""
        for sink in self._sinks:
            sink.flush()

    def close(self, statistics: SourceStatistics) -> None:
        """Close all, whatever becomes of each."""
        with ExitStack() as stack:
            for sink in self._sinks:
                stack.callback(sink.close, statistics)

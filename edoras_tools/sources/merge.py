"""Several sources into one, in order of time, a batch of each in memory."""

from __future__ import annotations

from dataclasses import fields, replace
from itertools import chain
from typing import TYPE_CHECKING

import numpy as np

from edoras_tools.errors import CaptureError
from edoras_tools.model import PacketBatch, SourceInfo, SourceStatistics, concatenate
from edoras_tools.sources.framing import PADDING

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

    from edoras_tools.sources import Source


def merge(sources: Sequence[Source]) -> Source:
    """Read several sources as one, in order of time.

    Every source keeps its own order: a datagram that is earlier than the one before it counts as late as that
    one. Of equal times the source named first goes first. Datagrams are numbered anew from 1. When a source
    ends in an error the others are read to their end before it is raised.

    Args:
        sources: at least one; a single one is returned as it is. Meant for files: a source that waits makes
            all wait.
    """
    return sources[0] if len(sources) == 1 else MergedSource(sources)


class MergedSource:
    """See ``merge``."""

    def __init__(self, sources: Sequence[Source]) -> None:
        self._sources = list(sources)
        self._statistics = SourceStatistics()

    @property
    def info(self) -> SourceInfo:
        """What the sources are together: all names, the finest resolution, the largest snap length."""
        infos = [source.info for source in self._sources]
        kinds = {info.kind for info in infos}
        return SourceInfo(
            name=", ".join(info.name for info in infos),
            kind=kinds.pop() if len(kinds) == 1 else "merged",
            time_resolution_ns=min(info.time_resolution_ns for info in infos),
            snap_length=max(info.snap_length for info in infos),
            attachments={name: data for info in reversed(infos) for name, data in info.attachments.items()},
            definitions={name: text for info in reversed(infos) for name, text in info.definitions.items()},
        )

    @property
    def statistics(self) -> SourceStatistics:
        """The sums of what the sources counted."""
        total = self._statistics
        for item in fields(SourceStatistics):
            values = [getattr(source.statistics, item.name) for source in self._sources]
            setattr(total, item.name, [*chain(*values)] if item.name == "warnings" else sum(values))
        return total

    def batches(self) -> Iterator[PacketBatch]:
        """Hand over all datagrams in order of time; see ``Source.batches``.

        Raises:
            CaptureError: one of the sources raised it; all of their messages.
        """
        errors: list[str] = []
        heads = [_Head(source, errors) for source in self._sources]
        number = 1
        while heads := [head for head in heads if head.fill()]:
            until = min(int(head.keys[-1]) for head in heads)
            # The first source that ends at this time may go on with it: later ones keep theirs back.
            last = next(place for place, head in enumerate(heads) if head.keys[-1] == until)
            parts = [head.take(until, whole=place <= last) for place, head in enumerate(heads)]
            batch = _in_order([part for part in parts if part is not None])
            yield replace(batch, number=np.arange(number, number + len(batch)))
            number += len(batch)
        if errors:
            raise CaptureError("; ".join(errors))

    def close(self) -> None:
        """Close all sources."""
        for source in self._sources:
            source.close()


class _Head:
    """The datagrams of a source that wait for their turn.

    Attributes:
        keys: i64, the time each datagram counts as: its own, or the latest before it.
    """

    def __init__(self, source: Source, errors: list[str]) -> None:
        self._batches = source.batches()
        self._errors = errors
        self._rest: PacketBatch | None = None
        self._latest = np.iinfo(np.int64).min
        self.keys: NDArray[np.int64] = np.empty(0, dtype=np.int64)

    def fill(self) -> bool:
        """See to it that some datagram waits; False at the end of the source."""
        while not len(self.keys):
            try:
                self._rest = next(self._batches, None)
            except CaptureError as error:
                self._errors.append(str(error))
                return False
            if self._rest is None:
                return False
            self.keys = np.maximum.accumulate(np.maximum(self._rest.time_ns, self._latest))
        return True

    def take(self, until: int, *, whole: bool) -> tuple[PacketBatch, NDArray[np.int64]] | None:
        """Hand over the datagrams before a time, and those of that time where ``whole``, with their keys."""
        count = int(np.searchsorted(self.keys, until, side="right" if whole else "left"))
        if not count or self._rest is None:
            return None
        part, keys = self._rest, self.keys
        self._latest = int(keys[count - 1])
        self.keys = keys[count:]
        if len(self.keys):
            part, self._rest = part.take(slice(count)), part.take(slice(count, None))
        return part, keys[:count]


def _in_order(parts: list[tuple[PacketBatch, NDArray[np.int64]]]) -> PacketBatch:
    """Interleave batches by key; the first batch goes first among equals."""
    if len(parts) == 1:
        return parts[0][0]
    order = np.argsort(np.concatenate([keys for _, keys in parts]), kind="stable")
    return concatenate([_trim(batch) for batch, _ in parts]).take(order)


def _trim(batch: PacketBatch) -> PacketBatch:
    """Leave out the bytes in front of and behind those that the rows use, so that they are not copied."""
    start = int(min(batch.frame_offset.min(), batch.offset.min()))
    end = (
        int(max((batch.frame_offset + batch.frame_length).max(), (batch.offset + batch.length).max()))
        + PADDING
    )
    return replace(
        batch,
        data=batch.data[start:end],
        frame_offset=batch.frame_offset - start,
        offset=batch.offset - start,
    )

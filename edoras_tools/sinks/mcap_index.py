"""MessageIndex records: where in a chunk the messages of each channel are."""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, Final

import numpy as np
from mcap.opcode import Opcode

from edoras_tools.wire.mcap import RECORD_PREFIX_BYTES
from edoras_tools.wire.order import by_value

if TYPE_CHECKING:
    from numpy.typing import NDArray

_HEAD: Final = struct.Struct("<BQHI")
"""Opcode, length of what follows it, channel id, bytes of entries."""
_ENTRY: Final = np.dtype([("log_time", "<u8"), ("offset", "<u8")])


class MessageIndex:
    """The index of one chunk, made as messages go into it.

    Attributes:
        start_ns: log time of the first message in time; 0 before there is one.
        end_ns: log time of the last.
    """

    def __init__(self) -> None:
        self.start_ns = self.end_ns = 0
        self._entries: dict[int, list[NDArray[np.void]]] = {}

    def add(
        self,
        channel_id: NDArray[np.uint16] | int,
        log_time: NDArray[np.int64 | np.uint64],
        position: NDArray[np.int64],
    ) -> None:
        """Take messages, at least one; those of a channel come in the order of their positions.

        Args:
            channel_id: of each or of all.
            log_time: i64 or u64, ns since 1970.
            position: i64, where its record starts in the uncompressed chunk.
        """
        log_time = log_time.view(np.uint64)
        first, last = int(log_time.min()), int(log_time.max())
        self.start_ns = min(self.start_ns, first) if self._entries else first
        self.end_ns = max(self.end_ns, last)
        entries = np.empty(len(position), _ENTRY)
        entries["log_time"], entries["offset"] = log_time, position
        if isinstance(channel_id, int):
            self._entries.setdefault(channel_id, []).append(entries)
            return
        for value, rows in by_value(channel_id):
            self._entries.setdefault(value, []).append(entries[rows])

    @property
    def counts(self) -> dict[int, int]:
        """Messages of each channel, the channels in order."""
        return {channel_id: sum(map(len, pieces)) for channel_id, pieces in sorted(self._entries.items())}

    def records(self) -> tuple[list[bytes | memoryview], dict[int, int]]:
        """Return the records in pieces that follow one another, and where in them each channel's starts."""
        pieces: list[bytes | memoryview] = []
        places: dict[int, int] = {}
        end = 0
        for channel_id, count in self.counts.items():
            size = count * _ENTRY.itemsize
            places[channel_id] = end
            end += _HEAD.size + size
            length = _HEAD.size - RECORD_PREFIX_BYTES + size
            pieces.append(_HEAD.pack(Opcode.MESSAGE_INDEX, length, channel_id, size))
            pieces += [item.view(np.uint8).data for item in self._entries[channel_id]]
        return pieces, places

"""Finds what packets of F Prime hold, by the entries of a dictionary."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from edoras_tools.structs.payloads import StructPayloads
from edoras_tools.structs.shapes import FPRIME_KEY
from edoras_tools.wire import fprime
from edoras_tools.wire.arrays.order import by_value
from edoras_tools.wire.arrays.window import gather
from edoras_tools.wire.fprime import PacketPlaces, PacketType

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from edoras_tools.structs.fprime.bound import BoundEntry

_ID_BYTES: Final = np.array([4, 4, 4, 0, 2])
"""Of an ID, by packet type; 0 where a dictionary describes nothing."""
DESCRIBED: Final = frozenset(np.flatnonzero(_ID_BYTES).tolist())
"""The packet types that a dictionary describes."""
_REPEATED: Final = (PacketType.TELEMETRY, PacketType.EVENT)
"""PacketPlaces that may hold several, one after the other."""


class EntryTable:
    """The entries of a dictionary by packet type and ID.

    Args:
        bounds: by packet type, then ID; the key of each is its place.

    Attributes:
        bounds: as given.
        unknown: key of an ID that the dictionary has not.
        odd: key of bytes behind the last value that are not an ID.
    """

    def __init__(self, bounds: Sequence[BoundEntry]) -> None:
        self.bounds = bounds
        codes = [int(item.entry.kind) << 32 | item.entry.id for item in bounds]
        self._codes = np.array([*codes, np.iinfo(np.int64).max])
        self._fixed = np.array([-1 if item.texts else item.struct.size for item in bounds] + [0])
        self.unknown = FPRIME_KEY + len(bounds)
        self.odd = self.unknown + 1

    def __getitem__(self, key: int) -> BoundEntry:
        """Return the entry of a key."""
        return self.bounds[key - FPRIME_KEY]

    def whole(self, payloads: StructPayloads) -> StructPayloads:
        """Return those of payloads that are entries and not cut."""
        described = (payloads.key >= FPRIME_KEY) & (payloads.key < self.unknown)
        return payloads.take(described & (payloads.length >= 0))

    def in_packet(self, data: bytes, kind: int, at: int, end: int) -> StructPayloads:
        """Return what one packet holds.

        Args:
            at: the first byte behind it.
            end: one past the packet.
        """
        row, space, start, stop, code = (
            np.array([item]) for item in (0, -1, at - fprime.PACKET.size, end, kind)
        )
        packets = fprime.PacketPlaces(row, space, start, stop, code.astype(np.int32), np.array([True]))
        return self.payloads(np.frombuffer(data, np.uint8), packets)

    def payloads(self, data: NDArray[np.uint8], packets: PacketPlaces) -> StructPayloads:
        """Return all that packets hold, behind their IDs, in order; of each packet up to what is not known.

        Args:
            data: u8, contiguous.
            packets: the packets; those whose header is cut hold nothing.
        """
        some = np.flatnonzero(packets.whole & np.isin(packets.kind, list(DESCRIBED)))
        row, cursor, end = packets.row[some], packets.start[some] + fprime.PACKET.size, packets.end[some]
        kind = packets.kind[some]
        parts = [StructPayloads(row[:0], kind[:0], kind[:0], cursor[:0], kind[:0])]
        while len(row):
            width = _ID_BYTES[kind]
            whole = cursor + width <= end
            key, length = np.full(len(row), self.odd, np.int32), end - cursor
            offset = np.where(whole, cursor + width, cursor)
            self._identify(data, cursor, whole, kind, key)
            described = np.flatnonzero(key < self.unknown)
            length[described] = self._measure(data, key[described], offset[described], end[described])
            parts.append(
                StructPayloads(row, key, np.zeros(len(row), np.int32), offset, length.astype(np.int32))
            )
            cursor = offset + length
            open_ = (key < self.unknown) & (length >= 0) & (cursor < end)
            once = open_ & ~np.isin(kind, _REPEATED)
            rest = np.flatnonzero(once)
            odd = np.full(len(rest), self.odd, np.int32)
            size = (end - cursor)[rest].astype(np.int32)
            parts.append(StructPayloads(row[rest], odd, odd * 0, cursor[rest], size))
            open_ &= ~once
            row, cursor, end, kind = row[open_], cursor[open_], end[open_], kind[open_]
        every = StructPayloads(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))
        return every.take(np.lexsort((every.offset, every.row)))

    def _identify(
        self,
        data: NDArray[np.uint8],
        cursor: NDArray[np.int64],
        whole: NDArray[np.bool_],
        kind: NDArray[np.int32],
        key: NDArray[np.int32],
    ) -> None:
        """Write the key of each ID that is ``whole``."""
        window = gather(data, np.minimum(cursor, len(data)), 4)
        number = window.view(">u4")[:, 0].astype(np.int64)
        number >>= np.where(_ID_BYTES[kind] == 2, 16, 0)
        code = kind.astype(np.int64) << 32 | number
        place = np.searchsorted(self._codes, code)
        matches = self._codes[place] == code
        key[whole] = np.where(matches, FPRIME_KEY + place, self.unknown)[whole]

    def _measure(
        self,
        data: NDArray[np.uint8],
        key: NDArray[np.int32],
        offset: NDArray[np.int64],
        end: NDArray[np.int64],
    ) -> NDArray[np.int64]:
        """Return the bytes of each value; -1 where it does not fit."""
        length = self._fixed[key - FPRIME_KEY]
        length[(length >= 0) & (offset + length > end)] = -1
        for value, members in by_value(np.where(self._fixed[key - FPRIME_KEY] < 0, key, -1)):
            if value >= 0:
                length[members] = self[value].measure(data, offset[members], end[members])
        return length

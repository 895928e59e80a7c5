"""Finds the contents of F Prime packets, by the entries of a dictionary."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import numpy as np

from edoras_tools.addons.fprime import wire as fprime
from edoras_tools.addons.fprime.wire import VALUES_LAYER, PacketPlaces, PacketType
from edoras_tools.model import Finding, Layer, LayerField, RosMessage
from edoras_tools.structs.messages import parts
from edoras_tools.structs.payloads import StructPayloads
from edoras_tools.structs.shapes import ENTRY_KEY, Struct, StructLayout
from edoras_tools.wire.arrays.order import Integers, Mask, Octets, by_value
from edoras_tools.wire.arrays.window import gather

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

    from edoras_tools.addons.fprime.entry import BoundEntry, Entry
    from edoras_tools.links.reading import Reading
    from edoras_tools.structs import Structs

_ID_BYTES: Final = np.array([4, 4, 4, 0, 2])
"""Size of an ID by packet type, bytes; 0 for types without entries in a dictionary."""
DESCRIBED: Final = frozenset(np.flatnonzero(_ID_BYTES).tolist())
"""Packet types with entries in a dictionary."""
_REPEATED: Final = (PacketType.TELEMETRY, PacketType.EVENT)
"""Packet types that may contain several entries, one after the other."""

_KINDS: Final = {"float32": "float", "float64": "double"}
"""Names of types in the engine of the Wireshark dissector."""


class EntryTable:
    """The entries of a dictionary by packet type and ID.

    Args:
        bounds: bound entries by packet type, then ID; the key of each is its index.
        structs: all structs, for the types of the entries.

    Attributes:
        bounds: bound entries by packet type, then ID.
        unknown: key of an ID that the dictionary does not have.
        odd: key of bytes behind the last value that are no ID.
    """

    def __init__(self, bounds: Sequence[BoundEntry], structs: Structs) -> None:
        self.bounds = bounds
        self._structs = structs
        codes = [int(item.entry.kind) << 32 | item.entry.id for item in bounds]
        self._codes = np.array([*codes, np.iinfo(np.int64).max])
        self._fixed = np.array([-1 if item.texts else item.struct.size for item in bounds] + [0])
        self.unknown = ENTRY_KEY + len(bounds)
        self.odd = self.unknown + 1

    def __getitem__(self, key: int) -> BoundEntry:
        """Return the struct of a key."""
        return self.bounds[key - ENTRY_KEY]

    def entry(self, key: int) -> Entry:
        """Return the entry of a key."""
        return self[key].entry

    def whole(self, payloads: StructPayloads) -> StructPayloads:
        """Return the payloads that are entries and complete."""
        described = (payloads.key >= ENTRY_KEY) & (payloads.key < self.unknown)
        return payloads.take(described & (payloads.length >= 0))

    def payloads(self, data: Octets, offset: Integers, length: NDArray[np.int32]) -> StructPayloads:
        """Return all contents of datagrams; see ``structs.entries.LayoutEntryTable``."""
        return self.in_packets(data, fprime.read_ground_frames(data, offset, length, checked=False).packets)

    def in_packets(self, data: Octets, packets: PacketPlaces) -> StructPayloads:
        """Return all contents of packets, behind their IDs, in order; of each packet up to an unknown one.

        Args:
            data: u8, contiguous buffer.
            packets: packets; those with a cut header have no contents.
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

    def read(self, reading: Reading, kind: int, at: int, end: int) -> bool:
        """Read the contents of one packet, including IDs and times; see ``Reading.described``."""
        if kind not in DESCRIBED:
            return False
        header = fprime.ENTRY_HEADERS[PacketType(kind)]
        row, space, start, stop = (np.array([item]) for item in (0, -1, at - fprime.PACKET.size, end))
        packet = PacketPlaces(row, space, start, stop, np.array([kind], np.int32), np.array([True]))
        entries = self.in_packets(np.frombuffer(reading.data, np.uint8), packet)
        for key, start, length in zip(
            entries.key.tolist(), entries.offset.tolist(), entries.length.tolist(), strict=True
        ):
            if key == self.odd:
                reading.findings |= Finding.LENGTH_MISMATCH
                continue
            first = start - header.slots[0].end
            if first + header.size <= end:
                reading.read(header, first)
            if key == self.unknown:
                reading.findings |= Finding.UNKNOWN_MSG_ID
            elif length < 0:
                reading.findings |= Finding.STRUCT_LENGTH
            else:
                self._values(reading, self[key], start, start + length)
        return bool(len(entries.key))

    def _values(self, reading: Reading, bound: BoundEntry, at: int, end: int) -> None:
        """Read the values of one entry, as a message."""
        payload = reading.data[at:end]
        cdr = bound.message(payload)
        values = self._structs.types.decode(bound.type, cdr)
        fields: tuple[LayerField, ...] = ()
        if reading.detail:
            spans = zip(bound.spans(values, 0), bound.wire_places(payload), strict=True)
            fields = tuple(
                LayerField(path, value, at + low, at + high, bound.text(member, value), member.doc)
                for (path, value, _, _, member), (low, high) in spans
                if not bound.is_time(path)
            )
        message = RosMessage(bound.type, bound.topic, values, cdr)
        reading.add(message, Layer(VALUES_LAYER, bound.line(values), at + bound.time_bytes, end, fields))

    def logs(self, payloads: StructPayloads, data: Octets) -> Iterator[tuple[int, int, dict[str, Any]]]:
        """Yield row, position and log message of each event.

        ``name`` is the component, ``function`` the event, ``msg`` its text, ``line`` 0, ``file`` empty; the
        time is left to the caller, because F Prime's clock may have any epoch.
        """
        whole = self.whole(payloads)
        for key, members in by_value(whole.key):
            bound = self[key]
            if bound.entry.severity is None:
                continue
            component, _, name = bound.entry.name.rpartition(".")
            head = {"level": bound.entry.severity.level, "name": component, "file": "", "function": name}
            events = whole.take(members)
            for row, at, size in zip(
                events.row.tolist(), events.offset.tolist(), events.length.tolist(), strict=True
            ):
                message = bound.message(data[at : at + size].tobytes())
                text = bound.text_of(self._structs.types.decode(bound.type, message))
                yield row, at, {**head, "msg": text, "line": 0}

    def engine_values(self) -> dict[str, Any]:
        """Return the values for ``engine/fprime.lua`` of the Wireshark dissector, from the entries."""
        entries: dict[int, dict[int, Any]] = {}
        structs: dict[str, Any] = {}
        enums: dict[str, Any] = {}
        for bound in self.bounds:
            entry = bound.entry
            entries.setdefault(int(entry.kind), {})[entry.id] = {
                "name": entry.name,
                "word": entry.word,
                "topic": entry.topic,
                "type": bound.type,
                "severity": entry.severity.name if entry.severity else None,
                "format": entry.format or None,
                "timed": entry.timed or None,
                "padded": entry.padded or None,
                "members": _members(bound.layout, bound.struct, structs, enums)[int(entry.timed) :],
            }
        return {
            "described": dict.fromkeys(sorted(DESCRIBED), True),
            "entries": entries,
            "structs": structs,
            "enums": enums,
        }

    def _identify(
        self, data: Octets, cursor: Integers, whole: Mask, kind: NDArray[np.int32], key: NDArray[np.int32]
    ) -> None:
        """Write the key of each ``whole`` ID."""
        window = gather(data, np.minimum(cursor, len(data)), 4)
        number = window.view(">u4")[:, 0].astype(np.int64)
        number >>= np.where(_ID_BYTES[kind] == 2, 16, 0)
        code = kind.astype(np.int64) << 32 | number
        place = np.searchsorted(self._codes, code)
        matches = self._codes[place] == code
        key[whole] = np.where(matches, ENTRY_KEY + place, self.unknown)[whole]

    def _measure(self, data: Octets, key: NDArray[np.int32], offset: Integers, end: Integers) -> Integers:
        """Return the size of each value, bytes; -1 if it does not fit."""
        length = self._fixed[key - ENTRY_KEY]
        length[(length >= 0) & (offset + length > end)] = -1
        for value, members in by_value(np.where(self._fixed[key - ENTRY_KEY] < 0, key, -1)):
            if value >= 0:
                length[members] = self[value].measure(data, offset[members], end[members])
        return length


def _members(
    layout: StructLayout, struct: Struct, structs: dict[str, Any], enums: dict[str, Any]
) -> list[dict[str, Any]]:
    """Return the values of a struct in a dictionary; store the structs and enumerations in it."""
    members = []
    for name, member, _ in parts(layout, struct, whole=False):
        inner, enum, basic = layout.structs.get(str(member.type)), layout.enumeration(member), None
        if inner is not None:
            structs[inner.name] = _members(layout, inner, structs, enums)
        else:
            basic = layout.basic(member)
        if enum is not None:
            enums[enum.name] = dict(enum.names)
        kind = "string" if member.text else inner.name if inner else _KINDS.get(str(basic), str(basic))
        members.append(
            {
                "name": name,
                "kind": kind,
                "size": basic.size if basic else None,
                "count": member.count if member.array else None,
                "most": member.dims[-1] if member.text else None,
                "enum": enum.name if enum else None,
            }
        )
    return members

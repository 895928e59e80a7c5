"""The entries of an F Prime dictionary, which find the contents of F Prime packets.

An entry is one command, channel, event or packet, with its values as messages. On the wire a text is its
length in two bytes and its characters, so later values have no fixed position. The values are copied to their
positions in the struct, where each text has its maximum length: for many messages at once, in one step for
each text.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from enum import Enum
from functools import cached_property
from typing import TYPE_CHECKING, Any, Final

import msgspec
import numpy as np

from edoras_tools.addons.fprime import link as fprime
from edoras_tools.addons.fprime.link import TIME_BYTES, VALUES_LAYER, PacketPlaces, PacketType
from edoras_tools.model import Finding, Layer, LayerField, RosMessage
from edoras_tools.structs.bindings import Bound, Encoded, StructPayloads, headed
from edoras_tools.structs.messages import HEAD, StructPlan, parts
from edoras_tools.structs.shapes import ENTRY_KEY, Key, Member, Struct, StructLayout
from edoras_tools.wire.arrays import Integers, Mask, Octets, by_value, copy_rows, gather, read_at

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from edoras_tools.links.doors import Reading
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
        """Return all contents of datagrams; see ``structs.table.LayoutEntryTable``."""
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


_LENGTH_BYTES: Final = 2
_WORDS: Final = {
    PacketType.COMMAND: "command",
    PacketType.TELEMETRY: "channel",
    PacketType.EVENT: "event",
    PacketType.PACKETIZED_TELEMETRY: "packet",
}
_FIELD: Final = re.compile(r"\{\{|\}\}|\{(\d{0,3}(?:\.\d{1,3})?[cdxoefgCDXOEFG]?)\}", re.ASCII)
"""Fields in FPP's formats: a field with its form, or a brace, which is written twice."""
_BRACES: Final = {"{{": "{", "}}": "}"}


class EventSeverity(Enum):
    """Severity of an event; the value is the level in ``rcl_interfaces/msg/Log``."""

    FATAL = 50
    WARNING_HI = 40
    WARNING_LO = 30
    COMMAND = 20
    ACTIVITY_HI = 21
    ACTIVITY_LO = 22
    DIAGNOSTIC = 10

    @classmethod
    def of(cls, name: Any) -> EventSeverity | None:
        """Return the severity of that name, or None."""
        return cls.__members__.get(name) if isinstance(name, str) else None

    @property
    def level(self) -> int:
        """The level in ``rcl_interfaces/msg/Log``."""
        return self.value // 10 * 10


class Entry(msgspec.Struct, frozen=True, order=True):
    """One entry of a dictionary.

    Attributes:
        kind: type of its packets.
        id: opcode, channel ID, event ID, or ID of a packet of channels.
        name: qualified, as ``Ref.cmdDisp.OpCodeDispatched``.
        severity: severity of an event.
        format: text of an event, with a field for each argument.
    """

    kind: PacketType
    id: int
    name: str
    severity: EventSeverity | None = None
    format: str = ""

    @property
    def word(self) -> str:
        """Kind of the entry: command, channel, event or packet."""
        return _WORDS[self.kind]

    @property
    def timed(self) -> bool:
        """Whether the time is in front of its values."""
        return self.kind is not PacketType.COMMAND

    @property
    def padded(self) -> bool:
        """Whether a text takes its maximum length on the wire, whatever its length."""
        return self.kind is PacketType.PACKETIZED_TELEMETRY

    @property
    def topic(self) -> str:
        """Topic of its messages."""
        return f"/fprime/{self.word}s/{self.name.replace('.', '/')}"

    @property
    def id_text(self) -> str:
        """ID on the wire, in hex."""
        bits = fprime.ENTRY_HEADERS[self.kind].slots[0].field.bits
        return f"0x{self.id:0{bits // 4}x}"

    def event_text(self, values: Sequence[Any], words: Sequence[str]) -> str:
        """Return the text of an event.

        Args:
            words: values as text, enumerations by name.
        """
        if not self.format:
            return " ".join(words)
        places = iter(zip(values, words, strict=True))

        def filled(match: re.Match[str]) -> str:
            if match[0] in _BRACES:
                return _BRACES[match[0]]
            value, word = next(places, ("", match[0]))
            form = match[1].lower() if match[1][-1:] in {"C", "D", "O"} else match[1]
            try:
                return format(value, form) if form else word
            except (TypeError, ValueError, OverflowError):
                return word

        return _FIELD.sub(filled, self.format)


class BoundEntry(Bound):
    """An entry of a dictionary, with the positions of its values; see :class:`Bound`.

    Args:
        key: index in the table of entries.
        type: full name of the type of its messages.

    Attributes:
        entry: entry.
    """

    repeats = True

    def __init__(self, entry: Entry, key: Key, layout: StructLayout, struct: Struct, type: str) -> None:  # noqa: A002
        super().__init__(key, layout, struct, entry.topic, type)
        self.entry = entry

    @property
    def name(self) -> str:
        """The qualified name."""
        return self.entry.name

    @property
    def metadata(self) -> dict[str, str]:
        """Return the metadata of its topic: its kind, ID and name."""
        return {"link": "fprime", "id": self.entry.id_text, self.entry.word: self.entry.name}

    def fits(self, length: NDArray[np.integer[Any]] | int) -> Mask:
        """Return which values are complete: their measured length is not -1."""
        return np.asarray(length) >= 0

    def plan(self, length: int) -> StructPlan:
        """Return the plan, which is the same for all lengths."""
        return super().plan(self.struct.size)

    @cached_property
    def texts(self) -> list[tuple[int, int]]:
        """Start of each text in the struct, and its maximum size, bytes; in order."""
        return [(leaf.start, leaf.end - leaf.start) for leaf in self.plan(0).leaves if leaf.member.text]

    def measure(self, data: Octets, start: Integers, end: Integers) -> Integers:
        """Return the size of the values at each position, i64 (n,); -1 if they do not fit.

        Args:
            data: u8, contiguous buffer.
            start: i64 (n,), the first byte.
            end: i64 (n,), one past the last available byte.
        """
        cursor, good, _ = self._walk(data, start, end)
        return np.where(good, cursor - start, -1)

    def encode(
        self, data: Octets, offset: Integers, length: NDArray[np.integer[Any]], heads: NDArray[np.void]
    ) -> Encoded:
        """Return the messages of many payloads; see :meth:`Bound.encode`."""
        if not self.texts:
            return super().encode(data, offset, length, heads)
        image = np.zeros((len(offset), self.struct.size), np.uint8)
        _, _, places = self._walk(data, offset, offset + length)
        at, rows = 0, np.arange(len(offset)) * self.struct.size
        for (start, most), (cursor, size) in zip(self.texts, places, strict=True):
            if start > at:
                image[:, at:start] = gather(data, cursor - _LENGTH_BYTES - (start - at), start - at)
            copy_rows(image.reshape(-1), rows + start, data, cursor, size)
            at = start + most
            behind = cursor + (most if self.entry.padded else size)
        if at < self.struct.size:
            image[:, at:] = gather(data, behind, self.struct.size - at)
        return Encoded(*self.plan(0).encode(headed(image, heads)), 0)

    def message(self, payload: bytes) -> bytes:
        """Return the message of one payload: CDR, encapsulation included."""
        size = np.array([len(payload)])
        data = np.frombuffer(payload or b"\0", np.uint8)
        return self.encode(data, np.array([0]), size, np.zeros(1, HEAD)).data.tobytes()

    def wire_places(self, payload: bytes) -> list[tuple[int, int]]:
        """Return the place of each value of ``plan.leaves`` in the bytes: first, and one past the last."""
        data, size = np.frombuffer(payload or b"\0", np.uint8), np.array([len(payload)])
        _, _, places = self._walk(data, np.array([0]), size)
        texts = iter(zip(self.texts, places, strict=True))
        spans, shift = [], 0
        for leaf in self.plan(0).leaves:
            if not leaf.member.text:
                spans.append((leaf.start + shift, leaf.end + shift))
                continue
            (_, most), (cursor, length) = next(texts)
            begin, end = int(cursor[0]), int(cursor[0] + length[0])
            spans.append((begin - _LENGTH_BYTES, end))
            shift = (begin + most if self.entry.padded else end) - leaf.end
        return spans

    @property
    def time_bytes(self) -> int:
        """Size of the time in front of the values, bytes."""
        return TIME_BYTES if self.entry.timed else 0

    def is_time(self, path: str) -> bool:
        """Return whether a field of a message belongs to the time in front of its values."""
        return self.entry.timed and path.startswith("time.")

    def line(self, values: Mapping[str, Any]) -> str:
        """Return a message on one line: its name, and the text of an event, else the values."""
        words = self._words(values)
        if self.entry.severity is not None:
            text = f"{self.entry.severity.name} {self.text_of(values)}".strip()
        elif self.entry.kind is PacketType.TELEMETRY:
            text = " ".join(words.values())
        else:
            text = " ".join(f"{name}={word}" for name, word in words.items())
        return f"{self.name}: {text}".removesuffix(": ")

    def text_of(self, values: Mapping[str, Any]) -> str:
        """Return the text of an event."""
        words = self._words(values)
        return self.entry.event_text([values[name] for name in words], [*words.values()])

    def _words(self, values: Mapping[str, Any]) -> dict[str, str]:
        """Return the values as text by name, without the time."""
        pairs = list(zip(self.struct.members, values.items(), strict=False))[int(self.entry.timed) :]
        return {name: self._word(member, value) for member, (name, value) in pairs}

    def _word(self, member: Member, value: Any) -> str:
        """Return a value as text; an enumeration by its name."""
        if isinstance(value, list):
            return "[" + ", ".join(self._word(member, item) for item in value) + "]"
        if isinstance(value, dict):
            parts = zip(self.layout.structs[str(member.type)].members, value.items(), strict=True)
            return "{" + ", ".join(f"{name}={self._word(part, item)}" for part, (name, item) in parts) + "}"
        return self.values(member).get(value) or (f"{value:.9g}" if isinstance(value, float) else str(value))

    def _walk(
        self, data: Octets, start: Integers, end: Integers
    ) -> tuple[Integers, Mask, Sequence[tuple[Integers, Integers]]]:
        """Walk from text to text.

        Returns:
            End of the values; whether they end in time; position and size of each text.
        """
        cursor, good, at = start.copy(), np.ones(len(start), bool), 0
        places = []
        for where, most in self.texts:
            cursor += where - at
            good &= cursor + _LENGTH_BYTES <= end
            size = (
                read_at(data, np.where(good, cursor, 0), ">u2").astype(np.int64) if good.any() else cursor * 0
            )
            cursor += _LENGTH_BYTES
            good &= (size <= most) & (cursor + size <= end)
            size[~good] = 0
            places.append((cursor.copy(), size))
            cursor += most if self.entry.padded else size
            at = where + most
        cursor += self.struct.size - at
        return cursor, good & (cursor <= end), places

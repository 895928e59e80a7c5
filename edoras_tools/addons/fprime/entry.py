"""One command, channel, event or packet of an F Prime dictionary, and its values as messages.

On the wire a text is its length in two bytes and its characters, so later values have no fixed position. The
values are copied to their positions in the struct, where each text has its maximum length: for many messages
at once, in one step for each text.
"""

from __future__ import annotations

import re
from enum import Enum
from functools import cached_property
from typing import TYPE_CHECKING, Any, Final

import msgspec
import numpy as np

from edoras_tools.addons.fprime import wire as fprime
from edoras_tools.addons.fprime.wire import TIME_BYTES, PacketType
from edoras_tools.structs.bindings import Bound, Encoded, headed
from edoras_tools.structs.transcode import HEAD, StructPlan
from edoras_tools.wire.arrays.window import copy_rows, gather, read_at

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from edoras_tools.structs.shapes import Key, Member, Struct, StructLayout
    from edoras_tools.wire.arrays.order import Integers, Mask, Octets

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

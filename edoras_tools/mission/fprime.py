"""What an F Prime dictionary says of one command, channel, event or packet of channels."""

from __future__ import annotations

import re
from dataclasses import dataclass
from enum import Enum
from typing import TYPE_CHECKING, Any, Final

from edoras_tools.wire import fprime
from edoras_tools.wire.fprime import PacketType

if TYPE_CHECKING:
    from collections.abc import Sequence

_WORDS: Final = {
    PacketType.COMMAND: "command",
    PacketType.TELEMETRY: "channel",
    PacketType.EVENT: "event",
    PacketType.PACKETIZED_TELEMETRY: "packet",
}
_FIELD: Final = re.compile(r"\{\{|\}\}|\{(\d{0,3}(?:\.\d{1,3})?[cdxoefgCDXOEFG]?)\}", re.ASCII)
"""What FPP allows in a format: a field with its form, or a brace, which is written twice."""
_BRACES: Final = {"{{": "{", "}}": "}"}


class EventSeverity(Enum):
    """How severe an event is; the value is the level in ``rcl_interfaces/msg/Log``."""

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


@dataclass(frozen=True, slots=True)
class Entry:
    """One entry of a dictionary.

    Attributes:
        kind: of the packets that it is in.
        id: opcode, channel ID, event ID, or ID of a packet of channels.
        name: qualified, as ``Ref.cmdDisp.OpCodeDispatched``.
        severity: of an event.
        format: the text of an event, with a field for each argument.
    """

    kind: PacketType
    id: int
    name: str
    severity: EventSeverity | None = None
    format: str = ""

    @property
    def word(self) -> str:
        """What it is: command, channel, event or packet."""
        return _WORDS[self.kind]

    @property
    def timed(self) -> bool:
        """Whether the time is in front of its values."""
        return self.kind is not PacketType.COMMAND

    @property
    def padded(self) -> bool:
        """Whether a text takes its most bytes on the wire, however long it is."""
        return self.kind is PacketType.PACKETIZED_TELEMETRY

    @property
    def topic(self) -> str:
        """The topic of its messages."""
        return f"/fprime/{self.word}s/{self.name.replace('.', '/')}"

    @property
    def id_text(self) -> str:
        """The ID as on the wire, in hex."""
        bits = fprime.ENTRY_HEADERS[self.kind].slots[0].field.bits
        return f"0x{self.id:0{bits // 4}x}"

    def event_text(self, values: Sequence[Any], words: Sequence[str]) -> str:
        """Return the text of an event.

        Args:
            words: the same as text, enumerations by name.
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

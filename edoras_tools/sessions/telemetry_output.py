"""Telemetry Output (TO_LAB): which messages go to the ground, and to whom."""

from __future__ import annotations

from dataclasses import dataclass
from ipaddress import AddressValueError, IPv4Address
from typing import TYPE_CHECKING, Final

from edoras_tools.sessions import software_bus
from edoras_tools.sessions.events import Event, EventType
from edoras_tools.wire import cfe

if TYPE_CHECKING:
    from collections.abc import Iterable

    from edoras_tools.sessions.profile import SimProfile
    from edoras_tools.sessions.software_bus import Pipe, SoftwareBus

NAME: Final = "TO_LAB_APP"
PIPE: Final = "TO_LAB_TLM_PIPE"
COMMAND_MSG_ID: Final = 0x1880
REQUEST_MSG_ID: Final = 0x1881
HOUSEKEEPING_MSG_ID: Final = 0x0880
DATA_TYPES_MSG_ID: Final = 0x0881

NOOP, RESET, ADD_PACKET, SEND_DATA_TYPES, REMOVE_PACKET, REMOVE_ALL, ENABLE = range(7)


@dataclass(frozen=True, slots=True)
class Answer:
    """What a command led to.

    Attributes:
        event: what TO says, or None.
        publish: MsgId and payload of a packet that the command asks for, or None.
    """

    event: Event | None = None
    publish: tuple[int, bytes] | None = None


class TelemetryOutput:
    """The table, the destination and the counters of Telemetry Output.

    Attributes:
        pipe: what waits for the next round.
        destination: IPv4 address that telemetry goes to; None before the first enable.
        commands: commands taken.
        command_errors: and refused.
    """

    def __init__(self, profile: SimProfile, bus: SoftwareBus) -> None:
        self.profile = profile
        self.bus = bus
        self.pipe: Pipe = bus.create_pipe(PIPE, profile.to_pipe_depth)
        self.destination: str | None = None
        self.commands = 0
        self.command_errors = 0

    def subscribe(self, msg_ids: Iterable[int] = ()) -> None:
        """Subscribe to every MsgId of the table and to these, whose limit may be in the table too."""
        default = self.profile.to_default_limit
        for wanted, limit in (dict.fromkeys(msg_ids, default) | dict(self.profile.to_limits)).items():
            self.bus.subscribe(self.pipe, wanted, limit)

    def forward(self) -> tuple[bool, bytes | None]:
        """Take one packet from the pipe.

        Returns:
            whether there was one, and the datagram for the ground; None while output is not enabled.
        """
        packet = self.pipe.get()
        if packet is None:
            return False, None
        return True, software_bus.whole(packet) if self.destination else None

    def command(self, packet: bytes) -> Answer:
        """Take a command. Like the flight code it trusts the payload's length."""
        function_code = packet[6] & 0x7F
        payload = packet[cfe.COMMAND_HEADER_BYTES :].ljust(16, b"\0")
        if function_code > ENABLE:
            self.command_errors += 1
            text = f"L344 TO: Invalid Function Code Rcvd In Ground Command 0x{function_code:x}"
            return Answer(Event(NAME, 9, EventType.ERROR, text))
        self.commands += 1
        if function_code == RESET:
            self.commands = self.command_errors = 0
            return _says(6, "Reset counters command")
        if function_code == ADD_PACKET:
            return self._add(payload)
        if function_code == REMOVE_PACKET:
            return self._remove(int.from_bytes(payload[:4], "little"))
        if function_code == REMOVE_ALL:
            for wanted in list(self.pipe.limits):
                self.bus.unsubscribe(self.pipe, wanted)
            return _says(18, "L514 TO Removed all packets")
        if function_code == SEND_DATA_TYPES:
            return Answer(publish=(DATA_TYPES_MSG_ID, bytes(64)))
        if function_code == ENABLE:
            return self._enable(payload[:16].split(b"\0")[0].decode("ascii", "replace"))
        return _says(2, "No-op command")

    def _enable(self, text: str) -> Answer:
        try:
            self.destination = str(IPv4Address(text))
        except AddressValueError:
            # An address that cannot be read leaves 0.0.0.0, which the host takes for itself.
            self.destination = self.profile.address
        return _says(3, f"TO telemetry output enabled for IP {text}")

    def _add(self, payload: bytes) -> Answer:
        wanted, limit = int.from_bytes(payload[:4], "little"), payload[6] or self.profile.to_default_limit
        if not 0 < wanted <= cfe.HIGHEST_MSG_ID:
            return Answer(Event(NAME, 7, EventType.ERROR, f"L459 TO Can't subscribe to stream 0x{wanted:x}"))
        self.bus.subscribe(self.pipe, wanted, limit)
        text = f"L473 TO AddPkt 0x{wanted:x}, QoS {payload[4]}.{payload[5]}, limit {limit}"
        return _says(15, text)

    def _remove(self, wanted: int) -> Answer:
        if not self.bus.unsubscribe(self.pipe, wanted):
            text = f"L489 TO Can't Unsubscribe to Stream 0x{wanted:x}"
            return Answer(Event(NAME, 11, EventType.ERROR, text))
        return _says(16, f"L497 TO RemovePkt 0x{wanted:x}")

    def housekeeping(self) -> bytes:
        """Return the payload of housekeeping packet 0x880, 4 bytes."""
        return bytes([self.commands & 0xFF, self.command_errors & 0xFF, 0, 0])


def _says(event_id: int, text: str) -> Answer:
    return Answer(Event(NAME, event_id, EventType.INFORMATION, text))

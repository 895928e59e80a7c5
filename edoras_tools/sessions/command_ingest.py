"""Command Ingest (CI_LAB): what it makes of the datagrams that wait in its socket.

The receive buffer is one piece of memory for good: a datagram shorter than the last leaves the rest of it
behind, and a packet whose length field is larger than its datagram carries that rest. That is how the flight
code behaves, so it is how this does.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from edoras_tools.sessions import software_bus
from edoras_tools.sessions.events import Event, EventType
from edoras_tools.wire import cfe

if TYPE_CHECKING:
    from edoras_tools.sessions.profile import SimProfile

NAME: Final = "CI_LAB_APP"
COMMAND_MSG_ID: Final = 0x1884
REQUEST_MSG_ID: Final = 0x1885
HOUSEKEEPING_MSG_ID: Final = 0x0884


@dataclass(frozen=True, slots=True)
class Ingested:
    """One datagram read.

    Attributes:
        packet: for the software bus, or None.
        event: what there is to say, or None.
    """

    packet: bytes | None = None
    event: Event | None = None


class CommandIngest:
    """The socket queue and the counters of Command Ingest.

    Attributes:
        ingest_packets: datagrams handed to the software bus.
        ingest_errors: datagrams too short to be a command.
        commands: commands to CI itself that it took.
        command_errors: and that it refused.
        socket_drops: datagrams that found the socket's queue full.
    """

    def __init__(self, profile: SimProfile) -> None:
        self.profile = profile
        self.ingest_packets = 0
        self.ingest_errors = 0
        self.commands = 0
        self.command_errors = 0
        self.socket_drops = 0
        self._queue: deque[bytes] = deque()
        self._buffer = bytearray(profile.ci_buffer)

    def __len__(self) -> int:
        return len(self._queue)

    def receive_datagram(self, data: bytes) -> bool:
        """Put a datagram in the socket's queue until a wake-up reads it; tell whether there was room."""
        if len(self._queue) >= self.profile.socket_queue:
            self.socket_drops += 1
            return False
        self._queue.append(data)
        return True

    def read(self) -> Ingested | None:
        """Read one datagram; None when there is none. A wake-up reads ``ci_datagrams_per_wake`` at most."""
        if not self._queue:
            return None
        data = self._queue.popleft()[: self.profile.ci_buffer]
        self._buffer[: len(data)] = data
        if not data:
            return Ingested()
        if len(data) < cfe.COMMAND_HEADER_BYTES:
            self.ingest_errors += 1
            word, second = self._buffer[0] << 8 | self._buffer[1], self._buffer[2] << 8 | self._buffer[3]
            text = f"CI: L369, cmd {word:04x} {second:02x} dropped, bad length={len(data)}\n"
            return Ingested(event=Event(NAME, 8, EventType.ERROR, text))
        self.ingest_packets += 1
        held = max(len(data), software_bus.length(data))
        return Ingested(packet=bytes(self._buffer[:held]))

    def refused(self, status: int) -> Event:
        """Return the event for a packet that the software bus would not take."""
        text = f"CI: L359, CFE_SB_TransmitBuffer() failed, status={status}\n"
        return Event(NAME, 10, EventType.ERROR, text)

    def command(self, packet: bytes) -> Event | None:
        """Take a command to CI itself; return what it says."""
        function_code, size = packet[6] & 0x7F, software_bus.length(packet)
        if function_code > 1:
            self.command_errors += 1
            text = f"Invalid Ground Command CC = {function_code}"
            return Event(NAME, 7, EventType.ERROR, text)
        if size != cfe.COMMAND_HEADER_BYTES:
            self.command_errors += 1
            text = f"Invalid msg length: ID = 0x{COMMAND_MSG_ID:04X},  CC = {function_code}, Len = {size}"
            return Event(NAME, 16, EventType.ERROR, f"{text}, Expected = {cfe.COMMAND_HEADER_BYTES}")
        if function_code == 0:
            self.commands += 1
            return Event(NAME, 5, EventType.INFORMATION, "CI: NOOP command")
        self.commands = self.command_errors = self.ingest_packets = self.ingest_errors = 0
        return Event(NAME, 6, EventType.INFORMATION, "CI: RESET command")

    def housekeeping(self) -> bytes:
        """Return the payload of housekeeping packet 0x884, 24 bytes, little-endian."""
        head = bytes([self.command_errors & 0xFF, self.commands & 0xFF, 0, 1])
        counts = (self.ingest_packets, self.ingest_errors)
        return head + bytes(8) + b"".join((n & 0xFFFFFFFF).to_bytes(4, "little") for n in counts) + bytes(4)

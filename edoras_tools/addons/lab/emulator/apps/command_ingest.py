"""Command Ingest (CI_LAB): how it processes the datagrams that wait in its socket.

One receive buffer is used for all datagrams. A datagram shorter than the previous one leaves the end of that
one in the buffer, and a packet whose length field is larger than its datagram includes it. The flight code
does the same.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import msgspec

from edoras_tools.addons.lab.emulator.account import Fifo, socket
from edoras_tools.addons.lab.emulator.messages import bus_id, command_length, from_link
from edoras_tools.addons.lab.emulator.scheduler import Receive, Work
from edoras_tools.addons.lab.emulator.services.events import Event
from edoras_tools.cfs import command_ingest as facts
from edoras_tools.cfs import software_bus
from edoras_tools.cfs.queues import QueueEnd
from edoras_tools.wire import cfe
from edoras_tools.wire.cfe import function_code_of, length_of, msg_id_of

if TYPE_CHECKING:
    from edoras_tools.addons.lab.emulator.cfs import Cfs
    from edoras_tools.addons.lab.emulator.scheduler import Task
    from edoras_tools.cfs.profile import SimProfile


class Ingested(msgspec.Struct, frozen=True):
    """One datagram read.

    Attributes:
        packet: packet for the software bus, or None.
        event: the event to report, or None.
    """

    packet: bytes | None = None
    event: Event | None = None


class CommandIngest:
    """The socket queue and the counters of Command Ingest.

    Attributes:
        ingest_packets: datagrams handed to the software bus.
        ingest_errors: datagrams too short to be a command.
        commands: accepted commands to CI itself. command_errors: refused commands to CI itself.
        queue: datagrams that wait in the socket.
        socket_drops: datagrams that found the socket's queue full.
    """

    def __init__(self, profile: SimProfile) -> None:
        self.profile = profile
        self.ingest_packets = 0
        self.ingest_errors = 0
        self.commands = 0
        self.command_errors = 0
        self.socket_drops = 0
        self.queue: Fifo[bytes] = Fifo(profile.socket_queue)
        self._buffer = bytearray(profile.ci_buffer)

    def __len__(self) -> int:
        return len(self.queue)

    def receive_datagram(self, data: bytes) -> bool:
        """Put a datagram in the socket's queue until a wake-up reads it; return whether it fits."""
        has_room = self.queue.put(data) is QueueEnd.WAITING
        self.socket_drops += not has_room
        return has_room

    def read(self) -> Ingested | None:
        """Read one datagram; None if there is none. A wake-up reads at most ``ci_datagrams_per_wake``."""
        data = self.queue.get()
        if data is None:
            return None
        data = data[: self.profile.ci_buffer]
        self._buffer[: len(data)] = data
        if not data:
            return Ingested()
        if len(data) < self.profile.headers.command_bytes:
            self.ingest_errors += 1
            word, second = self._buffer[0] << 8 | self._buffer[1], self._buffer[2] << 8 | self._buffer[3]
            return Ingested(
                event=Event.of(
                    facts.TOO_SHORT,
                    line=369,
                    msg_id=bus_id(word, self.profile),  # the event contains the first word unchanged
                    second=second,
                    length=len(data),
                )
            )
        self.ingest_packets += 1
        length = max(len(data), length_of(data))
        return Ingested(packet=from_link(bytes(self._buffer[:length]), self.profile))

    def refused(self, status: int) -> Event:
        """Return the event for a packet that the software bus refused."""
        return Event.of(facts.NOT_SENT, line=359, status=status)

    def command(self, packet: bytes) -> Event | None:
        """Process a command to CI itself; return its event."""
        function_code, size = function_code_of(packet), length_of(packet)
        if function_code > 1:
            return None  # the flight code neither counts nor reports it
        if size != cfe.COMMAND_HEADER_BYTES:
            self.command_errors += 1
            return Event.of(
                facts.BAD_LENGTH,
                msg_id=facts.COMMAND_MSG_ID,
                code=function_code,
                length=command_length(size, self.profile),
                expected=self.profile.headers.command_bytes,
            )
        if function_code == 0:
            self.commands += 1
            return Event.of(facts.NOOP)
        self.commands = self.command_errors = self.ingest_packets = self.ingest_errors = 0
        return Event.of(facts.RESET)

    def housekeeping(self) -> bytes:
        """Return the payload of housekeeping packet 0x884, 24 bytes, little-endian."""
        return cfe.COMMAND_INGEST_HOUSEKEEPING.emit(
            {
                "command_error_counter": self.command_errors & 0xFF,
                "command_counter": self.commands & 0xFF,
                "socket_connected": 1,
                "ingest_packets": self.ingest_packets & 0xFFFFFFFF,
                "ingest_errors": self.ingest_errors & 0xFFFFFFFF,
            }
        )


class CiLab:
    """Command Ingest's task: it reads the socket after each message and after each time-out."""

    def __init__(self, cfs: Cfs) -> None:
        self.socket = CommandIngest(cfs.profile)
        cfs.account.watch(self.socket.queue, socket(cfs.profile.ci_port))
        self._cfs = cfs
        self._pipe = cfs.create_pipe(facts.PIPE, facts.COMMAND_MSG_ID, facts.REQUEST_MSG_ID)
        cfs.events.register(facts.NAME, now=cfs.scheduler.now)
        cfs.say(facts.INITIALIZED, version="Emulated")
        cfs.listen(cfs.profile.ci_port, self.socket.receive_datagram)
        cfs.spawn(self._run())

    def _run(self) -> Task:
        cfs, profile = self._cfs, self._cfs.profile
        while cfs.executive.run_loop(facts.NAME):
            packet = yield Receive(self._pipe, profile.ci_wake_ns)
            if packet is not None:
                yield Work(profile.work_ns)
                self._message(packet)
            for _ in range(profile.ci_datagrams_per_wake):
                ingested = self.socket.read()
                if ingested is None:
                    break
                if ingested.event:
                    cfs.report(ingested.event)
                if ingested.packet is not None:
                    status = cfs.publish(ingested.packet, facts.NAME, stamp=False).status
                    if status != software_bus.SUCCESS:
                        cfs.report(self.socket.refused(status))
                yield Work(profile.ci_read_ns)

    def _message(self, packet: bytes) -> None:
        if msg_id_of(packet) == facts.REQUEST_MSG_ID:
            self._cfs.telemetry(facts.HOUSEKEEPING_MSG_ID, self.socket.housekeeping(), facts.NAME)
        elif event := self.socket.command(packet):
            self._cfs.report(event)

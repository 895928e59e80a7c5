"""Command Ingest (CI_LAB): how it processes the datagrams that wait in its socket.

One receive buffer is used for all datagrams. A datagram shorter than the previous one leaves the end of that
one in the buffer, and a packet whose length field is larger than its datagram includes it. The flight code
does the same.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from edoras_tools.addons.lab.emulator.account import Fifo, socket
from edoras_tools.addons.lab.emulator.messages import bus_id, command_length, from_link
from edoras_tools.addons.lab.emulator.scheduler import Receive, Work
from edoras_tools.cfs import command_ingest as facts
from edoras_tools.cfs import software_bus
from edoras_tools.cfs.queues import QueueEnd
from edoras_tools.wire import cfe
from edoras_tools.wire.cfe import function_code_of, length_of, msg_id_of

if TYPE_CHECKING:
    from edoras_tools.addons.lab.emulator.cfs import Cfs
    from edoras_tools.addons.lab.emulator.scheduler import Task


class CommandIngest:
    """Command Ingest on an emulated cFS: its task reads the socket after each message and each time-out.

    Attributes:
        ingest_packets: datagrams handed to the software bus.
        ingest_errors: datagrams too short to be a command.
        commands: accepted commands to CI itself.
        command_errors: refused commands to CI itself.
        queue: datagrams that wait in the socket.
        socket_drops: datagrams that found the socket's queue full.
    """

    def __init__(self, cfs: Cfs) -> None:
        profile = cfs.profile
        self.ingest_packets = 0
        self.ingest_errors = 0
        self.commands = 0
        self.command_errors = 0
        self.socket_drops = 0
        self.queue: Fifo[bytes] = cfs.account.watch(Fifo(profile.socket_queue), socket(profile.ci_port))
        self._cfs = cfs
        self._buffer = bytearray(profile.ci_buffer)
        self._pipe = cfs.create_pipe(facts.PIPE, facts.COMMAND_MSG_ID, facts.REQUEST_MSG_ID)
        cfs.events.register(facts.NAME, now=cfs.scheduler.now)
        cfs.say(facts.INITIALIZED, version="Emulated")
        cfs.listen(profile.ci_port, self.receive_datagram)
        cfs.spawn(self._run())

    def receive_datagram(self, data: bytes) -> bool:
        """Put a datagram in the socket's queue until a wake-up reads it; return whether it fits."""
        has_room = self.queue.put(data) is QueueEnd.WAITING
        self.socket_drops += not has_room
        return has_room

    def read(self) -> bool:
        """Read one datagram and publish its packet, or report why not; return whether there was one."""
        data = self.queue.get()
        if data is None:
            return False
        cfs, profile = self._cfs, self._cfs.profile
        data = data[: profile.ci_buffer]
        self._buffer[: len(data)] = data
        if len(data) >= profile.headers.command_bytes:
            self.ingest_packets += 1
            length = max(len(data), length_of(data))
            packet = from_link(bytes(self._buffer[:length]), profile)
            status = cfs.publish(packet, facts.NAME, stamp=False).status
            if status != software_bus.SUCCESS:
                cfs.say(facts.NOT_SENT, line=359, status=status)
        elif data:
            self.ingest_errors += 1
            word, second = self._buffer[0] << 8 | self._buffer[1], self._buffer[2] << 8 | self._buffer[3]
            # The event contains the first word unchanged.
            msg_id = bus_id(word, profile)
            cfs.say(facts.TOO_SHORT, line=369, msg_id=msg_id, second=second, length=len(data))
        return True

    def command(self, packet: bytes) -> None:
        """Process a command to CI itself."""
        cfs = self._cfs
        function_code, size = function_code_of(packet), length_of(packet)
        if function_code > 1:
            return  # the flight code neither counts nor reports it
        if size != cfe.COMMAND_HEADER_BYTES:
            self.command_errors += 1
            cfs.say(
                facts.BAD_LENGTH,
                msg_id=facts.COMMAND_MSG_ID,
                code=function_code,
                length=command_length(size, cfs.profile),
                expected=cfs.profile.headers.command_bytes,
            )
        elif function_code == 0:
            self.commands += 1
            cfs.say(facts.NOOP)
        else:
            self.commands = self.command_errors = self.ingest_packets = self.ingest_errors = 0
            cfs.say(facts.RESET)

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

    def _run(self) -> Task:
        cfs, profile = self._cfs, self._cfs.profile
        while cfs.executive.run_loop(facts.NAME):
            packet = yield Receive(self._pipe, profile.ci_wake_ns)
            if packet is not None:
                yield Work(profile.work_ns)
                self._message(packet)
            for _ in range(profile.ci_datagrams_per_wake):
                if not self.read():
                    break
                yield Work(profile.ci_read_ns)

    def _message(self, packet: bytes) -> None:
        if msg_id_of(packet) == facts.REQUEST_MSG_ID:
            self._cfs.telemetry(facts.HOUSEKEEPING_MSG_ID, self.housekeeping(), facts.NAME)
        else:
            self.command(packet)

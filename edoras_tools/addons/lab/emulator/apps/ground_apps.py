"""The applications of the ground link: Command Ingest (CI_LAB) and Telemetry Output (TO_LAB).

CI processes the datagrams that wait in its socket. One receive buffer is used for all datagrams. A datagram
shorter than the previous one leaves the end of that one in the buffer, and a packet whose length field is
larger than its datagram includes it. The flight code does the same.

TO decides which messages go to the ground, and to which address.
"""

from __future__ import annotations

from ipaddress import AddressValueError, IPv4Address
from typing import TYPE_CHECKING

from edoras_tools.addons.lab.emulator.account import Fifo, socket
from edoras_tools.addons.lab.emulator.messages import bus_id, command_length, from_link, to_link, whole_packet
from edoras_tools.addons.lab.emulator.scheduler import Receive, Sleep, Work
from edoras_tools.cfs import command_ingest, software_bus, telemetry_output
from edoras_tools.cfs.queues import QueueEnd
from edoras_tools.model import Endpoint
from edoras_tools.wire import cfe
from edoras_tools.wire.cfe import function_code_of, length_of, msg_id_of

if TYPE_CHECKING:
    from collections.abc import Iterable

    from edoras_tools.addons.lab.emulator.cfs import Cfs
    from edoras_tools.addons.lab.emulator.scheduler import Task
    from edoras_tools.cfs.event_services import EventText


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
        self._pipe = cfs.create_pipe(
            command_ingest.PIPE, command_ingest.COMMAND_MSG_ID, command_ingest.REQUEST_MSG_ID
        )
        cfs.events.register(command_ingest.NAME, now=cfs.scheduler.now)
        cfs.say(command_ingest.INITIALIZED, version="Emulated")
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
            status = cfs.publish(packet, command_ingest.NAME, stamp=False).status
            if status != software_bus.SUCCESS:
                cfs.say(command_ingest.NOT_SENT, line=359, status=status)
        elif data:
            self.ingest_errors += 1
            word, second = self._buffer[0] << 8 | self._buffer[1], self._buffer[2] << 8 | self._buffer[3]
            # The event contains the first word unchanged.
            msg_id = bus_id(word, profile)
            cfs.say(command_ingest.TOO_SHORT, line=369, msg_id=msg_id, second=second, length=len(data))
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
                command_ingest.BAD_LENGTH,
                msg_id=command_ingest.COMMAND_MSG_ID,
                code=function_code,
                length=command_length(size, cfs.profile),
                expected=cfs.profile.headers.command_bytes,
            )
        elif function_code == 0:
            self.commands += 1
            cfs.say(command_ingest.NOOP)
        else:
            self.commands = self.command_errors = self.ingest_packets = self.ingest_errors = 0
            cfs.say(command_ingest.RESET)

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
        while cfs.executive.run_loop(command_ingest.NAME):
            packet = yield Receive(self._pipe, profile.ci_wake_ns)
            if packet is not None:
                yield Work(profile.work_ns)
                self._message(packet)
            for _ in range(profile.ci_datagrams_per_wake):
                if not self.read():
                    break
                yield Work(profile.ci_read_ns)

    def _message(self, packet: bytes) -> None:
        if msg_id_of(packet) == command_ingest.REQUEST_MSG_ID:
            self._cfs.telemetry(command_ingest.HOUSEKEEPING_MSG_ID, self.housekeeping(), command_ingest.NAME)
        else:
            self.command(packet)


class TelemetryOutput:
    """Telemetry Output on an emulated cFS.

    Args:
        cfs: the cFS that it runs on.
        telemetry: MsgIds that go to the ground besides those of the table, which may have their limits.

    Attributes:
        pipe: packets that wait for the next round.
        destination: IPv4 address that telemetry goes to; None before the first enable.
        commands: accepted commands.
        command_errors: refused commands.
    """

    def __init__(self, cfs: Cfs, telemetry: Iterable[int] = ()) -> None:
        profile = cfs.profile
        self.pipe = cfs.bus.create_pipe(telemetry_output.PIPE, profile.to_pipe_depth)
        self.destination: str | None = None
        self.commands = 0
        self.command_errors = 0
        self._cfs = cfs
        cfs.executive.owns(pipe=telemetry_output.PIPE)
        cfs.open_telemetry_socket()
        cfs.events.register(telemetry_output.NAME, now=cfs.scheduler.now)
        self._command_pipe = cfs.create_pipe(
            telemetry_output.COMMAND_PIPE, telemetry_output.COMMAND_MSG_ID, telemetry_output.REQUEST_MSG_ID
        )
        limits = dict.fromkeys(telemetry, profile.to_default_limit) | dict(profile.to_limits)
        for msg_id, limit in limits.items():
            cfs.bus.subscribe(self.pipe, msg_id, limit)
        cfs.say(telemetry_output.INITIALIZED, version="Emulated")
        cfs.spawn(self._run())

    def forward(self) -> bool:
        """Send one packet of the pipe to the ground, once output is enabled; return whether there was one."""
        packet = self.pipe.get()
        if packet is not None and self.destination is not None:
            cfs = self._cfs
            ground = Endpoint(self.destination, cfs.profile.to_port)
            cfs.send(cfs.to_endpoint, ground, to_link(whole_packet(packet), cfs.profile))
        return packet is not None

    def command(self, packet: bytes) -> None:
        """Process a command. Like the flight code, it trusts the payload's length."""
        cfs = self._cfs
        function_code = function_code_of(packet)
        payload = packet[cfe.COMMAND_HEADER_BYTES :].ljust(16, b"\0")
        if function_code > telemetry_output.ENABLE:
            self.command_errors += 1
            cfs.say(telemetry_output.BAD_FUNCTION_CODE, line=344, code=function_code)
            return
        self.commands += 1
        if function_code == telemetry_output.RESET:
            self.commands = self.command_errors = 0
        elif function_code == telemetry_output.ADD_PACKET:
            self._add(payload)
        elif function_code == telemetry_output.REMOVE_PACKET:
            self._remove(self._msg_id(payload))
        elif function_code == telemetry_output.REMOVE_ALL:
            for msg_id in list(self.pipe.limits):
                cfs.bus.unsubscribe(self.pipe, msg_id)
            cfs.say(telemetry_output.ALL_REMOVED, line=527)
        elif function_code == telemetry_output.SEND_DATA_TYPES:
            cfs.telemetry(telemetry_output.DATA_TYPES_MSG_ID, bytes(64), telemetry_output.NAME)
        elif function_code == telemetry_output.ENABLE:
            self._enable(payload[:16].split(b"\0")[0].decode("ascii", "replace"))
        else:
            cfs.say(telemetry_output.NOTHING_DONE)

    def housekeeping(self) -> bytes:
        """Return the payload of housekeeping packet 0x880, 4 bytes."""
        return bytes([self.commands & 0xFF, self.command_errors & 0xFF, 0, 0])

    def _run(self) -> Task:
        """Wait for a time, send everything in the pipe, read the commands, and again."""
        cfs, profile = self._cfs, self._cfs.profile
        while cfs.executive.run_loop(telemetry_output.NAME):
            yield Sleep(profile.to_wake_ns)
            while self.forward():
                yield Work(profile.work_ns)
            while (packet := self._command_pipe.get()) is not None:
                if msg_id_of(packet) == telemetry_output.REQUEST_MSG_ID:
                    cfs.telemetry(
                        telemetry_output.HOUSEKEEPING_MSG_ID, self.housekeeping(), telemetry_output.NAME
                    )
                else:
                    self.command(packet)
                yield Work(profile.work_ns)

    def _enable(self, text: str) -> None:
        try:
            self.destination = str(IPv4Address(text))
        except AddressValueError:
            # An address that cannot be read becomes 0.0.0.0, which the host takes for itself.
            self.destination = self._cfs.profile.address
        self._cfs.say(telemetry_output.ENABLED, address=text)

    def _add(self, payload: bytes) -> None:
        cfs = self._cfs
        msg_id, limit = self._msg_id(payload), payload[6] or cfs.profile.to_default_limit
        if not 0 < msg_id <= cfe.HIGHEST_MSG_ID:
            cfs.say(telemetry_output.NOT_ADDED, line=470, msg_id=msg_id, status=software_bus.BAD_ARGUMENT)
            return
        if msg_id in self.pipe.limits:
            self._bus_says(software_bus.DUPLICATE_SUBSCRIPTION, msg_id)
        cfs.bus.subscribe(self.pipe, msg_id, limit)
        priority, reliability = payload[4], payload[5]
        cfs.say(
            telemetry_output.ADDED,
            line=473,
            msg_id=msg_id,
            priority=priority,
            reliability=reliability,
            limit=limit,
        )

    def _remove(self, msg_id: int) -> None:
        cfs = self._cfs
        if not 0 < msg_id <= cfe.HIGHEST_MSG_ID:
            cfs.say(telemetry_output.NOT_REMOVED, line=494, msg_id=msg_id, status=software_bus.BAD_ARGUMENT)
            return
        if not cfs.bus.unsubscribe(self.pipe, msg_id):
            # cFE returns success, and TO relies on it.
            self._bus_says(software_bus.NOTHING_TO_UNSUBSCRIBE, msg_id)
        cfs.say(telemetry_output.REMOVED, line=497, msg_id=msg_id)

    def _msg_id(self, payload: bytes) -> int:
        return bus_id(int.from_bytes(payload[:4], "little"), self._cfs.profile)

    def _bus_says(self, event: EventText, msg_id: int) -> None:
        self._cfs.say(event, msg_id=msg_id, pipe=self.pipe.name, app=telemetry_output.NAME)

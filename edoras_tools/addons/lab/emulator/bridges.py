"""Emulated ground and flight bridges, with an operator and robots: the traffic of the demos."""

from __future__ import annotations

from math import cos, sin
from typing import TYPE_CHECKING, Final

import msgspec

from edoras_tools.addons.lab.emulator import messages
from edoras_tools.addons.lab.emulator.routes import DEMO_ROUTES, SystemRoutes
from edoras_tools.cfs import edoras_app, limits, telemetry_output
from edoras_tools.sessions.sbn.connection import SbnConnection
from edoras_tools.sessions.sbn.events import AppMessage
from edoras_tools.sessions.sbn.habits import PUBLIC_BRIDGE
from edoras_tools.units import MILLISECOND, SECOND
from edoras_tools.wire import cfe
from edoras_tools.wire.envelope import DEFAULT, EnvelopeFormat

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from edoras_tools.addons.lab.emulator.robots import Robot
    from edoras_tools.addons.lab.emulator.scheduler import Scheduler
    from edoras_tools.model import Endpoint, Peer

    SendFrom = Callable[[Endpoint, Endpoint, bytes], None]

_ENABLE_AFTER_NS: Final = SECOND // 2
_POLL_NS: Final = 100 * MILLISECOND


def command_packet(
    msg_id: int, cdr: bytes, headers: cfe.Headers = cfe.STANDARD, form: EnvelopeFormat = DEFAULT
) -> bytes:
    """Return a command as the bridges send it: sequence word 0, checksum 0."""
    body = form.emit(cdr)
    return cfe.emit_command(
        msg_id, edoras_app.SET, body, sequence_flags=0, with_checksum=False, headers=headers
    )


class GroundOperator(msgspec.Struct, frozen=True):
    """The commands that the ground sends.

    Attributes:
        command_type: ROS type of a command.
        msg_ids: MsgId of the commands of each robot.
        rate_hz: commands per second and robot.
        routes: types and envelopes of the MsgIds.
        start_ns: time of the first command, ns from the start of the simulation.
        count: commands per robot; None for no end.
    """

    command_type: str
    msg_ids: Sequence[int]
    rate_hz: float
    start_ns: int = SECOND
    count: int | None = None
    routes: SystemRoutes | None = None

    def packet(self, index: int, robot: int, headers: cfe.Headers) -> bytes:
        """Return command number ``index`` for robot number ``robot`` as a packet."""
        msg_id, form = self.msg_ids[robot], DEFAULT
        if self.routes is not None:
            form = self.routes.envelope(headers.msg_ids.standard(msg_id))
        return command_packet(msg_id, self.cdr(index, robot), headers, form)

    def cdr(self, index: int, robot: int) -> bytes:
        """Return command ``index`` for robot number ``robot`` as CDR: arcs for rovers, targets for arms."""
        phase = index / self.rate_hz + robot
        if self.command_type == messages.TWIST:
            return messages.twist(0.5 + 0.1 * sin(phase / 3), 0.2 * cos(phase / 2))
        if self.command_type == messages.POSE:
            return messages.encode(messages.POSE, messages.pose(0.5 + 0.2 * sin(phase / 4), 0.1 * robot, 0.7))
        return messages.encode(self.command_type, {}, self.routes.store if self.routes else None)


class GroundBridge:
    """The ground bridge: enables telemetry, sends commands to Command Ingest, receives TO's packets.

    Attributes:
        endpoint: address of its one socket: TO's destination, and source of its commands.
        received: MsgId to packets that arrived.
        sent: commands sent.
        headers: headers of its packets. The public bridges know the usual ones only.
    """

    headers = cfe.STANDARD

    def __init__(
        self, scheduler: Scheduler, endpoint: Endpoint, ci: Endpoint, operator: GroundOperator, send: SendFrom
    ) -> None:
        self.endpoint = endpoint
        self.received: dict[int, int] = {}
        self.sent = 0
        self._scheduler, self._ci, self._operator, self._send = scheduler, ci, operator, send
        self._first_ns = scheduler.now + operator.start_ns
        scheduler.call_at(scheduler.now + _ENABLE_AFTER_NS, self._enable)
        if operator.rate_hz > 0:
            scheduler.call_at(self._first_ns, self._command, 0)

    def receive_datagram(self, data: bytes) -> None:
        """Process a datagram of cFS; the buffer holds 1024 bytes."""
        if len(data[: limits.BRIDGE_BUFFER]) >= cfe.COMMAND_HEADER_BYTES:
            msg_id = self.headers.msg_ids.of(data)
            self.received[msg_id] = self.received.get(msg_id, 0) + 1

    def _enable(self) -> None:
        address = self.endpoint.address.encode().ljust(16, b"\0")
        command = cfe.emit_command(
            self.headers.msg_ids.of_known(telemetry_output.COMMAND_MSG_ID),
            telemetry_output.ENABLE,
            address,
            sequence_flags=0,
            with_checksum=False,
            headers=self.headers,
        )
        self._send(self.endpoint, self._ci, command)

    def _command(self, index: int) -> None:
        for robot in range(len(self._operator.msg_ids)):
            self._send(self.endpoint, self._ci, self._operator.packet(index, robot, self.headers))
            self.sent += 1
        if self._operator.count is None or index + 1 < self._operator.count:
            due = self._first_ns + int((index + 1) * SECOND / self._operator.rate_hz)
            self._scheduler.call_at(due, self._command, index + 1)


class FlightBridge:
    """The flight bridge and the robots behind it.

    Attributes:
        endpoint: address of its one socket.
        received: MsgId to packets that arrived.
        sent: robot states sent.
        headers: headers of its packets, as for the ground bridge.
        routes: types and envelopes of the MsgIds.
    """

    headers = cfe.STANDARD
    routes = DEMO_ROUTES["two-rovers"]

    def __init__(
        self,
        scheduler: Scheduler,
        endpoint: Endpoint,
        own: Peer,
        sbn: Endpoint,
        robots: Mapping[tuple[int, int], Robot],
        rate_hz: float,
        send: SendFrom,
    ) -> None:
        """Start the bridge.

        Args:
            own: its own SBN identity.
            sbn: address of cFS's socket.
            robots: (MsgId of the state, MsgId of the command) to the robot.
            rate_hz: states per second and robot.
            send: called with source, destination and payload.
        """
        self.endpoint = endpoint
        self.received: dict[int, int] = {}
        self.sent = 0
        self._scheduler, self._sbn, self._send = scheduler, sbn, send
        self._robots, self._rate_hz = robots, rate_hz
        commands = [command for _, command in robots]
        self._connection = SbnConnection(own, commands, habits=PUBLIC_BRIDGE, now=scheduler.now)
        self._commanded = {command: robot for (_, command), robot in robots.items()}
        self._first_ns = scheduler.now + SECOND
        scheduler.call_at(scheduler.now + _POLL_NS, self._poll)
        if rate_hz > 0:
            scheduler.call_at(self._first_ns, self._state, 0)

    def receive_datagram(self, data: bytes) -> None:
        """Queue a datagram of cFS; the next poll reads it."""
        self._connection.receive_datagram(data, now=self._scheduler.now)

    def _poll(self) -> None:
        now = self._scheduler.now
        step = self._connection.service(now=now)
        for data in step.datagrams:
            self._send(self.endpoint, self._sbn, data)
        for event in step.events:
            if isinstance(event, AppMessage):
                self._command(event.packet, now)
        self._scheduler.call_at(now + _POLL_NS, self._poll)

    def _command(self, packet: bytes, now: int) -> None:
        """Pass a command of cFS to its robot."""
        if len(packet) < cfe.TELEMETRY_HEADER_BYTES:
            return
        msg_id = self.headers.msg_ids.of(packet)
        self.received[msg_id] = self.received.get(msg_id, 0) + 1
        robot = self._commanded.get(msg_id)
        form = self.routes.envelope(self.headers.msg_ids.standard(msg_id))
        data = packet[cfe.TELEMETRY_HEADER_BYTES :]
        values = robot and messages.decode_envelope(robot.command_type, data, form, self.routes.store)
        if robot and values:
            robot.obey(values, now=now)

    def _state(self, index: int) -> None:
        for (state, _), robot in self._robots.items():
            form = self.routes.envelope(self.headers.msg_ids.standard(state))
            packet = command_packet(state, robot.state(now=self._scheduler.now), self.headers, form)
            self._send(self.endpoint, self._sbn, self._connection.frame(packet))
            self.sent += 1
        due = self._first_ns + int((index + 1) * SECOND / self._rate_hz)
        self._scheduler.call_at(due, self._state, index + 1)

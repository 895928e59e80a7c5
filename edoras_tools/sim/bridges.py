"""Stand-ins of the ground and the flight bridge, an operator and robots behind them: the demos' traffic."""

from __future__ import annotations

from dataclasses import dataclass
from math import cos, sin
from typing import TYPE_CHECKING, Final

from edoras_tools.sessions import flight_bridge, software_bus, telemetry_output
from edoras_tools.sessions.flight_bridge import FlightBridge
from edoras_tools.sessions.profile import SECOND
from edoras_tools.sim import messages
from edoras_tools.wire import cfe, envelope

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from edoras_tools.model import Endpoint
    from edoras_tools.sim.robots import Robot
    from edoras_tools.sim.scheduler import Scheduler

    SendFrom = Callable[[Endpoint, Endpoint, bytes], None]

SET: Final = 1
GROUND_BUFFER: Final = 1024
_ENABLE_AFTER_NS: Final = SECOND // 2


def command_packet(msg_id: int, cdr: bytes) -> bytes:
    """Return a command as the bridges send it: sequence word 0, checksum 0."""
    return cfe.emit_command(msg_id, SET, envelope.DEFAULT.emit(cdr), sequence_flags=0, with_checksum=False)


@dataclass(frozen=True, slots=True)
class Operator:
    """What the ground asks of the robots.

    Attributes:
        command_type: ROS type of a command.
        msg_ids: a MsgId a robot.
        rate_hz: commands per second and robot.
        start_ns: first command, from the start of the simulation.
        count: commands per robot; None for no end.
    """

    command_type: str
    msg_ids: Sequence[int]
    rate_hz: float
    start_ns: int = SECOND
    count: int | None = None

    def cdr(self, index: int, robot: int) -> bytes:
        """Return command number ``index`` for robot number ``robot``: arcs for rovers, targets for arms."""
        phase = index / self.rate_hz + robot
        if self.command_type == messages.TWIST:
            return messages.twist(0.5 + 0.1 * sin(phase / 3), 0.2 * cos(phase / 2))
        return messages.encode(messages.POSE, messages.pose(0.5 + 0.2 * sin(phase / 4), 0.1 * robot, 0.7))


class GroundBridge:
    """The ground bridge: enables telemetry, sends commands to Command Ingest, receives what TO sends.

    Attributes:
        endpoint: its one socket: TO's destination, and where its commands come from.
        received: MsgId to packets that arrived.
        sent: commands sent.
    """

    def __init__(
        self, scheduler: Scheduler, endpoint: Endpoint, ci: Endpoint, operator: Operator, send: SendFrom
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
        """Take what came from cFS; more than 1024 bytes are cut."""
        if len(data[:GROUND_BUFFER]) >= cfe.COMMAND_HEADER_BYTES:
            wanted = software_bus.msg_id(data)
            self.received[wanted] = self.received.get(wanted, 0) + 1

    def _enable(self) -> None:
        address = self.endpoint.address.encode().ljust(16, b"\0")
        command = cfe.emit_command(
            telemetry_output.COMMAND_MSG_ID,
            telemetry_output.ENABLE,
            address,
            sequence_flags=0,
            with_checksum=False,
        )
        self._send(self.endpoint, self._ci, command)

    def _command(self, index: int) -> None:
        for robot, msg_id in enumerate(self._operator.msg_ids):
            packet = command_packet(msg_id, self._operator.cdr(index, robot))
            self._send(self.endpoint, self._ci, packet)
            self.sent += 1
        if self._operator.count is None or index + 1 < self._operator.count:
            due = self._first_ns + int((index + 1) * SECOND / self._operator.rate_hz)
            self._scheduler.call_at(due, self._command, index + 1)


class FlightSide:
    """The flight bridge and the robots behind it.

    Attributes:
        endpoint: its one socket.
        received: MsgId to packets that arrived.
        sent: robot states sent.
    """

    def __init__(
        self,
        scheduler: Scheduler,
        endpoint: Endpoint,
        sbn: Endpoint,
        robots: Mapping[tuple[int, int], Robot],
        rate_hz: float,
        send: SendFrom,
    ) -> None:
        """Start.

        Args:
            scheduler: the clock.
            endpoint: its socket.
            sbn: cFS's socket.
            robots: (MsgId of the state, MsgId of the command) to the robot.
            rate_hz: states per second and robot.
            send: called with source, destination and payload.
        """
        self.endpoint = endpoint
        self.received: dict[int, int] = {}
        self.sent = 0
        self._scheduler, self._sbn, self._send = scheduler, sbn, send
        self._robots, self._rate_hz = robots, rate_hz
        self._bridge = FlightBridge([command for _, command in robots], now=scheduler.now)
        self._first_ns = scheduler.now + SECOND
        scheduler.call_at(scheduler.now + flight_bridge.POLL_NS, self._poll)
        if rate_hz > 0:
            scheduler.call_at(self._first_ns, self._state, 0)

    def receive_datagram(self, data: bytes) -> None:
        """Take what came from cFS; the next poll looks at it."""
        self._bridge.receive_datagram(data)

    def _poll(self) -> None:
        now = self._scheduler.now
        polled = self._bridge.poll(now=now)
        for data in polled.sends:
            self._send(self.endpoint, self._sbn, data)
        commanded = {command: robot for (_, command), robot in self._robots.items()}
        for packet in polled.packets:
            if len(packet) < cfe.TELEMETRY_HEADER_BYTES:
                continue
            wanted = software_bus.msg_id(packet)
            self.received[wanted] = self.received.get(wanted, 0) + 1
            robot = commanded.get(wanted)
            values = robot and messages.decode(robot.command_type, packet[cfe.TELEMETRY_HEADER_BYTES :])
            if robot and values:
                robot.obey(values, now=now)
        self._scheduler.call_at(now + flight_bridge.POLL_NS, self._poll)

    def _state(self, index: int) -> None:
        for (state, _), robot in self._robots.items():
            packet = command_packet(state, robot.state(now=self._scheduler.now))
            self._send(self.endpoint, self._sbn, self._bridge.emit(packet))
            self.sent += 1
        due = self._first_ns + int((index + 1) * SECOND / self._rate_hz)
        self._scheduler.call_at(due, self._state, index + 1)

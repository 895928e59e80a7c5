"""Emulated ground and flight bridges, with an operator and robots: the traffic of the demos.

The robots are two that are easy to check by hand: a rover on a plane, and an arm that moves to its target.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from math import cos, sin
from typing import TYPE_CHECKING, Any, Final, Protocol

from edoras_tools.addons.lab.emulator import messages
from edoras_tools.cfs import edoras_app, telemetry_output
from edoras_tools.errors import ConfigError
from edoras_tools.model import Endpoint
from edoras_tools.sessions.sbn import PUBLIC_BRIDGE, AppMessage, SbnConnection
from edoras_tools.units import MILLISECOND, SECOND
from edoras_tools.wire import cfe

if TYPE_CHECKING:
    from edoras_tools.addons.lab.emulator.cfs import Cfs
    from edoras_tools.ros import TypeStore

ARM_JOINTS: Final = 7
ARM_TIME_CONSTANT_S: Final = 0.5
COMMAND_AGE_S: Final = 5.0
"""Time without a command after which a rover stops, s."""


class Robot(Protocol):
    """The interface of a robot for applications and bridges.

    Attributes:
        command_type: ROS type of its commands.
        state_type: ROS type of its state.
    """

    command_type: str
    state_type: str

    def obey(self, values: Mapping[str, Any], *, now: int) -> None:
        """Execute a command."""

    def state(self, *, now: int) -> bytes:
        """Return the state as CDR."""


class Rover:
    """A unicycle: drives and turns as the last Twist commands.

    Attributes:
        x: position, m.
        y: position, m.
        heading: angle, rad, counter-clockwise from x.
    """

    command_type = messages.TWIST
    state_type = messages.POSE_STAMPED

    def __init__(self, *, now: int, y: float = 0.0) -> None:
        self.x, self.y, self.heading = 0.0, y, 0.0
        self._speed = self._turn = 0.0
        self._moved_ns = self._told_ns = now

    def obey(self, values: Mapping[str, Any], *, now: int) -> None:
        """Execute a Twist: ``linear.x`` m/s and ``angular.z`` rad/s."""
        self._move(now)
        self._speed, self._turn = float(values["linear"]["x"]), float(values["angular"]["z"])
        self._told_ns = now

    def state(self, *, now: int) -> bytes:
        """Return a PoseStamped."""
        self._move(now)
        return messages.pose_stamped(now, "world", self.x, self.y, self.heading)

    def _move(self, now: int) -> None:
        until = min(now, self._told_ns + int(COMMAND_AGE_S * SECOND))
        seconds = max(0, until - self._moved_ns) / SECOND
        self._moved_ns = now
        # The exact arc; a straight line if it hardly turns.
        start, end = self.heading, self.heading + self._turn * seconds
        if abs(self._turn) > 1e-9:
            radius = self._speed / self._turn
            self.x += radius * (sin(end) - sin(start))
            self.y -= radius * (cos(end) - cos(start))
        else:
            self.x += self._speed * seconds * cos(start)
            self.y += self._speed * seconds * sin(start)
        self.heading = end


class StillRobot:
    """A robot that accepts commands of any type, and always reports its first state."""

    def __init__(self, command_type: str, state_type: str, state: bytes) -> None:
        self.command_type, self.state_type, self._state = command_type, state_type, state

    def obey(self, values: Mapping[str, Any], *, now: int) -> None:
        """Accept a command; nothing moves."""

    def state(self, *, now: int) -> bytes:
        """Return the state."""
        return self._state


class Arm:
    """Seven joints that move towards a target pose, each by its own share.

    No kinematics: joint ``i`` goes to ``(i + 1) / 7`` of the target's distance. Only the traffic matters.
    """

    command_type = messages.POSE
    state_type = messages.JOINT_STATE

    def __init__(self, *, now: int, name: str = "big_arm") -> None:
        self._names = [f"{name}_joint_{number}" for number in range(2, 2 + ARM_JOINTS)]
        self._positions = [0.0] * ARM_JOINTS
        self._target = [0.0] * ARM_JOINTS
        self._moved_ns = now

    def obey(self, values: Mapping[str, Any], *, now: int) -> None:
        """Execute a Pose."""
        self._move(now)
        distance = sum(float(item) ** 2 for item in values["position"].values()) ** 0.5
        self._target = [distance * (joint + 1) / ARM_JOINTS for joint in range(ARM_JOINTS)]

    def state(self, *, now: int) -> bytes:
        """Return a JointState."""
        self._move(now)
        return messages.joint_state(now, self._names, self._positions)

    def _move(self, now: int) -> None:
        share = min(1.0, max(0, now - self._moved_ns) / SECOND / ARM_TIME_CONSTANT_S)
        self._moved_ns = now
        self._positions = [
            at + (to - at) * share for at, to in zip(self._positions, self._target, strict=True)
        ]


def robot_of(
    command_type: str, state_type: str, store: TypeStore | None, *, now: int, number: int = 0
) -> Robot:
    """Return the robot for messages of some types: a rover, an arm, or one that does not move.

    Args:
        number: number of the robot, from 0.
    """
    if (command_type, state_type) == (Rover.command_type, Rover.state_type):
        return Rover(now=now, y=float(number))
    if (command_type, state_type) == (Arm.command_type, Arm.state_type):
        return Arm(now=now, name=("big_arm", "little_arm")[number % 2])
    return StillRobot(command_type, state_type, messages.encode(state_type, {}, store) if state_type else b"")


_ENABLE_AFTER_NS: Final = SECOND // 2
_POLL_NS: Final = 100 * MILLISECOND


def operator_command(
    command_type: str, rate_hz: float, index: int, robot: int, store: TypeStore | None = None
) -> bytes:
    """Return a command of the operator as CDR: arcs for rovers, targets for arms.

    Args:
        rate_hz: commands per second and robot.
        index: number of the command, from 0.
        robot: number of the robot, from 0.
        store: types, if it is not a type of the demos.
    """
    phase = index / rate_hz + robot
    if command_type == messages.TWIST:
        return messages.twist(0.5 + 0.1 * sin(phase / 3), 0.2 * cos(phase / 2))
    if command_type == messages.POSE:
        return messages.encode(messages.POSE, messages.pose(0.5 + 0.2 * sin(phase / 4), 0.1 * robot, 0.7))
    return messages.encode(command_type, {}, store)


class _Bridge:
    """A bridge to an emulated cFS: it has one socket, and sends a message of each robot at a rate.

    Args:
        cfs: the cFS, whose headers and routes the bridge has.
        endpoint: address of its socket.
        target: socket of cFS that it sends to.
        rate_hz: messages per second and robot.
        first_ns: time of the first messages, ns.
        count: messages of each robot; None for no end.

    Attributes:
        endpoint: address of its one socket.
        received: MsgId to packets that arrived.
        sent: messages sent.
    """

    def __init__(
        self,
        cfs: Cfs,
        endpoint: Endpoint,
        target: Endpoint,
        rate_hz: float,
        first_ns: int,
        count: int | None = None,
    ) -> None:
        self.endpoint, self._target = endpoint, target
        self.received: Counter[int] = Counter()
        self.sent = 0
        self._cfs, self._headers, self._scheduler = cfs, cfs.profile.headers, cfs.scheduler
        self._rate_hz, self._first_ns, self._count = rate_hz, first_ns, count
        if rate_hz > 0:
            self._scheduler.call_at(first_ns, self._send_all, 0)

    def _send_all(self, index: int) -> None:
        """Send message number ``index`` of each robot, and plan the next ones."""
        for data in self._datagrams(index):
            self._send(data)
            self.sent += 1
        if self._count is None or index + 1 < self._count:
            due = self._first_ns + int((index + 1) * SECOND / self._rate_hz)
            self._scheduler.call_at(due, self._send_all, index + 1)

    def _datagrams(self, index: int) -> Iterable[bytes]:
        raise NotImplementedError

    def _send(self, data: bytes) -> None:
        self._cfs.send(self.endpoint, self._target, data)

    def _command(self, msg_id: int, function_code: int, body: bytes) -> bytes:
        """Return a command as the bridges send it: sequence word 0, checksum 0."""
        return cfe.emit_command(
            messages.link_id(msg_id, self._cfs.profile),
            function_code,
            body,
            sequence_flags=0,
            with_checksum=False,
            headers=self._headers,
        )

    def _message(self, msg_id: int, cdr: bytes) -> bytes:
        """Return a ROS message as the packet of a MsgId on the bus."""
        return self._command(msg_id, edoras_app.SET, self._cfs.routes.envelope(msg_id).emit(cdr))


class GroundBridge(_Bridge):
    """The ground bridge: enables telemetry, sends commands to Command Ingest, receives TO's packets.

    Args:
        cfs: the cFS.
        rate_hz: commands per second and robot.
        count: commands per robot; None for no end.
        after_ns: time until the first command, ns.
    """

    def __init__(self, cfs: Cfs, rate_hz: float, count: int | None, after_ns: int) -> None:
        endpoint, now = Endpoint(cfs.profile.address, cfs.profile.to_port), cfs.scheduler.now
        super().__init__(cfs, endpoint, cfs.ci_endpoint, rate_hz, now + after_ns, count)
        self._scheduler.call_at(now + _ENABLE_AFTER_NS, self._enable)

    def receive_datagram(self, data: bytes) -> None:
        """Process a datagram of cFS; the buffer holds 1024 bytes."""
        if len(data[: edoras_app.BRIDGE_BUFFER]) >= cfe.COMMAND_HEADER_BYTES:
            self.received[self._headers.msg_ids.of(data)] += 1

    def _enable(self) -> None:
        address = self.endpoint.address.encode().ljust(16, b"\0")
        self._send(self._command(telemetry_output.COMMAND_MSG_ID, telemetry_output.ENABLE, address))

    def _datagrams(self, index: int) -> Iterable[bytes]:
        routes = self._cfs.routes
        for robot, msg_id in enumerate(routes.commands):
            own = routes.types[routes.commands[0]]
            cdr = operator_command(own, self._rate_hz, index, robot, routes.store)
            yield self._message(msg_id, cdr)


class FlightBridge(_Bridge):
    """The flight bridge and the robots behind it.

    Args:
        cfs: the cFS.
        rate_hz: states per second and robot.

    Raises:
        ConfigError: the profile does not have the bridge's peer, or SBN over TCP.
    """

    def __init__(self, cfs: Cfs, rate_hz: float) -> None:
        profile, routes, now = cfs.profile, cfs.routes, cfs.scheduler.now
        if profile.sbn_tcp:
            raise ConfigError("the flight bridge speaks SBN over UDP alone: leave it out, --no-bridges")
        peer = next((item for item in profile.sbn_peers if item.peer == routes.bridge), None)
        if peer is None:
            raise ConfigError(f"sim profile: sbn_peers: the flight bridge, {routes.bridge}, is missing")
        super().__init__(cfs, Endpoint(peer.address, peer.port), cfs.sbn_endpoint, rate_hz, now + SECOND)
        self._robots = [
            robot_of(routes.types[command], routes.types[state], routes.store, now=now, number=number)
            for number, (command, state) in enumerate(zip(routes.flight, routes.states, strict=True))
        ]
        commands = [messages.link_id(item, profile) for item in routes.flight]
        self._connection = SbnConnection(peer.peer, commands, habits=PUBLIC_BRIDGE, now=now)
        self._scheduler.call_at(now + _POLL_NS, self._poll)

    def receive_datagram(self, data: bytes) -> None:
        """Queue a datagram of cFS; the next poll reads it."""
        self._connection.receive_datagram(data, now=self._scheduler.now)

    def _poll(self) -> None:
        now = self._scheduler.now
        step = self._connection.service(now=now)
        for data in step.datagrams:
            self._send(data)
        for event in step.events:
            if isinstance(event, AppMessage):
                self._obey(event.packet, now)
        self._scheduler.call_at(now + _POLL_NS, self._poll)

    def _obey(self, packet: bytes, now: int) -> None:
        """Pass a command of cFS to its robot."""
        if len(packet) < cfe.TELEMETRY_HEADER_BYTES:
            return
        routes, number = self._cfs.routes, self._headers.msg_ids.of(packet)
        self.received[number] += 1
        msg_id = self._headers.msg_ids.standard(number)
        if msg_id in routes.flight:
            robot = self._robots[routes.flight.index(msg_id)]
            data, form = packet[cfe.TELEMETRY_HEADER_BYTES :], routes.envelope(msg_id)
            if values := messages.decode_envelope(robot.command_type, data, form, routes.store):
                robot.obey(values, now=now)

    def _datagrams(self, index: int) -> Iterable[bytes]:
        for msg_id, robot in zip(self._cfs.routes.states, self._robots, strict=True):
            packet = self._message(msg_id, robot.state(now=self._scheduler.now))
            yield self._connection.frame(packet)

"""Who is in the ROS 2 graph of a demo beside the bridges: the ground station, and the robots."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from math import dist
from typing import TYPE_CHECKING, Any, Final

from edoras_tools.errors import WireError
from edoras_tools.middleware import Qos
from edoras_tools.sessions.profile import SECOND
from edoras_tools.sim.bridges import Operator
from edoras_tools.sim.robots import Arm, Rover

if TYPE_CHECKING:
    from collections.abc import Mapping

    from edoras_tools.middleware import Graph
    from edoras_tools.pipelines.demo_agenda import Agenda
    from edoras_tools.pipelines.demo_scene import Lane
    from edoras_tools.pipelines.demo_trace import Leg
    from edoras_tools.ros import TypeStore
    from edoras_tools.sim.robots import Robot

_GIVES_WAY_NS: Final = 5 * SECOND
"""The ground station says nothing for so long after another node commanded its robot."""
_TRACK: Final = 400
_QOS: Final = Qos()


@dataclass(slots=True)
class Seen:
    """What the ground knows of a robot.

    Attributes:
        place: of a rover x, y in m and heading in rad; of an arm its joints, rad; empty at first.
        start: the first of them.
        way: how far it came: m of a rover, rad of all joints of an arm.
        track: places of a rover, some of them, oldest first.
        looks: how often it was looked at.
    """

    place: tuple[float, ...] = ()
    start: tuple[float, ...] = ()
    way: float = 0.0
    track: list[tuple[float, float]] = field(default_factory=list)
    looks: int = 0

    def take(self, values: Mapping[str, Any]) -> None:
        """Take a PoseStamped or a JointState."""
        place = place_of(values)
        if not self.looks:
            self.start = place
        elif len(place) == len(self.place):
            moved = slice(0, 2) if "pose" in values else slice(None)
            self.way += dist(place[moved], self.place[moved])
        self.looks += 1
        self.place = place
        if "pose" in values and (not self.track or dist(place[:2], self.track[-1]) > 0.02):
            self.track.append((place[0], place[1]))
            if len(self.track) > _TRACK:
                del self.track[1::2]


def place_of(values: Mapping[str, Any]) -> tuple[float, ...]:
    """Return where a robot is by its state."""
    from math import atan2

    if "pose" not in values:
        return tuple(map(float, values["position"]))
    position, turned = values["pose"]["position"], values["pose"]["orientation"]
    return float(position["x"]), float(position["y"]), 2 * atan2(turned["z"], turned["w"])


class GroundStation:
    """The operator: commands every robot at a rate, and looks where it is.

    It gives way for some seconds to whoever else commands a robot.

    Args:
        lanes: the robots.
        commands: what is followed of each.
        states: likewise.
        rate_hz: commands a second and robot; 0 for none.
        types: the ROS types.
        agenda: where it works.

    Attributes:
        seen: what it knows of each robot.
        others: commands of other nodes, of each robot.
    """

    def __init__(
        self,
        lanes: tuple[Lane, ...],
        commands: list[Leg],
        states: list[Leg],
        rate_hz: float,
        types: TypeStore,
        agenda: Agenda,
    ) -> None:
        self.seen = [Seen() for _ in lanes]
        self.others = [0] * len(lanes)
        self._lanes, self._commands, self._states = lanes, commands, states
        self._rate_hz, self._types, self._agenda = rate_hz, types, agenda
        self._others_ns = [-_GIVES_WAY_NS] * len(lanes)
        self._newest = [b""] * len(lanes)
        self._index = 0
        self._quiet = False
        self._publish: list[Any] = []
        self._operator = Operator(
            lanes[0].command.type, [lane.command.msg_id for lane in lanes], rate_hz or 1
        )

    def join(self, graph: Graph) -> None:
        """Take part in a graph.

        Raises:
            ConfigError: it refuses.
        """
        for index, lane in enumerate(self._lanes):
            self._publish.append(graph.advertise(lane.command.topic, lane.command.type, _QOS))
            graph.subscribe(lane.command.topic, lane.command.type, _QOS, self._other(index))
            graph.subscribe(lane.state.topic, lane.state.type, _QOS, self._state(index))

    def begin(self) -> None:
        """Begin to command, on the agenda."""
        if self._rate_hz:
            self._agenda.every(self._rate_hz, self._command)

    def rest(self) -> None:
        """Command no more."""
        self._quiet = True

    def _command(self) -> None:
        if self._quiet:
            return
        for robot, publish in enumerate(self._publish):
            now = time.monotonic_ns()
            if now - self._others_ns[robot] >= _GIVES_WAY_NS:
                cdr = self._operator.cdr(self._index, robot)
                self._commands[robot].begin(cdr, now)
                publish(cdr)
        self._index += 1

    def _other(self, robot: int) -> Any:
        def heard(_cdr: bytes) -> None:
            self.others[robot] += 1
            self._others_ns[robot] = time.monotonic_ns()

        return heard

    def _state(self, robot: int) -> Any:
        leg, ask, look, newest = self._states[robot], self._agenda.ask, self._look, self._newest

        def heard(cdr: bytes) -> None:
            leg.arrive(cdr, time.monotonic_ns())
            # Telemetry comes in bursts: of each, the last is looked at.
            waits, newest[robot] = newest[robot], cdr
            if not waits:
                ask(look, robot)

        return heard

    def _look(self, robot: int) -> None:
        cdr, self._newest[robot] = self._newest[robot], b""
        try:
            values = self._types.decode(self._lanes[robot].state.type, cdr)
        except WireError:
            return
        self.seen[robot].take(values)


class RobotNode:
    """A robot in the graph: it obeys what the flight bridge says, and tells its state at a rate.

    Args:
        lane: its topics.
        robot: what moves.
        command: what is followed.
        state: likewise.
        types: the ROS types.
        agenda: where it works.
    """

    def __init__(
        self, lane: Lane, robot: Robot, command: Leg, state: Leg, types: TypeStore, agenda: Agenda
    ) -> None:
        self._lane, self._robot, self._types, self._agenda = lane, robot, types, agenda
        self._command, self._state = command, state
        self._quiet = False

    def join(self, graph: Graph) -> None:
        """Take part in a graph.

        Raises:
            ConfigError: it refuses.
        """
        lane = self._lane
        assert lane.board_command is not None
        assert lane.board_state is not None
        self._publish = graph.advertise(lane.board_state.topic, lane.board_state.type, _QOS)
        graph.subscribe(lane.board_command.topic, lane.board_command.type, _QOS, self._heard)

    def begin(self, rate_hz: float) -> None:
        """Begin to tell, on the agenda."""
        if rate_hz:
            self._agenda.every(rate_hz, self._tell)

    def rest(self) -> None:
        """Tell no more."""
        self._quiet = True

    def _heard(self, cdr: bytes) -> None:
        self._command.arrive(cdr, time.monotonic_ns())
        self._agenda.ask(self._obey, cdr)

    def _obey(self, cdr: bytes) -> None:
        try:
            values = self._types.decode(self._lane.command.type, cdr)
        except WireError:
            return
        self._robot.obey(values, now=time.time_ns())

    def _tell(self) -> None:
        if not self._quiet:
            cdr = self._robot.state(now=time.time_ns())
            self._state.begin(cdr, time.monotonic_ns())
            self._publish(cdr)


class AppRobot:
    """A ``Robot`` that hangs on the flight application, and is looked at from outside.

    Args:
        robot: the robot.
        command: what is followed.
        state: likewise.
        types: the ROS types.
    """

    def __init__(self, robot: Robot, command: Leg, state: Leg, types: TypeStore) -> None:
        self.command_type, self.state_type = robot.command_type, robot.state_type
        self._robot, self._command, self._state, self._types = robot, command, state, types

    def obey(self, values: Mapping[str, Any], *, now: int) -> None:
        """Take a command."""
        self._command.arrive(self._types.encode(self.command_type, values), time.monotonic_ns())
        self._robot.obey(values, now=now)

    def state(self, *, now: int) -> bytes:
        """Return the state as CDR."""
        cdr = self._robot.state(now=now)
        self._state.begin(cdr, time.monotonic_ns())
        return cdr


def make_robot(lane: Lane, index: int) -> Robot:
    """Return the robot of a lane."""
    now = time.time_ns()
    return Rover(now=now, y=float(index)) if "Twist" in lane.command.type else Arm(now=now, name=lane.robot)

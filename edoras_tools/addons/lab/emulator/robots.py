"""Two robots that are easy to check by hand: a rover on a plane, and an arm that moves to its target."""

from __future__ import annotations

from math import cos, sin
from typing import TYPE_CHECKING, Any, Final, Protocol

from edoras_tools.addons.lab.emulator import messages
from edoras_tools.units import SECOND

if TYPE_CHECKING:
    from collections.abc import Mapping

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

"""The robot link: between a flight app and its robot over UDP, bare doubles without a header.

The paper calls it serial. Its values are shown as bytes: only the app knows what they mean.
"""

from __future__ import annotations

from typing import ClassVar, Final

from edoras_tools.links.protocol import Form, LinkProtocol
from edoras_tools.model import Transport
from edoras_tools.wire.layout import Field, Layout

CFS_PORT: Final = 8080
ROBOT_PORT: Final = 8585

ROBOT_COMMAND: Final = Layout(
    "robot_command",
    "Robot command",
    Field("values", 8 * 48, "6 doubles in native order: linear and angular x, y, z", kind="bytes"),
)
ROBOT_POSE: Final = Layout(
    "robot_pose",
    "Robot pose",
    Field(
        "values", 8 * 56, "7 doubles in native order: position x, y, z; quaternion x, y, z, w", kind="bytes"
    ),
)
ROBOT_STATE: Final = Layout(
    "robot_state",
    "Robot state",
    Field(
        "values",
        8 * 56,
        "7 doubles in native order: a rover's position x, y, z and quaternion x, y, z, w; an arm's 7 joints",
        kind="bytes",
    ),
    Field("stamp", 8 * 8, "seconds and nanoseconds, 4 bytes each in native order", kind="bytes"),
)


class RobotLink(LinkProtocol):
    """The link of the public flight apps to the robot.

    Other programs use port 8080 too, so the lengths of its messages and likely doubles identify it.
    """

    code = 4
    name = "ROBOT"
    label = "robot"
    colour = "yellow"
    doc = "between a flight app and its robot, bare doubles over UDP"
    transport = Transport(ports=(CFS_PORT, ROBOT_PORT), first="either")
    to_cfs = True
    from_cfs = True
    last_hop = True
    layouts = (ROBOT_COMMAND, ROBOT_POSE, ROBOT_STATE)
    forms: ClassVar = {
        ROBOT_COMMAND.size: Form((ROBOT_COMMAND,), port=ROBOT_PORT, doubles=6),
        ROBOT_POSE.size: Form((ROBOT_POSE,), port=ROBOT_PORT, doubles=7),
        ROBOT_STATE.size: Form((ROBOT_STATE,), port=CFS_PORT, doubles=7),
    }


ROBOT: Final = RobotLink()

"""The messages between the public flight apps and their robots: bare doubles, without a header.

They have the sender's native byte order, which is little-endian in practice.
"""

from __future__ import annotations

from typing import Final

from edoras_tools.wire.layout import Field, Layout

CFS_PORT: Final = 8080
ROBOT_PORT: Final = 8585


def _doubles(name: str, letters: str, doc: str) -> list[Field]:
    return [Field(f"{name}_{letter}", 64, doc, kind="float") for letter in letters]


_PLACE: Final = (
    *_doubles("position", "xyz", "m; an arm's joints 1 to 3, rad"),
    *_doubles("orientation", "xyzw", "quaternion; an arm's joints 4 to 7, rad"),
)
ROBOT_COMMAND: Final = Layout(
    "robot_command",
    "Robot command",
    *_doubles("linear", "xyz", "velocity, m/s"),
    *_doubles("angular", "xyz", "velocity, rad/s"),
    byte_order="little",
)
ROBOT_POSE: Final = Layout("robot_pose", "Robot pose", *_PLACE, byte_order="little")
ROBOT_STATE: Final = Layout(
    "robot_state",
    "Robot state",
    *_PLACE,
    Field("stamp_seconds", 32, "the robot's time", kind="int"),
    Field("stamp_nanoseconds", 32, "the robot's time: beyond its seconds"),
    byte_order="little",
)
SENT_TO: Final = {ROBOT_COMMAND: ROBOT_PORT, ROBOT_POSE: ROBOT_PORT, ROBOT_STATE: CFS_PORT}
"""Destination port of each message; a message is recognised by its length."""

"""Commands that a flight application sends to its robot: bare numbers without a header."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from edoras_tools.diagnosis.evidence import fingerprint
from edoras_tools.links.robot import ROBOT
from edoras_tools.structs.packets import UDP_KEY
from edoras_tools.wire import robot
from edoras_tools.wire.fingerprint import of_bytes
from edoras_tools.wire.window import PADDING, gather

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from edoras_tools.model import Columns, PacketBatch
    from edoras_tools.ros import TypeStore
    from edoras_tools.structs import Structs

_TYPES: Final = {
    robot.ROBOT_COMMAND.size: "geometry_msgs/msg/Twist",
    robot.ROBOT_POSE.size: "geometry_msgs/msg/Pose",
}
"""Bytes of a datagram to the message whose numbers it carries."""
_ENCAPSULATION: Final = b"\0\1\0\0"


def robot_commands(columns: Columns, batch: PacketBatch, structs: Structs) -> NDArray[np.bool_]:
    """Tell which datagrams are commands to a robot: all but the states that it sends."""
    port = batch.destination_port
    state = (batch.length == robot.ROBOT_STATE.size) & (structs.of_port(port) == UDP_KEY)
    return np.asarray((columns.link == ROBOT) & (port != robot.CFS_PORT) & ~state)


def fingerprints(
    batch: PacketBatch, rows: NDArray[np.intp], types: TypeStore | None
) -> tuple[NDArray[np.uint64], NDArray[np.uint64]]:
    """Return two fingerprints of each command to a robot: of its bytes, and of its values.

    They are those that the command to cFS has, as a message of an unknown and of a known type.
    """
    length = batch.length[rows]
    bytes_ = of_bytes(batch.data, batch.offset[rows], length)
    values = np.zeros(len(rows), np.uint64)
    for size, name in _TYPES.items():
        own = np.flatnonzero(length == size)
        if not len(own) or types is None or not types.has(name):
            continue
        step = len(_ENCAPSULATION) + size
        data = np.zeros(len(own) * step + PADDING, np.uint8)
        messages = data[: len(own) * step].reshape(-1, step)
        messages[:, : len(_ENCAPSULATION)] = np.frombuffer(_ENCAPSULATION, np.uint8)
        messages[:, len(_ENCAPSULATION) :] = gather(batch.data, batch.offset[rows[own]], size)
        offset = np.arange(len(own), dtype=np.int64) * step
        values[own], _ = fingerprint.of_values(types, name, data, offset, np.full(len(own), step, np.int32))
    return bytes_, values

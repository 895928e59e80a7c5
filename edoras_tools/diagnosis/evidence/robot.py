"""Commands that a flight application sends to its robot: bare numbers without a header."""

from __future__ import annotations

import re
from functools import partial
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from edoras_tools.diagnosis.evidence import fingerprint
from edoras_tools.links.robot import ROBOT
from edoras_tools.structs.payloads import payloads
from edoras_tools.structs.shapes import UDP_KEY
from edoras_tools.wire import robot
from edoras_tools.wire.arrays.fingerprint import of_bytes
from edoras_tools.wire.arrays.window import PADDING, gather

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from edoras_tools.decode import Context
    from edoras_tools.model import Columns, PacketBatch
    from edoras_tools.ros import TypeStore
    from edoras_tools.ros.cdr.columns import MessageColumns
    from edoras_tools.structs import Structs

_TYPES: Final = {
    robot.ROBOT_COMMAND.size: "geometry_msgs/msg/Twist",
    robot.ROBOT_POSE.size: "geometry_msgs/msg/Pose",
}
"""Bytes of a datagram to the message whose numbers it carries."""
_ENCAPSULATION: Final = b"\0\1\0\0"


class SharedFields:
    """Finds the command that a robot's own struct was made of, by the numbers of one name in both.

    Names are the same without their dots and underscores, in either case: ``linear.x`` is ``Linear_X``. The
    command's numbers are rounded as the struct's types round them.
    Of structs for one type of command that share different numbers with it only the first is followed.

    Args:
        context: its structs that are bound to ports, and the types of its commands.
    """

    def __init__(self, context: Context) -> None:
        self._context = context
        self._shared: dict[str, tuple[str, dict[str, tuple[str, np.dtype[Any]]]]] = {}
        types = context.types
        if types is None or not context.structs.ports:
            return
        empty = np.zeros(1, np.uint8), np.zeros(0, np.int64), np.zeros(0, np.int32)
        commands = {route.type for route in context.mission.routes if route.to_cfs and types.has(route.type)}
        for _, bound in context.structs.ports:
            own = _by_name(context.structs.types.columns(bound.type, *empty))
            for kind in sorted(commands):
                names = _by_name(types.columns(kind, *empty))
                shared = {names[key][0]: own[key] for key in names.keys() & own.keys()}
                if len(shared) > len(self._shared.get(bound.topic, ("", {}))[1]):
                    self._shared[bound.topic] = kind, dict(sorted(shared.items()))

    def fingerprints(
        self, batch: PacketBatch, columns: Columns, offset: NDArray[np.int64], length: NDArray[np.int32]
    ) -> NDArray[np.uint64]:
        """Return a fingerprint of each command and of each struct made of one; 0 for others.

        Args:
            offset: i64, first byte of each message, encapsulation included; -1 where there is none.
            length: i32, bytes of each.
        """
        found = np.zeros(len(batch), np.uint64)
        structs, types, routes = self._context.structs, self._context.types, self._context.mission.routes
        if not self._shared or types is None:
            return found
        column = partial(getattr, columns)
        bare = payloads(structs, column, partial(getattr, batch), batch.data)
        for held in structs.payloads_of(bare.take(bare.key >= UDP_KEY), column, batch.data):
            if held.bound.topic in self._shared:
                told = held.encode()
                read = structs.types.columns(
                    held.bound.type, told.data, told.start, told.size.astype(np.int32)
                )
                names = self._shared[held.bound.topic][1]
                found[held.rows] = fingerprint.of_fields(
                    {name: np.asarray(read.fields[own]) for name, (own, _) in names.items()}
                )
        for kind, names in reversed(self._shared.values()):
            of_kind = [index for index, route in enumerate(routes) if route.type == kind and route.to_cfs]
            rows = np.flatnonzero((offset >= 0) & np.isin(columns.route, of_kind))
            read = types.columns(kind, batch.data, offset[rows], length[rows])
            told_values = {
                name: np.asarray(read.fields[name]).astype(own) for name, (_, own) in names.items()
            }
            found[rows] = np.where(read.valid, fingerprint.of_fields(told_values), 0)
        return found


def _by_name(columns: MessageColumns) -> dict[str, tuple[str, np.dtype[Any]]]:
    """Return the single numbers of a type by their plain names: the path, and the type."""
    return {
        re.sub("[^a-z0-9]", "", name.lower()): (name, column.dtype)
        for name, column in columns.fields.items()
        if isinstance(column, np.ndarray) and column.ndim == 1 and column.dtype.kind in "iuf"
    }


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

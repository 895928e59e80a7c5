"""Fingerprints of messages, to find the same message on another link.

A fingerprint is made from the decoded values, so that another encoding, padding or time stamp does not change
it. Fingerprints are u64; 0 means that there is none.

What a flight application sends to its robot are bare numbers without a header: they are compared as the bytes
or values of the type that they carry, or by the numbers that a robot's own struct shares with a command.
"""

from __future__ import annotations

import re
from functools import partial
from typing import TYPE_CHECKING, Any, Final
from zlib import crc32

import numpy as np
from msgspec.structs import replace

from edoras_tools.links.robot import ROBOT
from edoras_tools.model import OTHER, Columns, PacketBatch
from edoras_tools.structs.payloads import payloads
from edoras_tools.structs.shapes import UDP_KEY
from edoras_tools.wire import robot
from edoras_tools.wire.arrays.fingerprint import HASHED_BYTES, MIX, WEIGHTS, finished, of_bytes, stirred
from edoras_tools.wire.arrays.order import Integers, Mask, Places, Prints, in_16_bits, numbered
from edoras_tools.wire.arrays.window import PADDING, gather

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from edoras_tools.decode import Context
    from edoras_tools.ros import TypeStore
    from edoras_tools.ros.cdr.columns import MessageColumns, Ragged
    from edoras_tools.structs import Structs


_OCTETS: Final = np.uint8, np.int8


def of_values(
    types: TypeStore, type_name: str, data: NDArray[np.uint8], offset: Integers, length: NDArray[np.int32]
) -> tuple[Prints, Prints]:
    """Return two fingerprints of each message: of all numbers but time stamps, and of all numbers.

    A type without numbers goes by its strings. Messages that do not decode have none.

    Args:
        data: u8, the buffer that holds them.
        offset: i64, first byte of each CDR, encapsulation included.
        length: i32, bytes of each CDR.
    """
    columns = types.columns(type_name, data, offset, length)
    plain, stamped = (np.zeros(len(columns), np.uint64) for _ in range(2))
    texts: list[tuple[str, Any]] = []
    numeric = False
    for name, column in columns.fields.items():
        values = column if isinstance(column, np.ndarray) else column.values
        if values.dtype == object:
            texts.append((name, column))
            continue
        numeric = True
        part = _field(name, column)
        stamped += part
        if not name.endswith(("stamp.sec", "stamp.nanosec")):
            plain += part
    if not numeric:
        for name, column in texts:
            plain += _text(name, column)
        stamped = plain
    plain, stamped = finished(plain), finished(stamped)
    plain[~columns.valid], stamped[~columns.valid] = 0, 0
    return plain, stamped


def of_fields(columns: Mapping[str, NDArray[Any]]) -> Prints:
    """Return a fingerprint of some numbers of each message, by their names; of one column at least."""
    return finished(
        np.sum([_field(name, column) for name, column in columns.items()], axis=0, dtype=np.uint64)
    )


def latest_equal(into: Prints, into_ns: Integers, out: Prints, out_ns: Integers) -> Places:
    """Return which of ``into`` is the latest equal to each of ``out`` and not later; -1 for none."""
    prints, order = _in_order(into, into_ns, out, out_ns)
    latest = np.maximum.accumulate(np.where(order < len(into), np.arange(len(order)), -1))
    goes = np.flatnonzero((order >= len(into)) & (latest >= 0))
    from_ = order[latest[goes]]
    same = (prints[order[goes]] == prints[from_]) & (prints[from_] != 0)
    origin = np.full(len(out), -1, np.intp)
    origin[order[goes[same]] - len(into)] = from_[same]
    return origin


def paired(into: Prints, into_ns: Integers, out: Prints, out_ns: Integers) -> Places:
    """Return which of ``into`` each of ``out`` is, each once, -1 for none: equal, the latest not later."""
    prints, order = _in_order(into, into_ns, out, out_ns)
    opening, closing = brackets(prints[order], order < len(into))
    real = prints[order[opening]] != 0
    origin = np.full(len(out), -1, np.intp)
    origin[order[closing[real]] - len(into)] = order[opening[real]]
    return origin


def _in_order(into: Prints, into_ns: Integers, out: Prints, out_ns: Integers) -> tuple[Prints, Places]:
    """Return both together, and their order: equal ones by time, what went in first at one time."""
    prints = np.concatenate((into, out))
    by_time = np.argsort(np.concatenate((into_ns, out_ns)), kind="stable")
    return prints, by_time[np.argsort(in_16_bits(numbered(prints)[1])[by_time], kind="stable")]


def brackets(group: NDArray[Any], opens: Mask) -> tuple[Places, Places]:
    """Return which brackets close which: places of opening ones, and of those that close them.

    A closing bracket closes the one of its group that was opened last, if any is open.

    Args:
        group: whose each bracket is; those of one group stand together, in order.
        opens: which of them open.
    """
    # The brackets of one level of a group follow each other, whatever is within or is never closed.
    level = np.cumsum(np.where(opens, 1, -1)) + ~opens
    number = np.cumsum(np.append(False, group[1:] != group[:-1])[: len(group)])
    order = np.lexsort((in_16_bits(level - level.min(initial=0)), in_16_bits(number)))
    before, behind = order[:-1], order[1:]
    closed = opens[before] & ~opens[behind]
    closed &= (number[before] == number[behind]) & (level[before] == level[behind])
    return before[closed], behind[closed]


def _field(name: str, column: NDArray[Any] | Ragged) -> Prints:
    """Return what a numeric field adds to the fingerprints, a row each."""
    key = np.uint64(crc32(name.encode()) * int(MIX) & 0xFFFFFFFFFFFFFFFF)
    if isinstance(column, np.ndarray):
        flat = column.reshape(len(column), -1)
        total = np.zeros(len(column), np.uint64)
        for index in range(flat.shape[1]):
            total += stirred(_bits(flat[:, index]) + key) * WEIGHTS[index % len(WEIGHTS)]
        return total
    values, offset, count = column.values, column.offsets[:-1], np.diff(column.offsets)
    total, rest = count.astype(np.uint64) * key, np.ones(len(count), np.bool_)
    for sign, narrow in enumerate(_OCTETS) if values.dtype.kind in "iub" else ():
        # The same values are the same bytes, whatever type holds them: the first that holds all of a row.
        if values.dtype in (narrow, np.bool_):
            fits = rest
        else:
            least, most = np.iinfo(narrow).min, np.iinfo(narrow).max
            outside = np.append(0, np.cumsum((values < least) | (values > most)))
            fits = rest & (outside[column.offsets[1:]] == outside[offset])
        octets = values.astype(narrow, copy=False).view(np.uint8)
        total[fits] += _octets(octets, offset[fits], count[fits], key ^ np.uint64(sign))
        rest = rest & ~fits
        if not rest.any():
            return total
    if not rest.all():
        values, count = values[np.repeat(rest, count)], count[rest]
    begin = np.cumsum(count) - count
    within = np.arange(len(values)) - np.repeat(begin, count)
    part = stirred(_bits(values) + key) * WEIGHTS[within % len(WEIGHTS)]
    sums = np.append(np.uint64(0), np.cumsum(part, dtype=np.uint64))
    total[rest] += sums[begin + count] - sums[begin]
    return total


def _octets(data: NDArray[np.uint8], offset: Integers, length: Integers, key: np.uint64) -> Prints:
    """Return what ranges of bytes add to the fingerprints; each byte counts, however many there are."""
    data = np.append(data, np.zeros(HASHED_BYTES, np.uint8))
    total = np.zeros(len(offset), np.uint64)
    for block in range(0, int(length.max(initial=0)), HASHED_BYTES):
        part = of_bytes(data, offset + block, np.maximum(length - block, 0))
        total += np.where(part, stirred(part + key) * WEIGHTS[block // HASHED_BYTES % len(WEIGHTS)], 0)
    return total


def _text(name: str, column: NDArray[Any] | Ragged) -> Prints:
    key = name.encode()
    rows = (
        column.tolist()
        if isinstance(column, np.ndarray)
        else ["\0".join(column[row].tolist()) for row in range(len(column))]
    )
    return np.array([crc32(text.encode("utf-8", "replace"), crc32(key)) for text in rows], np.uint64) * MIX


def _bits(values: NDArray[Any]) -> Prints:
    if values.dtype.kind == "f":
        with np.errstate(invalid="ignore"):  # what was never set may be no number
            return (values.astype(np.float64) + 0.0).view(np.uint64)  # 0.0 and -0.0 are one value
    return values.astype(np.int64).view(np.uint64)


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
        self, batch: PacketBatch, columns: Columns, offset: Integers, length: NDArray[np.int32]
    ) -> Prints:
        """Return a fingerprint of each command and of each struct made of one; 0 for others.

        Args:
            offset: i64, first byte of each message, encapsulation included; -1 where there is none.
            length: i32, bytes of each.
        """
        prints = np.zeros(len(batch), np.uint64)
        structs, types, routes = self._context.structs, self._context.types, self._context.mission.routes
        if not self._shared or types is None:
            return prints
        column = partial(getattr, columns)
        bare = payloads(structs, column, partial(getattr, batch), batch.data)
        for group in structs.payloads_of(bare.take(bare.key >= UDP_KEY), column, batch.data):
            if group.bound.topic in self._shared:
                cdr = group.encode()
                read = structs.types.columns(group.bound.type, cdr.data, cdr.start, cdr.size.astype(np.int32))
                names = self._shared[group.bound.topic][1]
                prints[group.rows] = of_fields(
                    {name: np.asarray(read.fields[own]) for name, (own, _) in names.items()}
                )
        for kind, names in reversed(self._shared.values()):
            of_kind = [index for index, route in enumerate(routes) if route.type == kind and route.to_cfs]
            rows = np.flatnonzero((offset >= 0) & np.isin(columns.route, of_kind))
            read = types.columns(kind, batch.data, offset[rows], length[rows])
            told_values = {
                name: np.asarray(read.fields[name]).astype(own) for name, (_, own) in names.items()
            }
            prints[rows] = np.where(read.valid, of_fields(told_values), 0)
        return prints


def _by_name(columns: MessageColumns) -> dict[str, tuple[str, np.dtype[Any]]]:
    """Return the single numbers of a type by their plain names: the path, and the type."""
    return {
        re.sub("[^a-z0-9]", "", name.lower()): (name, column.dtype)
        for name, column in columns.fields.items()
        if isinstance(column, np.ndarray) and column.ndim == 1 and column.dtype.kind in "iuf"
    }


def robot_commands(columns: Columns, batch: PacketBatch, structs: Structs) -> Mask:
    """Tell which datagrams are commands to a robot: all but the states that it sends."""
    port = batch.destination_port
    state = (batch.length == robot.ROBOT_STATE.size) & (structs.of_port(port) == UDP_KEY)
    return np.asarray((columns.link == ROBOT) & (port != robot.CFS_PORT) & ~state)


def with_garbled(columns: Columns, batch: PacketBatch) -> Columns:
    """Return columns in which what a flight app sends its robot is of the robot link, whatever it holds.

    Elsewhere that link is known by likely numbers: what was never set, or was damaged, has others.
    """
    garbled = (batch.source_port == robot.CFS_PORT) & (batch.destination_port == robot.ROBOT_PORT)
    length = batch.length + np.maximum(batch.original_length - batch.frame_length, 0)
    garbled &= (columns.link == OTHER) & np.isin(length, list(_TYPES))
    link = np.where(garbled, np.uint8(ROBOT.code), columns.link)
    return replace(columns, link=link) if garbled.any() else columns


def robot_prints(batch: PacketBatch, rows: Places, types: TypeStore | None) -> tuple[Prints, Prints]:
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
        values[own], _ = of_values(types, name, data, offset, np.full(len(own), step, np.int32))
    return bytes_, values

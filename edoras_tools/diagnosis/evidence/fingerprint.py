"""Fingerprints of messages, to find the same message on another link.

Rules:

1. A fingerprint is a u64. It is 0 if there is none.
2. It is computed from decoded values, so it does not depend on byte order, padding or (in one of two kinds)
   time stamps.
3. A flight application sends its robot bare numbers without a header. They are compared as bytes or values of
   the message type that they hold, or by the numbers that the robot's own struct shares with a command.
"""

from __future__ import annotations

import re
from functools import partial
from typing import TYPE_CHECKING, Any, Final
from zlib import crc32

import numpy as np
from msgspec.structs import replace

from edoras_tools.links import CFS_PORT, ROBOT_PORT, bare
from edoras_tools.links.bare import ROBOT
from edoras_tools.model import OTHER, Columns, PacketBatch
from edoras_tools.structs.bindings import payloads
from edoras_tools.structs.shapes import UDP_KEY
from edoras_tools.wire.arrays import (
    HASHED_BYTES,
    MIX,
    PADDING,
    WEIGHTS,
    Integers,
    Mask,
    Places,
    Prints,
    finished,
    gather,
    in_16_bits,
    numbered,
    of_bytes,
    stirred,
)

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from edoras_tools.decode import Context
    from edoras_tools.ros import TypeStore
    from edoras_tools.ros.cdr.bulk import MessageColumns, Ragged
    from edoras_tools.structs import Structs


_OCTETS: Final = np.uint8, np.int8
_COOKED_BYTES: Final = {113: 12, 276: 18}
"""Bytes of a Linux cooked header up to the end of the sender's address; two of any value follow it."""


def of_tap(batch: PacketBatch, network: Integers, some: Places | slice) -> Prints:
    """Return a fingerprint (u64) of the bytes before some network headers: it shows where they were captured.

    Args:
        batch: datagrams.
        network: start of each network header of the batch.
        some: which datagrams.
    """
    frame, link_type = batch.frame_offset[some], batch.link_type[some]
    size = network[some] - frame
    for kind, length in _COOKED_BYTES.items():
        size = np.where(link_type == kind, length, size)
    return of_bytes(batch.data, frame, size)


def of_values(
    types: TypeStore, type_name: str, data: NDArray[np.uint8], offset: Integers, length: NDArray[np.int32]
) -> tuple[Prints, Prints]:
    """Return two fingerprints of each message, u64 (n,): without time stamps, and with them.

    A type without numbers uses its strings. A message that does not decode has fingerprint 0.

    Args:
        types: types of the mission.
        type_name: ROS type of all messages.
        data: u8, buffer that holds the messages.
        offset: i64 (n,), first byte of each CDR, including its encapsulation.
        length: i32 (n,), bytes of each CDR.
    """
    columns = types.columns(type_name, data, offset, length)
    plain, stamped = (np.zeros(len(columns), np.uint64) for _ in range(2))
    numbers = [name for name, column in columns.fields.items() if _elements(column).dtype != object]
    for name in numbers or columns.fields:
        part = _field(name, columns.fields[name])
        stamped += part
        if not name.endswith(("stamp.sec", "stamp.nanosec")):
            plain += part
    plain, stamped = finished(plain), finished(stamped)
    plain[~columns.valid], stamped[~columns.valid] = 0, 0
    return plain, stamped


def of_fields(columns: Mapping[str, NDArray[Any]]) -> Prints:
    """Return a fingerprint of each row of named number columns, u64 (n,); there is at least one column."""
    return finished(np.sum([_field(*item) for item in columns.items()], axis=0, dtype=np.uint64))


def latest_equal(into: Prints, into_ns: Integers, out: Prints, out_ns: Integers) -> Places:
    """Return for each of ``out`` the index of the latest equal, not later one of ``into``; -1 for none.

    Several of ``out`` may get the same index.
    """
    prints, order = _in_order(into, into_ns, out, out_ns)
    latest = np.maximum.accumulate(np.where(order < len(into), np.arange(len(order)), -1))
    goes = np.flatnonzero((order >= len(into)) & (latest >= 0))
    from_ = order[latest[goes]]
    same = (prints[order[goes]] == prints[from_]) & (prints[from_] != 0)
    origin = np.full(len(out), -1, np.intp)
    origin[order[goes[same]] - len(into)] = from_[same]
    return origin


def paired(into: Prints, into_ns: Integers, out: Prints, out_ns: Integers) -> Places:
    """Return the same as ``latest_equal``, but use each of ``into`` at most once."""
    prints, order = _in_order(into, into_ns, out, out_ns)
    opening, closing = brackets(prints[order], order < len(into))
    real = prints[order[opening]] != 0
    origin = np.full(len(out), -1, np.intp)
    origin[order[closing[real]] - len(into)] = order[opening[real]]
    return origin


def _in_order(into: Prints, into_ns: Integers, out: Prints, out_ns: Integers) -> tuple[Prints, Places]:
    """Return both arrays joined, and an order: by fingerprint, then by time, then ``into`` first."""
    prints = np.concatenate((into, out))
    by_time = np.argsort(np.concatenate((into_ns, out_ns)), kind="stable")
    return prints, by_time[np.argsort(in_16_bits(numbered(prints)[1])[by_time], kind="stable")]


def brackets(group: NDArray[Any], opens: Mask) -> tuple[Places, Places]:
    """Return pairs of brackets: indices of the opening ones, and of those that close them.

    A closing bracket closes the bracket of its group that was opened last, if one is open.

    Args:
        group: group of each bracket; equal groups stand together, in order.
        opens: bool, whether each bracket opens.
    """
    # Brackets of one level of a group are neighbours in this order, whatever is nested or never closed.
    level = np.cumsum(np.where(opens, 1, -1)) + ~opens
    number = np.cumsum(np.append(False, group[1:] != group[:-1])[: len(group)])
    order = np.lexsort((in_16_bits(level - level.min(initial=0)), in_16_bits(number)))
    before, behind = order[:-1], order[1:]
    closed = opens[before] & ~opens[behind]
    closed &= (number[before] == number[behind]) & (level[before] == level[behind])
    return before[closed], behind[closed]


def _elements(column: NDArray[Any] | Ragged) -> NDArray[Any]:
    return column if isinstance(column, np.ndarray) else column.values


def _field(name: str, column: NDArray[Any] | Ragged) -> Prints:
    """Return the summand of a field in each row's fingerprint, u64 (n,)."""
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
        # Equal values of any type hash alike: as bytes of the first narrow type that holds the whole row.
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
    """Return the summand of each range of bytes, u64 (n,); ranges of any length, by all their bytes."""
    data = np.append(data, np.zeros(HASHED_BYTES, np.uint8))
    total = np.zeros(len(offset), np.uint64)
    for block in range(0, int(length.max(initial=0)), HASHED_BYTES):
        part = of_bytes(data, offset + block, np.maximum(length - block, 0))
        total += np.where(part, stirred(part + key) * WEIGHTS[block // HASHED_BYTES % len(WEIGHTS)], 0)
    return total


def _bits(values: NDArray[Any]) -> Prints:
    if values.dtype == object:  # texts
        return np.array([crc32(text.encode("utf-8", "replace")) for text in values.tolist()], np.uint64)
    if values.dtype.kind == "f":
        with np.errstate(invalid="ignore"):  # an unset field may be NaN
            return (values.astype(np.float64) + 0.0).view(np.uint64)  # 0.0 and -0.0 are one value
    return values.astype(np.int64).view(np.uint64)


_TYPES: Final = {
    bare.ROBOT_COMMAND.size: "geometry_msgs/msg/Twist",
    bare.ROBOT_POSE.size: "geometry_msgs/msg/Pose",
}
"""Length of a datagram to a robot, in bytes, to the ROS type whose numbers it holds."""
_ENCAPSULATION: Final = 4


class SharedFields:
    """Computes fingerprints that a command and the robot struct made from it have in common.

    They use the numbers of equal name. Names are compared without case, dots and underscores: ``linear.x``
    equals ``Linear_X``. The command's numbers are rounded to the types of the struct. If several structs
    share different numbers with one type of command, only the first struct is matched.

    Args:
        context: mission with the types of commands, and the structs that are bound to ports.
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
        """Return a fingerprint of each command and each robot struct, u64 (n,); 0 for other datagrams.

        Args:
            batch: datagrams.
            columns: decoded columns of these.
            offset: i64 (n,), first byte of each message, including its encapsulation; -1 for none.
            length: i32 (n,), bytes of each message.
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
            rounded_values = {
                name: np.asarray(read.fields[name]).astype(own) for name, (_, own) in names.items()
            }
            prints[rows] = np.where(read.valid, of_fields(rounded_values), 0)
        return prints


def _by_name(columns: MessageColumns) -> dict[str, tuple[str, np.dtype[Any]]]:
    """Return plain name to (path, dtype) of each scalar number of a type."""
    return {
        re.sub("[^a-z0-9]", "", name.lower()): (name, column.dtype)
        for name, column in columns.fields.items()
        if isinstance(column, np.ndarray) and column.ndim == 1 and column.dtype.kind in "iuf"
    }


def robot_commands(columns: Columns, batch: PacketBatch, structs: Structs) -> Mask:
    """Return which datagrams are commands to a robot, bool (n,): on its link, but not states from it."""
    port = batch.destination_port
    state = (batch.length == bare.ROBOT_STATE.size) & (structs.of_port(port) == UDP_KEY)
    return np.asarray((columns.link == ROBOT) & (port != CFS_PORT) & ~state)


def with_garbled(columns: Columns, batch: PacketBatch) -> Columns:
    """Return columns in which all datagrams of a command's length to a robot belong to the robot link.

    The decoder recognises this link by plausible numbers, which unset or damaged datagrams do not have.
    """
    garbled = (batch.source_port == CFS_PORT) & (batch.destination_port == ROBOT_PORT)
    length = batch.length + np.maximum(batch.original_length - batch.frame_length, 0)
    garbled &= (columns.link == OTHER) & np.isin(length, list(_TYPES))
    link = np.where(garbled, np.uint8(ROBOT.code), columns.link)
    return replace(columns, link=link) if garbled.any() else columns


def robot_prints(batch: PacketBatch, rows: Places, types: TypeStore | None) -> tuple[Prints, Prints]:
    """Return two fingerprints of each command to a robot, u64 (rows,): of its bytes, and of its values.

    The first equals that of the command to cFS if its type is unknown, the second if its type is known.
    """
    length = batch.length[rows]
    bytes_ = of_bytes(batch.data, batch.offset[rows], length)
    values = np.zeros(len(rows), np.uint64)
    for size, name in _TYPES.items():
        own = np.flatnonzero(length == size)
        if not len(own) or types is None or not types.has(name):
            continue
        messages = np.zeros((len(own), _ENCAPSULATION + size), np.uint8)
        messages[:, 1] = 1  # little-endian
        messages[:, _ENCAPSULATION:] = gather(batch.data, batch.offset[rows[own]], size)
        data, step = np.append(messages, np.zeros(PADDING, np.uint8)), messages.shape[1]
        offset = np.arange(len(own), dtype=np.int64) * step
        values[own], _ = of_values(types, name, data, offset, np.full(len(own), step, np.int32))
    return bytes_, values

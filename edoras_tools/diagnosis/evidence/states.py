"""What a robot says of itself, and telemetry that carries it: how old that is when it leaves cFS.

A robot's state begins with the seven doubles of its pose. A message that a flight application makes of it
ends with the same bytes, so both are compared by a fingerprint of these.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from edoras_tools.diagnosis.evidence.fingerprint import latest_equal
from edoras_tools.links.table import among
from edoras_tools.wire import robot
from edoras_tools.wire.arrays.fingerprint import of_bytes
from edoras_tools.wire.arrays.order import by_value

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from edoras_tools.model import Columns, PacketBatch
    from edoras_tools.wire.arrays.order import Integers, Prints

_LEAST: Final = 3


class PassedStates(NamedTuple):
    """States of a robot that left cFS on one MsgId.

    Attributes:
        msg_id: the MsgId.
        number: i64, packet of each message.
        time_ns: i64, when it left cFS.
        age_ns: i64, how long before the robot had sent what it carries.
        sent_ns: i64, when the robot sent its states, all of them.
    """

    msg_id: int
    number: Integers
    time_ns: Integers
    age_ns: Integers
    sent_ns: Integers


class StateRecorder:
    """Keeps the states of robots, and of telemetry behind the first of them what may carry one."""

    def __init__(self) -> None:
        self._sent: list[tuple[Integers, Prints]] = []
        self._passed: list[tuple[Integers, ...]] = []

    def add_states(self, batch: PacketBatch) -> None:
        """Take datagrams without a packet; some may be states of a robot."""
        size = robot.ROBOT_STATE.size
        own = np.flatnonzero((batch.length == size) & (batch.destination_port == robot.CFS_PORT))
        if len(own):
            length = np.full(len(own), robot.ROBOT_POSE.size, np.int32)
            self._sent.append((batch.time_ns[own], of_bytes(batch.data, batch.offset[own], length)))

    def add_messages(
        self, batch: PacketBatch, columns: Columns, offset: Integers, length: NDArray[np.int32]
    ) -> None:
        """Take packets.

        Args:
            offset: i64, first byte of each message, -1 where there is none.
            length: i32, its bytes.
        """
        size = robot.ROBOT_POSE.size
        if not self._sent:
            return
        down = among(columns.link, lambda link: link.only_from_cfs)
        own = np.flatnonzero(down & (offset >= 0) & (length > size))
        prints = of_bytes(batch.data, offset[own] + length[own] - size, np.full(len(own), size, np.int32))
        msg_id = columns.msg_id[own].astype(np.int64)
        self._passed.append((msg_id, batch.number[own], batch.time_ns[own], prints.view(np.int64)))

    def passed(self) -> Iterator[PassedStates]:
        """Yield what left cFS on each MsgId that passes states on."""
        if not self._sent or not self._passed:
            return
        sent_ns, states = (np.concatenate(parts) for parts in zip(*self._sent, strict=True))
        columns = [np.concatenate(parts) for parts in zip(*self._passed, strict=True)]
        for msg_id, rows in by_value(columns[0]):
            number, time_ns, prints = (column[rows] for column in columns[1:])
            at = latest_equal(states, sent_ns, prints.view(np.uint64), time_ns)
            is_state = at >= 0
            is_state &= np.isin(np.arange(len(at)), np.unique(at, return_index=True)[1])  # each waits once
            if is_state.sum() >= _LEAST:
                age_ns = time_ns[is_state] - sent_ns[at[is_state]]
                yield PassedStates(msg_id, number[is_state], time_ns[is_state], age_ns, sent_ns)

"""Makes the messages of RACS2, in the form of its ROS side, and messages with the values in their bodies.

Rules that this file keeps:

1. ``racs2_msg/msg/RACS2UserMsg`` is the type that the public ROS side publishes on the topic that a header
   names, and that it takes from ``/RACS2Bridge`` to send to cFS.
2. If a body is a ``RACS2Bridge_std_msgs``, its values get topics of ours below ``/racs2``, each field with
   the type of ``std_msgs`` that the public ``.proto`` file names beside it.
3. Names come from the network: a name that is no valid ROS name, or that has another use, gets no topic, and
   there are at most ``MOST_TOPICS`` topics. Whole datagrams are recorded all the same.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from edoras_tools.addons.racs2 import link as racs2
from edoras_tools.addons.racs2.link import RACS2
from edoras_tools.errors import FieldError
from edoras_tools.io.topics.messages import RECORD, Messages, bodies_of, whole_messages
from edoras_tools.model import Columns, Finding, PacketBatch
from edoras_tools.wire import cfe
from edoras_tools.wire.arrays import Places, by_value, copy_rows, gather
from edoras_tools.wire.envelope import ENCAPSULATION

if TYPE_CHECKING:
    from collections.abc import Iterator

    from edoras_tools.links.doors import TopicSpace

MOST_TOPICS: Final = 256
TO_CFS_TOPIC: Final = "/RACS2Bridge"
"""The topic that the public ROS side subscribes to."""
USER_TYPE: Final = "racs2_msg/msg/RACS2UserMsg"
VALUES_PREFIX: Final = "/racs2"
_RESERVED: Final = ("/edoras/", "/cfs/", "/fprime/", f"{VALUES_PREFIX}/", "/tf/")
"""Beginnings of topic names that this package uses, and ``/tf``."""
_NAME: Final = re.compile(rb"/?(?!.*__)[A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*")
_CUT: Final = np.uint32(Finding.FRAGMENT | Finding.CAPTURE_CUT)
_USER: Final = np.dtype(
    [
        *RECORD,
        ("encapsulation", "<u4"),
        ("cfs_message_id", "<u4"),
        ("body_data_length", "<u4"),
        ("count", "<u4"),
    ]
)
"""``RACS2UserMsg`` as a record, up to the bytes of its body."""


class _Target(NamedTuple):
    """Where messages go, and the rows of these messages.

    Attributes:
        topic: topic of the messages themselves.
        values: prefix of the topics of their values.
        msg_id: MsgId in cFS; 0 for messages from cFS to ROS.
        rows: i64, rows of the batch.
    """

    topic: str
    values: str
    msg_id: int
    rows: Places


class BridgeTopics:
    """Makes messages of what the bridges send; see :class:`~edoras_tools.links.doors.OwnTopics`."""

    def __init__(self, space: TopicSpace) -> None:
        self._space, self._other_topics = space, space.used_names()
        self._known: set[str] = set()

    def offer(self) -> None:
        """Do nothing: the messages themselves name the topics."""

    def messages(self, batch: PacketBatch, columns: Columns) -> Iterator[Messages]:
        """Yield the messages of a batch; they hold no references to its data."""
        for target in _targets(batch, columns):
            if self._may_have(target.topic):
                yield _user_messages(target, batch, self._place(target.topic, USER_TYPE))
            for topic, type_name, values in _values(target, batch):
                if self._may_have(topic):
                    yield self._value_messages(type_name, values, batch, self._place(topic, type_name))

    def _place(self, topic: str, type_name: str) -> int:
        return self._space.place(topic, type_name, {"link": RACS2.label})

    def _may_have(self, topic: str) -> bool:
        """Return whether a topic is kept; there are at most ``MOST_TOPICS``, and none of another maker."""
        if topic not in self._known and topic not in self._other_topics and len(self._known) < MOST_TOPICS:
            self._known.add(topic)
        return topic in self._known

    def _value_messages(
        self, type_name: str, values: list[tuple[int, Any]], batch: PacketBatch, channel_id: int
    ) -> Messages:
        """Return a ``std_msgs`` message for each value; a value that the type cannot hold is left out."""
        bodies, rows = [], []
        for row, value in values:
            try:
                cdr = self._space.types.encode(type_name, {"data": value})
            except FieldError:  # a varint may be longer than its field
                continue
            bodies.append(cdr[ENCAPSULATION.size :])
            rows.append(row)
        where = np.array(rows, np.int64)
        return bodies_of(bodies, batch.time_ns[where].tolist(), channel_id, where)


def _targets(batch: PacketBatch, columns: Columns) -> Iterator[_Target]:
    """Yield the whole messages of a batch, by destination; messages without a valid ROS name are left out."""
    rows = np.flatnonzero((columns.link == RACS2) & (columns.findings & _CUT == 0))
    headers = gather(batch.data, batch.offset[rows], racs2.BRIDGE_HEADER)
    names, which = np.unique(headers.view(f"S{racs2.BRIDGE_HEADER}")[:, 0], return_inverse=True)
    for place, members in by_value(which):
        msg_id = int.from_bytes(headers[members[0], :2].tobytes(), "big")
        if msg_id <= cfe.HIGHEST_MSG_ID:
            yield _Target(TO_CFS_TOPIC, f"{VALUES_PREFIX}/msg_id_{msg_id:04x}", msg_id, rows[members])
            continue
        name = bytes(names[place]).partition(b"\0")[0]
        if _NAME.fullmatch(name):
            topic = f"/{name.decode().removeprefix('/')}"
            if topic != TO_CFS_TOPIC and not f"{topic}/".startswith(_RESERVED):
                yield _Target(topic, VALUES_PREFIX + topic, 0, rows[members])


def _user_messages(target: _Target, batch: PacketBatch, channel_id: int) -> Messages:
    """Return a ``RACS2UserMsg`` for each message; its length is that of the transferred body."""
    rows, log_time = target.rows, batch.time_ns[target.rows]
    size = batch.length[rows].astype(np.int64) - racs2.BRIDGE_HEADER
    start = np.cumsum(size) - size
    pool = np.empty(int(size.sum()), np.uint8)
    copy_rows(pool, start, batch.data, batch.offset[rows] + racs2.BRIDGE_HEADER, size)
    heads = np.zeros(len(rows), _USER)
    heads["cfs_message_id"], heads["body_data_length"] = target.msg_id, size
    heads["count"] = size
    return whole_messages(rows, heads, channel_id, 0, log_time, log_time, (pool, start, size))


def _values(target: _Target, batch: PacketBatch) -> Iterator[tuple[str, str, list[tuple[int, Any]]]]:
    """Yield the topic, the type, and the (row, value) pairs of each field in the bodies."""
    by_name: dict[str, list[tuple[int, Any]]] = {}
    for row in target.rows.tolist():
        start = int(batch.offset[row])
        body = batch.data[start + racs2.BRIDGE_HEADER : start + int(batch.length[row])].tobytes()
        for name, value in (racs2.std_msgs_values(body) or {}).items():
            by_name.setdefault(name, []).append((row, value))
    for name, values in by_name.items():
        yield f"{target.values}/{name}", f"std_msgs/msg/{racs2.BODY_FIELDS[name].type}", values

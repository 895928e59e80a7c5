"""Accounting: what was seen of each MsgId on each link, and what its sequence count says is missing.

A stream is one MsgId of one sender on one link. The count is followed over its 14 bits, through reordering,
repeats and restarts; a sequence word of zero is no count, and nothing is ever called lost for it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from edoras_tools.diagnosis.fingerprint import latest_equal
from edoras_tools.diagnosis.instances import NOBODY
from edoras_tools.model import NO_MSG_ID, NO_ROUTE, Finding, Link
from edoras_tools.sessions.profile import SECOND
from edoras_tools.wire.order import by_value

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from edoras_tools.diagnosis.instances import Instances
    from edoras_tools.diagnosis.table import Rows

_MODULUS: Final = 1 << 14
_REORDER: Final = 64
"""A count that steps back further is not late, it began anew."""
_PAUSE_NS: Final = 2 * SECOND
_PAUSE_FACTOR: Final = 4


@dataclass(slots=True)
class Stream:
    """One MsgId of one sender on one link.

    Attributes:
        link: the link.
        msg_id: cFE MsgId.
        sender: endpoint it came from.
        receiver: endpoint it went to.
        processor: SBN identity of the sender, spacecraft and processor; (0, 0) elsewhere.
        instance: index of the cFS that made it, ``NOBODY`` where unknown.
        route: index of its configured route, or ``NO_ROUTE``.
        rows: of the table, in order.
        counted: whether its sequence count counts.
        missing: i64 (rows,), counts that never came between a row and its next.
        pauses: bool (rows,), the next row came after a pause: what is missing may never have come this way.
        duplicates: rows that repeat one.
        reordered: rows that came late.
        restarts: times the count began anew.
    """

    link: Link
    msg_id: int
    sender: int
    receiver: int
    processor: tuple[int, int]
    instance: int
    route: int
    rows: NDArray[np.intp]
    counted: bool
    missing: NDArray[np.int64]
    pauses: NDArray[np.bool_]
    duplicates: int = 0
    reordered: int = 0
    restarts: int = 0

    @property
    def gaps(self) -> int:
        """Counts missing while the stream went on, late arrivals taken off."""
        return max(0, int(self.missing[~self.pauses].sum()) - self.reordered)

    def __len__(self) -> int:
        return len(self.rows)


def find_streams(rows: Rows, instances: Instances) -> list[Stream]:
    """Return every stream of a capture."""
    instance = _whole(rows, instances)
    packets = np.flatnonzero(rows.msg_id != NO_MSG_ID)
    link = rows.link[packets].astype(np.int64)
    # Whoever commands does not count, and may use any number of ports.
    sender = np.where(link == Link.CI, -1, rows.source[packets])
    receiver = np.where(link == Link.TO, -1, rows.destination[packets])
    keys = np.stack(
        (
            link,
            sender,
            receiver,
            rows.processor_id[packets].astype(np.int64),
            rows.spacecraft_id[packets].astype(np.int64),
            rows.msg_id[packets].astype(np.int64),
            np.where(link == Link.CI, NOBODY, instance[packets]),
        )
    )
    if not len(packets):
        return []
    _, which = np.unique(keys, axis=1, return_inverse=True)
    return [_stream(rows, packets[members], instance) for _, members in by_value(which.reshape(-1))]


def _whole(rows: Rows, instances: Instances) -> NDArray[np.int32]:
    """Give packets without a time of their own (wake-ups) the instance whose count they continue."""
    out = instances.of_row.copy()
    cases = ((Link.SBN, rows.processor_id.astype(np.int64)), (Link.TO, rows.source.astype(np.int64)))
    for link, sender in cases:
        bare = (rows.link == link) & (out == NOBODY) & (rows.msg_id != NO_MSG_ID)
        timed = (rows.link == link) & (instances.of_row != NOBODY)
        for who in np.unique(sender[bare]).tolist():
            mine = bare & (sender == who)
            for msg_id in np.unique(rows.msg_id[mine]).tolist():
                lost = np.flatnonzero(mine & (rows.msg_id == msg_id))
                same = timed & (sender == who)
                # Behind TO several instances share a MsgId; an SBN sender is one instance at a time.
                same &= (rows.msg_id == msg_id) if link == Link.TO else np.ones(len(rows), bool)
                known = np.flatnonzero(same)
                if link == Link.TO:
                    lost = _handed_on(rows, lost, instances.of_row, out)
                if len(known) and len(lost):
                    out[lost] = _nearest(rows, lost, known, instances.of_row, by_count=link == Link.TO)
    return out


def _handed_on(
    rows: Rows, lost: NDArray[np.intp], instance: NDArray[np.int32], out: NDArray[np.int32]
) -> NDArray[np.intp]:
    """Give packets from Telemetry Output the instance that sent the same ones over SBN; return the others."""
    network = np.flatnonzero((rows.link == Link.SBN) & np.isin(rows.msg_id, rows.msg_id[lost]))
    from_ = latest_equal(
        rows.packet_print[network], rows.time_ns[network], rows.packet_print[lost], rows.time_ns[lost]
    )
    same = from_ >= 0
    same[same] = rows.time_ns[lost[same]] - rows.time_ns[network[from_[same]]] < _PAUSE_NS
    out[lost[same]] = out[network[from_[same]]]
    left: NDArray[np.intp] = lost[~same & (instance[lost] == NOBODY)]
    return left


def _nearest(
    rows: Rows,
    lost: NDArray[np.intp],
    known: NDArray[np.intp],
    instance: NDArray[np.int32],
    *,
    by_count: bool,
) -> NDArray[np.int32]:
    best = np.full(len(lost), np.iinfo(np.int64).max)
    out = np.full(len(lost), NOBODY, np.int32)
    for index in np.unique(instance[known]).tolist():
        own = known[instance[known] == index]
        at = np.searchsorted(rows.time_ns[own], rows.time_ns[lost])
        for side in (np.maximum(at - 1, 0), np.minimum(at, len(own) - 1)):
            there = own[side]
            if by_count:
                step = rows.sequence_count[lost].astype(np.int64) - rows.sequence_count[there]
                away = np.abs((step + _MODULUS // 2) % _MODULUS - _MODULUS // 2)
            else:
                away = np.abs(rows.time_ns[lost] - rows.time_ns[there])
            closer = away < best
            best[closer], out[closer] = away[closer], index
    return out


def _stream(rows: Rows, members: NDArray[np.intp], instance: NDArray[np.int32]) -> Stream:
    first = int(members[0])
    routes = rows.route[members]
    known = routes[routes != NO_ROUTE]
    stream = Stream(
        link=Link(int(rows.link[first])),
        msg_id=int(rows.msg_id[first]),
        sender=int(rows.source[first]),
        receiver=int(rows.destination[first]),
        processor=(int(rows.spacecraft_id[first]), int(rows.processor_id[first])),
        instance=int(instance[first]) if rows.link[first] != Link.CI else NOBODY,
        route=int(known[0]) if len(known) else NO_ROUTE,
        rows=members,
        counted=False,
        missing=np.zeros(len(members), np.int64),
        pauses=_pauses(rows.time_ns[members]),
    )
    one_sender = stream.link is not Link.CI or len(np.unique(rows.source[members])) == 1
    set_ = ~rows.has(Finding.SEQUENCE_UNSET)[members]
    if one_sender and set_.sum() > 1:
        _follow(stream, rows, np.flatnonzero(set_))
    return stream


def _pauses(times: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Tell after which rows a stream paused: so long as it never does while it runs."""
    steps = np.diff(times)
    out = np.zeros(len(times), bool)
    if len(steps) > 2:
        usual = float(np.quantile(steps, 0.9))
        out[:-1] = steps > max(_PAUSE_NS, _PAUSE_FACTOR * usual)
    return out


def _follow(stream: Stream, rows: Rows, picked: NDArray[np.intp]) -> None:
    """Follow the count of those rows of a stream that have one."""
    members = stream.rows[picked]
    count = rows.sequence_count[members].astype(np.int64)
    step = (np.diff(count) + _MODULUS // 2) % _MODULUS - _MODULUS // 2
    if not step.any():
        return  # a constant is no count
    same = rows.packet_print[members]
    repeated = (step == 0) & (same[1:] == same[:-1])
    anew = (step < -_REORDER) | ((step == 0) & ~repeated)
    if anew.sum() * 4 > len(step):
        return  # steps back as often as not: several senders' counts, or no count
    stream.counted = True
    stream.restarts = int(anew.sum())
    stream.duplicates = int(repeated.sum())
    # Each run between restarts is moved clear above the last, so that one running maximum serves all.
    moved = np.where(anew, 0, step)
    position = np.concatenate(([0], np.cumsum(moved))) + np.concatenate(([0], np.cumsum(anew))) * (
        _MODULUS * (len(count) + 1)
    )
    highest = np.maximum.accumulate(position)
    ahead = position[1:] - highest[:-1] - 1
    ahead[anew] = 0
    stream.reordered = int(((position[1:] < highest[:-1]) & ~anew).sum())
    stream.missing[picked[:-1]] = np.maximum(ahead, 0)

"""The queues of cFS, sockets and pipes: which messages enter, which are lost, and when they leave.

A queue is filled when messages arrive and read at wake-ups. Its rules, for one message and for columns:

1. cFE checks the limit of the MsgId first, then the depth.
2. A message that arrives at the time of a wake-up is still read by it.
3. A wake-up reads the oldest messages first, and at most ``reads`` of them.

Messages that leave one queue arrive at the next: ``pass_queue`` is called again with their times.
"""

from __future__ import annotations

from collections.abc import Mapping
from enum import IntEnum
from typing import TYPE_CHECKING, Final, NamedTuple

import msgspec
import numpy as np
from msgspec.structs import replace

from edoras_tools.units import SECOND
from edoras_tools.wire.arrays import Integers, Mask, Octets, in_16_bits, numbered

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from edoras_tools.cfs.profile import SimProfile

NO_LIMIT: Final = 1 << 62


class QueueEnd(IntEnum):
    """The outcome of a message at one queue."""

    DELIVERED = 0
    WAITING = 1
    SUPERSEDED = 2
    MSG_LIMIT = 3
    PIPE_OVERFLOW = 4
    SOCKET_FULL = 5
    CLOSED = 6


def admission(waiting: int, limit: int, length: int, depth: int) -> QueueEnd:
    """Return whether a message may enter a queue: ``WAITING``, ``MSG_LIMIT`` or ``PIPE_OVERFLOW``.

    Args:
        waiting: number of messages of its MsgId in the queue.
        limit: most messages of its MsgId.
        length: number of messages in the queue.
        depth: most messages in the queue.
    """
    if waiting >= limit:
        return QueueEnd.MSG_LIMIT
    return QueueEnd.PIPE_OVERFLOW if length >= depth else QueueEnd.WAITING


class Queue(msgspec.Struct, frozen=True):
    """The constants of one queue.

    Attributes:
        round_ns: time between two wake-ups of its reader; 0 if each message is read at once.
        depth: most messages in the queue.
        usual_limit: most messages of one MsgId that may wait.
        limits: limit of each MsgId that has another one.
        reads: most messages that one wake-up reads.
        phase_ns: time of one of the wake-ups.
        is_socket: whether it is a socket, which has no MsgIds: ``SOCKET_FULL`` is then the loss.
        keeps_newest: whether a message over its limit replaces the oldest one of its MsgId.
    """

    round_ns: int
    depth: int
    usual_limit: int = NO_LIMIT
    limits: Mapping[int, int] = msgspec.field(default_factory=dict)
    reads: int = NO_LIMIT
    phase_ns: int = 0
    is_socket: bool = False
    keeps_newest: bool = False

    @property
    def full(self) -> QueueEnd:
        """The outcome of a message that arrives while the queue is full."""
        return QueueEnd.SOCKET_FULL if self.is_socket else QueueEnd.PIPE_OVERFLOW

    def limit(self, msg_id: int) -> int:
        """Return the number of messages of a MsgId that may wait."""
        return self.limits.get(msg_id, self.usual_limit)

    def with_limit(self, msg_id: int, limit: int | None) -> Queue:
        """Return the queue with another limit for a MsgId, or unchanged if ``limit`` is None."""
        return self if limit is None else replace(self, limits={**self.limits, msg_id: limit})

    def rate_hz(self, count: int) -> float:
        """Return the rate in Hz of ``count`` messages a round."""
        return count * SECOND / self.round_ns

    def wakes(self, first_ns: int, last_ns: int) -> Integers:
        """Return the times of the wake-ups, ns: from ``first_ns`` to the first one not before ``last_ns``."""
        first, last = (-((self.phase_ns - item) // self.round_ns) for item in (first_ns, last_ns))
        return np.arange(first, last + 1, dtype=np.int64) * self.round_ns + self.phase_ns


def ci_socket(profile: SimProfile) -> Queue:
    """Return the queue before Command Ingest."""
    return Queue(
        profile.ci_wake_ns, profile.socket_queue, reads=profile.ci_datagrams_per_wake, is_socket=True
    )


def application_pipe(profile: SimProfile, *, over_network: bool = False) -> Queue:
    """Return an application's pipe, by the rounds of its sender: the application reads it after each burst.

    Args:
        over_network: whether SBN fills it, at each of its wake-ups if it polls; else Command Ingest.
    """
    period_ns = profile.sbn_wake_ns if over_network else profile.ci_wake_ns
    return Queue(period_ns, profile.app_pipe_depth, profile.app_msg_limit)


def telemetry_pipe(profile: SimProfile) -> Queue:
    """Return Telemetry Output's pipe."""
    return Queue(profile.to_wake_ns, profile.to_pipe_depth, profile.to_default_limit, profile.to_limits)


def peer_pipe(profile: SimProfile) -> Queue:
    """Return the pipe of an SBN peer."""
    return Queue(profile.sbn_wake_ns, profile.sbn_pipe_depth, profile.sbn_msg_limit)


class Passage(NamedTuple):
    """The outcomes of the messages that arrived at one queue; one element for each.

    Attributes:
        time_ns: time of arrival, i64.
        outcome: a ``QueueEnd``, u8.
        left_ns: time of the wake-up that read it, i64; -1 for a message that was not read.
        superseded_ns: time at which a newer one replaced it, i64; -1 if none did.
    """

    time_ns: Integers
    outcome: Octets
    left_ns: Integers
    superseded_ns: Integers

    @property
    def delivered(self) -> Integers:
        """Indices of the messages that were read, in the order in which they left for the next queue."""
        rows = np.flatnonzero(self.outcome == QueueEnd.DELIVERED)
        return rows[np.argsort(self.left_ns[rows], kind="stable")]

    def depth(self, at_ns: Integers) -> Integers:
        """Return the number of waiting messages at some times, after the arrivals and wake-ups then."""
        entered = self.time_ns[self.outcome <= QueueEnd.SUPERSEDED]
        exit_ns = np.where(self.outcome == QueueEnd.SUPERSEDED, self.superseded_ns, self.left_ns)
        exit_ns = np.sort(exit_ns[exit_ns >= 0])
        return np.searchsorted(entered, at_ns, side="right") - np.searchsorted(exit_ns, at_ns, side="right")


def pass_queue(
    queue: Queue, time_ns: Integers, msg_id: NDArray[np.integer], wakes_ns: Integers | None = None
) -> Passage:
    """Return the outcomes of messages at a queue that is empty at first.

    Args:
        time_ns: times of arrival, (n,), ns, in order.
        msg_id: MsgIds, to which the limits apply, (n,).
        wakes_ns: times at which the queue is read, in order, if they are known; by default its rounds, until
            it is empty.

    Returns:
        Elements in the order of the arrivals. ``WAITING`` messages are never read.
    """
    count = len(time_ns)
    reads = max(1, min(queue.reads, count))
    if wakes_ns is None and queue.round_ns and count:
        rounds = -(-min(count, queue.depth) // reads)
        wakes_ns = queue.wakes(int(time_ns[0]), int(time_ns[-1]) + rounds * queue.round_ns)
    wake = np.arange(count) if wakes_ns is None else np.searchsorted(wakes_ns, time_ns)
    wakes_ns = time_ns if wakes_ns is None else wakes_ns
    first_of, kind = numbered(msg_id)
    limit = np.array([queue.limit(int(item)) for item in msg_id[first_of]], np.int64)[kind]
    messages = _Messages(queue, time_ns, kind, limit, np.full(count, -1, np.int64))
    outcome = np.full(count, QueueEnd.WAITING, np.uint8)
    left_ns = np.full(count, -1, np.int64)

    first = np.flatnonzero(np.diff(wake, prepend=-1))
    rounds_at, arrivals = wake[first], np.diff(first, append=count)
    ahead = _ahead(rounds_at, arrivals, reads, queue.depth)
    is_free = limit.min(initial=NO_LIMIT) > queue.depth  # only the depth counts, so ``ahead`` is exact
    at_once = is_free | ((ahead == 0) & (arrivals <= reads))
    rows = np.flatnonzero(np.repeat(at_once, arrivals))
    place = (np.repeat(ahead - first, arrivals) + np.arange(count))[rows]
    fits = np.where(place < queue.depth, QueueEnd.WAITING, queue.full)
    outcome[rows] = fits if is_free else messages.enter(rows, wake[rows])
    leaves_at = wake[rows] + place // reads
    leaves = (outcome[rows] == QueueEnd.WAITING) & (leaves_at < len(wakes_ns))
    left_ns[rows[leaves]] = wakes_ns[leaves_at[leaves]]

    waiting, next_wake = np.zeros(0, np.int64), 0
    for number in np.flatnonzero(~at_once):
        at, start = int(rounds_at[number]), int(first[number])
        waiting = _read(waiting, left_ns, wakes_ns[next_wake:at], reads)
        rows = np.concatenate((waiting, np.arange(start, start + arrivals[number])))
        outcome[rows] = messages.enter(rows)
        waiting, next_wake = rows[outcome[rows] == QueueEnd.WAITING], at
    _read(waiting, left_ns, wakes_ns[next_wake:], reads)
    outcome[left_ns >= 0] = QueueEnd.DELIVERED
    return Passage(time_ns, outcome, left_ns, messages.superseded_ns)


def _ahead(rounds_at: Integers, arrivals: Integers, reads: int, depth: int) -> Integers:
    """Return the most messages that wait before the arrivals of each round; exact if no limit applies.

    Args:
        rounds_at: numbers of the rounds in which messages arrive.
        arrivals: number of messages that arrive.
    """
    read = reads * np.diff(rounds_at, prepend=0)
    grown = np.cumsum(np.append(0, arrivals)[:-1] - read)
    ahead = grown - np.minimum.accumulate(grown)
    if not (ahead[1:].astype(bool) & (ahead + arrivals > depth)[:-1]).any():
        return ahead
    exact, waiting = [], 0
    for leaving, arriving in zip(read.tolist(), arrivals.tolist(), strict=True):
        exact.append(max(0, waiting - leaving))
        waiting = min(depth, exact[-1] + arriving)
    return np.array(exact, np.int64)


def _read(waiting: Integers, left_ns: Integers, wakes_ns: Integers, reads: int) -> Integers:
    """Set the times at which messages leave at some wake-ups, and return those that stay."""
    leaving = waiting[: reads * len(wakes_ns)]
    left_ns[leaving] = wakes_ns[np.arange(len(leaving)) // reads]
    return waiting[len(leaving) :]


class _Messages(NamedTuple):
    """The messages of one call, with the rules for entering.

    Attributes:
        queue: constants of the queue.
        time_ns: time of arrival, (n,).
        kind: number of the MsgId, (n,).
        limit: limit of the MsgId, (n,).
        superseded_ns: time of replacement, (n,), set by ``enter``.
    """

    queue: Queue
    time_ns: Integers
    kind: Integers
    limit: Integers
    superseded_ns: Integers

    def enter(self, rows: Integers, batch: Integers | None = None) -> Octets:
        """Return the outcome of messages that arrive, in order, between two wake-ups.

        The result is the same as that of ``admission`` for one after another. Nothing leaves in between, so
        the first messages of a MsgId up to its limit may enter until the queue is full; from then on none
        enters.

        Args:
            rows: indices of the messages; those that wait from before come first.
            batch: number of the interval between wake-ups, (rows,), ascending; the queue is empty before
                each.
                None: all are in the same interval.
        """
        limit, group = self.limit[rows], self.kind[rows]
        if batch is not None:
            group = group + (group.max(initial=0) + 1) * np.cumsum(np.diff(batch, prepend=batch[:1]) != 0)
        below = _rank(group) < limit
        ahead = np.cumsum(below) - below if batch is None else _rank(batch, below)
        entered = below & (ahead < self.queue.depth)
        inside = np.bincount(group, entered)[group] if len(rows) else limit
        over = ~entered & (inside >= limit)
        lost = np.where(over, QueueEnd.MSG_LIMIT, self.queue.full)
        outcome = np.where(entered, QueueEnd.WAITING, lost).astype(np.uint8)
        if self.queue.keeps_newest and over.any():
            self._supersede(rows, group, entered | (over & (limit > 0)), outcome)
        return outcome

    def _supersede(self, rows: Integers, group: Integers, enters: Mask, outcome: Octets) -> None:
        """Keep the newest messages of each MsgId; each older one is superseded by its replacement."""
        order = np.flatnonzero(enters)
        order = order[np.argsort(group[order], kind="stable")]
        later = np.arange(len(order)) + np.minimum(self.limit[rows[order]], len(order))
        older = later < len(order)
        older[older] = group[order[later[older]]] == group[order[older]]
        outcome[order] = QueueEnd.WAITING
        outcome[order[older]] = QueueEnd.SUPERSEDED
        self.superseded_ns[rows[order[older]]] = self.time_ns[rows[order[later[older]]]]


def _rank(group: Integers, among: Mask | None = None) -> Integers:
    """Return the number of earlier elements in the same group for each one; only those ``among`` count."""
    order = np.argsort(in_16_bits(group), kind="stable")
    ones = np.ones(len(group), np.int64) if among is None else among[order].astype(np.int64)
    before = np.cumsum(ones) - ones
    ordered = group[order]
    first = np.append(True, ordered[1:] != ordered[:-1])[: len(group)]
    rank = np.empty(len(group), np.int64)
    rank[order] = before - np.maximum.accumulate(np.where(first, before, 0))
    return rank

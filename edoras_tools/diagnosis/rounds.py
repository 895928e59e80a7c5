"""The rounds in which a queue is read: when each message came, with which wake-up it left, what waited.

Rules:

1. Wake-ups are seen where messages come out in bursts: those of Command Ingest at the robot, those of
   Telemetry Output and of SBN on their links. Bursts that do not fit the round of that task show none.
2. A message that came out left with the wake-up whose burst it is in. One that did not come out would have
   left with the next wake-up behind it.
3. What waited in front of a message are those of its MsgId that left with the same wake-up.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, Literal

import numpy as np

from edoras_tools.cfs import queues, telemetry_output
from edoras_tools.diagnosis.advice import published_at, told_limit

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from edoras_tools.diagnosis.case import Case
    from edoras_tools.diagnosis.matching.streams import Stream

ConstantFrom = Literal["measured", "assumed"]
"""Whether a constant is the capture's, or of the lab applications'; what somebody told counts as measured."""
_NEAR: Final = 0.1
"""A round may be so much longer or shorter than its task's."""


@dataclass(frozen=True, slots=True)
class Rounds:
    """The messages of a stream in the rounds of the queue that they pass; an element for each message.

    Attributes:
        stream: the stream.
        queue: what reads it, as people are told.
        pipe: where the messages wait.
        time_ns: i64 (n,), when each was sent or published.
        row: i64 (n,), its place in the stream; of one that never came, the place of the one before.
        behind: i64 (n,), 0 of a message that was seen, else the how-manyth it is behind that one.
        out: bool (n,), it came out.
        visible: whether it can be seen which came out.
        wakes_ns: i64 (m,), the wake-ups that are seen.
        wake: i64 (n,), with which of these it left, or would have; -1 and m where none is seen.
        round_ns: time between two of them.
        round_from: what tells that.
        limit: how many messages of this MsgId may wait.
        limit_from: what tells that.
    """

    stream: Stream
    queue: str
    pipe: str
    time_ns: NDArray[np.int64]
    row: NDArray[np.int64]
    behind: NDArray[np.int64]
    out: NDArray[np.bool_]
    visible: bool
    wakes_ns: NDArray[np.int64]
    wake: NDArray[np.int64]
    round_ns: int
    round_from: ConstantFrom
    limit: int
    limit_from: ConstantFrom

    def __len__(self) -> int:
        return len(self.time_ns)

    def place(self, row: int, behind: int = 0) -> int:
        """Return the place of a message by its row and how far behind that it is."""
        return int(np.flatnonzero((self.row == row) & (self.behind == behind))[0])

    def waiting(self, place: int) -> int | None:
        """Return how many of its MsgId waited when a message came; None where no wake-up of it is seen."""
        if not 0 <= self.wake[place] < len(self.wakes_ns):
            return None
        return int((self.out[:place] & (self.wake[:place] == self.wake[place])).sum())

    def depth(self) -> NDArray[np.int64]:
        """Return how many wait once each message came, itself where it got in; i64 (n,)."""
        order = np.argsort(self.wake, kind="stable")
        wake, inside = self.wake[order], np.cumsum(self.out[order], dtype=np.int64)
        depth = np.empty_like(inside)
        depth[order] = inside - np.append(0, inside)[np.searchsorted(wake, wake)]
        return depth

    def as_json(self) -> dict[str, Any]:
        """Return it in the shape of ``trace --json``; of each message its time, wake-up and what waited."""
        columns = zip(*(item.tolist() for item in (self.time_ns, self.wake, self.out)), strict=True)
        return {
            "queue": self.queue,
            "pipe": self.pipe,
            "round_ns": self.round_ns,
            "round_from": self.round_from,
            "limit": self.limit,
            "limit_from": self.limit_from,
            "rounds": [
                {"out": out, "of": of, "count": many} for (out, of), many in self.sizes().most_common()
            ],
            "wakes_ns": self.wakes_ns.tolist(),
            "messages": [
                {"time_ns": when, "wake": wake if 0 <= wake < len(self.wakes_ns) else None, "out": out}
                for when, wake, out in columns
            ],
        }

    def sizes(self) -> Counter[tuple[int, int]]:
        """Return how many rounds there are of each kind: messages that came out, of how many."""
        inside = (self.wake >= 0) & (self.wake < len(self.wakes_ns))
        came = np.bincount(self.wake[inside], minlength=1)
        out = np.bincount(self.wake[inside], weights=self.out[inside], minlength=1).astype(np.int64)
        return Counter((through, of) for through, of in zip(out.tolist(), came.tolist(), strict=True) if of)


@dataclass(frozen=True, slots=True)
class Timing:
    """The messages of a topic in the rounds of their queue.

    Attributes:
        topic: topic, name or MsgId.
        link: label of the link on which they are seen.
        msg_id: their cFE MsgId.
        rounds: the messages and the wake-ups.
        endings: what became of those that did not come out: how many, and how; of the ledger.
    """

    topic: str
    link: str
    msg_id: int
    rounds: Rounds
    endings: tuple[tuple[int, str], ...]

    @property
    def lost(self) -> int:
        """How many did not come out."""
        return int((~self.rounds.out).sum()) if self.rounds.visible else 0

    def as_json(self) -> dict[str, Any]:
        """Return it in the shape of ``trace --json``."""
        return {
            "topic": self.topic,
            "link": self.link,
            "msg_id": f"0x{self.msg_id:04x}",
            "endings": [{"number": number, "text": text} for number, text in self.endings],
            **self.rounds.as_json(),
        }


def rounds_into(case: Case, stream: Stream) -> Rounds:
    """Return the rounds of Command Ingest in which a stream into cFS is read."""
    profile, times = case.profile, case.rows.time_ns[stream.rows]
    alike = [
        hop
        for hop in case.hops
        if hop.out.link.last_hop and hop.into.link is stream.link and hop.into.receiver == stream.receiver
    ]
    over_network = not stream.link.only_to_cfs
    out = np.zeros(len(stream), bool)
    left_ns = np.zeros(len(stream), np.int64)
    for hop in case.hops:
        if hop.into is stream:
            out[hop.in_rows] = True
            if hop.out.link.last_hop:
                left_ns[hop.in_rows] = case.rows.time_ns[hop.out.rows[hop.out_rows]]
    bursts = [case.rows.time_ns[hop.out.rows[hop.out_rows]] for hop in alike]
    wakes = _wakes(bursts, profile.ci_wake_ns) if not over_network else times[:0]
    pipe = queues.application_pipe(profile, over_network=over_network)
    wake = np.searchsorted(wakes, times)
    wake = np.where(left_ns > 0, np.searchsorted(wakes, left_ns, side="right") - 1, wake)
    learned = case.constants.learned
    return Rounds(
        stream,
        "SBN" if over_network else "CI",
        "the application's pipe",
        times,
        np.arange(len(stream)),
        np.zeros(len(stream), np.int64),
        out,
        bool(out.any()),
        wakes,
        wake if len(wakes) else np.full(len(stream), -1),
        _period(wakes, pipe.round_ns),
        "measured" if len(wakes) else "assumed",
        pipe.usual_limit,
        "measured" if "app_msg_limit" in learned else "assumed",
    )


def rounds_out(case: Case, stream: Stream) -> Rounds:
    """Return the rounds of Telemetry Output, or of an SBN peer's pipe, in which a stream comes out."""
    rows, output = case.rows, stream.link.only_from_cfs
    queue = queues.telemetry_pipe(case.profile) if output else queues.peer_pipe(case.profile)
    alike = (rows.link == stream.link) & (rows.source == stream.sender)
    if not output:
        alike &= rows.destination == stream.receiver
    captured = rows.time_ns[stream.rows]
    wakes = _wakes([rows.time_ns[alike]], queue.round_ns)
    counts = stream.counts
    row = np.repeat(np.arange(len(stream)), counts)
    behind = np.arange(len(row)) - np.repeat(np.cumsum(counts) - counts, counts)
    times, out = published_at(case, stream), behind == 0
    departure = np.searchsorted(wakes, captured, side="right") - 1
    # What never came would have left between the one before and the one behind.
    after = np.append(departure[1:], departure[-1:])[row]
    wake = np.where(out, departure[row], np.clip(np.searchsorted(wakes, times), departure[row], after))
    command = told_limit(case, stream)
    limit = command if command is not None else queue.limit(stream.msg_id)
    is_told = command is not None or stream.msg_id in case.constants.learned
    return Rounds(
        stream,
        telemetry_output.NAME if output else "SBN",
        case.known.hop(stream),
        times,
        row,
        behind,
        out,
        True,
        wakes,
        wake if len(wakes) else np.full(len(row), -1),
        _period(wakes, queue.round_ns),
        "measured" if len(wakes) else "assumed",
        limit,
        "measured" if is_told else "assumed",
    )


def _wakes(bursts: Sequence[NDArray[np.int64]], round_ns: int) -> NDArray[np.int64]:
    """Return when bursts begin that come in such rounds; none where they do not."""
    times = np.sort(np.concatenate([np.zeros(0, np.int64), *bursts]))
    begins = times[np.diff(times, prepend=times[:1] - round_ns) > round_ns // 4]
    steps = np.diff(begins) / round_ns
    fits = np.abs(steps - np.round(steps)) < _NEAR
    return begins if len(steps) and fits.mean() > 0.5 else begins[:0]


def _period(wakes: NDArray[np.int64], round_ns: int) -> int:
    """Return the usual time between two wake-ups that follow each other."""
    steps = np.diff(wakes)
    steps = steps[np.abs(steps - round_ns) < _NEAR * round_ns]
    return int(np.median(steps)) if len(steps) else round_ns

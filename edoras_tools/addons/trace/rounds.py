"""The rounds in which a queue is read: arrival of each message, its wake-up, and the messages in front of it.

Rules:

1. Wake-ups are visible if messages come out in bursts: those of Command Ingest at the robot, those of
   Telemetry Output and of SBN on their links. Bursts that do not fit the task's round show no wake-ups.
2. A message that came out left with the wake-up of its burst. One that did not come out would have left with
   the next wake-up behind it.
3. The messages that waited in front of a message are those of its MsgId that left with the same wake-up.
4. The rate of a topic at a hop is the publisher's rate times the share of its messages that came out there:
   so the bursts of a queue do not affect it. If nothing shows the messages that came out, there is no rate.
"""

from __future__ import annotations

from collections import Counter
from functools import cached_property
from typing import TYPE_CHECKING, Any, Final, Literal

import msgspec
import numpy as np
from msgspec.structs import asdict

from edoras_tools.cfs import queues, telemetry_output
from edoras_tools.diagnosis.accounting.losses import BUS, COUNTERS, Among
from edoras_tools.diagnosis.advice import published_at
from edoras_tools.diagnosis.ledger import APPLICATION, LedgerEntry, LedgerWay
from edoras_tools.model import rate_hz
from edoras_tools.units import SECOND

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from edoras_tools.diagnosis.case import Case
    from edoras_tools.diagnosis.matching.streams import Stream


ConstantFrom = Literal["measured", "assumed"]
"""Origin of a constant: measured (in the capture, or given by the user), or assumed (stock cFS)."""
_NEAR: Final = 0.1
"""Largest relative difference between an observed round and that of its task."""


class Rounds(msgspec.Struct, frozen=True, dict=True):
    """The messages of a stream in the rounds of their queue; arrays with one element for each message.

    Attributes:
        stream: stream.
        queue: name of the reader for people.
        pipe: name of the place where the messages wait.
        time_ns: i64 (n,), time of sending or publishing, ns since 1970.
        row: i64 (n,), row in the stream; for a missing message, the row in front of it.
        behind: i64 (n,), 0 for a captured message, else its position behind that row, from 1.
        out: bool (n,), whether it came out.
        visible: whether the capture shows which messages came out.
        wakes_ns: i64 (m,), times of the visible wake-ups, ns since 1970.
        wake: i64 (n,), index of the wake-up with which it left, or would have; -1 or m if that is not
            visible.
        task_ns: time between two wake-ups by the task's constants, ns.
        limit: number of messages of this MsgId that may wait.
        limit_from: origin of the limit.
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
    task_ns: int
    limit: int
    limit_from: ConstantFrom

    def __len__(self) -> int:
        return len(self.time_ns)

    @property
    def round_from(self) -> ConstantFrom:
        """Origin of the time between two wake-ups."""
        return "measured" if len(self.wakes_ns) else "assumed"

    @cached_property
    def round_ns(self) -> int:
        """Usual time between two successive wake-ups, ns."""
        steps = np.diff(self.wakes_ns)
        steps = steps[np.abs(steps - self.task_ns) < _NEAR * self.task_ns]
        return int(np.median(steps)) if len(steps) else self.task_ns

    def place(self, row: int, behind: int = 0) -> int:
        """Return the index of a message by its row and its position behind that row."""
        return int(np.flatnonzero((self.row == row) & (self.behind == behind))[0])

    def waiting(self, place: int) -> int | None:
        """Return how many of its MsgId waited when a message came; None without a visible wake-up."""
        if not 0 <= self.wake[place] < len(self.wakes_ns):
            return None
        return int((self.out[:place] & (self.wake[:place] == self.wake[place])).sum())

    def depth(self) -> NDArray[np.int64]:
        """Return the number of waiting messages after each message came, itself if it got in; i64 (n,)."""
        order = np.argsort(self.wake, kind="stable")
        wake, inside = self.wake[order], np.cumsum(self.out[order], dtype=np.int64)
        depth = np.empty_like(inside)
        depth[order] = inside - np.append(0, inside)[np.searchsorted(wake, wake)]
        return depth

    def as_json(self) -> dict[str, Any]:
        """Return the rounds in the shape of ``trace --json``, with time and wake-up of each message."""
        columns = zip(*(item.tolist() for item in (self.time_ns, self.wake, self.out)), strict=True)
        names = ("queue", "pipe", "round_ns", "round_from", "limit", "limit_from")
        return {
            **{name: getattr(self, name) for name in names},
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
        """Return the number of rounds by (messages that came out, all messages)."""
        inside = (self.wake >= 0) & (self.wake < len(self.wakes_ns))
        came = np.bincount(self.wake[inside], minlength=1)
        out = np.bincount(self.wake[inside], weights=self.out[inside], minlength=1).astype(np.int64)
        return Counter((through, of) for through, of in zip(out.tolist(), came.tolist(), strict=True) if of)


class Timing(msgspec.Struct, frozen=True):
    """The messages of a topic in the rounds of their queue.

    Attributes:
        topic: topic, name or MsgId.
        link: label of the link on which they are captured.
        msg_id: cFE MsgId.
        rounds: messages and wake-ups.
        endings: endings of the messages that did not come out, from the ledger: number and text.
    """

    topic: str
    link: str
    msg_id: int
    rounds: Rounds
    endings: tuple[tuple[int, str], ...]

    @property
    def lost(self) -> int:
        """Number of messages that did not come out."""
        return int((~self.rounds.out).sum()) if self.rounds.visible else 0

    def as_json(self) -> dict[str, Any]:
        """Return the timing in the shape of ``trace --json``."""
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
    over_network = not stream.link.only_to_cfs
    out, left_ns, bursts = np.zeros(len(stream), bool), np.zeros(len(stream), np.int64), [times[:0]]
    for hop in case.hops:
        came_ns = case.rows.time_ns[hop.out.rows[hop.out_rows]]
        if hop.into is stream:
            out[hop.in_rows] = True
        if hop.into is stream and hop.out.link.last_hop:
            left_ns[hop.in_rows] = came_ns
        if hop.out.link.last_hop and hop.into.link is stream.link and hop.into.receiver == stream.receiver:
            bursts.append(came_ns)
    wakes = times[:0] if over_network else _wakes(np.sort(np.concatenate(bursts)), profile.ci_wake_ns)
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
        pipe.round_ns,
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
    wakes = _wakes(np.sort(rows.time_ns[alike]), queue.round_ns)
    counts = stream.counts
    row = np.repeat(np.arange(len(stream)), counts)
    behind = np.arange(len(row)) - np.repeat(np.cumsum(counts) - counts, counts)
    times, out = published_at(case, stream), behind == 0
    departure = np.searchsorted(wakes, captured, side="right") - 1
    # A missing message would have left between the one before and the one behind.
    after = np.append(departure[1:], departure[-1:])[row]
    wake = np.where(out, departure[row], np.clip(np.searchsorted(wakes, times), departure[row], after))
    command = case.commanded_limit(stream)
    limit = command if command is not None else queue.limit(stream.msg_id)
    is_told = command is not None or stream.msg_id in case.constants.learned
    return Rounds(
        stream,
        telemetry_output.NAME if output else "SBN",
        case.pipe_of(stream),
        times,
        row,
        behind,
        out,
        True,
        wakes,
        wake if len(wakes) else np.full(len(row), -1),
        queue.round_ns,
        limit,
        "measured" if is_told else "assumed",
    )


def _wakes(times: NDArray[np.int64], round_ns: int) -> NDArray[np.int64]:
    """Return the begins of bursts that come in such rounds, ns since 1970; empty if they do not."""
    begins = times[np.diff(times, prepend=times[:1] - round_ns) > round_ns // 4]
    steps = np.diff(begins) / round_ns
    fits = np.abs(steps - np.round(steps)) < _NEAR
    return begins if len(steps) and fits.mean() > 0.5 else begins[:0]


USUAL_WINDOW: Final = 10_000
"""Number of messages of a rate, as in ``ros2 topic hz``."""
_LEAST: Final = 3
"""Least number of counter readings for a rate."""
_BACKLOG_S: Final = 2.0
"""Least time of traffic that waits in a backlog, s: counters are read once a second."""
_GONE: Final = frozenset({"lost", "unaccounted"})


class HopRate(msgspec.Struct, frozen=True):
    """The rate at one hop.

    Attributes:
        hop: name of the place.
        rate_hz: messages per second; None if nothing shows them.
        count: messages of the window that came out there.
        exact: whether this is known of each message, not only of all messages of the capture together.
        least_s: shortest time between two, s; None if their times are not captured.
        greatest_s: longest time between two, s.
        deviation_s: standard deviation of that time, s.
    """

    hop: str
    rate_hz: float | None
    count: int | None
    exact: bool = True
    least_s: float | None = None
    greatest_s: float | None = None
    deviation_s: float | None = None


class TopicRates(msgspec.Struct, frozen=True):
    """The rates of one topic.

    Attributes:
        topic: name of the topic as requested.
        link: label of the link on which it is first captured.
        msg_id: cFE MsgId there.
        window: number of messages that the rates are of.
        hops: rates in order of the way.
    """

    topic: str
    link: str
    msg_id: int
    window: int
    hops: tuple[HopRate, ...]

    def as_json(self) -> dict[str, Any]:
        """Return the rates in the shape of ``hz --json``."""
        hops = [asdict(item) for item in self.hops]
        return {**asdict(self), "msg_id": f"0x{self.msg_id:04x}", "hops": hops}


def topic_rates(case: Case, stream: Stream, topic: str, window: int) -> TopicRates:
    """Return the rates of the last messages of a stream.

    Args:
        topic: name for people.
        window: maximum number of messages.
    """
    fate = case.commands.fates.get(stream)
    rounds = rounds_out(case, stream) if fate is None else rounds_into(case, stream)
    first = max(0, len(rounds) - window)
    times, out = rounds.time_ns[first:], rounds.out[first:]
    base = rate_hz(len(times), int(times[-1] - times[0]))
    hops = [HopRate(APPLICATION if fate is None else "publisher", base, len(times), True, *_steps(times))]
    way = case.ledger.way(stream)
    hops += _inner(way, first, len(times), base)
    if fate is not None and not rounds.visible:
        rate = _by_counters(case, stream, way, times)
        into = base if hops[-1].rate_hz is None else hops[-1].rate_hz
        hops.append(HopRate(APPLICATION, None if rate is None else into - rate, None, False))
    elif fate is not None:
        # Messages that may still come out are left out of the rate.
        waits = np.flatnonzero(fate.waits[first:])
        until = int(waits[0]) if len(waits) and waits[0] else len(out)
        rate, count = base * int(out[:until].sum()) / until, int(out.sum())
        hops.append(HopRate(APPLICATION, rate, count, True, *_steps(_outs(case, stream, first))))
    else:
        captured = case.rows.time_ns[stream.rows[rounds.row[first:][out]]]
        hops.append(HopRate("capture", base * float(out.mean()), int(out.sum()), True, *_steps(captured)))
    return TopicRates(topic, stream.link.label, stream.msg_id, len(times), tuple(hops))


def _steps(times: NDArray[np.int64]) -> tuple[float, float, float] | tuple[()]:
    """Return the shortest and the longest time between two, and the standard deviation, s."""
    steps = np.diff(times) / SECOND
    return (float(steps.min()), float(steps.max()), float(steps.std())) if len(steps) else ()


def _inner(way: LedgerWay, first: int, size: int, base: float) -> list[HopRate]:
    """Return the rates at the hops between the first and the last, by the ledger."""
    hops, share, exact = [], 1.0, True
    for row in way.rows()[:-1]:
        if row.hop in {BUS, APPLICATION}:
            break  # the losses of the bus and the application follow from the messages that come out
        entries = [item for item in way.entries() if item.hop == row.hop and item.ending in _GONE]
        number, sure = (row.proven, True) if not first else _within(entries, first, size / row.came)
        late = row.waiting + row.uncertain
        if is_behind := late > _BACKLOG_S * base:
            number, late = number + round(late * size / row.came), 0
        # Messages without a count yet are left out of the rate, unless more and more of them wait.
        passed = (row.came if not first else size) - late - row.not_captured
        share, exact = share * (1 - number / max(passed, number, 1)), exact and sure and not is_behind
        figures = (base * share, round(size * share), exact) if row.observed else (None, None)
        hops.append(HopRate(row.hop, *figures))
    return hops


def _by_counters(case: Case, stream: Stream, way: LedgerWay, times: NDArray[np.int64]) -> float | None:
    """Return the loss rate of an application's pipe by 0x803, Hz; None if other messages may share it."""
    row = next((item for item in way.rows() if item.hop == BUS), None)
    tracks = [track for at, track in case.tracks.items() if case.goes_to(stream, at)]
    if row is None or not row.observed or len(tracks) != 1:
        return None
    totals = np.sum([tracks[0].totals[name] for name in COUNTERS.values()], axis=0)
    read = np.array(tracks[0].times)
    inside = np.flatnonzero((read >= times[0] + SECOND) & (read <= times[-1] + SECOND))
    if len(inside) < _LEAST or row.all_lost != totals[-1] - totals[0]:
        return None
    first, last = inside[0], inside[-1]
    return float((totals[last] - totals[first]) / (read[last] - read[first]) * SECOND)


def _within(entries: list[LedgerEntry], first: int, share: float) -> tuple[int, bool]:
    """Return the number of some entries' messages in the window, and whether it is certain.

    Args:
        first: first row of the window.
        share: share of the window in all messages, for entries whose messages are not identified.
    """
    number, exact = 0, True
    for entry in entries:
        among = entry.among
        if isinstance(among, Among) and among.missing is None and len(among.rows) == entry.number:
            number += int((among.rows >= first).sum())
        else:
            number, exact = number + round(entry.number * share), False
    return number, exact


def _outs(case: Case, stream: Stream, first: int) -> NDArray[np.int64]:
    """Return the times when the messages of the window came out of cFS."""
    hops = [hop for hop in case.hops if hop.into is stream]
    parts = [case.rows.time_ns[hop.out.rows[hop.out_rows[hop.in_rows >= first]]] for hop in hops]
    return np.sort(np.concatenate([np.zeros(0, np.int64), *parts]))

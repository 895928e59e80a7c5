"""How often the messages of a topic came to each hop: a view of the ledger and of the matched streams.

The rate of a hop is the publisher's times the share of its messages that came out there: bursts, in which a
queue is read, do not change it. Where nothing shows what came out, there is none.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from edoras_tools.diagnosis.accounting.losses import COUNTERS, Among
from edoras_tools.diagnosis.ledger import APPLICATION, BUS, MessageLedger
from edoras_tools.diagnosis.rounds import rounds_into, rounds_out
from edoras_tools.units import SECOND

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from edoras_tools.diagnosis.case import Case
    from edoras_tools.diagnosis.ledger import LedgerEntry, LedgerWay
    from edoras_tools.diagnosis.matching.streams import Stream

USUAL_WINDOW: Final = 10_000
"""Messages that a rate is of, as in ``ros2 topic hz``."""
_LEAST: Final = 3
"""Readings of a counter that make a rate."""
_GONE: Final = frozenset({"lost", "unaccounted"})


@dataclass(frozen=True, slots=True)
class HopRate:
    """The rate at one hop.

    Attributes:
        hop: the place.
        rate_hz: messages a second; None where nothing shows them.
        count: messages of the window that came out there.
        exact: whether that is known of each, not only of all in the capture.
        least_s: shortest time between two; None where their times are not seen.
        greatest_s: longest.
        deviation_s: standard deviation.
    """

    hop: str
    rate_hz: float | None
    count: int | None
    exact: bool = True
    least_s: float | None = None
    greatest_s: float | None = None
    deviation_s: float | None = None

    def rate_or(self, other: float) -> float:
        """Return the rate, or another one where there is none."""
        return other if self.rate_hz is None else self.rate_hz


@dataclass(frozen=True, slots=True)
class TopicRates:
    """The rates of one topic.

    Attributes:
        topic: what it was asked for by.
        link: label of the link on which it is first seen.
        msg_id: its cFE MsgId there.
        window: messages that they are of.
        hops: in the order of the way.
    """

    topic: str
    link: str
    msg_id: int
    window: int
    hops: tuple[HopRate, ...]

    def as_json(self) -> dict[str, Any]:
        """Return it in the shape of ``hz --json``."""
        hops = [asdict(hop) for hop in self.hops]
        return {"topic": self.topic, "link": self.link, "msg_id": f"0x{self.msg_id:04x}"} | {
            "window": self.window,
            "hops": hops,
        }


def topic_rates(case: Case, stream: Stream, topic: str, window: int) -> TopicRates:
    """Return the rates of the last messages of a stream.

    Args:
        topic: what people call it.
        window: how many messages.
    """
    fate = case.commands.fates.get(id(stream))
    rounds = rounds_out(case, stream) if fate is None else rounds_into(case, stream)
    first = max(0, len(rounds) - window)
    times, out = rounds.time_ns[first:], rounds.out[first:]
    seconds = float(times[-1] - times[0]) / SECOND
    base = (len(times) - 1) / seconds if seconds > 0 else 0.0
    hops = [HopRate(APPLICATION if fate is None else "publisher", base, len(times), True, *_steps(times))]
    way = MessageLedger(case).way(stream)
    hops += _inner(way, first, len(times), base)
    if fate is not None and not rounds.visible:
        rate = _by_counters(case, stream, way, times)
        hops.append(
            HopRate(APPLICATION, None if rate is None else hops[-1].rate_or(base) - rate, None, False)
        )
    elif fate is not None:
        # What may yet come out says nothing of the rate.
        waits = np.flatnonzero(fate.waits[first:])
        until = int(waits[0]) if len(waits) and waits[0] else len(out)
        rate, count = base * int(out[:until].sum()) / until, int(out.sum())
        hops.append(HopRate(APPLICATION, rate, count, True, *_steps(_outs(case, stream, first))))
    else:
        captured = case.rows.time_ns[stream.rows[rounds.row[first:][out]]]
        rate = base * int(out.sum()) / len(out)
        hops.append(HopRate("capture", rate, int(out.sum()), True, *_steps(captured)))
    return TopicRates(topic, stream.link.label, stream.msg_id, len(times), tuple(hops))


def _steps(times: NDArray[np.int64]) -> tuple[float, float, float] | tuple[()]:
    """Return the shortest and the longest time between two, and their deviation, s."""
    steps = np.diff(times) / SECOND
    return (float(steps.min()), float(steps.max()), float(steps.std())) if len(steps) else ()


def _inner(way: LedgerWay, first: int, size: int, base: float) -> list[HopRate]:
    """Return the hops between the first and the last, by the ledger."""
    hops, share, exact = [], 1.0, True
    for row in way.rows()[:-1]:
        if row.hop in {BUS, APPLICATION}:
            break  # what the bus and the application lose is told by what comes out
        entries = [item for item in way.entries() if item.hop == row.hop and item.ending in _GONE]
        number, sure = (row.proven, True) if not first else _within(entries, first, size / row.came)
        # What no count has yet says nothing of the rate.
        counted = (row.came if not first else size) - (row.waiting + row.not_captured + row.uncertain)
        share, exact = share * (1 - number / max(counted, number, 1)), exact and sure
        hops.append(HopRate(row.hop, base * share, round(size * share), exact))
        if not row.observed:
            hops[-1] = HopRate(row.hop, None, None)
    return hops


def _by_counters(case: Case, stream: Stream, way: LedgerWay, times: NDArray[np.int64]) -> float | None:
    """Return how many a second the pipe of an application loses, by 0x803; None where others may share it."""
    row = next((item for item in way.rows() if item.hop == BUS), None)
    tracks = [track for at, track in case.tracks.items() if case.known.goes_to(stream, at)]
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
    """Return how many of some entries' messages are in the window, and whether that is sure.

    Args:
        first: the first row of the window.
        share: of all messages, as far as nothing tells which they are.
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
    """Return when the messages of the window came out of cFS."""
    hops = [hop for hop in case.hops if hop.into is stream]
    parts = [case.rows.time_ns[hop.out.rows[hop.out_rows[hop.in_rows >= first]]] for hop in hops]
    return np.sort(np.concatenate([np.zeros(0, np.int64), *parts]))

"""Who doubled a datagram that is there twice at one place: the network, or the capture.

Its receiver gets twice what the network doubled, and once what the capture did. So, in this order:

1. Between two of its counts CI read as many as were sent with the second ones, or as many as without them.
   What was under way at either count makes a range: only where one of both is outside of it, it tells.
2. What an application made of a command comes out as often as it got it. Values that were sent once tell.
3. What is told of one way holds for the others: a capture doubles all, and a network that is known to has
   not been helped.
4. Else two with one time are the capture's: no interface gets two at once.
5. Else nothing tells. They are left out, and of what went to cFS it is uncertain whether that came twice.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from edoras_tools.links.table import among
from edoras_tools.units import MILLISECOND
from edoras_tools.wire.arrays.order import by_value

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

    from edoras_tools.diagnosis.evidence.copies import Copies
    from edoras_tools.diagnosis.evidence.payloads import Samples
    from edoras_tools.diagnosis.evidence.table import Rows
    from edoras_tools.model import Endpoint

BY_CAPTURE: Final = 1
BY_NETWORK: Final = 2
_READ_NS: Final = 2500 * MILLISECOND
"""A count is seen within so long of what it counts."""


def who_doubled(
    rows: Rows,
    copies: Copies,
    samples: Samples,
    sources: NDArray[np.int32],
    endpoints: Sequence[Endpoint],
) -> NDArray[np.int8]:
    """Return who doubled each row: i8, ``BY_CAPTURE`` or ``BY_NETWORK``; 0 where nothing tells, or none did.

    Args:
        copies: of these rows.
        samples: the counts of CI.
        sources: who sent each of them, as an index of ``endpoints``.
    """
    out = np.zeros(len(rows), np.int8)
    to_cfs = among(rows.link, lambda link: link.to_cfs and link.packets)
    kept = ~copies.copy
    answers = np.flatnonzero(kept & ~copies.duplicate & among(rows.link, lambda link: link.from_cfs))
    votes: dict[int, int] = {}
    for receiver in np.unique(rows.destination[copies.duplicate & to_cfs]).tolist():
        mine = np.flatnonzero(kept & to_cfs & (rows.destination == receiver))
        own = copies.duplicate[mine]
        vote = 0
        for counted in _tracks(rows, receiver, samples, sources, endpoints):
            vote += _by_counts(rows.time_ns[mine], own, *counted)
        votes[receiver] = vote or _by_answers(rows, mine, own, answers)
    whole = sum(votes.values())
    for receiver, members in by_value(np.where(copies.duplicate, rows.destination, -1)):
        if receiver >= 0 and (vote := votes.get(receiver, 0) or whole):
            out[members] = BY_NETWORK if vote > 0 else BY_CAPTURE
    out[copies.duplicate & (out == 0) & copies.at_once] = BY_CAPTURE
    return out


def _tracks(
    rows: Rows,
    receiver: int,
    samples: Samples,
    sources: NDArray[np.int32],
    endpoints: Sequence[Endpoint],
) -> Iterator[tuple[NDArray[np.int64], NDArray[np.int64]]]:
    """Yield times and counts of each CI that may be a receiver: those at its address."""
    address = endpoints[receiver].address
    if not among(rows.link[rows.destination == receiver], lambda link: link.only_to_cfs).all():
        return
    for source, members in by_value(sources):
        if endpoints[source].address == address:
            yield samples["time_ns"][members], (samples["packets"] + samples["errors"])[members]


def _by_counts(
    sent_ns: NDArray[np.int64],
    again: NDArray[np.bool_],
    seen_ns: NDArray[np.int64],
    total: NDArray[np.int64],
) -> int:
    """Return how many of those that were there twice CI read twice, less those that it read once.

    Args:
        sent_ns: when each datagram was sent, in order.
        again: which were there before.
        seen_ns: when each count was.
        total: the counts.
    """
    vote, step = 0, 1
    early, late = (np.searchsorted(sent_ns, seen_ns - slack) for slack in (_READ_NS, 0))
    twice = np.concatenate(([0], np.cumsum(again)))
    while step < len(seen_ns):
        first, last = np.arange(0, len(seen_ns) - step, step), np.arange(step, len(seen_ns), step)
        counted = total[last] - total[first]
        least, most = (early[last], late[first]), (late[last], early[first])
        fits = [
            (counted >= np.maximum(low, 0)) & (counted <= high)
            for low, high in (
                tuple(end - begin - less * (twice[end] - twice[begin]) for end, begin in (least, most))
                for less in (0, 1)
            )
        ]
        number = twice[late[last]] - twice[late[first]]
        vote += int(number[fits[0] & ~fits[1]].sum()) - int(number[fits[1] & ~fits[0]].sum())
        step *= 2
    return vote


def _by_answers(
    rows: Rows, mine: NDArray[np.intp], again: NDArray[np.bool_], answers: NDArray[np.intp]
) -> int:
    """Return of how many that were there twice two came out, less those of which one did.

    Args:
        mine: datagrams that went in.
        again: which of these were there before.
        answers: what came out, each once.
    """
    values, came = np.unique(rows.body_print[mine], return_counts=True)
    doubled = np.isin(values, rows.body_print[mine[again]])
    went = np.sort(rows.body_print[answers])
    number = np.searchsorted(went, values, "right") - np.searchsorted(went, values)
    alone = number[(came == 1) & ~doubled & (number > 0) & (values != 0)]
    usual = int(np.median(alone)) if len(alone) else 0  # it may leave on several ways
    told = number[(came == 2) & doubled & (values != 0)]
    return int((told == 2 * usual).sum()) - int((told == usual).sum()) if usual else 0

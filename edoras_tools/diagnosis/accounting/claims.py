"""The growth of the software bus's loss counters, second by second, and who claims it.

A count belongs to the second between two samples of the counter, and to one message. Who has the least to
choose from chooses first, so that as many as possible are explained: in kinds or in time, whichever explains
more.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import groupby
from typing import TYPE_CHECKING, Any

import numpy as np

from edoras_tools.diagnosis.accounting.losses import COUNTERS, TAIL_NS, PipeKind

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from numpy.typing import NDArray

    from edoras_tools.diagnosis.evidence.loss_reports import Track


@dataclass(slots=True)
class Counts:
    """The growth of one instance's loss counters, second by second, less what was told of it.

    Attributes:
        times: i64 (n + 1,), of the samples.
        left: kind to i64 (n,), counts between two samples that nothing has taken.
    """

    times: NDArray[np.int64]
    left: dict[PipeKind, NDArray[np.int64]]

    @classmethod
    def of(cls, track: Track) -> Counts:
        """Lay out a track."""
        return cls(
            np.array(track.times, np.int64),
            {kind: _steps(track.totals[name]) for kind, name in COUNTERS.items()},
        )

    @classmethod
    def together(cls, parts: Sequence[Counts]) -> Counts:
        """Lay out the counts of several instances on one line of time, each at the sample that told of it."""
        times = np.unique(np.concatenate([part.times for part in parts]))
        found = cls(times, {kind: np.zeros(len(times) - 1, np.int64) for kind in COUNTERS})
        for part in parts:
            at = found.seconds(part.times[1:])
            for kind, left in found.left.items():
                np.add.at(left, at, part.left[kind])
        return found

    def divided(self, parts: Sequence[Counts]) -> dict[PipeKind, list[int]]:
        """Take from the parts what was taken of them together; return how much that is of each."""
        taken: dict[PipeKind, list[int]] = {}
        for kind, left in self.left.items():
            rest = left.copy()
            for part in parts:
                at = self.seconds(part.times[1:])
                kept = np.minimum(part.left[kind], rest[at])
                np.subtract.at(rest, at, kept)
                taken.setdefault(kind, []).append(int((part.left[kind] - kept).sum()))
                part.left[kind] = kept
        return taken

    def seconds(self, times: NDArray[np.int64]) -> NDArray[np.intp]:
        """Return which of the seconds each time is in: -1 before the first sample, n behind the last."""
        return np.asarray(np.searchsorted(self.times, times) - 1)

    def often(self, first: NDArray[np.intp], last: NDArray[np.intp]) -> NDArray[np.bool_]:
        """Tell of which runs of seconds no two samples lie far apart: what is counted then was sent then."""
        rare = np.concatenate(([0], np.cumsum(np.diff(self.times) > TAIL_NS)))
        low, high = np.clip(first, 0, len(rare) - 1), np.clip(last + 1, 0, len(rare) - 1)
        return np.asarray(rare[low] == rare[high])

    def take(self, kinds: Sequence[PipeKind], first: int, last: int, most: int) -> dict[PipeKind, int]:
        """Take up to so many counts out of some seconds, the earliest first."""
        low, high = max(first, 0), min(last + 1, len(self.times) - 1)
        if low >= high or most <= 0 or not kinds:
            return {}
        window = np.stack([self.left[kind][low:high] for kind in kinds], axis=1)
        flat = window.reshape(-1)
        part = np.minimum(flat, np.maximum(0, most - (np.cumsum(flat) - flat))).reshape(window.shape)
        for column, kind in enumerate(kinds):
            self.left[kind][low:high] -= part[:, column]
        return dict(zip(kinds, part.sum(axis=0).tolist(), strict=True))


@dataclass(slots=True)
class Claim:
    """Messages that are missing, and may be what a counter counted.

    Attributes:
        key: whose: what is taken is told by it.
        first: the first second in which they can have been counted.
        last: the last.
        number: how many.
        kinds: as which, the likelier first.
        taken: kind to how many were.
    """

    key: int
    first: int
    last: int
    number: int
    kinds: Sequence[PipeKind]
    taken: dict[PipeKind, int] = field(default_factory=dict)

    @property
    def overflowed(self) -> bool:
        """Whether some of it was counted as a full pipe's."""
        return self.taken.get("overflow", 0) > 0


def _steps(totals: list[int]) -> NDArray[np.int64]:
    values = np.array(totals, np.int64)
    return np.asarray(values[1:] - values[:-1])


def settle(counts: Counts, claims: Sequence[Claim]) -> None:
    """Give claims what was counted: who has the least to choose from first (rule 4).

    That is who can be counted as the fewest kinds, or who has the earliest end: what explains more is taken.
    """
    grew = {kind for kind, left in counts.left.items() if left.any()}
    for claim in claims:
        claim.kinds = [kind for kind in claim.kinds if kind in grew]

    def by_kinds(claim: Claim) -> tuple[Any, ...]:
        return len(claim.kinds), claim.last, claim.first, tuple(claim.kinds)

    def by_end(claim: Claim) -> tuple[Any, ...]:
        return claim.last, len(claim.kinds), claim.first, tuple(claim.kinds)

    tried = [_given(counts, sorted(claims, key=order), order) for order in (by_kinds, by_end)]
    counts.left, given = max(tried, key=lambda each: sum(number for _, _, number in each[1]))
    for claim, kind, number in given:
        claim.taken[kind] = number


def _given(
    counts: Counts, claims: Sequence[Claim], order: Callable[[Claim], Any]
) -> tuple[dict[PipeKind, NDArray[np.int64]], list[tuple[Claim, PipeKind, int]]]:
    """Return what is left of counts where claims in this order take theirs, and what each is given."""
    work = Counts(counts.times, {kind: left.copy() for kind, left in counts.left.items()})
    given: list[tuple[Claim, PipeKind, int]] = []
    for _, together in groupby(claims, key=order):
        members = list(together)
        left = [claim.number for claim in members]
        one = members[0]
        for kind, number in work.take(one.kinds, one.first, one.last, sum(left)).items():
            for at, share in enumerate(shares(number, left, left)):
                given.append((members[at], kind, share))
                left[at] -= share
    return work.left, given


def shares(number: int, weights: Sequence[float], most: Sequence[int]) -> list[int]:
    """Divide a number by weights into whole parts, none above its most; what does not fit is left."""
    out, left = [0] * len(weights), number
    while left > 0:
        free = [at for at in range(len(out)) if out[at] < most[at] and weights[at] > 0]
        if not free:
            break
        total = sum(weights[at] for at in free)
        exact = [left * weights[at] / total for at in free]
        parts = [min(int(value), most[at] - out[at]) for value, at in zip(exact, free, strict=True)]
        if not any(parts):
            best = max(zip(free, exact, strict=True), key=lambda each: each[1] % 1)[0]
            parts = [int(at == best) for at in free]
        for at, part in zip(free, parts, strict=True):
            out[at] += part
        left = number - sum(out)
    return out


def grouped(
    key: NDArray[np.intp], first: NDArray[np.intp], last: NDArray[np.intp], number: NDArray[np.int64]
) -> Iterator[tuple[int, int, int, int]]:
    """Yield (key, first, last, sum of numbers) of rows that share the first three."""
    if not len(key):
        return
    rows, which = np.unique(np.stack((key, first, last)), axis=1, return_inverse=True)
    sums = np.bincount(which.reshape(-1), weights=number)
    for (one, low, high), total in zip(rows.T.tolist(), sums.tolist(), strict=True):
        yield one, low, high, int(total)

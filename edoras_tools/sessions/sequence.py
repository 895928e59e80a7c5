"""Following a packet sequence count: what is missing, repeated or late, and who is whose.

One stream may carry the packets of several senders that count each for themselves, as Telemetry Output does
with what another processor sends through it. Their counts interleave; read as one they would look like a gap
at every packet. So a stream is followed as strands: a packet belongs to the strand that it continues.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

MODULUS: Final = 1 << 14
"""CCSDS 133.0-B 4.1.3.4.3: the packet sequence count has 14 bits."""
FORWARD: Final = MODULUS // 2
"""A step of half the range or more is a step back: reordering, or a count begun anew."""
_MOST_STRANDS: Final = 8


@dataclass(slots=True, eq=False)
class _Strand:
    """One sender's count.

    Attributes:
        last: the count it is at.
        before: the count before its last jump.
        jumped: counts that this jump left out; 0 where there was none, or it was told from another sender.
        lone: begun by a step back, and not continued yet: perhaps only a late packet.
    """

    last: int
    before: int = 0
    jumped: int = 0
    lone: bool = False


class SequenceTracker:
    """Follows one stream of sequence counts.

    Attributes:
        gaps: counts that never came.
        duplicates: packets that came twice.
        reordered: packets that came late.
        moved: whether any count ever went on: where none does, the sender does not count.
    """

    def __init__(self) -> None:
        self.gaps = 0
        self.duplicates = 0
        self.reordered = 0
        self.moved = False
        self._strands: list[_Strand] = []

    def follow(self, first: int, last: int) -> None:
        """Take a run of packets whose counts go up by one.

        Args:
            first: count of the first, 0 to 16383.
            last: count of the last; ``first`` for a single packet.
        """
        strand = self._continued(first) or self._repeated(first) or self._late(first) or self._jumped(first)
        # The strand that moved last comes first: it is the one that a run goes on with.
        self._strands.remove(strand)
        self._strands.insert(0, strand)
        if first != last:
            self._continue(strand)
        strand.last = last

    def _continue(self, strand: _Strand) -> _Strand:
        self.moved = True
        self.reordered -= strand.lone
        strand.lone = False
        return strand

    def _continued(self, first: int) -> _Strand | None:
        for strand in self._strands:
            if (strand.last + 1) % MODULUS == first:
                return self._continue(strand)
        return None

    def _repeated(self, first: int) -> _Strand | None:
        for strand in self._strands:
            if strand.last == first:
                self.duplicates += 1
                return strand
        return None

    def _late(self, first: int) -> _Strand | None:
        """Tell a packet out of what was taken for a gap: it came late, or the jump was another sender's."""
        for strand in self._strands:
            if 0 < (since := (first - strand.before) % MODULUS) <= strand.jumped:
                self.gaps += since - 1 - strand.jumped
                strand.jumped = 0
                return self._begin(lone=True)
        return None

    def _jumped(self, first: int) -> _Strand:
        steps = [((first - strand.last) % MODULUS, strand) for strand in self._strands]
        step, strand = min(steps, key=lambda item: item[0], default=(MODULUS, None))
        if strand is None or step >= FORWARD:
            return self._begin(lone=bool(steps))
        self.moved = True
        strand.before, strand.jumped = strand.last, step - 1
        self.gaps += strand.jumped
        return strand

    def _begin(self, *, lone: bool) -> _Strand:
        self.reordered += lone
        self.moved |= bool(self._strands)
        strand = _Strand(0, lone=lone)
        self._strands = [strand, *self._strands[: _MOST_STRANDS - 1]]
        return strand


def runs(counts: NDArray[np.uint16], begins: NDArray[np.integer]) -> Iterator[tuple[int, int, int, int]]:
    """Yield the runs of counts that go up by one: what ``SequenceTracker.follow`` takes.

    Args:
        counts: u16 (n,), of at least one packet; those of one stream side by side, in the order they came.
        begins: where each stream begins, increasing, 0 first.

    Yields:
        the stream's place in ``begins``, the run's first packet, and its first and last count.
    """
    counts = counts.astype(np.int64)
    breaks = np.diff(counts) & (MODULUS - 1) != 1
    breaks[begins[1:] - 1] = True
    firsts = np.append(0, np.flatnonzero(breaks) + 1)
    lasts = np.append(firsts[1:], len(counts)) - 1
    owners = np.searchsorted(begins, firsts, side="right") - 1
    yield from zip(
        owners.tolist(), firsts.tolist(), counts[firsts].tolist(), counts[lasts].tolist(), strict=True
    )

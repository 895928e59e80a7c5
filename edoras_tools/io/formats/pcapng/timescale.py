"""pcapng timestamps to nanoseconds (draft-ietf-opsawg-pcapng section 4.2: if_tsresol, if_tsoffset)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

_NS = 1_000_000_000


@dataclass(frozen=True, slots=True)
class TimeScale:
    """The unit and offset of an interface's timestamps.

    Attributes:
        exponent: a tick is ``base ** -exponent`` seconds; 0 to 127.
        base: 10 or 2.
        offset_s: seconds to add.
    """

    exponent: int = 6
    base: int = 10
    offset_s: int = 0

    @property
    def resolution_ns(self) -> int:
        """A tick in ns; 1 if it is shorter."""
        return max(1, _NS // int(self.base**self.exponent))

    def to_ns(self, ticks: NDArray[np.uint64]) -> NDArray[np.int64]:
        """Convert ticks to ns since 1970-01-01 UTC, rounded down; times past the year 2262 wrap."""
        if self.base == 10:
            if self.exponent <= 9:
                nanoseconds = ticks * np.uint64(10 ** (9 - self.exponent))
            elif self.exponent <= 28:
                nanoseconds = ticks // np.uint64(10 ** (self.exponent - 9))
            else:
                nanoseconds = np.zeros_like(ticks)
        else:
            nanoseconds = _from_binary(ticks, self.exponent)
        return nanoseconds.astype(np.int64) + np.int64(self.offset_s * _NS)


def _from_binary(ticks: NDArray[np.uint64], exponent: int) -> NDArray[np.uint64]:
    """Return the floor of ``ticks * 10**9 / 2**exponent``, computed in two halves to stay within 64 bits."""
    if exponent >= 64:
        # Above 64 bits there are no whole seconds, and shifting the ticks changes the result by less than 1
        # ns.
        ticks = ticks >> np.uint64(min(exponent - 63, 63))
        exponent = 63
    shift = np.uint64(exponent)
    fraction = ticks & np.uint64((1 << exponent) - 1)
    low, high = fraction & np.uint64(0xFFFFFFFF), fraction >> np.uint64(32)
    if exponent <= 32:
        part = fraction * np.uint64(_NS) >> shift
    else:
        part = (high * np.uint64(_NS) + (low * np.uint64(_NS) >> np.uint64(32))) >> np.uint64(exponent - 32)
    return (ticks >> shift) * np.uint64(_NS) + part

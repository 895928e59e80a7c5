"""Hashes of many byte ranges at once: equal bytes have equal hashes, different bytes almost never do."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import numpy as np

from edoras_tools.wire.arrays.order import Integers, Octets, Places, by_value
from edoras_tools.wire.arrays.window import gather

if TYPE_CHECKING:
    from numpy.typing import NDArray

HASHED_BYTES: Final = 4096
"""Bytes of a packet that are hashed; longer packets differ within these bytes."""
_BLOCK: Final = 2048
"""Rows that are handled together: few enough to stay in the second-level cache."""
MIX: Final = np.uint64(0x9E3779B97F4A7C15)
"""An odd number without a pattern: multiplying by it spreads the bits of a word over the product."""


def of_bytes(data: Octets, offset: Integers, length: NDArray[Any]) -> NDArray[np.uint64]:
    """Return the fingerprint of each range of bytes, u64 (n,); 0 for an empty one."""
    out = np.zeros(len(offset), np.uint64)
    cut = np.minimum(length, HASHED_BYTES)
    sizes = ((size, rows) for size, rows in by_value((cut + 7) >> 3) if size > 0)
    for size, own, at in ((size, rows, at) for size, rows in sizes for at in range(0, len(rows), _BLOCK)):
        some = slice(at, at + _BLOCK)
        rows = some if len(own) == len(out) else own[some]
        words = gather(data, offset[rows], size * 8).view(np.uint64)
        words[:, -1] &= _LAST_WORD.take(cut[rows] & 7)
        # Folded first: a factor alone would let the highest bits of two words cancel each other.
        words ^= words >> np.uint64(32)
        out[rows] = finished(words @ WEIGHTS[:size] + length[rows].astype(np.uint64) * MIX)
    return out


def stirred(words: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Mix each word so that every bit depends on many bits of the input; different words stay different."""
    mixed = (words ^ (words >> np.uint64(29))) * MIX
    return np.asarray(mixed ^ (mixed >> np.uint64(32)), np.uint64)


def finished(total: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Return fingerprints from sums of mixed words times ``WEIGHTS``; never 0."""
    return stirred(total) | np.uint64(1)


WEIGHTS: Final = stirred(np.arange(1, HASHED_BYTES // 8 + 2, dtype=np.uint64) * MIX) | np.uint64(1)
"""An odd factor for each word of a range."""
_LAST_WORD: Final = np.array([[0xFF] * (size or 8) + [0] * (-size % 8) for size in range(8)], np.uint8).view(
    np.uint64
)[:, 0]
"""Masks for the last word of a range, by its size modulo 8."""


def matches(first: NDArray[np.uint64], second: NDArray[np.uint64]) -> tuple[Places, Places]:
    """Return the indices of keys that occur exactly once in each array, and are not 0."""
    sides = []
    for keys in (first, second):
        values, at, count = np.unique(keys, return_index=True, return_counts=True)
        once = (count == 1) & (values != 0)
        sides.append((values[once], at[once]))
    _, ours, theirs = np.intersect1d(sides[0][0], sides[1][0], assume_unique=True, return_indices=True)
    return sides[0][1][ours], sides[1][1][theirs]

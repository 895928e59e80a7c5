"""Repeatable random numbers: the n-th follows from the seed and n alone.

A function of a counter (the finaliser of SplitMix64), not a sequential generator: the result for a datagram
does not depend on its time or its neighbours, and a batch is decided at once.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

_MASK: Final = (1 << 64) - 1
_GOLDEN: Final = 0x9E3779B97F4A7C15
_FIRST: Final = 0xBF58476D1CE4E5B9
_SECOND: Final = 0x94D049BB133111EB


def key_of(*parts: object) -> int:
    """Return a 64-bit key of one sequence of random numbers, from what identifies it."""
    from hashlib import blake2b

    return int.from_bytes(blake2b("|".join(map(str, parts)).encode(), digest_size=8).digest(), "little")


def draw(key: int, number: int, salt: int = 0) -> int:
    """Return 64 bits that look random.

    Args:
        key: key of the sequence.
        number: place in the sequence, from 0.
        salt: number that distinguishes several draws for one place.
    """
    value = (key + (number + 1) * _GOLDEN + salt * _SECOND) & _MASK
    value = ((value ^ value >> 30) * _FIRST) & _MASK
    value = ((value ^ value >> 27) * _SECOND) & _MASK
    return value ^ value >> 31


def draws(key: int, first: int, count: int) -> NDArray[np.uint64]:
    """Return ``draw(key, first)`` to ``draw(key, first + count - 1)``, u64 (count,)."""
    start = (key + (first + 1) * _GOLDEN) & _MASK
    value = np.uint64(start) + np.arange(count, dtype=np.uint64) * np.uint64(_GOLDEN)
    value = (value ^ value >> np.uint64(30)) * np.uint64(_FIRST)
    value = (value ^ value >> np.uint64(27)) * np.uint64(_SECOND)
    return value ^ value >> np.uint64(31)


def threshold(probability: float) -> int:
    """Return the limit below which a draw strikes, for a probability below 1."""
    return int(probability * (1 << 64))


def fraction(bits: int) -> float:
    """Return a draw as a number from 0 up to 1."""
    return bits / (1 << 64)

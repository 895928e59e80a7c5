"""How many bytes the longest message of a type takes, padding and all.

Padding depends on where a value starts, and that on how long the strings before it are. What counts is only
the start's place modulo 8. So a value is an 8 by 8 matrix: from a start at place ``r`` to an end at place
``s``, the most bytes that takes, or ``_NEVER``. One value after another is the product of their matrices in
the algebra where plus is maximum and times is plus; so many of them is a power, by repeated squaring.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

_PLACES: Final = 8
_NEVER: Final = -(1 << 60)
_MOST: Final = 1 << 50
"""Larger sizes are cut to this, so that sums do not overflow 64 bits."""


def nothing() -> NDArray[np.int64]:
    """Return the matrix of no bytes."""
    return np.where(np.eye(_PLACES, dtype=bool), 0, _NEVER)


def aligned(size: int) -> NDArray[np.int64]:
    """Return the matrix of a primitive, aligned to its size."""
    matrix = np.full((_PLACES, _PLACES), _NEVER)
    for start in range(_PLACES):
        taken = -start % size + size
        matrix[start, (start + taken) % _PLACES] = taken
    return matrix


def then(first: NDArray[np.int64], second: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the matrix of one value after another."""
    total: NDArray[np.int64] = (first[:, :, None] + second[None, :, :]).max(axis=1)
    return np.where(total < 0, _NEVER, np.minimum(total, _MOST))


def times(matrix: NDArray[np.int64], count: int) -> NDArray[np.int64]:
    """Return the matrix of a value repeated ``count`` times."""
    result = nothing()
    while count:
        if count & 1:
            result = then(result, matrix)
        matrix = then(matrix, matrix)
        count >>= 1
    return result


def up_to(matrix: NDArray[np.int64], most: int) -> NDArray[np.int64]:
    """Return the matrix of a value repeated 0 to ``most`` times."""
    return times(np.maximum(matrix, nothing()), most)


def longest(matrix: NDArray[np.int64]) -> int:
    """Return the most bytes from an aligned start."""
    return int(matrix[0].max())

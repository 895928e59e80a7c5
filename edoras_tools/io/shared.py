"""Values that go from process to process with their arrays in shared memory, not in a pickle."""

from __future__ import annotations

import mmap
import pickle
from typing import TYPE_CHECKING, Any, Final

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

SLOT_BYTES: Final = 32 << 20
"""Space for the arrays of one value; the rest stays in its pickle. Only pages in use need memory."""
ROOM_BYTES: Final = 9 << 20
"""Space for a source to read into: a window of a file, and what is left of the one before."""
_ALIGNMENT: Final = 64

Packed = tuple[bytes, list[tuple[int, int]]]
"""A pickle, and where its arrays are in the shared memory."""


def shared_memory(size: int) -> NDArray[np.uint8]:
    """Return memory that processes forked later share: u8.

    Raises:
        OSError: no memory.
    """
    return np.frombuffer(mmap.mmap(-1, size), np.uint8)


def pickled(
    value: Any,
    memory: NDArray[np.uint8],
    at: int,
    lent: Callable[[NDArray[np.uint8]], int | None] = lambda _: None,
    *,
    size: int,
) -> Packed:
    """Pickle a value, with its arrays in shared memory.

    Args:
        at: where in it there is room for arrays.
        lent: tells where an array is if it is already there.
        size: how much room, in bytes.
    """
    places: list[tuple[int, int]] = []
    end = at + size

    def inside(buffer: pickle.PickleBuffer) -> bool:
        """Put an array into shared memory; return True if it has to stay in the pickle."""
        nonlocal at
        data = np.frombuffer(buffer.raw(), np.uint8)
        there = lent(data)
        if there is not None:
            places.append((there, there + len(data)))
            return False
        if at + len(data) > end:
            return True
        memory[at : at + len(data)] = data
        places.append((at, at + len(data)))
        at += -(-len(data) // _ALIGNMENT) * _ALIGNMENT
        return False

    return pickle.dumps(value, protocol=5, buffer_callback=inside), places


def unpickled(packed: Packed, memory: NDArray[np.uint8]) -> Any:
    """Return a value whose arrays lie in shared memory."""
    body, places = packed
    return pickle.loads(body, buffers=[memory[first:end] for first, end in places])  # noqa: S301  our own data


def place(data: NDArray[np.uint8], memory: NDArray[np.uint8]) -> int:
    """Return where an array begins, counted from the beginning of the memory; it may lie outside."""
    begins: int = data.__array_interface__["data"][0] - memory.__array_interface__["data"][0]
    return begins

"""The thread that asks a filter about block after block, while the view stays quick."""

from __future__ import annotations

import queue
import threading
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from numpy.typing import NDArray

    from edoras_tools.decode.where import Where
    from edoras_tools.tui.store import Block


class Sieve(threading.Thread):
    """Answers for blocks in the order they are put.

    Args:
        settled: called with the filter, the block and its rows that pass, in this thread.
    """

    def __init__(self, settled: Callable[[Where, Block, NDArray[np.int64]], None]) -> None:
        super().__init__(name="filter", daemon=True)
        self._settled = settled
        self._wanted: Where | None = None
        self._blocks: queue.SimpleQueue[tuple[Where, Block] | None] = queue.SimpleQueue()

    def begin(self, where: Where | None, blocks: Iterable[Block] = ()) -> None:
        """Ask another filter, or none: what the one before has not answered it need not any more."""
        self._wanted = where
        if where is not None:
            for block in blocks:
                self._blocks.put((where, block))

    def put(self, block: Block) -> None:
        """Ask the filter about one more block."""
        if self._wanted is not None:
            self._blocks.put((self._wanted, block))

    def stop(self) -> None:
        """Let the thread end."""
        self._wanted = None
        self._blocks.put(None)

    def run(self) -> None:
        """Answer."""
        while (asked := self._blocks.get()) is not None:
            where, block = asked
            if where is self._wanted:
                self._settled(where, block, np.flatnonzero(where.mask(block.batch, block.columns)))

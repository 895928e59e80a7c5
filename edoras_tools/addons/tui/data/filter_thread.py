"""The thread that runs the filter, block by block, so that the view stays responsive."""

from __future__ import annotations

import queue
import threading
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from numpy.typing import NDArray

    from edoras_tools.addons.tui.data.store import PacketBlock
    from edoras_tools.decode.filters.filter import Where


class FilterThread(threading.Thread):
    """Runs a filter on blocks, in the order in which they are put.

    Args:
        settled: called with the filter, the block and its rows that pass, in this thread.
    """

    def __init__(self, settled: Callable[[Where, PacketBlock, NDArray[np.int64]], None]) -> None:
        super().__init__(name="filter", daemon=True)
        self._settled = settled
        self._wanted: Where | None = None
        self._blocks: queue.SimpleQueue[tuple[Where, PacketBlock] | None] = queue.SimpleQueue()

    def begin(self, where: Where | None, blocks: Iterable[PacketBlock] = ()) -> None:
        """Start again with another filter, or none; blocks that still wait for the old one are dropped."""
        self._wanted = where
        if where is not None:
            for block in blocks:
                self._blocks.put((where, block))

    def put(self, block: PacketBlock) -> None:
        """Add a block."""
        if self._wanted is not None:
            self._blocks.put((self._wanted, block))

    def stop(self) -> None:
        """End the thread."""
        self._wanted = None
        self._blocks.put(None)

    def run(self) -> None:
        """Filter blocks until stopped."""
        while (asked := self._blocks.get()) is not None:
            where, block = asked
            if where is self._wanted:
                self._settled(where, block, np.flatnonzero(where.mask(block.batch, block.columns)))

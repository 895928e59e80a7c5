"""The thread that judges the packets of the view."""

from __future__ import annotations

import queue
import threading
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Iterable

    from edoras_tools.addons.tui.data.store import PacketBlock


class WatchThread(threading.Thread):
    """Passes blocks to the monitor of a link, in the order in which they are put.

    Args:
        monitor: result of ``doors.part("monitor")``.
        blocks: blocks that exist already.

    Attributes:
        state: function that returns the state of the link so far.
    """

    def __init__(self, monitor: Any, blocks: Iterable[PacketBlock]) -> None:
        super().__init__(name="monitor", daemon=True)
        self._monitor, self._stopping = monitor, threading.Event()
        self._blocks: queue.SimpleQueue[PacketBlock | None] = queue.SimpleQueue()
        self.state = monitor.state
        for block in blocks:
            self.put(block)

    def put(self, block: PacketBlock | None) -> None:
        """Add a block; None behind the last one."""
        self._blocks.put(block)

    def stop(self) -> None:
        """End the thread."""
        self._stopping.set()
        self._blocks.put(None)

    def run(self) -> None:
        """Pass blocks on until stopped."""
        while (block := self._blocks.get()) is not None and not self._stopping.is_set():
            self._monitor.add(block.batch, block.columns)
        self._monitor.finish()
        self._stopping.wait()
        self._monitor.close()

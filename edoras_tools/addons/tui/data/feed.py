"""The threads that read a source, decode its packets in blocks and judge these, so that the view goes on."""

from __future__ import annotations

import queue
import threading
from typing import TYPE_CHECKING, Any

from edoras_tools.addons.tui.data.store import PacketBlock
from edoras_tools.errors import EdorasError
from edoras_tools.pipelines.capture.flushing import compact
from edoras_tools.pipelines.reading import Limits, reading
from edoras_tools.render import units
from edoras_tools.words import plural

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from edoras_tools.io import Source
    from edoras_tools.pipelines.selection import Selection
    from edoras_tools.pipelines.workbench import Workbench


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


class Feed(threading.Thread):
    """Reads a source to its end, or until it is stopped.

    Args:
        source: closed by the thread when it ends.
        selection: selection of packets to read; its filter is ignored, because the view filters.
        deliver: called with each block, in this thread.
        ended: called once, with a message if there is something to report, and whether reading failed.
        size: bytes to keep; 0 for all. Not for live sources: there the view drops its oldest packets instead.
    """

    def __init__(
        self,
        source: Source,
        bench: Workbench,
        selection: Selection,
        *,
        deliver: Callable[[PacketBlock], None],
        ended: Callable[[str, bool], None],
        limits: Limits,
        size: int = 0,
    ) -> None:
        super().__init__(name="packets", daemon=True)
        self._source = source
        self._bench = bench
        self._selection = selection
        self._deliver = deliver
        self._ended = ended
        self._limits = limits
        self._size = size
        self._stopping = threading.Event()

    def stop(self) -> None:
        """Ask the thread to end; a live source is read up to what has already arrived."""
        self._stopping.set()
        self._source.stop()

    def run(self) -> None:
        """Read until the end; report it with ``ended``."""
        why, failed = "", True
        try:
            why = self._read()
            failed = False
        except EdorasError as error:
            why = str(error)
        except Exception as error:  # noqa: BLE001  if the thread died silently, the link would look idle
            why = f"reading stopped: {type(error).__name__}: {error}"
        finally:
            self._ended(why, failed)

    def _read(self) -> str:
        count = size = 0
        with reading(self._source, self._bench, self._selection, self._limits) as loop:
            for rows in loop:
                if self._stopping.is_set():
                    break
                if len(rows):
                    block = PacketBlock(*compact(*rows.alone()), begin_ns=rows.begin_ns)
                    count, size = count + len(block), size + block.size
                    self._deliver(block)
                if self._size and size >= self._size:
                    return (
                        f"only the first {plural(count, 'packet')} were read: the limit is "
                        f"{units.size(size)}; select fewer with --link, --topic or --msg-id"
                    )
        return ""

"""The thread that reads a source, decodes what comes, and hands it over in blocks."""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING

from edoras_tools.errors import EdorasError
from edoras_tools.render import units
from edoras_tools.tui.store import Block, compact

if TYPE_CHECKING:
    from collections.abc import Callable

    from edoras_tools.pipelines.selection import Selection
    from edoras_tools.pipelines.workbench import Workbench
    from edoras_tools.sources import Source


class Feed(threading.Thread):
    """Reads a source to its end, or until told to stop.

    Args:
        source: closed by the thread when it ends.
        bench: mission, types and decoders.
        selection: what is taken at all; without a filter, which the view has itself.
        deliver: called with each block, in this thread.
        ended: called once, with why if there is something to say, and whether it is that reading failed.
        clock: monotonic time in ns.
        count: take so many packets; 0 all.
        duration_ns: read so long; 0 to the end.
        limit: bytes to hand over; 0 all. A live source has none: its oldest packets give way instead.
    """

    def __init__(
        self,
        source: Source,
        bench: Workbench,
        selection: Selection,
        *,
        deliver: Callable[[Block], None],
        ended: Callable[[str, bool], None],
        clock: Callable[[], int],
        count: int = 0,
        duration_ns: int = 0,
        limit: int = 0,
    ) -> None:
        super().__init__(name="packets", daemon=True)
        self._source = source
        self._bench = bench
        self._selection = selection
        self._deliver = deliver
        self._ended = ended
        self._clock = clock
        self._count = count
        self._duration_ns = duration_ns
        self._limit = limit
        self._stopping = threading.Event()

    def stop(self) -> None:
        """Ask the thread to end; a live source is read up to what has arrived."""
        self._stopping.set()
        stop = getattr(self._source, "stop", None)
        if stop is not None:
            stop()

    def run(self) -> None:
        """Read."""
        why, failed = "", True
        try:
            why = self._read()
            failed = False
        except EdorasError as error:
            why = str(error)
        except Exception as error:  # noqa: BLE001  a thread that dies silently would look like a quiet link
            why = f"reading stopped: {type(error).__name__}: {error}"
        finally:
            self._source.close()
            self._ended(why, failed)

    def _read(self) -> str:
        began, taken, size = self._clock(), 0, 0
        for batch in self._source.batches():
            if self._stopping.is_set():
                break
            if len(batch):
                columns = self._bench.columns.decode(batch)
                if self._selection:
                    rows = self._selection.rows(batch, columns, self._bench.mission)
                    batch, columns = batch.take(rows), columns.take(rows)  # noqa: PLW2901  what is left of it
                if self._count and taken + len(batch) > self._count:
                    left = slice(0, self._count - taken)
                    batch, columns = batch.take(left), columns.take(left)  # noqa: PLW2901
                if len(batch):
                    block = Block(*compact(batch, columns))
                    taken, size = taken + len(block), size + block.size
                    self._deliver(block)
            if self._count and taken >= self._count:
                break
            if self._duration_ns and self._clock() - began >= self._duration_ns:
                break
            if self._limit and size >= self._limit:
                return (
                    f"the first {units.plural(taken, 'packet')} are here, more do not fit {units.size(size)};"
                    " choose fewer with --link, --topic or --msg-id"
                )
        return ""

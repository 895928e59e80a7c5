"""Watches the files of a recording: if one is moved or deleted, recording continues in another file.

Rules that it keeps:

1. Once a second, and at the end, the file being written is compared with the file at its path: inode and
   size. Any change by others is reported at once, and kept in ``losses``.
2. A file that was moved is completed at its new place. One that was deleted, replaced or truncated is closed
   in its present state: its datagrams are lost, and counted.
3. Another output of the same kind is started at a free name beside the first (``outputs.path_beside``).
4. Complete files, e.g. those of a split recording, are checked once more at the end.
5. A file that replaces another one is written beside it until it is complete (``outputs.OutputFile``); after
   ``cut_short`` both are kept.
6. To survive power cuts, everything is flushed, and file and folder are synced, at an interval and at the
   end. A complete file is synced once more, and then not again. A thread waits for the disk, so that a slow
   disk does not delay writing; while it waits, no other sync is started.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import TYPE_CHECKING, Final, Protocol

import msgspec

from edoras_tools.errors import CaptureError, os_errors
from edoras_tools.io import Sink
from edoras_tools.io.outputs import OutputFile, path_beside, to_disk
from edoras_tools.words import plural

if TYPE_CHECKING:
    from concurrent.futures import Future, ThreadPoolExecutor
    from pathlib import Path

    from edoras_tools.model import Columns, HostCounters, PacketBatch, SourceStatistics
    from edoras_tools.sessions.faults.rules import Fault

_LOOK_S: Final = 1.0


class OutputLoss(msgspec.Struct, frozen=True):
    """A file that was moved, deleted or changed by others, while it was written or later.

    Attributes:
        path: its original path.
        fate: what happened to it, e.g. ``was deleted``.
        datagrams: number of datagrams in it.
        recoverable: whether it is complete at another place.
        complete: whether it was already complete when it happened.
    """

    path: Path
    fate: str
    datagrams: int
    recoverable: bool
    complete: bool = False

    def __str__(self) -> str:
        if self.complete:
            content = plural(self.datagrams, "datagram")
            return f"{self.path} {self.fate} when it was complete: it held {content}"
        result = "are there" if self.recoverable else "are lost"
        return f"{self.path} {self.fate} while it was written: {self.datagrams:,} datagrams {result}"


class FileSink(Sink, Protocol):
    """A sink that writes files."""

    @property
    def paths(self) -> Sequence[Path]:
        """The files written, or their directory."""

    @property
    def output(self) -> OutputFile | None:
        """The file being written; None if this sink did not open it."""

    @property
    def datagrams(self) -> int:
        """Number of datagrams that are, or will be, in the file being written."""

    @property
    def complete(self) -> Sequence[tuple[OutputFile, int]]:
        """The complete files, with the number of datagrams in each."""

    def forget(self, output: OutputFile) -> None:
        """Leave a complete file out of ``paths`` and ``complete``: it was deleted."""

    def abandon(self) -> None:
        """Close the file in its present state; nothing more is written."""


class Keep(msgspec.Struct):
    """Limit of the parts of a recording to keep, and the count of deleted parts.

    Attributes:
        files: most files to keep, including the one being written; 0: all.
        size: approximate most bytes of all files; 0: no limit. The file being written is never deleted.
        deleted: number of files deleted, the oldest first.
        datagrams: number of datagrams in the deleted files.
    """

    files: int = 0
    size: int = 0
    deleted: int = 0
    datagrams: int = 0


class WatchedSink(Sink):
    """A sink that continues if its file is lost.

    Args:
        begin: opens a sink at a path.
        on_warning: called with a line for each file that was lost.
        statistics: counts of the source, for files that are completed before the end.
        clock: monotonic time in s.
        sync_s: interval at which everything is synced to the disk; 0: never.
        keep: limit of the files to keep; by default none is deleted.

    Attributes:
        on_complete: called with the path of each complete file; by default nothing is called.
        losses: the files that were lost.
        keep: the limit, with the counts of deleted files.

    Raises:
        CaptureError: from every method: the output cannot be written.
    """

    def __init__(
        self,
        path: Path,
        begin: Callable[[Path], FileSink],
        on_warning: Callable[[str], None],
        statistics: SourceStatistics,
        *,
        clock: Callable[[], float] = time.monotonic,
        sync_s: float = 0,
        keep: Keep | None = None,
    ) -> None:
        self.losses: list[OutputLoss] = []
        self.keep = keep or Keep()
        self._path, self._begin, self._on_warning = path, begin, on_warning
        self.on_complete: Callable[[Path], None] = lambda _: None
        self._announced: set[Path] = set()
        self._statistics = statistics
        self._clock = clock
        self._looked = self._synced = clock()
        self._sync_s = sync_s
        self._on_disk: set[Path] = set()
        """Files that are complete and synced."""
        self._disk: ThreadPoolExecutor | None = None
        self._syncing: Future[None] | None = None
        self._over: list[Path] = []
        self._complete: list[tuple[OutputFile, int]] = []
        self._sink: FileSink | None = begin(path)
        self._closed = False

    @property
    def paths(self) -> list[Path]:
        """The files written, or their directories, without lost ones."""
        return [*self._over, *(self._sink.paths if self._sink else ())]

    @property
    def replaces(self) -> bool:
        """Whether the file being written will replace another one."""
        return bool(self._sink and self._sink.output and self._sink.output.older)

    def write(self, batch: PacketBatch, columns: Columns) -> None:
        """Write a batch and its columns."""
        self._look()
        sink = self._open()
        sink.write(batch, columns)
        self._announce([output for output, _ in sink.complete])
        self._delete_oldest()
        self._sync()

    def write_faults(self, faults: Sequence[Fault]) -> None:
        """Write injected faults, if the format stores them."""
        self._open().write_faults(faults)

    def write_host(self, host: HostCounters) -> None:
        """Write the kernel's counters of this host, if the format stores them."""
        self._open().write_host(host)

    def flush(self) -> None:
        """Write everything received so far to the file."""
        self._open().flush()
        self._look()
        self._sync()

    def close(self, statistics: SourceStatistics) -> None:
        """Complete the output."""
        if self._closed:
            return
        self._closed = True
        sink = self._sink
        if sink is None or self._close_if_moved(statistics):
            self._check_complete(None)
            return
        sink.close(statistics)
        if sink.output and sink.output.spares and sink.output.older:
            self._on_warning(f"{sink.output.older} is as it was; the new recording is {sink.output.path}")
        complete = [output for output, _ in sink.complete]
        self._check_complete(sink)
        self._announce([*complete, *([sink.output] if sink.output else ())])
        if self._sync_s:
            if self._disk:
                self._disk.shutdown()
            if self._syncing:
                self._syncing.result()
            self._to_disk(self._files(), None)

    def cut_short(self, *, empty: bool) -> None:
        """Keep the file that would be replaced; with ``empty``, delete the output and its empty directory."""
        if self._sink and self._sink.output:
            self._sink.output.spares = True
        if not empty:
            return
        self.abandon()
        for output in (self._sink.output,) if self._sink and self._sink.output else ():
            output.remove()
            if self._sink and output.path not in self._sink.paths:
                with suppress(OSError):  # something else is in it
                    output.path.parent.rmdir()

    def abandon(self) -> None:
        """Close the file in its present state; nothing more is written."""
        self._closed = True
        if self._disk:
            self._disk.shutdown(wait=False)
        if self._sink:
            self._sink.abandon()

    def _announce(self, outputs: Sequence[OutputFile]) -> None:
        """Call ``on_complete`` with each complete file, once."""
        for output in outputs:
            if output.path not in self._announced:
                self._announced.add(output.path)
                self.on_complete(output.path)

    def _open(self) -> FileSink:
        if self._sink is None:
            raise CaptureError(f"{self._path}: the recording is closed")
        return self._sink

    def _delete_oldest(self) -> None:
        """Delete the oldest complete files until the rest is within the limits of ``keep``."""
        keep, sink = self.keep, self._open()
        if not (keep.files or keep.size):
            return
        outputs = [*self._complete, *sink.complete]
        size = sum(output.size for output, _ in outputs) + (sink.output.size if sink.output else 0)
        for output, count in outputs:
            if not ((keep.files and len(outputs) >= keep.files) or (keep.size and size > keep.size)):
                return
            outputs, size = outputs[1:], size - output.size
            sink.forget(output)
            self._complete = [item for item in self._complete if item[0] is not output]
            self._over = [path for path in self._over if path != output.path]
            if output.fate():
                continue  # another program moved it, so it is no longer ours
            with os_errors(f"{output.path}: cannot be deleted"):
                output.path.unlink()
            keep.deleted += 1
            keep.datagrams += count

    def _sync(self) -> None:
        now = self._clock()
        if not self._sync_s or now - self._synced < self._sync_s:
            return
        if self._syncing:
            if not self._syncing.done():
                return
            self._syncing.result()
        self._synced = now - (now - self._synced) % self._sync_s  # flushes do not come at exact times
        sink = self._open()
        sink.flush()
        current = sink.output.path if sink.output else None
        if self._disk is None:
            from concurrent.futures import ThreadPoolExecutor

            self._disk = ThreadPoolExecutor(1, "edoras-sync")
        self._syncing = self._disk.submit(self._to_disk, self._files(), current)

    def _files(self) -> list[Path]:
        return [item for path in self.paths for item in (path.iterdir() if path.is_dir() else (path,))]

    def _to_disk(self, files: Sequence[Path], current: Path | None) -> None:
        """Sync files that may not be on the disk; ``current`` is still being written."""
        for path in files:
            if path not in self._on_disk:
                # A removed file is reported elsewhere.
                with os_errors(f"{path}: cannot be synced"), suppress(FileNotFoundError):
                    to_disk(path)
        self._on_disk.update(path for path in files if path != current)

    def _look(self) -> None:
        now = self._clock()
        if now - self._looked < _LOOK_S:
            return
        self._looked = now
        if self._close_if_moved(self._statistics):
            path = path_beside(self._path)
            with os_errors(f"{path.parent}: cannot be made"):
                path.parent.mkdir(parents=True, exist_ok=True)
            self._sink = self._begin(path)
            self._on_warning(f"{self.losses[-1]}; continuing in {self._sink.paths[-1]}")

    def _check_complete(self, sink: FileSink | None) -> None:
        """Check whether the complete files are still there; add a loss for each that is not."""
        self._over, self._sink = self.paths, None
        for output, count in [*self._complete, *(sink.complete if sink else ())]:
            if fate := output.fate():
                self.losses.append(OutputLoss(output.path, fate, count, recoverable=False, complete=True))
                self._over = [path for path in self._over if path != output.path and path.exists()]

    def _close_if_moved(self, statistics: SourceStatistics) -> bool:
        """Close the sink if its file was moved or deleted; complete the file if it still exists."""
        sink = self._sink
        fate = sink.output.fate() if sink and sink.output else ""
        if not fate or sink is None or sink.output is None:
            return False
        self._sink = None
        path, count = sink.output.path, sink.datagrams
        recoverable = fate != "was truncated" and sink.output.linked
        self._over += [other for other in sink.paths if other not in {path, path.parent}]
        self._complete += sink.complete
        if recoverable:
            try:
                sink.close(statistics)
            except CaptureError:
                recoverable = False
        with suppress(CaptureError):
            sink.abandon()
        self.losses.append(OutputLoss(path, fate, count, recoverable))
        return True

"""From a source to a recording: MCAP, rosbag2, pcapng or pcap, chosen by the suffix.

Live traffic is written to the file in time, so that a killed recorder loses at most one second. Rules:

1. The age of a datagram counts from its capture: a recorder that is late flushes after every batch.
2. Ages compare two clocks, and a step of one of them makes them wrong. So an age can only make a flush
   earlier.
3. The sink is flushed once a second even without data, because a sink then checks its files.
4. Batches that waited for others are flushed as soon as they are written.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Collection, Sequence
from contextlib import ExitStack, suppress
from time import time_ns
from typing import TYPE_CHECKING, Any, Final

import msgspec
import numpy as np
from msgspec.structs import replace

from edoras_tools.diagnosis.evidence.copies import Repeats
from edoras_tools.errors import ConfigError, EdorasError, os_errors
from edoras_tools.io import RecordingOptions, Sink, Source
from edoras_tools.io.formats.capture_file import LISTENED, CaptureFileSink, SplitCaptureSink
from edoras_tools.io.formats.table import FILE_SUFFIXES, MCAP, PCAP, PCAPNG, ROSBAG2, Format, written_as
from edoras_tools.io.formats.watched import FileSink, Keep, OutputLoss, WatchedSink
from edoras_tools.io.outputs import Patience, in_the_way, refuse_existing, refuse_input, waiting_for_room
from edoras_tools.io.processes import jobs_for
from edoras_tools.model import Columns, HostCounters, PacketBatch, concatenate
from edoras_tools.pipelines.capture.ledger import Ledger
from edoras_tools.pipelines.reading import Independence, Limits, ReadLoop, reading
from edoras_tools.sessions.sequence import SequenceCounts
from edoras_tools.units import SECOND
from edoras_tools.wire.arrays import copy_rows

if TYPE_CHECKING:
    from pathlib import Path

    from edoras_tools.pipelines.selection import Selection
    from edoras_tools.pipelines.workbench import Workbench
    from edoras_tools.render.terminal.text import Watcher
    from edoras_tools.structs.shapes import LayoutEntry


class Target(msgspec.Struct, frozen=True):
    """The output of a recording.

    Attributes:
        path: the file, or the rosbag2 directory.
        rosbag2: write a rosbag2 directory.
        stream: format on standard output, if ``path`` is ``outputs.STDOUT``.
        split_bytes: start a new file at this size; 0: never.
        split_ns: start a new file after this time; 0: never.
        split_count: start a new file after this number of datagrams; 0: never.
        keep_files: number of files of a split recording to keep, deleting the oldest; 0: all.
        keep_bytes: size of all files together from which the oldest are deleted, bytes; 0: never.
        replace: overwrite an existing output.
        sync_ns: flush to the disk at this interval, to survive a power cut; 0: never.
        jobs: number of processes that share the work on a large file; 0: one for each processor core, up to a
            maximum.
        transforms: also write ``/tf``, made of the poses, for 3D views.
        on_warning: called with a line if the file is removed while it is written.
        on_complete: called with each file that is complete.
    """

    path: Path
    rosbag2: bool = False
    stream: Format | None = None
    split_bytes: int = 0
    split_ns: int = 0
    split_count: int = 0
    keep_files: int = 0
    keep_bytes: int = 0
    sync_ns: int = 0
    replace: bool = False
    transforms: bool = False
    jobs: int = 0
    on_warning: Callable[[str], None] = lambda _: None
    on_complete: Callable[[Path], None] = lambda _: None

    @property
    def splits(self) -> bool:
        """Whether it is written in parts."""
        return bool(self.split_bytes or self.split_ns or self.split_count)

    @property
    def format(self) -> Format | None:
        """The requested format; None if the suffix names no format."""
        if self.stream is not None:
            return self.stream
        return ROSBAG2 if self.rosbag2 else written_as(self.path)


class CaptureReport(msgspec.Struct, eq=False):
    """The result of a recording.

    Attributes:
        ledger: counts by route.
        source: the source, for its statistics.
        outputs: paths of the written files, or of the rosbag2 directory.
        failure: error that ended the source early, if any; everything before it is written.
        notes: properties recognised from the bytes, one line each.
        unnamed: see ``Context``.
        losses: outputs that were removed while they were written.
        keep: number of oldest files that were deleted because of ``keep_files`` or ``keep_bytes``.
        entries: times that each entry of a dictionary was seen whole; only ``info`` counts them.
    """

    ledger: Ledger
    source: Source
    outputs: list[Path] = msgspec.field(default_factory=list)
    failure: EdorasError | None = None
    notes: list[str] = msgspec.field(default_factory=list)
    unnamed: int = 0
    losses: list[OutputLoss] = msgspec.field(default_factory=list)
    keep: Keep = msgspec.field(default_factory=Keep)
    entries: Counter[LayoutEntry] = msgspec.field(default_factory=Counter)

    @property
    def lost(self) -> int:
        """Frames that the kernel or a full queue lost."""
        return self.source.statistics.kernel_drops or 0

    @property
    def messages(self) -> int:
        """Messages of a recording without datagrams that were counted, or written and not lost again."""
        return self.ledger.datagrams - sum(item.datagrams for item in self.losses)

    def summary(self) -> dict[str, Any]:
        """Return the report in the shape of ``info --json``."""
        statistics = self.source.statistics
        recorded = bool(self.ledger.mission.recorded)
        return {
            "source": self.source.info.name,
            "kind": self.source.info.kind,
            "datagrams": 0
            if recorded
            else self.ledger.datagrams - self.ledger.taken_out - sum(item.datagrams for item in self.losses),
            **({"messages": self.messages} if recorded else {}),
            "skipped": statistics.skipped,
            "start_ns": self.ledger.start_ns,
            "end_ns": self.ledger.end_ns,
            "capture_drops": None if recorded else statistics.kernel_drops,
            "outages": [outage.as_json() for outage in statistics.outages],
            "routes": self.ledger.routes(),
            **({"entries": self._entries()} if self.entries else {}),
            **self.ledger.summary(),
            "findings": dict(sorted(self.ledger.findings.items())),
            "warnings": [
                *self.ledger.mission.warnings,
                *self.notes,
                *self.ledger.notes,
                *self.ledger.unread,
                *statistics.warnings,
                *map(str, self.losses),
            ],
        }

    def _entries(self) -> list[dict[str, Any]]:
        """Return the entries of a dictionary with the times that each was seen."""
        return [
            {"entry": entry.name, "is": entry.word, "id": entry.id_text, "count": self.entries[entry]}
            for entry in sorted(self.entries)
        ]


def check_output(target: Target, inputs: Sequence[Path], *, snapshots: bool = False) -> None:
    """Check a target before anything is opened: its format, and that it overwrites nothing.

    Args:
        snapshots: whether each file gets its own unused name.

    Raises:
        ConfigError: the suffix is unknown, or something would be overwritten.
    """
    if target.format is None:
        raise ConfigError(
            f"{target.path}: unknown suffix; use {', '.join(FILE_SUFFIXES)}, or --format rosbag2"
        )
    split = target.splits
    if target.stream is not None:
        if split or snapshots or target.rosbag2 or target.sync_ns or target.replace:
            raise ConfigError(
                "-o - writes one stream to standard output: leave the options about files out, as --force"
            )
        return
    if (target.keep_files or target.keep_bytes) and not (split or snapshots):
        raise ConfigError("--keep deletes the oldest files: split too, e.g. --split 10m")
    if 0 < target.keep_bytes < target.split_bytes:
        raise ConfigError("--keep is smaller than --split: no complete file would be kept")
    refuse_input(target.path, inputs)
    if not target.replace and not target.rosbag2 and not snapshots:
        refuse_existing(in_the_way(target.path, split=split))


def check_recorded(source: Source, bench: Workbench, target: Target) -> None:
    """Refuse outputs that only datagrams can be written to; the source is then closed.

    Raises:
        ConfigError: the source is a recording without datagrams, and the target needs them.
    """
    if not bench.mission.recorded or target.format is None:
        return
    why = ""
    if not target.format.messages:
        why = f"{target.format.name} holds datagrams: write .mcap, or --format rosbag2"
    elif target.transforms:
        why = "--tf makes /tf of what bridges carry: leave it out"
    if why:
        source.close()
        raise ConfigError(f"{source.info.name}: has messages and no datagrams, and {why}")


def open_sink(
    target: Target,
    source: Source,
    bench: Workbench,
    *,
    selection: str = "",
    sequences: SequenceCounts | None = None,
    topics: Collection[int] | None = None,
    apart: Independence | None = None,
) -> WatchedSink:
    """Open a sink for a target that was checked.

    Args:
        selection: the selection, in words.
        sequences: see ``RecordingOptions``.
        topics: see ``RecordingOptions``.
        apart: see ``RecordingOptions``; by default one that does not count.

    Raises:
        CaptureError: it cannot be written.
    """
    # If a file has the folder's name, opening the output reports the error.
    with os_errors(f"{target.path}: cannot be created"), suppress(FileExistsError):
        target.path.parent.mkdir(parents=True, exist_ok=True)
    info = replace(source.info, read_with=bench.columns.context.described)
    format_ = target.format or PCAP
    make = format_.sink()
    options = RecordingOptions(
        selection,
        target.split_bytes,
        target.split_ns,
        target.split_count,
        structs=bench.columns.context.structs,
        transforms=target.transforms,
        jobs=jobs_for(source, target.jobs, fixed=False),
        yields=not target.jobs,
        sequences=sequences,
        endpoints=bench.columns.context.endpoints,
        topics=topics,
        apart=apart or Independence(bench.columns.context),
    )

    def part(path: Path) -> CaptureFileSink:
        listened = info.read_with.get("listened") if format_ is PCAPNG else None
        return make(
            path,
            nanosecond=info.time_resolution_ns < 1000,
            snap_length=info.snap_length,
            **({"comment": f"{LISTENED}{listened}"} if listened else {}),
        )

    def begin(path: Path) -> FileSink:
        if not format_.messages:
            return SplitCaptureSink(path, options, part) if options.splits else part(path)
        messages: FileSink = make(
            path, bench.mission, bench.types, info, options, statistics=source.statistics
        )
        if messages.room:
            source.borrow(messages.room)
        return messages

    sync_s, keep = target.sync_ns / 1e9, Keep(target.keep_files, target.keep_bytes)
    sink = WatchedSink(target.path, begin, target.on_warning, source.statistics, sync_s=sync_s, keep=keep)
    sink.on_complete = target.on_complete
    if source.on_this_host and sink.replaces:
        target.on_warning(
            f"{target.path} is replaced at the end; until then the recording is {sink.paths[-1]}"
        )
    return sink


def record(
    source: Source,
    bench: Workbench,
    target: Target,
    *,
    selection: Selection | None = None,
    limits: Limits = Limits(),  # noqa: B008  frozen
    watcher: Watcher[CaptureReport] | None = None,
    tap: Callable[[PacketBatch, Columns], None] | None = None,
    by_route: bool = True,
) -> CaptureReport:
    """Write everything from a source until it ends, Ctrl-C, or a limit.

    Args:
        source: source of the datagrams; it is closed.
        selection: selected datagrams; all by default.
        limits: conditions of the end; its clock also determines when to flush.
        watcher: called with the report after every batch.
        tap: called with every batch that was written.
        by_route: count by route, for the report; else only the number of datagrams.

    Raises:
        CaptureError: the recording cannot be written.
        RouteError: the selection names a topic that is not configured.
        ConfigError: its filter has an error.
    """
    check_recorded(source, bench, target)
    selection = replace(selection, announced=True) if selection else None
    began = limits.clock()
    with (
        reading(source, bench, selection, limits, keeps_failure=True, selected=True) as loop,
        ExitStack() as stack,
    ):
        if source.on_this_host:

            def over() -> bool:
                late = limits.duration_ns and limits.clock() - began >= limits.duration_ns
                return bool(loop.interrupted or late)

            stack.enter_context(waiting_for_room(Patience(target.on_warning, over)))
        sequences = SequenceCounts()
        topics = loop.selection.places() if bench.mission.recorded else None
        # A recording of everything contains the counts that ``info`` would count in it.
        whole = not (loop.selection or limits.period or bench.mission.recorded or target.splits)
        counts = whole and target.format is MCAP
        apart = Independence(bench.columns.context, *((sequences, Repeats()) if counts else ()))
        sink = open_sink(
            target,
            source,
            bench,
            selection=str(loop.selection),
            sequences=sequences,
            topics=topics,
            apart=apart,
        )
        report = pour(
            loop,
            sink,
            watcher=watcher,
            tap=tap,
            by_route=by_route or counts,
            sequences=sequences,
            apart=apart if counts else None,
            patient=source.on_this_host and watcher is None and tap is None,
        )
    report.outputs, report.losses, report.keep = list(sink.paths), sink.losses, sink.keep
    return report


def pour(
    loop: ReadLoop,
    sink: Sink,
    *,
    watcher: Watcher[CaptureReport] | None = None,
    tap: Callable[[PacketBatch, Columns], None] | None = None,
    by_route: bool = True,
    sequences: SequenceCounts | None = None,
    apart: Independence | None = None,
    patient: bool = False,
) -> CaptureReport:
    """Write everything from a loop to an open sink; the source and the sink are closed. See ``record``.

    Args:
        loop: the read loop; it must keep the source's failure.
        sink: the output.
        watcher: see ``record``.
        tap: see ``record``.
        by_route: see ``record``.
        sequences: shared with the sink, see ``RecordingOptions``.
        apart: the sink's, which gets the counts; None: it does not get them.
        patient: see ``Waiting``.

    Raises:
        CaptureError: the sink cannot be written.
    """
    source, bench = loop.source, loop.bench
    context = bench.columns.context
    report = CaptureReport(
        Ledger(bench.mission, context, sequences, context.structs), source, notes=context.notes
    )
    silent = len(context.notes)
    live = not source.statistics.total_bytes  # a file is not flushed: it always gives the same recording
    flushing = Flushing(sink, loop.limits.clock, time_ns if source.on_this_host else None)
    host = None
    if source.on_this_host:
        source.pace(FLUSH_NS / 1e9, (1 + patient) * FLUSH_NS / 1e9)
        from edoras_tools.io.host import HostWatch

        host = HostWatch(set(bench.columns.context.capture_ports()))
    wrote = ended = False
    waiting = Waiting(patient=patient, clock=loop.limits.clock)

    def write(pair: tuple[PacketBatch, Columns] | None, counters: HostCounters | None) -> None:
        nonlocal wrote
        if pair is not None:
            wrote = True
            sink.write(*pair)
            flushing.took(pair[0])
        if counters:
            sink.write_host(counters)
            flushing.noted()
        if live:
            flushing.flush_if_due()  # first, because the rest can wait
        if pair is not None:
            if by_route:
                report.ledger.add(*pair)
            else:
                report.ledger.tally(pair[0])
            if tap is not None:
                tap(*pair)

    try:
        if host:
            sink.write_host(host.now())
        for rows in loop:
            if len(rows):
                waiting.add(*rows.alone())
            if not waiting.waits:  # else the counters of this host are not worth a chunk of their own
                write(waiting.take(), host.due() if host else None)
            if watcher is not None:
                watcher.update(report)
        if (rest := waiting.take()) is not None:
            write(rest, None)
        if host:
            sink.write_host(host.now())
        report.failure = loop.failure
        report.notes = [*report.notes, *loop.conversations.recorded()]
        if apart is not None and len(report.notes) == silent:
            apart.counts = report.ledger.as_json()
        ended = not report.failure
    finally:
        source.close()
        if not ended:
            sink.cut_short(empty=not wrote)
        sink.close(source.statistics)
    return report


OFFSETS: Final = ("packet_offset", "cdr_offset")
"""The columns that point into the buffer of their batch."""
ROW_BYTES: Final = 128
"""Approximate bytes that the columns of one packet take."""
_SPARE: Final = 64
"""Bytes after the last packet, for readers of whole words."""


def compact(batch: PacketBatch, columns: Columns) -> tuple[PacketBatch, Columns]:
    """Return the same packets over a smaller buffer, if most of the buffer is unused."""
    outside = (batch.offset < batch.frame_offset) | (
        batch.offset + batch.length > batch.frame_offset + batch.frame_length
    )
    sizes = batch.frame_length.astype(np.int64) + np.where(outside, batch.length, 0)
    total = int(sizes.sum())
    if 2 * total >= len(batch.data) or not len(batch):
        return batch, columns
    starts = np.cumsum(sizes) - sizes
    data = np.zeros(total + _SPARE, np.uint8)
    copy_rows(data, starts, batch.data, batch.frame_offset, batch.frame_length)
    # A payload that was reassembled from fragments is copied to a place after its frame.
    offset = np.where(outside, starts + batch.frame_length, starts + batch.offset - batch.frame_offset)
    rows = np.flatnonzero(outside)
    copy_rows(data, offset[rows], batch.data, batch.offset[rows], batch.length[rows])
    shift = offset - batch.offset
    moved = {
        name: np.where(column >= 0, column + shift, column)
        for name in OFFSETS
        for column in (getattr(columns, name),)
    }
    return replace(batch, data=data, frame_offset=starts, offset=offset), replace(columns, **moved)


def join(parts: Sequence[tuple[PacketBatch, Columns]]) -> tuple[PacketBatch, Columns]:
    """Put batches and their columns end to end into one; the buffers are copied.

    Args:
        parts: at least one.
    """
    if len(parts) == 1:
        return parts[0]
    shifts = np.cumsum([0, *(len(batch.data) for batch, _ in parts[:-1])]).tolist()
    whole = {}
    for name in Columns.__struct_fields__:
        values = [getattr(columns, name) for _, columns in parts]
        if name in OFFSETS:
            pairs = zip(values, shifts, strict=True)
            values = [np.where(value >= 0, value + shift, value) for value, shift in pairs]
        whole[name] = np.concatenate(values)
    return concatenate([batch for batch, _ in parts]), Columns(**whole)


FLUSH_NS: Final = 200_000_000
"""Largest age of data that is not in the file: a fifth of the guaranteed second, to leave time to write."""
_QUIET_NS: Final = 350_000_000
"""Longest time that small batches wait for others; the first may already be ``FLUSH_NS`` old."""
_SMALL: Final = 256 << 10
"""Size from which waiting batches are written, bytes."""
_SWIFT: Final = 16 << 20
"""Bytes since the last flush from which no flush is needed, because chunks fill up by themselves."""


class Waiting:
    """Joins small batches before they are written: each written batch costs a millisecond.

    Args:
        patient: whether batches wait for others while little arrives; for a recorder that nobody watches.
        clock: function that returns monotonic time, ns.
    """

    def __init__(self, *, patient: bool, clock: Callable[[], int] = time.monotonic_ns) -> None:
        self._patient, self._clock = patient, clock
        self._parts: list[tuple[PacketBatch, Columns]] = []
        self._bytes = self._since = 0

    def add(self, batch: PacketBatch, columns: Columns) -> None:
        """Add a batch of at least one row."""
        if not self._parts:
            self._since = self._clock()
        self._parts.append((batch, columns))
        self._bytes += len(batch.data)

    @property
    def waits(self) -> bool:
        """Whether there are batches, and they may still wait."""
        waits = self._patient and self._bytes < _SMALL and self._clock() - self._since < _QUIET_NS
        return bool(self._parts) and waits

    def take(self) -> tuple[PacketBatch, Columns] | None:
        """Return the waiting batches as one; None if there are none."""
        parts, self._parts, self._bytes = self._parts, [], 0
        return join(parts) if parts else None


class Flushing:
    """Flushes a sink in time; ``flush_if_due`` must be called several times per ``FLUSH_NS``.

    Args:
        clock: function that returns monotonic time, ns.
        wall: function that returns ns since 1970; None if the datagrams are not captured live.
    """

    def __init__(
        self,
        sink: Sink,
        clock: Callable[[], int] = time.monotonic_ns,
        wall: Callable[[], int] | None = time.time_ns,
    ) -> None:
        self._sink, self._clock, self._wall = sink, clock, wall
        self._due = clock() + FLUSH_NS
        self._bytes = 0

    @property
    def wait_s(self) -> float:
        """Time until the next flush, s."""
        return max(0, self._due - self._clock()) / 1e9

    def took(self, batch: PacketBatch) -> None:
        """Record that the sink got a batch."""
        if len(batch):
            age = max(0, self._wall() - int(batch.time_ns[0])) if self._wall else 0
            self.noted(age)
            self._bytes += int(batch.frame_length.sum())

    def noted(self, age_ns: int = 0) -> None:
        """Record that the sink got data of an age."""
        self._due = min(self._due, self._clock() + FLUSH_NS - age_ns)

    def flush_if_due(self) -> None:
        """Flush if it is due.

        Raises:
            CaptureError: the output cannot be written.
        """
        if self._clock() >= self._due:
            if self._bytes < _SWIFT:
                self._sink.flush()
            self._due, self._bytes = self._clock() + SECOND, 0

"""A source into a recording: MCAP, rosbag2, pcapng or pcap, told by the suffix."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Protocol

from edoras_tools.errors import CaptureError, ConfigError, EdorasError
from edoras_tools.pipelines.accounts import Ledger
from edoras_tools.pipelines.interrupt import interruptible
from edoras_tools.pipelines.selection import Selection

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence
    from pathlib import Path

    from edoras_tools.model import Columns, PacketBatch
    from edoras_tools.pipelines.workbench import Workbench
    from edoras_tools.sinks import Sink
    from edoras_tools.sinks.mcap import McapSink
    from edoras_tools.sources import Source

_KINDS = (".mcap", ".pcapng", ".pcap")
_FLUSH_NS = 500_000_000
"""A killed recorder loses at most a second; flushed twice as often, it has time to write."""
_SWIFT = 16 << 20
"""Bytes in that time from where on flushing is left out: it waits, and chunks fill by themselves."""

_LARGE = 32 << 20
"""Bytes of a file from where on a process of its own for what writes pays."""


class Watcher(Protocol):
    """What looks on while a recording grows: a progress bar or a live table."""

    def update(self, report: Report) -> None:
        """Show where things are; called once a batch."""


@dataclass(frozen=True, slots=True)
class Target:
    """What to write.

    Attributes:
        path: the file, or the rosbag2 directory.
        rosbag2: write a rosbag2 directory.
        split_bytes: begin another file at so many bytes; 0 never.
        split_ns: begin another file after so long; 0 never.
    """

    path: Path
    rosbag2: bool = False
    split_bytes: int = 0
    split_ns: int = 0


@dataclass(slots=True)
class Report:
    """What was recorded.

    Attributes:
        ledger: counts by route.
        source: the source, for its statistics.
        interrupted: ended by Ctrl-C.
        outputs: the files that were written, or the rosbag2 directory.
        failure: why the source ended early, if it did; all before it is written.
    """

    ledger: Ledger
    source: Source
    interrupted: bool = False
    outputs: list[Path] = field(default_factory=list)
    failure: EdorasError | None = None

    @property
    def lost(self) -> int:
        """Frames that the kernel or a full queue lost."""
        return self.source.statistics.kernel_drops

    def summary(self) -> dict[str, Any]:
        """Return the report in the shape of ``info --json``."""
        statistics = self.source.statistics
        return {
            "source": self.source.info.name,
            "kind": self.source.info.kind,
            "datagrams": self.ledger.datagrams,
            "skipped": statistics.skipped,
            "start_ns": self.ledger.start_ns,
            "end_ns": self.ledger.end_ns,
            "capture_drops": statistics.kernel_drops,
            "routes": self.ledger.routes(),
            "findings": dict(sorted(self.ledger.findings.items())),
            "warnings": [*self.ledger.mission.warnings, *statistics.warnings],
        }


def check_target(target: Target, inputs: Sequence[Path]) -> None:
    """Refuse a target that would overwrite what is being read, or an unknown kind, before anything is opened.

    Raises:
        ConfigError: it would.
    """
    if not target.rosbag2 and target.path.suffix.lower() not in _KINDS:
        raise ConfigError(
            f"{target.path}: its suffix names no kind of recording; "
            f"there are {', '.join(_KINDS)}, and --rosbag2"
        )
    splits = target.split_bytes or target.split_ns
    if splits and not target.rosbag2 and target.path.suffix.lower() != ".mcap":
        raise ConfigError(
            f"{target.path}: only MCAP recordings are split; name it .mcap, or leave --split-* out"
        )
    for item in inputs:
        if item.exists() and target.path.exists() and item.samefile(target.path):
            raise ConfigError(f"{target.path}: would overwrite its own input; name another output")


def open_sink(target: Target, source: Source, bench: Workbench, *, chosen: str = "") -> Sink:
    """Open what a checked target's suffix names.

    Raises:
        CaptureError: it cannot be written.
    """
    path, info = target.path, source.info
    suffix = path.suffix.lower()
    if target.rosbag2 or suffix == ".mcap":
        from edoras_tools.sinks.mcap import McapSink
        from edoras_tools.sinks.rosbag2 import Rosbag2Sink

        kind = Rosbag2Sink if target.rosbag2 else McapSink
        opened = kind(
            path,
            bench.mission,
            bench.types,
            info,
            filter=chosen,
            split_bytes=target.split_bytes,
            split_ns=target.split_ns,
            statistics=source.statistics,
            structs=bench.columns.context.structs,
        )
        return _apart(opened, source, path) if isinstance(opened, McapSink) else opened
    if suffix == ".pcapng":
        from edoras_tools.sinks.pcapng import PcapngSink

        return PcapngSink(path, nanosecond=info.time_resolution_ns < 1000, snap_length=info.snap_length)
    from edoras_tools.sinks.pcap import PcapSink

    return PcapSink(path, nanosecond=info.time_resolution_ns < 1000, snap_length=info.snap_length)


def _apart(sink: McapSink, source: Source, path: Path) -> Sink:
    """Give a sink a process of its own where that pays; the source then reads into memory of both."""
    if source.statistics.total_bytes < _LARGE:
        return sink
    from edoras_tools.sinks.apart import Apart
    from edoras_tools.sources.records import RecordSource

    try:
        apart = Apart(sink, source.statistics, path)
    except OSError:
        return sink
    if isinstance(source, RecordSource):
        source.borrow(apart.lend)
    return apart


def record(
    source: Source,
    bench: Workbench,
    target: Target,
    *,
    selection: Selection | None = None,
    clock: Callable[[], int],
    duration_ns: int = 0,
    count: int = 0,
    watcher: Watcher | None = None,
    tap: Callable[[PacketBatch, Columns], None] | None = None,
    by_route: bool = True,
) -> Report:
    """Write everything that a source gives until it ends, Ctrl-C, or a limit.

    Args:
        source: where datagrams come from; it is closed.
        bench: mission, types and decoders.
        target: what to write.
        selection: which datagrams; all by default.
        clock: monotonic time in ns, for flushing and ``duration_ns``.
        duration_ns: stop after so long; 0 never.
        count: stop after so many datagrams; 0 never.
        watcher: shown the report after every batch.
        tap: given every batch that was written.
        by_route: count by route, for the report; else only how many datagrams there were.

    Raises:
        CaptureError: the recording cannot be written.
        RouteError: the selection names a topic that is not configured.
        ConfigError: its filter has a mistake.
    """
    selection = selection or Selection()
    report = Report(Ledger(bench.mission), source)
    try:
        selection = selection.over(bench)
        sink = open_sink(target, source, bench, chosen=str(selection))
    except EdorasError:
        source.close()
        raise
    pour(
        source,
        bench,
        sink,
        report,
        selection=selection,
        clock=clock,
        duration_ns=duration_ns,
        count=count,
        watcher=watcher,
        tap=tap,
        by_route=by_route,
    )
    report.outputs = getattr(sink, "paths", None) or [target.path]
    return report


def pour(
    source: Source,
    bench: Workbench,
    sink: Sink,
    report: Report,
    *,
    selection: Selection,
    clock: Callable[[], int],
    duration_ns: int = 0,
    count: int = 0,
    watcher: Watcher | None = None,
    tap: Callable[[PacketBatch, Columns], None] | None = None,
    by_route: bool = True,
) -> None:
    """Write everything that a source gives into an open sink; both are closed. See ``record``.

    Args:
        source: as there.
        bench: as there.
        sink: where it goes.
        report: what is written down as it happens.
        selection: which datagrams; ready for the bench.
        clock: as there.
        duration_ns: as there.
        count: as there.
        watcher: as there.
        tap: as there.
        by_route: as there.

    Raises:
        CaptureError: the sink cannot be written.
    """
    began = flushed = clock()
    unflushed = 0
    try:
        with interruptible(source) as (batches, asked):
            for batch in _until_failure(batches, report):
                if len(batch):
                    columns = bench.columns.decode(batch)
                    chosen, columns = selection.apply(batch, columns, bench.mission)
                    if count and report.ledger.datagrams + len(chosen) > count:
                        keep = slice(0, count - report.ledger.datagrams)
                        chosen, columns = chosen.take(keep), columns.take(keep)
                    sink.write(chosen, columns)
                    unflushed += int(chosen.frame_length.sum())
                    if by_route:
                        report.ledger.add(chosen, columns)
                    else:
                        report.ledger.tally(chosen)
                    if tap is not None:
                        tap(chosen, columns)
                now = clock()
                if now - flushed >= _FLUSH_NS:
                    if unflushed < _SWIFT:
                        sink.flush()
                    flushed, unflushed = now, 0
                if watcher is not None:
                    watcher.update(report)
                full = bool(count) and report.ledger.datagrams >= count
                if full or (duration_ns and now - began >= duration_ns):
                    break
            report.interrupted = asked.is_set()
    finally:
        source.close()
        sink.close(source.statistics)


def _until_failure(batches: Iterator[PacketBatch], report: Report) -> Iterator[PacketBatch]:
    """Yield batches; a source that ends early ends them, and the report says why."""
    try:
        yield from batches
    except CaptureError as error:
        report.failure = error

"""Several captures of one system as one: clocks are aligned, and common datagrams are counted once."""

from __future__ import annotations

import gc
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, suppress
from typing import TYPE_CHECKING, Final

import numpy as np
from msgspec.structs import replace

from edoras_tools.cfs.time_services import START_S
from edoras_tools.diagnosis.evidence.clocks import alignment
from edoras_tools.diagnosis.evidence.clocks.lines import ClockLine
from edoras_tools.diagnosis.evidence.table import Recorder
from edoras_tools.errors import CaptureError
from edoras_tools.io import Source, SourceOver
from edoras_tools.io.formats.merge import SEAM_NS, MergedSource, merge_sources
from edoras_tools.io.formats.open import is_cfe_file, open_file
from edoras_tools.pipelines.reading import APART_NS
from edoras_tools.units import SECOND
from edoras_tools.wire import cfe
from edoras_tools.wire.cfe import RESET_LOG

if TYPE_CHECKING:
    from pathlib import Path

    from edoras_tools.model import Endpoint, HostCounters, PacketBatch
    from edoras_tools.pipelines.workbench import Settings
    from edoras_tools.render.terminal.text import Progress
    from edoras_tools.sessions.faults.rules import Fault
    from edoras_tools.wire.arrays import Integers

_LEAST: Final = 3
_MOST: Final = 1_000_000
"""Datagrams of each capture that are used to find the offset of its clock."""


class Aligned(SourceOver):
    """A source with corrected times, without the frames that another source also has.

    Args:
        lines: clock corrections to apply in order, the last of them to the first capture's clock.
        left_out: i64 (n,), numbers of frames that are left out, increasing.
    """

    def __init__(self, source: Source, lines: Sequence[ClockLine], left_out: Integers) -> None:
        super().__init__(source)
        self._lines = lines
        self._left_out = left_out

    def faults(self) -> list[Fault]:
        """Return the faults that were injected, with corrected times."""
        faults = super().faults()
        times = _set_back(self._lines, np.array([fault.time_ns for fault in faults], np.int64))
        return [fault._replace(time_ns=at) for fault, at in zip(faults, times.tolist(), strict=True)]

    def narrow(self, period: Callable[[int], tuple[int, int]]) -> None:
        """Skip nothing: the period is in corrected times, and the file has uncorrected ones."""

    def batches(self) -> Iterator[PacketBatch]:
        """Yield the remaining datagrams, with corrected times."""
        for batch in self._source.batches():
            moved = replace(batch, time_ns=_set_back(self._lines, batch.time_ns))
            yield moved.take(~np.isin(batch.number, self._left_out)) if len(self._left_out) else moved


class OneByOne(MergedSource):
    """Sources with clocks that cannot be aligned, read one after the other.

    The order of events between two of them is not known: each must be judged on its own.

    Args:
        sources: at least one.

    Attributes:
        part: index of the source of the last batch.
    """

    part = 0

    def host(self) -> list[HostCounters]:
        """Return no host counters: they are valid on one clock only."""
        return []

    def batches(self) -> Iterator[PacketBatch]:
        """Yield all datagrams of the first, then those of the second, and so on, numbered from 1."""
        number = 1
        for part, source in enumerate(self._sources):
            self.part, self._origin = part, np.array([part])
            for batch in source.batches():
                yield replace(batch, number=np.arange(number, number + len(batch)))
                number += len(batch)


def open_aligned(
    paths: Sequence[Path], settings: Settings, progress: Progress | None = None
) -> tuple[Source, list[str]]:
    """Open several captures as one, with clocks aligned to the first; return it, and notes on the clocks.

    Captures are aligned in order of time, starting with the first path. A capture that continues where
    another one ended is aligned to that one, else to the first or to another one that shares packets or
    times with it.

    Args:
        progress: shows the progress of reading the clocks and comparing them.

    Raises:
        CaptureError: one cannot be read.
        ConfigError: a mission file has mistakes.
    """
    kinds = {path: is_cfe_file(path) and 1 + _holds_resets(path) for path in paths}
    paths = sorted(paths, key=kinds.__getitem__)  # files of cFE last: they need the clocks of captures
    tables = [_recorded(path, settings, progress) for path in paths]
    sources = {0: open_file(paths[0])}
    alone: list[Source] = []
    notes = []
    set_back: dict[int, list[ClockLine]] = {0: []}
    astray: list[tuple[int, int, bool]] = []
    gaps_ns = [max(0, _gap_ns(tables[0], table)) for table in tables]
    for at in sorted(range(1, len(paths)), key=lambda at: (kinds[paths[at]], gaps_ns[at])):
        path, table = paths[at], tables[at]
        if progress is not None:
            progress.step("aligning clocks", len(sources), len(paths))
        if kinds[path] > 1:
            sources[at], note = _placed(path, paths, tables, set_back)
            notes.append(note)
            continue
        to, shift = _nearest(path, tables, at, set_back)
        if shift is None:
            if is_cfe_file(path):
                sources[at], name = _of_cfe(path)
                most = max(len(alignment.boot_offsets(tables[other], name)) for other in set_back)
                notes.append(_not_placed(path, name, most))
                continue
            if gaps_ns[at] or _on_one_loopback(tables[0], table):
                set_back[at], sources[at] = [], open_file(path)
                notes += [f"{path}: its clock is assumed to be that of {paths[0]}"] * (not gaps_ns[at])
                continue
            alone.append(open_file(path))
            notes.append(
                f"{path}: its clock cannot be compared with that of {paths[0]}: it is judged on its own, and "
                "no loss is concluded from the order of events between the two"
            )
            continue
        is_one_clock = not is_cfe_file(path) and _is_one_clock(tables[to], table, shift)
        set_back[at] = set_back[to] if is_one_clock else [shift.line, *set_back[to]]
        # Of each datagram in both, that of the first counts, or what the network has made of it.
        before, after = shift.changed
        sources[at] = Aligned(open_file(path), set_back[at], np.setdiff1d(shift.shared, after))
        if len(before):
            sources[to] = Aligned(sources[to], [], np.sort(before))
        sources[0].statistics.shared += len(shift.shared)
        for side, (places, sure) in zip(
            (to, at), alignment.lost_between(tables[to], table, shift), strict=True
        ):
            rows = tables[side].rows.take(places)
            times_ns = _set_back(set_back[side], rows.time_ns).tolist()
            own = zip(times_ns, rows.bytes_print.tolist(), strict=True)
            astray += [(when, value, sure) for when, value in own]
        if not is_one_clock:
            some = f"; {len(shift.shared):,} datagrams are in both, counted once" if len(shift.shared) else ""
            notes.append(f"{path}: its clock is {shift.sentence(str(paths[to]))}{some}")
    sources[0].statistics.astray += astray
    sources[0].statistics.begins += _begins({at: tables[at] for at in set_back}, set_back)
    merged = merge_sources([sources[at] for at in sorted(sources)])
    return OneByOne([merged, *alone]) if alone else merged, notes


def _set_back(lines: Sequence[ClockLine], time_ns: Integers) -> Integers:
    for line in lines:
        time_ns = line.set_back(time_ns)
    return time_ns


def _begins(
    tables: Mapping[int, alignment.Side], set_back: Mapping[int, list[ClockLine]]
) -> Iterator[tuple[Endpoint, Endpoint, int]]:
    """Yield the conversations that begin with a later capture, and when that begins, ns.

    A capture that ended by then may have been continued by that one: it would have had the conversation, too.
    """
    spans = {at: _set_back(set_back[at], np.array(table.span)).tolist() for at, table in tables.items()}
    for way in set[tuple["Endpoint", "Endpoint"]]().union(*(table.ways for table in tables.values())):
        begin_ns = min(spans[at][0] for at, table in tables.items() if way in table.ways)
        for start_ns, end_ns in sorted(spans.values(), reverse=True):
            begin_ns = min(begin_ns, start_ns) if end_ns <= begin_ns else begin_ns
        if begin_ns > min(spans.values())[0]:
            yield *way, begin_ns


def _nearest(
    path: Path, tables: Sequence[alignment.Side], at: int, aligned: Iterable[int]
) -> tuple[int, alignment.Alignment | None]:
    """Return the best aligned capture, and the alignment of another capture to it; None if none fits."""

    def fits(others: Iterable[int]) -> Iterator[tuple[int, alignment.Alignment]]:
        for other in others:
            shift = alignment.align(tables[other], tables[at])
            if shift and (is_cfe_file(path) or not _of_two_runs(tables[other], tables[at], shift)):
                yield other, shift

    gaps_ns = {other: _gap_ns(tables[other], tables[at]) for other in aligned}
    to, shift = next(fits(sorted(gaps_ns, key=lambda other: abs(gaps_ns[other]) >= SEAM_NS)), (0, None))
    if shift is not None and not len(shift.shared):  # packets in both captures give a better alignment
        beside = (other for other, gap_ns in gaps_ns.items() if other != to and gap_ns <= 0)
        return next((fit for fit in fits(beside) if len(fit[1].shared)), (to, shift))
    return to, shift


def _holds_resets(path: Path) -> bool:
    """Return whether a cFE file is a reset log."""
    with closing(open_file(path)) as source:
        return bool(source.header["subtype"] == RESET_LOG)


def _placed(
    path: Path, paths: Sequence[Path], tables: Sequence[alignment.Side], set_back: dict[int, list[ClockLine]]
) -> tuple[Source, str]:
    """Put a reset log on the clock of the first capture that shows one boot of its cFS; return a note too."""
    source, name = _of_cfe(path)
    most = 0
    for to, lines in set_back.items():
        offsets = alignment.boot_offsets(tables[to], name)
        most = max(most, len(offsets))
        if len(offsets) == 1:
            line = ClockLine(0, cfe.EPOCH_S * SECOND - offsets[0])
            by = f"the mission time of cFS {name}, to within half a second"
            note = (
                f"{path}: its entries are put on the clock of {paths[to]} by {by}; those made while cFE "
                f"started, before that time began, at {START_S} s of it"
            )
            return Aligned(source, [line, *lines], np.zeros(0, np.int64)), note
    return source, _not_placed(path, name, most)


def _of_cfe(path: Path) -> tuple[Source, str]:
    """Open a cFE file; return it with the name of its cFS."""
    source = open_file(path)
    return source, f"{source.header['spacecraft_id']}:{source.header['processor_id']}"


def _not_placed(path: Path, name: str, boots: int) -> str:
    """Return why a file is on the clock of no capture; ``boots``: most boots of its cFS in one capture."""
    if boots > 1:
        why = f"its cFS {name} was started {boots} times there, which fit equally"
    elif boots:
        why = f"nothing tells at which time of its cFS {name} it was made"
    else:
        why = f"no packet of its cFS {name} with a time is there"
    return f"{path}: not placed, its mission times are kept: {why}; 'edoras info {path}' shows it alone"


def _recorded(path: Path, settings: Settings, progress: Progress | None) -> alignment.Side:
    gc.collect(0)  # free the previous decoder, whose objects refer to each other: 1.5 MB
    with closing(open_file(path)) as source:
        bench = settings.workbench(source.info)
        recorder = Recorder(bench.columns.context)
        source.follow(bench.columns.context.framings)
        for batch in _readable(source):
            if len(batch):
                recorder.add(batch, bench.columns.decode(batch))
            if progress is not None:
                progress.read(source)
            if len(recorder) >= _MOST:
                break
    return alignment.Side(recorder)


def _readable(source: Source) -> Iterator[PacketBatch]:
    """Yield batches until an error; the error is reported when the file is judged."""
    with suppress(CaptureError):
        yield from source.batches()


def _is_one_clock(first: alignment.Side, second: alignment.Side, shift: alignment.Alignment) -> bool:
    """Return whether two captures have the same clock, whatever was measured.

    One of these is true:

    - One capture continues the other, as files that are written in turn do: its own times begin soon after
    the
      end of the other; or no difference of the clocks is certain; or only mission times differ, by more than
      clocks can: cFS was restarted.
    - Both are of the same host, and packets wait longer than the measured difference of the clocks.
    """
    gap_ns, may_be = _gap_ns(first, second), shift.low_ns <= 0 <= shift.high_ns
    if gap_ns < 0:
        return may_be and abs(shift.line.offset_ns) < alignment.HANDED_NS and _on_one_loopback(first, second)
    is_restart = shift.by == alignment.MISSION_TIME and abs(shift.line.offset_ns) > APART_NS
    return gap_ns < SEAM_NS or may_be or is_restart


def _of_two_runs(first: alignment.Side, second: alignment.Side, shift: alignment.Alignment) -> bool:
    """Return whether two captures are similar but of different runs, as the same commands sent twice.

    By their own clocks they do not overlap; by their common data they would overlap. The common data are the
    mission times of one boot, or packets without an IP identification that would distinguish them.
    """
    a, b = first.rows, second.rows
    same = np.isin(b.number, shift.shared)
    # In a capture that continues the other, mission time may only have run slower.
    near_ns = SEAM_NS * (not len(shift.shared))
    if (b.identification[same] != 0).sum() >= _LEAST or _gap_ns(first, second) <= near_ns:
        return False
    timed = all((rows.mission_time_ns > 0).any() for rows in (a, b))
    return (timed or bool(same.any())) and _gap_ns(first, second, shift.line) <= 0


def _on_one_loopback(first: alignment.Side, second: alignment.Side) -> bool:
    """Return whether two captures are of different conversations on loopback, so of one clock."""
    return bool(first.local and second.local) and first.local.isdisjoint(second.local)


def _gap_ns(first: alignment.Side, second: alignment.Side, line: ClockLine | None = None) -> int:
    """Return the time from the end of one of two captures to the begin of the other, ns.

    It is negative if they overlap. With a line, the second capture's times are corrected by it first.
    """
    (start, end), own = first.span, second.span
    begin, stop = own if line is None else line.set_back(np.array(own)).tolist()
    return max(begin - end, start - stop)

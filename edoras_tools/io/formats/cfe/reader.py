"""Reads the dated contents of cFE files: packets of event logs and Data Storage, entries of reset logs.

Each becomes a datagram without addresses; its time is its mission time, and a command has the time of the
packet before it. When they are read with a capture, they are aligned to its clock.

An entry that cFE makes while it starts has no mission time, which has not begun yet: its stamp is the
processor's own clock. The first such entry of a power-on gets the time at which mission time begins, others
get the time of the entry before them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import numpy as np

from edoras_tools.cfs.time_services import START_S
from edoras_tools.errors import CaptureError
from edoras_tools.io.formats.records import RecordSource
from edoras_tools.io.frames.build import FramePage, ends_of
from edoras_tools.io.frames.chain import walk_records
from edoras_tools.links.table import STORED
from edoras_tools.model import Endpoint, SourceInfo
from edoras_tools.units import SECOND
from edoras_tools.wire import ccsds, cfe, cfe_file
from edoras_tools.wire.arrays.window import gather
from edoras_tools.wire.cfe_file import FILE_HEADER, ON_TIME_LINE, RESET_ENTRY, kind_of

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from edoras_tools.io.formats.stream import Window
    from edoras_tools.io.frames.frame_batch import FrameBatch
    from edoras_tools.wire.arrays.order import Integers, Octets, Places

_ENDS: Final = ends_of(Endpoint("0.0.0.0", 0), Endpoint("0.0.0.0", STORED.transport.ports[0]))  # noqa: S104


class CfePacketSource(RecordSource):
    """The packets of an event log, or of a file of Data Storage; the entries of a reset log.

    Attributes:
        header: the fields of ``FILE_HEADER``.
    """

    unit = "packet"
    header: Mapping[str, Any] = {}

    def __init__(self, window: Window) -> None:
        """Read the file header.

        Args:
            window: the file from its first byte on.

        Raises:
            CaptureError: the header is incomplete, or no packets follow it.
        """
        super().__init__(window)
        name = window.stream.name
        while window.end < FILE_HEADER.size and window.advance(0):
            pass
        if window.end < FILE_HEADER.size:
            raise CaptureError(
                f"{name}: ends inside the cFE file header, at byte {window.end} of {FILE_HEADER.size}"
            )
        self.header = FILE_HEADER.parse(window.data[: FILE_HEADER.size].tobytes())
        subtype = self.header["subtype"]
        kind = kind_of(subtype)
        if subtype not in ON_TIME_LINE:
            raise CaptureError(
                f"{name}: is a cFE {kind}, which has no packets; 'edoras info {name}' shows what is in it"
            )
        if subtype == cfe_file.RESET_LOG:
            self.unit = "entry"
        self._at = cfe_file.OF_PACKETS.get(subtype, FILE_HEADER.size)
        self._info = SourceInfo(name, f"cFE {kind}")
        self._time_ns = (cfe.EPOCH_S + self.header["seconds"]) * SECOND
        self._clock_at = 0
        while window.end < self._at and window.advance(0):
            pass
        if window.end < self._at:
            raise CaptureError(
                f"{name}: ends inside Data Storage's header, at byte {window.end} of {self._at}"
            )

    def _frames(self) -> Iterator[FrameBatch]:
        window = self._window
        data, start, end = window.data, self._at, window.end
        if self.header["subtype"] == cfe_file.RESET_LOG:
            yield from self._entries(data, start, end)
            return

        def successor(positions: Integers) -> Integers:
            header = gather(data, positions, ccsds.PRIMARY.size)
            after: Integers = positions + ccsds.PRIMARY.size + 1
            after += ccsds.PRIMARY.column("packet_data_length", header)
            return after

        def step(position: int) -> int:
            return int(successor(np.array([position]))[0])

        positions, self._at = walk_records(start, end, np.empty(0, np.int64), successor, step)
        if len(positions):
            page = FramePage(len(positions), end - start)
            length = np.diff(np.append(positions, self._at))
            page.add(data, positions, length, self._times(data, positions), _ENDS)
            yield page.frames(self.statistics.frames + 1)

    def _entries(self, data: Octets, start: int, end: int) -> Iterator[FrameBatch]:
        """Yield the used entries of a reset log, oldest first."""
        positions = np.arange(start, end - RESET_ENTRY.size + 1, RESET_ENTRY.size)
        self._at = start + len(positions) * RESET_ENTRY.size
        rows = gather(data, positions, RESET_ENTRY.size)
        used = np.flatnonzero(RESET_ENTRY.column("entry_type", rows) > 0)
        if not len(used):
            return
        time_ns, order = reset_times(rows[used])
        positions, length = positions[used][order], np.full(len(used), RESET_ENTRY.size)
        page = FramePage(len(used), end - start)
        page.add(data, positions, length, time_ns[order], _ENDS)
        yield page.frames(self.statistics.frames + 1)

    def _times(self, data: Octets, positions: Integers) -> Integers:
        """Return the mission time of each packet as ns since 1970: i64 (n,)."""
        window = gather(data, positions, ccsds.PRIMARY.size + cfe.EXTENDED.size + cfe.TELEMETRY.size)
        if not self._clock_at:
            self._clock_at = self._where_time_is(window)
        telemetry = ccsds.PRIMARY.column("packet_type", window) == 0
        seconds, subseconds = (
            cfe.TELEMETRY.column(name, window, self._clock_at).astype(np.int64)
            for name in ("seconds", "subseconds")
        )
        time_ns = (cfe.EPOCH_S + seconds) * SECOND + subseconds * SECOND // 65536
        latest = np.maximum.accumulate(np.where(telemetry, np.arange(len(time_ns)), -1))
        time_ns = np.where(latest < 0, self._time_ns, time_ns[latest])
        self._time_ns = int(time_ns[-1])
        return time_ns

    def _where_time_is(self, window: Octets) -> int:
        """Return the offset of the time: of two candidates, the one nearer to the file header's time."""
        usual = ccsds.PRIMARY.size
        seconds = [
            cfe.TELEMETRY.column("seconds", window, at).astype(np.int64)
            for at in (usual, usual + cfe.EXTENDED.size)
        ]
        away = [np.abs(item - self.header["seconds"]).min() for item in seconds]
        return usual if away[0] <= away[1] else usual + cfe.EXTENDED.size


def reset_times(rows: Octets) -> tuple[Integers, Places]:
    """Return the time of each entry of a reset log, and the order in which the entries were made.

    The log is a ring: where mission time decreases from one entry to the next, the oldest entry follows.

    Args:
        rows: the entries, (n, ``RESET_ENTRY.size``) u8, in the file's order.

    Returns:
        Mission time as ns since 1970, i64 (n,); indices of the entries, oldest first.
    """
    core, power_on, subtype, seconds, subseconds = (
        RESET_ENTRY.column(name, rows).astype(np.int64)
        for name in ("entry_type", "reset_type", "reset_subtype", "seconds", "subseconds")
    )
    stamped = (core != 1) | np.isin(subtype, (cfe_file.RESET_COMMAND, cfe_file.EXCEPTION))
    begin = START_S * SECOND
    times = seconds * SECOND + (subseconds * SECOND >> 32)
    times = np.where(stamped, times, np.where(power_on == 2, begin, -1))
    dated = np.flatnonzero(times >= 0)
    falls = dated[1:][np.diff(times[dated]) < 0]
    order = np.roll(np.arange(len(rows)), -int(falls[0]) if len(falls) else 0)
    latest = np.maximum.accumulate(times[order])
    time_ns = np.empty(len(rows), np.int64)
    time_ns[order] = cfe.EPOCH_S * SECOND + np.where(latest < 0, begin, latest)
    return time_ns, order

"""An example of a format and a command: the radio modem's own log, and who heard the modem how well.

The log is made up, as the modem is. It begins with 8 bytes; then each datagram follows a head of 16 bytes:
time in ns since 1970, source port, destination port, length, 2 bytes of zeros, all big-endian. Addresses are
not kept.
"""

from __future__ import annotations

from pathlib import Path  # noqa: TC003  typer evaluates annotations at run time
from typing import TYPE_CHECKING, Annotated, Any, Final

import numpy as np
import typer
from edoras_radio_state import RadioFrames

from edoras_tools.io.formats.capture_file import CaptureFileSink, RecordSource
from edoras_tools.io.formats.open import open_file
from edoras_tools.io.formats.table import Format
from edoras_tools.io.frames.frame_batch import ENDS, FramePage, walk_records
from edoras_tools.model import SourceInfo
from edoras_tools.pipelines.workbench import Settings
from edoras_tools.wire.arrays import copy_rows, gather, put_rows

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from edoras_tools.io.formats.capture_file import Window
    from edoras_tools.io.frames.frame_batch import FrameBatch
    from edoras_tools.model import PacketBatch, SourceStatistics

MAGIC: Final = b"RADIOLOG"
HEAD: Final = np.dtype(
    [
        ("time_ns", ">i8"),
        ("source_port", ">u2"),
        ("destination_port", ">u2"),
        ("length", ">u2"),
        ("zeros", ">u2"),
    ]
)

LOG: Final = Format(
    "radio log",
    ".radiolog",
    f"{__name__}:RadioLogSource",
    f"{__name__}:RadioLogSink",
    magic=MAGIC,
)


class RadioLogSource(RecordSource):
    """The datagrams of a log."""

    def __init__(self, window: Window) -> None:
        super().__init__(window)
        self._at = len(MAGIC)
        self._info = SourceInfo(window.stream.name, LOG.name)

    def _frames(self) -> Iterator[FrameBatch]:
        data, start, end = self._window.data, self._at, self._window.end

        def successor(positions: NDArray[np.int64]) -> NDArray[np.int64]:
            after: NDArray[np.int64] = positions + HEAD.itemsize
            after += _heads(data, positions)["length"]
            return after

        def step(position: int) -> int:
            return int(successor(np.array([position]))[0])

        positions, self._at = walk_records(start, end, np.empty(0, np.int64), successor, step)
        if len(positions):
            heads = _heads(data, positions)
            ends = np.zeros(len(heads), ENDS)
            ends["version"] = 4
            for name in ("source_port", "destination_port"):
                ends[name] = heads[name]
            page = FramePage(len(heads), end - start)
            times = heads["time_ns"].astype(np.int64)
            page.add(data, positions + HEAD.itemsize, heads["length"].astype(np.int64), times, ends)
            yield page.frames(self.statistics.frames + 1)


class RadioLogSink(CaptureFileSink):
    """Writes datagrams to a log."""

    head = len(MAGIC)
    overhead = HEAD.itemsize

    def __init__(self, path_or_file: Any, *, nanosecond: bool = True, snap_length: int = 0) -> None:
        del nanosecond, snap_length  # of a log all times are in ns, and all datagrams whole
        super().__init__(path_or_file)
        self._put(MAGIC)

    def _lay_out(self, batch: PacketBatch) -> NDArray[np.uint8]:
        heads = np.zeros(len(batch), HEAD)
        for name in ("time_ns", "source_port", "destination_port", "length"):
            heads[name] = getattr(batch, name)
        sizes = batch.length.astype(np.int64) + HEAD.itemsize
        starts = np.cumsum(sizes) - sizes
        out = np.empty(int(sizes.sum()), np.uint8)
        put_rows(out, starts, heads)
        copy_rows(out, starts + HEAD.itemsize, batch.data, batch.offset, batch.length)
        return out

    def _finish(self, statistics: SourceStatistics | None) -> None:
        del statistics  # a log does not tell what was lost


def radio(file: Annotated[Path, typer.Argument(metavar="FILE", help="A capture or a recording.")]) -> None:
    """Show which ground stations heard the modem, and how well."""
    follower = RadioFrames()
    source, decoder = open_file(file), Settings().workbench().columns
    for batch in source.batches():
        follower.add(batch, decoder.decode(batch))
    for number, item in sorted(follower.stations.items()):
        signal, lost = f"{item.weakest} to {item.strongest} dBm", f"{item.lost:,} lost"
        typer.echo(f"station {number}  {item.frames:,} datagrams  {signal}  {lost}")


def _heads(data: NDArray[np.uint8], positions: NDArray[np.int64]) -> NDArray[Any]:
    """Return the heads at some positions, of which those behind the last record are not whole."""
    heads: NDArray[Any] = gather(data, positions, HEAD.itemsize).view(HEAD)[:, 0]
    return heads

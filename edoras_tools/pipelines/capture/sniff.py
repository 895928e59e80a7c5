"""Single packets from a source, in order, for people and for JSON."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from edoras_tools.decode.lines import PacketLines
from edoras_tools.errors import CaptureError
from edoras_tools.io.formats.merge import follow_streams
from edoras_tools.pipelines.capture.packet_json import PacketTexts
from edoras_tools.pipelines.reading import Limits, reading

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from edoras_tools.decode.filters.rows import ColumnRows
    from edoras_tools.decode.lines import PacketLine
    from edoras_tools.io import Source
    from edoras_tools.model import Decoded
    from edoras_tools.pipelines.selection import Selection
    from edoras_tools.pipelines.workbench import Workbench

_AT_ONCE: Final = 8192


def sniff(
    source: Source,
    bench: Workbench,
    selection: Selection,
    limits: Limits = Limits(),  # noqa: B008  frozen
    started: Callable[[int], None] = lambda _: None,
) -> Iterator[Decoded]:
    """Yield the selected packets of a source, decoded; the source is closed at the end.

    Args:
        started: called before each batch with the time of the source's first datagram, ns since 1970.

    Raises:
        CaptureError: the source ended early; everything before was yielded.
        RouteError: the selection names a topic that is not configured.
        ConfigError: its filter has an error.
    """
    for rows in _selected(source, bench, selection, limits, started):
        for row in rows.indices().tolist():
            yield bench.dissector.dissect(rows.batch[row])


def lines(
    source: Source,
    bench: Workbench,
    selection: Selection,
    limits: Limits = Limits(),  # noqa: B008  frozen
    started: Callable[[int], None] = lambda _: None,
) -> Iterator[list[PacketLine]]:
    """Yield what a line shows of each selected packet, many at once; all else as ``sniff``."""
    made = PacketLines(bench.columns.context)
    for rows in _selected(source, bench, selection, limits, started):
        yield list(made.of(rows))


def _selected(
    source: Source,
    bench: Workbench,
    selection: Selection,
    limits: Limits,
    started: Callable[[int], None],
) -> Iterator[ColumnRows]:
    """Yield the selected rows, some thousands at most, so that Ctrl-C ends it soon."""
    with reading(source, bench, selection, limits, conversing=True) as loop:
        try:
            for rows in loop:
                started(rows.begin_ns)
                for first in range(0, len(rows), _AT_ONCE):
                    if loop.gives_up(len(rows) - first):
                        return
                    yield rows.take(np.arange(first, min(first + _AT_ONCE, len(rows))))
        finally:
            loop.note()


def packet_texts(
    source: Source,
    bench: Workbench,
    selection: Selection,
    limits: Limits = Limits(),  # noqa: B008  frozen
    started: Callable[[int], None] = lambda _: None,
) -> Iterator[list[str]]:
    """Yield the JSON text of each selected packet, many at once; all else as ``sniff``."""
    made = PacketTexts(bench.columns.context)
    for rows in _selected(source, bench, selection, limits, started):
        yield made.of(rows)


def decode_packet(source: Source, bench: Workbench, number: int) -> Decoded:
    """Return one packet; everything before it is decoded first, because decoding keeps state.

    Args:
        number: the frame's number, from 1, as ``sniff`` and Wireshark show it.

    Raises:
        CaptureError: there is no such datagram.
    """
    last = 0
    follow_streams(source, bench.columns.context.framings)
    try:
        for batch in source.batches():
            bench.columns.decode(batch)
            rows = (batch.number == number).nonzero()[0]
            if len(rows):
                return bench.dissector.dissect(batch[int(rows[0])])
            last = int(batch.number[-1]) if len(batch) else last
            if last > number:
                break
    finally:
        source.close()
    word, unit = ("message", "message") if bench.mission.recorded else ("packet", "datagram")
    what = "is not a UDP datagram" if number <= last else f"does not exist: the last {unit} is number {last}"
    raise CaptureError(f"{source.info.name}: {word} {number} {what}")

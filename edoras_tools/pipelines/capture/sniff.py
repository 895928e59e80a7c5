"""Single packets from a source, in order, for people and for JSON."""

from __future__ import annotations

from contextlib import closing
from typing import TYPE_CHECKING, Final

from edoras_tools.errors import CaptureError
from edoras_tools.pipelines.reading import Limits, selected_rows

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from edoras_tools.io import Source
    from edoras_tools.model import Decoded
    from edoras_tools.pipelines.selection import Selection
    from edoras_tools.pipelines.workbench import Workbench

AT_ONCE: Final = 8192
"""Largest number of packets that are shown at once."""


def sniff(
    source: Source,
    bench: Workbench,
    selection: Selection,
    limits: Limits = Limits(),  # noqa: B008  frozen
    started: Callable[[int], None] = lambda _: None,
) -> Iterator[Decoded]:
    """Yield the selected packets of a source, decoded; see ``selected_rows``."""
    for rows in selected_rows(source, bench, selection, limits, started, most=AT_ONCE):
        for row in rows.indices().tolist():
            yield bench.dissector.dissect(rows.batch[row])


def decode_packet(source: Source, bench: Workbench, number: int) -> Decoded:
    """Return one packet; everything before it is decoded first, because decoding keeps state.

    Args:
        number: the frame's number, from 1, as ``sniff`` and Wireshark show it.

    Raises:
        CaptureError: there is no such datagram.
    """
    last = 0
    source.follow(bench.columns.context.framings)
    with closing(source):
        for batch in source.batches():
            bench.columns.decode(batch)
            rows = (batch.number == number).nonzero()[0]
            if len(rows):
                return bench.dissector.dissect(batch[int(rows[0])])
            last = int(batch.number[-1]) if len(batch) else last
            if last > number:
                break
    word, unit = ("message", "message") if bench.mission.recorded else ("packet", "datagram")
    problem = (
        "is not a UDP datagram" if number <= last else f"does not exist: the last {unit} is number {last}"
    )
    raise CaptureError(f"{source.info.name}: {word} {number} {problem}")

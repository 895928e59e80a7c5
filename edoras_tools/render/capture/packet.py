"""One packet in full: tree and bytes, side by side where the terminal is wide enough."""

from __future__ import annotations

from itertools import zip_longest
from typing import Final

from edoras_tools.model import NO_ROUTE, Decoded
from edoras_tools.render.capture import hexdump, tree
from edoras_tools.render.terminal import palette
from edoras_tools.render.terminal.terminal import FILE_WIDTH
from edoras_tools.render.terminal.text import plain_cells

SIDE_BY_SIDE: Final = 140
"""Width from which the tree and the bytes are shown side by side."""
_GAP: Final = 3


def packet_lines(
    decoded: Decoded, width: int, *, colour: bool, highlight: str = "", base: hexdump.Base = "payload"
) -> list[str]:
    """Return a packet's tree, its bytes, and the legend of their layers.

    Args:
        width: cells that no line exceeds, at least 44.
        colour: whether to use ANSI styles.
        highlight: a layer or ``LAYER.FIELD`` to highlight in the bytes; empty for none.
        base: dump the payload, or the whole frame.

    Raises:
        ConfigError: the packet has no such layer or field.
    """
    paint = palette.Paint(colour)
    if width < SIDE_BY_SIDE:
        return [*tree.tree_lines(decoded, width, paint), "", *_bytes(decoded, width, paint, highlight, base)]
    room = width - hexdump.DUMP_WIDTH - _GAP
    tree_part = tree.tree_lines(decoded, room, paint)
    if width >= FILE_WIDTH:
        room = max(map(plain_cells, tree_part))
    right = _bytes(decoded, hexdump.DUMP_WIDTH, paint, highlight, base)
    return [
        f"{a}{' ' * (room + _GAP - plain_cells(a))}{b}" if b else a
        for a, b in zip_longest(tree_part, right, fillvalue="")
    ]


def _bytes(
    decoded: Decoded, width: int, paint: palette.Paint, highlight: str, base: hexdump.Base
) -> list[str]:
    datagram = decoded.datagram
    data = datagram.payload if base == "payload" else datagram.frame
    coloured = hexdump.regions(decoded, base)
    span = None
    if highlight:
        shift = 0 if base == "payload" else datagram.payload_offset
        start, end = hexdump.choose(decoded, highlight)
        # A payload reassembled from fragments is not in a single frame.
        span = (start + shift, end + shift) if shift >= 0 else None
    content = "TCP message" if datagram.stream else "UDP payload"
    if datagram.topic != NO_ROUTE:
        content = "Message"
    title = content if base == "payload" else "Frame"
    pointed = f", {highlight} at {span[0]}-{span[1] - 1}" if span and span[1] > span[0] else ""
    head = paint(f"{title}, {len(data):,} bytes{pointed}", palette.STRONG)
    return [
        head,
        *hexdump.dump_lines(data, coloured, width, paint, highlight=span),
        *hexdump.legend(coloured, width, paint),
    ]

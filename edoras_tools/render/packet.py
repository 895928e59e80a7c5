"""One packet whole: its tree and its bytes, side by side where the terminal is wide enough."""

from __future__ import annotations

from itertools import zip_longest
from typing import TYPE_CHECKING, Final

from edoras_tools.render import hexdump, palette, tree
from edoras_tools.render.text import plain_cells

if TYPE_CHECKING:
    from edoras_tools.model import Decoded

SIDE_BY_SIDE: Final = 140
"""Width from which the tree and the bytes stand beside each other."""
_GAP: Final = 3


def lines(
    decoded: Decoded, width: int, *, colour: bool, chosen: str = "", base: hexdump.Base = "payload"
) -> list[str]:
    """Return a packet's tree, its bytes and which of them are which layer.

    Args:
        decoded: the packet.
        width: cells that no line exceeds, at least 44.
        colour: whether to use ANSI styles.
        chosen: a layer or ``LAYER.FIELD`` to point at in the bytes; nothing points at nothing.
        base: dump the UDP payload, or the whole frame.

    Raises:
        ConfigError: the packet holds no such layer or field.
    """
    paint = palette.Paint(colour)
    if width < SIDE_BY_SIDE:
        return [*tree.lines(decoded, width, paint), "", *_bytes(decoded, width, paint, chosen, base)]
    room = width - hexdump.WIDTH - _GAP
    left = tree.lines(decoded, room, paint)
    right = _bytes(decoded, hexdump.WIDTH, paint, chosen, base)
    return [
        f"{a}{' ' * (room + _GAP - plain_cells(a))}{b}" if b else a
        for a, b in zip_longest(left, right, fillvalue="")
    ]


def _bytes(decoded: Decoded, width: int, paint: palette.Paint, chosen: str, base: hexdump.Base) -> list[str]:
    datagram = decoded.datagram
    data = datagram.payload if base == "payload" else datagram.frame
    shown = hexdump.regions(decoded, base)
    span = None
    if chosen:
        shift = 0 if base == "payload" else datagram.payload_offset
        start, end = hexdump.choose(decoded, chosen)
        # A payload put together from fragments lies in no one frame.
        span = (start + shift, end + shift) if shift >= 0 else None
    title = "UDP payload" if base == "payload" else "Frame"
    pointed = f", {chosen} at {span[0]}-{span[1] - 1}" if span and span[1] > span[0] else ""
    head = paint(f"{title}, {len(data):,} bytes{pointed}", palette.STRONG)
    return [
        head,
        *hexdump.lines(data, shown, width, paint, chosen=span),
        *hexdump.legend(shown, width, paint),
    ]

"""The bytes of one packet: coloured by layer, one range highlighted."""

from __future__ import annotations

from itertools import groupby
from typing import TYPE_CHECKING, Final, Literal, NamedTuple

from edoras_tools.errors import ConfigError
from edoras_tools.render.terminal import palette
from edoras_tools.render.terminal.text import cells, clean, clip

if TYPE_CHECKING:
    from collections.abc import Sequence

    from edoras_tools.model import Decoded

Base = Literal["payload", "frame"]
DUMP_WIDTH: Final = 75
"""Cells of one line with 16 bytes."""
_ASCII: Final = "".join(chr(octet) if 32 <= octet < 127 else "·" for octet in range(256))


class Region(NamedTuple):
    """Bytes that belong together.

    Attributes:
        name: name of the layer.
        start: first byte, from the start of the dump.
        end: one past the last byte.
        style: rich style.
    """

    name: str
    start: int
    end: int
    style: str


def regions(decoded: Decoded, base: Base = "payload") -> list[Region]:
    """Return the layers of a packet as regions of its payload or its frame, later ones over earlier ones.

    A frame that holds only one fragment of the payload has no regions.
    """
    datagram = decoded.datagram
    shift = 0 if base == "payload" else datagram.payload_offset
    if shift < 0:
        return []
    out = [Region("headers", 0, shift, palette.layer("frame"))] if shift else []
    styles = palette.layers(layer.name for layer in decoded.layers)
    for layer in decoded.layers:
        style = styles[layer.name]
        if out and out[-1].name == layer.name and out[-1].end == layer.start + shift:
            out[-1] = Region(layer.name, out[-1].start, layer.end + shift, style)
        else:
            out.append(Region(layer.name, layer.start + shift, layer.end + shift, style))
    return out


def choose(decoded: Decoded, name: str) -> tuple[int, int]:
    """Return the bytes, from the start of the payload, that a layer or ``LAYER.FIELD`` was read from.

    Args:
        name: name such as ``edoras``, ``ccsds.apid`` or ``ros.pose.position``; a group stands for all its
            fields.

    Raises:
        ConfigError: the packet has no layer or field of that name.
    """
    owner, _, field = name.partition(".")
    layer = decoded.layer(owner)
    if layer is None:
        existing = ", ".join(dict.fromkeys(item.name for item in decoded.layers)) or "no layers"
        raise ConfigError(f"packet {decoded.datagram.number} has no layer {owner!r}; there are {existing}")
    if not field:
        return layer.start, layer.end
    fields = [item for item in layer.fields if item.name == field or item.name.startswith(f"{field}.")]
    if not fields:
        existing = ", ".join(item.name for item in layer.fields) or "no fields"
        raise ConfigError(
            f"layer {owner} of packet {decoded.datagram.number} has no field {field!r}; there are {existing}"
        )
    return min(item.start for item in fields), max(item.end for item in fields)


def dump_lines(
    data: bytes,
    coloured: Sequence[Region],
    width: int,
    paint: palette.Paint,
    *,
    highlight: tuple[int, int] | None = None,
) -> list[str]:
    """Return a dump of bytes: offset, hex, ASCII.

    Args:
        data: the bytes.
        coloured: regions to colour; later ones cover earlier ones.
        width: cells that no line exceeds; from ``DUMP_WIDTH`` on 16 bytes a line, else 8.
        highlight: first byte and one past the last of the highlighted range: in reverse, or in brackets
            without colour.
    """
    per_line = 16 if width >= DUMP_WIDTH else 8
    styles = [palette.DIM] * len(data)
    for item in coloured:
        for at in range(max(0, item.start), min(len(data), item.end)):
            styles[at] = item.style
    first, last = highlight or (0, 0)
    if paint.colour:
        for at in range(max(0, first), min(len(data), last)):
            styles[at] = f"{styles[at]} {palette.CHOSEN}".removeprefix(f"{palette.DIM} ")
    rows = _Rows(data, styles, per_line, paint, (-1, -1) if paint.colour or first >= last else (first, last))
    return [rows.line(at) for at in range(0, len(data), per_line)]


def legend(coloured: Sequence[Region], width: int, paint: palette.Paint) -> list[str]:
    """Return a legend of the layers in their colours, as lines of at most ``width`` cells."""
    out: list[str] = []
    used = width
    for item in (item for item in coloured if item.end > item.start):
        label = clip(f"■ {clean(item.name)} {item.start}-{item.end - 1}", width)
        if used + 3 + cells(label) > width:
            out.append("")
            used = 0
        out[-1] += ("   " if used else "") + paint(label, item.style)
        used += (3 if used else 0) + cells(label)
    return out


class _Rows(NamedTuple):
    """Draws the lines of one dump.

    Attributes:
        data: the bytes.
        styles: style of each byte.
        per_line: bytes in one line.
        paint: painter, with or without colour.
        brackets: first byte and one past the last of the range in brackets.
    """

    data: bytes
    styles: Sequence[str]
    per_line: int
    paint: palette.Paint
    brackets: tuple[int, int]

    def line(self, at: int) -> str:
        """Return the line that begins with byte ``at``."""
        end = min(at + self.per_line, len(self.data))
        octets = text = ""
        for style, run in groupby(range(at, end), key=self.styles.__getitem__):
            places = list(run)
            # The space in front of a run stays plain, so that only the chosen bytes are reversed.
            octets += self._gap(at, places[0]) + self.paint(
                self._hex(places[0])
                + "".join(self._gap(at, place) + self._hex(place) for place in places[1:]),
                style,
            )
            text += self.paint("".join(_ASCII[self.data[place]] for place in places), style)
        missing = self.per_line - (end - at)
        octets += "]" if end == self.brackets[1] else " "
        octets += " " * (3 * missing + (1 if self.per_line == 16 and missing >= 8 else 0))
        digits = 4 if len(self.data) <= 0x10000 else 6
        return f"{self.paint(f'{at:0{digits}x}', palette.DIM)} {octets} {text}"

    def _hex(self, place: int) -> str:
        return f"{self.data[place]:02x}"

    def _gap(self, at: int, place: int) -> str:
        # A bracket that closes at the end of a line stands there, not at the start of the next.
        closes = place == self.brackets[1] and place > at
        bracket = "[" if place == self.brackets[0] else "]" if closes else " "
        return " " + bracket if self.per_line == 16 and place - at == 8 else bracket

"""The tree of one packet: layers, fields, the bytes of each field, and faults; and the packet in full.

In full, tree and bytes stand side by side where the terminal is wide enough.

The bytes are coloured by layer, with one range highlighted.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from itertools import groupby, islice, zip_longest
from typing import Any, Final, Literal, NamedTuple

from edoras_tools import words
from edoras_tools.decode.lines import line_of
from edoras_tools.decode.stack import recorded_topic
from edoras_tools.errors import ConfigError
from edoras_tools.io.frames.linklayer import checksum_fault
from edoras_tools.model import NO_MSG_ID, NO_ROUTE, Decoded, Layer, LayerField
from edoras_tools.render.severity import EXPLANATIONS, Explanation, Level, ranked
from edoras_tools.render.terminal import palette
from edoras_tools.render.terminal.palette import FILE_WIDTH
from edoras_tools.render.terminal.text import ELLIPSIS, cells, clean, clip, fit, fit_right, plain_cells, wrap
from edoras_tools.words import plural

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


_MOST_ITEMS: Final = 64
_MOST_BYTES: Final = 32
_MOST_TEXT: Final = 1024


def field_text(item: LayerField) -> str:
    """Return a field's value: its text if it has one, followed by the plain number in brackets.

    The result is not yet safe for a terminal: see :func:`edoras_tools.render.terminal.text.clean`.
    """
    plain = value_text(item.value)
    if not item.text or item.text == plain or isinstance(item.value, str):
        return plain
    if isinstance(item.value, bytes):
        return plain if item.text == item.value.hex() else item.text
    # A single word is the number in another base; a text of several words already explains the number.
    return f"{item.text} ({plain})" if isinstance(item.value, int) and " " not in item.text else item.text


def value_text(value: Any) -> str:
    """Return a plain value on one line; long lists, bytes and texts are cut, and their length is given."""
    match value:
        case str():
            cut = f'"{value[:_MOST_TEXT]}"'
            return cut if len(value) <= _MOST_TEXT else f"{cut}… ({len(value):,} characters)"
        case bool():
            return "true" if value else "false"
        case bytes() | bytearray() | memoryview():
            data = bytes(value[:_MOST_BYTES])
            return data.hex(" ") if len(value) <= _MOST_BYTES else f"{data.hex(' ')} … ({len(value):,} bytes)"
        case Mapping():
            inside = ", ".join(
                f"{name}: {value_text(item)}" for name, item in islice(value.items(), _MOST_ITEMS)
            )
            return (
                f"{{{inside}}}" if len(value) <= _MOST_ITEMS else f"{{{inside}, …}} ({len(value):,} entries)"
            )
        case Sequence():
            inside = ", ".join(value_text(item) for item in islice(value, _MOST_ITEMS))
            return f"[{inside}]" if len(value) <= _MOST_ITEMS else f"[{inside}, …] ({len(value):,} items)"
        case _:
            return str(value)


RowRole = Literal["packet", "layer", "group", "field", "finding", "stop"]

GUTTER: Final = 11
"""Cells of the byte ranges at the left."""
_MOST_LABEL: Final = 32
_LEAST_VALUE: Final = 20
_MOST_LINES: Final = 8
"""Most lines of one value."""
_DOC_AT: Final = 64
"""Column where the documentation of fields begins, on lines that are wide enough."""
_LEAST_DOC: Final = 32


class TreeRow(NamedTuple):
    """One row of the tree.

    Attributes:
        role: role of the row.
        depth: level of indentation; 0 for layers.
        label: name of the field or title of the layer.
        value: readable value; empty for groups.
        start: first byte, from the start of the UDP payload.
        end: one past the last byte; equal to ``start`` if the row stands for no bytes.
        style: the rich style of the link, the layer or the severity.
        doc: description of the field, one line.
        align: width of the labels at this level, in cells.
    """

    role: RowRole
    depth: int
    label: str
    value: str = ""
    start: int = 0
    end: int = 0
    style: str = ""
    doc: str = ""
    align: int = 0


def rows(decoded: Decoded) -> Iterator[TreeRow]:
    """Yield the rows of a packet from top to bottom, all expanded; their texts are clean."""
    yield from _packet(decoded)
    often = Counter(layer.name for layer in decoded.layers)
    styles = palette.layers(often)
    for layer in decoded.layers:
        yield from (_repeated if often[layer.name] > 1 else _layer)(layer, styles[layer.name])
    yield from _departures(decoded)


def tree_lines(decoded: Decoded, width: int, paint: palette.Paint) -> list[str]:
    """Return the tree of a packet.

    Args:
        width: cells that no line exceeds, at least 40.
    """
    return [line for row in rows(decoded) for line in row_lines(row, max(40, width), paint)]


def _packet(decoded: Decoded) -> Iterator[TreeRow]:
    datagram, style = decoded.datagram, decoded.link.colour
    cut = datagram.original_length - len(datagram.frame)
    frame = f"frame of {len(datagram.frame):,}" + (f" ({cut:,} more were cut off)" if cut > 0 else "")
    length = plural(len(datagram.payload), "byte")
    recorded = datagram.topic != NO_ROUTE
    if not recorded:
        length += f" in a {frame}"
    value = f"{words.utc(datagram.time_ns)} UTC  {length}"
    title = "Message" if recorded else "Packet"
    yield TreeRow("packet", 0, f"{title} {datagram.number}", value, style=style)
    if recorded:
        yield TreeRow("packet", 0, "", clean("  ".join(recorded_topic(decoded))), style=style)
        return
    line = line_of(decoded)
    msg_id = f"0x{line.msg_id:04x}" if line.msg_id != NO_MSG_ID else ""
    title = " ".join(word for word in (decoded.link_name, line.kind, msg_id, line.name) if word)
    yield TreeRow("packet", 0, "", clean(f"{title}  {datagram.source} → {datagram.destination}"), style=style)


def _departures(decoded: Decoded) -> Iterator[TreeRow]:
    explained = [(item.label, EXPLANATIONS[item]) for item in ranked(decoded.findings)]
    if decoded.datagram.topic == NO_ROUTE and (fault := checksum_fault(decoded.datagram)):
        explained.insert(0, (fault, Explanation(Level.ERROR, fault, "Its receiver's kernel drops it.")))
    align = max((cells(label) + 2 for label, _ in explained), default=0)
    for label, it in explained:
        yield TreeRow(
            "finding", 0, f"{it.severity.mark} {label}", it.meaning, style=it.severity.style, align=align
        )
    if decoded.stop is not None:
        align = max(align, cells("✗ stopped"))
        yield TreeRow("stop", 0, "✗ stopped", clean(str(decoded.stop)), style=Level.ERROR.style, align=align)


def _layer(layer: Layer, style: str) -> Iterator[TreeRow]:
    yield TreeRow("layer", 0, clean(layer.title), "", layer.start, layer.end, style)
    yield from _fields(layer.fields, style)


def _repeated(layer: Layer, style: str) -> Iterator[TreeRow]:
    """Yield one row for a layer that a packet has many times, such as an SBN subscription."""
    value = "  ".join(f"{item.name}: {field_text(item)}" for item in layer.fields)
    yield TreeRow("layer", 0, clean(layer.title), clean(value), layer.start, layer.end, style)


def _fields(items: Sequence[LayerField], style: str, depth: int = 1, prefix: str = "") -> Iterator[TreeRow]:
    """Yield fields; fields with the same dotted parent are in one group of its name."""
    blocks = list(_blocks(items, prefix))
    align = min(max((cells(name) for name, _, leaf in blocks if leaf), default=0), _MOST_LABEL)
    for name, members, leaf in blocks:
        if leaf:
            item = members[0]
            value = clean(field_text(item))
            yield TreeRow("field", depth, name, value, item.start, item.end, style, clean(item.doc), align)
        else:
            start, end = min(item.start for item in members), max(item.end for item in members)
            yield TreeRow("group", depth, name, "", start, end, style)
            yield from _fields(
                members, style, depth + 1, f"{prefix}{members[0].name[len(prefix) :].partition('.')[0]}."
            )


def _blocks(items: Sequence[LayerField], prefix: str) -> Iterator[tuple[str, list[LayerField], bool]]:
    """Yield (name, its fields, whether it is itself a field) for one level, in wire order."""
    blocks: dict[tuple[str, int], list[LayerField]] = {}
    for index, item in enumerate(items):
        name, dot, _ = item.name[len(prefix) :].partition(".")
        # Two fields with the same name remain two rows.
        blocks.setdefault((name, -1 if dot else index), []).append(item)
    for (name, index), members in blocks.items():
        yield clean(name), members, index >= 0


def row_lines(row: TreeRow, width: int, paint: palette.Paint, *, closed: bool = False) -> list[str]:
    """Return the lines of one row.

    Args:
        row: as :func:`rows` yields it.
        width: cells that no line exceeds, at least 40.
        closed: whether the rows below it are hidden.
    """
    match row.role:
        case "packet":
            label = fit(row.label, max(GUTTER, cells(row.label) + 1))
            return _hang(
                paint(label, f"bold {row.style}" if row.label else ""), cells(label), row.value, GUTTER, width
            )
        case "finding" | "stop":
            label = fit(row.label, row.align + 2)
            return _hang(paint(label, row.style), cells(label), row.value, cells(label), width)
        case "field":
            return _field(row, width, paint)
    room = width - GUTTER
    title = clip(f"{_indent(row, room)}{'▸' if closed or row.value else '▾'} {row.label}", room)
    line = _gutter(row, paint) + paint(title, f"bold {row.style}" if row.role == "layer" else row.style)
    value = clip(row.value, room - cells(title) - 2)
    return [f"{line}  {value}" if value else line]


def _field(row: TreeRow, width: int, paint: palette.Paint) -> list[str]:
    room = width - GUTTER
    indent = _indent(row, room)
    # Even for a deeply nested message and a long name, part of the line is left for the value.
    align = max(row.align, cells(row.label)) if width >= FILE_WIDTH else row.align
    label = clip(fit(f"{clip(row.label, align)}:", align + 1), max(4, room - len(indent) - 2 - _LEAST_VALUE))
    used = GUTTER + len(indent) + cells(label) + 2
    out = _hang(f"{_gutter(row, paint)}{indent}{paint(label, palette.DIM)}  ", used, row.value, used, width)
    at = max(_DOC_AT, used + cells(row.value) + 3)
    if row.doc and len(out) == 1 and width - at >= _LEAST_DOC:
        out[0] += " " * (at - used - cells(row.value)) + paint(
            clip(row.doc, width - at), f"{palette.DIM} italic"
        )
    return out


def _gutter(row: TreeRow, paint: palette.Paint) -> str:
    return paint(fit(fit_right(_range(row), GUTTER - 3), GUTTER), palette.DIM)


def _indent(row: TreeRow, room: int) -> str:
    return " " * min(2 * row.depth, room // 3)


def _hang(first: str, used: int, value: str, indent: int, width: int) -> list[str]:
    """Return ``value`` after ``first``, which takes ``used`` cells; further lines begin at ``indent``."""
    head = wrap(value, width - used)
    if len(head) == 1:
        return [first + head[0] if head[0] else first.rstrip()]
    rest = head[1:] if indent == used else wrap(value[len(head[0]) :].lstrip(" "), width - indent)
    if len(rest) >= _MOST_LINES:
        rest = [*rest[: _MOST_LINES - 2], clip(f"{rest[_MOST_LINES - 2]} {ELLIPSIS}", width - indent)]
    return [first + head[0], *(" " * indent + line for line in rest)]


def _range(row: TreeRow) -> str:
    """Return ``24-75``, both ends inclusive as in the standards; empty if the row has no bytes."""
    if row.end <= row.start:
        return ""
    return str(row.start) if row.end == row.start + 1 else f"{row.start}-{row.end - 1}"


SIDE_BY_SIDE: Final = 140
"""Width from which the tree and the bytes are shown side by side."""
_GAP: Final = 3


def packet_lines(
    decoded: Decoded, width: int, *, colour: bool, highlight: str = "", base: Base = "payload"
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
        return [*tree_lines(decoded, width, paint), "", *_bytes(decoded, width, paint, highlight, base)]
    room = width - DUMP_WIDTH - _GAP
    tree_part = tree_lines(decoded, room, paint)
    if width >= FILE_WIDTH:
        room = max(map(plain_cells, tree_part))
    right = _bytes(decoded, DUMP_WIDTH, paint, highlight, base)
    return [
        f"{a}{' ' * (room + _GAP - plain_cells(a))}{b}" if b else a
        for a, b in zip_longest(tree_part, right, fillvalue="")
    ]


def _bytes(decoded: Decoded, width: int, paint: palette.Paint, highlight: str, base: Base) -> list[str]:
    datagram = decoded.datagram
    data = datagram.payload if base == "payload" else datagram.frame
    coloured = regions(decoded, base)
    span = None
    if highlight:
        shift = 0 if base == "payload" else datagram.payload_offset
        start, end = choose(decoded, highlight)
        # A payload reassembled from fragments is not in a single frame.
        span = (start + shift, end + shift) if shift >= 0 else None
    content = "TCP message" if datagram.stream else "UDP payload"
    if datagram.topic != NO_ROUTE:
        content = "Message"
    title = content if base == "payload" else "Frame"
    pointed = f", {highlight} at {span[0]}-{span[1] - 1}" if span and span[1] > span[0] else ""
    head = paint(f"{title}, {len(data):,} bytes{pointed}", palette.STRONG)
    return [head, *dump_lines(data, coloured, width, paint, highlight=span), *legend(coloured, width, paint)]

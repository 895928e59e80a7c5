"""Packets as ``sniff --json`` prints them: from the layers of one packet, or many at once from columns.

A text is a template with the parts that all packets of a kind share, filled with the texts of the columns
that differ. The rules:

1. Both ways give the same bytes; ``tests/pipelines/capture/test_packet_json.py`` compares them.
2. From columns come the packets that :mod:`edoras_tools.decode.lines` reads from columns, on links whose
   headers are fixed, in an envelope of a known format, with a message without lists inside lists.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import groupby, pairwise
from json import dumps
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from edoras_tools.decode.filters.layers import slot_values
from edoras_tools.decode.lines import Contents, endpoints, links_of, message_rows, read_whole
from edoras_tools.decode.stack import RECORDED_LAYER, recorded_topic
from edoras_tools.decode.summary import Group, grouped_columns
from edoras_tools.io.formats.columns import json_value, value_texts
from edoras_tools.links.protocol import LinkProtocol
from edoras_tools.links.sbn import SBN
from edoras_tools.model import NO_ROUTE, Decoded, Finding, Link, RosMessage
from edoras_tools.ros.cdr.bulk import Ragged
from edoras_tools.ros.library import PLACEHOLDER
from edoras_tools.wire import ccsds, cfe, sbn
from edoras_tools.wire.arrays import Integers, Places, by_value, gather, numbered
from edoras_tools.wire.envelope import ENCAPSULATION, ENVELOPE_FORMATS

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from edoras_tools.decode.context import Context
    from edoras_tools.decode.filters.rows import ColumnRows
    from edoras_tools.decode.summary import Column
    from edoras_tools.wire.layout import Layout

    Texts = str | Sequence[Any]
    """JSON texts of a column: one for each row, or one for all rows; integers stand for their own text."""
    Path = tuple[str, ...]
    Parts = Mapping[Path, Texts]
    """Values of an object by their path; the values of one inner object are adjacent."""

_IN_HEAD: Final = 6
"""Number of a packet's values in front of those that are decoded from its bytes."""
_ABOUT: Final = ("topic", "type", "message")
_INSIDE: Final = tuple(cfe.PAYLOADS.items())
"""Packets that are shown with one more layer, and the layer."""


def as_json(decoded: Decoded) -> dict[str, Any]:
    """Return a packet in the shape of ``sniff --json``: plain values, bytes of headers as hex."""
    packet = decoded.layer("ccsds")
    message = decoded.message
    recorded = decoded.datagram.topic != NO_ROUTE
    topic, type_ = (
        recorded_topic(decoded) if recorded else (message.topic, message.type) if message else ("", "")
    )
    return {
        "number": decoded.datagram.number,
        "time_ns": decoded.datagram.time_ns,
        "link": None if recorded else decoded.link.label,
        "source": None if recorded else str(decoded.datagram.source),
        "destination": None if recorded else str(decoded.datagram.destination),
        "length": len(decoded.datagram.payload),
        "layers": _layers(decoded),
        "msg_id": f"0x{packet.values()['msg_id']:04x}" if packet else None,
        "topic": topic or None,
        "type": type_ or None,
        "message": json_value(message.values) if message else None,
        **({"more": [_message(item) for item in decoded.more]} if decoded.more else {}),
        "findings": decoded.findings.labels,
        "stop": str(decoded.stop) if decoded.stop else None,
    }


def _layers(decoded: Decoded) -> dict[str, Any]:
    """Return the fields of each layer by its name; a second DDS layer of one name is ``rtps_data#2``."""
    by_name: dict[str, Any] = {}
    count: Counter[str] = Counter()
    for layer in decoded.layers:
        if layer.name not in {"ros", "cfs", RECORDED_LAYER}:
            count[layer.name] += 1
            again = decoded.link.samples and count[layer.name] > 1
            name = f"{layer.name}#{count[layer.name]}" if again else layer.name
            by_name[name] = json_value(layer.values(), octets=bytes.hex)
    return by_name


def _message(message: RosMessage) -> dict[str, Any]:
    return {"topic": message.topic, "type": message.type, "message": json_value(message.values)}


class PacketTexts:
    """Makes the JSON texts of many packets.

    Args:
        context: shared with the decoder of the same stream.
    """

    def __init__(self, context: Context) -> None:
        self._contents = Contents(context, _tail, _tails)

    def of(self, rows: ColumnRows) -> list[str]:
        """Return the text of each row, in order: ``as_json`` without spaces, starting behind ``schema``."""
        recorded = rows.batch.recorded is not None
        links = {code: "null" if recorded else _text(link.label) for code, link in links_of(rows).items()}
        pairs, which = endpoints(rows)
        names = [["null" if recorded else _text(str(end)) for end in pair] for pair in pairs]
        heads = zip(
            rows.datagram("number").tolist(),
            rows.datagram("time_ns").tolist(),
            map(links.__getitem__, rows.column("link").tolist()),
            map(names.__getitem__, which.tolist()),
            rows.datagram("length").tolist(),
            self._contents.of(rows),
            strict=True,
        )
        return [
            f'{{"schema":1,"number":{number},"time_ns":{time_ns},"link":{link},"source":{source},'
            f'"destination":{destination},"length":{length},{tail}'
            for number, time_ns, link, (source, destination), length, tail in heads
        ]


def _text(value: Any) -> str:
    return dumps(value, ensure_ascii=False, separators=(",", ":"))


def _tail(decoded: Decoded) -> str:
    """Return the text of the values that are decoded from a packet's bytes, without the brace in front."""
    return _text(dict(list(as_json(decoded).items())[_IN_HEAD:]))[1:]


def _tails(rows: ColumnRows) -> list[str | None]:
    """Return ``_tail`` of each row from columns; None for rows that must be dissected."""
    out: list[str | None] = [None] * len(rows)
    recorded = rows.batch.recorded is not None
    shapes = None if recorded else _Shapes(rows)
    easy = read_whole(rows) if shapes is None else read_whole(rows) & shapes.known
    about: dict[str, NDArray[Any]] = {name: np.full(len(rows), "null", object) for name in _ABOUT}
    for owner, topic, name, messages, plan, _ in message_rows(rows, easy):
        columns = grouped_columns(messages, plan)  # none of a type with lists of messages that hold lists
        texts = None if columns is None else _message_objects(columns, len(messages))
        for key, value in zip(_ABOUT, (_text(topic), _text(name), texts or "null"), strict=True):
            about[key][owner] = value
        easy[owner if texts is None else owner[~messages.valid]] = False
    ids, findings = rows.column("msg_id"), rows.column("findings")
    labels = {bits: _text(Finding(bits).labels) for bits in set(findings.tolist())}
    places = np.flatnonzero(easy)
    bare: dict[Path, Texts] = {("layers",): "{}"}
    for members, parts in [(places, bare)] if shapes is None else shapes.of(places):
        parts[("msg_id",)] = "null" if recorded else [f'"0x{value:04x}"' for value in ids[members].tolist()]
        for key, values in about.items():
            parts[(key,)] = values[members].tolist()
        parts[("findings",)] = [labels[bits] for bits in findings[members].tolist()]
        parts[("stop",)] = "null"
        for row, text in zip(members.tolist(), _objects(parts, len(members)), strict=True):
            out[row] = text[1:]
    return out


class _Shapes:
    """The layers of rows whose packets are read to their end.

    Attributes:
        known: bool (n,), rows whose layers the columns determine.
    """

    def __init__(self, rows: ColumnRows) -> None:
        self._rows = rows
        envelopes = [*rows.context.envelopes, None]  # the last stands for no route
        self._start, header = rows.column("packet_offset"), rows.column("header_length")
        self._body = self._start + header
        size = rows.column("packet_length") - header
        self._links = links_of(rows)
        fixed = [code for code, link in self._links.items() if _fixed(link) is not None]
        self.known = np.isin(rows.column("link"), fixed)
        self._inside = np.zeros(len(rows), np.uint8)
        msg_ids, bare = rows.context.msg_ids, rows.routes() == NO_ROUTE
        for number, (standard, layout) in enumerate(_INSIDE, 1):
            inside = (rows.column("msg_id") == msg_ids.of_known(standard)) & (size >= layout.size) & bare
            self._inside[inside] = number
        enclosed = rows.column("cdr_length") > 0
        places = {item: place for place, item in enumerate(ENVELOPE_FORMATS, 1)}  # 0: the mission's own
        formats = np.array([places.get(item, 0) if item else 0 for item in envelopes])
        self._envelope = np.where(enclosed, formats[rows.routes()], 0)
        sizes = np.array([0, *(item.size for item in ENVELOPE_FORMATS)])
        self._cdr, length = rows.column("cdr_offset"), rows.column("cdr_length")
        self.known &= ~enclosed | ((self._envelope > 0) & (self._cdr == self._body + sizes[self._envelope]))
        self._padding = np.where(enclosed, self._start + rows.column("packet_length") - self._cdr - length, 0)
        self._command = msg_ids.is_command(rows.column("msg_id"))

    def of(self, rows: Places) -> Iterator[tuple[Places, dict[Path, Texts]]]:
        """Yield groups of rows that have the same layers, each with its fields."""
        link, headers = self._rows.column("link"), self._rows.column("headers")
        keys = link, headers, self._command, self._inside, self._envelope, self._padding > 0
        _, which = numbered(*(key[rows] for key in keys))
        for _, members in by_value(which):
            yield rows[members], dict(self._fields(rows[members]))

    def _fields(self, rows: Places) -> Iterator[tuple[Path, Texts]]:
        of, first, start = self._rows, rows[0], self._start[rows]
        headers = cfe.HEADERS[of.column("headers")[first]]
        at = of.datagram("offset")[rows]
        for layout in _fixed(self._links[int(of.column("link")[first])]) or ():
            yield from self._layer(layout, at)
            at = at + layout.size
        yield ("layers", "ccsds", "msg_id"), _texts(of.column("msg_id")[rows])
        yield from self._layer(ccsds.PRIMARY, start)
        if headers.extended:
            yield from self._layer(cfe.EXTENDED, start + ccsds.PRIMARY.size)
        second = headers.command if self._command[first] else of.context.in_order(headers.telemetry)
        yield from self._layer(second, start + headers.start)
        if self._inside[first]:
            layout = of.context.in_order(_INSIDE[self._inside[first] - 1][1])
            yield from self._layer(layout, self._body[rows])
        if self._envelope[first]:
            yield from self._layer(ENVELOPE_FORMATS[self._envelope[first] - 1].layout, self._body[rows])
            yield from self._layer(ENCAPSULATION, self._cdr[rows])
        if self._padding[first]:
            yield ("layers", "padding", "length"), _texts(self._padding[rows])
            stale = (of.column("findings")[rows] & np.uint32(Finding.STALE_TAIL)) != 0
            yield ("layers", "padding", "stale"), _texts(stale)

    def _layer(self, layout: Layout, at: Integers) -> Iterator[tuple[Path, Texts]]:
        window = gather(self._rows.batch.data, at, layout.size)
        for slot in layout.slots:
            values = slot_values(layout, slot, window[:, slot.start : slot.end])
            if isinstance(values, list):
                texts = {item: item.hex() if isinstance(item, bytes) else item for item in set(values)}
                values = np.array([texts[item] for item in values], object)
            yield ("layers", layout.name, slot.field.name), _texts(values)


def _fixed(link: Link) -> tuple[Layout, ...] | None:
    """Return the headers in front of every space packet of a link; None if they vary."""
    if link is SBN:
        return (sbn.HEADER,)
    usual = isinstance(link, LinkProtocol) and type(link).dissect is LinkProtocol.dissect
    return link.layouts if usual and isinstance(link, LinkProtocol) and not link.forms else None


def _texts(column: Column) -> Texts:
    """Return the JSON texts of a column; a single text if all rows have the same value."""
    if isinstance(column, (Ragged, Group)):
        offsets = column.offsets.tolist()
        if isinstance(column, Ragged) and column.values.itemsize > 1 and _as_python(column.values):
            values = column.values.tolist()
            return [str(values[first:last]).replace(" ", "") for first, last in pairwise(offsets)]
        if isinstance(column, Group):
            items = _message_objects(column.columns, offsets[-1])
        else:
            items = value_texts(_doubles(column.values))
        return [f"[{','.join(items[first:last])}]" for first, last in pairwise(offsets)]
    return str(_each(column[:1])[0]) if len(column) and _all_equal(column) else _each(column)


def _each(column: NDArray[Any]) -> list[Any]:
    if column.ndim == 1:
        return column.tolist() if column.dtype.kind in "iu" else value_texts(_doubles(column))
    if _as_python(column):
        return [str(row).replace(" ", "") for row in column.tolist()]
    return [f"[{','.join(value_texts(_doubles(row)))}]" for row in column]


def _as_python(values: NDArray[Any]) -> bool:
    """Return whether Python prints a list of these numbers as JSON does, except for spaces."""
    kind = values.dtype.kind
    return kind in "iu" or (kind == "f" and bool(np.isfinite(values).all()))


def _doubles(values: NDArray[Any]) -> NDArray[Any]:
    """Return floating-point numbers as Python floats."""
    return values.astype(np.float64) if values.dtype.kind == "f" else values


def _all_equal(column: NDArray[Any]) -> bool:
    if column.dtype != object:  # compare bits: -0.0 has another text than 0.0
        column = np.ascontiguousarray(column).view(f"u{column.itemsize}")
    return bool((column == column[0]).all())


def _message_objects(columns: Mapping[str, Column], count: int) -> list[str]:
    return _objects({tuple(name.split(".")): _texts(column) for name, column in columns.items()}, count)


def _objects(parts: Parts, count: int) -> list[str]:
    """Return the JSON texts of ``count`` objects."""
    columns: list[Sequence[Any]] = []
    template = _template(list(parts.items()), columns)
    if not columns:
        return [template % ()] * count
    return list(map(template.__mod__, zip(*columns, strict=True)))


def _template(parts: Iterable[tuple[Path, Texts]], columns: list[Sequence[Any]]) -> str:
    """Return the template of an object; append the columns that fill it to ``columns``."""
    members = []
    for name, group in groupby(parts, lambda part: part[0][0]):
        inside = [(path[1:], texts) for path, texts in group]
        path, texts = inside[0]
        if name == PLACEHOLDER:
            return "{}"
        if path:
            text = _template(inside, columns)
        elif isinstance(texts, str):
            text = texts.replace("%", "%%")
        else:
            text = "%s"
            columns.append(texts)
        members.append(f"{_text(name).replace('%', '%%')}:{text}")
    return f"{{{','.join(members)}}}"

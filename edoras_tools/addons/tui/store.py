"""The packets of the list: blocks of columns, with the rows that pass the filter; searching in them.

Only the thread that draws uses a store. A filter's result for a block is shown once all blocks before it have
a result, so that the list grows from its top while the filter runs.

Another thread judges the packets of the view (``WatchThread``). The list may be in the order of one of its
columns. A search is a filter, a text, or bytes.

Plots show the rates of these packets by MsgId, and the values of a field.
"""

from __future__ import annotations

import queue
import re
import threading
from bisect import bisect_right
from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, Any, Final

import msgspec
import numpy as np

from edoras_tools.decode.filters.filter import Where, fields
from edoras_tools.decode.filters.rows import ColumnRows, FilterField
from edoras_tools.decode.filters.syntax import Presence, WhereError, parse_filter
from edoras_tools.links import table
from edoras_tools.model import NO_MSG_ID, NO_ROUTE, OTHER, Columns, Datagram, Finding, PacketBatch
from edoras_tools.pipelines.capture.record import ROW_BYTES, join
from edoras_tools.render.plot.figure import Figure, Panel, PlotLine, RateCounts, bar_seconds
from edoras_tools.wire.arrays import by_value, numbered
from edoras_tools.wire.sbn import MSG_TYPE_NAMES

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from edoras_tools.decode.context import Context

    Shown = range | NDArray[np.int64]
    """Rows of a block, in order."""
    Part = tuple["PacketBlock", int, Shown]
    Matcher = Callable[["PacketBlock"], NDArray[np.bool_]]
    """Function from a block to a mask of the packets that match."""


_SMALL: Final = 16_384
"""Blocks of a live capture are joined up to this many packets."""


class PacketBlock(msgspec.Struct, eq=False):
    """Some packets.

    Attributes:
        batch: the datagrams.
        columns: decoded columns.
        selection: rows that pass the filter; None if it has not run yet.
        begin_ns: time of the capture's first datagram, ns since 1970; None: time of the first packet.
    """

    batch: PacketBatch
    columns: Columns
    selection: Shown | None = None
    begin_ns: int | None = None

    def __len__(self) -> int:
        return len(self.batch)

    @property
    def size(self) -> int:
        """Approximate bytes in memory."""
        return self.batch.data.nbytes + ROW_BYTES * len(self)


class Store:
    """All packets that are kept.

    Args:
        limit: maximum bytes to keep; the oldest packets are dropped when there are more. 0: no limit.

    Attributes:
        order: i64 (n,), index in the capture's order of each of the first n rows; later rows are in that
            order. None if all are.
    """

    def __init__(self, limit: int = 0) -> None:
        self.blocks: list[PacketBlock] = []
        self.packets = 0
        self.size = 0
        self.forgotten = 0
        self.begin_ns: int | None = None
        self.filtered = False
        self.order: NDArray[np.int64] | None = None
        self._limit = limit
        self._ends: list[int] = []

    def __len__(self) -> int:
        """Return the number of shown rows, as far as the filter has run."""
        return self._ends[-1] if self._ends else 0

    @property
    def settled(self) -> int:
        """Number of packets that the filter has run on."""
        return sum(len(block) for block in self.blocks[: len(self._ends)])

    def append(self, block: PacketBlock) -> int:
        """Add a block; return the number of rows dropped at the top to make space."""
        if not len(block):
            return 0
        if self.begin_ns is None:
            self.begin_ns = int(block.batch.time_ns[0]) if block.begin_ns is None else block.begin_ns
        if not self.filtered:
            block.selection = range(len(block))
        self.blocks.append(block)
        self.packets += len(block)
        self.size += block.size
        self._advance()
        self._merge()
        return self._forget() if self._limit else 0

    def restart(self, *, filtered: bool) -> None:
        """Start again: without a filter all rows are shown; with one, no row until it has run."""
        self.filtered, self.order = filtered, None
        for block in self.blocks:
            block.selection = None if filtered else range(len(block))
        self._ends = []
        self._advance()

    def settle(self, block: PacketBlock, rows: NDArray[np.int64]) -> None:
        """Store the filter's result for a block."""
        block.selection = rows
        self._advance()
        self._merge()

    def locate(self, row: int) -> tuple[PacketBlock, int]:
        """Return the block of a shown row, and its index there.

        Raises:
            IndexError: there is no such row.
        """
        if not 0 <= row < len(self):
            raise IndexError(row)
        row = self.place(row)
        place = bisect_right(self._ends, row)
        block = self.blocks[place]
        assert block.selection is not None
        return block, int(block.selection[row - (self._ends[place - 1] if place else 0)])

    def place(self, row: int) -> int:
        """Return the index of a row in the capture's order."""
        return row if self.order is None or row >= len(self.order) else int(self.order[row])

    def datagram(self, row: int) -> Datagram:
        """Return the datagram of a shown row."""
        block, index = self.locate(row)
        return block.batch[index]

    def number(self, row: int) -> int:
        """Return the number of the packet of a shown row."""
        block, index = self.locate(row)
        return int(block.batch.number[index])

    def time_ns(self, row: int) -> int:
        """Return the capture time of a shown row."""
        block, index = self.locate(row)
        return int(block.batch.time_ns[index])

    def find_number(self, number: int) -> int | None:
        """Return the row of the packet with that number, else of the next one after it; None at the end."""
        return self._first_at_least("number", number)

    def find_time(self, time_ns: int) -> int | None:
        """Return the first row at or after a time."""
        return self._first_at_least("time_ns", time_ns)

    def parts(self) -> list[Part]:
        """Return the blocks with shown packets, each with the row of its first one and its shown rows.

        The list does not change later, so threads may use it.
        """
        return [
            (block, end - len(block.selection), block.selection)
            for block, end in zip(self.blocks, self._ends, strict=False)
            if block.selection is not None and len(block.selection)
        ]

    def _first_at_least(self, name: str, value: int) -> int | None:
        for block, first, selection in self.parts():
            column = getattr(block.batch, name)
            # Blocks are in order, so most are skipped by one comparison.
            if column[int(selection[-1])] < value:
                continue
            places = np.flatnonzero(column[np.asarray(selection)] >= value)
            if len(places):
                return self._row(first + int(places[0]))
        return None

    def _row(self, place: int) -> int:
        if self.order is None or place >= len(self.order):
            return place
        return int(np.flatnonzero(self.order == place)[0])

    def _advance(self) -> None:
        """Count the blocks that the filter has run on since the last call."""
        while len(self._ends) < len(self.blocks):
            selection = self.blocks[len(self._ends)].selection
            if selection is None:
                break
            self._ends.append(len(self) + len(selection))

    def _merge(self) -> None:
        """Join small blocks at the end, so that hours of a quiet link remain a few blocks."""
        while len(self.blocks) > 1 and len(self._ends) == len(self.blocks):
            before, last = self.blocks[-2:]
            if len(before) + len(last) > _SMALL or len(before) > 2 * len(last):
                break
            joined = join_blocks(before, last)
            self.size += joined.size - before.size - last.size
            self.blocks[-2:] = [joined]
            del self._ends[-2]

    def _forget(self) -> int:
        dropped = rows = 0
        while self.size > self._limit and dropped < len(self.blocks) - 1 and dropped < len(self._ends):
            block = self.blocks[dropped]
            self.size -= block.size
            self.packets -= len(block)
            self.forgotten += len(block)
            rows = self._ends[dropped]
            dropped += 1
        if dropped:
            del self.blocks[:dropped]
            self._ends = [end - rows for end in self._ends[dropped:]]
            if self.order is not None:
                self.order = self.order[self.order >= rows] - rows
        return rows


def join_blocks(first: PacketBlock, second: PacketBlock) -> PacketBlock:
    """Join two blocks; the filter has run on both, or on neither."""
    selection: Shown | None = None
    if isinstance(first.selection, range) and isinstance(second.selection, range):
        selection = range(len(first) + len(second))
    elif first.selection is not None and second.selection is not None:
        selection = np.concatenate([np.asarray(first.selection), np.asarray(second.selection) + len(first)])
    batch, columns = join([(first.batch, first.columns), (second.batch, second.columns)])
    return PacketBlock(batch, columns, selection)


class WatchThread(threading.Thread):
    """Passes blocks to the monitor of a link, in the order in which they are put.

    Args:
        monitor: result of ``doors.part("monitor")``.
        blocks: blocks that exist already.

    Attributes:
        state: function that returns the state of the link so far.
    """

    def __init__(self, monitor: Any, blocks: Iterable[PacketBlock]) -> None:
        super().__init__(name="monitor", daemon=True)
        self._monitor, self._stopping = monitor, threading.Event()
        self._blocks: queue.SimpleQueue[PacketBlock | None] = queue.SimpleQueue()
        self.state = monitor.state
        for block in blocks:
            self.put(block)

    def put(self, block: PacketBlock | None) -> None:
        """Add a block; None behind the last one."""
        self._blocks.put(block)

    def stop(self) -> None:
        """End the thread."""
        self._stopping.set()
        self._blocks.put(None)

    def run(self) -> None:
        """Pass blocks on until stopped."""
        while (block := self._blocks.get()) is not None and not self._stopping.is_set():
            self._monitor.add(block.batch, block.columns)
        self._monitor.finish()
        self._stopping.wait()
        self._monitor.close()


_FIELDS: Final = {
    "time": "time_ns",
    "ports": "source.port,destination.port",
    "packet": "link,sbn.msg_type",
    "bytes": "length",
}
"""Field of a list's column, if its name differs from the column's."""


def sort_order(
    parts: Sequence[Part],
    column: str,
    context: Context,
    *,
    reverse: bool,
    given_up: Callable[[], bool] = lambda: False,
) -> NDArray[np.int64] | None:
    """Return the rows of a list sorted by a column; rows without a value are last; the sort is stable.

    Args:
        parts: result of ``Store.parts``.
        column: one of the list's columns, or any field.
        reverse: whether the largest comes first.
        given_up: called between blocks; the result is None if it returns true.
    """
    fields_of = [
        several_fields for _, several_fields in fields(_FIELDS.get(column, column), context, "column")
    ]
    read = _names if column == "topic" else _values
    blocks: list[list[tuple[NDArray[Any], NDArray[np.bool_]]]] = []
    for block, _, selection in parts:
        if given_up():
            return None
        rows = ColumnRows(context, 0, block.batch, block.columns, np.asarray(selection))
        blocks.append([read(rows, several) for several in fields_of])
    keys: list[NDArray[Any]] = []
    for pieces in zip(*blocks, strict=True):
        _, ranks = np.unique(np.concatenate([values for values, _ in pieces]), return_inverse=True)
        has_value = np.concatenate([present for _, present in pieces])
        keys += [~has_value, np.where(has_value, -ranks if reverse else ranks, 0)]
    return np.lexsort(keys[::-1]) if keys else np.zeros(0, np.int64)


def _values(rows: ColumnRows, several: Sequence[FilterField]) -> tuple[NDArray[Any], NDArray[np.bool_]]:
    """Return the first value of each row, numbers or texts, and which rows have one.

    Args:
        several: fields that share a name; a row has the value of the last field that it has.
    """
    out, present = np.zeros(len(rows)), np.zeros(len(rows), bool)
    for field in several:
        series = field.series(rows)
        values = series.values
        if series.table is not None:
            values = np.array([*map(str, series.table), ""])[values]
        owner, first = np.unique(
            np.arange(len(rows)) if series.owner is None else series.owner, return_index=True
        )
        if not present.any():
            out = np.zeros(len(rows), values.dtype)
        elif out.dtype.kind in "US" or values.dtype.kind in "US":
            out, values = out.astype(str), values.astype(str)
        out = out.astype(np.promote_types(out.dtype, values.dtype))
        out[owner] = values[first]
        present[owner] = True
    return out, present


def _names(rows: ColumnRows, _: Sequence[FilterField]) -> tuple[NDArray[Any], NDArray[np.bool_]]:
    """Return the text in the list's column of topics: topic of the route, else name of the MsgId."""
    columns = rows.routes(), rows.column("msg_id"), rows.column("spacecraft")
    first, which = numbered(*columns)
    kinds = zip(*(column[first].tolist() for column in columns), strict=True)
    names = np.array([_name(rows.context, *kind) for kind in kinds], str)[which]
    return names, names != ""


def _name(context: Context, route: int, msg_id: int, spacecraft: int) -> str:
    if msg_id != NO_MSG_ID and route != NO_ROUTE:
        return context.of(spacecraft).mission.routes[route].topic
    return context.name(msg_id) if msg_id != NO_MSG_ID else ""


_HEX: Final = re.compile(r"0x((?:[0-9a-fA-F]{2}[ :]?)+)")
_LOWER: Final = np.array([ord(chr(code).lower()) if code < 128 else code for code in range(256)], np.uint8)


def matcher(text: str, context: Context, begin_ns: int | None) -> Matcher:
    """Return the test for a search.

    Args:
        text: a comparison of the filter language; bytes, e.g. ``0x0b0c``; else a text to search in topics, in
            names of packets and findings, and in the packets' bytes, ignoring case.
        begin_ns: time of the first packet.
    """
    try:
        # A single word would also be a filter (packets that have that field); a search treats it as text.
        where = None if isinstance(parse_filter(text), Presence) else Where(text, context, begin_ns)
    except WhereError:
        where = None
    if where is not None:
        return lambda block: where.mask(block.batch, block.columns)
    digits = _HEX.fullmatch(text.strip())
    if digits:
        octets = bytes.fromhex(re.sub("[ :]", "", digits[1]))
        return lambda block: _holding(block, block.batch.data, octets)
    word = text.strip().lower()
    return lambda block: (
        _rows_named(block, word, context) | _holding(block, _LOWER[block.batch.data], word.encode())
    )


def next_number(
    parts: Sequence[Part],
    matches: Matcher,
    after: int,
    *,
    back: bool = False,
    given_up: Callable[[], bool] = lambda: False,
) -> int | None:
    """Return the number of the next packet that matches, continuing at the other end; None if none does.

    Args:
        parts: result of ``Store.parts``.
        matches: the test.
        after: the row to start after; it is tested last.
        given_up: called between blocks; the search ends when it returns true.
    """
    start = next(
        (place for place, (_, first, selection) in enumerate(parts) if first + len(selection) > after), 0
    )
    step = -1 if back else 1
    # The block in which the search starts is tested twice: first the rows ahead, at the end the others.
    for turn in range(len(parts) + 1 if parts else 0):
        if given_up():
            return None
        block, first, selection = parts[(start + step * turn) % len(parts)]
        candidates = np.asarray(selection)
        candidates = candidates[matches(block)[candidates]]
        if turn == 0:
            rows = first + np.searchsorted(np.asarray(selection), candidates)
            candidates = candidates[rows < after] if back else candidates[rows > after]
        if len(candidates):
            return int(block.batch.number[candidates[-1 if back else 0]])
    return None


def _holding(block: PacketBlock, data: NDArray[np.uint8], octets: bytes) -> NDArray[np.bool_]:
    """Return which payloads contain these bytes."""
    batch = block.batch
    hit = np.zeros(len(batch), bool)
    if not octets:
        return hit
    text = data.tobytes()
    places = []
    at = text.find(octets)
    while at >= 0:
        places.append(at)
        at = text.find(octets, at + 1)
    order = np.argsort(batch.offset, kind="stable")
    positions = np.array(places, np.int64)
    owner = np.searchsorted(batch.offset[order], positions, side="right") - 1
    positions, rows = positions[owner >= 0], order[owner[owner >= 0]]
    hit[rows[positions + len(octets) <= batch.offset[rows] + batch.length[rows]]] = True
    return hit


def _rows_named(block: PacketBlock, word: str, context: Context) -> NDArray[np.bool_]:
    """Return which packets have a name that contains a word."""
    columns = block.columns
    hit = np.isin(columns.link, [int(link) for link in (*table.links(), OTHER) if word in link.label])
    bits = sum(int(item) for item in Finding if word in item.label)
    if bits:
        hit |= (columns.findings & np.uint32(bits)) != 0
    kinds = [kind for kind, name in MSG_TYPE_NAMES.items() if word in name.lower()]
    hit |= np.isin(columns.sbn_msg_type, kinds)
    for number, rows in by_value(columns.spacecraft):
        own = columns.msg_id[rows]
        msg_ids = [item for item in np.unique(own).tolist() if item != NO_MSG_ID]
        hit[rows] |= np.isin(own, [item for item in msg_ids if word in _field_name(item, context.of(number))])
    return hit


def _field_name(msg_id: int, context: Context) -> str:
    route = int(context.any_route_of[msg_id])
    topic = f"{context.mission.routes[route].topic} {context.mission.routes[route].type}" * (
        route != NO_ROUTE
    )
    return f"0x{msg_id:04x} {context.name(msg_id)} {topic}".lower()


_MOST_LINES: Final = 6
"""Most lines: one for each colour of a terminal."""
_MSG_ID_BITS: Final = 17
_APART_S: Final = 0.1
"""Least time between two rounds of Telemetry Output, s; packets of one round are closer."""
_MOST_OF_ROUND: Final = 0.25
"""Largest share of a round that its packets take; else they do not come in rounds."""


def rate_figure(
    parts: Sequence[Part], context: Context, begin_ns: int, given_up: Callable[[], bool], bars: int
) -> Figure | None:
    """Return the rates of packets; None if there are no packets, or the work was given up.

    Telemetry Output sends in rounds. Its packets count as spread evenly over the time since the previous
    round, so that the rate is that of publishing.

    Args:
        parts: result of ``Store.parts``.
        begin_ns: zero of the seconds, ns since 1970.
        given_up: called between blocks; true ends the work.
        bars: number of means that fit.
    """
    pieces: list[tuple[NDArray[np.float64], NDArray[np.int64]]] = []
    for block, _, selection in parts:
        if given_up():
            return None
        rows = np.asarray(selection)
        keys = _keys(block.columns)[rows]
        pieces.append(((block.batch.time_ns[rows] - begin_ns) / 1e9, keys))
    if not pieces:
        return None
    seconds, keys = map(np.concatenate, zip(*pieces, strict=True))
    span = min(0.0, float(seconds.min())), max(float(seconds.max()), 1e-3)
    since = seconds.copy()
    in_rounds = table.among(keys >> _MSG_ID_BITS & 0xFF, lambda link: link.only_from_cfs)
    since[in_rounds] = _round_before(seconds[in_rounds])
    counts: dict[int, RateCounts] = {}
    for key, places in by_value(keys):
        counts[key] = RateCounts()
        counts[key].add_spans(since[places], seconds[places], np.ones(len(places), np.int64))
    series = [(_series_name(key, context), item) for key, item in counts.items()]
    series.sort(key=lambda item: -item[1].total)
    if len(series) > _MOST_LINES:
        rest = RateCounts()
        for _, item in series[_MOST_LINES - 1 :]:
            rest.join(item)
        series = [*series[: _MOST_LINES - 1], (f"{len(series) - _MOST_LINES + 1} others", rest)]
    width = bar_seconds(span, bars)
    lines = [item.line(0, span, width, label) for label, item in series]
    title = f"packets of the list, mean over {width:g} s"
    return Figure([""], [Panel(title, lines, "packets/s", beneath=True)], span)


def _round_before(seconds: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the begin of the previous round for each packet; its own time if there are no rounds."""
    order = np.argsort(seconds, kind="stable")
    times = seconds[order]
    place = np.cumsum(np.diff(times, prepend=times[:1]) > _APART_S)
    starts, ends = np.flatnonzero(np.diff(place, prepend=-1)), np.flatnonzero(np.diff(place, append=-1))
    begins = times[starts]
    if len(begins) < 3:
        return seconds
    period = float(np.median(np.diff(begins)))
    if float(np.median(times[ends] - begins)) > _MOST_OF_ROUND * period:
        return seconds
    before = np.maximum(np.append(begins[0] - period, begins[:-1]), begins - 1.5 * period)
    out = np.empty_like(seconds)
    out[order] = before[place]
    return out


def field_figure(
    parts: Sequence[Part], context: Context, name: str, begin_ns: int, given_up: Callable[[], bool]
) -> Figure | None:
    """Return the values of a field over time, a line for each route; None if there is no number, or given up.

    Args:
        parts: see ``rate_figure``.
        name: name of the field.
        begin_ns: see ``rate_figure``.
        given_up: see ``rate_figure``.

    Raises:
        WhereError: there is no field of that name.
    """
    ((_, several),) = fields(name, context, "graph")
    values: dict[int, list[NDArray[np.float64]]] = {}
    for block, _, selection in parts:
        if given_up():
            return None
        rows = ColumnRows(context, begin_ns, block.batch, block.columns, np.asarray(selection))
        keys = _keys(block.columns)[np.asarray(selection)]
        seconds = (rows.datagram("time_ns") - begin_ns) / 1e9
        for field in several:
            series = field.series(rows)
            if series.table is not None:
                continue
            owner = np.arange(len(rows)) if series.owner is None else series.owner
            for key, places in by_value(keys[owner]):
                pair = np.stack([seconds[owner[places]], series.values[places].astype(np.float64)])
                values.setdefault(key, []).append(pair[:, np.isfinite(pair[1])])
    if not values:
        return None
    drawn = []
    for key, item in values.items():
        seconds, numbers = np.hstack(item)
        drawn.append(PlotLine(_series_name(key, context), 0, seconds, numbers, len(numbers)))
    drawn.sort(key=lambda line: -line.read)
    if not (lines := [line for line in drawn[:_MOST_LINES] if line.read]):
        return None
    numbers = np.concatenate([line.values for line in drawn])
    title = (
        f"{name}: {len(numbers):,} values, {numbers.min():g} to {numbers.max():g}, mean {numbers.mean():g}"
    )
    ends = [float(edge) for line in lines for edge in (line.seconds[0], line.seconds[-1])]
    return Figure([""], [Panel(title, lines)], (min(0.0, *ends), max(*ends, 1e-3)))


def _keys(columns: Columns) -> NDArray[np.int64]:
    """Return one number for spacecraft, link and MsgId of each row, i64; see ``_series_name``."""
    code = columns.spacecraft.astype(np.int64) << 8 | columns.link
    return code << _MSG_ID_BITS | (columns.msg_id.astype(np.int64) + 1)


def _series_name(key: int, context: Context) -> str:
    """Return the link and the topic, or the name of the MsgId."""
    code, msg_id = key >> _MSG_ID_BITS, (key & (1 << _MSG_ID_BITS) - 1) - 1
    link, own = table.link(code & 0xFF), context.of(code >> 8)
    name = context.name(msg_id) or f"0x{msg_id:04x}" if msg_id != NO_MSG_ID else ""
    route = int(context.routes_on(link)[msg_id]) if name else NO_ROUTE
    if route != NO_ROUTE:
        return f"{link.label} {own.mission.routes[route].topic}"
    return f"{own.mission.prefix(code >> 8)[1:]} {link.label} {name}".strip()

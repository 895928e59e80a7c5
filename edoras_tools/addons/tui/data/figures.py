"""The rates of the packets that the list shows, by MsgId, and the values of a field, as plots."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from edoras_tools.decode.filters.filter import fields
from edoras_tools.decode.filters.rows import ColumnRows
from edoras_tools.links import table
from edoras_tools.model import NO_MSG_ID, NO_ROUTE, Columns
from edoras_tools.render.plot.figure import Figure, Panel, PlotLine, RateCounts, bar_seconds
from edoras_tools.wire.arrays import by_value

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from edoras_tools.addons.tui.data.store import Part
    from edoras_tools.decode.context import Context

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
    series = [(_name(key, context), item) for key, item in counts.items()]
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
        drawn.append(PlotLine(_name(key, context), 0, seconds, numbers, len(numbers)))
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
    """Return one number for spacecraft, link and MsgId of each row, i64; see ``_name``."""
    code = columns.spacecraft.astype(np.int64) << 8 | columns.link
    return code << _MSG_ID_BITS | (columns.msg_id.astype(np.int64) + 1)


def _name(key: int, context: Context) -> str:
    """Return the link and the topic, or the name of the MsgId."""
    code, msg_id = key >> _MSG_ID_BITS, (key & (1 << _MSG_ID_BITS) - 1) - 1
    link, own = table.link(code & 0xFF), context.of(code >> 8)
    name = context.name(msg_id) or f"0x{msg_id:04x}" if msg_id != NO_MSG_ID else ""
    route = int(context.routes_on(link)[msg_id]) if name else NO_ROUTE
    if route != NO_ROUTE:
        return f"{link.label} {own.mission.routes[route].topic}"
    return f"{own.mission.prefix(code >> 8)[1:]} {link.label} {name}".strip()

"""The rates of the packets that the list shows, by MsgId, as a plot."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from edoras_tools.links import table
from edoras_tools.model import NO_MSG_ID, NO_ROUTE
from edoras_tools.pipelines.plot_lines import RateCounts, bar_seconds
from edoras_tools.render.plot.figure import Figure, Panel

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from edoras_tools.addons.tui.data.store import Part
    from edoras_tools.decode.context import Context

_MOST_LINES: Final = 6
"""As many as a terminal has colours for."""
_MSG_ID_BITS: Final = 17


def rate_figure(
    parts: Sequence[Part], context: Context, begin_ns: int, given_up: Callable[[], bool]
) -> Figure | None:
    """Return the rates of packets; None if there is none, or it was given up.

    Args:
        parts: what ``Store.parts`` returned.
        begin_ns: the time that seconds count from, ns since 1970.
        given_up: asked between blocks.
    """
    counts: dict[int, RateCounts] = {}
    ends: list[float] = []
    for block, _, selection in parts:
        if given_up():
            return None
        rows = np.asarray(selection)
        seconds = (block.batch.time_ns[rows] - begin_ns) / 1e9
        ends += [float(seconds.min()), float(seconds.max())]
        msg_id = block.columns.msg_id[rows].astype(np.int64)
        code = block.columns.spacecraft[rows].astype(np.int64) << 8 | block.columns.link[rows]
        keys = code << _MSG_ID_BITS | (msg_id + 1)
        streams, places = np.unique(keys, return_inverse=True)
        for place, key in enumerate(streams.tolist()):
            counts.setdefault(key, RateCounts()).add(seconds[places == place])
    if not ends:
        return None
    span = min(0.0, *ends), max(*ends, 1e-3)
    ordered = sorted(counts.items(), key=lambda item: -item[1].total)
    named = [(_name(key, context), item) for key, item in ordered]
    if len(named) > _MOST_LINES:
        rest = RateCounts()
        for _, item in named[_MOST_LINES - 1 :]:
            rest.join(item)
        named = [*named[: _MOST_LINES - 1], (f"{len(named) - _MOST_LINES + 1} others", rest)]
    width = bar_seconds(span)
    lines = [item.line(0, span, width, label) for label, item in named]
    title = f"packets of the list, mean over {width:g} s"
    return Figure([""], [Panel(title, lines, "packets/s", beneath=True)], span)


def _name(key: int, context: Context) -> str:
    """Return the link and the topic, or the name of the MsgId."""
    code, msg_id = key >> _MSG_ID_BITS, (key & (1 << _MSG_ID_BITS) - 1) - 1
    link, own = table.link(code & 0xFF), context.of(code >> 8)
    name = context.name(msg_id) or f"0x{msg_id:04x}" if msg_id != NO_MSG_ID else ""
    route = int(context.routes_on(link)[msg_id]) if name else NO_ROUTE
    if route != NO_ROUTE:
        return f"{link.label} {own.mission.routes[route].topic}"
    return f"{own.mission.prefix(code >> 8)[1:]} {link.label} {name}".strip()

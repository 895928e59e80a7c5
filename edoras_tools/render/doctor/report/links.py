"""One picture of the links: what went into each hop, what came out, and what was lost there."""

from __future__ import annotations

from collections import Counter
from html import escape
from textwrap import wrap
from typing import TYPE_CHECKING, Any, Final

from edoras_tools.cfs.names import message_name
from edoras_tools.diagnosis.balance import summed
from edoras_tools.render.doctor import balance
from edoras_tools.render.doctor.report import charts
from edoras_tools.words import plural

if TYPE_CHECKING:
    from edoras_tools.diagnosis.balance import Row
    from edoras_tools.diagnosis.examination import Diagnosis

_MOST: Final = 12
_MOST_NAMES: Final = 2
_LINE, _GAP, _TITLE = 23, 22, 30
_ACROSS: Final = 3
_LETTERS: Final = 18
"""Letters in a line of a box, at a size that is readable on a phone."""
_REST: Final = tuple(
    (name, head.lower())
    for name, head in zip(balance.FIGURES, balance.HEADS, strict=True)
    if name not in {"in", "out"}
)


def links_picture(found: Diagnosis) -> str:
    """Return the picture: a line of boxes for the messages of one path; empty without messages."""
    ways: dict[tuple[Any, ...], list[Row]] = {}
    for row in summed(found.balance):
        ways.setdefault((row.route, row.link, row.msg_id, row.instance), []).append(row)
    lanes: dict[tuple[Any, ...], list[list[Row]]] = {}
    for (_, link, msg_id, _), rows in ways.items():
        own = rows[0].route not in found.topics and bool(message_name(msg_id or 0))
        lanes.setdefault((own, link, tuple(row.hop for row in rows)), []).append(rows)
    parts, top = [], 0
    for (own, link, hops), members in sorted(lanes.items(), key=lambda lane: lane[0][0])[:_MOST]:
        drawn, height = _lane(_title(found, link, members, own=own), link, hops, members)
        parts.append(f'<g transform="translate(0 {top})">{drawn}</g>')
        top += height
    if len(lanes) > _MOST:
        top += _LINE
        parts.append(f'<text x="0" y="{top - 6}">and {len(lanes) - _MOST} more, in the balance</text>')
    return (
        f'<div class="links">{charts.svg_box("".join(parts), top, "links and hops")}</div>' if parts else ""
    )


def _title(found: Diagnosis, link: str, members: list[list[Row]], *, own: bool) -> str:
    names = list(
        dict.fromkeys(
            found.topics.get(rows[0].route)
            or ("not known which" if rows[0].msg_id is None else f"0x{rows[0].msg_id:04x}")
            for rows in members
        )
    )
    told = ", ".join(names) if len(names) <= _MOST_NAMES else f"{len(names)} MsgIds"
    if own:
        told = f"{plural(len(names), 'MsgId')} of cFS itself"
    return f"{link.upper()}: {told}" if link else told


def _lane(title: str, link: str, hops: tuple[str, ...], members: list[list[Row]]) -> tuple[str, int]:
    """Return the boxes of one path, and their height."""
    boxes = []
    for place, hop in enumerate(hops):
        sums: Counter[str] = Counter()
        for rows in members:
            told = rows[place].as_json(None)
            sums.update({name: told[name] for name in balance.FIGURES})
        lines = [(text, "label") for text in wrap(hop, _LETTERS)]
        lines.append((f"{sums['in']:,} in, {sums['out']:,} out", ""))
        lines += [
            (f"{sums[name]:,} {text}", "bad" if name in {"lost", "unaccounted"} else "")
            for name, text in _REST
            if sums[name]
        ]
        boxes.append(lines)
    high = _LINE * max(map(len, boxes)) + 12
    wide = (charts.CHART_WIDTH - 2 - (_ACROSS - 1) * _GAP) / _ACROSS
    parts = [f'<text class="label" x="1" y="{_TITLE - 10}">{escape(title)}</text>']
    for place, lines in enumerate(boxes):
        row, column = divmod(place, _ACROSS)
        left, top = 1 + column * (wide + _GAP), _TITLE + row * (high + _GAP)
        style = f"hop {link}" + (" bad" if any(kind == "bad" for _, kind in lines) else "")
        parts.append(
            f'<rect class="{style}" x="{left:.0f}" y="{top}" width="{wide:.0f}" height="{high}" rx="5"/>'
        )
        if column:
            parts.append(
                f'<path class="arrow" d="M{left - _GAP + 3:.0f} {top + high // 2}h{_GAP - 6}'
                f'm-6 -5l6 5l-6 5"/>'
            )
        parts += [
            f'<text class="{kind}" x="{left + 10:.0f}" y="{top + _LINE * (at + 1)}">{escape(text)}</text>'
            for at, (text, kind) in enumerate(lines)
        ]
    return "".join(parts), _TITLE + -(-len(boxes) // _ACROSS) * (high + _GAP)

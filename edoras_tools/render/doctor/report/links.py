"""One picture of the links: what went into each hop, what came out, and what was lost there."""

from __future__ import annotations

from collections import Counter
from html import escape
from typing import TYPE_CHECKING, Any, Final

from edoras_tools.diagnosis.balance import summed
from edoras_tools.render.doctor import balance
from edoras_tools.words import plural

if TYPE_CHECKING:
    from edoras_tools.diagnosis.balance import Row
    from edoras_tools.diagnosis.examination import Diagnosis

_MOST: Final = 12
_MOST_NAMES: Final = 2
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
    for (_, link, _, _), rows in ways.items():
        own = rows[0].route not in found.topics and bool(rows[0].name)
        lanes.setdefault((own, link, tuple(row.hop for row in rows)), []).append(rows)
    shown = sorted(lanes.items(), key=lambda lane: lane[0][0])[:_MOST]
    parts = [
        f"<h3>{escape(_title(found, link, members, own=own))}</h3>{_lane(link, hops, members)}"
        for (own, link, hops), members in shown
    ]
    if len(lanes) > _MOST:
        parts.append(f'<p class="dim">and {len(lanes) - _MOST} more, in the balance</p>')
    return f'<div class="links">{"".join(parts)}</div>' if parts else ""


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


def _lane(link: str, hops: tuple[str, ...], members: list[list[Row]]) -> str:
    """Return the boxes of one path."""
    boxes = []
    for place, hop in enumerate(hops):
        sums: Counter[str] = Counter()
        for rows in members:
            told = rows[place].as_json(None)
            sums.update({name: told[name] for name in balance.FIGURES})
        bad = " bad" if sums["lost"] or sums["unaccounted"] else ""
        figures = [(f"{sums['in']:,} in, {sums['out']:,} out", "dim")] + [
            (f"{sums[name]:,} {text}", "lost" if name in {"lost", "unaccounted"} else "dim")
            for name, text in _REST
            if sums[name]
        ]
        lines = "".join(f'<span class="{kind}">{text}</span>' for text, kind in figures)
        boxes.append(f'<li class="hop {link}{bad}"><strong>{escape(hop)}</strong>{lines}</li>')
    return f"<ol>{''.join(boxes)}</ol>"

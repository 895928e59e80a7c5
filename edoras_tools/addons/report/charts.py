"""The pictures of a report, and their data: the balance as a Sankey diagram, routes and charts over time."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from html import escape
from typing import TYPE_CHECKING, Any, Final

import msgspec
import numpy as np

from edoras_tools.cfs.names import MSG_ID_NAMES
from edoras_tools.diagnosis.accounts import clean_rate
from edoras_tools.diagnosis.balance import ways
from edoras_tools.diagnosis.evidence.instances import NOBODY
from edoras_tools.diagnosis.ledger import ENDING_TEXTS, ENDINGS, Row, cause_text, summed
from edoras_tools.model import NO_ROUTE
from edoras_tools.render.pages import BOTTOM, CHART_WIDTH, LEFT, TOP, Frame, TimeSpan, svg_box
from edoras_tools.render.terminal.text import clean, clip
from edoras_tools.units import SECOND
from edoras_tools.words import plural

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from edoras_tools.diagnosis.accounting.losses import Fate
    from edoras_tools.diagnosis.case import Case
    from edoras_tools.diagnosis.examination import Diagnosis
    from edoras_tools.diagnosis.matching.crossing import Hop
    from edoras_tools.diagnosis.matching.streams import Stream
    from edoras_tools.diagnosis.verdict import Choice


_MOST_LANES: Final = 8
_BAND: Final = 64.0
"""Height of the widest band."""
_NODE, _LINE = 8, 15
_LEFT: Final = 12


class Band(msgspec.Struct, frozen=True):
    """Messages that go on from one hop, or end there; the width of the band is to scale.

    Attributes:
        hop: hop at which the band starts.
        ending: ``out``, or how the messages ended.
        number: number of messages.
        text: the ending for people.
    """

    hop: str
    ending: str
    number: int
    text: str


def bands(row: Row) -> list[Band]:
    """Return the bands of a hop; their numbers add up to the messages that came, and copies."""
    members = [Band(row.hop, "out", row.out, "went on")]
    members += [Band(row.hop, "lost", number, cause_text(cause)) for cause, number in row.lost.items()]
    for ending in ENDINGS[1:]:
        members.append(Band(row.hop, ending, getattr(row, ending), ENDING_TEXTS[ending]))
    return [item for item in members if item.number or item.ending == "out"]


def sankey(result: Diagnosis) -> str:
    """Draw the balance: a lane for each route, widths in proportion to messages; empty without any."""
    everything = [
        way for way in ways(summed(result.balance)) if way.hops[0].came and way.hops[0].msg_id is not None
    ]
    routes = [way for way in everything if way.hops[0].route != NO_ROUTE] or [
        way for way in everything if not way.hops[0].name
    ]
    routes.sort(key=lambda way: (-sum(row.proven for row in way.hops), -way.hops[0].came))
    lanes, rest = routes[:_MOST_LANES], len(routes) - _MOST_LANES
    if not lanes:
        return ""
    most = max(max(row.came + row.duplicated, row.out) for way in lanes for row in way.hops)
    columns = max(len(way.hops) for way in lanes)
    y, drawn, texts = 8.0, [], []
    for way in lanes:
        topic = result.topics.get(way.hops[0].route) or way.hops[0].topic or f"0x{way.hops[0].msg_id:04x}"
        inside, y = _lane(topic, way.hops, y, _BAND / most, columns)
        drawn.append(inside)
        ends = [band for row in way.hops for band in bands(row) if band.ending != "out"]
        losses = "".join(f", {band.number:,} {band.text} at {band.hop}" for band in ends)
        texts.append(f"{topic}: {way.hops[0].came:,} sent, {way.hops[-1].out:,} came out{losses}")
    if rest > 0:
        drawn.append(
            f'<text x="{_LEFT}" y="{y + 12}">and {plural(rest, "more route")}, in the balance</text>'
        )
        y += 20
    box = svg_box("".join(drawn), round(y), f"What became of the messages. {'. '.join(texts)}")
    return box.replace("<svg", '<svg class="wide"', 1)  # letters sized for a phone do not fit between hops


def _lane(topic: str, hops: Sequence[Row], y: float, scale: float, columns: int) -> tuple[str, float]:
    """Draw the path of one route; return it and the y coordinate where the next one begins."""
    step = (CHART_WIDTH - 2 * _LEFT - 60) / columns
    name = f"{topic}, {hops[0].link.upper()}: {hops[0].came:,}"
    out = [f'<text class="label" x="{_LEFT}" y="{y + 12:.1f}">{escape(clip(clean(name), 90))}</text>']
    top, bottom = y + 34, y + 34
    for place, row in enumerate(hops):
        x = _LEFT + place * step
        height = (row.came + row.duplicated) * scale
        out.append(
            f'<text x="{x:.1f}" y="{top - 5:.1f}">{escape(clip(clean(row.hop), int(step / 6.2)))}</text>'
        )
        out.append(f'<rect class="node" x="{x:.1f}" y="{top:.2f}" width="{_NODE}" height="{height:.2f}"/>')
        at, below = top, top + max(row.out * scale, (hops[0].came * scale)) + 8
        for band in bands(row):
            wide = band.number * scale
            begin, end = x + _NODE, x + step
            if band.ending == "out":
                out.append(_band(row.link, band, (begin, at), (end, top), wide))
                out.append(
                    f'<text class="label" x="{end - 6:.1f}" y="{at + wide / 2 + 4:.1f}" text-anchor="end">'
                )
                out.append(f"{band.number:,}</text>")
            else:
                tip = begin + min(46.0, step / 3)
                out.append(_band(row.link, band, (begin, at), (tip, below), wide))
                text = clip(clean(f"{band.number:,} {band.text}"), int((CHART_WIDTH - tip) / 5.8))
                out.append(f'<text x="{tip + 4:.1f}" y="{below + wide / 2 + 4:.1f}">{escape(text)}</text>')
                below += max(wide, _LINE) + 3
            at += wide
        bottom = max(bottom, below, top + height)
    return "".join(out), bottom + 14


def _band(link: str, band: Band, begin: tuple[float, float], end: tuple[float, float], wide: float) -> str:
    """Draw a band between two places; ``wide`` is its constant width."""
    (x, y), (to_x, to_y) = begin, end
    middle = (x + to_x) / 2
    style = f"seen {link}" if band.ending == "out" else "missing" if band.ending in _GONE else "rest"
    title = f"{band.hop}: {band.number:,} {band.text}"
    return (
        f'<path class="band {style}" data-number="{band.number}" data-width="{wide:.4f}" '
        f'd="M{x:.1f} {y:.2f}C{middle:.1f} {y:.2f} {middle:.1f} {to_y:.2f} {to_x:.1f} {to_y:.2f}'
        f"V{to_y + wide:.2f}C{middle:.1f} {to_y + wide:.2f} {middle:.1f} {y + wide:.2f} {x:.1f} "
        f'{y + wide:.2f}Z"><title>{escape(clean(title))}</title></path>'
    )


_GONE: Final = frozenset({"lost", "unaccounted"})
_STRIP: Final = 20


def strip(drawn: Plots) -> str:
    """Draw all routes over time: where messages came, where some were lost, and where none came."""
    rows = [row for row in drawn.rates if any(row["seen"]) or any(row["missing"])]
    if not rows:
        return ""
    height = _STRIP * 2 * len(rows) + 44
    names = [f"{row['label']}, {row['link'].upper()}" for row in rows]
    texts = "; ".join(f"{name}: {_became(row, drawn)}" for name, row in zip(names, rows, strict=True))
    frame = Frame(drawn, 1.0, "", f"Routes over time. {texts}", height)
    inside = []
    for place, (name, row) in enumerate(zip(names, rows, strict=True)):
        top = 4 + place * _STRIP * 2
        inside.append(f'<text x="{frame.x(0)}" y="{top + 12}">{escape(clean(name))}</text>')
        inside += list(_cells(frame, row, drawn, top + 17))
    return svg_box("".join([*inside, *frame.seconds()]), height, frame.title)


def _became(row: dict[str, Any], drawn: Plots) -> str:
    quiet = [not rate and not gap for rate, gap in zip(row["seen"], row["missing"], strict=True)]
    lost, silent = sum(row["missing"]) * drawn.bin_s, sum(quiet) * drawn.bin_s
    return f"{lost:,.0f} lost, {silent:.0f} s without a message"


def _cells(frame: Frame, row: dict[str, Any], drawn: Plots, top: int) -> Iterator[str]:
    """Yield runs of bins of one kind, each as one bar."""
    kinds = [
        "missing" if gap else f"seen {row['link']}" if rate else "silence"
        for rate, gap in zip(row["seen"], row["missing"], strict=True)
    ]
    first = 0
    for place in range(1, len(kinds) + 1):
        if place == len(kinds) or kinds[place] != kinds[first]:
            begin, end = frame.x(first * drawn.bin_s), frame.x(min(place * drawn.bin_s, frame.x_most))
            lost = sum(row["missing"][first:place]) * drawn.bin_s
            about = f"{lost:.0f} lost" if lost else kinds[first].partition(" ")[0]
            yield (
                f'<rect class="{kinds[first]}" x="{begin}" y="{top}" width="{max(0.5, end - begin):.1f}" '
                f'height="{_STRIP - 6}"><title>{about}</title></rect>'
            )
            first = place


_ROW: Final = 36


def rate_chart(row: Mapping[str, Any], drawn: Plots) -> str:
    """Return a route's rate: messages that arrived, lost ones on top, and the clean rate as a line."""
    total = [a + b for a, b in zip(row["seen"], row["missing"], strict=True)]
    peak = max(total, default=1.0)
    clean = row["limit"] or 0.0
    most = max(peak, clean if clean < 4 * peak else 0.0)
    frame = Frame(drawn, most, "per second", f"rate of {row['label']}")
    frame.bars(row["seen"], [0.0] * len(total), drawn.bin_s, f"seen {row['link']}")
    frame.bars(row["missing"], row["seen"], drawn.bin_s, "missing")
    if clean:
        frame.level(clean, "limit", f"clean to {clean:g}/s, {row['limit_from']}")
    return frame.svg()


def delays(row: Mapping[str, Any], drawn: Plots) -> str:
    """Return the delays of a path through cFS, over time."""
    frame = Frame(drawn, max(row["delays"], default=1.0), "ms", f"latency of {row['label']}")
    frame.dots(list(zip(row["times"], row["delays"], strict=True)), "dot")
    return frame.svg()


def counters(row: Mapping[str, Any], drawn: Plots) -> str:
    """Return the growth of the loss counters of a cFS."""
    most = max([*row["limits"], *row["overflows"], 1])
    frame = Frame(drawn, most, "messages", f"loss counters of {row['label']}")
    for name, style in (("limits", "limits"), ("overflows", "overflows")):
        frame.line(list(zip(row["times"], row[name], strict=True)), style)
    return frame.svg()


def timeline(drawn: Plots) -> str:
    """Return connections as bars and events as ticks, over time."""
    peers, events = drawn.peers, drawn.events
    height = _ROW * (len(peers) + bool(events)) + BOTTOM + TOP
    frame = Frame(drawn, 1.0, "", "connections and events", height)
    parts = []
    for at, row in enumerate(peers):
        top = TOP + _ROW * at
        parts.append(f'<text x="{LEFT}" y="{top + 12}">{escape(row["label"])}</text>')
        for state in row["states"]:
            begin, right = frame.x(state["from"]), frame.x(min(state["to"], drawn.seconds))
            when = f"{drawn.begin + state['from']:.1f} s: {state['why']}"
            label = escape(f"{state['state'].replace('_', ' ')} at {when}")
            parts.append(
                f'<rect class="{state["state"]}" x="{begin}" y="{top + 17}" height="11" '
                f'width="{max(right - begin, 1.5):.1f}"><title>{label}</title></rect>'
            )
    if events:
        top = TOP + _ROW * len(peers)
        parts.append(f'<text x="{LEFT}" y="{top + 12}">events</text>')
        for item in events:
            x, grade = frame.x(item["time"]), "error" if item["type"] >= 3 else "info"
            label = escape(f"{drawn.begin + item['time']:.1f} s {item['text']}")
            parts.append(
                f'<line class="event {grade}" x1="{x}" x2="{x}" y1="{top + 17}" y2="{top + 28}">'
                f"<title>{label}</title></line>"
            )
    parts += frame.seconds()
    return svg_box("".join(parts), height, frame.title)


_BINS: Final = 240
_MOST_POINTS: Final = 1500
_MOST_EVENTS: Final = 400


class Plots(TimeSpan, frozen=True):
    """The data of all charts; times are in s from the first examined datagram.

    Attributes:
        begin: time of the origin, s from the start of the capture; more than 0 if only a part is examined.
        seconds: length of the examined period.
        bin_s: width of a bin of the rates.
        rates: a row for each route: label, link, seen and missing messages a second by bin, clean rate.
        delays: a row for each path through cFS: label, times, delays in ms.
        sizes: a row for each route: label, largest datagram, and size of the buffer that has to hold it.
        counters: a row for each cFS: label, times, messages lost over a limit, and by full pipes.
        events: time, severity, text.
        peers: a row for each connection: label, and its states as (from, to, state).
    """

    bin_s: float
    rates: list[dict[str, Any]]
    delays: list[dict[str, Any]]
    sizes: list[dict[str, Any]]
    counters: list[dict[str, Any]]
    events: list[dict[str, Any]]
    peers: list[dict[str, Any]]


def plots(case: Case, choice: Choice | None = None) -> Plots:
    """Compute the data of all charts.

    Args:
        choice: links and MsgIds to include; None for all.
    """
    seconds = max((case.end_ns - case.start_ns) / SECOND, 1e-3)
    bin_s = max(1.0, seconds / _BINS)
    streams = [
        item for item in case.streams if item.route != NO_ROUTE or item.msg_id not in MSG_ID_NAMES
    ] or case.streams
    if choice is not None:
        streams = [item for item in case.streams if choice.takes(item.link.label, item.msg_id)]
    return Plots(
        begin=(case.start_ns - case.zero_ns) / SECOND,
        seconds=seconds,
        bin_s=bin_s,
        rates=_told_apart([(_rate(case, item, bin_s, seconds), _whose(case, item)) for item in streams]),
        delays=_told_apart(
            [(_delay(case, item), _whose(case, item.out)) for item in case.hops if _shows(item, choice)]
        ),
        sizes=_told_apart([(_size(case, item), _whose(case, item)) for item in streams]),
        counters=_counters(case),
        events=[
            {"time": _at(case, item.time_ns), "type": item.event_type, "text": str(item), "who": item.sender}
            for item in case.payloads.events[:_MOST_EVENTS]
        ],
        peers=_peers(case, seconds),
    )


def _at(case: Case, time_ns: int) -> float:
    return round((time_ns - case.start_ns) / SECOND, 4)


def _label(case: Case, stream: Stream) -> str:
    return "the robot" if stream.link.last_hop else case.name(stream.msg_id)


def _whose(case: Case, stream: Stream) -> str:
    """Return the owner of a stream: the cFS that makes it and the stream's first time, else an endpoint."""
    if stream.instance != NOBODY:
        begin = _at(case, int(case.rows.time_ns[stream.rows[0]]))
        return f"{case.label(stream.instance)}, from {begin:.1f} s"
    end = stream.receiver if stream.sender < 0 else stream.sender
    return str(case.endpoints[end])


def _told_apart(rows: Sequence[tuple[dict[str, Any], str]]) -> list[dict[str, Any]]:
    """Return rows; labels that are equal get the owner of their stream."""
    same = Counter((row["label"], row.get("link")) for row, _ in rows)
    return [
        {**row, "label": f"{row['label']} ({whose})"} if same[row["label"], row.get("link")] > 1 else row
        for row, whose in rows
    ]


def _rate(case: Case, stream: Stream, bin_s: float, seconds: float) -> dict[str, Any]:
    times = (case.rows.time_ns[stream.rows] - case.start_ns) / SECOND
    count = int(seconds / bin_s) + 1
    index = np.clip((times / bin_s).astype(np.int64), 0, count - 1)
    visible = np.bincount(index, minlength=count) / bin_s
    fate = case.commands.fates.get(stream)
    if fate is None:
        missing = _never_came(case, stream)
        # Missing messages were due at even steps up to the next one that came.
        place = np.arange(int(missing.sum())) - np.repeat(np.cumsum(missing) - missing, missing)
        steps = np.append(np.diff(times), 0.0) / (missing + 1)
        due = np.repeat(times, missing) + np.repeat(steps, missing) * (place + 1)
        lost = np.bincount(np.clip((due / bin_s).astype(np.int64), 0, count - 1), minlength=count) / bin_s
    else:  # messages lost behind the capture were seen in it
        lost = np.bincount(index, weights=_not_arrived(case, fate), minlength=count) / bin_s
        visible -= lost
    clean_hz, told_by = clean_rate(case, stream)
    return {
        "label": _label(case, stream),
        "link": stream.link.label,
        "seen": np.round(visible, 2).tolist(),
        "missing": np.round(lost, 2).tolist(),
        "limit": clean_hz,
        "limit_from": told_by,
    }


def _never_came(case: Case, stream: Stream) -> NDArray[np.int64]:
    """Return how much telemetry is drawn as lost behind each row: gaps in counts, and what counters add.

    Messages missing over a pause are drawn only if a loss covers them, because the path may have been closed.
    """
    times = case.rows.time_ns[stream.rows]
    counts = np.where(stream.pauses, 0, stream.missing).astype(np.int64)
    own = case.losses_of(stream)
    closed = [int(np.searchsorted(times, loss.start_ns)) for loss in own if loss.closed]
    counts[closed] = 0
    for loss in own:
        if loss.closed:
            counts[np.searchsorted(times, loss.start_ns)] += loss.lost
        else:
            rows = np.flatnonzero((times >= loss.start_ns) & (times <= loss.end_ns))
            counts[rows] = stream.missing[rows]
            if len(rows):
                counts[rows[-1]] += max(0, loss.lost - int(counts[rows].sum()))
    return counts


def _not_arrived(case: Case, fate: Fate) -> NDArray[np.bool_]:
    """Return which commands are drawn as lost, bool (n,): of those that did not arrive, the number in losses.

    If the output cannot be seen, they are spread over all commands sent in the meantime.
    """
    times = case.rows.time_ns[fate.stream.rows]
    candidates = ~fate.arrived
    for loss in case.losses:
        if loss.stream is fate.stream:
            rows = np.flatnonzero(candidates & (times >= loss.start_ns) & (times <= loss.end_ns))
            number = min(loss.lost, len(rows))
            candidates[rows[np.linspace(0, len(rows) - 1, number).round().astype(np.intp)]] = False
    return ~candidates & ~fate.arrived


def _shows(hop: Hop, choice: Choice | None) -> bool:
    if choice is not None and not choice.takes(hop.into.link.label, hop.into.msg_id):
        return False
    return bool(len(hop.delays_ns)) and hop.out.msg_id not in MSG_ID_NAMES


def _delay(case: Case, hop: Hop) -> dict[str, Any]:
    step = max(1, len(hop.delays_ns) // _MOST_POINTS)
    times: NDArray[Any] = (hop.out_ns[::step] - case.start_ns) / SECOND
    return {
        "label": f"{_label(case, hop.into)} to {_label(case, hop.out)}",
        "times": np.round(times, 3).tolist(),
        "delays": np.round(hop.delays_ns[::step] / 1e6, 3).tolist(),
        "latency": hop.latency.as_json() if hop.latency else None,
    }


def _size(case: Case, stream: Stream) -> dict[str, Any]:
    largest = int(case.rows.length[stream.rows].max())
    room = case.profile.ci_buffer if stream.link.only_to_cfs else stream.link.receive_buffer or 4096
    return {"label": _label(case, stream), "link": stream.link.label, "bytes": largest, "room": room}


def _counters(case: Case) -> list[dict[str, Any]]:
    return [
        {
            "label": case.label(instance),
            "times": [_at(case, time_ns) for time_ns in track.times],
            "limits": track.totals["msg_limits"],
            "overflows": track.totals["pipe_overflows"],
        }
        for instance, track in case.tracks.items()
    ]


def _peers(case: Case, seconds: float) -> list[dict[str, Any]]:
    rows = []
    for connection in case.network.connections.values():
        changes = connection.changes
        if not changes:
            continue
        ends = [_at(case, change.time_ns) for change in changes[1:]] + [seconds]
        rows.append(
            {
                "label": f"{connection.peer} seen by {connection.observer}",
                "states": [
                    {"from": _at(case, change.time_ns), "to": end, "state": change.state, "why": change.why}
                    for change, end in zip(changes, ends, strict=True)
                ],
            }
        )
    return rows

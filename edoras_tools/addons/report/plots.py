"""The data of a report's charts: rates and limits, gaps, latencies, events and connections over time."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from edoras_tools.cfs.names import MSG_ID_NAMES
from edoras_tools.diagnosis.accounts import clean_rate
from edoras_tools.diagnosis.evidence.instances import NOBODY
from edoras_tools.model import NO_ROUTE
from edoras_tools.render.pages.charts import TimeSpan
from edoras_tools.units import SECOND

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from edoras_tools.diagnosis.accounting.losses import Fate
    from edoras_tools.diagnosis.case import Case
    from edoras_tools.diagnosis.matching.crossing import Hop
    from edoras_tools.diagnosis.matching.streams import Stream
    from edoras_tools.diagnosis.verdict import Choice

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
        return (
            f"{case.label(stream.instance)}, from {_at(case, int(case.rows.time_ns[stream.rows[0]])):.1f} s"
        )
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

"""What a report draws: rates against limits, gaps, latencies, events and connections over time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from edoras_tools.diagnosis.budget import limit
from edoras_tools.model import NO_ROUTE, Link
from edoras_tools.sessions.profile import SECOND
from edoras_tools.wire.limits import BRIDGE_BUFFER
from edoras_tools.wire.names import MSG_ID_NAMES

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from edoras_tools.diagnosis.case import Case
    from edoras_tools.diagnosis.streams import Stream

_BINS: Final = 240
_MOST_POINTS: Final = 1500
_MOST_EVENTS: Final = 400


@dataclass(frozen=True, slots=True)
class Plots:
    """All of them, times in s from the start of the capture.

    Attributes:
        seconds: length of the capture.
        bin_s: width of a bin of the rates.
        rates: a row a route: label, link, seen and missing a second by bin, clean rate.
        delays: a row a way through cFS: label, times, delays in ms.
        sizes: a row a route: label, largest datagram, and the buffer that it has to fit.
        counters: a row a cFS: label, times, messages lost over a limit, and by full pipes.
        events: time, severity, text.
        peers: a row a connection: label, and its states as (from, to, state).
    """

    seconds: float
    bin_s: float
    rates: list[dict[str, Any]]
    delays: list[dict[str, Any]]
    sizes: list[dict[str, Any]]
    counters: list[dict[str, Any]]
    events: list[dict[str, Any]]
    peers: list[dict[str, Any]]


def plots(case: Case) -> Plots:
    """Work out what there is to draw."""
    seconds = max((case.end_ns - case.start_ns) / SECOND, 1e-3)
    bin_s = max(1.0, seconds / _BINS)
    shown = [
        item for item in case.streams if item.route != NO_ROUTE or item.msg_id not in MSG_ID_NAMES
    ] or case.streams
    return Plots(
        seconds=seconds,
        bin_s=bin_s,
        rates=[_rate(case, item, bin_s, seconds) for item in shown],
        delays=[_delay(case, item) for item in range(len(case.hops)) if _shows(case, item)],
        sizes=[_size(case, item) for item in shown],
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
    return case.name(stream.msg_id)


def _rate(case: Case, stream: Stream, bin_s: float, seconds: float) -> dict[str, Any]:
    times = (case.rows.time_ns[stream.rows] - case.start_ns) / SECOND
    count = int(seconds / bin_s) + 1
    index = np.clip((times / bin_s).astype(np.int64), 0, count - 1)
    seen = np.bincount(index, minlength=count) / bin_s
    missing = np.where(stream.pauses, 0, stream.missing)
    gone = np.bincount(index, weights=missing, minlength=count) / bin_s
    to_cfs = bool(stream.msg_id & 0x1000)
    clean, _, _ = limit(stream.link, stream.msg_id, case.profile, to_cfs=to_cfs)
    return {
        "label": _label(case, stream),
        "link": stream.link.label,
        "seen": np.round(seen, 2).tolist(),
        "missing": np.round(gone, 2).tolist(),
        "limit": clean or None,
    }


def _shows(case: Case, index: int) -> bool:
    hop = case.hops[index]
    return bool(len(hop.delays_ns)) and hop.out.msg_id not in MSG_ID_NAMES


def _delay(case: Case, index: int) -> dict[str, Any]:
    hop = case.hops[index]
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
    room = {Link.CI: case.profile.ci_buffer, Link.TO: BRIDGE_BUFFER}.get(stream.link, 4096)
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

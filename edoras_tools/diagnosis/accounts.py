"""The account of each route: sent, seen, lost, how fast, how late, and what it could carry."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from edoras_tools.diagnosis.budget import limit
from edoras_tools.diagnosis.instances import NOBODY
from edoras_tools.diagnosis.matching import summary
from edoras_tools.diagnosis.spans import comb
from edoras_tools.model import NO_ROUTE, Link
from edoras_tools.sessions.profile import SECOND
from edoras_tools.wire.names import MSG_ID_NAMES, message_name

if TYPE_CHECKING:
    from edoras_tools.diagnosis.case import Case
    from edoras_tools.diagnosis.matching import Latency
    from edoras_tools.diagnosis.streams import Stream

_ROUND = 10
"""A period within a tenth of a task's is that task's."""


def accounts(case: Case) -> list[dict[str, Any]]:
    """Return a row for every stream, in the shape of ``doctor --json``: configured topics first."""
    order = sorted(
        case.streams,
        key=lambda item: (item.route == NO_ROUTE, item.msg_id in MSG_ID_NAMES, item.link, item.msg_id),
    )
    return [_row(case, stream) for stream in order]


def _row(case: Case, stream: Stream) -> dict[str, Any]:
    rows, own = case.rows, stream.rows
    route = case.mission.routes[stream.route] if stream.route != NO_ROUTE else None
    times = rows.time_ns[own]
    losses = [loss for loss in case.losses if loss.stream is stream]
    lost = sum(loss.lost for loss in losses)
    seconds = float(times[-1] - times[0]) / SECOND
    to_cfs = route.to_cfs if route else bool(stream.msg_id & 0x1000)
    clean, _, _ = limit(stream.link, stream.msg_id, case.profile, to_cfs=to_cfs)
    rounds = comb(times)
    behind = stream.link is Link.CI or (stream.link is Link.SBN and to_cfs)
    return {
        "topic": route.topic if route else None,
        "type": route.type if route else None,
        "name": message_name(stream.msg_id) or None,
        "link": stream.link.label,
        "msg_id": f"0x{stream.msg_id:04x}",
        "sender": str(case.endpoints[stream.sender]),
        "receiver": str(case.endpoints[stream.receiver]),
        "instance": case.label(stream.instance) if stream.instance != NOBODY else None,
        "sent": len(stream) if behind else len(stream) + lost,
        "seen": len(stream),
        "lost": lost,
        "rate_hz": round((len(stream) - 1) / seconds, 3) if seconds > 0 else 0.0,
        "limit_hz": clean or None,
        "counted": stream.counted,
        "gaps": stream.gaps,
        "duplicates": stream.duplicates,
        "reordered": stream.reordered,
        "restarts": stream.restarts,
        "bytes_max": int(rows.length[own].max()),
        "comb_ms": round(rounds.period_ns / 1e6, 1) if _named(case, rounds.period_ns) else None,
        "delay": _json(_delay(case, stream)),
        "crossings": [
            {
                "from": f"0x{hop.into.msg_id:04x}",
                "from_link": hop.into.link.label,
                "of": hop.of,
                "matched": hop.matched,
                "superseded": hop.superseded,
                "missing": len(hop.missing),
                "latency": _json(hop.latency),
            }
            for hop in case.hops
            if hop.out is stream
        ],
    }


def _named(case: Case, period_ns: int) -> bool:
    """Tell whether a period is that of a task that wakes up now and then."""
    return any(
        abs(period_ns - own) < own // _ROUND for own in (case.profile.to_wake_ns, case.profile.sbn_wake_ns)
    )


def _delay(case: Case, stream: Stream) -> Latency | None:
    """Return how long telemetry waited between publication and the wire, more than its luckiest packet."""
    mission = case.rows.mission_time_ns[stream.rows]
    timed = (case.instances.of_row[stream.rows] == stream.instance) & (mission > 0)
    if stream.link is Link.CI or stream.instance == NOBODY or not timed.any():
        return None
    offset = case.instances.items[stream.instance].offset_ns
    return summary(np.asarray(case.rows.time_ns[stream.rows][timed] - mission[timed] - offset))


def _json(latency: Latency | None) -> dict[str, Any] | None:
    return latency.as_json() if latency else None

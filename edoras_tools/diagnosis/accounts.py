"""The account of each stream for ``doctor --json``: messages sent and lost, rate, delay, and safe rate."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING, Any, Final, Literal

from edoras_tools.cfs.names import MSG_ID_NAMES, message_name
from edoras_tools.diagnosis.accounting.budget import limit
from edoras_tools.diagnosis.accounting.losses import COUNTERS
from edoras_tools.diagnosis.advice import clean_round
from edoras_tools.diagnosis.evidence.instances import NOBODY
from edoras_tools.diagnosis.evidence.relays import PROXY_HOP
from edoras_tools.diagnosis.ledger import DAMAGED
from edoras_tools.diagnosis.matching.crossing import Hop, Latency, latency_of
from edoras_tools.diagnosis.matching.streams import Stream, comb
from edoras_tools.model import NO_ROUTE, rate_hz

if TYPE_CHECKING:
    from collections.abc import Mapping

    from edoras_tools.diagnosis.case import Case
    from edoras_tools.diagnosis.ledger import LedgerWay

_ROUND: Final = 10
"""A period within this part (a tenth) of a task's period belongs to that task."""
_OVER: Final = 1.1
"""A rate without loss this many times above the assumed limit disproves that limit."""


def accounts(case: Case) -> list[dict[str, Any]]:
    """Return one row for each stream, in the shape of ``doctor --json``: configured topics first."""
    order = sorted(
        case.streams,
        key=lambda item: (item.route == NO_ROUTE, item.msg_id in MSG_ID_NAMES, item.link, item.msg_id),
    )
    ways = dict(zip(case.streams, case.ledger.ways, strict=False))
    more = Counter[tuple[str, int | None]]()  # what came out damaged is lost, too
    for way in case.ledger.ways[len(order) :]:
        more[way.traffic.link, way.traffic.msg_id] += sum(row.all_lost for row in way.rows())
    return [_row(case, item, ways[item], more.pop((item.link.label, item.msg_id), 0)) for item in order]


def _row(case: Case, stream: Stream, way: LedgerWay, damaged: int) -> dict[str, Any]:
    rows, own = case.rows, stream.rows
    route = case.mission.routes[stream.route] if stream.route != NO_ROUTE else None
    source = route or case.own_struct(stream.msg_id)
    times, onward = rows.time_ns[own], [hop for hop in case.hops if hop.into is stream]
    to_cfs = route.to_cfs if route else stream.is_command
    clean_hz, told_by = clean_rate(case, stream)
    rounds, tasks = comb(times), (case.profile.to_wake_ns, case.profile.sbn_wake_ns)
    is_task = any(abs(rounds.period_ns - period) < period // _ROUND for period in tasks)
    lost = sum((Counter(row.lost) for row in way.rows()), Counter[str]())
    behind = not (stream.link.only_to_cfs or (stream.link.peers and to_cfs))  # captured behind what loses it
    absent = lost[DAMAGED] + lost[PROXY_HOP]
    absent += sum(loss.lost * (behind - (loss.kind == DAMAGED)) for loss in case.losses_of(stream))
    return {
        "topic": source.topic if source else None,
        "type": source.type if source else None,
        "name": message_name(stream.known_id) or case.packet_name(stream.msg_id) or None,
        "link": stream.link.label,
        "msg_id": f"0x{stream.msg_id:04x}",
        "sender": str(case.endpoints[stream.sender]),
        "receiver": str(case.endpoints[stream.receiver]),
        "instance": case.label(stream.instance) if stream.instance != NOBODY else None,
        "sent": len(stream) + absent,
        "seen": len(stream),
        "lost": lost.total() + damaged,
        "rate_hz": round(rate_hz(len(stream), int(times[-1]) - int(times[0])), 3),
        "limit_hz": clean_hz,
        "limit_from": told_by,
        "counted": stream.counted,
        "gaps": stream.gaps,
        "duplicates": stream.duplicates,
        "reordered": stream.reordered,
        "restarts": stream.restarts,
        "bytes_max": int(rows.length[own].max()),
        "comb_ms": round(rounds.period_ns / 1e6, 1) if is_task else None,
        "delay": _json(_delay(case, stream)),
        "to_robot": next((_json(hop.latency) for hop in onward if hop.out.link.last_hop), None),
        "crossings": [_crossing(case, hop) for hop in case.hops if hop.out is stream],
    }


def _crossing(case: Case, hop: Hop) -> dict[str, Any]:
    """Return the figures of one pair of streams in and out of cFS."""
    fate = case.commands.fates.get(hop.into)
    return {
        "from": f"0x{hop.into.msg_id:04x}",
        "from_link": hop.into.link.label,
        "of": hop.of,
        "matched": hop.matched,
        "superseded": fate.ends["superseded"] if fate else 0,
        "missing": fate.ends["unaccounted"] if fate else 0,
        "latency": _json(hop.latency),
    }


def latency_ms(row: Mapping[str, Any]) -> float | None:
    """Return the 99 % quantile of the delay in a row's slowest part, ms; None without any delay."""
    parts = [item["latency"] for item in row["crossings"]] + [row["delay"], row["to_robot"]]
    return max((item["p99_ms"] for item in parts if item), default=None)


def clean_rate(case: Case, stream: Stream) -> tuple[float | None, Literal["measured", "assumed"] | None]:
    """Return the highest rate, Hz, at which a stream gets through, and its origin; None if unknown.

    It is measured if messages were lost at a pipe that is emptied in rounds, and the stream shows these
    rounds. Else it follows from assumed constants of cFS, unless a higher rate got through without loss.
    Constants from a mission or an option count as measured.
    """
    lost_at_pipe = [loss for loss in case.losses_of(stream) if loss.kind in COUNTERS]
    route = case.mission.routes[stream.route] if stream.route != NO_ROUTE else None
    to_cfs = route.to_cfs if route else stream.is_command
    rounds = [] if to_cfs else [clean_round(case, loss) for loss in lost_at_pipe]
    if rates := [queue.rate_hz(most) for queue, most, measured in rounds if measured]:
        return round(max(rates), 1), "measured"
    assumed_hz, _, _, names = limit(stream.link, stream.msg_id, case.profile, to_cfs=to_cfs)
    if lost_at_pipe and assumed_hz and (lossless_hz := case.lossless_hz(stream, assumed_hz)):
        return round(lossless_hz, 1), "measured"
    fate = case.commands.fates.get(stream)
    arrives = fate.seen if fate is not None else stream.link.only_from_cfs
    fastest_hz = max((span.offered_hz for span in stream.spans), default=0.0)
    if not assumed_hz or (arrives and not lost_at_pipe and fastest_hz > _OVER * assumed_hz):
        return None, None
    return assumed_hz, "measured" if case.origin(*names) == "told" else "assumed"


def _delay(case: Case, stream: Stream) -> Latency | None:
    """Return the delay of telemetry from publication to the wire, above the smallest one of its instance."""
    if stream.link.only_to_cfs or stream.instance == NOBODY:
        return None
    own = stream.rows[case.instances.of_row[stream.rows] == stream.instance]
    return latency_of(case.rows.delay_ns(own) - case.instances.items[stream.instance].offset_ns)


def _json(latency: Latency | None) -> dict[str, Any] | None:
    return latency.as_json() if latency else None

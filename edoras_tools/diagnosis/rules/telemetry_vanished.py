"""A telemetry MsgId came steadily and then never again, while the rest goes on.

No counter has what would have come: it is estimated, and in no figure of the balance.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from operator import itemgetter
from typing import TYPE_CHECKING, Final

import numpy as np

from edoras_tools.cfs import telemetry_output
from edoras_tools.cfs.names import MSG_ID_NAMES
from edoras_tools.diagnosis.evidence.instances import NOBODY
from edoras_tools.diagnosis.rules import struct_overrun
from edoras_tools.diagnosis.verdict import Severity, Verdict
from edoras_tools.links.to import TO
from edoras_tools.units import SECOND
from edoras_tools.wire import cfe
from edoras_tools.words import plural

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from edoras_tools.diagnosis.accounting.stops import Outage
    from edoras_tools.diagnosis.case import Case
    from edoras_tools.diagnosis.matching.streams import Stream

ID = "telemetry_vanished"
_FIRST: Final = itemgetter(0)
_LEAST: Final = 5
_WAIT_NS: Final = 5 * SECOND
_WAIT_PERIODS: Final = 6
_NEAR_NS: Final = 3 * SECOND
_EVENTS: Final = frozenset({cfe.EVENT_MSG_ID, cfe.SHORT_EVENT_MSG_ID})
"""They come as there is something to say, and no more of one kind once cFS has said it 16 times."""


def judge(case: Case) -> Iterator[Verdict]:
    """Look for a stream that ended for good, and for what happened just then."""
    stops = case.outages
    removed = _removed(case)
    overruns: list[Verdict] | None = None
    strange = _strange(case)
    for stream in case.streams:
        if stream.link is not TO or len(stream) < _LEAST or stream.known_id in _EVENTS:
            continue
        if _asked_for(case, stream, removed) or _stopped(case, stream, stops):
            continue
        if stream.instance == NOBODY or stream.instance != case.known.owner(stream):
            continue  # handed on for a peer, which may be gone
        times = case.rows.time_ns[stream.rows]
        last_ns = int(times[-1])
        usual = (last_ns - int(times[0])) / (len(times) - 1)
        # Its own cFS goes on: another boot behind the same address would be a restart.
        alive_ns = case.instances.items[stream.instance].last_ns
        if alive_ns - last_ns < max(_WAIT_NS, _WAIT_PERIODS * usual):
            continue
        overruns = list(struct_overrun.judge(case)) if overruns is None else overruns
        after = strange[
            bisect_right(strange, last_ns, key=_FIRST) : bisect_left(strange, last_ns + _NEAR_NS, key=_FIRST)
        ]
        size = int(case.rows.packet_length[stream.rows[-1]])
        alike = [other for _, other in after if case.rows.packet_length[other.rows[0]] == size]
        signs = list(_signs(case, stream, (last_ns, alive_ns), overruns, alike))
        if not signs:
            continue  # topic_silent tells of it
        signs += _longer(case, last_ns)
        sure = len(signs) > 1
        missed = round((alive_ns - last_ns) / usual) if usual > 0 else None
        if missed:
            signs.append(
                f"about {plural(missed, 'message')} would have come since then: an estimate, in no figure of "
                "the balance"
            )
        yield Verdict(
            ID,
            Severity.ERROR,
            f"{case.name(stream.msg_id)} came every {usual / SECOND:.1f} s until {case.at(last_ns)} and "
            "never again, while other telemetry goes on: its header in the application's memory was "
            "overwritten",
            msg_id=stream.msg_id,
            topic=case.topic(stream.msg_id),
            link="to",
            hop="flight application",
            estimated=missed,
            start_ns=last_ns,
            end_ns=alive_ns,
            evidence=tuple(signs),
            remedy="make the struct in front of it large enough (see struct_overrun), and restart the "
            "application: the MsgId does not come back by itself",
            confidence="high" if sure else "medium",
        )


def _removed(case: Case) -> dict[int, list[int]]:
    """Return when Telemetry Output was told to stop sending, in order, by MsgId; -1: all of them."""
    stops = {telemetry_output.REMOVE_PACKET, telemetry_output.REMOVE_ALL}
    found: dict[int, list[int]] = {}
    for item in case.payloads.output:
        if item.function_code in stops:
            found.setdefault(item.msg_id, []).append(int(case.rows.time_ns[item.row]))
    return {msg_id: sorted(times) for msg_id, times in found.items()}


def _asked_for(case: Case, stream: Stream, removed: Mapping[int, Sequence[int]]) -> bool:
    """Tell whether Telemetry Output was told to stop sending it."""
    last_ns = int(case.rows.time_ns[stream.rows[-1]])
    times = (removed.get(msg_id, ()) for msg_id in {-1, stream.msg_id})
    return any(
        bisect_left(item, last_ns + _NEAR_NS) > bisect_right(item, last_ns - _NEAR_NS) for item in times
    )


def _stopped(case: Case, stream: Stream, stops: Sequence[Outage]) -> bool:
    """Tell whether an application was stopped just then: another rule tells of it."""
    last_ns = int(case.rows.time_ns[stream.rows[-1]])
    return any(abs(item.start_ns - last_ns) < _NEAR_NS for item in stops)


def _strange(case: Case) -> list[tuple[int, Stream]]:
    """Return the streams from Telemetry Output that are nobody's, and when each came first, in that order."""
    found = [
        (int(case.rows.time_ns[item.rows[0]]), item)
        for item in case.streams
        if item.link is TO and item.msg_id not in MSG_ID_NAMES and case.route(item.msg_id) is None
    ]
    return sorted(found, key=_FIRST)


def _signs(
    case: Case,
    stream: Stream,
    span: tuple[int, int],
    overruns: Sequence[Verdict],
    alike: Sequence[Stream],
) -> Iterator[str]:
    """Yield what happened when it stopped: a message too long, a MsgId that is garbage.

    Args:
        span: when it did, and until when its cFS went on.
        overruns: messages that were too long for their structs.
        alike: streams of nobody's that began just then, of the same size.
    """
    last_ns, alive_ns = span
    for verdict in overruns:
        if abs(verdict.start_ns - last_ns) < _NEAR_NS and verdict.msg_id is not None:
            yield f"{case.name(verdict.msg_id)} overran its struct at {case.at(verdict.start_ns)}"
    for reported, said in case.reported_losses.items():
        internal = not reported.sender.startswith(("CI_LAB", "SBN"))
        told = internal and not reported.at_pipe
        if told and -_NEAR_NS < said.first_ns - last_ns < 2 * _NEAR_NS:
            yield f"event at {case.at(said.first_ns)}: {said.records[0]}"
    for other in alike:
        first_ns = int(case.rows.time_ns[other.rows[0]])
        yield f"0x{other.msg_id:04x}, of the same size and nobody's, came first at {case.at(first_ns)}"
    owner = case.instances.owner(stream.sender, last_ns)
    track = case.tracks.get(owner)
    if track:
        errors = track.growth("send_errors", last_ns, last_ns + 2 * _NEAR_NS)
        losses = sum(
            track.growth(name, last_ns, last_ns + 2 * _NEAR_NS) for name in ("msg_limits", "pipe_overflows")
        )
        if errors > losses:
            yield f"0x803: {errors - losses} sends failed just after, and no pipe was to blame"
        unheard = track.growth("no_subscribers", last_ns, alive_ns)
        before = track.growth("no_subscribers", last_ns - (alive_ns - last_ns), last_ns)
        usual = float(np.median(np.diff(case.rows.time_ns[stream.rows])))
        if unheard > before + 2 and usual > 0 and unheard >= 0.5 * (alive_ns - last_ns) / usual:
            yield f"0x803: from then on {unheard} messages have no subscriber, as many as are missing here"


def _longer(case: Case, last_ns: int) -> Iterator[str]:
    """Yield messages into cFS that were longer than all before, just when it stopped."""
    for stream in case.streams:
        if stream.link is TO:
            continue
        rows = case.rows
        times, sizes = rows.time_ns[stream.rows], rows.cdr_length[stream.rows]
        near = (times > last_ns - _NEAR_NS) & (times < last_ns + _NEAR_NS)
        before = sizes[times <= last_ns - _NEAR_NS]
        if near.any() and len(before) and int(sizes[near].max()) > int(before.max()):
            at = int(times[near][int(sizes[near].argmax())])
            text = f"{int(sizes[near].max())} bytes of CDR at {case.at(at)}, longer than any before"
            yield f"{case.name(stream.msg_id)} into cFS: {text} ({int(before.max())})"

"""Messages that are not as the mission files say."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from edoras_tools.cfs.names import MSG_ID_NAMES
from edoras_tools.diagnosis.accounting.budget import limit
from edoras_tools.diagnosis.verdict import Verdict, error, note, warning
from edoras_tools.links import table
from edoras_tools.links.ci import CI
from edoras_tools.links.to import TO
from edoras_tools.model import NO_ROUTE, Finding, Link
from edoras_tools.ros.cdr.plan import ROUNDING
from edoras_tools.ros.fitting import types_that_fit, types_that_fit_each
from edoras_tools.units import SECOND
from edoras_tools.wire.arrays.order import groups
from edoras_tools.words import plural

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from edoras_tools.diagnosis.case import Case
    from edoras_tools.diagnosis.matching.streams import Stream
    from edoras_tools.mission import Route

_LEAST: Final = 20
_OVER: Final = 1.05


def rate_over_limit(case: Case) -> Iterator[Verdict]:
    """A route is sent faster than its pipe takes, and nothing in the capture tells what became of it.

    Hold the rates to CI against the budget, where no counter does it better.
    """
    for stream in case.streams:
        if stream.link is not CI or len(stream) < _LEAST or stream.known_id in MSG_ID_NAMES:
            continue
        clean, hop, why = limit(CI, stream.msg_id, case.profile, to_cfs=True)
        times = case.rows.time_ns[stream.rows]
        usual = float(np.median(np.diff(times)))
        rate = SECOND / usual if usual > 0 else 0.0
        named = any(loss.msg_id == stream.msg_id and loss.kind == "limit" for loss in case.losses)
        if rate <= clean * _OVER or named or _counted(case, stream):
            continue
        yield warning(
            f"{case.name(stream.msg_id)} is sent at {rate:.1f} Hz, above the {clean:g} Hz that are clean: "
            f"{why}. The capture cannot show how many were lost",
            f"{len(stream):,} commands, one every {usual / 1e6:.1f} ms",
            "no counter of 0x803 then",
            msg_id=stream.msg_id,
            link="ci",
            hop=hop,
            of=len(stream),
            span=(int(times[0]), int(times[-1])),
            remedy=f"send at most {clean:g} Hz; to know what was lost, capture telemetry too, in whole "
            "frames: TO's link, UDP port 1235, with 0x803 in its table",
            confidence="medium",
        )


def _counted(case: Case, stream: Stream) -> bool:
    middle = int(case.rows.time_ns[stream.rows[len(stream) // 2]])
    return any(track.watches(middle) for track in case.tracks.values())


def wrong_direction(case: Case) -> Iterator[Verdict]:
    """A configured MsgId whose type bit does not suit its link, or that travels the other way.

    Hold the configured routes against the traffic.
    """
    rows = case.rows
    for route in case.mission.routes:
        command = case.mission.msg_ids.is_command(route.msg_id)
        against = (route.link is CI and not command) or (route.link is TO and command)
        elsewhere = TO if route.link is CI else CI if route.link is TO else None
        there = np.flatnonzero((rows.link == route.link) & (rows.msg_id == route.msg_id))
        other = (
            np.flatnonzero((rows.link == elsewhere) & (rows.msg_id == route.msg_id))
            if elsewhere is not None
            else there[:0]
        )
        # One stray datagram is a bad command; a route is wrong when it never travels as configured.
        if not against and (not len(other) or len(there)):
            continue
        seen = other if len(other) else there
        if route.link is CI:
            wrong = "configured as a command and it is a telemetry MsgId"
        else:
            wrong = "configured as telemetry and it is a command MsgId"
        if len(other) and not against:
            seen_on = (elsewhere or route.link).name
            wrong = f"configured on {route.link.label.upper()} and seen on {seen_on} only"
        yield warning(
            f"{case.name(route.msg_id)} is {wrong}: commands have the bit "
            f"0x{case.mission.msg_ids.command_bit:04x}, telemetry does not",
            f"{route.file}:{route.line}: {route.key}",
            f"{plural(len(seen), 'datagram')} of it seen",
            msg_id=route.msg_id,
            topic=route.topic,
            link=route.link.label,
            hop="mission file",
            of=len(seen) or None,
            span=(
                int(rows.time_ns[seen[0]]) if len(seen) else case.start_ns,
                int(rows.time_ns[seen[-1]]) if len(seen) else case.end_ns,
            ),
            remedy="list the key under command or telemetry as its MsgId says, or correct its mid",
        )


_MOST: Final = 3
_SHARE: Final = 0.5


def wrong_type(case: Case) -> Iterator[Verdict]:
    """Messages are not of the type that the mission file names: they do not decode, or are too long.

    Name the routes, and the types that fit their bytes.
    """
    rows = case.rows
    for index, bad, count in misread(case):
        route = case.mission.routes[index]
        fits = fitting(case, _samples(case, route), route.type)
        sizes = ", ".join(str(size) for size in np.unique(rows.cdr_length[bad])[:4].tolist())
        refused = bool(rows.has(Finding.CDR_INVALID)[bad].any())
        yield error(
            f"{len(bad):,} of {count:,} messages on {case.name(route.msg_id)} "
            f"{'do not decode as' if refused else 'are longer than'} {route.type}"
            + (f"; {' or '.join(fits[:_MOST])} would fit" if fits else ""),
            f"{route.file}:{route.line}: type {route.type}",
            f"CDR of {sizes} bytes",
            *([f"types that fit these bytes: {', '.join(fits)}"] if fits else ()),
            msg_id=route.msg_id,
            topic=route.topic,
            link=route.link.label,
            hop="mission file",
            lost=len(bad),
            of=count,
            span=case.span(bad),
            remedy="name the type that the other side sends; both bridges and the flight application must "
            "agree",
            confidence="high" if fits else "medium",
            by_type=True,
        )


def misread(case: Case) -> Iterator[tuple[int, NDArray[np.intp], int]]:
    """Yield routes most of whose messages are not of their type: index, those rows, of how many."""
    rows = case.rows
    for index, route in enumerate(case.mission.routes):
        whole = (rows.route == index) & (rows.cdr_length > 0) & ~rows.has(Finding.CAPTURE_CUT)
        bad = np.flatnonzero(whole & rows.has(_misfits(case, route)))
        count = int(whole.sum())
        if len(bad) >= 2 and len(bad) >= _SHARE * count:
            yield index, bad, count


def _misfits(case: Case, route: Route) -> Finding:
    """Return the findings that a message of another type has on a route.

    A few bytes too many may be rounding, where no other type ends at the last of them.
    """
    types, found = case.context.types, Finding.CDR_INVALID | Finding.CDR_TOO_LONG
    if types is None or not types.has(route.type) or types.most_trailing(route.type) > ROUNDING:
        return found
    members = (case.rows.msg_id == route.msg_id) & (case.rows.link == route.link)
    if (members & case.rows.has(Finding.CDR_TRAILING)).any() and fitting(
        case, _samples(case, route), route.type
    ):
        found |= Finding.CDR_TRAILING
    return found


def _samples(case: Case, route: Route) -> list[bytes]:
    return list(case.samples.get((int(route.link), route.msg_id), {}).values())


def fitting(case: Case, samples: list[bytes], configured: str) -> list[str]:
    """Return the other types that fit some messages; the mission's own come first."""
    types = case.context.types
    own = {route.type for route in case.mission.routes}
    found = types_that_fit(types, samples, own) if types is not None else []
    return [name for name in found if name != configured][:8]


def topic_never_seen(case: Case) -> Iterator[Verdict]:
    """A configured topic of which nothing crossed the capture point.

    Tell a link that is not in the capture from a topic that is silent on one that is.
    """
    rows = case.rows
    links = {table.link(code) for code in set(rows.link.tolist())}
    absent: dict[Link, list[str]] = {}
    for index, route in enumerate(case.mission.routes):
        if (rows.route == index).any():
            continue
        if route.link not in links:
            absent.setdefault(route.link, []).append(f"{route.topic} (0x{route.msg_id:04x})")
            continue
        if (rows.msg_id == route.msg_id).any():
            continue  # it is seen, on another link
        who = "the bridge" if route.to_cfs else "cFS"
        yield note(
            f"{route.topic} (0x{route.msg_id:04x}) is configured on {route.link.label.upper()} and never "
            f"seen, while other traffic of that link is: {who} sends none, or under another MsgId",
            f"{route.file}:{route.line}: {route.key}",
            msg_id=route.msg_id,
            topic=route.topic,
            link=route.link.label,
            hop="bridge" if route.to_cfs else "cFS",
            remedy="see that its publisher runs; compare its mid with MsgIds seen and not configured",
            confidence="medium",
        )
    for link, topics in absent.items():
        yield note(
            f"no datagram of the {link.label.upper()} link is in the capture: it cannot show what "
            f"{', '.join(topics)} did",
            f"links seen: {', '.join(sorted(item.label.upper() for item in links)) or 'none'}",
            link=link.label,
            hop="capture",
            remedy=f"capture where the {link.label.upper()} link passes, or on every host and merge "
            "(record -r A -r B)",
        )


def not_configured(case: Case) -> Iterator[Verdict]:
    """EDORAS messages under a MsgId that no mission file names.

    Name them, where a mission is given at all: without one nothing is configured.
    """
    rows = case.rows
    if not case.mission.routes:
        return
    loose = (rows.cdr_length > 0) & (rows.route == NO_ROUTE) & rows.has(Finding.UNKNOWN_MSG_ID)
    types, own = case.context.types, {route.type for route in case.mission.routes}
    every = dict(groups(rows.msg_id, np.flatnonzero(loose)))
    known = [case.samples.get((int(rows.link[at[0]]), msg_id), {}).values() for msg_id, at in every.items()]
    fitting_each = types_that_fit_each(types, known, own) if types is not None else [[]] * len(every)
    for (msg_id, members), fits in zip(every.items(), fitting_each, strict=True):
        link = table.link(rows.link[members[0]])
        yield note(
            f"{plural(len(members), 'message')} on 0x{msg_id:04x} ({link.label.upper()}) "
            f"{'carries' if len(members) == 1 else 'carry'} an EDORAS envelope, "
            "and no mission file names that MsgId: the bridges ignore it",
            f"CDR of {rows.cdr_length[members[0]]} bytes",
            *([f"types that fit: {', '.join(fits[:4])}"] if fits else ()),
            msg_id=msg_id,
            link=link.label,
            hop="mission file",
            span=case.span(members),
            remedy="add the topic to a mission file, or give that file with -c",
        )

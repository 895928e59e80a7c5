"""Messages that are cut, refused or changed for what they are, or that are not as the mission files say."""

from __future__ import annotations

from itertools import combinations, takewhile
from typing import TYPE_CHECKING, Final

import numpy as np

from edoras_tools.cfs.edoras_app import BRIDGE_BUFFER
from edoras_tools.cfs.names import MSG_ID_NAMES
from edoras_tools.diagnosis.accounting.budget import limit
from edoras_tools.diagnosis.accounting.ingest import DRAINS_NS
from edoras_tools.diagnosis.accounting.pipes import more_at_once
from edoras_tools.diagnosis.rules.about import of_messages, packet, subject
from edoras_tools.diagnosis.verdict import About, Confidence, Severity, Verdict, error, note, warning
from edoras_tools.links import table
from edoras_tools.links.bare import CI, TO
from edoras_tools.links.sbn import SBN
from edoras_tools.model import NO_ROUTE, Finding, Link
from edoras_tools.ros.cdr.plan import ROUNDING
from edoras_tools.ros.store import types_that_fit, types_that_fit_each
from edoras_tools.units import MILLISECOND, SECOND
from edoras_tools.wire import sbn
from edoras_tools.wire.arrays import Integers, Places, by_value, groups
from edoras_tools.words import either, listed, plural

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

    from edoras_tools.diagnosis.case import Case
    from edoras_tools.diagnosis.evidence.loss_reports import Track
    from edoras_tools.diagnosis.matching.streams import Stream
    from edoras_tools.mission import Route


def struct_overrun(case: Case) -> Iterator[Verdict]:
    """A flight application's fixed-size struct is too small for its message.

    Name telemetry whose envelope claims more than its packet holds.
    """
    rows = case.rows
    bad = (rows.claimed != 0) & ~rows.has(Finding.CAPTURE_CUT)
    for link in (TO, SBN):
        for msg_id, wrong in groups(rows.msg_id, np.flatnonzero(bad & (rows.link == link))):
            every = np.flatnonzero((rows.link == link) & (rows.msg_id == msg_id))
            sizes, counts = np.unique(rows.packet_length[every], return_counts=True)
            # Another size than the struct's: somebody else's packet under this MsgId.
            every, members = (at[rows.packet_length[at] == sizes[counts.argmax()]] for at in (every, wrong))
            if 2 * (rows.cdr_length[every] > 0).sum() < len(every):
                members = members[rows.claimed[members] > 0]  # the mission's type need not be theirs
            if len(members) and not case.mission.msg_ids.is_command(msg_id):
                yield _overrun(case, members)


def _overrun(case: Case, members: Places) -> Verdict:
    rows, first = case.rows, int(members[0])
    space, claimed = int(rows.space[first]), abs(int(rows.claimed[first]))
    before = _malformed_before(case, int(rows.time_ns[first]))
    number = f"{claimed:,}" if claimed < 1 << 24 else "millions"
    size = f"{rows.packet_length[first]} bytes, room for {space} of CDR"
    problem, doubt = f"are garbage: their envelope claims {number} and there are {space}", ""
    confidence: Confidence = "medium"
    if before is not None:
        why = f"malformed packet {rows.number[before]} went into cFS just before, and was passed on"
        remedy = "send well-formed datagrams: the application passes on what its buffer held"
    elif claimed <= case.profile.bus_max_bytes:
        room = f"it has room for {space} bytes of CDR, {claimed:,} are claimed"
        problem = f"do not fit the struct that carries them: {room}"
        why = "the application left out what is behind, or wrote past the struct's end and over other memory"
        remedy = "make the struct in the flight application as large as the longest message, strings included"
        way = rows.link[first], rows.msg_id[first]
        if any((hop.out.link.code, hop.out.msg_id) == way for hop in case.hops):
            confidence = "high"
        else:
            doubt = "what went into the application is not here: a malformed message looks the same"
    else:
        why = (
            f"the software bus takes {case.profile.bus_max_bytes:,} bytes at most, so no message was too "
            "long for its struct: the application passed on what its buffer held, as it does after a "
            "malformed packet; none is seen here just before"
        )
        remedy = "capture the link that the application's messages come in on, and look for malformed ones"
    evidence = f"{packet(case, first)}: {size}; its envelope claims {number}", why, doubt
    about: About = {"hop": "flight application", "remedy": remedy, "confidence": confidence}
    return of_messages(Severity.ERROR, case, members, problem, *evidence, **about)


def _malformed_before(case: Case, time_ns: int) -> int | None:
    """Return the row of a malformed datagram into cFS that came just before a time, or None."""
    rows = case.rows
    wrong = rows.has(Finding.TRUNCATED | Finding.LENGTH_MISMATCH | Finding.SBN_SIZE_MISMATCH)
    wrong |= rows.claimed != 0
    near = (rows.time_ns <= time_ns) & (rows.time_ns > time_ns - 2 * SECOND)
    places = np.flatnonzero(wrong & near & (rows.link != TO) & (rows.function_code >= 0))
    return int(places[-1]) if len(places) else None


def ground_bridge_buffer(case: Case) -> Iterator[Verdict]:
    """The ground bridge receives 1024 bytes, then trusts buffer_length: longer telemetry becomes garbage.

    Name every MsgId that the bridge publishes cut; housekeeping it does not publish at all.
    """
    rows = case.rows
    over = (rows.link == TO) & rows.has(Finding.OVER_BRIDGE_BUFFER) & (rows.space > 0)
    for _, members in groups(rows.msg_id, np.flatnonzero(over)):
        yield of_messages(
            Severity.ERROR,
            case,
            members,
            f"are longer than the ground bridge's {BRIDGE_BUFFER} bytes: their ends come out as garbage",
            f"up to {int(rows.length[members].max()):,} bytes a datagram",
            hop="ground bridge",
            remedy=f"keep telemetry below {BRIDGE_BUFFER} bytes, or give the bridge a larger buffer",
            confidence="medium",
        )


def flight_bridge_length(case: Case) -> Iterator[Verdict]:
    """The public flight bridge keeps a received length in 8 bits: below 11 modulo 256 it drops the datagram.

    Name every MsgId whose messages have such a length.
    """
    rows = case.rows
    whole = (rows.link == SBN) & (rows.sbn_msg_type == sbn.MsgType.APP)
    dropped = whole & rows.has(Finding.BRIDGE_DROPS_LENGTH)
    for msg_id, members in groups(rows.msg_id, np.flatnonzero(dropped)):
        towards = int(rows.destination[members[0]])
        sizes = ", ".join(str(size) for size in np.unique(rows.length[members])[:4].tolist())
        yield of_messages(
            Severity.ERROR,
            case,
            members,
            "have a length that the public flight bridge drops: it keeps it in 8 bits, and below 11 is no "
            "header",
            f"datagrams of {sizes} bytes to {case.endpoints[towards]}",
            hop="flight bridge",
            of=int((whole & (rows.msg_id == msg_id) & (rows.destination == towards)).sum()),
            remedy="pad the flight struct by 11 bytes or more, or keep the length in a size_t in the bridge",
            confidence="medium",
        )


_COUNTED_NS = 2200 * MILLISECOND
"""From a datagram to the 0x803 that counts it, at most."""
_FEW = 8
_UNKNOWN = (1, 2, 3)
"""So many MsgIds that nobody takes are looked for."""
_MANY_SETS: Final = 20_000
_HANDS_IN: Final = ("CI", "SBN")
"""Applications that hand to the software bus what came in; their names begin so."""


def no_subscriber(case: Case) -> Iterator[Verdict]:
    """Messages that nobody on the software bus takes.

    Say which, where an event or the only command before a count tells.
    """
    rows, counted = case.rows, {}
    # Where the capture missed some that came to a CI, these may be what nobody took; and what one cFS sends
    # another comes in unseen.
    if not case.peers_unseen and not any(item.not_captured for item in case.ingests):
        arriving = _perhaps_unwanted(case)
        published = [_published(item) - SECOND for item in case.streams if item.link.only_from_cfs]
        for instance, track in case.tracks.items():
            for msg_id, members, number in _unwanted(case, track, arriving, published):
                counted[instance, msg_id] = members, number
    reports = {item: events for item, events in case.reported_losses.items() if item.kind == "no_subscriber"}
    for item in (item for item in reports if item.sender.startswith(_HANDS_IN)):
        link: Link = CI if item.sender.startswith("CI") else SBN
        members = np.flatnonzero((rows.link == link) & (rows.msg_id == item.msg_id))
        _, number = counted.pop((item.instance, item.msg_id), (members, len(members)))
        text = f"cFS said: {reports[item].records[0]}"
        yield _not_taken(case, item.msg_id, link, members.tolist(), text, number)
    # Where an application of a cFS itself publishes what nobody takes, its counter tells nothing.
    others = {item.instance for item in reports if not item.sender.startswith(_HANDS_IN)}
    for (instance, msg_id), (members, number) in counted.items():
        if instance not in others:
            text = "0x803: NoSubscribers grew by these, and nothing else fits it (the event stops after 4)"
            link = table.link(rows.link[members[0]])
            yield _not_taken(case, msg_id, link, members.tolist(), text, number)


def _unwanted(
    case: Case, track: Track, arriving: Places, published: Sequence[Integers]
) -> Iterator[tuple[int, Places, int]]:
    """Yield the MsgIds whose messages alone can be what a counter counted, these, and how many it did.

    Of those that are not seen to be taken, and in the fewest of them that fit: at each count it has what was
    sent before it, but for what may still be on its way. None if it may be others, too.
    """
    times, seen_ns = case.rows.time_ns, np.array(track.times)
    counts, spread = track.beyond_steady("no_subscribers", times[arriving], _COUNTED_NS)
    if spread:
        counts = np.array(track.totals["no_subscribers"])
    if (
        counts[-1] <= 0
        or _each_time(seen_ns, counts)
        or any(_may_be(at, seen_ns, counts, _COUNTED_NS, 0, 0) for at in published)
    ):
        return  # what cFS does as often it may do for nobody: a scheduler wakes those that are not there
    inside = arriving[(times[arriving] > seen_ns[0] - _COUNTED_NS) & (times[arriving] < seen_ns[-1])]
    own = {msg_id: inside[at] for msg_id, at in by_value(case.rows.msg_id[inside])}
    lost, wake_ns = sum(item.lost for item in case.ingests), case.profile.ci_wake_ns
    crowded = more_at_once(times[arriving], wake_ns, case.profile.ci_datagrams_per_wake)
    lag_ns = DRAINS_NS if crowded else _COUNTED_NS  # what waits in CI's socket is counted late

    def may_be(sent: Places, more: int = 0, unseen: int = 0) -> bool:
        return _may_be(times[sent], seen_ns, counts, lag_ns, lost + more, unseen)

    fits: dict[tuple[int, ...], Places] = {}
    for item, sent in _sets(own):
        if fits and len(item) > len(next(iter(fits))):
            break  # the fewest that fit
        if may_be(sent):
            fits[item] = sent
    alike = _alike(case, own, len(next(iter(fits))), int(counts[-1]) // 10, may_be) if fits else ()
    for sent in fits.values() if len(alike) == 1 else ():
        # What the last sample does not have may be on its way, where CI lost nothing.
        until = len(sent) if lost else counts[-1] + int(np.searchsorted(times[sent], seen_ns[0]))
        part = counts[-1] / len(sent) if lost else 1
        for msg_id, members in groups(case.rows.msg_id, sent[:until]):
            yield msg_id, members, round(part * len(members))


def _alike(
    case: Case, own: Mapping[int, Places], most: int, few: int, may_be: Callable[[Places, int, int], bool]
) -> set[tuple[int, ...]]:
    """Return the sets of at most ``most`` MsgIds that fit a counter if the capture missed some of them.

    Without a sign that it missed any, it missed ``few`` at most. An application may take all of a set, and
    what it makes of the newest of each round be for nobody.
    """
    times, wake_ns = case.rows.time_ns, case.profile.ci_wake_ns
    missed = case.quality.may_have_missed(sum(map(len, own.values())) if case.quality.best[1] else few)
    small = takewhile(lambda one: len(one[0]) <= most, _sets(own))
    alike = {item for item, sent in small if may_be(sent, 0, missed)}
    newest = {item: at[np.diff(times[at] // wake_ns, append=-1) != 0] for item, at in own.items()}
    seldom = ((item, at) for item, at in _sets(newest) if 10 * len(at) < 9 * sum(len(own[x]) for x in item))
    for item, at in seldom:
        blur = len(at) // 4 * (case.unsteady_ns > 0)  # with wrong times the rounds are others
        if may_be(at, max(_FEW, blur), missed + blur):
            alike.add(item)
    return alike


def _sets(of: Mapping[int, Places]) -> Iterator[tuple[tuple[int, ...], Places]]:
    """Yield each set of one MsgId, of a few, then of all, with their rows; not of sizes with very many."""
    for size in dict.fromkeys((*_UNKNOWN, len(of))) if of else ():
        for item in combinations(of, size) if size == len(of) or len(of) ** size < _MANY_SETS else ():
            yield item, np.sort(np.concatenate([of[at] for at in item]))


def _each_time(seen_ns: Integers, counts: Integers) -> bool:
    """Tell whether a counter grew by one each time, as a scheduler does of which nothing is here.

    Some of the times may be missing.
    """
    steps, apart = np.diff(counts), np.diff(seen_ns)
    grown = np.flatnonzero(steps)
    if len(grown) < _FEW:
        return False
    even = steps == np.rint(apart / np.median(apart))
    return bool(even[grown[0] : grown[-1] + 1].all())


def _published(stream: Stream) -> Integers:
    """Return when messages of a stream came, and about when those would have come that did not."""
    place = np.cumsum(stream.missing + 1) - stream.missing - 1
    return np.interp(np.arange(place[-1] + 1), place, stream.time_ns).astype(np.int64)


def _perhaps_unwanted(case: Case) -> Places:
    """Return the rows of messages into cFS that are not seen to be taken."""
    rows = case.rows
    named = {item.msg_id for item in case.reported_losses if item.kind != "no_subscriber"}
    taken = MSG_ID_NAMES.keys() | named | {hop.into.msg_id for hop in case.hops}
    # A cFS sends its peer what that has subscribed to: a counter alone does not say otherwise.
    names = [item.name for item in case.instances.items]
    senders = [place for place, name in case.network.identity_of.items() if name in names]
    came = np.flatnonzero(((rows.link == CI) | (rows.link == SBN)) & (rows.function_code >= 0))
    came = came[~np.isin(rows.msg_id[came], list(taken))]
    refused = rows.has(Finding.INVALID_MSG_ID | Finding.OVER_SOFTWARE_BUS, came)
    return came[~refused & ~np.isin(rows.source[came], senders)]


def _may_be(
    sent_ns: Integers, seen_ns: Integers, counts: Integers, lag_ns: int, lost: int, unseen: int
) -> bool:
    """Tell whether a counter has all that was sent until so long before each of its samples, and no more.

    Args:
        lost: so many at most were lost before CI.
        unseen: so many more at most were sent, and the capture missed them.
    """
    if len(seen_ns) > 2 and not _may_be(sent_ns, seen_ns[[0, -1]], counts[[0, -1]], lag_ns, lost, unseen):
        return False  # mostly the ends tell
    least, most = (np.searchsorted(sent_ns, seen_ns - before_ns) for before_ns in (lag_ns, 0))
    first = int(least[0])  # what was sent before it was counted in it, or after
    least = least - most[0]
    return bool(least[-1] > 0 and (counts >= least - lost).all() and (counts <= most - first + unseen).all())


def _not_taken(case: Case, msg_id: int, link: Link, members: list[int], witness: str, number: int) -> Verdict:
    span = case.span(members) if members else (case.start_ns, case.start_ns)
    packets = listed([str(case.rows.number[row]) for row in members[: _FEW + 1]], _FEW)
    subject = f"{plural(number, 'message') if members else 'messages'} on {case.name(msg_id)}"
    remedy = "correct the MsgId in the mission file, or have the application subscribe to it"
    certain = "cFS said" in witness
    if not certain and any(hop.out.link.peers for hop in case.hops):
        # The count is the same where an application took them, and no peer wants what it sends on.
        subject += ", or what an application sends on for them,"
        remedy += "; let the SBN peer subscribe to what becomes of it"
    return error(
        f"{subject} without a subscriber in cFS: dropped by the software bus",
        f"packet {packets}, the first at {case.at(span[0])}" if members else "",
        witness,
        msg_id=msg_id,
        place=(link.label, "software bus"),
        lost=number or None,
        of=len(members) or None,
        span=span,
        remedy=remedy,
        confidence="high" if certain else "medium",
    )


_LEAST: Final = 20
_OVER: Final = 1.05
_ASKED: Final = 20


def rate_over_limit(case: Case) -> Iterator[Verdict]:
    """A route is sent faster than its pipe takes, and nothing in the capture tells what became of it.

    Hold the rates to CI against the budget, where no counter does it better.
    """
    for stream in case.streams:
        if stream.link is not CI or len(stream) < _LEAST or stream.known_id in MSG_ID_NAMES:
            continue
        clean, hop, why, _ = limit(CI, stream.msg_id, case.profile, to_cfs=True)
        usual = float(np.median(np.diff(stream.time_ns)))
        rate = SECOND / usual if usual > 0 else 0.0
        lost = sum(loss.lost for loss in case.losses_of(stream))
        is_lost = any(loss.msg_id == stream.msg_id and loss.kind == "limit" for loss in case.losses)
        if rate <= clean * _OVER or is_lost or lost == len(stream) or _watched(case, stream):
            continue
        yield warning(
            f"{case.name(stream.msg_id)} is sent at {rate:.1f} Hz, above the {clean:g} Hz that are clean: "
            f"{why}. The capture cannot show how many were lost",
            f"{len(stream):,} commands, one every {usual / 1e6:.1f} ms",
            "no counter of 0x803 then",
            **subject(case, stream.rows),
            hop=hop,
            of=len(stream),
            remedy=f"send at most {clean:g} Hz; capture TO's link too, UDP port 1235, with 0x803",
            confidence="medium",
        )


def _watched(case: Case, stream: Stream) -> bool:
    fate = case.commands.fates.get(stream)
    times = stream.time_ns[:: max(1, len(stream) // _ASKED)].tolist()
    watched = sum(any(track.watches(when) for track in case.tracks.values()) for when in times)
    return (fate is not None and fate.seen) or watched > len(times) // 2


def wrong_direction(case: Case) -> Iterator[Verdict]:
    """A configured MsgId whose type bit does not suit its link, or that travels the other way.

    Hold the configured routes against the traffic.
    """
    rows = case.rows
    for route in case.mission.routes:
        if route.link not in {CI, TO}:
            continue  # peers send commands and telemetry
        against = case.mission.msg_ids.is_command(route.msg_id) != (route.link is CI)
        elsewhere = TO if route.link is CI else CI
        alike = rows.msg_id == route.msg_id
        own, other = (np.flatnonzero((rows.link == link) & alike) for link in (route.link, elsewhere))
        # One stray datagram is a bad command; a route is wrong when it never travels as configured.
        if not against and (not len(other) or len(own)):
            continue
        members = other if len(other) else own
        kinds = ("a command", "a telemetry") if route.link is CI else ("telemetry", "a command")
        wrong = "configured as {} and it is {} MsgId".format(*kinds)
        if not against:
            wrong = f"configured on {route.link.label.upper()} and seen on {elsewhere.name} only"
        yield warning(
            f"{case.name(route.msg_id)} is {wrong}: commands have the bit "
            f"0x{case.mission.msg_ids.command_bit:04x}, telemetry does not",
            f"{route.file}:{route.line}: {route.key}",
            f"{plural(len(members), 'datagram')} of it seen",
            msg_id=route.msg_id,
            topic=route.topic,
            place=(route.link.label, "mission file"),
            of=len(members) or None,
            span=case.span(members) if len(members) else (case.start_ns, case.end_ns),
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
        fits = fitting(case, route)
        sizes = ", ".join(str(size) for size in np.unique(rows.cdr_length[bad])[:4].tolist())
        refused = bool(rows.has(Finding.CDR_INVALID)[bad].any())
        yield of_messages(
            Severity.ERROR,
            case,
            bad,
            f"{'do not decode as' if refused else 'are longer than'} {route.type}"
            + (f"; {either(fits[:_MOST])} would fit" if fits else ""),
            f"{route.file}:{route.line}: type {route.type}",
            f"CDR of {sizes} bytes",
            f"types that fit these bytes: {', '.join(fits)}" if fits else "",
            topic=route.topic,
            hop="mission file",
            of=count,
            remedy="name the type that the other side sends: bridges and application must agree",
            confidence="high" if fits else "medium",
            by_type=True,
        )


def misread(case: Case) -> Iterator[tuple[int, Places, int]]:
    """Yield routes most of whose messages are not of their type: index, those rows, of how many."""
    rows = case.rows
    whole = (rows.route != NO_ROUTE) & (rows.cdr_length > 0) & ~rows.has(Finding.CAPTURE_CUT)
    longer = np.flatnonzero(rows.has(Finding.CDR_TRAILING))
    for index, members in groups(rows.route, np.flatnonzero(whole)):
        bad = members[rows.has(_misfits(case, case.mission.routes[index], longer), members)]
        if len(bad) >= 2 and len(bad) >= _SHARE * len(members):
            yield index, bad, len(members)


def _misfits(case: Case, route: Route, longer: Places) -> Finding:
    """Return the findings that a message of another type has on a route.

    A few bytes too many may be rounding, where no other type ends at the last of them.

    Args:
        longer: rows of messages with a few bytes too many.
    """
    types, findings = case.context.types, Finding.CDR_INVALID | Finding.CDR_TOO_LONG
    if types is None or not types.has(route.type) or types.most_trailing(route.type) > ROUNDING:
        return findings
    own = (case.rows.msg_id[longer] == route.msg_id) & (case.rows.link[longer] == route.link)
    if own.any() and fitting(case, route):
        findings |= Finding.CDR_TRAILING
    return findings


def fitting(case: Case, route: Route) -> list[str]:
    """Return the other types that fit the messages of a route; the mission's own come first."""
    types, own = case.context.types, {item.type for item in case.mission.routes}
    samples = list(case.samples.get((int(route.link), route.msg_id), {}).values())
    fits = types_that_fit(types, samples, own) if types is not None else []
    return [name for name in fits if name != route.type][:8]


def topic_never_seen(case: Case) -> Iterator[Verdict]:
    """A configured topic of which nothing crossed the capture point.

    Tell a link that is not in the capture from a topic that is silent on one that is.
    """
    rows = case.rows
    links = {table.link(code) for code in set(rows.link.tolist())}
    absent: dict[Link, list[str]] = {}
    for route in case.mission.routes:
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
            place=(route.link.label, "bridge" if route.to_cfs else "cFS"),
            remedy="see that its publisher runs; compare its mid with MsgIds seen and not configured",
            confidence="medium",
        )
    for link, topics in absent.items():
        reason = f"no datagram of the {link.label.upper()} link is here to show what {', '.join(topics)} did"
        why = f"links seen: {', '.join(sorted(item.label.upper() for item in links)) or 'none'}"
        remedy = f"capture where the {link.label.upper()} link passes, or on all hosts: record -r A -r B"
        yield note(reason, why, place=(link.label, "capture"), remedy=remedy)


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
    samples = [case.samples.get((int(rows.link[at[0]]), msg_id), {}).values() for msg_id, at in every.items()]
    fitting_each = types_that_fit_each(types, samples, own) if types is not None else [[]] * len(every)
    for (msg_id, members), fits in zip(every.items(), fitting_each, strict=True):
        link = table.link(rows.link[members[0]])
        yield note(
            f"{plural(len(members), 'message')} on 0x{msg_id:04x} ({link.label.upper()}) "
            f"{'carries' if len(members) == 1 else 'carry'} an EDORAS envelope, "
            "and no mission file names that MsgId: the bridges ignore it",
            f"CDR of {rows.cdr_length[members[0]]} bytes",
            f"types that fit: {', '.join(fits[:4])}" if fits else "",
            **subject(case, members),
            hop="mission file",
            remedy="add the topic to a mission file, or give that file with -c",
        )

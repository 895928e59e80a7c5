"""Messages that nobody could receive: closed ways out, silent peers, closed ports, stopped applications.

In: the states of the timeline, the peers of SBN, and ICMP errors. Out: masks and spans of such messages, for
the steps of ``commands`` and ``bus``; ``Unheard`` and ``Unreached``, for the ledger. ``Stops`` marks messages
in their ``Fate``, and makes losses of those that no counter has.

Ways out and SBN peers:

1. Telemetry that is missing while its way out was closed was not sent.
2. A peer that cFS gave up for its silence received nothing since its next datagram was due: messages to it
   are lost. It may have received messages sent just before.
3. A peer that restarted earlier received nothing from when its next datagram was due until it subscribed
   again.
4. A peer that is silent when the capture ends may still run: messages to it since are uncertain.

Ports that ICMP errors show as closed or unreachable:

5. Telemetry to such a port is lost behind cFS. A command is lost behind the application if all copies of it
   to one robot went to such a port.
6. An SBN peer is silent while its port is closed: its messages are counted once, by rules 2 to 4.
7. Datagrams to a robot that are of no captured command have a row of their own.

Applications and links that did not run:

8. Way out captured: nothing arrived between the last message that arrived before the stop and the first one
   after it. If the application does not run again, or sends nothing on, only messages that may still be
   unread are waiting.
9. Way out not captured: messages are lost that were sent between the end of the application and the command
   that starts it, if they surely were for it. That is so if events name its pipe for the MsgId, or if only
   one application stopped and there is only one such MsgId. During a restart no event shows when the
   application ended, so it may have received them.
10. Way out not captured, and rule 9 does not hold: messages since the first stop are unaccounted for.
11. Messages from or to SBN are lost while SBN was stopped, and while their peer was away or had not
    subscribed to them. If the application keeps only the newest, that is one message a round.
12. Messages that an application was to send by Telemetry Output are lost while that sent nothing until it was
    enabled, and after it was stopped or started again, if it sent nothing from then on.
"""

from __future__ import annotations

from collections import Counter
from operator import itemgetter
from typing import TYPE_CHECKING, Final

import msgspec
import numpy as np
from msgspec.structs import replace

from edoras_tools.cfs import command_ingest, executive_services, queues, sbn, telemetry_output
from edoras_tools.cfs.names import housekeeping_of
from edoras_tools.diagnosis.accounting.losses import (
    BUS,
    COUNTERS,
    READY_NS,
    TAIL_NS,
    WAITS_NS,
    Fate,
    Loss,
    LossKind,
    Outage,
)
from edoras_tools.diagnosis.evidence.instances import NOBODY
from edoras_tools.diagnosis.evidence.peers import SAID_GOODBYE
from edoras_tools.diagnosis.evidence.timeline.table import NEVER, StateOwner, StateSpan, Way, reason_text
from edoras_tools.diagnosis.matching.streams import Stream
from edoras_tools.diagnosis.quality import CONFIDENCE
from edoras_tools.model import NO_MSG_ID, Finding
from edoras_tools.units import SECOND
from edoras_tools.wire.arrays import Integers, Mask, Places, by_value, distinct
from edoras_tools.wire.cfe import EVENT_MSG_ID
from edoras_tools.wire.sbn import MsgType

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from numpy.typing import NDArray

    from edoras_tools.diagnosis.case import Case
    from edoras_tools.diagnosis.evidence.peers import Connection
    from edoras_tools.diagnosis.evidence.timeline.table import Change
    from edoras_tools.diagnosis.matching.crossing import Hop


_SILENT_WAKES: Final = 5
_STOPS_NS: Final = 3 * SECOND
"""Packets may come this long after a command that stops them, also over a slow network."""
_SLACK_NS: Final = SECOND // 200
"""Error of capture times."""
_FEW: Final = 3
_BRIEF: Final = 10
"""A stop that lasts less than a tenth of a gap does not explain the gap."""


def closed_at(case: Case, stream: Stream, at: Places) -> Mask:
    """Return which gaps contain a time in which the way out of their stream was closed: a mask (gaps,).

    Args:
        case: the capture.
        stream: a telemetry stream.
        at: intp (gaps,), row before each gap.
    """
    rows = case.rows
    behind = np.minimum(at + 1, len(stream) - 1)
    starts, ends = stream.time_ns[at], stream.time_ns[behind]
    out = np.zeros(len(at), bool)
    for span in routes_cut(case, stream):
        middle_ns = (span.start_lo + min(span.end_lo, case.end_ns)) // 2
        out |= (starts < middle_ns) & (middle_ns < ends)
    if stream.link.only_from_cfs:
        # Telemetry Output that sends from another port has restarted, and lost its destination.
        out |= rows.source[stream.rows[at]] != rows.source[stream.rows[behind]]
        changes = case.timeline.entry(stream.msg_id, case.instances.system(case.owner(stream)))
        added_ns, stops_ns = (
            np.array([item.not_before_ns for item in changes if item.state == state], np.int64)
            for state in ("subscribed", "unsubscribed")
        )
        for when in added_ns[:1][added_ns[:1] < stops_ns.min(initial=NEVER)]:
            out |= (starts < when) & (when < ends)  # it may have been removed before the capture began
        for when in stops_ns:
            # Once the MsgId is added again, only the first gap that ends later is explained by the removal.
            again_ns = added_ns[added_ns > when].min(initial=NEVER)
            inside = (starts - _STOPS_NS < when) & (when < ends)
            inside &= ((ends - starts) // _BRIEF < again_ns - when) & (starts - SECOND < again_ns)
            back = np.flatnonzero(inside & (ends > again_ns))[:1]
            out |= np.isin(np.arange(len(at)), back) if len(back) else inside
        return out
    # The pipe of a peer takes nothing that SBN itself publishes: its own events are no loss.
    out |= stream.known_id == EVENT_MSG_ID
    peer = case.network.identity_of.get(stream.receiver, "")
    way = Way(stream.msg_id, stream.link, case.instances.system(case.owner(stream)), peer=peer)
    for span in case.timeline.blocking(way, 0, NEVER):
        subject, state = span.change.subject.kind, span.change.state
        # A peer that did not say so may have subscribed before; SBN that restarts keeps its pipes. To a peer
        # that is only silent SBN sends on.
        if {"subscription": span.change.rows, "peer": True, "app": state == "stopped"}.get(subject):
            late = (state != "silent") | (ends >= span.end_lo)
            out |= (span.start_lo < ends) & (starts < span.end_lo) & late
    return out


def routes_cut(case: Case, stream: Stream) -> list[StateSpan]:
    """Return the spans in which a command had disabled the route of a stream's MsgId on its software bus."""
    return case.timeline.spans(StateOwner("route", "", stream.msg_id), "cut", case.system(stream))


def containing(stream: Stream, at: Places, spans: Sequence[tuple[int, int]]) -> Mask:
    """Return which gaps of a stream contain one of some spans: a mask (gaps,).

    Args:
        stream: the stream.
        at: intp (gaps,), row before each gap.
        spans: begin and end, capture time in ns.
    """
    times, behind = stream.time_ns, np.minimum(at + 1, len(stream) - 1)
    starts, ends = np.array([*spans, (NEVER, NEVER)], np.int64).reshape(-1, 2).T
    order = np.argsort(starts)
    first_end = np.minimum.accumulate(ends[order][::-1])[::-1]  # of all that start no earlier
    return np.asarray(first_end[np.searchsorted(starts[order], times[at])] <= times[behind])


def lacks_control(case: Case, stream: Stream) -> bool:
    """Return whether the capture lacks the commands or subscriptions that decide whether a stream is sent.

    Commands to cFS control Telemetry Output; SBN sends to a peer that is connected and subscribes.
    """
    rows = case.rows
    if stream.link.peers:
        from_peer = (rows.source == stream.receiver) & (rows.destination == stream.sender)
        lists = rows.has(Finding.CAPTURE_CUT) & np.isin(rows.sbn_msg_type, (MsgType.SUB, MsgType.UNSUB))
        return not from_peer.any() or bool((from_peer & lists).any())
    return not rows.on(lambda link: link.only_to_cfs).any()


def may_lack_control(case: Case, stream: Stream) -> bool:
    """Return whether the capture lacks all of them, or surely misses datagrams, perhaps some of them."""
    return lacks_control(case, stream) or (stream.link.only_from_cfs and case.quality.lacks_answered)


def sent_elsewhere(case: Case, outage: Outage) -> bool:
    """Return whether Telemetry Output was enabled to an address without telemetry since an outage began."""
    changes = case.timeline.of(StateOwner("output"), outage.system)
    heard = {case.endpoints[item.receiver].address for item in case.streams if item.link.only_from_cfs}
    later = [item for item in changes if item.state == "enabled" and item.not_before_ns > outage.start_ns]
    return any(item.value not in heard for item in later)


def unexplained_silences(case: Case, stream: Stream) -> tuple[list[tuple[int, int]], ...]:
    """Return spans in which nothing came on a stream's way, and the capture does not show whether it should.

    Returns:
        Spans without any packet where the controlling commands may not be captured; and spans without any
        packet after which fewer MsgIds came, so that Telemetry Output was commanded, captured or not.
    """
    controlled, output = not may_lack_control(case, stream), stream.link.only_from_cfs
    rows = case.rows
    own = (rows.source == stream.sender) & (rows.destination == stream.receiver)
    times = _sent_by(case, stream.sender) if output else rows.time_ns[own & (rows.msg_id != NO_MSG_ID)]
    silent = np.flatnonzero(np.diff(times) > _SILENT_WAKES * case.profile.to_wake_ns)
    spans = list(zip(times[silent].tolist(), times[silent + 1].tolist(), strict=True))
    ends = [item.time_ns[-1] for item in case.streams if item.sender == stream.sender and len(item) >= _FEW]
    late = [span for span in spans if output and case.end_ns - span[1] > _STOPS_NS]
    shrunk = [span for span in late if sum(span[0] - _STOPS_NS < when <= span[0] for when in ends) > 1]
    return ([], shrunk) if controlled else (spans, [])


def perhaps_removed(case: Case, stream: Stream, missing: Integers) -> Mask:
    """Return which gaps are too long for chance, where the controlling commands are not captured.

    A command may have removed the MsgId from Telemetry Output's table and added it again.

    Args:
        case: the capture.
        stream: the stream.
        missing: i64 (gaps,), number of missing messages.
    """
    others = missing.sum() - missing
    share = (others + 1) / (len(stream) + others + 1)
    lacking = lacks_control(case, stream) or any(own.not_captured for own in case.ingests)
    return np.asarray(lacking & (len(stream) * share**missing < 1 - CONFIDENCE))


def _sent_by(case: Case, sender: int) -> Integers:
    """Return the times at which the Telemetry Output behind an endpoint sent something: i64, ns."""
    rows, output = case.rows, case.instances.output
    sent = rows.on(lambda link: link.only_from_cfs)
    mine = [port for port in distinct(rows.source[sent]).tolist() if sender in {port, output(port)}]
    return rows.time_ns[sent & np.isin(rows.source, mine)]


def silences_of(case: Case, sender: int) -> list[tuple[int, int]]:
    """Return the spans in which the Telemetry Output behind an endpoint sent nothing until it was enabled."""
    sent_ns = _sent_by(case, sender)
    owner = case.instances.owner(sender, int(sent_ns[0]))
    boot_ns = None
    if owner != NOBODY:  # from its boot, or from the begin of the capture
        boot_ns = case.instances.items[owner].boot_ns(case.profile)
        sent_ns = np.append(max(boot_ns, int(case.rows.time_ns[0])), sent_ns)
    enabled_ns = [item.time_ns for item in case.payloads.outputs(telemetry_output.ENABLE)]
    spans = silences(sent_ns, enabled_ns, case.profile.to_wake_ns, boot_ns)
    # What enabled it again after a diversion may not be here: that it sends shows that as well.
    long = np.flatnonzero(np.diff(sent_ns) > _SILENT_WAKES * case.profile.to_wake_ns)
    every = zip(sent_ns[long].tolist(), sent_ns[long + 1].tolist(), strict=True)
    return sorted({*spans, *(span for span in every if diversion(case, sender, *span))})


def diversion(case: Case, sender: int, start_ns: int, end_ns: int) -> Change | None:
    """Return the command that sent Telemetry Output elsewhere when it fell silent here, if it is here."""
    system = case.instances.system(case.instances.owner(sender, start_ns))
    places = {case.endpoints[item.receiver].address for item in case.streams if item.sender == sender}
    before: object = None
    order = None
    for change in case.timeline.of(StateOwner("output"), system):
        near = start_ns - case.profile.to_wake_ns < change.not_after_ns
        if near and change.not_before_ns < end_ns - SECOND:
            if change.state == "enabled" and change.value not in {*places, before}:
                order = order or change
            elif change.value in places and change.not_before_ns < start_ns:
                order = None  # it was sent here again before it fell silent
        before = change.value  # it was sent there already, whatever the address is here
    return order


def silences(
    sent_ns: Integers, enabled_ns: Sequence[int], wake_ns: int, boot_ns: int | None = None
) -> list[tuple[int, int]]:
    """Return the spans between two packets in which a Telemetry Output sent nothing until it was enabled.

    Such a span is longer than Telemetry Output ever waits, and its first enable comes just before its end:
    a command that is repeated all the time explains nothing.

    Args:
        sent_ns: i64, when it sent, in order.
        enabled_ns: when commands that enable it were sent.
        wake_ns: period in which it sends.
        boot_ns: its boot, from which on it is silent; may be the first of ``sent_ns``.
    """
    spans = []
    most_ns = np.full(len(sent_ns), _SILENT_WAKES * wake_ns)[1:]
    most_ns[:1][sent_ns[:1] == boot_ns] = wake_ns
    for at in np.flatnonzero(np.diff(sent_ns) > most_ns).tolist():
        start_ns, end_ns = int(sent_ns[at]), int(sent_ns[at + 1])
        inside = [when for when in enabled_ns if start_ns < when < end_ns]
        if inside and min(inside) > end_ns - _SILENT_WAKES * wake_ns:
            spans.append((start_ns, end_ns))
    return spans


class Unheard(msgspec.Struct):
    """Messages of one stream that were sent to a silent SBN peer.

    Attributes:
        connection: the connection with the peer.
        uncertain: number of messages sent while it may still have run, at the end of the capture, too.
        lost: indices of the messages to a peer that was given up.
        restarted: indices of the messages to a peer that restarted before it was given up.
    """

    connection: Connection
    uncertain: int = 0
    lost: list[int] = msgspec.field(default_factory=list)
    restarted: list[int] = msgspec.field(default_factory=list)


def unheard(case: Case) -> dict[Stream, Unheard]:
    """Return the messages to silent peers, by each stream whose peer was ever silent."""
    by_stream: dict[Stream, Unheard] = {}
    party, closed = case.network.party, case.unreachable.closed
    for ends, connection in case.network.connections.items():
        silences = list(connection.silences(case.end_ns))
        for stream in case.streams if silences or connection.restarts else ():
            if not stream.link.peers or (party(stream.receiver), party(stream.sender)) != ends:
                continue
            item = by_stream.setdefault(stream, Unheard(connection))
            times = stream.time_ns
            for silence in silences:
                since_ns = silence.start_ns + case.unsteady_ns
                until_ns = silence.sent_until_ns - case.unsteady_ns
                inside = np.flatnonzero((times > since_ns) & (times < until_ns)).tolist()
                if silence.given_up_ns:
                    # It may have received messages until an ICMP error says that its port was closed, or its
                    # next datagram was due. A peer that stood still reads later what its socket holds, and
                    # did so where it answers all.
                    shut = (row for row in inside if closed[stream.rows[row]])
                    due = int(np.searchsorted(times, silence.due_ns))
                    first = next(shut, len(times) if silence.stood_still else due)
                    item.lost += [row for row in inside if row >= first]
                    if len(silence.within(connection.sent_ns)) > silence.answers:
                        item.uncertain += sum(row < first for row in inside)
                else:
                    item.uncertain += int((~closed[stream.rows[inside]]).sum())
            for restart in connection.restarts:
                dead = (times > restart.dead_ns) & (times < restart.back_ns)
                item.restarted += np.flatnonzero(dead).tolist()
                unread = (times > restart.read_ns) & (times <= restart.dead_ns)
                item.uncertain += int((unread & ~closed[stream.rows]).sum())
    return by_stream


UDP_PORT: Final = "port"
PORT_CLOSED: Final[LossKind] = "port_closed"
REFUSED: Final = "unreachable"
"""Causes of a loss; also the names of the rules that report them."""
_UNCERTAIN, _REFUSED, _SHUT = 1, 2, 3
_CAUSES: Final = {_SHUT: PORT_CLOSED, _REFUSED: REFUSED}


class Unreached(msgspec.Struct, frozen=True):
    """Messages of one stream to an endpoint that did not receive all of them.

    Attributes:
        stream: telemetry, commands to cFS, or datagrams to a robot.
        endpoint: number of the endpoint.
        own: whether the stream has rows of its own in the balance; false for datagrams of no captured
            command.
        lost: cause to the indices of lost messages.
        uncertain: indices of messages that may be lost.
        sent_ns: i64 (rows,), when each of the stream's messages went to the endpoint.
    """

    stream: Stream
    endpoint: int
    own: bool
    lost: Mapping[str, Places]
    uncertain: Places
    sent_ns: Integers


def unreached(case: Case) -> list[Unreached]:
    """Return the messages to closed or unreachable endpoints, in the order of the streams."""
    errors, times = case.unreachable, case.rows.time_ns
    fate_of = np.zeros(len(case.rows), np.int8)
    fate_of[errors.uncertain] = _UNCERTAIN
    fate_of[errors.refused > 0] = _REFUSED
    fate_of[errors.closed] = _SHUT
    if not fate_of.any():
        return []
    out: list[Unreached] = []
    covered = np.zeros(len(case.rows), bool)
    for stream in case.streams:
        fate = case.commands.fates.get(stream)
        for hop in fate.hops if fate else ():
            if hop.out.link.last_hop:
                rows = hop.out.rows[hop.out_rows]
                covered[rows] = True
                best, sent_ns = np.full(len(stream), _SHUT, np.int8), np.zeros(len(stream), np.int64)
                np.minimum.at(best, hop.in_rows, fate_of[rows])
                np.maximum.at(sent_ns, hop.in_rows, times[rows])
                out += _at(stream, np.unique(hop.in_rows), best, hop.out.receiver, sent_ns)
        if fate is None:
            unheard = case.missed_by_peer(stream)
            for endpoint, members in by_value(case.rows.destination[stream.rows]):
                rows = np.setdiff1d(members, unheard)
                out += _at(stream, rows, fate_of[stream.rows], endpoint, times[stream.rows])
    for stream in case.robots:
        rows = np.flatnonzero(~covered[stream.rows])
        every = _at(stream, rows, fate_of[stream.rows], stream.receiver, times[stream.rows])
        out += [replace(item, own=False) for item in every]
    return out


def _at(
    stream: Stream, rows: Places, fate_of: NDArray[np.int8], endpoint: int, sent_ns: Integers
) -> list[Unreached]:
    """Return the losses of some rows of a stream at an endpoint: a list of one, or an empty one."""
    every = {cause: rows[fate_of[rows] == mark] for mark, cause in _CAUSES.items()}
    lost = {cause: at for cause, at in every.items() if len(at)}
    uncertain = rows[fate_of[rows] == _UNCERTAIN]
    return [Unreached(stream, endpoint, True, lost, uncertain, sent_ns)] if lost or len(uncertain) else []


_LINKS: Final = frozenset({*command_ingest.NAMES, *telemetry_output.NAMES, sbn.NAME})
"""Applications whose stops show elsewhere: CI's in its counter, Telemetry Output's in its port."""
_CLOSED: Final[Mapping[str, tuple[int, LossKind, str]]] = {
    "app": (0, "stopped", sbn.NAME),
    "peer": (1, "away", "SBN peer"),
    "subscription": (2, "unsubscribed", "SBN peer"),
    "route": (3, "route", BUS),
}
"""Kind of a closed subject to its order among several causes, the kind of loss, and its place."""
_LEAST_ROUNDS: Final = 5
_LEAST_UNANSWERED: Final = 5
"""If this many messages are sent and none comes out, a command to stop the application was effective."""
_USUAL_STEPS: Final = 20
_ENDS_NS: Final = 15 * SECOND
"""An application ends at most this long after the command: CI may read that from a full socket."""
_SILENT_STEPS: Final = 3
"""An application that sends nothing on for this many of its longest steps did not run."""
_FASTER: Final = 1.25
"""If messages come faster than rounds by this factor, newer ones supersede older ones."""


_OVERLAP_NS: Final = 3 * SECOND
"""A clock tells to a second or two when a cFS began."""


def boots(case: Case) -> Iterator[tuple[int, int, int]]:
    """Yield each instance that follows another one of its cFS: that one, it, and when it began beside it.

    That is 0 where the one before had ended, or where its clock went on, which then tells no boot.
    """
    items, systems = case.instances.items, case.instances.systems
    order = sorted(range(len(items)), key=lambda index: items[index].first_ns)
    for at, index in enumerate(order):
        later, own = items[index], [item for item in order[:at] if systems[item] == systems[index]]
        for before in [item for item in own if items[item].last_ns < later.first_ns][-1:]:
            earlier, boot_ns = items[before], later.boot_ns(case.profile)
            went_on = later.first_ns - earlier.last_ns >= later.offset_ns - earlier.offset_ns
            beside = max(case.start_ns, earlier.first_ns) < boot_ns < earlier.last_ns - _OVERLAP_NS
            yield before, index, boot_ns if beside and not went_on else 0


def outages(case: Case) -> list[Outage]:
    """Return all stops and restarts that events, or a command and silence, show; in order of time."""
    timeline, items = case.timeline, []
    for system, subject in timeline.subjects:
        if subject.kind != "app":
            continue
        for restarted, state in ((False, "stopped"), (True, "restarting")):
            for span in timeline.spans(subject, state, system):
                if _is_sure(case, span):
                    times = span.start_lo, span.end_hi if span.end else None, span.start_hi, span.end_lo
                    items.append(Outage(subject.name, *times, span.change.witness, system, restarted))
        first = timeline.of(subject, system)[0]
        if first.state == "running" and first.sure and len(first.rows) > 1:
            # It was commanded to start: it was stopped before the capture began, or never ran.
            times = case.start_ns - 1, first.not_after_ns, case.start_ns - 1, first.not_before_ns
            items.append(Outage(subject.name, *times, first.witness, system))
    return sorted(items, key=lambda item: item.start_ns)


def _is_sure(case: Case, span: StateSpan) -> bool:
    """Return whether a stop of an application is more than a command, which may be lost."""
    app, sure = span.change.subject.name, span.change.sure or bool(span.end and span.end.sure)
    every = case.timeline.every("disconnected") if app == sbn.NAME else ()
    goodbyes_ns = (item.start_lo for item in every if item.change.witness == SAID_GOODBYE)
    left = any(span.start_lo <= when <= span.start_hi for when in goodbyes_ns)
    return sure or left or _falls_silent(case, app, span)


def _falls_silent(case: Case, app: str, span: StateSpan) -> bool:
    """Return whether an application sends nothing on after a command to stop it, though messages come."""
    if (app in _LINKS and app not in command_ingest.NAMES) or app in executive_services.SCHEDULERS:
        return False
    if unanswered(case, app, span.change.system, span.start_lo)[0] < span.end_hi:
        return True
    start_ns, end_ns = span.start_lo + WAITS_NS, span.end_lo
    for hop in case.hops:
        left_ns = hop.out.time_ns
        at = int(np.searchsorted(left_ns, start_ns))
        back_ns = min([end_ns, *left_ns[at : at + 1].tolist()])
        sent = np.diff(np.searchsorted(hop.into.time_ns, (start_ns, back_ns)))[0]
        before_ns = left_ns[max(0, at - _USUAL_STEPS) : at]
        longest_ns = np.diff(before_ns).max(initial=0)
        recent = len(before_ns) > 0 and before_ns[-1] > start_ns - _STOPS_NS - WAITS_NS
        if sent >= _LEAST_UNANSWERED and recent and back_ns - before_ns[-1] > _SILENT_STEPS * longest_ns:
            return True
    return False


def unanswered(case: Case, app: str, system: int, since_ns: int) -> tuple[int, int]:
    """Return from when to when an application surely did not run: it sent no housekeeping, though others did.

    Args:
        case: the capture.
        app: name of the application; not one of cFS itself.
        system: number of its cFS.
        since_ns: when it was commanded to stop, or when it ended.

    Returns:
        Capture times in ns; ``NEVER`` twice if its housekeeping does not show that.
    """
    sent = [item for item in case.streams if item.link.only_from_cfs and item.is_housekeeping]
    sent = [item for item in sent if case.instances.system(case.owner(item)) == system]
    msg_ids = () if app in _LINKS else housekeeping_of(app)
    ends_ns = [0, *sorted(int(item.time_ns[-1]) for item in sent)]
    # The network may have lost the last ones.
    late = _SILENT_STEPS if any(item.missing[:-1].any() for item in sent) else 1
    for stream in (item for item in sent if item.known_id in msg_ids and len(item) >= _LEAST_ROUNDS):
        last_ns = ends_ns[-1 - (stream.time_ns[-1] == ends_ns[-1])]  # of the others
        times, missing = np.append(stream.time_ns, last_ns), np.append(stream.missing[:-1], 0)
        steps, usual = np.diff(times), int(np.median(np.diff(stream.time_ns)))
        near = (times[:-1] > since_ns - 2 * usual) & (times[:-1] < since_ns + _ENDS_NS) & (missing == 0)
        for at in np.flatnonzero(near & (steps > 2 * _SILENT_STEPS * usual)).tolist():
            begin, end = int(times[at]) + late * usual, int(times[at + 1]) - 2 * usual
            way = Way(stream.msg_id, stream.link, system)
            if not (lacks_control(case, stream) or case.timeline.blocking(way, begin, end)):
                return begin, end
    return NEVER, NEVER


class Stops:
    """Messages into cFS that were sent while applications did not run or peers did not listen.

    Args:
        case: the capture.
        fates: fates of the messages; ``stop`` is set for those that a stop explains.

    Attributes:
        losses: the losses.
    """

    def __init__(self, case: Case, fates: Sequence[Fate]) -> None:
        self._case = case
        self._causes: dict[tuple[LossKind, str, str], int] = {}
        self._beside = [item for item in boots(case) if item[2]]
        self.losses: list[Loss] = []
        self._fates = [fate for fate in fates if not fate.stream.is_housekeeping]
        stopped = [item for item in case.outages if item.app not in _LINKS]
        for fate in sorted(self._fates, key=lambda item: not item.seen):
            own = [item for item in stopped if case.into_system(fate.stream, item.system)]
            if fate.seen:
                # Without a scheduler an application is not woken: its pipe fills, or it keeps the newest.
                apart = () if fate.keeps_newest else executive_services.SCHEDULERS
                silent = [(item, self._mark(fate, item)) for item in own if item.app not in apart]
                self._mark_closed(fate)
                for item, rows in silent:  # it runs again, and sends nothing on though it could
                    own_rows = rows & fate.open & ~fate.newer & (fate.stop < 0)
                    self.mark(fate, own_rows, "restart_failed", item.app, item.witness)
                self._mark_unsent(fate)
                self._mark_beside(fate)
                continue
            self._mark_unread(fate)
            if own := [item for item in own if item.app not in executive_services.SCHEDULERS]:
                self._unfollowed(fate, own)

    def mark(self, fate: Fate, rows: Mask, kind: LossKind, hop: str, text: str) -> None:
        """Mark messages as lost by a cause, unless a counter shows that a pipe lost them."""
        if rows.any():
            fate.stop[rows] = self._causes.setdefault((kind, hop, text), len(self._causes))

    def _mark(self, fate: Fate, item: Outage) -> Mask:
        """Mark the messages that a stopped application did not receive (rule 8).

        Returns:
            The messages that it did not send on since it was started again, bool (rows,).
        """
        times = fate.stream.time_ns
        # A message that came out shows that it runs, also one whose origin is not known or was sent before.
        out_ns = (np.maximum(hop.out.time_ns, (hop.origin >= 0) * times[hop.origin]) for hop in fate.hops)
        came_ns = np.concatenate((times[fate.arrived], *out_ns))
        since_ns = item.start_ns + WAITS_NS
        if item.end_ns is None and not (came_ns > item.ended_ns).any():
            since_ns = max(since_ns, int(came_ns.max(initial=0)))  # it still ran until then
        elif item.end_ns is not None and 0 < item.end_ns - item.asked_ns <= SECOND:  # an event has its end
            since_ns = max(since_ns, int(came_ns[came_ns < item.asked_ns].max(initial=0)))
        until_ns = int(came_ns[came_ns > since_ns].min(initial=NEVER))
        left_ns = READY_NS + 1 if item.end_ns is None else self._case.end_ns - item.end_ns
        if until_ns == NEVER and not 0 <= left_ns <= READY_NS:
            self._await_no_more(fate, item)
        # It received the last message that arrived before it stopped.
        last_ns = times[fate.arrived & (times <= since_ns)].max(initial=0)
        inside = fate.open & (fate.stop < 0)
        inside &= (times > max(item.start_ns - WAITS_NS, last_ns)) & (times < until_ns)
        if fate.keeps_newest:
            inside = self._surely_missed(fate, item, inside, until_ns)
            if item.end_ns is not None and last_ns > item.end_ns:
                # It was back within a round, and lost what CI had handed over together with the command.
                since_ns = item.start_ns - self._case.profile.ci_wake_ns
                fate.end("held", fate.open & (times > since_ns) & (times < item.end_ns))
        if item.app in executive_services.SCHEDULERS:
            inside &= ~fate.newer  # nobody woke the application: it kept the newest
            if NEVER in {until_ns, last_ns or NEVER}:  # the capture does not show which was the newest
                fate.end("held", inside)
                inside = np.zeros(len(times), bool)
        back_ns = NEVER if item.end_ns is None or until_ns <= item.end_ns + TAIL_NS else item.end_ns
        self.mark(fate, inside & (times <= back_ns), "stopped", item.app, item.witness)
        return np.asarray(inside & (times > back_ns))

    def _await_no_more(self, fate: Fate, item: Outage) -> None:
        """Remove the fate "waiting" from messages that a stopped application will never send on."""
        case, stream = self._case, fate.stream
        most = case.profile.ci_datagrams_per_wake
        if any(own.unread > most for own in case.ingests_at(stream.receiver)):
            return  # it may wait in CI's socket for longer than a round
        pipe = queues.application_pipe(case.profile, over_network=not stream.link.only_to_cfs)
        times, since_ns = stream.time_ns, case.end_ns - pipe.round_ns - max(_SLACK_NS, case.unsteady_ns)
        never = fate.waits & ~fate.unseen & (times > item.ended_ns) & (times < since_ns)
        fate.open |= never
        fate.waits &= ~never

    def _surely_missed(self, fate: Fate, item: Outage, inside: Mask, until_ns: int) -> Mask:
        """Return which messages an application that keeps the newest surely did not receive.

        Messages that it received together when it was back were superseded. It may have received those that
        were on their way when it was stopped, and when it was back.

        Args:
            fate: fates of the stream.
            item: the outage.
            inside: mask of the messages around the stop that did not come out.
            until_ns: when the first message was sent that came out after the stop.
        """
        times, over_network = fate.stream.time_ns, not fate.stream.link.only_to_cfs
        round_ns = queues.application_pipe(self._case.profile, over_network=over_network).round_ns
        back_ns = until_ns - round_ns
        if item.end_ns is not None and until_ns <= item.end_ns + TAIL_NS:
            back_ns = min(back_ns, item.end_ns)
        fate.newer |= inside & (times > back_ns)
        inside = inside & (times <= back_ns)
        unsure = inside & ((times <= item.start_ns + round_ns) | (times > back_ns - round_ns))
        if item.app not in executive_services.SCHEDULERS:
            fate.end("held", unsure)
            inside = inside & ~unsure
        return inside

    def _mark_closed(self, fate: Fate) -> None:
        """Mark the messages that came over SBN, or were to leave over it, while it was closed (rule 11).

        To another cFS goes a copy: Telemetry Output may send the message too, on a way that is not captured.
        """
        case, stream = self._case, fate.stream
        system, peer = case.system(stream), case.network.identity_of.get
        ways = [(Way(stream.msg_id, stream.link, system, to_cfs=True), np.ones(len(stream), bool))]
        if all(hop.out.link.peers for hop in fate.hops):
            # What an application makes of a message counts, not that another cFS gets the message too.
            for each in [hop for hop in fate.hops if hop.rewritten] or fate.hops:
                way = Way(each.out.msg_id, each.out.link, system, peer=peer(each.out.receiver, ""))
                ways.append((way, self._untaken(fate, each, _newest(fate, each, case.profile.sbn_wake_ns))))
        times, gap = stream.time_ns, np.cumsum(fate.arrived)
        others = {item.name for item in case.instances.items} - {""}
        closed = [
            (_CLOSED[span.change.subject.kind], span, newest, way.peer in others)
            for way, newest in ways
            for span in case.timeline.blocking(way, 0, NEVER)
            if (way.to_cfs if span.change.subject.kind == "route" else way.link.peers)
            if span.change.subject.kind in _CLOSED and span.change.state != "silent"
            if span.change.subject.kind != "app" or _is_sure(case, span)
        ]
        for early_ns, until in ((0, "end_lo"), (WAITS_NS, "end_hi")):
            for (_, kind, hop), span, newest, is_copy in sorted(closed, key=itemgetter(0)):
                inside = fate.open & ~fate.newer & (fate.stop < 0)
                inside &= (times > span.start_lo - early_ns) & (times < getattr(span, until))
                if not inside.any():
                    continue
                self._hold_one(fate, inside, newest)
                inside &= fate.open
                # Between two that came out the others gave way, also behind the closing.
                around = np.isin(gap, np.setdiff1d(gap[inside], [0, *gap[-1:]])) & (fate.stop < 0)
                fate.newer |= (inside | (fate.open & around)) & ~newest
                inside &= newest
                fate.end("missed", inside & is_copy)
                fate.no_pipe |= inside
                self.mark(fate, inside, kind, hop, reason_text(span, case.at))

    def _untaken(self, fate: Fate, hop: Hop, newest: Mask) -> Mask:
        """Return which messages an application sends on, corrected by the count of messages nobody received.

        Before the first message that came out, the MsgId had no route: 0x803 counted what was published.

        Args:
            fate: fates of the stream.
            hop: its way out.
            newest: mask of the messages that it would send on by its rounds; changed here.
        """
        out, times, first_ns = hop.out, fate.stream.time_ns, int(hop.out.time_ns[0])
        track = self._case.tracks.get(self._case.owner(out))
        before = np.flatnonzero(newest & (times < first_ns))
        if track and self._case.rows.sequence_count[out.rows[0]] == 1:
            number = track.growth("no_subscribers", int(times[0]), first_ns)
            if 0 < number < len(before) and not track.growth("no_subscribers", first_ns + _STOPS_NS):
                newest[np.delete(before, np.linspace(0, len(before) - 1, number).round().astype(int))] = False
        return newest

    def _hold_one(self, fate: Fate, inside: Mask, newest: Mask) -> None:
        """Give the fate "held" to one message of each kind, where no sequence count shows the exact number.

        Rounds give the number of messages only to within one.
        """
        rows, arrived = np.flatnonzero(inside), np.flatnonzero(fate.arrived)
        if fate.keeps_newest and len(rows) and len(arrived) and not arrived[0] < rows[0] < arrived[-1]:
            last = [alike[-1:] for alike in (rows[newest[rows]], rows[~newest[rows]])]
            fate.end("held", np.isin(np.arange(len(inside)), np.concatenate(last)))

    def _mark_unread(self, fate: Fate) -> None:
        """Mark messages that came over SBN while it surely did not run; their way out is not captured."""
        case, stream, times = self._case, fate.stream, fate.stream.time_ns
        for item in case.outages if stream.link.peers else ():
            if item.app == sbn.NAME and case.into_system(stream, item.system):
                inside = fate.open & (fate.stop < 0) & (times > item.ended_ns)
                # Its socket is open a moment before it sends.
                inside &= times < item.asked_ns - case.profile.sbn_wake_ns
                self.mark(fate, inside, "stopped", sbn.NAME, item.witness)

    def _mark_unsent(self, fate: Fate) -> None:
        """Mark the messages that Telemetry Output was not to send (rule 12)."""
        case, times = self._case, fate.stream.time_ns
        outs = [hop.out for hop in fate.hops if hop.out.link.only_from_cfs]
        for start_ns, end_ns in sorted({span for out in outs for span in case.silences_of(out.sender)}):
            text = f"Telemetry Output sent nothing until it was enabled, {case.at(end_ns)}"
            inside = fate.open & ~fate.newer & (fate.stop < 0) & (times > start_ns) & (times < end_ns)
            self.mark(fate, inside, "disabled", telemetry_output.NAME, text)
        last_ns = max((int(_sent_by(case, out.sender)[-1]) for out in outs), default=NEVER)
        for item in (item for item in case.outages if item.app in telemetry_output.NAMES):
            # Where it was started again, nobody enabled it since, as far as the capture shows.
            if item.end_ns and (sent_elsewhere(case, item) or any(may_lack_control(case, to) for to in outs)):
                continue
            if case.into_system(fate.stream, item.system) and last_ns < item.ended_ns + TAIL_NS:
                inside = fate.open & ~fate.newer & (fate.stop < 0) & (times > max(item.start_ns, last_ns))
                self.mark(fate, inside, "disabled" if item.end_ns else "stopped", item.app, item.witness)

    def _mark_beside(self, fate: Fate) -> None:
        """Mark the messages that a second cFS got, of which none came out since it was started."""
        times, last_ns = fate.stream.time_ns, fate.stream.time_ns[fate.arrived].max(initial=0)
        for _, index, boot_ns in self._beside:
            if fate.stream.link.only_to_cfs and self._case.goes_to(fate.stream, index):
                inside = fate.open & (fate.stop < 0) & (times > max(boot_ns, last_ns))
                text = f"started at {self._case.at(boot_ns)} beside another one: it has CI's port"
                self.mark(fate, inside, "beside", self._case.label(index), text)

    def make_losses(self) -> None:
        """Turn the marked messages into losses, but not those that may be lost behind the application."""
        causes = list(self._causes)
        for fate in (item for item in self._fates if item.undecidable is None):
            open_ = fate.open & ~fate.passed
            for place in np.unique(fate.stop[open_ & (fate.stop >= 0)]).tolist():
                rows = np.flatnonzero(open_ & (fate.stop == place))
                fate.claim(rows)
                number = fate.counted_in_stop[place]
                # At both ends some may have come out unseen, as many as the capture ever missed in a row.
                most = min(self._case.quality.longest_run * fate.seen, max(0, len(rows) - number) // 2)
                inner = rows[most : len(rows) - most]
                fate.ends["missed"] += len(rows) - len(inner)
                if not len(inner):
                    continue
                kind, hop, text = causes[place]
                evidence = [text]
                if number:
                    evidence.append(f"0x803 counted {number:,} of them: nobody read the pipe")
                self.losses.append(fate.loss(kind, inner, evidence, hop=hop))

    def make_uncounted(self, losses: list[Loss], telemetry: Sequence[Loss]) -> None:
        """Turn marked messages whose way out is not captured into losses, less those that a counter has.

        Args:
            losses: losses of messages into cFS; extended here.
            telemetry: losses of telemetry.
        """
        causes = list(self._causes)
        for fate in (item for item in self._fates if item.undecidable is not None):
            stream, marked = fate.stream, np.flatnonzero(fate.open & (fate.stop >= 0))
            since_ns = int(stream.time_ns[marked].min(initial=NEVER))
            later, of = stream.time_ns > since_ns, Counter[Stream | None]()
            counts = (item for item in (*losses, *telemetry) if item.instance != NOBODY)
            for item in (item for item in counts if item.end_ns > since_ns):
                most = later[item.among.rows].sum() if item.stream is stream and item.among else item.lost
                of[item.stream] += int(min(item.lost, most))
            # A count soon after that may be of a message sent before; a later one is of one of these.
            soon, late = (self._grown(stream, when) for when in (since_ns, since_ns + TAIL_NS))
            surely = max(0, min(of[stream], late - of.total() + of[stream]))
            fate.followed -= min(fate.followed, fate.claim(marked[:surely]))
            marked = marked[min(of[stream] + of[None] + fate.ends["shared"], soon) :]
            for place in distinct(fate.stop[marked]).tolist():
                rows = marked[fate.stop[marked] == place]
                kind, hop, text = causes[place]
                losses.append(fate.loss(kind, rows, [text], hop=hop))
                fate.claim(rows)

    def _grown(self, stream: Stream, start_ns: int, end_ns: int | None = None) -> int:
        """Return how many losses each cFS that a stream may go to counted between two times."""
        tracks = [track for at, track in self._case.tracks.items() if self._case.goes_to(stream, at)]
        return sum(track.growth(name, start_ns, end_ns) for track in tracks for name in COUNTERS.values())

    def _read(self, stream: Stream) -> Mask:
        """Return which messages do not wait in CI's socket at its last count: bool (rows,)."""
        read, sent_ns = np.ones(len(stream), bool), self._case.rows.time_ns
        for account in self._case.ingests_at(stream.receiver):
            sent = account.rows[sent_ns[account.rows] <= account.last_ns]
            read &= ~np.isin(stream.rows, sent[max(0, len(sent) - account.waiting) :])
        return read

    def _unfollowed(self, fate: Fate, own: Sequence[Outage]) -> None:
        """Apply rules 9 and 10."""
        case, times = self._case, fate.stream.time_ns
        reported = (item for item in case.reported_losses if item.at_pipe and not item.at_output)
        pipes = {item.pipe for item in reported if item.msg_id == fate.stream.msg_id}
        surely = [item for item in own if any(map(item.reads, pipes))]
        # If an application has messages of its own in rule 8, this MsgId need not be for it.
        own = surely or [item for item in own if item.app not in {hop for _, hop, _ in self._causes}]
        if not own:
            return
        alike = [item for item in self._fates if not item.seen and item.stream.link is fate.stream.link]
        several = sum(item is fate or len(item.stream) >= _FEW for item in alike) > 1  # no single commands
        if not (surely or several or len({item.app for item in own}) > 1):
            surely = list(own)
        fate.stops = surely
        read = self._read(fate.stream)
        for item in surely:
            lacking = np.flatnonzero(fate.open & read & (times > item.ended_ns) & (times < item.asked_ns))
            if fate.claim(lacking):
                self.losses.append(fate.loss("stopped", lacking, [item.witness], hop=item.app))
            begin, end = unanswered(case, item.app, item.system, item.start_ns)
            marked = fate.open & read & (times > begin) & (times < end) & (not case.quality.lacks_answered)
            # Where nobody reads its pipe again, 0x803 counts what that has no room for.
            most = self._grown(fate.stream, begin, end) + case.profile.app_pipe_depth
            marked &= (not item.restarted) | (int(marked.sum()) <= most)
            text = f"{item.witness}; no housekeeping of it came from {case.at(begin)} on"
            self.mark(fate, marked, "stopped" if item.end_ns is None else "restart_failed", item.app, text)
        first = min(own, key=lambda item: item.start_ns)
        fate.undecidable = times > first.start_ns
        fate.undecidable_since = first.witness


def _newest(fate: Fate, hop: Hop, wake_ns: int) -> Mask:
    """Return which messages an application that keeps the newest sends: the last of each of its rounds.

    If its output has sequence counts, as many as are missing there, spread evenly.

    Args:
        fate: fates of the stream.
        hop: its way out.
        wake_ns: period in which SBN sends, which makes rounds look long and short in turn.
    """
    times, out, out_ns = fate.stream.time_ns, hop.out, hop.out.time_ns
    steps = np.diff(out_ns) // (out.missing[:-1] + 1)
    # SBN may send in one burst what several rounds made: the steps between bursts are no pauses.
    steps = steps[steps <= 2 * np.quantile(steps, 0.9)] if len(steps) > 1 else steps[:0]
    period = int(steps.sum() + wake_ns) // len(steps) if len(steps) else 0
    newest = np.ones(len(times), bool)
    if fate.newer.any() and period >= _FASTER * float(np.median(np.diff(times))):
        read = out_ns - _delay(times, out_ns, hop)
        before = read[np.maximum(np.searchsorted(read, times) - 1, 0)]
        newest = np.append((np.diff(before) != 0) | (np.diff((times - before) // period) != 0), True)
    if fate.keeps_newest and out.counted:
        made_of = dict(zip(hop.out_rows.tolist(), hop.in_rows.tolist(), strict=True))
        for at in np.flatnonzero(out.missing[:-1]).tolist():
            if at in made_of and at + 1 in made_of:
                first, last = made_of[at], made_of[at + 1]
                newest[first + 1 : last] = False
                newest[np.linspace(first, last, int(out.missing[at]) + 2).round().astype(int)[1:-1]] = True
    return newest


def _delay(times: Integers, out_ns: Integers, hop: Hop) -> int:
    """Return how long an application takes from receiving a message to sending it on, ns.

    It sends the newest message that it has, so the message after that one came later.

    Args:
        times: i64, when its messages were sent.
        out_ns: i64, when its output was captured.
        hop: the pairs of both.
    """
    came = hop.in_rows < len(times) - 1
    at, sent = hop.in_rows[came], out_ns[hop.out_rows[came]]
    least, most = sent - times[at + 1], sent - times[at]
    return max(0, int(least.max() + most.min()) // 2) if len(at) else 0

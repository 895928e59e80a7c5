"""The Software Bus Network: its connections, and messages that a peer refuses or sends too often."""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np
from msgspec.structs import replace

from edoras_tools.cfs import sbn as facts
from edoras_tools.diagnosis.evidence.peers import SAID_GOODBYE, UNSEEN, Connection, PeerChange, PeerSilence
from edoras_tools.diagnosis.evidence.table import Rows, peer_of
from edoras_tools.diagnosis.ledger import DAMAGED
from edoras_tools.diagnosis.rules.about import one_by_one, packet, sent_before, subject
from edoras_tools.diagnosis.rules.pipes import revival
from edoras_tools.diagnosis.verdict import Severity, Verdict, error, habit, note, verdict, warning
from edoras_tools.links.sbn import SBN
from edoras_tools.model import NO_MSG_ID, Finding
from edoras_tools.units import MILLISECOND, SECOND
from edoras_tools.wire import sbn
from edoras_tools.wire.arrays import Mask, Places, by_key, by_value, distinct, groups, numbered
from edoras_tools.words import plural

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from edoras_tools.cfs.event_services import EventText
    from edoras_tools.diagnosis.case import Case
    from edoras_tools.diagnosis.evidence.payloads import EventRecord


def damaged(case: Case) -> Iterator[Verdict]:
    """Datagrams came with a wrong checksum: the network damaged them, and their receiver's kernel drops them.

    Say how many, of which MsgId.
    """
    lost = (item for item in case.ledger.losses() if item.cause == DAMAGED)
    places = by_key(lost, lambda item: (item.traffic.link, item.traffic.msg_id, item.hop))
    for (link, msg_id, hop), own in places.items():
        number = sum(item.number for item in own)
        whose = "unknown MsgIds" if msg_id is None else case.name(msg_id)
        reason = f"{plural(number, 'datagram')} on {whose} came damaged: what has a wrong checksum is dropped"
        why = "their checksums are wrong, and those of most others of the same hosts are not"
        remedy = "look at the interfaces on the way: ethtool -S, nstat -az UdpInCsumErrors, tc -s qdisc"
        span = min(item.times_ns[0] for item in own), max(item.times_ns[1] for item in own)
        yield error(reason, why, msg_id=msg_id, place=(link, hop), lost=number, span=span, remedy=remedy)


def sbn_timeout(case: Case) -> Iterator[Verdict]:
    """An SBN peer fell silent and timed out; what cFS sent to it meanwhile reached nobody.

    Name every silence, how long it was, and what was lost in it.
    """
    for connection in case.network.connections.values():
        for silence in connection.silences(case.end_ns):
            if silence.given_up_ns:
                yield _timed_out(case, connection, silence)
            elif len(connection.sent_ns):  # else it never was a peer
                yield _still(case, connection, silence)
        for change in connection.changes:
            if change.why == UNSEEN:
                yield _unseen(case, connection, change)


def _unseen(case: Case, connection: Connection, silent: PeerChange) -> Verdict:
    """Say that a peer is not dead, but out of sight."""
    return note(
        f"nothing of SBN peer {connection.peer} is seen here after {case.at(silent.time_ns)}, yet "
        f"{connection.observer} goes on sending to it: its datagrams do not cross this point any more",
        f"{connection.observer} still sent at {case.at(int(connection.sent_ns[-1]))}",
        place=("sbn", "capture"),
        span=(silent.time_ns, case.end_ns),
        remedy="capture on the host of cFS, where both directions pass",
        confidence="medium",
    )


def _still(case: Case, connection: Connection, silence: PeerSilence) -> Verdict:
    """Say that a peer is silent when the capture ends: nobody knows whether it is there."""
    sent = silence.within(connection.sent_ns)
    return warning(
        f"SBN peer {connection.peer} is silent since {case.at(silence.start_ns)}, "
        f"{(case.end_ns - silence.start_ns) / SECOND:.1f} s to the end of the capture; {connection.observer} "
        f"sent it {plural(len(sent), 'message')} since, and nothing shows whether they were heard",
        f"last datagram of {connection.peer} at {case.at(silence.start_ns)}",
        place=("sbn", f"SBN peer {connection.peer}"),
        of=len(sent) or None,
        span=(silence.start_ns, case.end_ns),
        remedy="capture longer: a peer that is gone is given up after 11 s",
        confidence="medium",
    )


def _timed_out(case: Case, connection: Connection, silent: PeerSilence) -> Verdict:
    until, out_ns, sent = silent.until_ns, silent.given_up_ns, silent.within(connection.sent_ns)
    last_ns = int(sent[-1]) if len(sent) else 0
    lost = [stream.time_ns[own.lost] for stream, own in case.unheard.items() if own.connection is connection]
    lost_ns = silent.within(np.concatenate([sent[:0], *lost]))
    early = 0 if silent.stood_still else len(sent) - len(lost_ns)
    away_s = (until - silent.start_ns) / SECOND
    returned = f"back after {away_s:.1f} s" if until < case.end_ns else "not back in this capture"
    why, remedy = _why_silent(case, connection, silent)
    return verdict(
        Severity.ERROR if len(sent) else Severity.WARNING,
        f"SBN peer {connection.peer} fell silent at {case.at(silent.start_ns)} and timed out at "
        f"{connection.observer} {(out_ns - silent.start_ns) // SECOND} s later; {returned}. {why}",
        f"last datagram of {connection.peer} at {case.at(silent.start_ns)}",
        f"{connection.observer} sent it {plural(len(sent), 'message')} after that",
        f"the last of them at {case.at(last_ns)}: then it had given the peer up" if last_ns else "",
        f"it may have heard the first {early:,}, until {case.at(int(sent[early - 1]))}" if early else "",
        f"it answered {silent.answers:,} of them when it was back"
        * (silent.stood_still and silent.answers > 0),
        *(
            f"event at {case.at(record.time_ns)}: {record}"
            for record in case.events_between(silent.start_ns, until + SECOND, facts.NAME)
            if connection.peer in record.message
            and _has(record, (facts.TIMED_OUT.phrase, facts.DISCONNECTED.phrase))
        ),
        place=("sbn", f"SBN peer {connection.peer}"),
        lost=len(lost_ns) or None,
        of=len(sent) or None,
        # It is lost until the peer is given up, however long it stays away.
        span=(silent.start_ns, min(max(out_ns, last_ns), until)),
        remedy=remedy,
    )


def _why_silent(case: Case, connection: Connection, silent: PeerSilence) -> tuple[str, str]:
    """Return why a peer that was given up was silent, and what to do."""
    start_ns, until = silent.start_ns, silent.until_ns
    if connection.runs(start_ns, until):
        why = "It sent to other ports meanwhile: it was cut off on this way alone, or sends to a wrong port"
        remedy = "look at the port to which it sends, and at the network"
    elif silent.stood_still:
        why = "It was not started anew: it stood still, or was cut off, and may read late what it was sent"
        remedy = "look at the load of its host, at who may stop its process, and at the network"
    elif elsewhere := case.network.speaks_from(case.rows, connection.peer, start_ns, until):
        where = " and ".join(str(case.endpoints[end]) for end in elsewhere)
        why = f"It went on at {where}: cFS hears it there, but sends to the address in its table"
        remedy = "start it at the address in cFS's SBN table (sbn_conf_tbl), or change that table"
    else:
        why = "It was killed, stopped or cut off: a stop looks the same as a kill, no DISCONNECT is sent"
        remedy = "restart the peer: its first SUB or PROTO connects it"
    return why, remedy


def sbn_peer_restart(case: Case) -> Iterator[Verdict]:
    """An SBN peer was started again before it was given up; what it was sent meanwhile reached nobody.

    Name every restart: cFS noticed none of them.
    """
    for connection in case.network.connections.values():
        for last_ns, dead_ns, back_ns, (last, first), read_ns in connection.restarts:
            sent = connection.sent_ns[(connection.sent_ns > read_ns) & (connection.sent_ns < back_ns)]
            lost = int((sent > dead_ns).sum())
            yield verdict(
                Severity.ERROR if lost else Severity.WARNING,
                f"SBN peer {connection.peer} was started again: nothing came from it from {case.at(last_ns)} "
                f"to {case.at(back_ns)}, then it subscribed anew. {connection.observer} did not notice, and "
                f"{plural(lost or len(sent), 'message')} sent to it {'may have ' * (not lost)}reached nobody",
                f"packet {case.rows.number[last]} is its last, packet {case.rows.number[first]} its SUB",
                f"{len(sent) - lost:,} more may have been heard, until {case.at(dead_ns)}"
                * (lost < len(sent)),
                place=("sbn", f"SBN peer {connection.peer}"),
                lost=lost or None,
                of=len(sent) or None,
                span=(last_ns, back_ns),
                remedy="send nothing while the peer starts again",
            )


def sbn_tcp_overwritten(case: Case) -> Iterator[Verdict]:
    """Messages of several SBN peers over TCP that one read of cFS took together: only one of them remains.

    A read of SBN's TCP module goes through all connections of a net into one buffer, and hands over what it
    read last (``Recv`` in ``sbn_tcp_if.c`` of nasa/SBN). So a message is in danger if one of another
    connection came in the same wake-up.
    """
    rows, streamed = case.rows, (item for item in case.network.connections.values() if item.streamed)
    for observer, own in by_key(streamed, lambda item: item.observer).items():
        peers, heard = {item.peer for item in own}, np.sort(np.concatenate([item.heard for item in own]))
        app = heard[rows.sbn_msg_type[heard] == sbn.MsgType.APP]
        beside = app[_beside(rows, app, heard, case.profile.sbn_wake_ns)]
        if len(peers) < 2 or not len(beside):
            continue
        yield warning(
            f"cFS {observer} hears {len(peers)} SBN peers over TCP, and {len(beside):,} of "
            f"{plural(len(app), 'message')} to it came within {case.profile.sbn_wake_ns // MILLISECOND} ms "
            "of another peer's: of several in one wake-up SBN keeps the last, and says and counts nothing",
            f"peers: {', '.join(sorted(peers))}",
            place=("sbn", f"SBN of {observer}"),
            of=len(app),
            span=case.span(beside),
            remedy="give each TCP peer a net of its own in sbn_conf_tbl (NetNum, port), or use UDP",
            confidence="medium",
        )


def _beside(rows: Rows, app: Places, every: Places, span_ns: int) -> Mask:
    """Tell which messages have one of another source within a span of time, before or after."""
    near = np.zeros(len(app), bool)
    every_ns, own = rows.time_ns[every], dict(groups(rows.source, every))
    for one, mine in by_value(rows.source[app]):
        when = rows.time_ns[app[mine]]
        # Fewer of its own within the span than of all.
        within, of_own = (
            np.searchsorted(times, when + span_ns, "right") - np.searchsorted(times, when - span_ns)
            for times in (every_ns, rows.time_ns[own[one]])
        )
        near[mine] = of_own < within
    return near


_WAIT_NS: Final = 12 * SECOND
_LEAST_SECONDS: Final = 8


def sbn_never_connected(case: Case) -> Iterator[Verdict]:
    """Someone sends SBN datagrams and never gets an answer.

    Look for a direction of a link on which nothing ever came.
    """
    rows = case.rows
    ways = dict(groups(rows.way(), np.flatnonzero((rows.link == SBN) & (rows.sbn_msg_type >= 0))))
    for both, own in ways.items():
        source, target = both >> 32, both & 0xFFFFFFFF
        first_ns, last_ns = case.span(own)
        # cFS sends each new SUB to every peer of its table, there or not.
        seconds = len(np.unique(rows.time_ns[own] // SECOND))
        often = last_ns - first_ns >= _WAIT_NS and seconds >= _LEAST_SECONDS
        # Where nobody listened, that is said by itself.
        if target << 32 | source in ways or not often or case.unreachable.closed[own].any():
            continue
        who = case.network.identity_of.get(source, str(case.endpoints[source]))
        kinds = np.unique(rows.sbn_msg_type[own]).tolist()
        names = ", ".join(sbn.MSG_TYPE_NAMES.get(kind, hex(kind)) for kind in kinds)
        yield warning(
            f"{who} sends to {case.endpoints[target]} and gets nothing back, or answers do not pass here",
            f"{plural(len(own), 'datagram')} ({names}) in {(last_ns - first_ns) / SECOND:.0f} s, no answer",
            "stock SBN announces only to a peer whose spacecraft and processor both differ: else a SUB or "
            "PROTO of either side has to come through",
            place=("sbn", "SBN"),
            span=case.span(own),
            remedy="see that the peer runs, listens at that port, and is in cFS's SBN table with this "
            "identity; capture at the peer to see whether answers leave it",
            confidence="medium",
        )


def sbn_disconnected(case: Case) -> Iterator[Verdict]:
    """An SBN peer said goodbye, or cFS did to its peer.

    Name every DISCONNECT, and when the peer came back; and every UNSUB.
    """
    yield from _by_cfs(case)
    yield from _unsubscribed(case)
    for connection in case.network.connections.values():
        for at, change in enumerate(connection.changes):
            if change.state != "disconnected" or change.why == SAID_GOODBYE:
                continue
            back = next((item for item in connection.changes[at + 1 :] if item.state == "connected"), None)
            sequel = f"connected again at {case.at(back.time_ns)}" if back else "not back in this capture"
            who, span = f"SBN peer {connection.peer}", (change.time_ns, back.time_ns if back else case.end_ns)
            bye = f"disconnected from {connection.observer} at {case.at(change.time_ns)}, in order"
            yield note(f"{who} {bye}; {sequel}", change.why, place=("sbn", who), span=span, remedy="none")


def _unsubscribed(case: Case) -> Iterator[Verdict]:
    """Name what a peer unsubscribed: of what it got, or what else is here."""
    msg_ids = {stream.msg_id for stream in case.streams}
    for span in case.timeline.every("unsubscribed"):
        owner, witness = span.change.subject, span.change.witness
        if owner.msg_id in msg_ids and witness.startswith("UNSUB"):
            until = f"until {case.at(span.end_lo)}" if span.end else "from then on"
            yield note(
                f"SBN peer {owner.name} unsubscribed {case.name(owner.msg_id)} at "
                f"{case.at(span.start_lo)}: it gets none {until}",
                witness,
                msg_id=owner.msg_id,
                place=("sbn", f"SBN peer {owner.name}"),
                span=(span.start_lo, min(span.end_lo, case.end_ns)),
                remedy="none, if it was to",
            )


def no_longer_wanted(case: Case) -> Iterator[Verdict]:
    """A peer connects anew with a shorter list: what it got before, it gets no more.

    Compare the lists of its connections, where no loss shows what that cost.
    """
    rows, peers = case.rows, case.network.identity_of
    got_ns: dict[tuple[str, int], int] = {}
    for item in case.streams:
        got_ns.setdefault((peers.get(item.receiver, ""), item.msg_id), int(item.time_ns[0]))
    lists = np.flatnonzero(rows.sbn_msg_type == sbn.MsgType.SUB)
    lists_ns = {peers.get(at, ""): int(rows.time_ns[own[-1]]) for at, own in groups(rows.source, lists)}
    lasting = [item for item in case.timeline.every("unsubscribed") if not item.end]
    by_peer = by_key(
        lasting, lambda item: (item.change.subject.kind, item.change.subject.name, item.start_lo)
    )
    for (kind, who, since_ns), own in by_peer.items():
        ids = sorted(item.change.subject.msg_id for item in own)
        names = [case.name(at) for at in ids if got_ns.get((who, at), since_ns) < since_ns]
        lost = any(item.kind == "unsubscribed" and item.end_ns > since_ns for item in case.losses)
        if kind == "subscription" and names and not lost and lists_ns.get(who, 0) > since_ns:
            few = ", ".join(names[:3]) + (f" and {len(names) - 3} others" if len(names) > 3 else "")
            yield warning(
                f"SBN peer {who} connected anew at {case.at(since_ns)}, and no longer subscribes to {few}: "
                "it gets none from then on",
                own[0].change.witness,
                place=("sbn", f"SBN peer {who}"),
                span=(since_ns, case.end_ns),
                remedy="compare the list that it is started with to the one before",
            )


def _by_cfs(case: Case) -> Iterator[Verdict]:
    """Name what a cFS says goodbye to: it does so when SBN is loaded anew, or ends."""
    rows, network = case.rows, case.network
    observers = {observer for _, observer in network.connections}
    for row in np.flatnonzero(rows.sbn_msg_type == sbn.MsgType.DISCONNECT).tolist():
        sender, target = (network.party(int(end[row])) for end in (rows.source, rows.destination))
        if sender not in observers or (target in observers and (sender, target) in network.connections):
            continue
        who, peer, when = sender[0], target[0], int(rows.time_ns[row])
        sent = (rows.source == rows.source[row]) & (rows.time_ns > when + SECOND)
        back_ns = rows.time_ns[sent & (rows.sbn_msg_type == sbn.MsgType.APP)]
        stops = [
            f"{item.app} was stopped: {item.witness}"
            for item in case.outages
            if item.app == facts.NAME and item.start_ns - SECOND < when < item.ended_ns + SECOND
        ]
        look = "look at the events of SBN around that time; to restart it: "
        yield verdict(
            Severity.WARNING if len(back_ns) else Severity.ERROR,
            f"{who} disconnected from its SBN peer {peer or 'there'} at {case.at(when)}"
            + ("" if len(back_ns) else ", and sent no application message to anybody after that"),
            f"packet {rows.number[row]}: DISCONNECT from {who}",
            *(stops or sent_before(case, when)),
            place=("sbn", f"SBN peer {peer}"),
            span=(when, int(back_ns.min(initial=case.end_ns))),
            remedy=revival(case, facts.NAME) if stops else look + case.inject("es-restart-app", facts.NAME),
        )


def sbn_table(case: Case) -> Iterator[Verdict]:
    """SBN's table beside what SBN sends: peers of it that are silent, and senders that it does not name.

    Compare who speaks on SBN with the table, if an image of it was given.
    """
    table = {item.peer: item for item in case.profile.sbn_table}
    rows = case.rows
    spoken = np.flatnonzero((rows.link == SBN) & (rows.sbn_msg_type >= 0) & ~rows.has(Finding.TRUNCATED))
    if not table or not len(spoken):
        return
    heard = {peer_of(who): members for who, members in groups(rows.sbn_sender(), spoken)}
    for peer, members in heard.items():
        if peer not in table:
            reason = f"{peer} sends on SBN, and is not in the table that was given: such a cFS refuses it"
            why = f"{plural(len(members), 'datagram')} of it, from {case.endpoints[rows.source[members[0]]]}"
            remedy = f"add {peer} to sbn_conf_tbl, or give the bridge an identity that is in it"
            span = int(rows.time_ns[members[0]]), case.end_ns
            yield warning(reason, why, place=("sbn", "SBN"), span=span, remedy=remedy, confidence="medium")
    for peer, place in table.items():
        if peer not in heard:
            where, why = f"{place.address}:{place.port}", f"on SBN are {', '.join(map(str, heard))}"
            reason = f"{peer}, in the table that was given at {where}, sends nothing here"
            remedy = "see whether it runs; capture where its datagrams pass"
            yield note(reason, why, place=("sbn", "SBN"), remedy=remedy)


_ANSWERED_NS: Final = 2 * SECOND
_RESTARTS: Final = "; its receive task ended and started anew"


_OWN_TYPES: Final = frozenset(sbn.MsgType) - {sbn.MsgType.APP}
"""Types of what SBN itself says, which is nobody's message."""


class BadMessage(NamedTuple):
    """A way in which an SBN datagram can be wrong.

    Attributes:
        problem: what it is.
        reaction: what the receiver does about it.
        events: what it says where it refuses such a datagram; without any it does not.
    """

    problem: str
    reaction: str
    events: tuple[EventText, ...] = ()


_SHORT: Final = BadMessage(
    "shorter than an SBN header, or than what its header announces",
    "read together with what the last datagram left behind, then refused",
    (facts.BAD_MSG_ID, facts.NOT_UNPACKED, facts.UNKNOWN_PEER, facts.UNKNOWN_TYPE),
)
_COMPLETED: Final = BadMessage(_SHORT.problem, "no event refuses it: perhaps taken with older bytes")
_TOO_LARGE: Final = BadMessage("MsgSz above 32,767, so negative", "refused", (facts.NOT_UNPACKED,))
_WRONG_SIZE: Final = BadMessage("MsgSz is not the size of what follows", "ignored silently")
_UNKNOWN_TYPE: Final = BadMessage("MsgType that SBN does not know", "refused", (facts.UNKNOWN_TYPE,))
_LEGACY_HEADER: Final = BadMessage(
    "the 7-byte header of older SBN sources",
    "cFS takes the next 4 bytes for a SpacecraftID, so for an unknown peer, and refuses them",
    (facts.UNKNOWN_PEER,),
)


def bad_network_message(case: Case) -> Iterator[Verdict]:
    """Malformed SBN datagrams, each with what the receiving SBN does about it.

    Go through every SBN datagram with such a finding; identity and version have rules of their own.
    """
    rows = case.rows
    findings = (
        Finding.TRUNCATED | Finding.SBN_SIZE_MISMATCH | Finding.SBN_UNKNOWN_TYPE | Finding.SBN_LEGACY_HEADER
    )
    wrong = (rows.link == SBN) & rows.has(findings) & ~rows.has(Finding.CAPTURE_CUT)
    # A message cut short inside a sound SBN datagram is the sender's application's business.
    inside = (rows.sbn_msg_type == sbn.MsgType.APP) & rows.has(Finding.TRUNCATED) & (rows.msg_id != NO_MSG_ID)
    wrong &= ~inside | rows.has(Finding.SBN_SIZE_MISMATCH | Finding.SBN_LEGACY_HEADER)
    by_kind = by_key(np.flatnonzero(wrong).tolist(), lambda row: (_kind(case, row), int(rows.msg_id[row])))
    for (kind, _), members in by_kind.items():
        yield from (_malformed(case, together, kind) for together in one_by_one(members))


def _kind(case: Case, row: int) -> BadMessage:
    findings = Finding(int(case.rows.findings[row]))
    if Finding.SBN_LEGACY_HEADER in findings:
        return _LEGACY_HEADER
    if Finding.SBN_UNKNOWN_TYPE in findings:
        return _UNKNOWN_TYPE
    start_ns = int(case.rows.time_ns[row])
    if Finding.SBN_SIZE_MISMATCH not in findings:
        return _SHORT if answers(case, start_ns, *_SHORT.events) else _COMPLETED
    # The table does not keep MsgSz; that it was refused says that it was negative.
    return _TOO_LARGE if answers(case, start_ns, facts.NOT_UNPACKED) else _WRONG_SIZE


def _malformed(case: Case, members: list[int], kind: BadMessage) -> Verdict:
    rows, first = case.rows, members[0]
    lines = answers(case, int(rows.time_ns[first]), *kind.events)
    type_ = int(rows.sbn_msg_type[first])
    name = sbn.MSG_TYPE_NAMES.get(type_, f"type 0x{type_:02x}") if type_ >= 0 else "SBN datagram"
    which = f"packet {rows.number[first]}" if len(members) == 1 else f"{len(members):,} datagrams"
    return verdict(
        Severity.ERROR if kind.events else Severity.WARNING,
        f"{which} ({name}): {kind.problem}; {kind.reaction}{_consequence(lines)}",
        f"{packet(case, first)}: {rows.length[first]} bytes",
        *lines,
        **subject(case, members),
        hop="SBN",
        lost=sum(rows.sbn_msg_type[row] not in _OWN_TYPES for row in members if kind.events) or None,
        of=len(members),
        remedy="write 11 bytes of header: MsgSz of the payload alone, a known MsgType, both IDs",
        confidence="high" if lines or not kind.events else "medium",
    )


def answers(case: Case, start_ns: int, *texts: EventText | str) -> list[str]:
    """Return what SBN said about a datagram: the first of some events, and what followed from it."""
    phrases = [item if isinstance(item, str) else item.phrase for item in texts]
    events = case.events_between(start_ns, start_ns + _ANSWERED_NS, facts.NAME)
    fits = next((at for at, record in enumerate(events) if _has(record, phrases)), None)
    if fits is None:
        return []
    consequences = ("failed", facts.RECEIVE_TASK_STARTED.phrase)
    follow = [item for item in events[fits + 1 : fits + 3] if _has(item, consequences)]
    return [f"cFS said: {record}" for record in (events[fits], *follow)]


def _consequence(lines: Iterable[str]) -> str:
    """Return what a refusal did to the receiver, where an event tells it: who polls has no receive task."""
    return _RESTARTS if any(facts.RECEIVE_TASK_STARTED.phrase in line for line in lines) else ""


def _has(record: EventRecord, phrases: Iterable[str]) -> bool:
    return any(phrase in record.message for phrase in phrases)


def wrong_ident(case: Case) -> Iterator[Verdict]:
    """SUB or UNSUB with another $Id than the receiver's: SBN refuses it.

    Name every other $Id, once a sender.
    """
    rows, listed, contents = case.rows, case.payloads.subscriptions, case.payloads.contents
    by_ident: dict[tuple[int, str], list[int]] = {}
    other = np.array([item.ident != sbn.IDENT for item in contents], bool)[listed["said"]]
    other &= ~rows.has(Finding.SBN_LEGACY_HEADER)[listed["row"]]
    for row, index in zip(listed["row"][other].tolist(), listed["said"][other].tolist(), strict=True):
        by_ident.setdefault((int(rows.source[row]), contents[index].ident), []).append(row)
    for (source, ident), members in by_ident.items():
        if all((end, ident) in by_ident for end in distinct(rows.destination[members]).tolist()):
            continue  # its receivers have the same
        who, detail = case.network.identity_of.get(source, "a peer"), f": {ident!r}, wanted {sbn.IDENT!r}"
        lines = answers(case, case.span(members)[0], facts.OTHER_IDENT)
        reason = f"{plural(len(members), 'subscription message')} of {who}: another $Id than cFS's: refused"
        remedy = "build bridge and cFS from the same SBN sources, or copy its $Id"
        yield _refused(case, members, reason + _consequence(lines), remedy, lines, detail)


def _refused(
    case: Case, members: Sequence[int] | Places, reason: str, remedy: str, lines: list[str], detail: str = ""
) -> Verdict:
    """Return a verdict on datagrams that SBN takes none of.

    Args:
        lines: what SBN said about the first.
        detail: what else is seen of it.
    """
    return error(
        reason,
        packet(case, int(members[0])) + detail,
        *lines,
        place=("sbn", "SBN"),
        span=case.span(members),
        remedy=remedy,
        confidence="high" if lines else "medium",
    )


def wrong_protocol_version(case: Case) -> Iterator[Verdict]:
    """PROTO with another protocol version than 11.

    Name every sender of one.
    """
    rows = case.rows
    wrong = (rows.link == SBN) & rows.has(Finding.SBN_VERSION_MISMATCH)
    for source, members in groups(rows.source, np.flatnonzero(wrong)):
        yield _refused(
            case,
            members,
            f"{len(members):,} PROTO of {case.network.identity_of.get(source, 'a peer')} "
            f"{'names' if len(members) == 1 else 'name'} another "
            f"protocol version than {sbn.PROTOCOL_VERSION}: cFS reports an error and goes on",
            "build both sides from the same SBN version",
            answers(case, case.span(members)[0], facts.VERSION_MISMATCH),
        )


_UNKNOWN_PEER: Final = (facts.UNKNOWN_PEER, facts.UNKNOWN_PROCESSOR)
_CRASH: Final = ". Its TCP module crashes cFS when a connection closes whose peer it does not know"


@lru_cache(maxsize=256)  # cFS says the same of each datagram
def _unknown(message: str) -> list[int]:
    """Return the spacecraft, where it is named, and the processor that SBN's event refuses; else nothing."""
    matches = (event.pattern.search(message) for event in _UNKNOWN_PEER)
    return next(([*map(int, match.groups())] for match in matches if match), [])


def _foreign(case: Case, came_out: Places) -> Mask:
    """Return which SBN datagrams are of a peer that an event of the receiver refuses, or of two names.

    Args:
        came_out: rows whose message came out of cFS again.
    """
    rows = case.rows
    listed = np.isin(rows.sbn_msg_type, (sbn.MsgType.SUB, sbn.MsgType.UNSUB))
    foreign = (rows.link == SBN) & rows.has(Finding.SBN_ID_MISMATCH) & ~listed
    network = np.flatnonzero((rows.link == SBN) & (rows.sbn_msg_type >= 0) & ~rows.has(Finding.TRUNCATED))
    times, names, party = rows.time_ns[network], case.network.identity_of.items(), case.network.party
    partners = {peer for (peer, _), own in case.network.connections.items() if len(own.sent_ns)}
    owner = case.instances.of_row
    ends_of = {at: distinct(rows.source[network[own]]) for at, own in by_value(owner[network])}
    for record in case.events_between(case.start_ns, case.end_ns, facts.NAME):
        if numbers := _unknown(record.message):
            *craft, processor = numbers
            low, high = np.searchsorted(times, (record.time_ns - 2 * SECOND, record.time_ns), "right")
            near = network[low:high]
            same = rows.processor_id[near] == processor
            same &= np.isin(rows.spacecraft_id[near], craft or rows.spacecraft_id[near])
            # Who is named by his processor alone may be one that was named in full just before, or one that
            # is not here: it is none that this cFS sends messages to.
            peers = [end for end, name in names if name.endswith(f":{processor}") and party(end) in partners]
            same &= bool(craft) | ~np.isin(rows.source[near], peers)
            # What it sends itself it does not refuse, also where a peer bears its own ids.
            same &= ~np.isin(rows.source[near], ends_of.get(int(owner[record.row]), ()))
            if craft or not foreign[near[same]].any():
                foreign[near[same]] = True
    # What it refuses once it refuses always, unless some comes out: then its table was changed. A mission may
    # name a peer that its table does not. A few may only seem to come out.
    _, who = numbered(rows.source[network], rows.sbn_sender(network))
    seldom = 10 * np.bincount(who, np.isin(network, came_out)) < np.bincount(who)
    foreign[network] |= np.isin(who, who[foreign[network]]) & seldom[who] & ~listed[network]
    return foreign & ~rows.has(Finding.SBN_LEGACY_HEADER)


def unknown_peer(case: Case) -> Iterator[Verdict]:
    """SBN datagrams of a spacecraft and processor that the receiver's table does not name.

    Name every such sender: by cFS's own words, or by an endpoint that has another name.
    """
    rows = case.rows
    came_out = np.concatenate([np.zeros(0, np.intp), *(hop.into.rows[hop.in_rows] for hop in case.hops)])
    msg_ids = [hop.into.msg_id for hop in case.hops]
    # The length of a space packet without SBN's header lies where SBN has the processor.
    bare = rows.has(Finding.SBN_SIZE_MISMATCH) & (rows.processor_id >> 8 == rows.length - 7)
    for who, members in groups(rows.sbn_sender(), np.flatnonzero(_foreign(case, came_out) | bare)):
        peer, start_ns = peer_of(who), case.span(members)[0]
        lines = answers(case, start_ns, *(event.text.format(**peer._asdict()) for event in _UNKNOWN_PEER))
        messages = members[bare[members] | (rows.sbn_msg_type[members] == sbn.MsgType.APP)]
        came, followed = np.isin(messages, came_out), np.isin(rows.msg_id[messages], msg_ids)
        usual = case.network.identity_of.get(int(rows.source[members[0]]))
        if 2 * came.sum() > len(messages) or not (lines or usual != str(peer) or bare[members].all()):
            continue  # most there are its own: one that spoke before it is the other
        usual_place = f", which is not the peer known at {case.endpoints[rows.source[members[0]]]}"
        usual_place *= usual != str(peer)
        remedy = "make spacecraft_id and processor_id of the bridge agree with cFS's SBN table (sbn_conf_tbl)"
        if bare[members].all():
            usual_place = ", which are packets without SBN's header"
            remedy = "send them to Command Ingest's port"
        refused = _refused(
            case,
            members,
            f"SBN messages of {peer}{usual_place}: "
            + ("cFS refuses them" if lines else "a cFS whose table does not name it refuses them"),
            remedy + _CRASH * bool(rows.streamed[members].any()),
            lines,
            f", the first of {len(members):,} datagrams" * (len(members) > 1),
        )
        if not lines and 2 * (came | ~followed).sum() > len(messages):  # what is not followed may come out
            refused = replace(refused, severity=Severity.WARNING, perhaps=int((~came).sum()))
        elif len(messages):  # subscriptions are no messages
            refused = replace(refused, lost=int((~came).sum()), of=len(messages))
        carried = {*rows.msg_id[messages].tolist()} - {NO_MSG_ID}
        yield replace(refused, msg_id=carried.pop()) if len(carried) == 1 else refused


_LEAST: Final = 6
_OFTEN_NS: Final = 2 * SECOND


def subscription_storm(case: Case) -> Iterator[Verdict]:
    """The public flight bridge sends its subscriptions again every 500 ms, for good.

    Find who repeats the same subscription.
    """
    rows, listed = case.rows, case.payloads.subscriptions
    lists: dict[tuple[int, ...], int] = {(): 0}
    numbers = [lists.setdefault(item.wanted, len(lists)) for item in case.payloads.contents]
    wants = np.array(numbers, np.int64)[listed["said"]]
    subs = (rows.sbn_msg_type[listed["row"]] == sbn.MsgType.SUB) & (wants > 0)
    row = listed["row"][subs]
    for source, at in by_value(rows.source[row]):
        own = [rows.time_ns[row[at[same]]] for _, same in by_value(numbered(wants[subs][at])[1])]
        often = [when for when in own if len(when) >= _LEAST and float(np.median(np.diff(when))) < _OFTEN_NS]
        if not often:
            continue
        period = float(np.median(np.concatenate([np.diff(when) for when in often])))
        yield habit(
            f"{case.network.identity_of.get(source, 'a peer')} sends its "
            f"{plural(len(often), 'subscription')} again every {period / 1e6:.0f} ms, "
            f"{sum(map(len, often)):,} in all: the public flight bridge does; cFS ignores repeats",
            f"from {case.endpoints[source]}",
            place=("sbn", "flight bridge"),
            span=(int(min(when[0] for when in often)), int(max(when[-1] for when in often))),
            remedy="none needed; subscribing once after PROTO would do",
        )


def proto_storm(case: Case) -> Iterator[Verdict]:
    """The public flight bridge answers every datagram with PROTO.

    Find who sends about as many PROTO as it receives datagrams.
    """
    rows = case.rows
    protos = (rows.link == SBN) & (rows.sbn_msg_type == sbn.MsgType.PROTO)
    every = np.bincount(rows.destination[rows.link == SBN], minlength=len(case.endpoints))
    for source, sent in groups(rows.source, np.flatnonzero(protos)):
        heard = int(every[source])
        if len(sent) < _LEAST or 2 * len(sent) < heard:
            continue
        yield habit(
            f"{case.network.identity_of.get(source, 'a peer')} answers every datagram with PROTO, "
            f"{len(sent):,} in all: the public flight bridge does; cFS reports an event for each and goes on",
            f"{len(sent):,} PROTO for {heard:,} datagrams received",
            place=("sbn", "flight bridge"),
            span=case.span(sent),
            remedy="none needed; the events may squelch SBN's others (15 a second)",
        )

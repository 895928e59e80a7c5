"""Connections of the Software Bus Network."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from edoras_tools.cfs import sbn as facts
from edoras_tools.cfs.sbn import NAME
from edoras_tools.diagnosis.evidence.peers import SAID_GOODBYE, UNSEEN, Connection, PeerChange, PeerSilence
from edoras_tools.diagnosis.verdict import Severity, Verdict, note, verdict, warning
from edoras_tools.links.sbn import SBN
from edoras_tools.model import Finding, Peer
from edoras_tools.units import MILLISECOND, SECOND
from edoras_tools.wire import sbn
from edoras_tools.wire.arrays.order import by_value
from edoras_tools.words import plural

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from edoras_tools.diagnosis.case import Case


def sbn_timeout(case: Case) -> Iterator[Verdict]:
    """An SBN peer fell silent and timed out; what cFS sent to it meanwhile reached nobody.

    Name every silence, how long it was, and what was lost in it.
    """
    for connection in case.network.connections.values():
        for silence in connection.silences(case.end_ns):
            yield (
                _verdict(case, connection, silence) if silence.given_up else _still(case, connection, silence)
            )
        for change in connection.changes:
            if change.why == UNSEEN:
                yield _unseen(case, connection, change)


def _unseen(case: Case, connection: Connection, silent: PeerChange) -> Verdict:
    """Say that a peer is not dead, but out of sight."""
    return note(
        f"nothing of SBN peer {connection.peer} is seen here after {case.at(silent.time_ns)}, yet "
        f"{connection.observer} goes on sending to it: its datagrams do not cross this point any more",
        f"{connection.observer} still sent at {case.at(int(connection.sent_ns[-1]))}",
        link="sbn",
        hop="capture",
        span=(silent.time_ns, case.end_ns),
        remedy="capture on the host of cFS, where both directions pass",
        confidence="medium",
    )


def _still(case: Case, connection: Connection, silence: PeerSilence) -> Verdict:
    """Say that a peer is silent when the capture ends: nobody knows whether it is there."""
    sent = connection.sent_in(silence)
    seconds = (case.end_ns - silence.start_ns) / SECOND
    return warning(
        f"SBN peer {connection.peer} is silent since {case.at(silence.start_ns)}, {seconds:.1f} s to the "
        f"end of the capture; {connection.observer} sent it {plural(len(sent), 'message')} since, and "
        "nothing shows whether they were heard",
        f"last datagram of {connection.peer} at {case.at(silence.start_ns)}",
        link="sbn",
        hop=f"SBN peer {connection.peer}",
        of=len(sent) or None,
        span=(silence.start_ns, case.end_ns),
        remedy="capture longer: a peer that is gone is given up after 11 s",
        confidence="medium",
    )


def _verdict(case: Case, connection: Connection, silent: PeerSilence) -> Verdict:
    back_ns = silent.until_ns if silent.until_ns < case.end_ns else None
    until = silent.until_ns
    out_ns = connection.changes[silent.change + 1].time_ns
    sent = connection.sent_in(silent)
    evidence = [
        f"last datagram of {connection.peer} at {case.at(silent.start_ns)}",
        f"{connection.observer} sent it {plural(len(sent), 'message')} after that",
    ]
    if len(sent) and int(sent[-1]) > silent.start_ns:
        evidence.append(f"the last of them at {case.at(int(sent[-1]))}: then it had given the peer up")
    speaks_ns = silent.start_ns + (case.profile.sbn_heartbeat_s + 1) * SECOND
    if early := int((sent <= speaks_ns).sum()):
        evidence.append(
            f"{early:,} of them until {case.at(speaks_ns)}, when a heartbeat was due: it may have heard some"
        )
    evidence += [
        f"event at {case.at(record.time_ns)}: {record}"
        for record in case.said(silent.start_ns, until + SECOND, facts.NAME)
        if connection.peer in record.message
        and any(event.phrase in record.message for event in (facts.TIMED_OUT, facts.DISCONNECTED))
    ]
    returned = (
        f"back after {(back_ns - silent.start_ns) / SECOND:.1f} s" if back_ns else "not back in this capture"
    )
    return verdict(
        Severity.ERROR if len(sent) else Severity.WARNING,
        f"SBN peer {connection.peer} fell silent at {case.at(silent.start_ns)} and timed out at "
        f"{connection.observer} {(out_ns - silent.start_ns) // SECOND} s later; {returned}. It was "
        "killed, stopped or cut off: a stop looks the same as a kill, no DISCONNECT is sent",
        *evidence,
        link="sbn",
        hop=f"SBN peer {connection.peer}",
        lost=len(sent) or None,
        of=len(sent) or None,
        # It is lost until the peer is given up, however long it stays away.
        span=(silent.start_ns, min(max(out_ns, int(sent[-1]) if len(sent) else 0), until)),
        remedy="restart the peer; it is connected again with its first SUB or PROTO. Send DISCONNECT "
        "before a planned stop",
    )


def sbn_peer_restart(case: Case) -> Iterator[Verdict]:
    """An SBN peer was started again before it was given up; what it was sent meanwhile reached nobody.

    Name every restart: cFS noticed none of them.
    """
    for connection in case.network.connections.values():
        for last_ns, dead_ns, back_ns, (last, first) in connection.restarts:
            sent = connection.sent_ns[(connection.sent_ns > last_ns) & (connection.sent_ns < back_ns)]
            lost = int((sent > dead_ns).sum())
            yield verdict(
                Severity.ERROR if lost else Severity.WARNING,
                f"SBN peer {connection.peer} was started again: nothing came from it from {case.at(last_ns)} "
                f"to {case.at(back_ns)}, then it subscribed anew. {connection.observer} did not notice, and "
                f"{plural(lost, 'message')} that it sent reached nobody",
                f"packet {case.rows.number[last]} is its last, packet {case.rows.number[first]} its SUB",
                f"{len(sent) - lost:,} more may have been heard, until {case.at(dead_ns)}",
                link="sbn",
                hop=f"SBN peer {connection.peer}",
                lost=lost or None,
                of=len(sent) or None,
                span=(last_ns, back_ns),
                remedy="send nothing while the peer starts again; its DISCONNECT before a planned stop makes "
                "cFS hold back what is for it",
            )


def sbn_tcp_overwritten(case: Case) -> Iterator[Verdict]:
    """Messages of several SBN peers over TCP that one read of cFS took together: only one of them remains.

    A read of SBN's TCP module goes through all connections of a net into one buffer, and hands over what it
    read last (``Recv`` in ``sbn_tcp_if.c`` of nasa/SBN). So a message is in danger if one of another
    connection came in the same wake-up.
    """
    rows, names = case.rows, case.network.identity_of
    heard = np.flatnonzero((rows.link == SBN) & rows.streamed & (rows.sbn_msg_type >= 0))
    for observer in sorted(set(names.values())):
        ends = [end for end, name in names.items() if name == observer]
        own = heard[np.isin(rows.destination[heard], ends)]
        peers = {names[end] for end in np.unique(rows.source[own]).tolist() if end in names}
        app = own[rows.sbn_msg_type[own] == sbn.MsgType.APP]
        beside = app[_beside(rows.time_ns, rows.source, app, own, case.profile.sbn_wake_ns)]
        if len(peers) < 2 or not len(beside):
            continue
        yield warning(
            f"cFS {observer} hears {len(peers)} SBN peers over TCP, and {len(beside):,} of "
            f"{plural(len(app), 'message')} to it came within {case.profile.sbn_wake_ns // MILLISECOND} ms "
            "of another peer's: of messages that one wake-up finds on several connections, SBN's TCP module "
            "keeps the last and drops the others, without an event or a counter",
            f"peers: {', '.join(sorted(peers))}",
            link="sbn",
            hop=f"SBN of {observer}",
            of=len(app),
            span=case.span(beside),
            remedy="give each TCP peer a net of its own in sbn_conf_tbl (NetNum, and a port of this cFS for "
            "it), or use UDP",
            confidence="medium",
        )


def _beside(
    time_ns: NDArray[np.int64],
    source: NDArray[np.int32],
    app: NDArray[np.intp],
    every: NDArray[np.intp],
    span_ns: int,
) -> NDArray[np.bool_]:
    """Tell which messages have one of another source within a span of time, before or after."""
    near = np.zeros(len(app), bool)
    every_ns, own = time_ns[every], dict(by_value(source[every]))
    for one, mine in by_value(source[app]):
        when = time_ns[app[mine]]
        # Fewer of its own within the span than of all.
        within, of_own = (
            np.searchsorted(times, when + span_ns, "right") - np.searchsorted(times, when - span_ns)
            for times in (every_ns, every_ns[own[one]])
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
    network = np.flatnonzero((rows.link == SBN) & (rows.sbn_msg_type >= 0))
    way = rows.source[network].astype(np.int64) << 32 | rows.destination[network]
    ways = dict(by_value(way))
    for both, at in ways.items():
        source, target = both >> 32, both & 0xFFFFFFFF
        if target << 32 | source in ways:
            continue
        there = network[at]
        first_ns, last_ns = int(rows.time_ns[there[0]]), int(rows.time_ns[there[-1]])
        seconds = len(np.unique(rows.time_ns[there] // SECOND))
        if last_ns - first_ns < _WAIT_NS or seconds < _LEAST_SECONDS:
            continue  # cFS sends each new SUB to every peer of its table, there or not
        who = case.network.identity_of.get(source, str(case.endpoints[source]))
        kinds = np.unique(rows.sbn_msg_type[there]).tolist()
        names = ", ".join(sbn.MSG_TYPE_NAMES.get(kind, hex(kind)) for kind in kinds)
        yield warning(
            f"{who} sends to {case.endpoints[target]} and nothing comes back: the peers are not connected, "
            "or the answers do not cross this capture point",
            f"{plural(len(there), 'datagram')} ({names}) in {(last_ns - first_ns) / SECOND:.0f} s, no answer",
            "stock SBN announces only to a peer whose spacecraft and processor both differ: "
            "between equal spacecraft numbers the first SUB or PROTO of either side has to come "
            "through",
            link="sbn",
            hop="SBN",
            span=(first_ns, last_ns),
            remedy="see that the peer runs, listens at that port, and is in cFS's SBN table with this "
            "identity; capture at the peer to see whether answers leave it",
            confidence="medium",
        )


def sbn_disconnected(case: Case) -> Iterator[Verdict]:
    """An SBN peer said goodbye, or cFS did to its peer.

    Name every DISCONNECT, and when the peer came back.
    """
    yield from _by_cfs(case)
    for connection in case.network.connections.values():
        for at, change in enumerate(connection.changes):
            if change.state != "disconnected" or change.why == SAID_GOODBYE:
                continue
            later = connection.changes[at + 1 :]
            back = next((item for item in later if item.state == "connected"), None)
            told = f"connected again at {case.at(back.time_ns)}" if back else "not back in this capture"
            yield note(
                f"SBN peer {connection.peer} disconnected from {connection.observer} at "
                f"{case.at(change.time_ns)}, in order; {told}",
                change.why,
                link="sbn",
                hop=f"SBN peer {connection.peer}",
                span=(change.time_ns, back.time_ns if back else case.end_ns),
                remedy="none",
            )


def _by_cfs(case: Case) -> Iterator[Verdict]:
    """Name what a cFS says goodbye to: it does so when SBN is loaded anew, or ends."""
    rows, network = case.rows, case.network
    observers = {observer for _, observer in network.connections}
    for row in np.flatnonzero(rows.sbn_msg_type == sbn.MsgType.DISCONNECT).tolist():
        sender, target = (network.party(int(end[row])) for end in (rows.source, rows.destination))
        if sender not in observers or (target in observers and (sender, target) in network.connections):
            continue
        who, peer = sender[0], target[0]
        when = int(rows.time_ns[row])
        sent = (rows.source == rows.source[row]) & (rows.time_ns > when + SECOND)
        back = bool((sent & (rows.sbn_msg_type == sbn.MsgType.APP)).any())
        stops = [
            f"{item.app} was stopped: {item.witness}"
            for item in case.outages
            if item.app == NAME and item.start_ns - SECOND < when < item.ended_ns + SECOND
        ]
        yield verdict(
            Severity.WARNING if back else Severity.ERROR,
            f"{who} disconnected from its SBN peer {peer or 'there'} at {case.at(when)}"
            + ("" if back else ", and sent no application message to anybody after that"),
            f"packet {rows.number[row]}: DISCONNECT from {who}",
            *stops,
            link="sbn",
            hop=f"SBN peer {peer}",
            span=(when, case.end_ns),
            remedy="look at the events of SBN around that time; to restart it: "
            f"{case.inject('es-restart-app', NAME)}",
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
    identity = rows.spacecraft_id[spoken].astype(np.uint64) << 32 | rows.processor_id[spoken]
    seen, first, counts = np.unique(identity, return_index=True, return_counts=True)
    heard = {
        Peer(who >> 32, who & 0xFFFFFFFF): (int(spoken[at]), number)
        for who, at, number in zip(seen.tolist(), first.tolist(), counts.tolist(), strict=True)
    }
    for peer, (row, number) in heard.items():
        start_ns = int(rows.time_ns[row])
        if peer not in table:
            yield warning(
                f"{peer} sends on SBN, and the table that was given does not name it: a cFS with this table "
                "refuses what it sends",
                f"{plural(number, 'datagram')} of it, from {case.endpoints[rows.source[row]]}",
                link="sbn",
                hop="SBN",
                span=(start_ns, case.end_ns),
                remedy=f"add {peer} to sbn_conf_tbl, or give the bridge an identity that is in it",
                confidence="medium",
            )
    for peer, place in table.items():
        if peer not in heard:
            yield note(
                f"{peer}, which the table that was given names at {place.address}:{place.port}, sends "
                "nothing that was captured",
                f"on SBN are {', '.join(map(str, heard))}",
                link="sbn",
                hop="SBN",
                remedy="see whether it runs; capture where its datagrams pass",
                confidence="high",
            )

"""What the capture itself holds, lacks or does wrong: this goes for everything below."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from edoras_tools.decode.conversations import ConversationKind, foreign
from edoras_tools.diagnosis.evidence.relays import PROXY_HOP
from edoras_tools.diagnosis.ledger import ON_PURPOSE
from edoras_tools.diagnosis.verdict import Severity, Verdict, error, note, verdict, warning
from edoras_tools.links import table
from edoras_tools.model import OTHER, Finding
from edoras_tools.units import SECOND
from edoras_tools.wire.arrays import by_value, groups
from edoras_tools.wire.sbn import MsgType
from edoras_tools.words import plural, seconds

if TYPE_CHECKING:
    from collections.abc import Iterator

    from edoras_tools.decode.conversations import Flow
    from edoras_tools.diagnosis.case import Case

AWAY = "is away: what has been sent since"


def not_examined(case: Case) -> Iterator[Verdict]:
    """What was left out: traffic whose port nobody names, and times in which the interface was away.

    Say so first: what is below is not the whole link.
    """
    for item in case.unnamed:
        agree = "lengths, types and MsgIds in it agree as only that link's do"
        yield error(item.advice, agree, hop="capture", remedy=item.remedy)
    away = []
    for outage in case.capture.outages:
        end_ns = outage.end_ns or max(case.end_ns, outage.start_ns)
        lasted = f"was away {(end_ns - outage.start_ns) / 1e9:.1f} s: what was sent then"
        reason = f"{outage.interface} {lasted if outage.end_ns else AWAY} is not examined"
        away.append((reason, f"the recorder found it {outage.why}", (outage.start_ns, end_ns)))
    for start_ns, end_ns in case.holes if len(case.rows) else ():
        reason = f"the capture has a hole of {(end_ns - start_ns) / 1e9:.1f} s: traffic in it is not examined"
        why = "it shows no datagram of anybody; all sent before and after, and cFS went on counting"
        away.append((reason, why, (start_ns, end_ns)))
    ends = case.telemetry.ends.values() if away and len(case.rows) else ()
    missing = sum(item["away"] for item in ends)
    gaps = f"sequence counts: {plural(missing, 'message')} that span such a time are not captured"
    for reason, why, span in away:
        facts = [why, gaps] if missing else [why]
        remedy = "examine the time before it and the time after it alone: --start and --end"
        yield warning(reason, *facts, hop="capture", span=span, remedy=remedy)


def more_senders(case: Case) -> Iterator[Verdict]:
    """Senders beyond the number that is judged: those that sent least are counted together, and left out."""
    if len(crowd := case.prepared.crowd):
        who = f"{plural(len(crowd), 'more sender')} of what comes from cFS, each of at most {crowd.max():,}"
        why = "so many are no flight software: addresses are forged, or another program sends to these ports"
        remedy = "record what counts alone: edoras record FILE --where 'source == ADDRESS' -o OUT.pcap"
        left_out = f"{who}, not examined: {plural(int(crowd.sum()), 'datagram')}"
        yield warning(left_out, why, hop="capture", remedy=remedy)


def capture_drops(case: Case) -> Iterator[Verdict]:
    """The capture itself lost packets: what it misses is not cFS's fault.

    Say so before anything else is blamed.
    """
    if drops := case.capture.drops:
        reason = f"the capture itself lost {drops:,} frames: what is missing below may be among them"
        remedy = "capture on a faster host or to a faster disk, with a filter on the links' ports"
        of, why = drops + len(case.rows), "the capture's own drop counter"
        yield error(reason, why, hop="capture", lost=drops, of=of, remedy=remedy)


def cut_frames(case: Case) -> Iterator[Verdict]:
    """The capture kept only the beginnings of frames: what it cannot show is nobody's fault.

    Say so before anything else.
    """
    cut = np.flatnonzero(case.rows.has(Finding.CAPTURE_CUT))
    if len(cut):
        yield warning(
            f"{len(cut):,} of {len(case.rows):,} frames were cut by the capture: what their ends would show "
            "(messages, events, counters) is not judged; datagrams are counted",
            "the capture says that these frames were longer on the wire",
            hop="capture",
            span=case.span(cut),
            remedy="capture whole frames, without -s or with -s 0",
        )


def stream_gap(case: Case) -> Iterator[Verdict]:
    """Bytes of TCP streams are missing in the capture: TCP delivered them, so nobody lost what was in them.

    Name each link whose streams have messages behind missing bytes.
    """
    rows = case.rows
    behind = rows.has(Finding.STREAM_GAP) & ~rows.has(Finding.FRAGMENT)
    for link in case.context.links:
        members = np.flatnonzero(behind & (rows.link == link))
        if not link.transport.tcp or not len(members):
            continue
        first = int(members[0])
        yield warning(
            f"{link.name} over TCP: bytes are missing in front of {plural(len(members), 'message')} of "
            f"{int((rows.link == link).sum()):,}; what was in them is not judged",
            f"packet {rows.number[first]}: the first message behind bytes that are missing or no message",
            "TCP delivers every byte or ends the connection: the capture lacks them, the peer does not",
            place=(link.label, "capture"),
            span=case.span(members),
            remedy="capture whole frames, with a larger buffer, and from before the connections begin",
        )


def not_cfs(case: Case) -> Iterator[Verdict]:
    """Traffic on the links' ports that is not cFS's: left out; what reached a cFS is told by sender.

    One line for each port, and one verdict for each stranger. What an SBN peer sends there is lost.
    """
    flows, peers = case.prepared.flows, {case.endpoints[end]: end for end in case.network.identity_of}
    for line in foreign(flow for flow in flows if flow.kind is ConversationKind.FOREIGN):
        yield note(line, hop="capture", remedy="none; another program uses this port, and no cFS gets it")
    for flow in flows:
        if flow.kind is ConversationKind.STRANGER and flow.source in peers:
            yield _astray(case, flow, peers[flow.source])
        elif flow.kind is ConversationKind.STRANGER:
            yield warning(
                f"{flow.datagrams:,} datagrams on port {flow.destination.port} do not look like cFS, left "
                f"out: {flow.source} sends them to {flow.destination}, where {flow.link.name} is",
                "none of them is a packet whose length agrees, or has a MsgId that is known",
                place=(flow.link.label, str(flow.source)),
                span=(flow.first_ns, flow.last_ns),
                remedy=f"another program at {flow.source.address} sends to this port; move it",
            )


def _astray(case: Case, flow: Flow, end: int) -> Verdict:
    """Say that an SBN peer sends to another link's port: its messages are known by their sizes."""
    rows, peer, port = case.rows, case.network.identity_of[end], case.endpoints.index(flow.destination)
    own, app = rows.source == end, rows.sbn_msg_type == MsgType.APP
    sizes = np.setdiff1d(rows.length[own & app], rows.length[own & (rows.sbn_msg_type >= 0) & ~app])
    number = int((own & (rows.destination == port) & np.isin(rows.length, sizes)).sum())
    return verdict(
        Severity.ERROR if number else Severity.WARNING,
        f"SBN peer {peer} sends to {flow.destination}, where {flow.link.name} is: nobody takes what it sends",
        f"{plural(flow.datagrams, 'datagram')} went there, {number:,} of them as long as its messages are",
        place=(OTHER.label, f"{flow.link.name}, which takes no SBN"),
        lost=number or None,
        of=number or None,
        span=(flow.first_ns, flow.last_ns),
        remedy=f"let SBN peer {peer} send to SBN's port: what it sends here is lost",
    )


def captured_twice(case: Case) -> Iterator[Verdict]:
    """The same datagrams are in the capture more than once: on ``any`` or at two taps.

    Say how many were counted once.
    """
    if copies := case.prepared.copies:
        yield note(
            f"{copies:,} datagrams were captured twice, and are counted once",
            "the same bytes with the same IP identification, or at another place, within ms",
            *(
                f"{other} is another name of {name}: the same datagrams are there, only forwarded"
                for other, name in case.prepared.translated.items()
                if other != name
            ),
            hop="capture",
            remedy="capture on one interface instead of any, or at one place",
        )


def too_many(start_ns: int, end_ns: int, most: int) -> Verdict:
    """Return what is said first, by no rule that is asked, where they are too many to be sorted."""
    return error(
        f"the whole capture is out of time order, and holds more than the {most:,} datagrams that can be "
        "sorted: it is judged in parts, and what is said of loss, order and restarts is not right",
        hop="capture",
        span=(start_ns, end_ns),
        remedy="put it in order first: reordercap IN OUT",
        rule="out_of_order",
    )


def out_of_order(case: Case) -> Iterator[Verdict]:
    """Records of the file that stand behind later ones.

    Say that they were sorted.
    """
    if count := case.prepared.disordered:
        reason = f"{plural(count, 'record')} out of order in the capture; all were put in order of time"
        why = "capture times run back, and the times in cFS's packets with them"
        yield note(reason, why, hop="capture", remedy="none; reordercap writes such a file in order")


def duplicated(case: Case) -> Iterator[Verdict]:
    """The network delivered datagrams twice, or late; or nothing tells whether the capture has them twice.

    Say so for each way between two endpoints.
    """
    prepared = case.prepared
    for rows, by_network in ((case.rows.take(prepared.duplicates), True), (prepared.doubled, False)):
        for _, own in by_value(rows.way()):
            sender, receiver = (case.endpoints[end[own[0]]] for end in (rows.source, rows.destination))
            how, remedy = "doubled by the network", "none; whoever receives them gets them twice"
            if not by_network:
                how = "captured twice; nothing shows whether the network doubled what was sent"
                remedy = "capture what CI counts (0x884), or what comes out: that tells how often they came"
            which = f"{plural(len(own), 'datagram')} from {sender} to {receiver}"
            reason = f"{which} {'was' if len(own) == 1 else 'were'} {how}"
            why = "the same bytes with the same IP identification, captured at one place"
            span = int(rows.time_ns[own].min()), int(rows.time_ns[own].max())
            yield note(reason, why, hop="network", span=span, remedy=remedy)
    rows = case.rows
    for _, own in groups(rows.way(), np.flatnonzero((rows.reordered != 0) & ~rows.streamed)):
        # A row may tell that an earlier one was not late after all.
        if (number := int(rows.reordered[own].sum())) > 0:
            sender, receiver = (case.endpoints[end[own[0]]] for end in (rows.source, rows.destination))
            put = "it behind a later one" if number == 1 else "them behind later ones"
            which = f"{plural(number, 'datagram')} from {sender} to {receiver}"
            why = "their sequence counts are lower than those before, and nothing began anew"
            remedy = "none; who receives them sees an older value after a newer one"
            reason = f"{which} came late: the network put {put}"
            yield note(reason, why, hop="network", span=case.span(own), remedy=remedy)


def clock_jump(case: Case) -> Iterator[Verdict]:
    """A clock was set while the capture ran.

    Name every clock that was set; all times of this diagnosis are as if it had not been.
    """
    torn = {jump.row for jump in case.jumps if jump.clock == "capture"}
    for jump in case.jumps:
        when = int(case.rows.time_ns[jump.row])
        own = jump.clock == "capture"
        began = any(item.start_ns < when <= item.end_ns + SECOND for item in case.resets)
        began |= jump.row in torn and not own  # it is the capture's that was set
        if began or (jump.clock == "cFS" and any(item.name for item in case.instances.items)):
            continue  # it started again
        clock = f"the clock of cFS {jump.clock}".removesuffix(" cFS")  # one that no packet names
        whose = "the capture's own clock" if own else f"{clock}, and not the capture's,"
        yield warning(
            f"{whose} was set {'back' if jump.by_ns < 0 else 'ahead'} by {seconds(abs(jump.by_ns) / SECOND)} "
            f"at packet {case.rows.number[jump.row]}: times here are given as if it had not",
            "time runs back from one packet to the next"
            if jump.by_ns < 0 and own
            else "mission time and the capture's part ways here, and sequence counts go on: no restart",
            *(
                f"sent at {case.at(span.start_lo)}: {span.change.witness}"
                for span in (() if own else case.timeline.every("set"))
                if span.start_lo - SECOND <= when <= span.start_hi
            ),
            hop="capture" if own else "cFS",
            span=(when, when),
            remedy="discipline the clock (chrony), and do not set it while capturing"
            if own
            else "see who sends TIME commands (0x1805); mission times before and after do not compare",
            confidence="high" if own and jump.by_ns < 0 else "medium",
        )


def proxy_faults(case: Case) -> Iterator[Verdict]:
    """A proxy, or a replay, did something wrong on purpose: the recording says so, and nobody is to blame.

    Say what was done to each MsgId.
    """
    if case.prepared.relayed:
        which = f"{plural(case.prepared.relayed, 'datagram')} were captured in front of the proxy"
        reason = f"{which}: they are its own recording's once more, and not counted again"
        yield note(reason, "what the proxy dropped is among them", hop=PROXY_HOP, remedy="none")
    for (link, to_cfs, msg_id), item in case.proxied.items():
        struck = {f"struck by {kind}": number for kind, number in item.others.items()}
        actions = {"dropped": len(item.dropped), "sent again": item.doubled} | struck
        counts = [f"{number:,} {action}" for action, number in actions.items() if number]
        way = "to cFS" if to_cfs else "from cFS"
        yield verdict(
            Severity.WARNING if item.dropped else Severity.NOTE,
            f"datagrams on {case.name(msg_id)} {way}: {', '.join(counts)} on purpose by the proxy",
            ON_PURPOSE,
            *(f"rule {rule}" for rule in item.rules),
            msg_id=msg_id if msg_id >= 0 else None,
            place=(table.link(link).label, PROXY_HOP),
            lost=len(item.dropped) or None,
            span=(item.start_ns, item.end_ns),
            remedy="none: it was asked for",
        )

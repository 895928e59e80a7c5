"""What arrives with other values or late, and what is missing: between links, behind cFS, at closed ports."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np
from msgspec.structs import replace

from edoras_tools.cfs.commands import ENABLE_OUTPUT
from edoras_tools.cfs.software_bus import NAME
from edoras_tools.diagnosis.accounting.budget import limit
from edoras_tools.diagnosis.accounting.closed import (
    PORT_CLOSED,
    REFUSED,
    UDP_PORT,
    lacks_control,
    may_lack_control,
)
from edoras_tools.diagnosis.accounting.losses import BUS, Fate, Loss
from edoras_tools.diagnosis.evidence.timeline.table import NEVER
from edoras_tools.diagnosis.ledger import CAUSES
from edoras_tools.diagnosis.quality import overlapping
from edoras_tools.diagnosis.rules.about import loss_verdict, lost_at, packet, subject
from edoras_tools.diagnosis.verdict import (
    NOTHING_SENT,
    Severity,
    Verdict,
    error,
    habit,
    note,
    verdict,
    warning,
)
from edoras_tools.links.bare import CI, ROBOT, TO
from edoras_tools.links.icmp import error_text
from edoras_tools.links.sbn import SBN
from edoras_tools.model import rate_hz
from edoras_tools.units import SECOND
from edoras_tools.wire.arrays import by_key, distinct
from edoras_tools.words import either, listed, plural

if TYPE_CHECKING:
    from collections.abc import Iterator

    from edoras_tools.diagnosis.accounting.content import WayContent
    from edoras_tools.diagnosis.case import Case
    from edoras_tools.diagnosis.evidence.unreachable import ClosedSpan
    from edoras_tools.diagnosis.matching.streams import Stream
    from edoras_tools.model import Endpoint
    from edoras_tools.wire.arrays import Integers, Places

_EDORAS = "EDORAS"
"""The public applications, their pipes and their housekeeping begin so; these pass values on as they are."""
_FEW = 4
_LEAST = 3
_APP_NS = SECOND
"""The public applications read their robot's states once a second."""
_SLACK_NS = 3 * SECOND


def changed_values(case: Case) -> Iterator[Verdict]:
    """What reaches a robot, or leaves cFS again, has values that were never sent.

    Tell how many have changed, and how many always hold the same one. An application may change values on
    purpose; those of EDORAS do not.
    """
    names = [item.app for item in case.payloads.events]
    names += [item.pipe for item in case.reported_losses]
    names += [case.packet_name(stream.msg_id) for stream in case.streams if stream.link.only_from_cfs]
    passes_on = next((name for name in names if name.startswith(_EDORAS)), "")
    for item in case.contents:
        same, other = len(item.constant), len(item.changed)
        if not same + other:
            continue
        where, same_one = _where(case, item), f"{same:,} always hold the same one"
        if same + other == item.of:  # nothing that came out has a value that was sent
            all_ = f"all {item.of:,}" if not same or not other else f"{other:,} changed, {same_one}"
            how = "" if same and other else " always hold the same one" if same else " changed"
            text = f"{NOTHING_SENT[0]} that {where} {NOTHING_SENT[1]}: {all_}{how}"
        else:
            text = f"{same + other:,} of {item.of:,} that {where} have a value that was never sent"
            text += f": {same_one}" if same else ""
        purpose = "" if same else "an application that changes values on purpose does this, too"
        if passes_on:
            purpose = f"{passes_on} is here: the public EDORAS applications pass values on as they are"
        yield _about(
            Severity.ERROR if passes_on or same else Severity.WARNING,
            case,
            item,
            text,
            *(_first(case, item.constant if same else item.changed), purpose),
            remedy="look at what the application sends: a struct that was not filled, as after a command "
            "that it failed to parse, or one that something else wrote over",
        )


def old_values(case: Case) -> Iterator[Verdict]:
    """What reaches a robot, or leaves cFS again, is older than others, or later than rounds make it.

    Tell how many came again after newer ones, and how many took too long.
    """
    for item in case.contents:
        again, late = len(item.again), len(item.late)
        longest = f"up to {item.longest_ns / SECOND:.1f} s after they were sent"
        if again:
            yield _about(
                Severity.ERROR,
                case,
                item,
                f"{again:,} of {item.of:,} that {_where(case, item)} came with an old value, {longest}",
                _first(case, item.again),
                "others that were sent later had arrived, or were due",
                remedy="look for a network or relay that doubles or delays, and for an application that "
                "reads slower than it is sent to, or sends what it has kept",
            )
        if late:
            yield _about(
                Severity.WARNING,
                case,
                item,
                f"{late:,} of {item.of:,} that {_where(case, item)} were late, {longest}: rounds and CI's "
                f"socket explain {item.rounds_ns / SECOND:.1f} s at most",
                _first(case, item.late),
                remedy="look for a queue on the way that is served slower than it is filled",
            )


def old_states(case: Case) -> Iterator[Verdict]:
    """An application reads slower than its robot sends: what leaves cFS is older and older.

    Tell how old the states of the robot become, and both rates.
    """
    for item in case.passed_states:
        old = item.age_ns > _APP_NS + case.profile.to_wake_ns + _SLACK_NS
        if old.sum() < _LEAST:
            continue
        ways = item.sent_ns, item.time_ns
        sent, passed = (rate_hz(len(times), int(times[-1] - times[0])) for times in ways)
        last, oldest = int(np.flatnonzero(old)[-1]), int(item.age_ns.argmax())
        at = case.at(int(item.time_ns[oldest]))
        yield warning(
            f"{int(old.sum()):,} of {len(old):,} messages on {case.name(item.msg_id)} carry an old state of "
            f"the robot, up to {item.age_ns[oldest] / SECOND:.1f} s old",
            f"packet {item.number[oldest]} at {at}: {item.age_ns[oldest] / SECOND:.1f} s after it was sent",
            f"the robot sends {sent:.1f} a second, {passed:.1f} a second are passed on: the rest waits",
            msg_id=item.msg_id,
            place=(TO.label, "flight application"),
            span=(int(item.time_ns[old.argmax()]), int(item.time_ns[last])),
            remedy=f"let the application pass on the newest, or the robot send {passed:.1f} a second",
        )


def value_limits(case: Case) -> Iterator[Verdict]:
    """Values are outside the limits that the layout of their struct sets.

    Name each field, how many values are outside its yellow and its red limits, and the lowest and highest.
    """
    beyond = case.payloads.beyond
    for name, (number, member) in case.payloads.limited.items():
        among = beyond["field"] == number
        rows, value = beyond["row"][among], beyond["value"][among].view(np.float64)
        red, unit = int(beyond["red"][among].sum()), f" {member.unit}".rstrip()
        if len(rows):
            yield warning(
                f"{name}: {plural(len(rows), 'value')} outside its limits, {red:,} outside the red ones",
                f"{packet(case, int(rows[0]))}: {value[0]:.9g}{unit}",
                f"lowest {value.min():.9g}{unit}, highest {value.max():.9g}{unit}; limits: {member.limits}",
                **subject(case, rows),
                remedy="look for the cause on board, or correct the limits in the layout or the data sheet",
            )


def _about(
    severity: Severity, case: Case, item: WayContent, text: str, *evidence: str, remedy: str
) -> Verdict:
    return verdict(
        severity,
        text,
        *evidence,
        msg_id=item.into.msg_id if item.out.link.last_hop else item.out.msg_id,
        place=(item.out.link.label, "flight application"),
        span=case.span(item.out.rows),
        remedy=remedy,
        confidence="medium",
    )


def _where(case: Case, item: WayContent) -> str:
    return "reached the robot" if item.out.link.last_hop else f"came out as {case.name(item.out.msg_id)}"


def _first(case: Case, members: Places) -> str:
    return listed([packet(case, int(row)) for row in members[:_FEW]]) + ", and more" * (len(members) > _FEW)


_IN_A_ROW: Final = 8
"""So many in a row do not vanish by chance, while others come."""


def crossing_loss(case: Case) -> Iterator[Verdict]:
    """Messages went into cFS and never came out, and nothing in the capture says why.

    Say what is not accounted for, and what had nowhere to go.
    """
    remedies = {
        "away": "see that the peer runs, and that what it sends comes to cFS: its next SUB connects it",
        "unsubscribed": "let the peer subscribe to that MsgId again: compare what it is told to receive",
        "disabled": f"enable Telemetry Output as soon as it runs: {case.inject(ENABLE_OUTPUT)}",
        "beside": "end one of the two cFS: an application of the second one may find its port in use",
        "sbn_socket": f"spread what is sent: SBN reads every {case.profile.sbn_wake_ns / 1e6:.0f} ms, and "
        f"its socket holds about {case.profile.socket_queue} (assumed)",
        "route": "enable it: 0x1803, function code 4, with the MsgId and the pipe of that command",
    }
    for loss in case.losses:
        if loss.kind in remedies:
            text, remedy = f"{lost_at(case, loss)} {CAUSES[loss.kind].text}", remedies[loss.kind]
            for own in case.verdicts if loss.kind == "unsubscribed" else ():
                if own.rule == "wrong_ident" and own.start_ns <= loss.end_ns and loss.start_ns <= own.end_ns:
                    remedy = own.remedy
            yield loss_verdict(case, loss, text, remedy)
    for fate in case.commands.fates.values():
        if fate.ends["unaccounted"] or fate.ends["beyond"]:
            times, reason, evidence, remedy = (_never_out if fate.seen else _unfollowed)(case, fate)
            yield verdict(
                Severity.ERROR if fate.seen and fate.ends["unaccounted"] else Severity.WARNING,
                reason,
                *(*evidence, *case.drops_text()),
                msg_id=fate.stream.msg_id,
                place=(fate.stream.link.label, "application"),
                of=len(fate.stream),
                span=(int(times[0]), int(times[-1])),
                remedy=remedy,
                confidence="low" if fate.seen and not case.tracks else "medium",
            )


def _never_out(case: Case, fate: Fate) -> tuple[Integers, str, list[str], str]:
    """Return when what did not come out was sent, the sentence about it, the evidence, and what to do."""
    stream = fate.stream
    ways = dict.fromkeys(
        "to the robot" if hop.out.link == ROBOT else f"as {case.name(hop.out.msg_id)}" for hop in fate.hops
    )
    missing, visible = stream.time_ns[fate.open], bool(case.tracks)
    evidence = [f"{int(fate.arrived.sum()):,} came out {', '.join(ways)} with the same values"]
    accounts = case.ingests_at(stream.receiver)
    last_ns = max((item.last_ns for item in accounts), default=case.end_ns)
    behind = int((missing > last_ns).sum())
    if uncounted := visible and not accounts and stream.link.only_to_cfs:
        evidence.append("0x803 has none of them, and 0x884 is not here: CI may never have read them")
    elif visible and behind < len(missing):
        evidence.append("cFS's counters (0x803, 0x884) do not explain these")
    elif not visible:
        evidence.append("0x803 is not in the capture, so the software bus cannot be cleared or blamed")
    if behind:
        evidence.append(
            f"{behind:,} of them were sent after the last count of CI here, at {case.at(last_ns)}: whether "
            "CI, cFS or the application was away then, nothing tells"
        )
    unaccounted = fate.ends["unaccounted"]
    went_in = f"{unaccounted or fate.ends['beyond']:,} of {len(stream):,} messages that went into cFS"
    out = f"came out {' or '.join(ways)}"
    why = f"may be lost: they were sent before the first that {out}, or behind the last"
    if unaccounted:
        why = f"are not accounted for: they never {out}, and the capture cannot show why"
    remedy = "look at the application's counters and console; capture on cFS's host, from before the traffic"
    if uncounted:
        remedy = "let Telemetry Output send 0x884, CI's counts: they tell whether the uplink lost these"
    return missing, f"{went_in} on {case.name(stream.msg_id)} {why}", evidence, remedy


def _unfollowed(case: Case, fate: Fate) -> tuple[Integers, str, list[str], str]:
    """Return the same of what nobody can follow: an application stopped, or none subscribed to it."""
    stream, times, evidence, lost = fate.stream, fate.stream.time_ns, [], "are not accounted for"
    if fate.reached is not None:
        why = f"the robot got {fate.reached:,}, and which they were is cut off"
        evidence = ["datagrams counted: to CI, and on the robot link"]
    elif fate.commanded is not None:
        why = f"Telemetry Output counted {fate.commanded:,} commands meanwhile"
        evidence = ["0x880: its counters of commands taken and refused, between the first and the last here"]
    else:
        why = f"nothing here shows whether an application took them ({fate.undecidable_since})"
        times, lost = times[fate.undecidable], "may be lost"
    which = f"{fate.ends['unaccounted']:,} of {len(stream):,} messages sent to cFS on"
    remedy = "capture what comes out of the application too: the robot link (UDP 8080 to 8585), SBN"
    return times, f"{which} {case.name(stream.msg_id)} {lost}: {why}", evidence, remedy


def lost_after_cfs(case: Case) -> Iterator[Verdict]:
    """Counts are missing while the software bus lost nothing: it happened between cFS and the capture.

    Say that the counters clear cFS: a verdict a topic, and one for all housekeeping of a sender.
    """
    after = [loss for loss in case.losses if loss.kind in {"after", "fragments"}]

    def relay_and_kind(loss: Loss) -> tuple[str, tuple[object, ...]]:
        if loss.stream is None:  # no message of it ever came whole
            return "", (loss.kind,)
        together = loss.stream.is_housekeeping or loss.kind == "fragments"
        key = (loss.stream.sender, loss.stream.link, loss.kind) if together else (id(loss),)
        return _relay_of(case, loss, loss.stream), key

    for (relay, _), members in by_key(after, relay_and_kind).items():
        yield _lost_after(case, members, relay)


def _relay_of(case: Case, loss: Loss, stream: Stream) -> str:
    """Return the relay that took what is missing, and did not send it on; empty where none did."""
    place = stream.link.code, loss.msg_id, stream.receiver
    for item in case.prepared.passed:
        near = (item.lost_ns > loss.start_ns - SECOND) & (item.lost_ns < loss.end_ns + SECOND)
        if (item.link, item.msg_id, item.receiver) == place and near.sum() >= loss.lost:
            return item.hop
    return ""


def _lost_after(case: Case, members: list[Loss], relay: str) -> Verdict:
    first = members[0]
    lost, of = (sum(getattr(loss, name) or 0 for loss in members) for name in ("lost", "of"))
    names = list(dict.fromkeys(case.name(loss.msg_id) for loss in members))
    one, evidence = len(names) == 1, list(first.evidence)
    if not one:
        # What the counters say of each is the same; of how many counts, each has its own.
        alike = [line for line in first.evidence[1:] if all(line in loss.evidence for loss in members)]
        evidence = [*(f"{case.name(loss.msg_id)}: {loss.lost:,}" for loss in members), *alike]
    if first.kind == "fragments":
        where = "never became whole: a firewall or a router drops their later fragments"
        remedy = "let fragments through on the way, or raise its MTU above the longest of these"
    elif one and (longest := _longest(case, first)):
        where = f"are missing, and none longer than {longest:,} bytes came meanwhile, though shorter ones did"
        remedy = f"look at the MTU on the way, and at firewalls: above {longest:,} bytes none came meanwhile"
    elif relay:
        where, remedy = f"went into {relay} and did not come out of it", "look at its log and its queue"
    else:
        where = "are missing, and the bus lost none of them: they were lost behind cFS, or by the capture"
        remedy = (
            "look at the network between the captures, and at the queue of the cFS host (tc -s qdisc)"
            if case.capture.shared
            else "capture on the cFS host too: packets seen there but not here were lost by the network, "
            "those missing there as well by that host's own queue (tc -s qdisc)"
        )
    return error(
        f"{lost:,} of {of:,} messages on {names[0] if one else f'{len(names)} MsgIds'} {where}",
        *evidence,
        *case.drops_text(),
        msg_id=first.msg_id if one else None,
        place=(first.stream.link.label if first.stream else None, relay or first.hop),
        lost=lost,
        of=of,
        span=(min(loss.start_ns for loss in members), max(loss.end_ns for loss in members)),
        remedy=remedy,
        confidence="low" if case.capture.drops else first.confidence,
        cause=first.kind,
    )


def _longest(case: Case, loss: Loss) -> int:
    """Return how long what came was while none of these did, where all of it is shorter; 0 elsewhere."""
    rows, stream, among = case.rows, loss.stream, loss.among
    if stream is None or among is None or among.missing is None:
        return 0
    starts, ends = (np.append(stream.time_ns, NEVER)[among.rows + later] for later in (0, 1))
    # Where a full pipe lets some through in each round, little comes between two rounds.
    long = (among.missing >= _IN_A_ROW) & (ends - starts > _IN_A_ROW * case.profile.to_wake_ns)
    spans = list(zip(starts[long].tolist(), ends[long].tolist(), strict=True))
    inside = (rows.source == stream.sender) & overlapping(rows.time_ns, rows.time_ns, spans)
    longest = int(rows.length[inside].max(initial=0))
    fewer = inside.sum() < _IN_A_ROW or 2 * among.missing[long].sum() <= loss.lost
    return 0 if fewer or longest >= rows.length[stream.rows].min() else longest


def perhaps_lost(case: Case) -> Iterator[Verdict]:
    """Messages are missing, and the capture itself may have missed them.

    Say how many, of which topics, and how good the capture surely is.
    """
    ends, fates = case.telemetry.ends, case.commands.fates.values()
    both = [(item.stream, item.ends["missed"]) for item in fates]
    both += [(item, ends[item]["uncertain"] + ends[item]["astray"]) for item in case.streams]
    unsure = [(item, number) for item, number in both if number]
    if not unsure:
        return
    (checked, lacking), most = case.quality.best, 100 * case.quality.upper_share()
    total, streams = sum(number for _, number in unsure), [stream for stream, _ in unsure]
    basis = f"{checked:,} datagrams were checked that surely passed: {lacking:,} lack"
    late_ns = max((case.blind_spans(item.hops)[-1][1] for item in fates if item.ends["missed"]), default=0)
    late = f"; the capture of what came out begins at {case.at(late_ns)} only" if late_ns else ""
    yield warning(
        f"{plural(total, 'message')} may be lost, or the capture missed "
        f"{'it' if total == 1 else 'them'}: it may lack up to {min(most, 99):.2g} % of what passed{late}",
        basis if checked else "nothing here tells what the capture missed",
        *(
            f"nothing at all was captured from {case.at(start_ns)} to {case.at(end_ns)}"
            for start_ns, end_ns in case.possible_holes
        ),
        *(f"{case.name(stream.msg_id)}: {number:,} of {len(stream) + number:,}" for stream, number in unsure),
        *case.drops_text(),
        msg_id=streams[0].msg_id if len(streams) == 1 else None,
        link=streams[0].link.label if len({stream.link for stream in streams}) == 1 else None,
        span=(int(min(own.time_ns[0] for own in streams)), int(max(own.time_ns[-1] for own in streams))),
        remedy="begin all captures before the traffic"
        if late
        else "see how many frames the kernel dropped while capturing: if none, these messages are lost. "
        "pcapng has that count, and so has what this writes: edoras record",
        confidence="low",
    )


def unexplained_gap(case: Case) -> Iterator[Verdict]:
    """Counts are missing, and nothing in the capture tells where they were lost.

    Say which capture would tell.
    """
    for loss in case.losses:
        own = loss.stream
        if loss.kind != "unknown" or own is None:
            continue
        clean, pipe, why, _ = limit(own.link, loss.msg_id, case.profile, to_cfs=False)
        offered, which = loss.offered_hz, f"{loss.lost:,} of {loss.of:,} messages on {case.name(loss.msg_id)}"
        likely = f"published at {offered:.0f}/s; {why}: {clean:g}/s, so {pipe} is the likely place"
        reason = f"{which} missing behind the last place that counts them; the capture cannot show where"
        remedy = "capture TO's link with 0x803 and 0x808 in its table: its counters and events tell"
        item = loss_verdict(case, loss, reason, remedy, likely if offered > clean else "")
        yield replace(item, hop=pipe if offered > clean else None, confidence="low")
    for stream in case.streams:
        if undecided := case.telemetry.ends[stream]["undecided"]:
            why, remedy = _why_undecided(case, stream)
            reason = f"{undecided:,} of {case.name(stream.msg_id)} may be lost: {why}"
            about = subject(case, stream.rows) | {"of": len(stream) + undecided, "confidence": "low"}
            yield warning(reason, *case.drops_text(), **about, remedy=remedy)


def _why_undecided(case: Case, stream: Stream) -> tuple[str, str]:
    """Return why nothing tells what became of counts that are missing, and what would tell."""
    if not may_lack_control(case, stream):
        why = "the capture cut off when packets were made, so nothing tells whether they were lost, not sent,"
        return f"{why} or are another cFS's", "capture whole frames, without -s or with -s 0"
    if stream.link.peers:
        why = "what the peer sends is not in the capture, or cut, so nothing tells whether it was to get them"
        return f"SBN sent it none then, and {why}", "capture what the peer sends, too, in whole frames"
    why = "no command to cFS is in the capture"
    if not lacks_control(case, stream):
        why = "the capture misses some datagrams, perhaps a command to it"
    why += ", so nothing tells whether it was told not to send them"
    return f"Telemetry Output sent none then, and {why}", "capture what is sent to CI, too"


def unattributed_loss(case: Case) -> Iterator[Verdict]:
    """The software bus counts losses of several kinds of traffic, or of none that is seen here.

    Say how many, of which they may be, and what would tell.
    """
    lacking = [item.name for item in (CI, TO, SBN) if not (case.rows.link == item).any()]
    also = f"capture {' and '.join(lacking)} too where cFS uses it, and " if lacking else ""
    names_them = f"let events name them from the start on: {case.inject(ENABLE_OUTPUT)}; "
    names_them += case.inject("evs-reset-filters", NAME)
    reported = [item for item in case.reported_losses if item.at_pipe]
    for loss in case.losses:
        if loss.rivals or (loss.kind == "unknown" and loss.stream is None):
            where = f"on the {BUS}" if loss.hop == BUS else f"at {loss.hop}"
            which = either(list(dict.fromkeys(case.name(msg_id) for _, msg_id, _ in loss.rivals)))
            names = sorted({case.name(item.msg_id) for item in reported if item.instance == loss.instance})
            alone = f": events name {listed(names)} alone" * bool(names)
            question = f"whether of {which}" if which else f"which{alone}"
            ids = {msg_id for _, msg_id, _ in loss.rivals}
            own = [item for item in case.losses if item.msg_id in ids]
            helped = loss.hop in [item.hop for item in own] or ids == {item.msg_id for item in own} != set()
            yield error(
                f"{plural(loss.lost, 'message')} lost {where} of {case.label(loss.instance)}; the capture "
                f"cannot show {question}",
                *loss.evidence,
                hop=loss.hop,
                lost=loss.lost,
                span=(loss.start_ns, loss.end_ns),
                remedy="none beside what helps each of these" if helped else also + names_them,
                confidence="low",
            )


def superseded(case: Case) -> Iterator[Verdict]:
    """An application that keeps only the newest command of each burst: the others never go on.

    Count them apart from loss: this is how the two-robot application works.
    """
    for fate in (own for own in case.commands.fates.values() if own.ends["superseded"]):
        number, stream = fate.ends["superseded"], fate.stream
        outs = " and ".join(case.name(hop.out.msg_id) for hop in fate.hops)
        yield habit(
            f"{number:,} of {len(stream):,} messages on {case.name(stream.msg_id)} gave way to a "
            f"newer one before the application sent {outs}: it takes them in bursts, and the last goes on",
            f"{int(fate.arrived.sum()):,} came out with the same values",
            **subject(case, stream.rows),
            hop="application",
            remedy="send at most 2 Hz for every command to go on, or count on the newest alone",
            confidence="medium",
        )


def older_losses(case: Case) -> Iterator[Verdict]:
    """The counters stood above zero in the first 0x803 already, or grew by what CI had left from before.

    Name what is older, and what of this capture's is among it, so that nobody blames it for the rest.
    """
    for instance, track in case.tracks.items():
        limits, overflows = track.older.get("msg_limits", 0), track.older.get("pipe_overflows", 0)
        first_ns = max(track.times[0], case.start_ns)  # it was made before it came
        counts = case.loss_counts.get(instance)
        since = counts.older if counts else 0
        if older := since + (sum(counts.first.values()) if counts else limits + overflows):
            losses, own = f"{older:,} loss{'es' * (older > 1)}", limits + overflows + since - older
            beside = f", or ({since:,} of them) while CI may have read what waited then" if since else ""
            beside += f", beside {own:,} of what is here" if own else ""
            yield note(
                f"{losses} counted by {case.label(instance)} before {case.at(first_ns)}{beside}: older than "
                "this capture, or of traffic that it does not show",
                f"the first 0x803, at {case.at(first_ns)}: MsgLimit {limits:,}, PipeOverflow {overflows:,}",
                hop="software bus",
                span=(first_ns, first_ns),
                remedy="none; not counted as loss of this capture",
            )


def port_closed(case: Case) -> Iterator[Verdict]:
    """Nobody listened on a port for a time, as ICMP errors say; what was sent there meanwhile was lost.

    Name the port, from when to when, how many messages, and whether the port itself fell silent.
    """
    before: dict[Endpoint, int] = {}
    for span in case.unreachable.spans:
        since_ns, before[span.port] = before.get(span.port, 0), span.end_ns
        number, uncertain = (_within(case, span, since_ns, cause) for cause in (PORT_CLOSED, None))
        if not number and not uncertain:
            continue
        start, last, errors = case.at(span.start_ns), case.at(span.last_ns), plural(span.errors, "ICMP error")
        unread = f"{plural(uncertain, 'more message')} may not have been read there" if uncertain else ""
        never = span.end_ns == NEVER
        again = "not open again in this capture" if never else f"open again at {case.at(span.end_ns)}"
        when = f"at {start}" if start == last else f"from {start} to {last}"
        witness = f"{errors} (port unreachable), the first at {start}, the last at {last}"
        reason = f"nobody listened on {span.port} {when}"
        reason += f": {plural(number, 'message')} reached nobody" if number else ""
        if not span.errors:
            witness, unread = "no ICMP error says so: the capture leaves them out, or the host is off", ""
            reason = f"perhaps {reason}: {plural(uncertain, 'message')} may have reached nobody"
        if span.step_ns:
            reason += f"; its own datagrams, {SECOND / span.step_ns:.1f} a second, stopped too"
        yield verdict(
            Severity.ERROR if number else Severity.WARNING,
            reason,
            *(witness, again, unread),
            link=next((s.link.label for s in case.streams if case.endpoints[s.receiver] == span.port), None),
            hop=f"{UDP_PORT} {span.port}",
            lost=number or None,
            of=number + uncertain,
            span=(span.start_ns, span.last_ns),
            remedy=_open_again(case, span),
        )
    for flow, number, more in case.unreached_flows:
        yield error(
            f"nobody listened on {flow.destination}: {plural(number, 'datagram')} that look like "
            f"{flow.looks_like.name} traffic reached nobody",
            f"ICMP errors (port unreachable) came back from {case.at(flow.first_ns)} on"
            + f"; {plural(more, 'more datagram')} may have reached nobody: a host sends few" * bool(more),
            hop=f"{UDP_PORT} {flow.destination}",
            lost=number,
            span=(flow.first_ns, flow.last_ns),
            remedy="send to the port where that link's receiver listens",
        )


def _open_again(case: Case, span: ClosedSpan) -> str:
    """Return the remedy for a closed port: another one where its peer speaks from a port beside it."""
    rows, peers = case.rows, case.network.identity_of
    closed = np.isin(rows.destination, [at for at, end in enumerate(case.endpoints) if end == span.port])
    meanwhile = (rows.time_ns >= span.start_ns) & (rows.time_ns <= span.last_ns)
    meanwhile &= np.isin(rows.destination, rows.source[closed])
    for at in peers.keys() & distinct(rows.source[meanwhile]).tolist():
        if case.endpoints[at].address == span.port.address and at not in rows.destination:
            return f"make sbn_conf_tbl and the port of {peers[at]} agree: it sends from {case.endpoints[at]}"
    return "start what listens there first (its log may say why it ended), or send to its port"


_REMEDIES: Final = {
    "fragmentation": "the way carries only smaller packets: let it fragment them, or raise its MTU",
    "too big": "the way carries only smaller packets: raise its MTU, or send smaller messages",
    "reassembly": "let fragments through on the way, or raise its MTU above the longest of these",
    "prohibited": "a firewall on the way refuses them: open it for this port",
    "hop limit": "see the routes: packets go round, or the way is longer than their time to live",
}
_NO_WAY: Final = "see whether the host runs, and the route to it"


def unreachable(case: Case) -> Iterator[Verdict]:
    """Datagrams came back as ICMP errors: a host, a network or a firewall on the way did not let them pass.

    Name the endpoint, how many, and what the errors say.
    """
    for item in (one for one in case.unreached if REFUSED in one.lost):
        rows, reasons = item.lost[REFUSED], case.unreachable.refused
        endpoint = case.endpoints[item.endpoint]
        numbers = distinct(reasons[(case.rows.destination == item.endpoint) & (reasons > 0)]).tolist()
        why = listed([error_text(reason) for reason in numbers])
        yield error(
            f"{plural(len(rows), 'message')} of {case.name(item.stream.msg_id)} did not reach {endpoint}: "
            f"{why}, as ICMP errors about them say",
            f"{plural(len(item.uncertain), 'more message')} may not have: a host sends few such errors"
            * bool(len(item.uncertain)),
            msg_id=item.stream.msg_id if item.own else None,
            place=(item.stream.link.label, f"{UDP_PORT} {endpoint}"),
            lost=len(rows),
            of=len(rows),
            span=case.span(item.stream.rows[rows]),
            remedy=next((text for word, text in _REMEDIES.items() if word in why), _NO_WAY),
        )


def _within(case: Case, span: ClosedSpan, open_ns: int, cause: str | None) -> int:
    """Return how many messages were lost in a span, or may be if there is no cause.

    Args:
        open_ns: when the span before it on this port ended.
    """
    sent: list[Integers] = []
    for item in case.unreached:
        if case.endpoints[item.endpoint] == span.port:
            rows = item.uncertain if cause is None else item.lost.get(cause, np.zeros(0, np.intp))
            sent.append(item.sent_ns[rows])
    for loss in case.commands.losses if cause else ():
        if loss.kind == cause and loss.stream and case.endpoints[loss.stream.receiver] == span.port:
            assert loss.among is not None
            sent.append(loss.stream.time_ns[loss.among.rows])
    return sum(int(((times >= open_ns) & (times < span.end_ns)).sum()) for times in sent)

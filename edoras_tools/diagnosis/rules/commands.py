"""Commands that cFS refuses, who sends commands, and what nobody checks."""

from __future__ import annotations

import re
from functools import cache, partial, reduce
from operator import itemgetter, or_
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from edoras_tools.cfs import command_ingest, software_bus, telemetry_output
from edoras_tools.cfs.command_ingest import CI_BUFFER
from edoras_tools.cfs.names import PRIVILEGED, command_name
from edoras_tools.diagnosis.evidence.table import peer_of
from edoras_tools.diagnosis.rules.about import one_by_one, packet, subject
from edoras_tools.diagnosis.rules.messages import misread
from edoras_tools.diagnosis.verdict import Severity, Verdict, habit, security, verdict
from edoras_tools.links.bare import CI, TO
from edoras_tools.links.sbn import SBN
from edoras_tools.model import NO_MSG_ID, NO_ROUTE, Finding
from edoras_tools.units import MILLISECOND
from edoras_tools.wire import cfe
from edoras_tools.wire.arrays import Places, by_key, by_value, groups, numbered
from edoras_tools.words import listed, plural

if TYPE_CHECKING:
    from collections.abc import Iterator

    from edoras_tools.diagnosis.case import Case
    from edoras_tools.diagnosis.evidence.payloads import EventRecord


_ANSWERED_NS: Final = 1700 * MILLISECOND
"""CI reads within 500 ms, the application follows at once, TO sends the event within another 500 ms."""


class BadCommand(NamedTuple):
    """A way in which a command can be wrong.

    Attributes:
        finding: what the decoder saw.
        problem: what it is.
        reaction: what cFS does about it, as measured.
        event: pattern of what cFS says; empty where it says nothing.
    """

    finding: Finding
    problem: str
    reaction: str
    event: str = ""


_SHORT_EVENT: Final = f"{command_ingest.TOO_SHORT.phrase}|{command_ingest.TOO_SHORT_7.phrase}"
_MSG_ID_EVENT: Final = re.escape(software_bus.EVENTS[software_bus.INVALID_MSG_ID].phrase)
_CODE_EVENT: Final = r"Invalid ground command code|Function Code|Invalid.*CC = "
_LENGTH_EVENT: Final = rf"[Ii]nvalid [Mm]sg length|Invalid cmd length|{telemetry_output.ENABLED.phrase}"
_WRONG_LENGTH: Final = "wrong length for its function code"
_NOT_READ: Final = "the application cannot decode it, and says so on its console alone"
_READ_BEYOND: Final = "the application reads what is behind, and says nothing"
_OLD_BYTES: Final = "accepted; CI fills up what is missing with bytes of an older command"
_KINDS: Final = (
    BadCommand(Finding.TRUNCATED, "shorter than a command header", "CI drops it", _SHORT_EVENT),
    BadCommand(
        Finding.INVALID_MSG_ID, "MsgId is 0 or above 0x1FFF", "the software bus refuses it", _MSG_ID_EVENT
    ),
    BadCommand(
        Finding.OVER_SOFTWARE_BUS,
        "length field exceeds the software bus's 32,768",
        "the software bus refuses it",
        software_bus.EVENTS[software_bus.MSG_TOO_BIG].phrase,
    ),
    BadCommand(Finding.UNKNOWN_FUNCTION_CODE, "unknown function code", "it is refused", _CODE_EVENT),
    BadCommand(Finding.COMMAND_LENGTH, _WRONG_LENGTH, "it is refused, or read with old bytes", _LENGTH_EVENT),
    BadCommand(Finding.WRONG_DIRECTION, "telemetry sent as a command", "CI publishes it as if it were real"),
    BadCommand(Finding.CDR_INVALID, "CDR that is not of the configured type", _NOT_READ),
    BadCommand(Finding.CDR_TOO_LONG, "CDR longer than the configured type", "read as that type all the same"),
    BadCommand(Finding.ENVELOPE_OVERRUN, "buffer_length reaches past the packet", _READ_BEYOND),
    BadCommand(Finding.CDR_BIG_ENDIAN, "CDR in big-endian order", "accepted, and read as such"),
    BadCommand(Finding.LENGTH_MISMATCH, "packet data length disagrees with the datagram", _OLD_BYTES),
    BadCommand(Finding.CHECKSUM_BAD, "wrong checksum", "obeyed all the same: no application here checks it"),
)
_BAD_COMMANDS: Final = {item.finding: item for item in _KINDS}
_ANY: Final = reduce(or_, _BAD_COMMANDS)
_MISMATCH: Final = _BAD_COMMANDS[Finding.LENGTH_MISMATCH]
"""CI of cFS 7 refuses it, and says so."""
_SHORT = BadCommand(Finding.TRUNCATED, "ends before its message does", _NOT_READ)
_EMPTY = BadCommand(Finding.TRUNCATED, "empty", "CI reads nothing and says nothing")
_HARMLESS: Final = Finding.CDR_BIG_ENDIAN
_IN_CDR: Final = (Finding.CDR_INVALID, Finding.CDR_TOO_LONG, _HARMLESS, Finding.ENVELOPE_OVERRUN)
_REMEDIES: Final = {
    **dict.fromkeys(_IN_CDR, "send CDR of the configured type, and its length in buffer_length"),
    Finding.WRONG_DIRECTION: "send commands with MsgIds of commands",
}
_SEND_WHOLE: Final = f"send whole commands of up to {CI_BUFFER} bytes, with a MsgId and function code in use"
_ACCEPTED: Final = (
    *(Finding.WRONG_DIRECTION, Finding.CDR_TOO_LONG, Finding.ENVELOPE_OVERRUN, Finding.CHECKSUM_BAD),
    *(_HARMLESS, _MISMATCH.finding),
)
"""Findings of commands that come to something all the same."""
_REFUSED: Final = re.compile(
    r"Invalid ground command code: CC = (?P<code>\d+)"
    r"|(?:Invalid [Mm]sg length: ID = 0x(?P<msg_id>[0-9A-Fa-f]+),\s+CC = (?P<of>\d+), Len = (?P<length>\d+))"
)


def bad_command(case: Case) -> Iterator[Verdict]:
    """Datagrams to Command Ingest that are not as they should be, each with what cFS did about it.

    Go through every datagram to CI that has a finding, or that an application refused.
    """
    rows = case.rows
    # A wrong CRC of a CFDP PDU has the same finding, and is not obeyed: ``file_checksum`` counts it.
    wrong = rows.has(_ANY & ~Finding.CHECKSUM_BAD) | (rows.claimed != 0)
    wrong |= rows.has(Finding.CHECKSUM_BAD) & ~np.isin(rows.msg_id, case.mission.pdu_msg_ids)
    # Over 768 bytes has a rule of its own, and what follows from the cut belongs to it.
    wrong &= (rows.link == CI) & ~rows.has(Finding.CAPTURE_CUT | Finding.OVER_CI_BUFFER)
    for _, misfits, _ in misread(case):
        wrong[misfits] = False  # the type is wrong, not each of its messages
    bad = np.flatnonzero(wrong)
    findings = rows.findings[bad] | np.where(rows.claimed[bad] != 0, np.uint32(Finding.ENVELOPE_OVERRUN), 0)
    size = np.minimum(rows.length[bad], cfe.COMMAND_HEADER_BYTES)  # a longer one is of the same kind
    mismatch = int(_MISMATCH.finding)
    by_kind: dict[tuple[BadCommand, int], list[int]] = {}
    by_mission: dict[tuple[BadCommand, int], list[int]] = {}
    for row, bits, length, msg_id in zip(
        bad.tolist(), findings.tolist(), size.tolist(), rows.msg_id[bad].tolist(), strict=True
    ):
        kind = _kind(bits, length)
        if bits & mismatch and kind is not _MISMATCH and refusals(case, row, int(rows.length[row])):
            kind = _MISMATCH  # CI of cFS 7 looks at this first, and nobody else gets it
        by_route = kind.finding is Finding.UNKNOWN_FUNCTION_CODE and rows.route[row] != NO_ROUTE
        (by_mission if by_route else by_kind).setdefault((kind, msg_id), []).append(row)
    for row, kind in _refused(case, {row for members in by_kind.values() for row in members}):
        by_kind.setdefault((kind, int(rows.msg_id[row])), []).append(row)
    # Where an application says which it refused, that is what it got.
    by_kind = by_mission | by_kind
    for (kind, _), members in by_kind.items():
        yield from (_verdict(case, together, kind) for together in one_by_one(members))


@cache
def _kind(findings: int, length: int) -> BadCommand:
    if not length:
        return _EMPTY
    kind = next(item for item in _KINDS if item.finding in Finding(findings))
    # The header is there: it is the message that is cut.
    return _SHORT if kind.finding is Finding.TRUNCATED and length >= cfe.COMMAND_HEADER_BYTES else kind


def _refused(case: Case, judged: set[int]) -> Iterator[tuple[int, BadCommand]]:
    """Find commands that an application refused, and whose rules the decoder does not know."""
    rows = case.rows
    code, length = _BAD_COMMANDS[Finding.UNKNOWN_FUNCTION_CODE], _BAD_COMMANDS[Finding.COMMAND_LENGTH]
    commands = np.flatnonzero(rows.link == CI)
    times = rows.time_ns[commands]
    for record in case.payloads.events:
        match = _REFUSED.search(record.message)
        if not match or rows.duplicates[record.row]:
            continue
        low = np.searchsorted(times, record.time_ns - _ANSWERED_NS)
        near = commands[low : np.searchsorted(times, record.time_ns, "right")]
        parts = match.groupdict()
        near = near[rows.function_code[near] == int(parts["code"] or parts["of"])]
        if parts["msg_id"]:
            near = near[rows.msg_id[near] == int(parts["msg_id"], 16)]
        # Of several that are taken in one round each is answered.
        if rest := [row for row in near.tolist() if row not in judged]:
            judged.add(rest[-1])
            yield rest[-1], code if parts["code"] else length


def _verdict(case: Case, members: list[int], kind: BadCommand) -> Verdict:
    rows, first = case.rows, members[0]
    msg_id = int(rows.msg_id[first])
    name = case.name(msg_id) if msg_id != NO_MSG_ID else "a datagram"
    start_ns = int(rows.time_ns[first])
    refused = refusals(case, first, int(rows.length[first])) if kind is _MISMATCH else []
    events = refused or _answers(case, kind, first)
    many = len(members) > 1
    which = f"{len(members):,} of {name}: " if many else f"{name}, packet {rows.number[first]}: "
    # What cFS says beats what it usually does.
    accepted = bool(events) and telemetry_output.ENABLED.phrase in events[0].message
    # Without a word from cFS it may be built with a longer header, and the length be right.
    unheard = "" if events else _unheard(case, start_ns)
    unsure = kind.finding is Finding.COMMAND_LENGTH and (bool(unheard) or not case.has_telemetry)
    comes_to_nothing = kind.finding not in _ACCEPTED or bool(refused)
    lost = len(members) if comes_to_nothing and not (accepted or unsure) else None
    reaction = "accepted" if accepted else "CI drops it" if refused else kind.reaction
    return verdict(
        Severity.ERROR if lost else Severity.NOTE if kind.finding in _HARMLESS else Severity.WARNING,
        f"{which}{kind.problem}; {reaction}",
        *_evidence(case, members, kind, events, unheard),
        **subject(case, members),
        hop="CI_LAB_APP" if kind.finding is Finding.TRUNCATED or refused else None,
        lost=lost,
        of=len(members),
        remedy=_REMEDIES.get(kind.finding, _SEND_WHOLE),
        confidence="high" if events or not kind.event else "medium",
        by_type=kind.finding is Finding.CDR_INVALID or kind is _SHORT,
    )


def _evidence(
    case: Case, members: list[int], kind: BadCommand, events: list[EventRecord], unheard: str
) -> Iterator[str]:
    """Yield what the capture has of some commands: the first one, and what cFS said."""
    rows, first = case.rows, members[0]
    size = f"{rows.length[first]:,} bytes to CI at {case.at(int(rows.time_ns[first]))}"
    if len(members) > 1:
        size += " is the first"
    elif rows.function_code[first] >= 0:
        size += f", function code {rows.function_code[first]}"
    yield size
    yield from (f"cFS said: {record}" for record in events)
    if kind.event and unheard:
        yield unheard
    elif kind.event and not events and case.has_telemetry:
        yield "no event about it in the capture: suppressed, filtered, or not asked for"


def _unheard(case: Case, start_ns: int) -> str:
    """Return why what cFS said of a command cannot be in the capture; empty where it can."""
    rows, until_ns = case.rows, start_ns + _ANSWERED_NS
    inside = slice(*np.searchsorted(rows.time_ns, (start_ns, until_ns + 1)).tolist())
    if ((rows.known_id[inside] == cfe.EVENT_MSG_ID) & rows.has(Finding.CAPTURE_CUT, inside)).any():
        return "the capture cut the events of that time: what cFS said about it is not there"
    if case.has_telemetry and until_ns > case.end_ns:
        return "the capture ends before what cFS says about it is due"
    return ""


def refusals(case: Case, row: int, length: int) -> list[EventRecord]:
    """Return what CI of cFS 7 said about a packet of which it had ``length`` bytes: one event, or none."""
    start_ns = int(case.rows.time_ns[row])
    for record in case.events_between(start_ns, start_ns + _ANSWERED_NS, *command_ingest.NAMES):
        match = command_ingest.CUT_7.pattern.search(record.message)
        if match and int(match["length"]) == length:
            return [record]
    return []


def _answers(case: Case, kind: BadCommand, row: int) -> list[EventRecord]:
    """Return what cFS said about a row: the first event of its kind that can mean it."""
    if not kind.event:
        return []
    rows, start_ns = case.rows, int(case.rows.time_ns[row])
    msg_id = int(rows.msg_id[row])
    marks = {f"0x{msg_id:x}", f"{msg_id:04x}"}
    if kind.finding is Finding.INVALID_MSG_ID:
        marks.add("(0x0)")  # so it is called in cFS 7
    pattern = re.compile(kind.event)
    for record in case.events_between(start_ns, start_ns + _ANSWERED_NS):
        if not pattern.search(record.message):
            continue
        text = record.message.lower()
        names_one = "0x" in text or bool(re.search(r"cmd [0-9a-f]{4}", text))
        if not names_one or any(mark in text for mark in marks) or msg_id == NO_MSG_ID or "code" in text:
            return [record]
    return []


def _ways(case: Case, rows: Places) -> Iterator[tuple[tuple[str, str], Places]]:
    """Yield from which address to which some rows went, and those that did."""
    hosts, names = case.instances.hosts, case.instances.addresses
    ends = [hosts[end[rows]] for end in (case.rows.source, case.rows.destination)]
    first, which = numbered(*ends)
    for number, members in by_value(which):
        source, destination = (names[end[first[number]]] for end in ends)
        yield (source, destination), rows[members]


_suspicious = partial(security, place=("ci", "CI_LAB_APP"), confidence="medium")


def stranger_commands(case: Case) -> Iterator[Verdict]:
    """Commands from an address that telemetry never goes to: no ground station of this capture.

    Name every such address; silent where the capture shows no telemetry of that cFS.
    """
    rows = case.rows
    stations = by_key((way for way, _ in _ways(case, np.flatnonzero(rows.link == TO))), itemgetter(0))
    for (sender, target), members in _ways(case, _sound_commands(case)):
        addresses = {station for _, station in stations.get(target, ())}
        if not addresses or sender in addresses or sender == target:  # the flight host itself is no stranger
            continue
        kinds = members[numbered(rows.msg_id[members], rows.function_code[members])[0]].tolist()
        names = sorted({case.name(int(rows.msg_id[row])) for row in kinds})
        allowed = {text for row in kinds if (text := _privilege(case, row))}
        yield _suspicious(
            f"{plural(len(members), 'command')} to CI at {target} from {sender}, which gets no telemetry",
            f"{packet(case, members[0])} is the first",
            f"telemetry goes to {', '.join(sorted(addresses))}",
            f"MsgIds: {listed(names, 6)}",
            *(f"it could {text}" for text in sorted(allowed)),
            span=case.span(members),
            remedy="if it is a second ground station, nothing; else let only the station reach CI's port "
            "(a firewall, or authentication in front of CI)",
        )


_UNSOUND_NETWORK = Finding.TRUNCATED | Finding.SBN_UNKNOWN_TYPE | Finding.SBN_SIZE_MISMATCH


def identity_from_two_addresses(case: Case) -> Iterator[Verdict]:
    """One SBN identity that speaks from two addresses.

    Name every identity that does: a receiver tells peers apart by it, never by their address.
    """
    rows, hosts, addresses = case.rows, case.instances.hosts, case.instances.addresses
    spoke = np.flatnonzero((rows.link == SBN) & (rows.sbn_msg_type >= 0) & ~rows.has(_UNSOUND_NETWORK))
    for who, members in groups(rows.sbn_sender(), spoke):
        first, address = numbered(hosts[rows.source[members]])
        if len(first) < 2:
            continue
        order = [addresses[host] for host in hosts[rows.source[members[first]]].tolist()]
        times = [case.at(when) for when in rows.time_ns[members[first]].tolist()]
        each = list(zip(order, np.bincount(address).tolist(), times, strict=True))[:_MOST]
        why = [f"{name}: {plural(count, 'datagram')}, the first at {when}" for name, count, when in each]
        reason = f"SBN peer {peer_of(who)} has {len(order)} addresses, and cFS hears all: {', '.join(order)}"
        remedy = "give each peer its own processor_id; if there is only one, somebody else uses its name"
        span = int(rows.time_ns[members[first[1]]]), int(rows.time_ns[members[-1]])
        yield security(reason, *why, place=("sbn", "SBN"), span=span, remedy=remedy, confidence="medium")


def repeated_commands(case: Case) -> Iterator[Verdict]:
    """Commands that repeat bytes which another address sent before: a recording that is sent again.

    Name every address that does; bare headers, as a no-op, are the same whoever sends them.
    """
    rows, addresses = case.rows, case.instances.addresses
    sent = _sound_commands(case)
    sent = sent[rows.packet_length[sent] > rows.header_length[sent]]
    first, which = numbered(rows.packet_print[sent])
    sender = case.instances.hosts[rows.source[sent]]
    origin = sender[first[which]]
    repeats = np.flatnonzero(sender != origin)
    for who, at in by_value(sender[repeats]):
        members = sent[repeats[at]]
        origins = sorted({addresses[item] for item in origin[repeats[at]].tolist()})
        earlier = sent[first[which[repeats[at[0]]]]]
        yield _suspicious(
            f"{plural(len(members), 'command')} from {addresses[who]} repeat, byte for byte, what "
            f"{', '.join(origins)} sent before: a recording is being sent again",
            f"{packet(case, members[0])} repeats packet {rows.number[earlier]}",
            f"MsgIds: {', '.join(sorted({case.name(int(rows.msg_id[item])) for item in members}))}",
            span=case.span(members),
            remedy="let only the station reach CI's port: commands carry no count and no time",
        )


_MOST: Final = 8
"""Senders and times that are named."""
_UNSOUND = Finding.TRUNCATED | Finding.INVALID_MSG_ID | Finding.WRONG_DIRECTION | Finding.LENGTH_MISMATCH


def _sound_commands(case: Case) -> Places:
    """Return the rows of sound commands to CI, in order of capture."""
    rows = case.rows
    return np.flatnonzero((rows.link == CI) & (rows.function_code >= 0) & ~rows.has(_UNSOUND))


def _privilege(case: Case, row: int) -> str:
    """Return what a command allows whoever sends it; nothing for an ordinary one."""
    return PRIVILEGED.get((int(case.rows.msg_id[row]), int(case.rows.function_code[row])), "")


def privileged_commands(case: Case) -> Iterator[Verdict]:
    """Commands that change what the flight software is: applications, processor, tables, files, memory.

    Name each kind of such command with where it came from, whoever sent it.
    """
    rows = case.rows
    sent = _sound_commands(case)
    for _, at in by_value(numbered(rows.msg_id[sent], rows.function_code[sent])[1]):
        members, row = sent[at], int(sent[at[0]])
        if not _privilege(case, row):
            continue
        msg_id, code = int(rows.msg_id[row]), int(rows.function_code[row])
        senders = sorted({case.endpoints[at].address for at in np.unique(rows.source[members]).tolist()})
        times = [case.at(when) for when in rows.time_ns[members].tolist()]
        yield security(
            f"{plural(len(members), 'command')} {command_name(msg_id, code)} on {case.name(msg_id)} from "
            f"{listed(senders)}: it can {PRIVILEGED[msg_id, code]}",
            f"sent at {listed(times)}",
            f"packet {rows.number[members[0]]} is the first",
            **subject(case, members),
            hop="CI_LAB_APP",
            remedy="see that its sender may do this: CI takes commands from everybody",
        )


def checksum(case: Case) -> Iterator[Verdict]:
    """Nobody here checks a command's checksum, and the bridges do not send one.

    Tell of absent ones; wrong ones are told of one by one as bad commands.
    """
    rows = case.rows
    commands = (rows.link == CI) & (rows.function_code >= 0)
    if absent := int((commands & rows.has(Finding.CHECKSUM_ABSENT)).sum()):
        of = int(commands.sum())
        yield habit(
            f"{absent:,} of {of:,} commands carry no checksum, as the EDORAS bridges send them; no cFS "
            "application here checks it, so a damaged command is obeyed",
            "the checksum byte is 0, and 0 is not right",
            place=("ci", "ground bridge"),
            remedy="none needed on a link that checks for itself; else compute it (0xFF XOR every byte) "
            "and have the application call CFE_MSG_ValidateChecksum",
        )

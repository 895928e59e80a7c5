"""Commands that cFS refuses."""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Final

import numpy as np

from edoras_tools.cfs import command_ingest, software_bus, telemetry_output
from edoras_tools.cfs.limits import CI_BUFFER
from edoras_tools.diagnosis.rules.routes import misread
from edoras_tools.diagnosis.verdict import Severity, Verdict, verdict
from edoras_tools.links.ci import CI
from edoras_tools.model import NO_MSG_ID, Finding
from edoras_tools.units import MILLISECOND
from edoras_tools.wire import cfe

if TYPE_CHECKING:
    from collections.abc import Iterator

    from edoras_tools.diagnosis.case import Case
    from edoras_tools.diagnosis.evidence.payloads import EventRecord

_ANSWERED_NS: Final = 1700 * MILLISECOND
"""CI reads within 500 ms, the application follows at once, TO sends the event within another 500 ms."""
_ONE_BY_ONE: Final = 20
"""So many of one kind are told one by one; more are told together."""


@dataclass(frozen=True, slots=True)
class BadCommandKind:
    """A way in which a command can be wrong.

    Attributes:
        finding: what the decoder saw.
        what: what it is.
        done: what cFS does about it, as measured.
        refused: whether it comes to nothing.
        event: what cFS says; empty where it says nothing.
        refused_7: whether CI of cFS 7 refuses it, and says so.
    """

    finding: Finding
    what: str
    done: str
    refused: bool
    event: str = ""
    refused_7: bool = False


_LENGTH = r"[Ii]nvalid [Mm]sg length|Invalid cmd length"


_BAD_COMMANDS: Final = (
    BadCommandKind(
        Finding.TRUNCATED,
        "shorter than a command header",
        "CI drops it",
        True,
        f"{command_ingest.TOO_SHORT.phrase}|{command_ingest.TOO_SHORT_7.phrase}",
    ),
    BadCommandKind(
        Finding.INVALID_MSG_ID,
        "MsgId is 0 or above 0x1FFF",
        "the software bus refuses it",
        True,
        re.escape(software_bus.EVENTS[software_bus.INVALID_MSG_ID].phrase),
    ),
    BadCommandKind(
        Finding.OVER_SOFTWARE_BUS,
        "length field exceeds the software bus's 32,768",
        "the software bus refuses it",
        True,
        software_bus.EVENTS[software_bus.MSG_TOO_BIG].phrase,
    ),
    BadCommandKind(
        Finding.UNKNOWN_FUNCTION_CODE,
        "function code that the application does not have",
        "the application refuses it",
        True,
        r"Invalid ground command code|Function Code|Invalid.*CC = ",
    ),
    BadCommandKind(
        Finding.COMMAND_LENGTH,
        "length that its function code does not take",
        "the application refuses it, or reads what its buffer held before",
        True,
        rf"{_LENGTH}|{telemetry_output.ENABLED.phrase}",
    ),
    BadCommandKind(
        Finding.WRONG_DIRECTION,
        "telemetry MsgId sent as a command",
        "CI publishes it silently; who subscribes to that telemetry takes it for real",
        False,
    ),
    BadCommandKind(
        Finding.CDR_INVALID,
        "CDR that does not decode as the configured type",
        "the application fails to deserialise it, on its console only",
        True,
    ),
    BadCommandKind(
        Finding.CDR_TOO_LONG, "CDR longer than the configured type", "accepted, and read as that type", False
    ),
    BadCommandKind(
        Finding.ENVELOPE_OVERRUN,
        "buffer_length reaches past the packet",
        "accepted silently; the application reads beyond the data",
        False,
    ),
    BadCommandKind(Finding.CDR_BIG_ENDIAN, "CDR in big-endian order", "accepted, and read as such", False),
    BadCommandKind(
        Finding.LENGTH_MISMATCH,
        "packet data length disagrees with the datagram",
        "accepted silently; bytes that it lacks are what CI's buffer held before",
        False,
        refused_7=True,
    ),
    BadCommandKind(
        Finding.CHECKSUM_BAD, "wrong checksum", "obeyed all the same: no application here checks it", False
    ),
)


_MISMATCH: Final = next(item for item in _BAD_COMMANDS if item.refused_7)
_SHORT = BadCommandKind(
    Finding.TRUNCATED,
    "ends before its message does",
    "CI accepts it; the application fails to deserialise it, on its console only",
    True,
)


_EMPTY = BadCommandKind(Finding.TRUNCATED, "empty", "CI reads nothing and says nothing", True)


_HARMLESS: Final = Finding.CDR_BIG_ENDIAN


_REFUSED: Final = re.compile(
    r"Invalid ground command code: CC = (?P<code>\d+)"
    r"|(?:Invalid [Mm]sg length: ID = 0x(?P<msg_id>[0-9A-Fa-f]+),\s+CC = (?P<of>\d+), Len = (?P<length>\d+))"
)


def bad_command(case: Case) -> Iterator[Verdict]:
    """Datagrams to Command Ingest that are not as they should be, each with what cFS did about it.

    Go through every datagram to CI that has a finding, or that an application refused.
    """
    rows = case.rows
    commands = rows.link == CI
    mask = Finding(0)
    for kind in _BAD_COMMANDS:
        mask |= kind.finding
    # Over 768 bytes has a rule of its own, and what follows from the cut belongs to it.
    wrong = commands & rows.has(mask) & ~rows.has(Finding.CAPTURE_CUT | Finding.OVER_CI_BUFFER)
    found: dict[tuple[str, int], list[tuple[int, BadCommandKind]]] = {}
    # A wrong CRC of a CFDP PDU has the same finding, and is not obeyed: ``file_checksum`` counts it.
    others = mask & ~Finding.CHECKSUM_BAD
    wrong &= rows.has(others) | ~np.isin(rows.msg_id, case.mission.pdu_msg_ids)
    wrong |= commands & (rows.claimed > 0) & ~rows.has(Finding.CAPTURE_CUT | Finding.OVER_CI_BUFFER)
    for _, misfits, _ in misread(case):
        wrong[misfits] = False  # the type is wrong, not each of its messages
    bad = np.flatnonzero(wrong)
    findings = rows.findings[bad] | np.where(rows.claimed[bad] != 0, np.uint32(Finding.ENVELOPE_OVERRUN), 0)
    size = np.minimum(rows.length[bad], cfe.COMMAND_HEADER_BYTES)  # a longer one is of the same kind
    for row, bits, length, msg_id in zip(
        bad.tolist(), findings.tolist(), size.tolist(), rows.msg_id[bad].tolist(), strict=True
    ):
        kind = _kind(bits, length)
        if bits & _MISMATCH.finding and kind is not _MISMATCH and refusals(case, row, int(rows.length[row])):
            kind = _MISMATCH  # CI of cFS 7 looks at this first, and nobody else gets it
        found.setdefault((kind.what, msg_id), []).append((row, kind))
    told = {row for members in found.values() for row, _ in members}
    for row, kind in _refused(case, told):
        found.setdefault((kind.what, int(rows.msg_id[row])), []).append((row, kind))
    for members in found.values():
        if len(members) <= _ONE_BY_ONE:
            for row, kind in members:
                yield _verdict(case, [row], kind)
        else:
            yield _verdict(case, [row for row, _ in members], members[0][1])


@cache
def _kind(findings: int, length: int) -> BadCommandKind:
    if not length:
        return _EMPTY
    kind = next(item for item in _BAD_COMMANDS if item.finding in Finding(findings))
    # The header is there: it is the message that is cut.
    return _SHORT if kind.finding is Finding.TRUNCATED and length >= cfe.COMMAND_HEADER_BYTES else kind


def _refused(case: Case, told: set[int]) -> Iterator[tuple[int, BadCommandKind]]:
    """Find commands that an application refused, and whose rules the decoder does not know."""
    rows = case.rows
    code, length = _BAD_COMMANDS[3], _BAD_COMMANDS[4]
    commands = np.flatnonzero(rows.link == CI)
    times = rows.time_ns[commands]
    for record in case.payloads.events:
        said = _REFUSED.search(record.message)
        if not said or rows.duplicates[record.row]:
            continue
        low = np.searchsorted(times, record.time_ns - _ANSWERED_NS)
        near = commands[low : np.searchsorted(times, record.time_ns, "right")]
        parts = said.groupdict()
        if parts["code"]:
            near = near[rows.function_code[near] == int(parts["code"])]
        else:
            near = near[
                (rows.msg_id[near] == int(parts["msg_id"], 16))
                & (rows.function_code[near] == int(parts["of"]))
            ]
        # Of several that are taken in one round each is answered.
        if left := [row for row in near.tolist() if row not in told]:
            told.add(left[-1])
            yield left[-1], code if parts["code"] else length


def _verdict(case: Case, members: list[int], kind: BadCommandKind) -> Verdict:
    rows, first = case.rows, members[0]
    known = int(rows.msg_id[first])
    msg_id = known if known != NO_MSG_ID else None
    name = case.name(known) if known != NO_MSG_ID else "a datagram"
    start_ns = int(rows.time_ns[first])
    refused = refusals(case, first, int(rows.length[first])) if kind.refused_7 else []
    events = refused or _answers(case, kind, first)
    many = len(members) > 1
    which = f"{len(members):,} of {name}: " if many else f"{name}, packet {rows.number[first]}: "
    # What cFS says beats what it usually does.
    accepted = bool(events) and telemetry_output.ENABLED.phrase in events[0].message
    # Without a word from cFS it may be built with a longer header, and the length be right.
    unheard = not events and _events_cut(case, start_ns)
    unsure = kind.finding is Finding.COMMAND_LENGTH and (unheard or not case.has_telemetry)
    lost = None if accepted or unsure or not (kind.refused or refused) else len(members)
    done = "accepted" if accepted else "CI drops it" if refused else kind.done
    return verdict(
        Severity.ERROR if lost else Severity.NOTE if kind.finding in _HARMLESS else Severity.WARNING,
        f"{which}{kind.what}; {done}",
        *_evidence(case, members, kind, events, unheard=unheard),
        msg_id=msg_id,
        link="ci",
        hop="CI_LAB_APP" if kind.finding is Finding.TRUNCATED or refused else None,
        lost=lost,
        of=len(members),
        span=case.span(members),
        remedy=f"send whole commands of {cfe.COMMAND_HEADER_BYTES} to {CI_BUFFER} bytes whose fields agree",
        confidence="high" if events or not kind.event else "medium",
        by_type=kind.finding is Finding.CDR_INVALID,
    )


def _evidence(
    case: Case, members: list[int], kind: BadCommandKind, events: list[EventRecord], *, unheard: bool
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
        yield "the capture cut the events of that time: what cFS said about it is not there"
    elif kind.event and not events and case.has_telemetry:
        yield "no event about it in the capture: suppressed, filtered, or not asked for"


def _events_cut(case: Case, start_ns: int) -> bool:
    """Tell whether the capture cut off what cFS said within the time of an answer."""
    rows = case.rows
    there = (rows.time_ns >= start_ns) & (rows.time_ns <= start_ns + _ANSWERED_NS)
    return bool((there & (rows.known_id == cfe.EVENT_MSG_ID) & rows.has(Finding.CAPTURE_CUT)).any())


def refusals(case: Case, row: int, length: int) -> list[EventRecord]:
    """Return what CI of cFS 7 said about a packet of which it had ``length`` bytes: one event, or none."""
    start_ns = int(case.rows.time_ns[row])
    for record in case.said(start_ns, start_ns + _ANSWERED_NS, *command_ingest.NAMES):
        said = command_ingest.CUT_7.pattern.search(record.message)
        if said and int(said["length"]) == length:
            return [record]
    return []


def _answers(case: Case, kind: BadCommandKind, row: int) -> list[EventRecord]:
    """Return what cFS said about a row: the first event of its kind that can mean it."""
    if not kind.event:
        return []
    rows, start_ns = case.rows, int(case.rows.time_ns[row])
    named = int(rows.msg_id[row])
    marks = {f"0x{named:x}", f"{named:04x}"}
    if kind.finding is Finding.INVALID_MSG_ID:
        marks.add("(0x0)")  # so it is called in cFS 7
    pattern = re.compile(kind.event)
    for record in case.said(start_ns, start_ns + _ANSWERED_NS):
        if not pattern.search(record.message):
            continue
        text = record.message.lower()
        names_one = "0x" in text or bool(re.search(r"cmd [0-9a-f]{4}", text))
        if not names_one or any(mark in text for mark in marks) or named == NO_MSG_ID or "code" in text:
            return [record]
    return []

"""Malformed SBN datagrams, each with what the receiving SBN does about it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from edoras_tools.cfs import sbn as facts
from edoras_tools.diagnosis.verdict import Severity, Verdict
from edoras_tools.links.sbn import SBN
from edoras_tools.model import NO_MSG_ID, Finding
from edoras_tools.units import SECOND
from edoras_tools.wire import sbn

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from edoras_tools.cfs.event_services import EventText
    from edoras_tools.diagnosis.case import Case
    from edoras_tools.diagnosis.evidence.payloads import EventRecord

ID = "bad_network_message"
_ANSWERED_NS: Final = 2 * SECOND
_ONE_BY_ONE: Final = 20
_RESTARTS = "; its receive task ends and starts anew within 200 ms"


@dataclass(frozen=True, slots=True)
class BadMessageKind:
    """A way in which an SBN datagram can be wrong.

    Attributes:
        what: what it is.
        done: what the receiver does about it.
        events: what it may say.
        refused: whether it comes to nothing.
    """

    what: str
    done: str
    events: tuple[EventText, ...] = ()
    refused: bool = True


_SHORT: Final = BadMessageKind(
    "shorter than an SBN header, or than what its header announces",
    f"read together with what the last datagram left behind, then refused{_RESTARTS}",
    (facts.BAD_MSG_ID, facts.NOT_UNPACKED, facts.UNKNOWN_PEER, facts.UNKNOWN_TYPE),
)
_TOO_LARGE: Final = BadMessageKind(
    "MsgSz above 32,767, which reads as negative", f"refused{_RESTARTS}", (facts.NOT_UNPACKED,)
)
_WRONG_SIZE: Final = BadMessageKind(
    "MsgSz is not the size of what follows", "ignored silently", refused=False
)
_UNKNOWN_TYPE: Final = BadMessageKind(
    "MsgType that SBN does not know", f"refused{_RESTARTS}", (facts.UNKNOWN_TYPE,)
)
_LEGACY_HEADER: Final = BadMessageKind(
    "7-byte header of older sources",
    "the next 4 bytes are taken for a SpacecraftID: an unknown peer",
    (facts.UNKNOWN_PEER,),
)


def judge(case: Case) -> Iterator[Verdict]:
    """Go through every SBN datagram with such a finding; identity and version have rules of their own."""
    rows = case.rows
    wanted = (
        Finding.TRUNCATED | Finding.SBN_SIZE_MISMATCH | Finding.SBN_UNKNOWN_TYPE | Finding.SBN_LEGACY_HEADER
    )
    wrong = (rows.link == SBN) & rows.has(wanted) & ~rows.has(Finding.CAPTURE_CUT)
    # A message cut short inside a sound SBN datagram is the sender's application's business.
    inside = (rows.sbn_msg_type == sbn.MsgType.APP) & rows.has(Finding.TRUNCATED) & (rows.msg_id != NO_MSG_ID)
    wrong &= ~inside | rows.has(Finding.SBN_SIZE_MISMATCH | Finding.SBN_LEGACY_HEADER)
    found: dict[tuple[str, int], list[int]] = {}
    kinds: dict[str, BadMessageKind] = {}
    for row in np.flatnonzero(wrong).tolist():
        kind = _kind(case, row)
        kinds[kind.what] = kind
        found.setdefault((kind.what, int(rows.msg_id[row])), []).append(row)
    for (what, _), members in found.items():
        several = len(members) > _ONE_BY_ONE
        for group in [members] if several else [[row] for row in members]:
            yield _verdict(case, group, kinds[what])


def _kind(case: Case, row: int) -> BadMessageKind:
    findings = Finding(int(case.rows.findings[row]))
    if Finding.SBN_LEGACY_HEADER in findings:
        return _LEGACY_HEADER
    if Finding.SBN_UNKNOWN_TYPE in findings:
        return _UNKNOWN_TYPE
    if Finding.SBN_SIZE_MISMATCH not in findings:
        return _SHORT
    said = case.said(int(case.rows.time_ns[row]), int(case.rows.time_ns[row]) + _ANSWERED_NS, facts.NAME)
    # The table does not keep MsgSz; that it was refused says that it was negative.
    if any(_has(record, [facts.NOT_UNPACKED.phrase]) for record in said):
        return _TOO_LARGE
    return _WRONG_SIZE


def _verdict(case: Case, members: list[int], kind: BadMessageKind) -> Verdict:
    rows, first = case.rows, members[0]
    start_ns = int(rows.time_ns[first])
    msg_id = int(rows.msg_id[first])
    evidence = [f"packet {rows.number[first]} at {case.at(start_ns)}: {rows.length[first]} bytes"]
    evidence += answers(case, start_ns, *(event.phrase for event in kind.events))
    type_ = int(rows.sbn_msg_type[first])
    name = sbn.MSG_TYPE_NAMES.get(type_, f"type 0x{type_:02x}") if type_ >= 0 else "SBN datagram"
    which = f"packet {rows.number[first]}" if len(members) == 1 else f"{len(members):,} datagrams"
    return Verdict(
        ID,
        Severity.ERROR if kind.refused else Severity.WARNING,
        f"{which} ({name}): {kind.what}; {kind.done}",
        msg_id=msg_id if msg_id != NO_MSG_ID else None,
        topic=case.topic(msg_id) if msg_id != NO_MSG_ID else None,
        link="sbn",
        hop="SBN",
        lost=len(members) if kind.refused else None,
        of=len(members),
        start_ns=start_ns,
        end_ns=int(rows.time_ns[members[-1]]),
        evidence=tuple(evidence),
        remedy="write the 11-byte header: MsgSz of the payload alone, a known MsgType, ProcessorID, "
        "SpacecraftID",
        confidence="high" if len(evidence) > 1 or not kind.events else "medium",
    )


def answers(case: Case, start_ns: int, *phrases: str) -> list[str]:
    """Return what SBN said about a datagram: the first event with a phrase, and what followed from it."""
    said = case.said(start_ns, start_ns + _ANSWERED_NS, facts.NAME)
    fits = next((at for at, record in enumerate(said) if _has(record, phrases)), None)
    if fits is None:
        return []
    consequences = ("failed", facts.RECEIVE_TASK_STARTED.phrase)
    follow = [item for item in said[fits + 1 : fits + 3] if _has(item, consequences)]
    return [f"cFS said: {record}" for record in (said[fits], *follow)]


def _has(record: EventRecord, phrases: Iterable[str]) -> bool:
    return any(phrase in record.message for phrase in phrases)

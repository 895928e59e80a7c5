"""Malformed SBN datagrams, each with what the receiving SBN does about it."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from edoras_tools.diagnosis.verdict import Severity, Verdict
from edoras_tools.model import NO_MSG_ID, Finding, Link
from edoras_tools.sessions.profile import SECOND
from edoras_tools.wire import sbn

if TYPE_CHECKING:
    from collections.abc import Iterator

    from edoras_tools.diagnosis.case import Case

ID = "bad_network_message"
_ANSWERED_NS: Final = 2 * SECOND
_ONE_BY_ONE: Final = 20
_RESTARTS = "; its receive task ends and starts anew within 200 ms"


@dataclass(frozen=True, slots=True)
class Kind:
    """A way in which an SBN datagram can be wrong.

    Attributes:
        what: what it is.
        done: what the receiver does about it.
        event: what it says.
        refused: whether it comes to nothing.
    """

    what: str
    done: str
    event: str = ""
    refused: bool = True


SHORT: Final = Kind(
    "shorter than an SBN header, or than what its header announces",
    f"read together with what the last datagram left behind, then refused{_RESTARTS}",
    r"unable to set msgid|could not unpack|unknown peer|unknown message type",
)
TOO_LARGE: Final = Kind(
    "MsgSz above 32,767, which reads as negative", f"refused{_RESTARTS}", r"could not unpack message"
)
SIZE: Final = Kind("MsgSz is not the size of what follows", "ignored silently", "", refused=False)
TYPE: Final = Kind("MsgType that SBN does not know", f"refused{_RESTARTS}", r"unknown message type")
LEGACY: Final = Kind(
    "7-byte header of older sources",
    "the next 4 bytes are taken for a SpacecraftID: an unknown peer",
    r"unknown peer",
)


def judge(case: Case) -> Iterator[Verdict]:
    """Go through every SBN datagram with such a finding; identity and version have rules of their own."""
    rows = case.rows
    wanted = (
        Finding.TRUNCATED | Finding.SBN_SIZE_MISMATCH | Finding.SBN_UNKNOWN_TYPE | Finding.SBN_LEGACY_HEADER
    )
    wrong = (rows.link == Link.SBN) & rows.has(wanted) & ~rows.has(Finding.CAPTURE_CUT)
    # A message cut short inside a sound SBN datagram is the sender's application's business.
    inside = (rows.sbn_msg_type == sbn.MsgType.APP) & rows.has(Finding.TRUNCATED) & (rows.msg_id != NO_MSG_ID)
    wrong &= ~inside | rows.has(Finding.SBN_SIZE_MISMATCH | Finding.SBN_LEGACY_HEADER)
    found: dict[tuple[str, int], list[int]] = {}
    kinds: dict[str, Kind] = {}
    for row in np.flatnonzero(wrong).tolist():
        kind = _kind(case, row)
        kinds[kind.what] = kind
        found.setdefault((kind.what, int(rows.msg_id[row])), []).append(row)
    for (what, _), members in found.items():
        several = len(members) > _ONE_BY_ONE
        for group in [members] if several else [[row] for row in members]:
            yield _verdict(case, group, kinds[what])


def _kind(case: Case, row: int) -> Kind:
    findings = Finding(int(case.rows.findings[row]))
    if Finding.SBN_LEGACY_HEADER in findings:
        return LEGACY
    if Finding.SBN_UNKNOWN_TYPE in findings:
        return TYPE
    if Finding.SBN_SIZE_MISMATCH not in findings:
        return SHORT
    said = case.said(int(case.rows.time_ns[row]), int(case.rows.time_ns[row]) + _ANSWERED_NS, "SBN")
    # The table does not keep MsgSz; that it was refused says that it was negative.
    if any(re.search(TOO_LARGE.event, record.message) for record in said):
        return TOO_LARGE
    return SIZE


def _verdict(case: Case, members: list[int], kind: Kind) -> Verdict:
    rows, first = case.rows, members[0]
    start_ns = int(rows.time_ns[first])
    msg_id = int(rows.msg_id[first])
    evidence = [f"packet {rows.number[first]} at {case.at(start_ns)}: {rows.length[first]} bytes"]
    evidence += answers(case, start_ns, kind.event)
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
        confidence="high" if len(evidence) > 1 or not kind.event else "medium",
    )


def answers(case: Case, start_ns: int, pattern: str) -> list[str]:
    """Return what SBN said about a datagram: the event that fits, and what followed from it."""
    if not pattern:
        return []
    said = case.said(start_ns, start_ns + _ANSWERED_NS, "SBN")
    fits = next((at for at, record in enumerate(said) if re.search(pattern, record.message)), None)
    if fits is None:
        return []
    follow = [
        item for item in said[fits + 1 : fits + 3] if re.search(r"failed|Creating recv task", item.message)
    ]
    return [f"cFS said: {record}" for record in (said[fits], *follow)]

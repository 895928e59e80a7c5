"""A flight application's fixed-size struct is too small for its message."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from edoras_tools.diagnosis.verdict import Severity, Verdict
from edoras_tools.links.sbn import SBN
from edoras_tools.links.to import TO
from edoras_tools.model import Finding, Link
from edoras_tools.units import SECOND

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from edoras_tools.diagnosis.case import Case
    from edoras_tools.diagnosis.verdict import Confidence

ID = "struct_overrun"


def judge(case: Case) -> Iterator[Verdict]:
    """Name telemetry whose envelope claims more than its packet holds."""
    rows = case.rows
    bad = (rows.claimed > 0) & ~rows.has(Finding.CAPTURE_CUT)
    for link in (TO, SBN):
        for msg_id in np.unique(rows.msg_id[bad & (rows.link == link)]).tolist():
            all_ = np.flatnonzero((rows.link == link) & (rows.msg_id == msg_id))
            members = all_[bad[all_]]
            sizes, counts = np.unique(rows.packet_length[all_], return_counts=True)
            # Another size than the struct's: somebody else's packet under this MsgId.
            members = members[rows.packet_length[members] == sizes[counts.argmax()]]
            if len(members) and not case.mission.msg_ids.is_command(msg_id):
                yield _verdict(case, link, msg_id, members, len(all_))


def _verdict(case: Case, link: Link, msg_id: int, members: NDArray[np.intp], of: int) -> Verdict:
    rows, first = case.rows, int(members[0])
    start_ns, held, claimed = int(rows.time_ns[first]), int(rows.space[first]), int(rows.claimed[first])
    before = malformed_before(case, start_ns)
    told = f"{claimed:,}" if claimed < 1 << 24 else "millions"
    evidence = [
        (
            f"packet {rows.number[first]} at {case.at(start_ns)}: {rows.packet_length[first]} bytes, room "
            f"for {held} of CDR; its envelope claims {told}"
        )
    ]
    confidence: Confidence = "medium"
    if before is None and claimed <= case.profile.bus_max_bytes:
        reason = (
            f"do not fit the struct that carries them: it has room for {held} bytes of CDR, {claimed:,} are "
            "claimed"
        )
        evidence.append(
            "the application wrote past the struct's end: the memory behind it is overwritten too"
        )
        remedy = "make the struct in the flight application as large as the longest message, strings included"
        if any((hop.out.link, hop.out.msg_id) == (link, msg_id) for hop in case.hops):
            confidence = "high"
        else:
            evidence.append("what went into the application is not here: a malformed message looks the same")
    elif before is None:
        reason = f"are garbage: their envelope claims {told} and there are {held}"
        evidence.append(
            f"the software bus takes {case.profile.bus_max_bytes:,} bytes at most, so no message was too "
            "long for its struct: the application passed on what its buffer held, as it does after a "
            "malformed packet; none is seen here just before"
        )
        remedy = "capture the link that the application's messages come in on, and look for malformed ones"
    else:
        reason = f"are garbage: their envelope claims {told} and there are {held}"
        evidence.append(
            f"malformed packet {rows.number[before]} went into cFS just before, and was passed on"
        )
        remedy = "send well-formed datagrams: the application passes on what its buffer held"
    return Verdict(
        ID,
        Severity.ERROR,
        f"{len(members):,} of {of:,} messages on {case.name(msg_id)} {reason}",
        msg_id=msg_id,
        topic=case.topic(msg_id),
        link=link.label,
        hop="flight application",
        lost=len(members),
        of=of,
        start_ns=start_ns,
        end_ns=int(rows.time_ns[members[-1]]),
        evidence=tuple(evidence),
        remedy=remedy,
        confidence=confidence,
    )


def malformed_before(case: Case, time_ns: int) -> int | None:
    """Return the row of a malformed datagram into cFS that came just before a time, or None."""
    rows = case.rows
    wrong = rows.has(Finding.TRUNCATED | Finding.LENGTH_MISMATCH | Finding.SBN_SIZE_MISMATCH)
    wrong |= rows.claimed > 0
    near = (rows.time_ns <= time_ns) & (rows.time_ns > time_ns - 2 * SECOND)
    found = np.flatnonzero(wrong & near & (rows.link != TO) & (rows.function_code >= 0))
    return int(found[-1]) if len(found) else None

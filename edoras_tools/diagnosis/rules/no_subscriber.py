"""Messages that nobody on the software bus takes."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from edoras_tools.cfs.names import MSG_ID_NAMES
from edoras_tools.diagnosis.verdict import Severity, Verdict
from edoras_tools.links import table
from edoras_tools.links.ci import CI
from edoras_tools.links.sbn import SBN
from edoras_tools.model import Finding, Link
from edoras_tools.units import MILLISECOND
from edoras_tools.words import plural

if TYPE_CHECKING:
    from collections.abc import Iterator

    from edoras_tools.diagnosis.case import Case

ID = "no_subscriber"
_COUNTED_NS = 2200 * MILLISECOND
"""From a datagram to the 0x803 that counts it, at most."""
_FEW = 8


def judge(case: Case) -> Iterator[Verdict]:
    """Say which, where an event or the only command before a count tells."""
    told: set[tuple[int, int]] = set()
    own = set()
    for reported, said in case.reported_losses.items():
        if reported.kind != "no_subscriber":
            continue
        if not reported.sender.startswith(("CI", "SBN")):
            own.add(reported.instance)  # an application of this cFS publishes what nobody takes
            continue
        told.add((reported.instance, reported.msg_id))
        link = CI if reported.sender.startswith("CI") else SBN
        rows = case.rows
        sent = np.flatnonzero((rows.link == link) & (rows.msg_id == reported.msg_id))
        yield _verdict(case, reported.msg_id, link, sent.tolist(), (f"cFS said: {said.records[0]}",))
    counted = _counted(case)
    for (instance, msg_id), members in counted.items():
        if (instance, msg_id) not in told and instance not in own:
            text = (
                "0x803: NoSubscribers grew right after, and nothing else was sent (the event stops after 4)"
            )
            yield _verdict(case, msg_id, table.link(case.rows.link[members[0]]), members, (text,))


def _counted(case: Case) -> dict[tuple[int, int], list[int]]:
    """Find growth of the counter that one command alone can have caused."""
    rows = case.rows
    if case.known.peers_unseen:
        return {}  # what one cFS sends another comes in unseen
    arriving = np.flatnonzero(
        ((rows.link == CI) | (rows.link == SBN))
        & (rows.function_code >= 0)
        & ~rows.has(Finding.INVALID_MSG_ID | Finding.OVER_SOFTWARE_BUS)
    )
    arriving = arriving[~np.isin(rows.msg_id[arriving], list(MSG_ID_NAMES))]
    times = rows.time_ns[arriving]
    found: dict[tuple[int, int], list[int]] = {}
    for instance, track in case.tracks.items():
        totals = track.totals["no_subscribers"]
        for at in range(1, len(totals)):
            if totals[at] - totals[at - 1] != 1:
                continue
            low, high = np.searchsorted(times, (track.times[at] - _COUNTED_NS, track.times[at]))
            if high - low == 1:
                row = int(arriving[low])
                found.setdefault((instance, int(rows.msg_id[row])), []).append(row)
    # A MsgId that is taken at other times was not what the counter counted.
    return {
        key: members
        for key, members in found.items()
        if len(members) * 2 > int((rows.msg_id[arriving] == key[1]).sum())
    }


def _verdict(case: Case, msg_id: int, link: Link, members: list[int], evidence: tuple[str, ...]) -> Verdict:
    rows = case.rows
    times = rows.time_ns[members] if members else np.array([case.start_ns])
    packets = ", ".join(str(rows.number[row]) for row in members[:_FEW])
    if packets:
        more = ", ..." if len(members) > _FEW else ""
        evidence = (f"packet {packets}{more}, the first at {case.at(int(times[0]))}", *evidence)
    return Verdict(
        ID,
        Severity.ERROR,
        f"{plural(len(members), 'message') if members else 'messages'} on {case.name(msg_id)} without a "
        "subscriber in cFS: the software bus drops them",
        msg_id=msg_id,
        topic=case.topic(msg_id),
        link=link.label,
        hop="software bus",
        lost=len(members) or None,
        of=len(members) or None,
        start_ns=int(times[0]),
        end_ns=int(times[-1]),
        evidence=evidence,
        remedy="correct the MsgId in the mission file, or have the application subscribe to it",
        confidence="medium" if "cFS said" not in evidence[-1] else "high",
    )

"""Messages that are cut, refused or changed for what they are."""

from __future__ import annotations

from itertools import chain, combinations
from typing import TYPE_CHECKING

import numpy as np

from edoras_tools.cfs.limits import BRIDGE_BUFFER
from edoras_tools.cfs.names import MSG_ID_NAMES
from edoras_tools.diagnosis.verdict import Confidence, Verdict, error, note
from edoras_tools.links import table
from edoras_tools.links.ci import CI
from edoras_tools.links.sbn import SBN
from edoras_tools.links.to import TO
from edoras_tools.model import Finding, Link
from edoras_tools.units import MILLISECOND, SECOND
from edoras_tools.wire import sbn
from edoras_tools.wire.arrays.order import by_value, groups
from edoras_tools.words import plural

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from edoras_tools.diagnosis.case import Case


def struct_overrun(case: Case) -> Iterator[Verdict]:
    """A flight application's fixed-size struct is too small for its message.

    Name telemetry whose envelope claims more than its packet holds.
    """
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
                yield _overrun(case, link, msg_id, members, len(all_))


def _overrun(case: Case, link: Link, msg_id: int, members: NDArray[np.intp], of: int) -> Verdict:
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
            "the application left out what is behind, or wrote past the struct's end and over other memory"
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
    return error(
        f"{len(members):,} of {of:,} messages on {case.name(msg_id)} {reason}",
        *evidence,
        msg_id=msg_id,
        link=link.label,
        hop="flight application",
        lost=len(members),
        of=of,
        span=case.span(members),
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


def ground_bridge_buffer(case: Case) -> Iterator[Verdict]:
    """The ground bridge receives 1024 bytes, then trusts buffer_length: longer telemetry becomes garbage.

    Name every MsgId that the bridge publishes cut; housekeeping it does not publish at all.
    """
    rows = case.rows
    over = (rows.link == TO) & rows.has(Finding.OVER_BRIDGE_BUFFER) & (rows.space > 0)
    for msg_id, members in groups(rows.msg_id, np.flatnonzero(over)):
        of = int(((rows.link == TO) & (rows.msg_id == msg_id)).sum())
        yield error(
            f"{len(members):,} of {of:,} messages on {case.name(msg_id)} are longer than the ground "
            f"bridge's {BRIDGE_BUFFER} bytes: it publishes what follows its buffer as garbage",
            f"up to {int(rows.length[members].max()):,} bytes a datagram",
            msg_id=msg_id,
            link="to",
            hop="ground bridge",
            lost=len(members),
            of=of,
            span=case.span(members),
            remedy=f"keep telemetry below {BRIDGE_BUFFER} bytes, or give the bridge a larger buffer",
            confidence="medium",
        )


def flight_bridge_length(case: Case) -> Iterator[Verdict]:
    """The public flight bridge keeps a received length in 8 bits: below 11 modulo 256 it drops the datagram.

    Name every MsgId whose messages have such a length.
    """
    rows = case.rows
    whole = (rows.link == SBN) & (rows.sbn_msg_type == sbn.MsgType.APP)
    dropped = whole & rows.has(Finding.BRIDGE_DROPS_LENGTH)
    for msg_id, members in groups(rows.msg_id, np.flatnonzero(dropped)):
        towards = int(rows.destination[members[0]])
        of = int((whole & (rows.msg_id == msg_id) & (rows.destination == towards)).sum())
        sizes = ", ".join(str(size) for size in np.unique(rows.length[members])[:4].tolist())
        yield error(
            f"{len(members):,} of {of:,} messages on {case.name(msg_id)} have a length that the public "
            "flight bridge drops: it keeps it in 8 bits, and below 11 is no header",
            f"datagrams of {sizes} bytes to {case.endpoints[towards]}",
            msg_id=msg_id,
            link="sbn",
            hop="flight bridge",
            lost=len(members),
            of=of,
            span=case.span(members),
            remedy="pad the flight struct by 11 bytes or more, or keep the length in a size_t in the bridge",
            confidence="medium",
        )


_COUNTED_NS = 2200 * MILLISECOND
"""From a datagram to the 0x803 that counts it, at most."""
_FEW = 8
_UNKNOWN = (1, 2, 3)
"""So many MsgIds that nobody takes are looked for."""


def no_subscriber(case: Case) -> Iterator[Verdict]:
    """Messages that nobody on the software bus takes.

    Say which, where an event or the only command before a count tells.
    """
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
        yield _not_taken(case, reported.msg_id, link, sent.tolist(), (f"cFS said: {said.records[0]}",))
    counted = _counted(case)
    for (instance, msg_id), members in counted.items():
        if (instance, msg_id) not in told and instance not in own:
            text = "0x803: NoSubscribers grew by these, and nothing else fits it (the event stops after 4)"
            yield _not_taken(case, msg_id, table.link(case.rows.link[members[0]]), members, (text,))


def _counted(case: Case) -> dict[tuple[int, int], list[int]]:
    """Find the MsgIds whose messages alone can be what the counter counted.

    Of those that are not seen to be taken, and in the fewest of them that fit: at each count it has what was
    sent before it, but for what may still be on its way.
    """
    rows, times = case.rows, case.rows.time_ns
    if case.peers_unseen:
        return {}  # what one cFS sends another comes in unseen
    arriving = np.flatnonzero(
        ((rows.link == CI) | (rows.link == SBN))
        & (rows.function_code >= 0)
        & ~rows.has(Finding.INVALID_MSG_ID | Finding.OVER_SOFTWARE_BUS)
    )
    taken = {hop.into.msg_id for hop in case.hops} | {
        item.msg_id for item in case.reported_losses if item.kind != "no_subscriber"
    }
    # A cFS sends its peer what that has subscribed to: a counter alone does not say otherwise.
    names = [item.name for item in case.instances.items]
    senders = [place for place, name in case.network.identity_of.items() if name in names]
    of_cfs = np.isin(rows.source[arriving], senders)
    arriving = arriving[~np.isin(rows.msg_id[arriving], [*MSG_ID_NAMES, *taken]) & ~of_cfs]
    found: dict[tuple[int, int], list[int]] = {}
    for instance, track in case.tracks.items():
        counts = np.array(track.totals["no_subscribers"]) - track.totals["no_subscribers"][0]
        seen_ns = np.array(track.times)
        inside = arriving[(times[arriving] > seen_ns[0] - _COUNTED_NS) & (times[arriving] < seen_ns[-1])]
        own = dict(by_value(rows.msg_id[inside])) if counts[-1] else {}
        every = chain.from_iterable(combinations(own, size) for size in _UNKNOWN)
        fits = [
            chosen
            for chosen in every
            if _may_be(times[inside[np.concatenate([own[at] for at in chosen])]], seen_ns, counts)
        ]
        if fits and len(fits[0]) not in map(len, fits[1:]):
            found |= {(instance, msg_id): inside[own[msg_id]].tolist() for msg_id in fits[0]}
    return found


def _may_be(sent_ns: NDArray[np.int64], seen_ns: NDArray[np.int64], counts: NDArray[np.int64]) -> bool:
    """Tell whether a counter has all that was sent until each of its samples, and nothing else."""
    sent_ns = np.sort(sent_ns)
    least, most = (np.searchsorted(sent_ns, seen_ns - lag_ns) for lag_ns in (_COUNTED_NS, 0))
    first = int(least[0])  # what was sent before it was counted in it, or after
    return bool((counts >= least - int(most[0])).all() and (counts <= most - first).all())


def _not_taken(case: Case, msg_id: int, link: Link, members: list[int], evidence: tuple[str, ...]) -> Verdict:
    rows = case.rows
    times = rows.time_ns[members] if members else np.array([case.start_ns])
    packets = ", ".join(str(rows.number[row]) for row in members[:_FEW])
    if packets:
        more = ", ..." if len(members) > _FEW else ""
        evidence = (f"packet {packets}{more}, the first at {case.at(int(times[0]))}", *evidence)
    return error(
        f"{plural(len(members), 'message') if members else 'messages'} on {case.name(msg_id)} without a "
        "subscriber in cFS: the software bus drops them",
        *evidence,
        msg_id=msg_id,
        link=link.label,
        hop="software bus",
        lost=len(members) or None,
        of=len(members) or None,
        span=(int(times[0]), int(times[-1])),
        remedy="correct the MsgId in the mission file, or have the application subscribe to it",
        confidence="medium" if "cFS said" not in evidence[-1] else "high",
    )


def stale_tail(case: Case) -> Iterator[Verdict]:
    """Bytes of an earlier, longer message stand behind the CDR: readers ignore them.

    Name each MsgId that has them, as harmless.
    """
    rows = case.rows
    stale = rows.has(Finding.STALE_TAIL) & (rows.space > rows.cdr_length)
    for link in (CI, TO, SBN):
        for msg_id, members in groups(rows.msg_id, np.flatnonzero(stale & (rows.link == link))):
            of = int(((rows.link == link) & (rows.msg_id == msg_id)).sum())
            first = int(members[0])
            tail = int(rows.space[first] - rows.cdr_length[first])
            yield note(
                f"{len(members):,} of {of:,} messages on {case.name(msg_id)} carry bytes of an earlier, "
                "longer message behind their CDR: harmless, readers stop where the envelope says",
                f"packet {rows.number[first]}: {tail} bytes behind {rows.cdr_length[first]} bytes "
                "of CDR, not all zero: the struct has a fixed size and is not cleared",
                msg_id=msg_id,
                link=link.label,
                hop="flight application",
                span=case.span(members),
                remedy="none needed; clear the struct before each message to keep old data off the link",
            )

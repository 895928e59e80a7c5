"""Messages of the Software Bus Network that a peer refuses, or sends too often."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

import numpy as np

from edoras_tools.cfs import sbn as facts
from edoras_tools.diagnosis.verdict import Severity, Verdict, error, habit, verdict
from edoras_tools.links.sbn import SBN
from edoras_tools.model import NO_MSG_ID, Finding, Peer
from edoras_tools.units import SECOND
from edoras_tools.wire import sbn
from edoras_tools.wire.arrays.order import by_value, groups, numbered
from edoras_tools.words import plural

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from numpy.typing import NDArray

    from edoras_tools.cfs.event_services import EventText
    from edoras_tools.diagnosis.case import Case
    from edoras_tools.diagnosis.evidence.payloads import EventRecord

_ANSWERED_NS: Final = 2 * SECOND
_ONE_BY_ONE: Final = 20
_RESTARTS: Final = "; its receive task ended and started anew"


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
    "read together with what the last datagram left behind, then refused",
    (facts.BAD_MSG_ID, facts.NOT_UNPACKED, facts.UNKNOWN_PEER, facts.UNKNOWN_TYPE),
)


_COMPLETED: Final = BadMessageKind(
    _SHORT.what,
    "no event here says that it was refused: completed by what the last datagram left behind, it may have "
    "been taken as that one again",
    refused=False,
)


_TOO_LARGE: Final = BadMessageKind(
    "MsgSz above 32,767, which reads as negative", "refused", (facts.NOT_UNPACKED,)
)


_WRONG_SIZE: Final = BadMessageKind(
    "MsgSz is not the size of what follows", "ignored silently", refused=False
)


_UNKNOWN_TYPE: Final = BadMessageKind("MsgType that SBN does not know", "refused", (facts.UNKNOWN_TYPE,))


_LEGACY_HEADER: Final = BadMessageKind(
    "7-byte header of older sources",
    "the next 4 bytes are taken for a SpacecraftID: an unknown peer",
    (facts.UNKNOWN_PEER,),
)


def bad_network_message(case: Case) -> Iterator[Verdict]:
    """Malformed SBN datagrams, each with what the receiving SBN does about it.

    Go through every SBN datagram with such a finding; identity and version have rules of their own.
    """
    rows = case.rows
    wanted = (
        Finding.TRUNCATED | Finding.SBN_SIZE_MISMATCH | Finding.SBN_UNKNOWN_TYPE | Finding.SBN_LEGACY_HEADER
    )
    wrong = (rows.link == SBN) & rows.has(wanted) & ~rows.has(Finding.CAPTURE_CUT)
    # A message cut short inside a sound SBN datagram is the sender's application's business.
    inside = (rows.sbn_msg_type == sbn.MsgType.APP) & rows.has(Finding.TRUNCATED) & (rows.msg_id != NO_MSG_ID)
    wrong &= ~inside | rows.has(Finding.SBN_SIZE_MISMATCH | Finding.SBN_LEGACY_HEADER)
    found: dict[tuple[BadMessageKind, int], list[int]] = {}
    for row in np.flatnonzero(wrong).tolist():
        found.setdefault((_kind(case, row), int(rows.msg_id[row])), []).append(row)
    for (kind, _), members in found.items():
        several = len(members) > _ONE_BY_ONE
        for group in [members] if several else [[row] for row in members]:
            yield _verdict(case, group, kind)


def _kind(case: Case, row: int) -> BadMessageKind:
    findings = Finding(int(case.rows.findings[row]))
    if Finding.SBN_LEGACY_HEADER in findings:
        return _LEGACY_HEADER
    if Finding.SBN_UNKNOWN_TYPE in findings:
        return _UNKNOWN_TYPE
    start_ns = int(case.rows.time_ns[row])
    if Finding.SBN_SIZE_MISMATCH not in findings:
        return _SHORT if answers(case, start_ns, *(event.phrase for event in _SHORT.events)) else _COMPLETED
    # The table does not keep MsgSz; that it was refused says that it was negative.
    return _TOO_LARGE if answers(case, start_ns, facts.NOT_UNPACKED.phrase) else _WRONG_SIZE


def _verdict(case: Case, members: list[int], kind: BadMessageKind) -> Verdict:
    rows, first = case.rows, members[0]
    start_ns = int(rows.time_ns[first])
    msg_id = int(rows.msg_id[first])
    evidence = [f"packet {rows.number[first]} at {case.at(start_ns)}: {rows.length[first]} bytes"]
    said = answers(case, start_ns, *(event.phrase for event in kind.events))
    type_ = int(rows.sbn_msg_type[first])
    name = sbn.MSG_TYPE_NAMES.get(type_, f"type 0x{type_:02x}") if type_ >= 0 else "SBN datagram"
    which = f"packet {rows.number[first]}" if len(members) == 1 else f"{len(members):,} datagrams"
    return verdict(
        Severity.ERROR if kind.refused else Severity.WARNING,
        f"{which} ({name}): {kind.what}; {kind.done}{_consequence(said)}",
        *evidence,
        *said,
        msg_id=msg_id if msg_id != NO_MSG_ID else None,
        link="sbn",
        hop="SBN",
        lost=len(members) if kind.refused else None,
        of=len(members),
        span=case.span(members),
        remedy="write the 11-byte header: MsgSz of the payload alone, a known MsgType, ProcessorID, "
        "SpacecraftID",
        confidence="high" if said or not kind.events else "medium",
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


def _consequence(said: Iterable[str]) -> str:
    """Return what a refusal did to the receiver, where an event tells it: who polls has no receive task."""
    return _RESTARTS if any(facts.RECEIVE_TASK_STARTED.phrase in line for line in said) else ""


def _has(record: EventRecord, phrases: Iterable[str]) -> bool:
    return any(phrase in record.message for phrase in phrases)


def wrong_ident(case: Case) -> Iterator[Verdict]:
    """SUB or UNSUB with another $Id than the receiver's: SBN refuses it.

    Name every other $Id, once a sender.
    """
    rows = case.rows
    found: dict[tuple[int, str], list[int]] = {}
    listed, contents = case.payloads.subscriptions, case.payloads.contents
    other = np.array([item.ident != sbn.IDENT for item in contents], bool)[listed["said"]]
    for row, said in zip(listed["row"][other].tolist(), listed["said"][other].tolist(), strict=True):
        found.setdefault((int(rows.source[row]), contents[said].ident), []).append(row)
    for (source, ident), members in found.items():
        said_by_cfs = answers(case, case.span(members)[0], facts.OTHER_IDENT.phrase)
        yield _refused(
            case,
            members,
            f"{plural(len(members), 'subscription message')} of "
            f"{case.network.identity_of.get(source, 'a peer')}: another $Id than cFS's: refused"
            f"{_consequence(said_by_cfs)}",
            "build bridge and cFS from the same SBN sources, or copy its $Id",
            said_by_cfs,
            f": {ident!r}, wanted {sbn.IDENT!r}",
        )


def _refused(
    case: Case,
    members: Sequence[int] | NDArray[np.intp],
    reason: str,
    remedy: str,
    said: list[str],
    seen: str = "",
) -> Verdict:
    """Return a verdict on datagrams that SBN takes none of.

    Args:
        said: what SBN said about the first.
        seen: what else is seen of it.
    """
    span = case.span(members)
    return error(
        reason,
        f"packet {case.rows.number[members[0]]} at {case.at(span[0])}{seen}",
        *said,
        link="sbn",
        hop="SBN",
        lost=len(members),
        of=len(members),
        span=span,
        remedy=remedy,
        confidence="high" if said else "medium",
    )


def wrong_protocol_version(case: Case) -> Iterator[Verdict]:
    """PROTO with another protocol version than 11.

    Name every sender of one.
    """
    rows = case.rows
    wrong = (rows.link == SBN) & rows.has(Finding.SBN_VERSION_MISMATCH)
    for source, members in groups(rows.source, np.flatnonzero(wrong)):
        yield _refused(
            case,
            members,
            f"{len(members):,} PROTO of {case.network.identity_of.get(source, 'a peer')} "
            f"{'names' if len(members) == 1 else 'name'} another "
            f"protocol version than {sbn.PROTOCOL_VERSION}: cFS reports an error and goes on",
            "build both sides from the same SBN version",
            answers(case, case.span(members)[0], facts.VERSION_MISMATCH.phrase),
        )


_UNKNOWN_PEER: Final = (facts.UNKNOWN_PEER, facts.UNKNOWN_PROCESSOR)
_CRASH: Final = ". Its TCP module crashes cFS when a connection closes whose peer it does not know"


def unknown_peer(case: Case) -> Iterator[Verdict]:
    """SBN datagrams of a spacecraft and processor that the receiver's table does not name.

    Name every such sender: by cFS's own words, or by an endpoint that has another name.
    """
    rows = case.rows
    listed = np.isin(rows.sbn_msg_type, (sbn.MsgType.SUB, sbn.MsgType.UNSUB))
    foreign = (rows.link == SBN) & rows.has(Finding.SBN_ID_MISMATCH) & ~listed
    network = np.flatnonzero((rows.link == SBN) & (rows.sbn_msg_type >= 0) & ~rows.has(Finding.TRUNCATED))
    times = rows.time_ns[network]
    for record in case.said(case.start_ns, case.end_ns, facts.NAME):
        found = (event.pattern.search(record.message) for event in _UNKNOWN_PEER)
        if named := next(filter(None, found), None):
            *craft, processor = map(int, named.groups())
            low, high = np.searchsorted(times, (record.time_ns - 2 * SECOND, record.time_ns), "right")
            near = network[low:high]
            same = (rows.processor_id[near] == processor) & np.isin(
                rows.spacecraft_id[near], craft or rows.spacecraft_id[near]
            )
            # Who is named by his processor alone may be one that was named in full just before.
            if craft or not foreign[near[same]].any():
                foreign[near[same]] = True
    identity = rows.spacecraft_id.astype(np.uint64) << 32 | rows.processor_id
    for who, members in groups(identity, np.flatnonzero(foreign)):
        peer, start_ns = Peer(who >> 32, who & 0xFFFFFFFF), case.span(members)[0]
        carried = np.unique(rows.msg_id[members]).tolist()
        said = answers(case, start_ns, *(event.text.format(**peer._asdict()) for event in _UNKNOWN_PEER))
        refused = _refused(
            case,
            members,
            f"{plural(len(members), 'SBN datagram')} from {peer}, which is not the peer known at "
            f"{case.endpoints[rows.source[members[0]]]}: "
            + ("cFS refuses them" if said else "a cFS whose table does not name it refuses them"),
            "make spacecraft_id and processor_id of the bridge agree with cFS's SBN table (sbn_conf_tbl)"
            + (_CRASH if rows.streamed[members].any() else ""),
            said,
        )
        one = len(carried) == 1 and carried[0] != NO_MSG_ID
        yield replace(refused, msg_id=carried[0]) if one else refused


_LEAST: Final = 6
_OFTEN_NS: Final = 2 * SECOND


def subscription_storm(case: Case) -> Iterator[Verdict]:
    """The public flight bridge sends its subscriptions again every 500 ms, for good.

    Find who repeats the same subscription.
    """
    rows, listed = case.rows, case.payloads.subscriptions
    lists: dict[tuple[int, ...], int] = {(): 0}
    wanted = [lists.setdefault(item.wanted, len(lists)) for item in case.payloads.contents]
    wants = np.array(wanted, np.int64)[listed["said"]]
    subs = (rows.sbn_msg_type[listed["row"]] == sbn.MsgType.SUB) & (wants > 0)
    row = listed["row"][subs]
    for source, at in by_value(rows.source[row]):
        own = [rows.time_ns[row[at[same]]] for _, same in by_value(numbered(wants[subs][at])[1])]
        often = [when for when in own if len(when) >= _LEAST and float(np.median(np.diff(when))) < _OFTEN_NS]
        if not often:
            continue
        total = sum(map(len, often))
        period = float(np.median(np.concatenate([np.diff(when) for when in often])))
        yield habit(
            f"{case.network.identity_of.get(source, 'a peer')} sends its "
            f"{plural(len(often), 'subscription')} again every {period / 1e6:.0f} ms, {total:,} in all: the "
            "public flight bridge does; cFS ignores repeats",
            f"from {case.endpoints[source]}",
            link="sbn",
            hop="flight bridge",
            span=(int(min(when[0] for when in often)), int(max(when[-1] for when in often))),
            remedy="none needed; subscribing once after PROTO would do",
        )


def proto_storm(case: Case) -> Iterator[Verdict]:
    """The public flight bridge answers every datagram with PROTO.

    Find who sends about as many PROTO as it receives datagrams.
    """
    rows = case.rows
    protos = (rows.link == SBN) & (rows.sbn_msg_type == sbn.MsgType.PROTO)
    every = np.bincount(rows.destination[rows.link == SBN], minlength=len(case.endpoints))
    for source, sent in groups(rows.source, np.flatnonzero(protos)):
        heard = int(every[source])
        if len(sent) < _LEAST or 2 * len(sent) < heard:
            continue
        yield habit(
            f"{case.network.identity_of.get(source, 'a peer')} answers every datagram with PROTO, "
            f"{len(sent):,} in all: the public flight bridge does; cFS reports an event for each and goes on",
            f"{len(sent):,} PROTO for {heard:,} datagrams received",
            link="sbn",
            hop="flight bridge",
            span=case.span(sent),
            remedy="none needed; the events may squelch SBN's others (15 a second)",
        )

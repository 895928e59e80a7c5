"""Every message that was lost, one by one: as many as the balance has, each once.

Rules:

1. Every loss names the messages that it is, or is some of: packets that did not arrive, or sequence counts
   that never came. Losses that share such messages are told together.
2. Where losses are as many as the messages that they are among, each of these is told by itself.
3. Elsewhere it is not known which of them were lost: each loss is told as one of so many.
4. A loss of which the capture shows neither packet nor count is told by its time alone.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from edoras_tools.cfs import telemetry_output
from edoras_tools.diagnosis.accounting.losses import Among, LossKind
from edoras_tools.diagnosis.accounting.ports import PORT_CLOSED, REFUSED
from edoras_tools.diagnosis.evidence.relays.proxied import PROXY_HOP
from edoras_tools.links import table
from edoras_tools.model import NO_MSG_ID
from edoras_tools.sessions.sequence import MODULUS

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

    from edoras_tools.diagnosis.accounting.commands import Refused
    from edoras_tools.diagnosis.case import Case

_CAUSES: Final[dict[LossKind, str]] = {
    "limit": "over the message limit of {hop}",
    "overflow": "{hop} was full",
    "after": "lost between cFS and the capture",
    "unknown": "lost on the software bus",
    "network": "lost before CI",
    "socket": "CI's socket was full",
    "down": "cFS was down",
    "restart": "{hop} was restarted",
    "stopped": "{hop} was stopped",
    "ci_stopped": "{hop} was stopped",
    "away": "the SBN peer was away",
    "unsubscribed": "the SBN peer had not subscribed to it",
    "sbn_socket": "SBN's socket was full",
    "fragments": "its later fragments never came",
    "port_closed": "nobody listened on the port of {hop}",
}
_UNREACHED: Final = {
    PORT_CLOSED: "nobody listened on {}",
    REFUSED: "an ICMP error came back from the way to {}",
}
_ROOM: Final = 1 << 32
"""Numbers for the counts that are missing behind one row."""


@dataclass(frozen=True, slots=True)
class Missing:
    """One message that was lost.

    Attributes:
        link: label of the link; empty where it is not known.
        msg_id: cFE MsgId.
        topic: configured topic, else the packet's name, or None.
        count: 1: each message has an entry of its own; of samples of DDS how many a writer lost for a cause.
        time_ns: when it was sent; of a count, when the packet before it was seen; else when the loss began.
        until_ns: of a count, when the packet behind it was seen; of a packet as ``time_ns``; else when the
            loss ended.
        number: place of the packet in the capture, from 1; None where it is not there or not known.
        first: its sequence count; None where it has none or it is not known.
        one_of: of how many messages it is one, where it is not known which; else None.
        what: what became of it.
        message: fields of the ROS message, or None.
    """

    link: str
    msg_id: int
    topic: str | None
    count: int
    time_ns: int
    until_ns: int
    number: int | None
    first: int | None
    one_of: int | None
    what: str
    message: dict[str, Any] | None = None

    @property
    def concerns(self) -> tuple[str | None, int | None, str]:
        """Its link and MsgId, each None where it is not known, and its topic."""
        return self.link or None, None if self.msg_id == NO_MSG_ID else self.msg_id, self.topic or ""

    def as_json(self) -> dict[str, Any]:
        """Return it in the shape of ``doctor --list-lost json``."""
        return {**asdict(self), "msg_id": None if self.msg_id == NO_MSG_ID else f"0x{self.msg_id:04x}"}


@dataclass(frozen=True, slots=True)
class _Share:
    """So many messages of one MsgId that were lost for one cause, among those that may be meant."""

    what: str
    link: str
    msg_id: int
    lost: int
    start_ns: int
    end_ns: int
    among: Among | None


def missing(case: Case) -> list[Missing]:
    """Return all of them, in order of time."""
    found = [*_dropped(case), *_unplaced(case)]
    groups: dict[tuple[int, bool], list[_Share]] = {}
    for share in _shares(case):
        if share.among is None:
            found += [_entry(case, share)] * share.lost
        else:
            groups.setdefault((id(share.among.stream), share.among.missing is None), []).append(share)
    for shares in groups.values():
        units = [_units(share.among) for share in shares if share.among is not None]
        labels = _connected(units)
        for label in np.unique(labels).tolist():
            members = np.flatnonzero(labels == label).tolist()
            found += _told(case, [(shares[index], units[index]) for index in members])
    return sorted(found, key=lambda item: item.time_ns)


def _shares(case: Case) -> Iterator[_Share]:
    """Yield all that the balance has as lost of streams, and what counters have of no stream."""
    for loss in case.losses:
        link = loss.stream.link.label if loss.stream else ""
        what = _CAUSES[loss.kind].format(hop=loss.hop)
        yield _Share(what, link, loss.msg_id, loss.lost, loss.start_ns, loss.end_ns, loss.among)
    for item in case.refused:
        if id(item) in case.commands.placed:
            yield _refused(item, *case.commands.placed[id(item)])
    for stream in case.streams:
        silent = case.unheard.get(id(stream))
        if silent is not None and silent.lost:
            what = f"sent to the SBN peer {silent.peer} while it was silent"
            yield _whole(case, what, silent.lost, Among(stream, np.array(silent.rows, np.intp)))
        if silent is not None and silent.restarted:
            what = f"sent to the SBN peer {silent.peer} before it was started again"
            among = Among(stream, np.array(silent.restarted_rows, np.intp))
            yield _whole(case, what, silent.restarted, among)
    for part in case.unreached:
        for cause, rows in part.lost.items():
            what = _UNREACHED[cause].format(case.endpoints[part.endpoint])
            yield _whole(case, what, len(rows), Among(part.stream, rows))
    for lost, among in case.telemetry.silent:
        if lost and case.socket_failed(among.stream):
            yield _whole(case, f"{telemetry_output.SOCKET} failed", lost, among)


def _refused(item: Refused, lost: int, among: Among | None) -> _Share:
    msg_id = NO_MSG_ID if item.msg_id is None else item.msg_id
    what = f"{item.rule} at {item.hop or 'cFS'}"
    return _Share(what, item.link or "", msg_id, lost, item.start_ns, item.end_ns, among)


def _unplaced(case: Case) -> Iterator[Missing]:
    """Yield what was refused and is of no stream: the datagrams of that time, where they are as many."""
    rows = case.rows
    for item in case.refused:
        if not (left := case.commands.unplaced[id(item)]):
            continue
        there = (rows.time_ns >= item.start_ns) & (rows.time_ns <= item.end_ns)
        if item.link:
            there &= rows.link == table.named(item.link).code
        if item.msg_id is not None:
            there &= rows.msg_id == item.msg_id
        at, share = np.flatnonzero(there).tolist(), _refused(item, left, None)
        if len(at) != left:
            yield from [_entry(case, share, len(at) if len(at) > left else None)] * left
            continue
        for row in at:
            when = int(rows.time_ns[row])
            one = replace(_entry(case, share), time_ns=when, until_ns=when)
            yield replace(one, number=int(rows.number[row]))


def _whole(case: Case, what: str, lost: int, among: Among) -> _Share:
    stream, times = among.stream, case.rows.time_ns[among.stream.rows[among.rows]]
    return _Share(what, stream.link.label, stream.msg_id, lost, int(times.min()), int(times.max()), among)


def _dropped(case: Case) -> Iterator[Missing]:
    """Yield what a proxy dropped on purpose; it is not in the capture."""
    for (link, _, msg_id), item in case.proxied.items():
        for when, _ in item.dropped:
            share = _Share(
                f"dropped on purpose by the {PROXY_HOP}", table.link(link).label, msg_id, 1, when, when, None
            )
            yield _entry(case, share)


def _units(among: Among) -> NDArray[np.int64]:
    """Return a number for each message: a row of the stream, and which of those missing behind it."""
    base = among.rows.astype(np.int64) * _ROOM
    if among.missing is None:
        return base
    within = np.arange(int(among.missing.sum())) - np.repeat(
        np.cumsum(among.missing) - among.missing, among.missing
    )
    return np.asarray(np.repeat(base, among.missing) + within)


def _connected(units: Sequence[NDArray[np.int64]]) -> NDArray[np.intp]:
    """Return a label for each set of messages, the same for those that share some, or do so by others."""
    label = np.arange(len(units))
    which = np.repeat(label, [len(own) for own in units])
    _, unit = np.unique(np.concatenate(units), return_inverse=True)
    while len(unit):
        least = np.full(int(unit.max()) + 1, len(units))
        np.minimum.at(least, unit, label[which])
        joined = label.copy()
        np.minimum.at(joined, which, least[unit])
        if np.array_equal(joined, label):
            break
        label = joined
    return label


def _told(case: Case, shares: Sequence[tuple[_Share, NDArray[np.int64]]]) -> Iterator[Missing]:
    """Yield the messages of losses that share what they are among (rules 2 to 4)."""
    every = np.unique(np.concatenate([units for _, units in shares]))
    if sum(share.lost for share, _ in shares) == len(every):
        causes: dict[int, dict[str, _Share]] = {}
        for share, units in shares:
            for unit in units.tolist():
                causes.setdefault(unit, {})[share.what] = share
        for unit, texts in causes.items():
            yield _message(case, next(iter(texts.values())), unit, " or ".join(texts))
        return
    taken = np.zeros(0, np.int64)
    for share, units in sorted(shares, key=lambda item: len(item[1]) - item[0].lost):
        free = np.setdiff1d(units, taken)
        if share.lost < len(free):
            yield from [_entry(case, share, len(free))] * share.lost
            continue
        taken = np.concatenate((taken, free))
        for unit in free.tolist():
            yield _message(case, share, unit, share.what)
        yield from [_entry(case, share)] * (share.lost - len(free))


def _entry(case: Case, share: _Share, one_of: int | None = None) -> Missing:
    """Return a message that no packet and no count tells."""
    return Missing(
        link=share.link,
        msg_id=share.msg_id,
        topic=_name(case, share.msg_id),
        count=1,
        time_ns=share.start_ns,
        until_ns=share.end_ns,
        number=None,
        first=None,
        one_of=one_of,
        what=share.what,
    )


def _message(case: Case, share: _Share, unit: int, what: str) -> Missing:
    """Return a message that is known: a packet, or a sequence count."""
    among, rows = share.among, case.rows
    assert among is not None
    index, place = divmod(unit, _ROOM)
    stream = among.stream
    row = int(stream.rows[index])
    times = (int(rows.time_ns[row]),) * 2
    number: int | None = int(rows.number[row])
    first = one_of = None
    if among.missing is not None:
        number, times = None, (times[0], int(rows.time_ns[stream.rows[min(index + 1, len(stream) - 1)]]))
        gap = int(stream.missing[index])
        if int(among.missing[np.flatnonzero(among.rows == index)[0]]) < gap:
            one_of = gap  # others are missing there as well
        else:
            first = (int(rows.sequence_count[row]) + 1 + place) % MODULUS
    return Missing(
        link=share.link,
        msg_id=share.msg_id,
        topic=_name(case, share.msg_id),
        count=1,
        time_ns=times[0],
        until_ns=times[1],
        number=number,
        first=first,
        one_of=one_of,
        what=what,
    )


def _name(case: Case, msg_id: int) -> str | None:
    return case.topic(msg_id) or case.packet_name(msg_id) or None

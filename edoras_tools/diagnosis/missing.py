"""The list of lost messages, one by one: as many as the balance has, each once.

Rules:

1. Every loss names its candidates: packets that did not arrive, or sequence counts that never came. Losses
   that share candidates are listed together.
2. If there are as many losses as candidates, each candidate is listed.
3. Otherwise it is unknown which candidates were lost. Each loss is listed as one of their number.
4. A loss without a packet and without a count in the capture is listed with its time only.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import msgspec
import numpy as np
from msgspec.structs import asdict, replace

from edoras_tools.diagnosis.accounting.losses import Among
from edoras_tools.diagnosis.ledger import LedgerEntry
from edoras_tools.model import NO_MSG_ID
from edoras_tools.sessions.sequence import MODULUS
from edoras_tools.wire.arrays import Integers, Places, distinct, numbered, places_within

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from edoras_tools.diagnosis.case import Case
    from edoras_tools.diagnosis.matching.streams import Stream
    from edoras_tools.mission import Mission

_Share = tuple[LedgerEntry, Among]
_ShareUnits = tuple[LedgerEntry, Among, "Integers"]
_ROOM: Final = 1 << 32
"""Numbers reserved for the sequence counts missing behind one row."""
ALL: Final = 1 << 62
"""A number above that of any loss: no limit."""


class Missing(msgspec.Struct, frozen=True):
    """One lost message.

    Attributes:
        link: label of the link; empty if unknown.
        msg_id: cFE MsgId; ``NO_MSG_ID`` if unknown.
        topic: configured topic, else the packet's name; None without either.
        count: 1, because each message has its own entry; for DDS, samples that a writer lost for one cause.
        time_ns: time of a packet; for a sequence count, that of the packet in front; else the loss's begin.
        until_ns: time of a packet; for a sequence count, that of the packet behind; else the loss's end.
        number: place of the packet in the capture, from 1; None if it is not there, or unknown.
        first: sequence count; None if it has none, or unknown.
        one_of: number of candidates, if it is unknown which of them was lost; else None.
        what: fate of the message, as text.
        message: fields of the ROS message; None if not decoded.
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
        """Arguments of ``Choice.takes``: link and MsgId, None if unknown, and topic, empty without one."""
        return self.link or None, None if self.msg_id == NO_MSG_ID else self.msg_id, self.topic or ""

    def of(self, spacecraft: int, mission: Mission) -> Missing:
        """Return the message with the name of its spacecraft in the topic."""
        name = self.topic or (f"0x{self.msg_id:04x}" if self.msg_id != NO_MSG_ID else "")
        return replace(self, topic=mission.own_name(name, spacecraft))

    def as_json(self) -> dict[str, Any]:
        """Return the message in the shape of ``doctor --list-lost json``."""
        return {**asdict(self), "msg_id": None if self.msg_id == NO_MSG_ID else f"0x{self.msg_id:04x}"}


def missing(case: Case, most: int = ALL) -> list[Missing]:
    """Return the lost messages in order of time.

    Args:
        case: capture.
        most: largest number of messages of each loss; the latest are listed.
    """
    listed: list[Missing] = []
    groups: dict[tuple[Stream, bool], list[_Share]] = {}
    for entry in case.ledger.losses():
        among = entry.among
        if isinstance(among, Among):
            groups.setdefault((among.stream, among.missing is None), []).append((entry, among))
        else:
            listed += _alone(case, entry, among, most)
    for shares in groups.values():
        units = [_units(among) for _, among in shares]
        labels = _connected(units)
        for label in np.unique(labels).tolist():
            members = np.flatnonzero(labels == label).tolist()
            listed += _together(case, [(*shares[index], units[index]) for index in members], most)
    return sorted(listed, key=lambda item: item.time_ns)


def _alone(case: Case, entry: LedgerEntry, rows: Places | None, most: int) -> Iterator[Missing]:
    """Yield the messages of a loss that belongs to no stream.

    Args:
        rows: candidate rows of the table; if there are as many as messages, each is listed.
    """
    number = entry.number
    if rows is None or len(rows) != number:
        one_of = None if rows is None or len(rows) < number else len(rows)
        yield from [_entry(case, entry, one_of)] * min(number, most)
        return
    for row in rows[-most:].tolist():
        when = int(case.rows.time_ns[row])
        one = replace(_entry(case, entry), time_ns=when, until_ns=when)
        yield replace(one, number=int(case.rows.number[row]))


def _units(among: Among) -> Integers:
    """Return a number for each candidate, i64: row in the stream * ``_ROOM`` + place in the gap behind."""
    base = among.rows.astype(np.int64) * _ROOM
    if among.missing is None:
        return base
    return np.asarray(np.repeat(base, among.missing) + places_within(among.missing))


def _connected(units: Sequence[Integers]) -> Places:
    """Return a label for each set of candidates, intp; sets that overlap, directly or by others, share it."""
    label = np.arange(len(units))
    which = np.repeat(label, [len(own) for own in units])
    unit = numbered(np.concatenate(units))[1]
    while len(unit):
        least = np.full(int(unit.max()) + 1, len(units))
        np.minimum.at(least, unit, label[which])
        joined = label.copy()
        np.minimum.at(joined, which, least[unit])
        if np.array_equal(joined, label):
            break
        label = joined
    return label


def _together(case: Case, shares: Sequence[_ShareUnits], most: int) -> Iterator[Missing]:
    """Yield the messages of losses that share candidates (rules 2 to 4)."""
    every = distinct(np.concatenate([units for _, _, units in shares]))
    if sum(entry.number for entry, _, _ in shares) == len(every):
        causes: dict[int, dict[str, _Share]] = {}
        for entry, among, units in shares:
            for unit in units[units >= every[-most:][0]].tolist():
                causes.setdefault(unit, {})[entry.text] = entry, among
        for unit, texts in causes.items():
            yield _message(case, next(iter(texts.values())), unit, " or ".join(texts))
        return
    used = np.zeros(0, np.int64)
    for entry, among, units in sorted(shares, key=lambda item: len(item[2]) - item[0].number):
        free = np.setdiff1d(units, used)
        if entry.number < len(free):
            yield from [_entry(case, entry, len(free))] * min(entry.number, most)
            continue
        used = np.concatenate((used, free))
        yield from (_message(case, (entry, among), unit, entry.text) for unit in free[-most:].tolist())
        yield from [_entry(case, entry)] * min(entry.number - len(free), most)


def _entry(case: Case, entry: LedgerEntry, one_of: int | None = None) -> Missing:
    """Return a message without packet or sequence count (rules 3 and 4)."""
    msg_id = NO_MSG_ID if entry.traffic.msg_id is None else entry.traffic.msg_id
    link, times_ns = entry.traffic.link, entry.times_ns[:2]
    name = case.topic(msg_id) or case.packet_name(msg_id) or None
    return Missing(link, msg_id, name, 1, *times_ns, number=None, first=None, one_of=one_of, what=entry.text)


def _message(case: Case, share: _Share, unit: int, text: str) -> Missing:
    """Return a message that is a packet or a sequence count (rule 2)."""
    entry, among = share
    rows, stream = case.rows, among.stream
    index, place = divmod(unit, _ROOM)
    row = int(stream.rows[index])
    one = replace(_entry(case, entry), what=text)
    start_ns = int(rows.time_ns[row])
    if among.missing is None:
        return replace(one, time_ns=start_ns, until_ns=start_ns, number=int(rows.number[row]))
    end_ns = int(rows.time_ns[stream.rows[min(index + 1, len(stream) - 1)]])
    gap = int(stream.missing[index])
    # If other losses share the gap, the count is unknown.
    whole = int(among.missing[np.flatnonzero(among.rows == index)[0]]) >= gap
    count = (int(rows.sequence_count[row]) + 1 + place) % MODULUS
    return replace(
        one, time_ns=start_ns, until_ns=end_ns, first=count if whole else None, one_of=None if whole else gap
    )

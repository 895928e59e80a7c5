"""Which datagrams each rule looks at, one at a time and a batch at once, and how many it has seen."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from edoras_tools.model import NO_MSG_ID, Link
from edoras_tools.sessions.fault_bytes import packet_offset
from edoras_tools.wire import ccsds, sbn

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from edoras_tools.sessions.fault_actors import Actor
    from edoras_tools.sessions.fault_rules import Rule

    Predicate = Callable[[bytes, Link], bool]

HEAD_BYTES: Final = sbn.HEADER.size + 2
"""What ``Heads`` needs of each datagram: the SBN header and a MsgId."""


def msg_id_of(payload: bytes, link: Link) -> int:
    """Return a datagram's MsgId, ``NO_MSG_ID`` where it has none."""
    at = packet_offset(payload, link)
    return int.from_bytes(payload[at : at + 2], "big") if at >= 0 else NO_MSG_ID


@dataclass(slots=True)
class Entry:
    """A rule of this run, and what it keeps in mind."""

    index: int
    rule: Rule
    ordinal: int
    matches: Predicate | None
    actor: Actor

    def looks_at(self, link: Link, *, to_cfs: bool) -> bool:
        """Tell whether datagrams of a link and direction may be in its scope."""
        scope = self.rule.scope
        return (not scope.links or link in scope.links) and scope.to_cfs in {None, to_cfs}

    def inside(self, payload: bytes, link: Link) -> bool:
        """Tell whether a datagram of a link and direction that it looks at is in its scope."""
        scope = self.rule.scope
        if scope.msg_ids and msg_id_of(payload, link) not in scope.msg_ids:
            return False
        if scope.sbn_types and (
            link is not Link.SBN or len(payload) < sbn.HEADER.size or payload[2] not in scope.sbn_types
        ):
            return False
        return self.matches is None or self.matches(payload, link)


@dataclass(slots=True)
class Lane:
    """A rule's count of one stream in one direction of one link, and what its chances there hang on."""

    entry: Entry
    key: int
    threshold: int
    count: int = 0
    first: int = 0
    places: NDArray[np.int64] = None  # type: ignore[assignment]  # of the last batch that was decided


class Heads:
    """What scopes ask of a batch, read once."""

    def __init__(self, heads: NDArray[np.uint8], length: NDArray[np.integer[Any]], link: Link) -> None:
        self._heads, self._length, self._link = heads, length, link
        self._msg_id: NDArray[np.int32] | None = None

    def inside(self, entry: Entry, payload: Callable[[int], bytes]) -> NDArray[np.bool_]:
        """Tell of each datagram whether it is in the scope of a rule that looks at this link; bool (n,)."""
        scope = entry.rule.scope
        inside = np.ones(len(self._length), bool)
        if scope.msg_ids:
            inside &= np.isin(self._msg_ids(), list(scope.msg_ids))
        if scope.sbn_types:
            inside &= np.isin(self._heads[:, 2], list(scope.sbn_types))
            inside &= (self._length >= sbn.HEADER.size) & (self._link is Link.SBN)
        if entry.matches is not None:
            for row in np.flatnonzero(inside).tolist():
                inside[row] = entry.matches(payload(row), self._link)
        return inside

    def _msg_ids(self) -> NDArray[np.int32]:
        if self._msg_id is None:
            at = sbn.HEADER.size if self._link is Link.SBN else 0
            heads = self._heads
            word = heads[:, at].astype(np.int32) << 8 | heads[:, at + 1]
            there = self._length >= at + ccsds.PRIMARY.size
            if self._link is Link.SBN:
                there &= heads[:, 2] == sbn.MsgType.APP
            self._msg_id = np.where(there, word, NO_MSG_ID).astype(np.int32)
        return self._msg_id

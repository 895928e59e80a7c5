"""The datagrams in the scope of a rule, one at a time or a batch at once, and their counts."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import msgspec
import numpy as np

from edoras_tools.model import NO_MSG_ID, Link
from edoras_tools.sessions.faults.bytes import packet_offset
from edoras_tools.wire import ccsds, sbn
from edoras_tools.wire.msg_id import MSG_ID_BYTES, VERSION_1, MsgIds

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from edoras_tools.sessions.faults.effects import Effect
    from edoras_tools.sessions.faults.rules import Rule
    from edoras_tools.wire.arrays.order import Integers, Mask, Octets

    Predicate = Callable[[bytes, Link], bool]

HEAD_BYTES: Final = sbn.HEADER.size + MSG_ID_BYTES
"""First bytes of each datagram that ``BatchHeads`` needs: the SBN header and a MsgId."""


def datagram_msg_id(payload: bytes, link: Link, msg_ids: MsgIds = VERSION_1) -> int:
    """Return a datagram's MsgId, ``NO_MSG_ID`` if it has none."""
    at = packet_offset(payload, link)
    return msg_ids.of(payload, at) if at >= 0 else NO_MSG_ID


class ActiveRule(msgspec.Struct):
    """A rule of this run.

    Attributes:
        index: place in the order in which rules act.
        rule: the rule as written.
        ordinal: number among the rules of its kind.
        matches: compiled filter expression; None if it has none.
        effect: effect of the rule, with its state.
        msg_ids: version of the MsgIds.
    """

    index: int
    rule: Rule
    ordinal: int
    matches: Predicate | None
    effect: Effect
    msg_ids: MsgIds = VERSION_1

    def looks_at(self, link: Link, *, to_cfs: bool) -> bool:
        """Return whether datagrams of a link and direction may be in its scope."""
        scope = self.rule.scope
        return (not scope.links or link in scope.links) and scope.to_cfs in {None, to_cfs}

    def inside(self, payload: bytes, link: Link) -> bool:
        """Return whether a datagram of a link and direction that may be in scope is in scope."""
        scope = self.rule.scope
        if scope.msg_ids and datagram_msg_id(payload, link, self.msg_ids) not in scope.msg_ids:
            return False
        if scope.sbn_types and (
            not link.peers
            or len(payload) < sbn.HEADER.size
            or payload[sbn.MSG_TYPE_AT] not in scope.sbn_types
        ):
            return False
        return self.matches is None or self.matches(payload, link)


class StreamCounter(msgspec.Struct):
    """A rule's count of the datagrams of one stream, link and direction, and the key of its random choices.

    Attributes:
        active: the rule.
        key: key of the random choices.
        threshold: limit below which a draw strikes.
        count: number of datagrams so far.
        first: count before the last batch that was decided.
        places: rows of that batch that were in scope.
    """

    active: ActiveRule
    key: int
    threshold: int
    count: int = 0
    first: int = 0
    places: Integers = None  # type: ignore[assignment]  # there is none before the first batch


class BatchHeads:
    """The header fields of a batch that scopes need, read once.

    Args:
        heads: first bytes of each datagram, u8 (n, ``HEAD_BYTES`` or more).
        length: bytes of each, (n,).
        link: link of all datagrams.
    """

    def __init__(self, heads: Octets, length: NDArray[np.integer[Any]], link: Link) -> None:
        self._heads, self._length, self._link = heads, length, link
        self._msg_id: NDArray[np.int32] | None = None

    def inside(self, active: ActiveRule, payload: Callable[[int], bytes]) -> Mask:
        """Return whether each datagram is in the scope of a rule that applies to this link; bool (n,)."""
        scope = active.rule.scope
        inside = np.ones(len(self._length), bool)
        if scope.msg_ids:
            inside &= np.isin(self._msg_ids(active.msg_ids), list(scope.msg_ids))
        if scope.sbn_types:
            inside &= np.isin(self._heads[:, sbn.MSG_TYPE_AT], list(scope.sbn_types))
            inside &= (self._length >= sbn.HEADER.size) & (self._link.peers)
        if active.matches is not None:
            for row in np.flatnonzero(inside).tolist():
                inside[row] = active.matches(payload(row), self._link)
        return inside

    def _msg_ids(self, msg_ids: MsgIds) -> NDArray[np.int32]:
        if self._msg_id is None:
            at = sbn.HEADER.size if self._link.peers else 0
            heads = self._heads
            numbers = msg_ids.column(heads[:, at:], self._length - at)
            whole = self._length >= at + ccsds.PRIMARY.size
            if self._link.peers:
                whole &= heads[:, sbn.MSG_TYPE_AT] == sbn.MsgType.APP
            self._msg_id = np.where(whole, numbers, NO_MSG_ID).astype(np.int32)
        return self._msg_id

"""Causes and effects in two captures of one system, which limit how their clocks differ (``clock_lines``).

1. A peer's PROTO answers the first datagram of the other after a silence, usually at once.
2. What leaves cFS entered it before: the same values, or the same packet forwarded from SBN.
3. A packet that a cFS sends on two links was made once: it leaves on each within one wake-up.

No answer comes before its question. Of many packets in one direction, the quickest waited less than a wake-
up.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from edoras_tools.cfs.profile import SimProfile
from edoras_tools.diagnosis.evidence.clocks.lines import ClockLine, Ordered
from edoras_tools.links.table import among
from edoras_tools.model import NO_MSG_ID
from edoras_tools.units import MILLISECOND, SECOND
from edoras_tools.wire import sbn
from edoras_tools.wire.arrays.fingerprint import matches
from edoras_tools.wire.arrays.order import by_value
from edoras_tools.wire.msg_id import VERSION_1

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from edoras_tools.diagnosis.evidence.instances import Instances
    from edoras_tools.diagnosis.evidence.table import Recorder, Rows

    _Pairs = tuple[NDArray[np.int64], NDArray[np.int64]]
    """When causes were captured, and when their effects."""

_PROFILE: Final = SimProfile()
_SLACK_NS: Final = 100 * MILLISECOND
"""Tasks on a busy host wake up so late."""
_OUTPUT_NS: Final = _PROFILE.to_wake_ns + _SLACK_NS
_NETWORK_NS: Final = _PROFILE.sbn_wake_ns + _SLACK_NS
HANDED_NS: Final = _OUTPUT_NS + _NETWORK_NS
"""A packet that crosses SBN and leaves by Telemetry Output waits for both at the most."""
_THROUGH_NS: Final = HANDED_NS + _PROFILE.ci_wake_ns
_AT_ONCE_NS: Final = MILLISECOND
"""An answer of a task that waits for its question comes within so much."""
_NEAR_NS: Final = 2 * SECOND
_LEAST: Final = 3
_MANY: Final = 20
"""Messages of one way of which one was delayed hardly at all."""


@dataclass(frozen=True, slots=True)
class Side:
    """One of the two captures: what it recorded, and the cFS in it."""

    recorder: Recorder
    rows: Rows
    instances: Instances


def relations(first: Side, second: Side, about: ClockLine | None) -> list[Ordered]:
    """Return what of one capture came before what of the other.

    Args:
        about: how the second's clock stands to the first's as far as that is known, which tells what belongs
            together; None where unknown.
    """
    return [*_related(first, second, about, back=False), *_related(second, first, about, back=True)]


def _related(cause: Side, effect: Side, about: ClockLine | None, *, back: bool) -> Iterator[Ordered]:
    """Yield pairs of what one holds and what in the other follows from it."""

    def ordered(pairs: _Pairs, wait_ns: int, **told: Any) -> Ordered:
        first, second = pairs[::-1] if back else pairs
        return Ordered(first, second, back=back, wait_ns=wait_ns, **told)

    for pairs in _answers(cause, effect, about, back=back):
        # It may have been a later datagram that was heard: how late an answer can be, nothing tells.
        yield ordered(pairs, _NEAR_NS, at_once_ns=_AT_ONCE_NS)
    for pairs in _values(cause.rows, effect.rows, about, back=back):
        at_once = _AT_ONCE_NS if len(pairs[0]) >= _MANY else None
        yield ordered(pairs, _THROUGH_NS, at_once_ns=at_once)
    for pairs, owner, maker in _packets(cause, effect, about, back=back):
        if owner == maker:
            yield ordered(pairs, _OUTPUT_NS, early_ns=_NETWORK_NS, each=True)
        else:
            yield ordered(pairs, HANDED_NS, early_ns=0 if owner else _NETWORK_NS)


def _near(pairs: _Pairs, about: ClockLine | None, *, back: bool, least: int = _LEAST) -> _Pairs:
    """Return those pairs of cause and effect that are of one offset; none where too few are."""
    first, second = pairs[::-1] if back else pairs
    ahead = second - first
    if not len(ahead):
        return pairs
    middle = int(np.median(ahead)) if about is None else about.ahead(first)
    near = np.abs(ahead - middle) < _NEAR_NS
    if near.sum() < least:
        near[:] = False
    return pairs[0][near], pairs[1][near]


def _answers(cause: Side, effect: Side, about: ClockLine | None, *, back: bool) -> Iterator[_Pairs]:
    """Yield when a peer sent its first datagram, and when a PROTO came that answered it."""
    if about is None:
        return
    asked, told = cause.rows, effect.rows
    asking = np.flatnonzero(asked.sbn_msg_type >= 0)
    proto = np.flatnonzero(told.sbn_msg_type == sbn.MsgType.PROTO)
    for way, members in by_value(told.source[proto].astype(np.int64) << 32 | told.destination[proto]):
        ends = [effect.recorder.endpoints[end] for end in (way & 0xFFFFFFFF, way >> 32)]
        if any(end not in cause.recorder.endpoints for end in ends):
            continue
        source, target = (cause.recorder.endpoints.index(end) for end in ends)
        own = asking[(asked.source[asking] == source) & (asked.destination[asking] == target)]
        sessions = _begins(asked.time_ns[own])
        answers = _begins(told.time_ns[proto[members]])
        if len(sessions) and len(answers):
            every = np.repeat(sessions, len(answers)), np.tile(answers, len(sessions))
            pairs = _near(every, about, back=back, least=1)
            if len(pairs[0]):
                yield pairs


def _begins(times: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return when something began after a silence that ends a connection."""
    silence = _PROFILE.sbn_timeout_s * SECOND
    return times[np.diff(times, prepend=-silence) >= silence] if len(times) else times


def _values(cause: Rows, effect: Rows, about: ClockLine | None, *, back: bool) -> Iterator[_Pairs]:
    """Yield when messages went into cFS and the same came out, read and written anew."""
    into = np.flatnonzero((cause.msg_id != NO_MSG_ID) & VERSION_1.is_command(cause.known_id))
    into = into[(cause.body_print[into] != 0) | (cause.value_print[into] != 0)]
    robot = among(effect.link, lambda item: item.last_hop)
    out = np.flatnonzero(robot | ((effect.msg_id != NO_MSG_ID) & ~VERSION_1.is_command(effect.known_id)))
    for came, went in (
        (cause.body_print, effect.body_print),
        (cause.value_print, effect.value_print),
        (cause.value_print, effect.stamped_print),
    ):
        ours, theirs = matches(came[into], went[out])
        pairs = _near((cause.time_ns[into[ours]], effect.time_ns[out[theirs]]), about, back=back)
        if len(pairs[0]):
            yield pairs
            return


def _packets(
    cause: Side, effect: Side, about: ClockLine | None, *, back: bool
) -> Iterator[tuple[_Pairs, str, str]]:
    """Yield when SBN carried packets and a Telemetry Output sent them, whose, and who made them."""
    network = np.flatnonzero(
        among(cause.rows.link, lambda link: link.peers) & (cause.rows.msg_id != NO_MSG_ID)
    )
    output = np.flatnonzero(among(effect.rows.link, lambda link: link.only_from_cfs))
    ours, theirs = matches(cause.rows.packet_print[network], effect.rows.packet_print[output])
    ours, theirs = network[ours], output[theirs]
    maker = cause.rows.spacecraft_id[ours].astype(np.int64) << 32 | cause.rows.processor_id[ours]
    for source, at in by_value(effect.rows.source[theirs].astype(np.int64)):
        for who, some in by_value(maker[at]):
            rows = at[some]
            times = effect.rows.time_ns[theirs[rows]]
            owner = effect.instances.owner(source, int(times[0]))
            name = effect.instances.items[owner].name if owner >= 0 else ""
            pairs = _near((cause.rows.time_ns[ours[rows]], times), about, back=back)
            if len(pairs[0]):
                yield pairs, name, f"{who >> 32}:{who & 0xFFFFFFFF}"

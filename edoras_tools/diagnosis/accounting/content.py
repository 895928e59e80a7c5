"""Compare the values that come out of cFS with those that went in.

In: the hops of the case. Out: a ``WayContent`` for each way out on which other values came out, with the
messages that these may stand for: ``commands`` takes these for no loss at a pipe.

The public EDORAS applications send on the values that they receive, unchanged. So a message that comes out
and matches none that went in is one of these:

1. *again*: its value was sent before. It is older than another message that arrived; or three others were
   sent meanwhile; or it is the same datagram once more. A message behind a later one is older than that one,
   too.
2. *changed*: it stands for a message that did not come out: the latest one sent before it, between the same
   two messages that did come out.
3. *constant*: several came out with one value, though different values went in.
4. A capture that missed messages going in looks the same, but then no message that went in is left over. So
   every such message must stand for one that did not come out, and they must be more than chance and the
   quality of the capture explain.
5. If nothing that reaches a robot was sent, all of it has changed, provided that it is as long as a command.
6. *late*: it took longer than CI's socket and the rounds on its way explain.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import msgspec
import numpy as np

from edoras_tools.diagnosis.evidence.fingerprint import brackets, latest_equal
from edoras_tools.diagnosis.evidence.timeline.table import NOT_RUNNING
from edoras_tools.diagnosis.quality import binomial_tail, overlapping
from edoras_tools.links import CFS_PORT
from edoras_tools.model import Finding
from edoras_tools.units import SECOND
from edoras_tools.wire.arrays import MIX, Integers, Mask, Places, by_key

if TYPE_CHECKING:
    from collections.abc import Sequence

    from edoras_tools.diagnosis.case import Case
    from edoras_tools.diagnosis.evidence.table import Rows
    from edoras_tools.diagnosis.matching.crossing import Hop
    from edoras_tools.diagnosis.matching.streams import Stream

_ENCAPSULATION: Final = 4
_LEAST: Final = 3
"""This many others must be sent meanwhile, or arrive, before a value is called old, or all values wrong."""
_BY_CHANCE: Final = 0.0001
_SHARES: Final = tuple(2.0**-power for power in range(1, 14))
"""Shares of its frames that the capture may have missed."""
_OFTEN: Final = 1.5
"""A message is left over more often than on average where a round ends."""
_SELDOM: Final = 0.02
_DRAINS_NS: Final = 12 * SECOND
"""The backlog of CI's socket at the begin of the capture has come out after this time."""
_SLACK_NS: Final = SECOND
_LACKING: Final = 0.02
"""A capture that missed more than this share of its frames does not show which messages waited."""


class WayContent(msgspec.Struct, frozen=True):
    """Messages that came out with other values than were sent, on one way out of cFS.

    Attributes:
        into: stream that went in.
        out: stream that came out.
        of: number of messages that came out and whose values can be compared.
        changed: rows of the table with a value that was never sent.
        constant: rows of the table with a value that was never sent and is always the same.
        again: rows of the table with an old value.
        late: rows of the table with a value that was sent once and took too long.
        rounds_ns: longest time that a message usually takes.
        longest_ns: longest time that an old or late message took.
        replaced: streams of each hop to the messages that others may stand for, as indices into its ``into``,
            and a mask of those of which that is sure.
    """

    into: Stream
    out: Stream
    of: int
    changed: Places
    constant: Places
    again: Places
    late: Places
    rounds_ns: int
    longest_ns: int
    replaced: dict[tuple[Stream, Stream], tuple[Places, Mask]] = msgspec.field(default_factory=dict)


def judge_contents(case: Case) -> list[WayContent]:
    """Return all ways out on which other values came out than were sent."""
    ways = by_key((hop for hop in case.hops if hop.rewritten), lambda hop: hop.out.way)
    every = [_judge(case, hops) for hops in ways.values()]
    every += [_none_sent(case, robot) for robot in case.robots if robot.way not in ways]
    return [item for item in every if item is not None]


def _judge(case: Case, hops: Sequence[Hop]) -> WayContent | None:
    """Judge a way out on which at least one message came out as it was sent."""
    rows, robot = case.rows, hops[0].out.link.last_hop
    out = np.unique(np.concatenate([hop.out.rows for hop in hops]))
    out = out[rows.claimed[out] == 0]  # an envelope with a wrong length has a rule of its own
    if rows.has(Finding.CAPTURE_CUT, np.concatenate((out, *(hop.into.rows for hop in hops)))).any():
        return None  # others may have the same values as far as they are here
    when, sent_ns = rows.time_ns[out], np.full(len(out), -1)
    late, inverted = np.zeros((2, len(out)), bool)
    for hop in hops:
        came = hop.out.rows[hop.out_rows]
        place, whole = np.searchsorted(out, came), np.isin(came, out)
        place = place[whole]
        sent_ns[place] = rows.time_ns[hop.into.rows[hop.in_rows[whole]]]
        sole = hop.sole[hop.out_rows[whole]]
        inverted[place] = sole & (sent_ns[place] < np.maximum.accumulate(sent_ns[place]))
        late[place] = sole & (when[place] > _expected(case, hop)[hop.in_rows[whole]])
    stops = [(span.start_lo, span.end_hi) for span in case.timeline.every(*NOT_RUNNING)]
    late &= ~inverted & ~case.overlaps_outage(sent_ns, when) & ~overlapping(sent_ns, when, stops)
    others = not robot and 2 * late.sum() > (sent_ns >= 0).sum()
    if others or case.quality.best[1] > _LACKING * case.quality.best[0]:
        late[:] = False  # other messages had the same values, or the queue before them was not captured
    odd = (sent_ns < 0) & (when > case.start_ns + _rounds(case, hops[0])) & ~_older(sent_ns, when)
    last_ns = _sent_before(rows, [hop.into for hop in hops], out, robot=robot)
    # A datagram that came out before:
    number, at_ns = rows.identification[out].astype(np.uint64), rows.time_ns[out]
    prints = np.where(number != 0, rows.bytes_print[out] ^ number * MIX, np.uint64(0))
    copy = odd & (latest_equal(prints, at_ns + 1, prints, at_ns) >= 0)
    old = odd & (last_ns >= 0) & (copy | _old(case, hops, out, sent_ns, last_ns))
    replaced, changed = _replaced(case, hops, out, odd & (last_ns < 0), odd & old & ~copy)
    again = out[old | inverted]
    if not (len(again) or any(len(places) for places, _ in replaced.values()) or late.any()):
        return None
    took = np.where(inverted | late, when - sent_ns, when - last_ns)
    return WayContent(
        hops[0].into,
        hops[0].out,
        len(out),
        *_same(rows, changed),
        again,
        out[late],
        _rounds(case, hops[0]),
        int(took[old | inverted | late].max(initial=0)),
        replaced,
    )


def _older(sent_ns: Integers, when: Integers) -> Mask:
    """Return which messages are of the backlog at the begin of the capture: a mask (n,)."""
    sent = np.flatnonzero(sent_ns >= 0)
    waited = len(sent) > 0 and when[sent[0]] - sent_ns[sent[0]] > _SLACK_NS
    return (np.arange(len(when)) < sent[0]) if waited else np.zeros(len(when), bool)


def _none_sent(case: Case, robot: Stream) -> WayContent | None:
    """Judge datagrams to a robot none of which was sent: all are wrong if they are as long as a command."""
    rows = case.rows
    length = int(np.median(rows.length[robot.rows]))
    into = [
        stream
        for stream in case.streams
        if stream.link.only_to_cfs
        and stream.is_command
        and int(np.median(rows.cdr_length[stream.rows])) - _ENCAPSULATION == length
    ]
    if not into or case.endpoints[robot.sender].port != CFS_PORT:
        return None
    went_ns = np.sort(np.concatenate([stream.time_ns for stream in into]))
    step_ns = int(np.median(np.diff(went_ns))) if len(went_ns) > 1 else SECOND
    # If commands were being sent when the capture began, older ones come out first.
    already = int(went_ns[0]) - case.start_ns <= 2 * step_ns
    own = robot.rows[robot.time_ns > went_ns[0] + already * _DRAINS_NS]
    own = own[np.arange(1, len(own) + 1) <= np.searchsorted(went_ns, rows.time_ns[own])]
    own_values = len(np.unique(rows.body_print[into[0].rows]))
    if min(len(own), own_values) < _LEAST or (_sent_before(rows, into, own, robot=True) >= 0).any():
        return None
    return WayContent(into[0], robot, len(own), *_same(rows, own), own[:0], own[:0], 0, 0)


def _same(rows: Rows, changed: Places) -> tuple[Places, Places]:
    """Divide changed rows into those with different values and those with one value."""
    _, which, count = np.unique(rows.body_print[changed], return_inverse=True, return_counts=True)
    same = count[which] > 1
    return changed[~same], changed[same]


_KINDS: Final = "body_print", "value_print", "stamped_print", "shared_print"


def _sent_before(rows: Rows, into: Sequence[Stream], out: Places, *, robot: bool) -> Integers:
    """Return when the value of each row that came out was last sent: i64 (n,), -1 if never."""
    last_ns = np.full(len(out), -1)
    for stream in into:
        for kind in _KINDS if robot else _KINDS[:1]:
            prints = getattr(rows, kind)
            at = latest_equal(prints[stream.rows], stream.time_ns, prints[out], rows.time_ns[out])
            some = np.flatnonzero(at >= 0)
            last_ns[some] = np.maximum(last_ns[some], rows.time_ns[stream.rows[at[some]]])
    return last_ns


def _old(case: Case, hops: Sequence[Hop], out: Places, sent_ns: Integers, last_ns: Integers) -> Mask:
    """Return which messages are older than others that came or were due; and all of a frequent value."""
    when = case.rows.time_ns[out]
    newest = np.maximum.accumulate(np.append(-1, sent_ns))[:-1]
    went_ns = np.sort(np.concatenate([hop.into.time_ns for hop in hops]))
    due, last = np.searchsorted(went_ns, (when - _rounds(case, hops[0]), last_ns + 1))
    old = (newest > last_ns) | (due - last >= _LEAST)
    body = case.rows.body_print[out]
    values, number = np.unique(body[old & (sent_ns < 0)], return_counts=True)
    return np.asarray(old | np.isin(body, values[number >= _LEAST]))


def _replaced(
    case: Case, hops: Sequence[Hop], out: Places, odd: Mask, old: Mask
) -> tuple[dict[tuple[Stream, Stream], tuple[Places, Mask]], Places]:
    """Pair messages that did not come out with others that came out in their place.

    Args:
        case: the capture.
        hops: hops of one way out.
        out: rows that came out.
        odd: mask of ``out``: values that were never sent.
        old: mask of ``out``: values that were sent, and are old.

    Returns:
        ``WayContent.replaced``, and the rows that have changed.
    """
    rows, rest, chance = case.rows, out[odd | old], 0.0
    pairs: dict[tuple[Stream, Stream], tuple[Places, Places]] = {}
    for hop in hops:
        absent = np.flatnonzero((hop.known | (rows.claimed[hop.into.rows] != 0)) & ~hop.arrived)
        own = np.intersect1d(rest, hop.out.rows[hop.origin < 0])
        into, came = np.sort(hop.in_rows), hop.out.rows[hop.out_rows]
        between = np.concatenate((np.searchsorted(into, absent), np.searchsorted(came, own)))
        when = np.concatenate((hop.into.time_ns[absent], rows.time_ns[own]))
        side = np.repeat([0, 1], [len(absent), len(own)])
        order = np.lexsort((side, when, between))
        opening, closing = brackets(between[order], side[order] == 0)
        pairs[hop.into, hop.out] = absent[order[opening]], own[order[closing] - len(absent)]
        rest = np.setdiff1d(rest, pairs[hop.into, hop.out][1])
        chance = max(chance, float((np.diff(into) > 1).mean()) if len(into) > 1 else 0.0)
    first = min(int(hop.out.rows[hop.out_rows[0]]) for hop in hops)
    changed = np.setdiff1d(out[odd], rest)
    unpaired = np.intersect1d(out[odd], rest)
    if (unpaired > first).any() or not _believed(case, len(changed), len(out), chance):
        changed = changed[:0]
    stands = np.union1d(changed, out[old])
    # Nothing shows the values of a command that the capture cut off.
    cut = [pairs[hop.into, hop.out][1][~hop.known[pairs[hop.into, hop.out][0]]] for hop in hops]
    changed = np.setdiff1d(changed, np.concatenate(cut))
    return {key: (places, np.isin(own, stands)) for key, (places, own) in pairs.items()}, changed


def _believed(case: Case, number: int, of: int, chance: float) -> bool:
    """Return whether so many changed values are more than chance and missed frames explain.

    Args:
        case: the capture.
        number: number of changed values.
        of: number of messages that came out.
        chance: share of places where a message is left over anyway.
    """
    if number < _LEAST:
        return False
    beside = [item for (_, kind), item in case.quality.sums.items() if kind != "inputs"]
    missed = max(
        (1 - binomial_tail(number - 1, of, share))
        * min((binomial_tail(missing, checked, share) for checked, missing in beside), default=1.0)
        for share in _SHARES
    )
    alike = min(1.0, max(_OFTEN * chance, _SELDOM)) ** number
    return case.quality.known_zero or alike * missed < _BY_CHANCE


def _rounds(case: Case, hop: Hop) -> int:
    """Return how long a message may wait for the rounds on its way through cFS, ns."""
    profile = case.profile
    waits = [profile.ci_wake_ns if hop.into.link.only_to_cfs else profile.sbn_wake_ns * profile.sbn_polls]
    if not hop.out.link.last_hop:
        # An application is woken once in a second at least.
        waits += [profile.to_wake_ns if hop.out.link.only_from_cfs else profile.sbn_wake_ns, SECOND]
    return sum(waits)


def _expected(case: Case, hop: Hop) -> Integers:
    """Return the latest time at which each message should come out, behind CI's queue: i64, ns."""
    profile, every, waits_ns = case.profile, case.arriving(hop.into.receiver), _rounds(case, hop)
    own = np.searchsorted(every, hop.into.time_ns, "right") - 1
    step = profile.ci_wake_ns / profile.ci_datagrams_per_wake if hop.into.link.only_to_cfs else 0
    place, arrived, first = np.arange(len(every)) * step, every - every[0], hop.in_rows.argmin()
    # The first message to come out waited behind the backlog from before the capture.
    read_ns, head = hop.out.time_ns[hop.out_rows[first]] - waits_ns, own[hop.in_rows[first]]
    if hop.out_rows[first]:
        arrived[head] = max(arrived[head], read_ns - every[0])
    read = np.maximum.accumulate(arrived - place) + place
    return np.asarray(read[own].astype(np.int64) + every[0] + waits_ns + _SLACK_NS)

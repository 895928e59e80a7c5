"""Finds datagrams that the capture has twice: captured twice, doubled by the network, or sent twice.

A datagram keeps its IP identification and its bytes on its whole path, and a sender changes the
identification with each datagram. So:

1. Datagrams with equal bytes, endpoints and identification (not 0) within half a second are one datagram,
   unless the sender reuses one identification for many. It is a *copy*, made by the capture and counted once,
   if it was captured at two places (another link layer header, interface or time to live), or if four of five
   datagrams of the conversation are doubled. Else it is a *duplicate*, made by the network and received
   twice, unless rules 3 to 7 show the opposite; these are asked about the copies of one place, too.
2. If the identification is 0, which is allowed for datagrams that must not be fragmented, equal bytes are a
   copy only if captured at two places, or if the whole conversation comes in pairs: at least eight groups of
   equal datagrams within 5 ms, nearly all of exactly two. A burst of 50 equal datagrams is one group, and
   stays 50.

Two captures merged into one file hold most datagrams of all conversations twice, far apart if their clocks
differ. These are copies. A datagram that is there once reached only one of the two places, or the other
place missed it.

A receiver gets a duplicate of the network twice, and a copy of the capture once. So, in this order:

3. Between two of its samples, CI counted the datagrams with their duplicates, or without. The datagrams under
   way at a sample make this a range; the sample decides only if one of the two numbers is outside the range.
4. An application answers each command alike. Values that were sent once show how many messages one makes.
5. A decision about one receiver holds for the others: a capture doubles everything, and so may a network.
6. Two datagrams with equal capture times were doubled by the capture, because no interface receives two at
   once. Each counts half as much as one that rules 3 and 4 decide; without these rules it decides alone.
7. Else nothing decides. The second ones are left out, and for messages to cFS the ledger has them uncertain.

Damaged datagrams:

8. A datagram with a wrong checksum is no copy. The network damaged it, and the receiver's kernel drops it.
9. If the same datagram was captured whole before, by its identification, that one is lost. If its path was
   captured at two places, a damaged one without a whole one is left out.
10. If most checksums of a host are wrong, they prove nothing: its network card computes them.

If identifications do not help, the echoes of a steady sender, or several senders at once, explain why more
datagrams of a MsgId came than expected.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from edoras_tools.decode.conversations import conversation_of
from edoras_tools.diagnosis.evidence import fingerprint
from edoras_tools.io.frames.linklayer import network_headers
from edoras_tools.model import OTHER, Columns, Endpoint, PacketBatch, rate_hz
from edoras_tools.units import MILLISECOND, SECOND
from edoras_tools.wire.arrays import (
    MIX,
    by_value,
    distinct,
    gather,
    groups,
    numbered,
    of_bytes,
    perhaps_in,
    quantiles,
)

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

    from edoras_tools.diagnosis.evidence.payloads import Samples
    from edoras_tools.diagnosis.evidence.table import Rows
    from edoras_tools.wire.arrays import Integers, Mask, Places, Prints


_WITHIN_NS: Final = 20 * MILLISECOND
_LATER_NS: Final = 500 * MILLISECOND
_UNNUMBERED_NS: Final = 5 * MILLISECOND
_STEADY: Final = 0.8
_NEARLY_ALL: Final = 0.95
_MOSTLY: Final = 0.5
_LEAST_GROUPS: Final = 8
_LEAST_BYTES: Final = 16
_LEAST_PAIRS: Final = 20
_MOST_AGAIN: Final = 1.5
_WINDOW_BITS: Final = 20
"""Bits for the number of a half-second window: some days in one batch; later windows share a number."""
_NEVER_NS: Final = (1 << 63) - 1


class Copies(NamedTuple):
    """The datagrams that an equal one precedes, of n.

    Attributes:
        copy: bool (n,), captured twice: not to be counted.
        duplicate: bool (n,), there twice at one place: the network or the capture doubled it.
        steady: bool (n,), ``copy`` only because nearly all of its conversation is there twice at one place.
        at_once: bool (n,), captured at the same time as the equal one before it.
        alone: bool (n,), captured at only one of two places that are merged into one file.
        behind_ns: i64 (n,), if only the second place has it, by how much its clock is ahead; else 0.
    """

    copy: Mask
    duplicate: Mask
    steady: Mask
    at_once: Mask
    alone: Mask
    behind_ns: Integers


def find_copies(
    time_ns: Integers, identification: NDArray[np.uint16], conversation: Integers, tap: Prints, prints: Prints
) -> Copies:
    """Return which datagrams an equal one precedes (rules 1 and 2); the first of each is not marked.

    Args:
        time_ns: i64 (n,), capture times, in order.
        identification: u16 (n,), IPv4 identification; 0 if there is none.
        conversation: i64 (n,), number of the pair of endpoints.
        tap: u64 (n,), place of capture, as ``Rows.tap``.
        prints: u64 (n,), fingerprints of the datagrams.
    """
    count = len(time_ns)
    copy, duplicate, steadily, at_once, alone = np.zeros((5, count), bool)
    out = Copies(copy, duplicate, steadily, at_once, alone, np.zeros(count, np.int64))
    key = (prints ^ conversation.astype(np.uint64) * MIX) * MIX ^ identification
    ranked = np.sort(key)  # several times as fast as ordering all rows, most of which are unique
    several = np.flatnonzero(perhaps_in(key, ranked[1:][ranked[1:] == ranked[:-1]]))
    if not len(several):
        return out
    order = several[np.argsort(key[several], kind="stable")]
    key, when, has_id = key[order], time_ns[order], identification[order] != 0
    step = np.abs(np.diff(when))
    near = (key[1:] == key[:-1]) & (step <= np.where(has_id[1:], _WITHIN_NS, _UNNUMBERED_NS))
    same = np.concatenate(([False], (key[1:] == key[:-1]) & has_id[1:]))
    later = same[1:] & ~near & (step <= _LATER_NS)
    if later.any():
        near[later] = _varied(conversation, identification, order[1:][later])
    far = same & (np.append(0, step) > _WITHIN_NS)
    once = identification != 0
    once[order[same]] = False
    two_places = _of_most(conversation, order[same], np.flatnonzero(once))
    far &= two_places  # their clocks differ
    near |= far[1:]
    # A group is a run of equal datagrams, each near the one before it.
    group = np.concatenate(([0], np.cumsum(~near)))
    out.at_once[order[1:]] = near & (step == 0)
    elsewhere, repeated = np.zeros((2, count), bool)
    elsewhere[order[1:]] = near & (far[1:] | (tap[order][1:] != tap[order][:-1]))
    repeated[order[1:][near]] = True
    group_size = np.ones(count, np.int64)
    group_size[order] = np.bincount(group)[group]
    if two_places:
        # Before the first common datagram, and after the last, one place may not have captured yet.
        apart_ns = int(np.median(step[same[1:]]))
        pair = far if apart_ns > _WITHIN_NS else same
        inside = (time_ns > when[pair].min()) & (time_ns < when[np.append(pair[1:], False)].max())
        both = np.isin(conversation, np.unique(conversation[order[same]]))
        single = (group_size == 1) & (identification != 0) & both
        out.alone[:] = single & inside
        if apart_ns > _WITHIN_NS:
            at, place = np.flatnonzero(far[1:]), conversation.astype(np.int64) << 16 | identification
            pairs = order[at[np.argsort(place[order[at]])]]
            out.behind_ns[_at_second(time_ns, place, pairs, np.flatnonzero(single), apart_ns)] = apart_ns
    _tell_copies(out, conversation, identification != 0, repeated, elsewhere, group_size)
    return out


def _tell_copies(
    out: Copies, conversation: Integers, has_id: Mask, repeated: Mask, elsewhere: Mask, group_size: Integers
) -> None:
    """Mark the datagrams that an equal one precedes as copies, or as duplicates (rules 1 and 2).

    Args:
        out: their marks; set here.
        conversation: i64 (n,), number of the pair of endpoints.
        has_id: bool (n,), it has an IPv4 identification.
        repeated: bool (n,), an equal one precedes it.
        elsewhere: bool (n,), and that one was captured at another place.
        group_size: i64 (n,), number of datagrams that are equal to it, with itself.
    """
    bare, mostly = ~has_id, _NEARLY_ALL
    if _of_most(conversation, np.flatnonzero(repeated & bare), np.flatnonzero(bare & ~repeated)):
        mostly = _MOSTLY  # the capture doubles all datagrams that it does not miss
    own = np.flatnonzero(np.isin(conversation, distinct(conversation[repeated])))
    for _, rows in groups(conversation, own):
        steady = False
        for numbered_ones in (True, False):  # a counter of identifications also passes 0
            mine = rows[has_id[rows] == numbered_ones]
            twice = mine[repeated[mine]]
            if not len(twice):
                continue
            sizes = group_size[mine[~repeated[mine]]]
            share = float((sizes > 1).mean() if numbered_ones else (sizes == 2).mean())
            steady |= len(sizes) >= _LEAST_GROUPS and share >= (_STEADY if numbered_ones else mostly)
            copied = np.ones(len(twice), bool) if steady else elsewhere[twice]
            out.copy[twice[copied]] = True
            out.steady[twice[copied & ~elsewhere[twice] & numbered_ones]] = True
            out.duplicate[twice[~copied & numbered_ones]] = True


def _at_second(time_ns: Integers, place: Integers, pairs: Places, rows: Places, apart_ns: int) -> Places:
    """Return which rows of two places the second one captured, whose clock is ahead by ``apart_ns``.

    Neighbours in identification were sent at about the same time, so the nearer clock is a row's own. Before
    the first pair of a conversation, and behind its last, only one place captures: the row next to the pair
    shows which.

    Args:
        time_ns: i64 (n,), capture times.
        place: i64 (n,), conversation and identification.
        pairs: first rows of what both places have, in order of ``place``.
        rows: rows that one place has alone.
    """

    def own(time_ns: Any, near_ns: Any) -> Any:
        return np.abs(time_ns - near_ns - apart_ns) < np.abs(time_ns - near_ns)

    second = own(time_ns[rows], np.interp(place[rows], place[pairs], time_ns[pairs].astype(np.float64)))
    where, ends = np.searchsorted(place[pairs], place[rows]), np.append(place[pairs], -1) >> 16
    before, behind = (ends[where - side] == place[rows] >> 16 for side in (0, 1))
    for key, members in by_value(np.where(before ^ behind, 2 * where + behind, -1)):
        if key >= 0:
            pair = pairs[key // 2 - key % 2]
            first = members[np.argmin(np.abs(place[rows[members]] - place[pair]))]
            second[members] = own(time_ns[rows[first]], time_ns[pair])
    return rows[second]


def _varied(conversation: Integers, identification: NDArray[np.uint16], rows: Places) -> Mask:
    """Return which datagrams belong to a conversation with mostly different identifications: bool."""
    own = np.flatnonzero(np.isin(conversation, distinct(conversation[rows])))
    _, which = numbered(conversation[own])
    first, _ = numbered(which, identification[own])
    varied = 2 * np.bincount(which[first]) > np.bincount(which)
    return np.asarray(varied[which[np.searchsorted(own, rows)]])


def _of_most(conversation: Integers, twice: Places, first: Places) -> bool:
    """Return whether most datagrams of most conversations are there twice, as from two places of capture.

    Args:
        conversation: i64 (n,), conversation of each datagram.
        twice: datagrams that are equal to the one before.
        first: datagrams that are the first of equal ones.
    """
    if not max(_LEAST_PAIRS, 0.5 * len(first)) <= len(twice) <= _MOST_AGAIN * len(first):
        return False
    ways, every = (len(np.unique(conversation[rows])) for rows in (twice, first))
    return ways > 1 and 2 * ways >= every


class Once:
    """Finds copies in batch after batch.

    Attributes:
        copies: number of copies so far.
    """

    def __init__(self) -> None:
        self.copies = 0
        self._last: tuple[NDArray[Any], ...] = ()

    def keep(self, batch: PacketBatch, columns: Columns) -> Mask:
        """Return which datagrams of a batch count, bool (n,): all but copies; all of those without a link."""
        mask = np.ones(len(batch), bool)
        rows = np.flatnonzero(columns.link != OTHER)
        if len(rows) < len(batch):
            batch = batch.take(rows)
        network, identification, life = network_headers(batch)
        conversation = conversation_of(batch)
        short = _quick_key(batch, conversation, identification)
        base: tuple[NDArray[Any], ...] = batch.time_ns, identification, conversation

        def whole(some: Places | slice) -> tuple[NDArray[Any], ...]:
            """Return the arguments of ``find_copies`` for some datagrams, and their quick keys."""
            tap = fingerprint.of_tap(batch, network, some) + life[some]
            prints = of_bytes(batch.data, batch.offset[some], batch.length[some])
            return *(column[some] for column in base), tap, prints, short[some]

        last = self._last or whole(slice(0))
        if _perhaps_again(np.append(last[-1], short), np.append(last[0], batch.time_ns)):
            both = [np.concatenate(pair) for pair in zip(last, whole(slice(None)), strict=True)]
            copy = find_copies(*both[:-1]).copy[len(last[0]) :]
            mask[rows[copy]] = False
            self.copies += int(copy.sum())
        self._last = whole(np.flatnonzero(batch.time_ns > batch.time_ns.max(initial=0) - _LATER_NS))
        return mask

    def notes(self) -> list[str]:
        """Return one line for people if there were copies, else none."""
        return [f"{self.copies:,} datagrams were captured twice, and are counted once"] * bool(self.copies)


class Repeats:
    """Checks batch after batch quickly for equal datagrams near each other.

    Attributes:
        possible: whether two datagrams so far may be equal.
    """

    def __init__(self) -> None:
        self.possible = False
        self._last = np.zeros(0, np.uint64), np.zeros(0, np.int64)

    def add(self, batch: PacketBatch, some: Places) -> None:
        """Compare some datagrams of a batch with each other and with the end of the batch before."""
        late = np.flatnonzero(batch.time_ns > batch.time_ns.max(initial=0) - _LATER_NS)
        both = batch.take(some), batch.take(late)
        own, newest = (_quick_key(rows, conversation_of(rows), network_headers(rows)[1]) for rows in both)
        glances = np.append(self._last[0], own)
        self.possible |= _perhaps_again(glances, np.append(self._last[1], both[0].time_ns))
        self._last = newest, both[1].time_ns


def _quick_key(batch: PacketBatch, conversation: Integers, identification: NDArray[np.uint16]) -> Prints:
    """Return a quick key of each datagram, u64 (n,), equal for equal ones: headers, without id some bytes."""
    number = batch.length.astype(np.uint64) << np.uint64(16) | identification
    number ^= conversation.astype(np.uint64) * MIX
    rows = np.flatnonzero((identification == 0) & (batch.length >= _LEAST_BYTES))
    offset, length = batch.offset[rows], batch.length[rows]
    early, late = (gather(batch.data, at, 8).view("u8")[:, 0] for at in (offset + 8, offset + length - 8))
    total = early * MIX ^ late
    number[rows] ^= (total ^ total >> np.uint64(29)) * MIX
    return number


def _perhaps_again(number: Prints, time_ns: Integers) -> bool:
    """Return whether two datagrams within half a second have equal quick keys."""
    window = time_ns // _LATER_NS  # two within half a second are in one window, or in neighbours
    window -= window.min(initial=_NEVER_NS)
    most = (1 << _WINDOW_BITS) - 1
    ranked = np.sort(number * MIX & ~np.uint64(most) | np.minimum(window, most).astype(np.uint64))
    return bool((ranked[1:] - ranked[:-1] <= 1).any())


_SELDOM: Final = 1 / 3
"""If a larger share of a host's checksums is wrong, its network card computes them."""
_MANY: Final = 8
"""With fewer datagrams of a host, the share of the whole capture is used."""
_TWICE: Final = 0.3
"""If this share of a conversation's datagrams are copies, it was captured at two places."""


def find_damaged(rows: Rows, hosts: NDArray[np.int32], *, shared: bool = False) -> tuple[Mask, Places]:
    """Return the rows that nobody received because of wrong checksums, and one row for each lost datagram.

    Args:
        rows: table of datagrams, in order of time.
        hosts: i32, number of the address of each endpoint.
        shared: whether datagrams that two captures have stand here only once.

    Returns:
        bool (rows,), not received; intp, rows that stand for the lost datagrams.
    """
    lost, none = rows.undelivered.copy(), np.zeros(0, np.intp)
    if lost.any():
        host = hosts.take(rows.source)
        number, wrong = np.bincount(host), np.bincount(host[lost], minlength=int(host.max()) + 1)
        lost &= np.where(number < _MANY, lost.mean(), wrong / np.maximum(number, 1))[host] <= _SELDOM
    if not lost.any():
        return lost, none
    way, standing = rows.way(), []
    shared |= _is_taken_twice(rows, way, np.flatnonzero(~lost))
    # A datagram is recognised by its IP identification, or without one by its sequence count.
    packet = rows.msg_id.astype(np.int64) << 16 | rows.sequence_count
    packet = np.where((rows.identification == 0) & rows.counted, packet, -1)
    alike = rows.length.astype(np.uint64) << np.uint64(16) | rows.identification
    alike ^= packet.astype(np.uint64) * MIX
    near = np.flatnonzero(perhaps_in(alike, alike[lost]) & ((rows.identification != 0) | (packet >= 0)))
    key = np.full(len(rows), -1)
    key[near] = numbered(rows.link[near], alike[near])[1]
    of_key = dict(by_value(np.where(np.isin(key, key[lost]) & ~lost, key, -1)))
    before: set[tuple[int, int]] = set()
    for row in np.flatnonzero(lost).tolist():
        again = int(key[row]), int(rows.bytes_print[row])
        if again[0] >= 0 and again in before:
            continue
        before.add(again)
        same = of_key.get(again[0], none) if again[0] >= 0 else none
        same = same[np.abs(rows.time_ns[same] - rows.time_ns[row]) <= SECOND]
        # Behind an address translation the endpoints differ.
        same = same[(way[same] == way[row]) | (shared & (rows.msg_id[same] == rows.msg_id[row]))]
        if not len(same):
            standing += [row] * (not shared)
        # If a whole one is at the same place, the network had doubled it, and it arrived.
        elif int((rows.tap[same] == rows.tap[row]).sum()) <= shared:
            standing.append(int(same[0]))
            lost[same] = True
    return lost, np.unique(np.array(standing, np.intp))


def _is_taken_twice(rows: Rows, way: Integers, whole: Places) -> bool:
    taps = rows.identification[whole], way[whole], rows.tap[whole], rows.bytes_print[whole]
    copy = find_copies(rows.time_ns[whole], *taps).copy
    _, which = numbered(way[whole])
    return bool((np.bincount(which, copy) >= _TWICE * np.bincount(which)).any())


BY_CAPTURE: Final = 1
BY_NETWORK: Final = 2
_READ_NS: Final = 2500 * MILLISECOND
"""Longest time from a datagram to the sample that counts it."""


def who_doubled(
    rows: Rows, copies: Copies, samples: Samples, sources: NDArray[np.int32], endpoints: Sequence[Endpoint]
) -> NDArray[np.int8]:
    """Return who doubled each row (rules 3 to 6): i8 (rows,), ``BY_CAPTURE``, ``BY_NETWORK`` or 0.

    0 means that the row is no duplicate, or that nothing decides.

    Args:
        rows: table of datagrams, in order of time.
        copies: result of ``find_copies`` for these rows.
        samples: samples of CI's counts.
        sources: i32, endpoint that sent each sample.
        endpoints: endpoints that the rows index.
    """
    out = np.zeros(len(rows), np.int8)
    to_cfs = rows.on(lambda link: link.to_cfs and link.packets)
    once = ~copies.copy
    alone = once & ~copies.duplicate
    answers = np.flatnonzero(alone & rows.on(lambda link: link.from_cfs))
    others = np.flatnonzero(alone & rows.on(lambda link: link.only_to_cfs))
    votes: dict[int, int] = {}
    for receiver in distinct(rows.destination[copies.duplicate & to_cfs]).tolist():
        mine = np.flatnonzero(once & to_cfs & (rows.destination == receiver))
        own = copies.duplicate[mine]
        vote = 0
        for track in _tracks(rows, receiver, samples, sources, endpoints):
            vote += _by_counts(rows.time_ns[mine], own, *track)
        if vote >= 0:  # CI also counts datagrams that the capture missed
            # SBN carries both ways, so what came in is no answer.
            vote = min(vote, int(own.sum()))
            vote += _by_answers(rows, mine, own, np.setdiff1d(answers, mine, assume_unique=True), others)
        # A few votes may be chance. SBN's own messages lead to no other, so they have none.
        voters = own & ((rows.body_print[mine] != 0) | rows.on(lambda link: link.only_to_cfs, mine))
        vote *= not 0 < vote <= max(2, voters.sum() // 2)
        votes[receiver] = 2 * vote - int(copies.at_once[mine[own]].sum()) if vote else 0
    whole = sum(votes.values())
    for receiver, members in by_value(np.where(copies.duplicate, rows.destination, -1)):
        own_vote = votes.get(receiver, 0)
        if receiver >= 0 and (vote := own_vote or whole):
            # What is doubled steadily says nothing of what others get.
            mine = members if own_vote else members[~copies.steady[members]]
            out[mine] = BY_NETWORK if vote > 0 else BY_CAPTURE
            together = copies.at_once[mine]
            if 2 * together.sum() < len(mine):
                out[mine[together]] = BY_CAPTURE
    out[copies.duplicate & (out == 0) & copies.at_once] = BY_CAPTURE
    return out


def _tracks(
    rows: Rows, receiver: int, samples: Samples, sources: NDArray[np.int32], endpoints: Sequence[Endpoint]
) -> Iterator[tuple[Integers, Integers]]:
    """Yield times, ns, and counts of each CI at the address of a receiver, if that only takes commands."""
    address = endpoints[receiver].address
    if not rows.on(lambda link: link.only_to_cfs, rows.destination == receiver).all():
        return
    for source, members in by_value(sources):
        if endpoints[source].address == address:
            yield samples["time_ns"][members], (samples["packets"] + samples["errors"])[members]


def _by_counts(sent_ns: Integers, again: Mask, seen_ns: Integers, total: Integers) -> int:
    """Return how many duplicates CI counted twice, minus those that it counted once (rule 3).

    Args:
        sent_ns: i64 (n,), time of each datagram, in order.
        again: bool (n,), the datagram is a duplicate.
        seen_ns: i64, capture time of each sample.
        total: i64, count of CI at each sample.
    """
    vote, step, lacking, longest = 0, 1, False, len(seen_ns) - 1
    early, late = (np.searchsorted(sent_ns, seen_ns - slack) for slack in (_READ_NS, 0))
    twice = np.concatenate(([0], np.cumsum(again)))
    while step <= longest:
        first, last = np.arange(0, len(seen_ns) - step, step), np.arange(step, len(seen_ns), step)
        growth = total[last] - total[first]
        least, most = (early[last], late[first]), (late[last], early[first])
        fits = [
            (growth >= np.maximum(low, 0)) & (growth <= high)
            for low, high in (
                tuple(end - begin - less * (twice[end] - twice[begin]) for end, begin in (least, most))
                for less in (0, 1)
            )
        ]
        number = twice[late[last]] - twice[late[first]]
        # Datagrams that still wait in CI's socket would look like a surplus.
        caught_up = total[first] - total[0] >= early[first] - late[0]
        lacking |= bool((growth > most[0] - most[1])[(number == 0) & caught_up].any())
        vote += int(number[fits[0] & ~fits[1]].sum()) - int(number[fits[1] & ~fits[0]].sum())
        step = longest if step < longest < 2 * step else 2 * step
    return min(vote, 0) if lacking else vote  # CI also counts datagrams that the capture missed


def _by_answers(rows: Rows, mine: Places, again: Mask, answers: Places, others: Places) -> int:
    """Return how many duplicates led to two messages out of cFS, minus those that led to one (rule 4).

    What was lost behind the application says nothing: the others stand for it.

    Args:
        rows: table of datagrams.
        mine: rows that went into cFS.
        again: bool, whether each of these is a duplicate.
        answers: rows that came out, without duplicates.
        others: rows without duplicates to other receivers, for where each of ``mine`` is there twice.
    """
    went = np.sort(rows.body_print[answers])

    def numbers_of(own: Places) -> tuple[Prints, Places, Places]:
        values, came = np.unique(rows.body_print[own], return_counts=True)
        number = np.searchsorted(went, values, "right") - np.searchsorted(went, values)
        return values, came, number * (values != 0)

    values, came, number = numbers_of(mine)
    doubled = np.isin(values, rows.body_print[mine[again]])
    alone = number[(came == 1) & ~doubled & (number > 0)]
    if not len(alone):
        _, single, alone = numbers_of(others)
        alone = alone[(single == 1) & (alone > 0)]
    usual = int(np.median(alone)) if len(alone) else 0  # a message may leave on several links
    if 10 * (alone == 2 * usual).sum() > len(alone):
        return 0  # the application itself repeats messages
    twice = number[(came == 2) & doubled]
    both, one = (int((twice == times * usual).sum()) for times in (2, 1))
    return (both - one) * len(twice) // (both + one) if usual and both + one else 0


_LEAST_ECHOES: Final = 3
_LEAST_SHARE: Final = 0.1
_ECHO: Final = 0.4
"""A copy follows within this share of the usual time from one message to the next."""
_ECHO_SHARE: Final = 0.02
_AT_USUAL: Final = 0.6
"""This share of the other messages comes at that usual time, give or take a third."""


def crowding(rows: Rows, own: Places, endpoints: Sequence[Endpoint]) -> str:
    """Return half a sentence that explains too many datagrams; empty if nothing does.

    Args:
        rows: table of datagrams.
        own: rows of one MsgId to one receiver, in order of time.
        endpoints: endpoints that the rows index.
    """
    if times := senders_at_once(rows, own):
        rates = {source: rate_hz(len(at), int(at[-1] - at[0])) for source, at in times.items()}
        each = ", ".join(f"{endpoints[source]} at {hz:.1f} Hz" for source, hz in rates.items())
        return f"{len(times)} senders sent it at once ({each})"
    return _echoes(rows, own)


def senders_at_once(rows: Rows, own: Places) -> dict[int, Integers]:
    """Return endpoint to send times, ns, of several senders that sent at the same time; empty if none did."""
    sources, counts = np.unique(rows.source[own], return_counts=True)
    least = max(_LEAST_ECHOES, _LEAST_SHARE * len(own))
    times = {
        int(source): rows.time_ns[own[rows.source[own] == source]]
        for source, count in zip(sources, counts, strict=True)
        if count >= least
    }
    if len(times) < 2:
        return {}
    start_ns, end_ns = max(at[0] for at in times.values()), min(at[-1] for at in times.values())
    if any(2 * int(((at >= start_ns) & (at <= end_ns)).sum()) < len(at) for at in times.values()):
        return {}
    return times


def find_echoes(rows: Rows, own: Places) -> Mask:
    """Return which datagrams of a steady sender are copies, bool (n,): they follow an equal one shortly.

    The delay of copies is nearly constant, and the other datagrams have a steady period, which a burst does
    not have. Datagrams of a second sender are no copies.

    Args:
        rows: table of datagrams.
        own: n rows of one MsgId to one receiver, in order of time.
    """
    times, prints = rows.time_ns[own], rows.bytes_print[own]
    steps, none, sources = np.diff(times), np.zeros(len(own), bool), rows.source[own]
    echo = (prints[1:] == prints[:-1]) & (sources[1:] == sources[:-1])
    if len(steps) < 2 * _LEAST_ECHOES or np.count_nonzero(echo) < _LEAST_ECHOES:
        return none
    usual = _usual(steps)
    echo &= steps < _ECHO * usual
    if np.count_nonzero(echo) < max(_LEAST_ECHOES, _ECHO_SHARE * len(own)):
        return none
    first, median, third = quantiles(steps[echo], 0.25, 0.5, 0.75)
    steady = np.abs(np.diff(times[np.concatenate(([True], ~echo))]) - usual) < usual / 3
    if third - first > max(median / 3, 5 * MILLISECOND) or steady.mean() < _AT_USUAL:
        return none
    return np.concatenate(([False], echo))


def _echoes(rows: Rows, own: Places) -> str:
    """Return half a sentence about copies; empty if there are none."""
    echo, steps = find_echoes(rows, own), np.diff(rows.time_ns[own])
    if not echo.any():
        return ""
    late_ms = np.median(steps[echo[1:]]) / MILLISECOND
    numbered = np.diff(rows.identification[own].astype(np.int64))[echo[1:]]
    return (
        f"{int(echo.sum()):,} of {len(own):,} datagrams are copies that came {late_ms:.0f} ms after an equal "
        f"one, the others at {SECOND / _usual(steps):.1f} Hz, so "
        f"{'their sender or a relay' if numbered.all() else 'the network or a relay'} doubles them"
    )


def _usual(steps: Integers) -> float:
    """Return the usual time from one message to the next: the 75 % quantile of the steps, ns."""
    return quantiles(steps, 0.75)[0]

"""Matches messages on two links: which ones crossed cFS, how long they took, and which never came out.

In: streams, with the fingerprints of their rows. Out: a ``Hop`` for each pair of streams in and out of cFS.

Rules:

1. A packet that cFS only forwards has the same bytes on both links.
2. A message that an application reads and sends on has another MsgId and the same body.
3. Values are compared, with the mission's types, only if no bodies are equal. So a result from bytes does not
   depend on the mission. Of bodies that the capture cut, the first bytes are compared.
4. Each stream that comes out has one MsgId that goes in: the one with most equal fingerprints. Only a robot
   may get messages of several MsgIds.
5. A message that came out is matched with the latest equal message that went in before it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final, NamedTuple, Protocol

import msgspec
import numpy as np
from msgspec.structs import replace

from edoras_tools.diagnosis.evidence.fingerprint import paired
from edoras_tools.diagnosis.evidence.instances import NOBODY
from edoras_tools.model import Finding
from edoras_tools.units import MILLISECOND, SECOND
from edoras_tools.wire.arrays import MIX, distinct, numbered, perhaps_in, quantiles

if TYPE_CHECKING:
    from collections.abc import Callable, Hashable, Iterator, Sequence

    from numpy.typing import NDArray

    from edoras_tools.diagnosis.evidence.table import Rows
    from edoras_tools.diagnosis.matching.streams import Stream
    from edoras_tools.wire.arrays import Integers, Mask, Places, Prints

_LONGEST_NS: Final = 120 * SECOND
"""Longest time under way: CI reads a full socket within a minute and a half."""
_EARLY_NS: Final = 20 * MILLISECOND
"""Largest error between two capture times: a message may seem to come out this much before it went in."""
_ALIKE: Final = 0.5
_LEAST_DIFFERENT: Final = 3
_NEARLY_ALL: Final = 0.9
_BODIES: Final = "body_print", "body_print"
_VALUES: Final = "value_print", "value_print"
_TO_ROBOT: Final = _BODIES, _VALUES, ("value_print", "stamped_print"), ("shared_print", "shared_print")
"""Fingerprints (in, out) for a robot: it gets the body of a message, its values, or a struct of its own."""
_HEADS: Final = "head_print", "head_print"
_REWRITTEN: Final = _BODIES, ("stamped_print", "stamped_print"), _VALUES, _HEADS
"""Fingerprints (in, out) for streams of different MsgIds."""
_TIED: Final = 8
"""Largest number of equally likely streams in, for one stream out."""
_COUNT: Final = "count"
_OF_PACKETS: Final = ("packet_print", "packet_print"), (_COUNT, _COUNT)
"""Fingerprints (in, out) for streams of one MsgId: whole packets, or counts if the capture cut packets."""
_COMPARED: Final = (*_REWRITTEN, *_TO_ROBOT[2:], *_OF_PACKETS)
"""All pairs of fingerprints, the strictest first: ``_BODIES`` before any other."""
_PAIRS: Final = 1 << 20
"""Largest number of pairs that are compared at once, which bounds the memory."""


class Latency(msgspec.Struct, frozen=True):
    """Delays of messages: their number, 50 % and 99 % quantiles and maximum, in ms."""

    count: int
    p50: float
    p99: float
    most: float

    def as_json(self) -> dict[str, Any]:
        """Return it in the shape of ``doctor --json``."""
        return {"count": self.count, "p50_ms": self.p50, "p99_ms": self.p99, "max_ms": self.most}


class Hop(NamedTuple):
    """A pair of streams: messages of the first left cFS as messages of the second.

    Attributes:
        into: stream into cFS.
        out: stream out of cFS, or to a robot.
        rewritten: whether an application made new messages of them; else the packets are the same.
        prints: u64 (rows of ``into``,), fingerprint that was searched for; 0 if the row has none.
        arrived: bool (rows of ``into``,), the message came out.
        perhaps: bool (rows of ``into``,), it did not, but an equal message came out that has no origin.
        single: bool (rows of ``into`` with a fingerprint,), no other row of ``into`` has this fingerprint.
        origin: i64 (rows of ``out``,), index of the matched row of ``into``; -1 without one.
        sole: bool (rows of ``out``,), the fingerprint comes out once, and goes in at most once.
        again: u8 (rows of ``out``,), 0 but for one without a match where an equal one that was matched came
            out: 1 directly behind an equal one, 2 behind others, as late copies do.
        delays_ns: i64, the delay of each message that came out and whose fingerprint goes in once.
        out_ns: i64, the time at which each of these came out.
        last_ns: longest delay of all that came out.
        in_rows: intp, messages that came out, as indices into the rows of ``into``.
        out_rows: intp, the matched row of ``out`` for each of ``in_rows``, ascending.
    """

    into: Stream
    out: Stream
    rewritten: bool
    prints: Prints
    arrived: Mask
    perhaps: Mask
    single: Mask
    origin: Places
    sole: Mask
    again: NDArray[np.uint8]
    delays_ns: Integers
    out_ns: Integers
    last_ns: int
    in_rows: Places
    out_rows: Places

    @property
    def known(self) -> Mask:
        """The messages with a fingerprint, which alone can be matched: bool (rows of ``into``,)."""
        return np.asarray(self.prints != 0)

    @property
    def is_copy(self) -> bool:
        """Whether the second stream is only a copy: Telemetry Output also sends the commands themselves."""
        return self.into.is_command and not self.rewritten and self.out.link.only_from_cfs

    @property
    def of(self) -> int:
        """Number of messages that went in and have a fingerprint."""
        return int(self.known.sum())

    @property
    def matched(self) -> int:
        """Number of messages that came out."""
        return int(self.arrived.sum())

    @property
    def first(self) -> tuple[int, int]:
        """Times of the first message: when it came out, and when it went in, ns since 1970."""
        return int(self.out.time_ns[self.out_rows[0]]), int(self.into.time_ns[self.in_rows[0]])

    @property
    def latency(self) -> Latency | None:
        """The delays in ``delays_ns`` as figures; None without any."""
        return latency_of(self.delays_ns)

    @property
    def absent(self) -> Mask:
        """The messages with a fingerprint that did not come out: bool (rows of ``into``,)."""
        return self.known & ~self.arrived


class Crossing(Protocol):
    """Knows which streams may leave cFS as which others.

    Attributes:
        unsteady_ns: random error of the capture times, ns.
    """

    unsteady_ns: int

    def arrival(self, stream: Stream) -> Hashable:
        """Return a key of a stream in; equal keys give equal answers of ``follows``; None if none follows."""

    def departure(self, stream: Stream) -> Hashable:
        """Return a key of a stream out; equal keys give equal answers of ``follows``."""

    def follows(self, into: Stream, out: Stream) -> bool:
        """Return whether the cFS that receives ``into`` may be the one that sends ``out``."""


def find_hops(streams: Sequence[Stream], rows: Rows, crossing: Crossing) -> list[Hop]:
    """Return every pair of streams in and out of cFS with common messages (rules 1 to 4).

    Args:
        streams: streams into cFS, out of cFS and to robots.
        rows: table of datagrams.
        crossing: knows which streams may follow which.
    """
    goes_in = [item for item in streams if item.link.to_cfs and item.link.packets]
    ways_in = _Ends(goes_in, rows, crossing.arrival, [item.receiver for item in goes_in])
    comes_out = [item for item in streams if item.link.from_cfs]
    hops: list[Hop] = []
    while comes_out:
        ways_out = _Ends(comes_out, rows, crossing.departure, [item.sender for item in comes_out])
        comes_out = []
        for at, (place, (came_by, went_by)) in sorted(_ways_in(ways_in, ways_out, crossing.follows).items()):
            into, out = ways_in.streams[place], ways_out.streams[at]
            came, went = ways_in.of(place, came_by), ways_out.of(at, went_by)
            is_packet = out.counted and came_by in dict(_OF_PACKETS)  # exact, so clocks may differ more
            early_ns = max(_EARLY_NS, crossing.unsteady_ns, SECOND * is_packet)
            hops.append(_match(into, out, came, went, early_ns))
            others = ways_in.streams if hops[-1].rewritten and not out.link.last_hop else ()
            for also, item in enumerate(others):
                if item.msg_id == into.msg_id and item is not into and crossing.follows(item, out):
                    went = np.where(np.isin(went, came), 0, went)
                    came = ways_in.of(also, came_by)
                    hops.append(_match(item, out, came, went, early_ns))
            if out.link.last_hop and (other := ~np.isin(went, came)).any():
                comes_out.append(replace(out, rows=out.rows[other], time_ns=out.time_ns[other]))
    # Of two streams that seem to follow each other, as a bridge receives and sends too, one came out later.
    lasts = {(hop.into, hop.out): hop.last_ns for hop in hops if hop.matched}
    return [hop for hop in hops if hop.matched and hop.last_ns >= lasts.get((hop.out, hop.into), 0)]


class _Ends:
    """The n streams into cFS, or out of it, as columns.

    Attributes:
        msg_id: i64 (n,), cFE MsgId.
        command: bool (n,), packets are commands.
        instance: i64 (n,), index of the instance.
        peers: bool (n,), link is between SBN peers.
        last_hop: bool (n,), link goes to a robot.
        span_ns: i64 (2, n), times of the first and the last row.
        end: i64 (n,), number of the endpoint at cFS.
        cut: bool (n,), the capture cut some packets.
        same: i64 (n,), id of the stream object, to compare both sides.
        party: i64 (n,), number of the key from ``Crossing``; -1 if nothing follows the stream.
    """

    def __init__(
        self, streams: Sequence[Stream], rows: Rows, kind: Callable[[Stream], Hashable], ends: Sequence[int]
    ) -> None:
        self.streams, self._rows = streams, rows

        def column(value: Callable[[Stream], int], kind: type = np.int64) -> NDArray[Any]:
            return np.array([value(item) for item in streams], kind)

        self.msg_id, self.end = column(lambda item: item.msg_id), np.array(ends, np.int64)
        self.instance, self.same = column(lambda item: item.instance), column(id)
        self.command = column(lambda item: item.is_command, np.bool_)
        self.peers = column(lambda item: item.link.peers, np.bool_)
        self.last_hop = column(lambda item: item.link.last_hop, np.bool_)
        kinds: dict[Hashable, int] = {None: -1}
        self.party = column(lambda item: kinds.setdefault(kind(item), len(kinds)))
        count = column(len)
        self._owner = np.repeat(np.arange(len(streams)), count)
        self._at = np.concatenate([np.zeros(0, np.intp), *(item.rows for item in streams)])
        borders = [np.cumsum(count) - count, np.cumsum(count) - 1]
        self.span_ns = rows.time_ns[self._at[np.array(borders, np.intp)]]
        cut = self._owner[rows.has(Finding.CAPTURE_CUT)[self._at]]
        self.cut = np.bincount(cut, minlength=len(streams)) > 0

    def _prints(self, kind: str, at: Places) -> Prints:
        if kind != _COUNT:
            return np.asarray(getattr(self._rows, kind)[at])
        return np.where(self._rows.counted[at], self._rows.sequence_count[at].astype(np.uint64) + 1, 0)

    def of(self, place: int, kind: str) -> Prints:
        """Return the fingerprints of a stream's rows, u64 (rows,); 0 for none.

        Args:
            place: index of the stream.
            kind: column of the table, or ``_COUNT`` for sequence counts.
        """
        return self._prints(kind, self.streams[place].rows)

    def prints(self, kind: str, some: Mask) -> tuple[Places, Prints]:
        """Return the nonzero fingerprints of some streams: index of the stream, and u64 value, of each."""
        mine = slice(None) if some.all() else some[self._owner]
        owner, prints = self._owner[mine], self._prints(kind, self._at[mine])
        places = np.flatnonzero(prints)
        owner, prints = owner[places], prints[places]
        if kind != _COUNT:
            return owner, prints
        # A count is meaningful only within one MsgId of one instance.
        return owner, prints + (self.msg_id[owner] << 16 | self.instance[owner] << 48).astype(np.uint64)

    def keys(self, owner: Places, values: Prints, *, into: bool) -> tuple[Places, Prints]:
        """Return lookup keys of fingerprints: index of the stream, and u64 key, of each.

        Streams that come from an SBN peer and go to an SBN peer match only at one endpoint of cFS.
        """
        peers = self.peers[owner]
        plain, ended = np.where(into & peers, 1, 0), np.where(peers, self.end[owner] + 2, 1)
        more = peers if into else np.ones(len(owner), bool)
        salts = np.concatenate((plain, ended[more])).astype(np.uint64)
        return np.concatenate((owner, owner[more])), np.concatenate((values, values[more])) + salts * MIX


def _ways_in(
    into: _Ends, out: _Ends, follows: Callable[[Stream, Stream], bool]
) -> dict[int, tuple[int, tuple[str, str]]]:
    """Return the likeliest stream in for each stream out, by index, with the fingerprints that match."""
    party = _Parties(into, out, follows)
    parts: list[Sequence[NDArray[Any]]] = []
    undecided = np.ones(len(out.streams), bool)
    for kinds in _COMPARED:
        parts += _scored(into, out, party, kinds, undecided)
        for _, at, _, score, _ in parts if kinds == _BODIES else ():
            undecided[at[score >= _ALIKE]] = False  # rule 3
    if not parts:
        return {}
    place, at, order, score, near = (np.concatenate(part) for part in zip(*parts, strict=True))
    rank = np.maximum(score, _ALIKE)
    alike: dict[int, list[int]] = {}
    likely: dict[tuple[int, int], bool] = {}
    for index in np.lexsort((order, place, -near, -rank, order != 0, at)).tolist():
        kinds, likeliest = _COMPARED[order[index]], alike.setdefault(int(at[index]), [])
        if not likeliest:
            way = int(at[index]), int(order[index])
            if way not in likely and score[index] < _ALIKE:
                together = place[(at == at[index]) & (order == order[index])].tolist()
                came = (into.of(one, kinds[0]) for one in together)
                likely[way] = _likely(np.concatenate([*came]), out.of(at[index], kinds[1]))
            if score[index] >= _ALIKE or likely[way]:
                likeliest.append(index)
        elif score[index] == score[likeliest[0]] >= _ALIKE and order[index] == order[likeliest[0]]:
            likeliest.append(index)
    pairs: dict[int, int] = {}
    groups: dict[Hashable, dict[int, list[int]]] = {}
    for comes, own in alike.items():
        key = out.end[comes], out.instance[comes], comes if out.last_hop[comes] else NOBODY
        if own:
            groups.setdefault(key, {})[comes] = own
    for group in groups.values():
        pairs |= assign_candidates(group, into.msg_id[place], out.msg_id)
    return {comes: (int(place[index]), _COMPARED[order[index]]) for comes, index in pairs.items()}


def assign_candidates(alike: dict[int, list[int]], came: Integers, went: Integers) -> dict[int, int]:
    """Return one of the equally likely candidates for each stream out, with different MsgIds if possible.

    Streams that compete for the same candidates get them in the order of MsgIds; else the first is taken.

    Args:
        alike: index of a stream out to its candidates, the likeliest first.
        came: i64, MsgId of each candidate.
        went: i64, MsgId of each stream out.
    """
    queue = sorted(alike, key=lambda comes: (len(alike[comes]), int(went[comes])))
    ways: dict[int, int] = {}
    for place, comes in enumerate(queue):
        used = {int(came[index]) for index in ways.values()}
        free = [index for index in alike[comes] if int(came[index]) not in used]
        rivals = {int(came[index]) for other in queue[place + 1 :] for index in alike[other]}
        both = [index for index in free if int(came[index]) in rivals]
        ways[comes] = min(both, key=lambda index: int(came[index])) if both else (free or alike[comes])[0]
    return ways


def _kind(places: Places) -> NDArray[np.uint8]:
    """Return the bit number, 0 to 63, of each stream; every 64th stream shares one."""
    return (places % 64).astype(np.uint8)


class _Parties:
    """Answers for many pairs of streams whether one may follow the other; it asks once for each key."""

    def __init__(self, into: _Ends, out: _Ends, follows: Callable[[Stream, Stream], bool]) -> None:
        self._into, self._out, self._follows = into, out, follows
        self._width = int(out.party.max(initial=-1)) + 1
        self._known: dict[int, bool] = {}

    def usable(self, kinds: tuple[str, str]) -> tuple[Mask, Prints]:
        """Return which streams in and out are worth comparing; all of them if there are too many pairs.

        Returns:
            bool (streams in,), something may come out; u64 (streams out,), bits of the possible streams in,
            by ``_kind``.
        """
        shape = len(self._into.streams), len(self._out.streams)
        able, fit = self._into.party >= 0, np.zeros(shape[1], np.uint64)
        if shape[0] * shape[1] > _PAIRS:
            return able, ~fit
        place, at = np.nonzero(np.broadcast_to(able[:, None], shape))
        fits = _may_follow(self._into, self._out, place, at, kinds)
        fits[fits] = self.follows(place[fits], at[fits])
        np.bitwise_or.at(fit, at[fits], np.uint64(1) << _kind(place[fits]))
        return np.isin(np.arange(shape[0]), place[fits]), fit

    def follows(self, place: Places, at: Places) -> Mask:
        """Return which pairs of streams (in, out), by index, may follow: bool; no ``party`` may be -1."""
        pair = self._into.party[place] * self._width + self._out.party[at]
        first, which = numbered(pair)
        for row in first.tolist():
            if int(pair[row]) not in self._known:
                streams = self._into.streams[place[row]], self._out.streams[at[row]]
                self._known[int(pair[row])] = self._follows(*streams)
        return np.array([self._known[item] for item in pair[first].tolist()], np.bool_)[which]


def _scored(
    into: _Ends, out: _Ends, party: _Parties, kinds: tuple[str, str], undecided: Mask
) -> Iterator[Sequence[NDArray[Any]]]:
    """Yield the likeliest streams in for each stream out, by one kind of fingerprint.

    Pairs with a robot stay even with a low score: its first messages may have gone in before the capture
    began (``_likely``).

    Yields:
        columns, one element a pair: index in, index out, index in ``_COMPARED``, score 0 to 1, and nearness
        of the MsgIds (0 is nearest).
    """
    order = _COMPARED.index(kinds)
    goes, fit = party.usable(kinds)
    owner, values = out.prints(kinds[1], (fit != 0) & undecided)
    came_owner, came = into.prints(kinds[0], goes & bool(len(owner)))
    meeting = perhaps_in(values, came, _kind(came_owner), fit[owner])
    some = (np.bincount(owner[meeting], minlength=len(fit)) > 0)[owner]
    once = np.flatnonzero(some)[numbered(owner[some], values[some])[0]]
    owner, values, meeting = owner[once], values[once], meeting[once]
    different = np.bincount(owner, minlength=len(fit))
    # Too few different values prove nothing, except at a robot, which gets no equal value by chance.
    enough = np.bincount(owner[meeting], minlength=len(fit)) >= _ALIKE * different
    some = ((enough & (different >= _LEAST_DIFFERENT)) | out.last_hop)[owner] & meeting
    if not some.any():
        return
    seeker, sought = out.keys(owner[some], values[some], into=False)
    by_seeker = np.argsort(seeker, kind="stable")
    seeker, sought = seeker[by_seeker], sought[by_seeker]
    met = perhaps_in(came, values[some])
    owner, keys = came_owner[met], came[met]
    once = numbered(owner, keys)[0]
    owner, keys = into.keys(owner[once], keys[once], into=True)
    by_key = np.argsort(keys, kind="stable")
    owner, keys = owner[by_key], keys[by_key]
    low, high = (np.searchsorted(keys, sought, side) for side in ("left", "right"))
    begins = np.append(0, np.flatnonzero(np.diff(seeker)) + 1)
    block = np.append(0, np.cumsum(high - low))[begins] // _PAIRS
    for part in np.split(np.arange(len(seeker)), begins[1:][np.diff(block) != 0]):
        count = (high - low)[part]
        met = np.repeat(low[part] - (np.cumsum(count) - count), count) + np.arange(count.sum())
        code = np.sort(np.repeat(seeker[part], count) * len(into.streams) + owner[met])
        begins = np.flatnonzero(np.append(True, code[1:] != code[:-1])[: len(code)])
        both = np.diff(np.append(begins, len(code)))
        at, place = np.divmod(code[begins], max(1, len(into.streams)))
        score = both / different[at]
        late = (score < _ALIKE) & out.last_hop[at] & (both >= _LEAST_DIFFERENT)
        fits = ((score >= _ALIKE) | late) & _may_follow(into, out, place, at, kinds)
        at, place, score = at[fits], place[fits], score[fits]
        valid = party.follows(place, at)
        at, place, score = at[valid], place[valid], score[valid]
        near = -np.abs((into.msg_id[place] & 0xF) - (out.msg_id[at] & 0xF))
        ranked = np.lexsort((place, -near, -score, at))
        first = np.flatnonzero(np.append(True, np.diff(at[ranked]) != 0)[: len(ranked)])
        nth = np.arange(len(ranked)) - np.repeat(first, np.diff(np.append(first, len(ranked))))
        best = score[ranked][np.arange(len(ranked)) - nth]
        rows = np.union1d(ranked[(score[ranked] == best) & (nth < _TIED)], np.flatnonzero(score < _ALIKE))
        yield place[rows], at[rows], np.full(len(rows), order), score[rows], near[rows]


def _may_follow(into: _Ends, out: _Ends, place: Places, at: Places, kinds: tuple[str, str]) -> Mask:
    """Return which pairs (in, out) of streams these fingerprints can match, by MsgIds and times: bool."""
    in_time = out.span_ns[1, at] >= into.span_ns[0, place]
    in_time &= out.span_ns[0, at] <= into.span_ns[1, place] + _LONGEST_NS
    robot, same = out.last_hop[at], into.msg_id[place] == out.msg_id[at]
    between = into.peers[place] & out.peers[at]
    one, command = (into.instance[place], out.instance[at]), into.command[place]
    anyone = (one[0] == one[1]) | (one[0] == NOBODY) | (one[1] == NOBODY)
    # SBN never sends on what SBN itself has put on the bus.
    handed_on = same & ~robot & ~between & anyone & (into.same[place] != out.same[at])
    if kinds in _OF_PACKETS:
        # The rest of a cut packet depends on its outer headers; but a cFS uses each count only once.
        cut = (one[0] == one[1]) & (one[0] != NOBODY) & (into.cut[place] | out.cut[at])
        return np.asarray(in_time & handed_on & (cut == (kinds[0] == _COUNT)))
    other = ~same & (command != out.command[at]) & (~between | (into.end[place] == out.end[at]))
    other |= handed_on & command & (kinds == _HEADS)
    return in_time & np.where(robot, command & (kinds in _TO_ROBOT), other & (kinds in _REWRITTEN))


def _likely(came: Prints, went: Prints) -> bool:
    """Return whether a robot gets these messages, though its first ones went in before the capture began.

    Args:
        came: u64, fingerprints of all messages in, of all MsgIds that may command it.
        went: u64, fingerprints of the messages that it got, in order.
    """
    arrived = np.isin(went, came[came != 0])
    every, behind = (distinct(some[some != 0]) for some in (went, went[arrived.argmax() :]))
    there_too = np.isin(behind, came)
    nearly_all = there_too.sum() >= _LEAST_DIFFERENT and there_too.mean() > _NEARLY_ALL
    return bool(nearly_all or (len(every) and np.isin(every, came).mean() >= _ALIKE))


def _match(into: Stream, out: Stream, came: Prints, went: Prints, early_ns: int) -> Hop:
    """Return the pair of two streams, with their messages matched (rule 5).

    Args:
        came: u64 (rows of ``into``,), fingerprints; 0 for none.
        went: u64 (rows of ``out``,), fingerprints; 0 for none.
        early_ns: largest time by which a message may seem to come out before it went in.
    """
    in_ns, out_ns = into.time_ns, out.time_ns
    from_ = paired(came, in_ns - early_ns, went, out_ns)
    from_[out_ns - in_ns[from_] > _LONGEST_NS] = -1
    goes_row = np.flatnonzero(from_ >= 0)
    from_row = from_[goes_row]
    delay = np.maximum(0, out_ns[goes_row] - in_ns[from_row])

    arrived = np.zeros(len(came), bool)
    arrived[from_row] = True
    rewritten = out.link.last_hop or into.msg_id != out.msg_id
    which = numbered(np.concatenate((came, went)))[1]
    came_as, went_as = which[: len(came)], which[len(came) :]
    number = np.bincount(came_as, minlength=len(which))
    often, out_often = number[came_as], np.bincount(went_as)[went_as]
    single = often[from_row] == 1
    repeated = (from_ < 0) & np.isin(went_as, came_as[arrived])
    return Hop(
        into=into,
        out=out,
        rewritten=rewritten,
        prints=came,
        arrived=arrived,
        perhaps=~arrived & np.isin(came, went[(from_ < 0) & (went != 0)]),
        single=often[came != 0] == 1,
        origin=from_,
        sole=(went != 0) & (out_often == 1) & (number[went_as] <= 1),
        again=np.where(np.diff(went_as, prepend=-1) != 0, np.uint8(2), np.uint8(1)) * repeated,
        delays_ns=delay[single],
        out_ns=out_ns[goes_row][single],
        last_ns=int(delay.max(initial=0)),
        in_rows=from_row,
        out_rows=goes_row,
    )


def latency_of(delay_ns: Integers) -> Latency | None:
    """Return number, quantiles and maximum of some delays, i64 ns; None without any."""
    if not len(delay_ns):
        return None
    p50, p99, most = (round(value / 1e6, 3) for value in quantiles(delay_ns, 0.5, 0.99, 1.0))
    return Latency(len(delay_ns), p50, p99, most)

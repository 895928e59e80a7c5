"""The same message on two links: what crossed cFS, how long that took, and what never came out.

A packet that cFS only hands on is the same bytes on both; a message that an application reads and writes anew
has another MsgId and the same body. Only where no bodies are alike are values compared, as the types of a
mission have them: what the bytes tell holds with any mission.
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
from edoras_tools.wire.arrays.fingerprint import MIX
from edoras_tools.wire.arrays.order import distinct, numbered, perhaps_in, quantiles

if TYPE_CHECKING:
    from collections.abc import Callable, Hashable, Iterator, Sequence

    from numpy.typing import NDArray

    from edoras_tools.diagnosis.evidence.table import Rows
    from edoras_tools.diagnosis.matching.streams import Stream
    from edoras_tools.wire.arrays.order import Integers, Mask, Places, Prints

_LONGEST_NS: Final = 120 * SECOND
"""No message is under way for longer: a full socket at CI is read within a minute and a half."""
_EARLY_NS: Final = 20 * MILLISECOND
"""By so much a message may come out before it went in: times of two interfaces, or of a busy host."""
_ALIKE: Final = 0.5
_LEAST_DIFFERENT: Final = 3
_NEARLY_ALL: Final = 0.9
_BODIES: Final = "body_print", "body_print"
_VALUES: Final = "value_print", "value_print"
_TO_ROBOT: Final = _BODIES, _VALUES, ("value_print", "stamped_print"), ("shared_print", "shared_print")
"""A robot is sent bare numbers, their bytes or values as the configured type has them, or a struct."""
_REWRITTEN: Final = _BODIES, ("stamped_print", "stamped_print"), _VALUES
"""What streams of different MsgIds are compared by: fingerprints of what goes in and of what comes out."""
_TIED: Final = 8
"""So many ways in that are equally likely are looked at."""
_COUNT: Final = "count"
_OF_PACKETS: Final = ("packet_print", "packet_print"), (_COUNT, _COUNT)
"""Of one MsgId: the packets, and the counts of those that the capture cut."""
_COMPARED: Final = (*_REWRITTEN, *_TO_ROBOT[2:], *_OF_PACKETS)
"""All of these, the strictest first; ``_BODIES`` is before any other."""
_PAIRS: Final = 1 << 20
"""Equal fingerprints that are held against each other at once."""


class Latency(msgspec.Struct, frozen=True):
    """How long messages took, in ms."""

    count: int
    p50: float
    p99: float
    most: float

    def as_json(self) -> dict[str, Any]:
        """Return it in the shape of ``doctor --json``."""
        return {"count": self.count, "p50_ms": self.p50, "p99_ms": self.p99, "max_ms": self.most}


class Hop(NamedTuple):
    """Messages of one stream that came out again as another.

    Attributes:
        into: where they go in.
        out: where they come out; the robot, where its link is ``OTHER``.
        rewritten: an application read them and wrote them anew; else they are the same packets.
        prints: u64, a row of ``into`` each: the fingerprint by which it was looked for; 0 where it has none.
        arrived: bool, likewise: it came out.
        perhaps: bool, likewise: it did not, but an equal one came out that is none of these.
        single: bool, one for each that is ``known``: no other of them has its fingerprint.
        origin: i64, a row of ``out`` each: the place in ``into`` that it came from, -1 where there is none.
        sole: bool, likewise: its fingerprint occurs once coming out, and not twice going in.
        doubled: how often one came out that already had.
        latency: of those whose values occur once.
        delays_ns: i64, the delay of each of those.
        out_ns: i64, and when each came out.
        last_ns: the longest that one took.
        in_rows: intp, the messages that came out, as indices into the rows of ``into``.
        out_rows: intp, and what each is, as an index into those of ``out``, ascending.
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
    doubled: int
    latency: Latency | None
    delays_ns: Integers
    out_ns: Integers
    last_ns: int
    in_rows: Places
    out_rows: Places

    @property
    def known(self) -> Mask:
        """Which have a fingerprint, so that they can be found again."""
        return np.asarray(self.prints != 0)

    @property
    def is_copy(self) -> bool:
        """Whether Telemetry Output was told to send commands as well, which go on to an application."""
        return self.into.is_command and not self.rewritten and self.out.link.only_from_cfs

    @property
    def of(self) -> int:
        """How many went in that can be found again."""
        return int(self.known.sum())

    @property
    def matched(self) -> int:
        """How many of those came out."""
        return int(self.arrived.sum())

    @property
    def first(self) -> tuple[int, int]:
        """When the first came out, and when it had gone in, ns since 1970."""
        return int(self.out.time_ns[self.out_rows[0]]), int(self.into.time_ns[self.in_rows[0]])

    @property
    def absent(self) -> Mask:
        """Which of those did not."""
        return self.known & ~self.arrived


class Crossing(Protocol):
    """Tells which streams may be what others were further on; each is asked once for streams of one kind.

    Attributes:
        unsteady_ns: by how much capture times are wrong in no order.
    """

    unsteady_ns: int

    def arrival(self, stream: Stream) -> Hashable:
        """Return all that matters of a stream that goes in; None where nothing of it comes out."""

    def departure(self, stream: Stream) -> Hashable:
        """Return all that matters of a stream that comes out."""

    def follows(self, into: Stream, out: Stream) -> bool:
        """Tell whether one stream's receiver is the sender of another."""


def find_hops(streams: Sequence[Stream], rows: Rows, crossing: Crossing) -> list[Hop]:
    """Find every pair of streams of which one is the other, further on.

    Each way out has one MsgId that goes in, by CI or by SBN, but for a robot's: several may command it.
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
            is_packet = out.counted and came_by in dict(_OF_PACKETS)  # whatever two capture clocks say
            early_ns = max(_EARLY_NS, crossing.unsteady_ns, SECOND * is_packet)
            hops.append(_match(into, out, came, went, early_ns))
            for also, item in enumerate(
                ways_in.streams if hops[-1].rewritten and not out.link.last_hop else ()
            ):
                if item.msg_id == into.msg_id and item is not into and crossing.follows(item, out):
                    went = np.where(np.isin(went, came), 0, went)
                    came = ways_in.of(also, came_by)
                    hops.append(_match(item, out, came, went, early_ns))
            if out.link.last_hop and (other := ~np.isin(went, came)).any():
                comes_out.append(replace(out, rows=out.rows[other], time_ns=out.time_ns[other]))
    return [hop for hop in hops if hop.matched]


class _Ends:
    """Streams that go in, or that come out, in columns: an element each.

    Attributes:
        msg_id: i64.
        command: bool.
        instance: i64.
        peers: bool, between SBN peers.
        last_hop: bool, to a robot.
        span_ns: i64 (2, n), times of the first and of the last row.
        end: i64, the endpoint at cFS.
        cut: bool, the capture cut some packet.
        same: i64, equal for the same stream on both sides.
        party: i64, equal where all is that decides what may follow what; -1: nothing may.
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
        """Return the fingerprints of a stream's rows, u64: of a column, or its counts; 0 tells nothing."""
        return self._prints(kind, self.streams[place].rows)

    def prints(self, kind: str, some: Mask) -> tuple[Places, Prints]:
        """Return the fingerprints of some streams but 0, stream by stream: whose, and which."""
        mine = slice(None) if some.all() else some[self._owner]
        owner, prints = self._owner[mine], self._prints(kind, self._at[mine])
        places = np.flatnonzero(prints)
        owner, prints = owner[places], prints[places]
        if kind != _COUNT:
            return owner, prints
        # A count says nothing but within one MsgId of one cFS.
        return owner, prints + (self.msg_id[owner] << 16 | self.instance[owner] << 48).astype(np.uint64)

    def keys(self, owner: Places, values: Prints, *, into: bool) -> tuple[Places, Prints]:
        """Return what equal fingerprints are looked up by: whose, and which.

        Of what goes from an SBN peer to an SBN peer only the streams of one endpoint may be the same.
        """
        peers = self.peers[owner]
        plain, ended = np.where(into & peers, 1, 0), np.where(peers, self.end[owner] + 2, 1)
        more = peers if into else np.ones(len(owner), bool)
        salts = np.concatenate((plain, ended[more])).astype(np.uint64)
        return np.concatenate((owner, owner[more])), np.concatenate((values, values[more])) + salts * MIX


def _ways_in(
    into: _Ends, out: _Ends, follows: Callable[[Stream, Stream], bool]
) -> dict[int, tuple[int, tuple[str, str]]]:
    """Return the likeliest way in of each way out, and the fingerprints that are alike; by their places."""
    party = _Parties(into, out, follows)
    parts: list[Sequence[NDArray[Any]]] = []
    undecided = np.ones(len(out.streams), bool)
    for kinds in _COMPARED:
        parts += _scored(into, out, party, kinds, undecided)
        for _, at, _, score, _ in parts if kinds == _BODIES else ():
            undecided[at[score >= _ALIKE]] = False  # what has equal bodies is not looked for by anything else
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
        pairs |= share_out(group, into.msg_id[place], out.msg_id)
    return {comes: (int(place[index]), _COMPARED[order[index]]) for comes, index in pairs.items()}


def share_out(alike: dict[int, list[int]], came: Integers, went: Integers) -> dict[int, int]:
    """Give each way out one of the ways in that are equally likely: another one each, as far as there are.

    Those with equal values on both sides go by the order of their MsgIds; else the first is the likeliest.

    Args:
        alike: way out to candidates.
        came: MsgId of each candidate.
        went: MsgId of each way out.
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
    """Return a number below 64 for each stream; every 64th has the same."""
    return (places % 64).astype(np.uint8)


class _Parties:
    """Answers for many pairs of streams whether one may follow the other, and asks once for each kind."""

    def __init__(self, into: _Ends, out: _Ends, follows: Callable[[Stream, Stream], bool]) -> None:
        self._into, self._out, self._follows = into, out, follows
        self._width = int(out.party.max(initial=-1)) + 1
        self._known: dict[int, bool] = {}

    def usable(self, kinds: tuple[str, str]) -> tuple[Mask, Prints]:
        """Tell of which streams that go in something may come out, and which of them each way out may be.

        Of very many it is not asked.

        Returns:
            bool, and a bit for each that it may be, by ``_kind``.
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
        """Tell for pairs of places, of which none is of a party where nothing follows."""
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
    """Yield the likeliest ways in of each way out by one kind of fingerprints, and those that may be it.

    Some of the rest may be, where what came first had gone in before the capture began: ``_likely`` tells.

    Yields:
        of pairs of streams: the places of both and of the fingerprints, how alike, how near the MsgIds are.
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
    # Where too few differ to tell, nothing is alike; a robot gets no equal value by chance.
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
    """Tell which pairs of places these fingerprints can make the same, as far as MsgIds and times go."""
    in_time = (out.span_ns[1, at] >= into.span_ns[0, place]) & (
        out.span_ns[0, at] <= into.span_ns[1, place] + _LONGEST_NS
    )
    robot, same = out.last_hop[at], into.msg_id[place] == out.msg_id[at]
    between = into.peers[place] & out.peers[at]
    if kinds in _OF_PACKETS:
        one = into.instance[place], out.instance[at]
        # What is left of a packet differs with the headers before it; one cFS gives a count once.
        cut = (one[0] == one[1]) & (one[0] != NOBODY) & (into.cut[place] | out.cut[at])
        anyone = (one[0] == one[1]) | (one[0] == NOBODY) | (one[1] == NOBODY)
        fits = same & ~robot & ~between & anyone & (cut == (kinds[0] == _COUNT))
        # SBN's pipes leave out what SBN itself has put on the bus.
        return np.asarray(in_time & fits & (into.same[place] != out.same[at]))
    command = into.command[place]
    other = ~same & (command != out.command[at]) & (~between | (into.end[place] == out.end[at]))
    fits = np.where(robot, command & (kinds in _TO_ROBOT), other & (kinds in _REWRITTEN))
    return np.asarray(in_time & fits)


def _likely(came: Prints, went: Prints) -> bool:
    """Tell whether a robot gets what goes in: what it got before the first that did had gone in before.

    Args:
        came: fingerprints of what goes in, of all MsgIds that may command it.
        went: of what comes out.
    """
    arrived = np.isin(went, came[came != 0])
    every, behind = (distinct(some[some != 0]) for some in (went, went[arrived.argmax() :]))
    there_too = np.isin(behind, came)
    nearly_all = there_too.sum() >= _LEAST_DIFFERENT and there_too.mean() > _NEARLY_ALL
    return bool(nearly_all or (len(every) and np.isin(every, came).mean() >= _ALIKE))


def _match(into: Stream, out: Stream, came: Prints, went: Prints, early_ns: int) -> Hop:
    """Give every message that came out the latest equal one that had gone in and not come out yet."""
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
        doubled=int((np.bincount(came_as[arrived], minlength=len(which))[went_as] > 0).sum()) - len(goes_row),
        latency=latency_of(delay[single]),
        delays_ns=delay[single],
        out_ns=out_ns[goes_row][single],
        last_ns=int(delay.max(initial=0)),
        in_rows=from_row,
        out_rows=goes_row,
    )


def latency_of(delay_ns: Integers) -> Latency | None:
    """Return the figures of some delays; None where there are none."""
    if not len(delay_ns):
        return None
    p50, p99, most = (round(value / 1e6, 3) for value in quantiles(delay_ns, 0.5, 0.99, 1.0))
    return Latency(len(delay_ns), p50, p99, most)

"""Follows packet sequence counts: finds missing, repeated, late, and restarted ones.

The rules:

1. A stream is one MsgId of one sender on one link. If the link has SBN identities, the sender is its
   identity, and each receiver has its own stream, because each gets a copy; otherwise the sender is its
   endpoint.
2. A sequence word of 0 is not a count; nor is a count that never changes. Nothing is reported of a stream
  whose count jumps beyond the window, or restarts, at more than every fourth packet.
3. One stream may carry packets of several senders with their own counts, for example if Telemetry Output
   forwards packets of another processor. Each count is followed as a strand. A packet with a time belongs to
   a strand of the same boot: capture time minus packet time is then the same, within 3 s. If no strand has
   that boot, the packet may still be the next of a strand, or fill a hole: it was delayed, or a clock was
   set.
4. A packet is the first of these that fits; among strands, the one that moved last comes first:
   a. a duplicate of the packet before: the same count, the same bytes;
   b. the next of a strand;
   c. late: it fills a hole of a strand, within the window. It was reordered, and is not missing;
   d. a duplicate: of a packet at most 128 counts back, with the same bytes;
   e. ahead of the nearest strand, within the window: the counts between are missing, and are a hole;
   f. late, within the window before the first packet of a strand;
   g. ahead of the nearest strand by less than half the range: as (e). But one of the first 64 counts, of a
      packet without a time, is (h);
   h. the first of a new strand: a restart, or another sender if the strand before it continues afterwards.
5. An apparent jump was another sender's packet if counts continue at the beginning of the hole: by three
   packets while the strand also continues after the hole (or never did, as after a damaged count); or by
   one packet if the hole is larger than the window. The hole then lies between two strands, and nothing is
   missing in it. Three such packets also prove that (f) was (h).
6. The division of packets into batches changes nothing.

Counts that increase by one are handled as runs; Python handles a packet alone only where the count jumps.
Consecutive jumps ahead, while there is one strand, are all rule 4e or 4g and are handled at once.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from itertools import pairwise
from operator import attrgetter
from typing import TYPE_CHECKING, Any, Final

import msgspec
import numpy as np
from msgspec.structs import replace

from edoras_tools.model import NO_MSG_ID, Columns, Finding, PacketBatch
from edoras_tools.units import SECOND
from edoras_tools.wire import arrays
from edoras_tools.wire.arrays import Integers, Mask, by_value, changes, distinct_rows, order_by

if TYPE_CHECKING:
    from numpy.typing import NDArray


MODULUS: Final = 1 << 14
"""CCSDS 133.0-B 4.1.3.4.3: the packet sequence count has 14 bits."""
FORWARD: Final = MODULUS // 2
"""Smallest step, modulo the range, that is a step back: half the range."""
WINDOW: Final = 1024
"""Range of counts below the highest one in which a late packet is recognised."""
REPEATED: Final = 128
"""Range of counts below the highest one in which a repeated packet is recognised."""
BOOT_APART_NS: Final = 3 * SECOND
"""Longest delay of a packet on its way; boots that are closer in time than this are not distinguished."""
_FIRST_COUNTS: Final = 64
_REMEMBERED: Final = FORWARD // 2
"""Number of counts for which a hole larger than the window, or an idle strand, is remembered."""
_GOES_ON: Final = 3
_LEAST_HOLE: Final = 16
"""Smallest hole that may be the distance between two senders: the first sender soon fills a smaller one."""
_MOST_STRANDS: Final = 8
_MOST_STREAMS: Final = 1 << 14
"""Most streams that are followed: random bytes could name any number."""
_NO_BOOT: Final = np.iinfo(np.int64).min
_NOT_MISSED: Final = -1


class _Hole(msgspec.Struct, eq=False):
    """Counts that have not come: positions from ``first`` up to ``end``.

    ``row`` is the row that jumped over them; ``_NOT_MISSED`` for those before the first packet of a strand.
    """

    first: int
    end: int
    row: int


_BY_FIRST = attrgetter("first")


class _Strand(msgspec.Struct, eq=False):
    """One sender's count. A position is a count that does not wrap: modulo ``MODULUS`` it is the count.

    Attributes:
        last: highest position.
        boot: capture time minus packet time of its newest packet with a time, ns; else ``_NO_BOOT``.
        prints: fingerprints of the newest packets, by position modulo ``REPEATED``.
        holes: positions that have not come and may still come.
        place: number of packets of the stream up to its last move.
        follows: the strand that moved last when this one began, until that one moves again.
        moved: whether it ever continued.
        front: packets by which it continued since ``behind_steps`` was 1.
        behind: position of the packet with which another sender's count would continue at a hole.
        behind_steps: number of consecutive late packets that continued like that.
    """

    last: int
    boot: int
    prints: NDArray[np.uint32]
    holes: list[_Hole]
    place: int = 0
    follows: _Strand | None = None
    moved: bool = False
    front: int = 0
    behind: int = 0
    behind_steps: int = 0

    def position(self, count: int) -> int:
        """Return the position with a given count that is nearest to ``last``."""
        return self.last + (count - self.last + FORWARD) % MODULUS - FORWARD

    def hole(self, position: int) -> _Hole | None:
        """Return the hole that contains a position, or None."""
        if position >= self.last:
            return None
        index = bisect_right(self.holes, position, key=_BY_FIRST) - 1
        return self.holes[index] if index >= 0 and position < self.holes[index].end else None

    def may_have(self, boot: int) -> bool:
        """Return whether a packet of a boot may belong to it."""
        return _NO_BOOT in {boot, self.boot} or abs(boot - self.boot) <= BOOT_APART_NS

    def advance(self, prints: Sequence[int] | NDArray[np.uint32], boot: int) -> None:
        """Continue by ``len(prints)`` packets; ``boot`` is that of the newest packet with a time."""
        self.last += len(prints)
        if len(prints) == 1:
            self.prints[self.last % REPEATED] = prints[0]
        else:
            newest = prints[-REPEATED:]
            begin = (self.last - len(newest) + 1) % REPEATED
            self.prints[begin : begin + len(newest)] = newest[: REPEATED - begin]
            self.prints[: max(begin + len(newest) - REPEATED, 0)] = newest[REPEATED - begin :]
        if boot != _NO_BOOT:
            self.boot = boot
        self.front += len(prints)
        self.forget()

    def fill(self, hole: _Hole, position: int) -> None:
        """Remove a position from one of its holes."""
        if position == hole.first:
            hole.first += 1
        else:
            if position + 1 < hole.end:
                self.holes.insert(self.holes.index(hole) + 1, replace(hole, first=position + 1))
            hole.end = position
        if hole.first == hole.end:
            self.holes.remove(hole)

    def forget(self) -> None:
        """Remove holes that are too old to be filled."""
        while self.holes:
            oldest = self.holes[0]
            if oldest.end > self.last - (_REMEMBERED if oldest.end - oldest.first > WINDOW else WINDOW):
                break
            del self.holes[0]


class SequenceRows(msgspec.Struct, frozen=True, eq=False):
    """The results of the sequence counts for each row of a batch: columns i32 (rows,), ``refilled_row`` i64.

    Sums over the rows of a stream are the counts in its ``SequenceStream``.

    Attributes:
        stream: index into ``SequenceCounts.streams``; -1 if the row has no count.
        missing: number of missing counts between the row and the one before it.
        refilled: number of counts, missing before, that the row proves not to be missing.
        refilled_row: row before which these were counted as missing, counted over all batches from 0.
        duplicates: 1 if the row repeats another.
        reordered: 1 if the row came late; less if the row proves that earlier rows did not.
        restarts: 1 if the count restarts; -1 if the row proves that another sender's count began.
    """

    stream: NDArray[np.int32]
    missing: NDArray[np.int32]
    refilled: NDArray[np.int32]
    refilled_row: Integers
    duplicates: NDArray[np.int32]
    reordered: NDArray[np.int32]
    restarts: NDArray[np.int32]


class _Runs(msgspec.Struct, frozen=True, eq=False):
    """Packets of the streams of a batch, and runs of them: of one stream, with counts that increase by one.

    Attributes:
        begins: start of each run in the columns below.
        ends: end of each run.
        steps: step from the count before a run, of the same stream; 0 if there is none.
        count: sequence count of each packet.
        rows: row of each packet in the batch.
        prints: fingerprint of each packet.
        places: number of packets of the stream before each packet.
        boots: capture time minus packet time; ``_NO_BOOT`` without a packet time.
    """

    begins: Integers
    ends: Integers
    steps: Integers
    count: NDArray[np.uint16]
    rows: Integers
    prints: NDArray[np.uint32]
    places: Integers
    boots: Integers


class SequenceStream(msgspec.Struct, eq=False):
    """The results of the sequence counts of one stream.

    Attributes:
        packets: number of packets that have a count.
        missing: number of counts that never came.
        repeated: number of packets that came twice.
        late: number of packets that came after a later one.
        restarts: number of times the count restarted.
        leaps: number of times it jumped beyond the window, or restarted.
        moved: whether it ever moved.
        last_count: count of the newest packet.
        last_print: fingerprint of the newest packet.
    """

    packets: int = 0
    missing: int = 0
    repeated: int = 0
    late: int = 0
    restarts: int = 0
    leaps: int = 0
    moved: bool = False
    last_count: int = -1
    last_print: int = 0
    _strands: list[_Strand] = msgspec.field(default_factory=list)

    @property
    def has_count(self) -> bool:
        """Whether its sender counts."""
        return self.moved and self.leaps * 4 <= self.packets + 4

    @property
    def goes_on(self) -> bool:
        """Whether it moved, and each packet so far was the next, or ahead of it."""
        return self.moved and len(self._strands) == 1 and not (self.repeated or self.late or self.leaps)

    @property
    def gaps(self) -> int:
        """The number of counts that never came; 0 if the sender does not count, as for the two below."""
        return self.missing if self.has_count else 0

    @property
    def duplicates(self) -> int:
        """The number of packets that came twice."""
        return self.repeated if self.has_count else 0

    @property
    def reordered(self) -> int:
        """The number of packets that came late."""
        return self.late if self.has_count else 0

    def stands_at(self, count: int) -> bool:
        """Return whether no count other than this one came so far."""
        return not self.moved and all(item.last % MODULUS == count for item in self._strands)

    def stay(self, newest: int) -> None:
        """Note the fingerprint of the newest packet of a stream that did not move."""
        strand = self._strands[0]
        strand.prints[strand.last % REPEATED] = newest

    def take(self, runs: _Runs, index: int, out: _Results) -> None:
        """Take a run; its results go to ``out``."""
        begin, end = int(runs.begins[index]), int(runs.ends[index])
        prints, boots, place = runs.prints[begin:end], runs.boots[begin:end], int(runs.places[begin])
        at, first = 0, int(runs.count[begin])
        if len(self._strands) == 1 and (self._strands[0].last + 1) % MODULUS == first:
            # A single strand continues, independent of the boots.
            self._strands[0].advance(prints, _newest(boots))
            self._continue_with(self._strands[0], place + len(prints) - 1, out)
            return
        while at < len(prints):
            count, out.row, boot = (first + at) % MODULUS, int(runs.rows[begin + at]), int(boots[at])
            strands = [item for item in self._strands if item.may_have(boot)]
            # If no strand has the boot, perhaps a clock was set: the next count of a strand still belongs
            # to it.
            ready = [item for item in strands or self._strands if (item.last + 1) % MODULUS == count]
            if ready:
                # The boot of each packet selects one of several strands.
                end = len(prints) if len(self._strands) == 1 else _same_boot(boots, at)
                ready[0].advance(prints[at:end], _newest(boots[at:end]))
                self._continue_with(ready[0], place + end - 1, out)
                at = end
                continue
            self._jumped(strands, _Packet(count, place + at, boot, int(prints[at])), out)
            at += 1

    def take_all(self, runs: _Runs, first: int, end: int, out: _Results) -> None:
        """Take the runs from ``first`` to before ``end``, each of which is ahead of the one before."""
        self.take(runs, first, out)
        newest = int(runs.count[runs.ends[first] - 1])
        single = end > first + 1 and len(self._strands) == 1 and self._strands[0].last % MODULUS == newest
        if not (single and self._go_ahead(runs, first + 1, end, out)):
            for index in range(first + 1, end):
                self.take(runs, index, out)

    def _go_ahead(self, runs: _Runs, first: int, end: int, out: _Results) -> bool:
        """Take runs of which each is ahead, if all may be of one boot; return whether they were taken."""
        (strand,) = self._strands
        begin, stop = runs.begins[first], runs.ends[end - 1]
        rows, jumps = runs.rows[begin:stop], runs.begins[first:end] - begin
        newest = _newest(boots := np.append(strand.boot, runs.boots[begin:stop]))
        if np.abs(boots[boots != _NO_BOOT] - newest).max(initial=0) > BOOT_APART_NS // 2:
            return False
        missing = runs.steps[first:end] - 1
        ahead = np.ones(len(rows), np.int64)
        ahead[jumps] += missing
        position = strand.last + np.cumsum(ahead)
        out.columns["missing"][rows[jumps]] += missing.astype(np.int32)
        self.missing += int(missing.sum())
        strand.last, strand.behind_steps = int(position[-1]), 0
        strand.prints[position % REPEATED] = runs.prints[begin:stop]
        strand.boot, strand.front = newest, strand.front + len(rows)
        strand.forget()
        ends = position[jumps]
        closed = (ends <= strand.last - np.where(missing > WINDOW, _REMEMBERED, WINDOW)) & (not strand.holes)
        kept = slice(int(np.append(closed, False).argmin()), None)
        columns = ends - missing, ends, out.first_row + rows[jumps]
        strand.holes += map(_Hole, *(column[kept].tolist() for column in columns))
        self.leaps += int((missing >= WINDOW).sum())
        self._continue_with(strand, int(runs.places[stop - 1]), out)
        return True

    def _jumped(self, strands: list[_Strand], packet: _Packet, out: _Results) -> None:
        """Take a packet that is not the next of any strand."""
        decided = self._strands and (
            self._late(strands or self._strands, packet, out, missed=True)
            or self._again(strands, packet, out)
            or self._ahead(strands, packet, out, WINDOW)
            or self._late(strands, packet, out, missed=False)
            or self._ahead(strands, packet, out, FORWARD)
        )
        if not decided:
            self._begin(_new_strand(packet, packet.count), packet.place, out)

    def _late(self, strands: list[_Strand], packet: _Packet, out: _Results, *, missed: bool) -> bool:
        for strand in strands:
            position = strand.position(packet.count)
            hole = strand.hole(position)
            if hole is None or (hole.row != _NOT_MISSED) != missed:
                continue
            if position <= strand.last - WINDOW:
                if hole.end - hole.first > WINDOW:
                    strand.behind_steps = 0
                    self._divide(strand, hole, position, packet, out)
                    return True
                continue
            if position <= hole.first + 1 or not missed:
                again = strand.behind_steps and position == strand.behind
                strand.behind_steps = strand.behind_steps + 1 if again else 1
                strand.front = strand.front if again else 0
            else:
                strand.behind_steps = 0
            strand.behind = position + 1
            ahead = strand.front >= _GOES_ON - 1 or hole.end == strand.last
            goes_on = strand.behind_steps >= _GOES_ON and (ahead or not missed)
            if goes_on and hole.end - position > _LEAST_HOLE:
                self._divide(strand, hole, position, packet, out)
                return True
            if position > strand.last - REPEATED:
                strand.prints[position % REPEATED] = packet.print_
            strand.fill(hole, position)
            self._find(hole, 1, out)
            self.moved = True
            self.late += 1
            out.add("reordered", 1)
            return True
        return False

    def _divide(self, strand: _Strand, hole: _Hole, position: int, packet: _Packet, out: _Results) -> None:
        """Attribute the packets before a hole to another sender: a strand that is now at ``position``."""
        taken_back = max(strand.behind_steps - 1, 0)
        self.late -= taken_back
        out.add("reordered", -taken_back)
        strand.behind_steps = 0
        other = replace(
            _new_strand(packet, position), follows=strand.follows, moved=True, behind=strand.behind
        )
        if hole.row == _NOT_MISSED:
            other.holes = [_unknown(position - taken_back)]
            self._begin(other, packet.place, out)
            return
        self._find(hole, hole.end - position, out)
        index = strand.holes.index(hole)
        before = [replace(hole, end=position)] if position > hole.first else []
        other.holes = [*strand.holes[:index], *before]
        strand.holes = [_unknown(hole.end), *strand.holes[index + 1 :]]
        self._add(other)
        self._continue_with(other, packet.place, out)

    def _again(self, strands: list[_Strand], packet: _Packet, out: _Results) -> bool:
        for strand in strands:
            position = strand.position(packet.count)
            if not strand.last - REPEATED < position <= strand.last or strand.hole(position):
                continue
            if strand.prints[position % REPEATED] == packet.print_:
                self.repeated += 1
                out.add("duplicates", 1)
                return True
            if not strand.moved and position == strand.last:
                strand.prints[position % REPEATED] = packet.print_
                return True  # it does not count
        return False

    def _ahead(self, strands: list[_Strand], packet: _Packet, out: _Results, reach: int) -> bool:
        step, strand = MODULUS, None
        for item in strands:
            if 0 < (own := item.position(packet.count) - item.last) < step:
                step, strand = own, item
        if strand is None or step > reach:
            return False
        if step > WINDOW:
            if packet.count < _FIRST_COUNTS and _NO_BOOT in {packet.boot, strand.boot}:
                return False
            self.leaps += 1
        strand.holes.append(_Hole(strand.last + 1, strand.last + step, out.first_row + out.row))
        self.missing += step - 1
        out.add("missing", step - 1)
        strand.last += step - 1
        strand.advance([packet.print_], packet.boot)
        strand.behind_steps = 0
        self._continue_with(strand, packet.place, out)
        return True

    def _begin(self, strand: _Strand, place: int, out: _Results) -> None:
        if self._strands:
            strand.follows = self._strands[0]
            self.moved = True
            self.leaps += 1
            self.restarts += 1
            out.add("restarts", 1)
        strand.place = place
        self._add(strand)

    def _add(self, strand: _Strand) -> None:
        """Put a strand first; remove strands that did not move for long."""
        remembered = [item for item in self._strands if strand.place - item.place <= _REMEMBERED]
        self._strands = [strand, *remembered[: _MOST_STRANDS - 1]]

    def _continue_with(self, strand: _Strand, place: int, out: _Results) -> None:
        """Put a strand first; strands that began after it were no restarts of it."""
        strand.place = place
        strand.moved = self.moved = True
        if len(self._strands) == 1:
            return
        self._strands.remove(strand)
        self._strands.insert(0, strand)
        for other in self._strands:
            if other.follows is strand:
                other.follows = None
                self.restarts -= 1
                out.add("restarts", -1)

    def _find(self, hole: _Hole, count: int, out: _Results) -> None:
        """Record that some counts of a hole are not missing after all."""
        if hole.row != _NOT_MISSED:
            self.missing -= count
            out.add("refilled", count)
            out.columns["refilled_row"][out.row] = hole.row


class _Packet(msgspec.Struct, frozen=True, eq=False):
    """A packet: its count, its place in the stream, boot and fingerprint."""

    count: int
    place: int
    boot: int
    print_: int


class _Results(msgspec.Struct, eq=False):
    """The result columns of a batch while it is followed.

    Attributes:
        columns: columns of ``SequenceRows``.
        first_row: number of rows in the batches before.
        row: row that is handled now.
    """

    columns: dict[str, NDArray[Any]]
    first_row: int
    row: int = 0

    def add(self, column: str, number: int) -> None:
        """Add to a column of ``row``."""
        self.columns[column][self.row] += number


def _unknown(position: int) -> _Hole:
    """Return a hole for packets that may come late before the first packet of a strand."""
    return _Hole(position - WINDOW, position, _NOT_MISSED)


def _new_strand(packet: _Packet, position: int) -> _Strand:
    prints = np.zeros(REPEATED, np.uint32)
    strand = _Strand(position, packet.boot, prints, [_unknown(position)], packet.place)
    strand.prints[position % REPEATED] = packet.print_
    return strand


class SequenceCounts:
    """Follows the sequence counts of all streams, a batch at a time.

    Several users that see the same batches may share it: a batch is followed once.

    Attributes:
        streams: results of each stream so far.
    """

    def __init__(self) -> None:
        self.streams: list[SequenceStream] = []
        self._index: dict[int, int] = {}
        self._rows = 0
        self._newest: tuple[PacketBatch, SequenceRows] | None = None
        self._ordered: tuple[PacketBatch, Integers, Mask] | None = None

    def order(self, batch: PacketBatch, columns: Columns) -> tuple[Integers, Mask]:
        """Return all rows of a batch grouped by link, sender and MsgId, in their order within a group.

        Returns:
            The rows; and whether each begins a group, bool.
        """
        if self._ordered is None or self._ordered[0] is not batch:
            msg_id = (columns.msg_id + 1).astype(np.uint32)
            keys = columns.processor_id, columns.link, msg_id, columns.spacecraft
            order = order_by(*keys)
            self._ordered = batch, order, changes(order, *keys)
        return self._ordered[1:]

    def follow(self, batch: PacketBatch, columns: Columns) -> SequenceRows:
        """Follow the counts of a batch's packets that have one; return the results for its rows."""
        if self._newest is not None and self._newest[0] is batch:
            return self._newest[1]
        out = _Results(
            {
                name: np.zeros(len(batch), np.int64 if name == "refilled_row" else np.int32)
                for name in SequenceRows.__struct_fields__
            },
            self._rows,
        )
        out.columns["stream"] -= 1
        self._rows += len(batch)
        has_count = (columns.msg_id != NO_MSG_ID) & (
            (columns.findings & np.uint32(Finding.SEQUENCE_UNSET)) == 0
        )
        order, _ = self.order(batch, columns)
        rows = order[has_count[order]]
        if len(rows):
            self._follow(batch, columns, _ordered(batch, columns, rows), out)
        self._newest = batch, SequenceRows(**out.columns)
        return self._newest[1]

    def whole(self, parts: Sequence[SequenceRows]) -> SequenceRows:
        """Join the results of ``follow`` for all batches so far, with later corrections.

        Counts that came later are subtracted from ``missing``. A row whose sender does not count becomes a
        row without a count.
        """
        joined = {
            name: np.concatenate([getattr(part, name) for part in parts])
            for name in SequenceRows.__struct_fields__
        }
        later = np.flatnonzero(joined["refilled"])
        np.subtract.at(joined["missing"], joined["refilled_row"][later], joined["refilled"][later])
        has_count = np.array([*(stream.has_count for stream in self.streams), False])
        silent = ~has_count[joined["stream"]]
        for name, column in joined.items():
            column[silent] = -1 if name == "stream" else 0
        return SequenceRows(**joined)

    def _follow(self, batch: PacketBatch, columns: Columns, groups: _Groups, out: _Results) -> None:
        rows, begins = groups.rows, groups.begins
        sizes = np.diff(begins, append=len(rows))
        stream_of = np.array([self._stream(item) for item in groups.keys.tolist()])
        out.columns["stream"][rows] = np.repeat(stream_of, sizes)
        if (stream_of < 0).any():
            tracked = stream_of >= 0
            if tracked.any():
                begins = np.cumsum(sizes[tracked]) - sizes[tracked]
                followed = _Groups(rows[np.repeat(tracked, sizes)], begins, groups.keys[tracked])
                self._follow(batch, columns, followed, out)
            return
        count = columns.sequence_count[rows].astype(np.uint16)
        ends = begins + sizes - 1
        streams = [self.streams[item] for item in stream_of.tolist()]
        jumps = _jumps(count, begins)
        step = (count[jumps] - count[jumps - 1]) & np.uint16(MODULUS - 1)
        inside = np.ones(len(jumps), np.bool_)
        inside[np.searchsorted(jumps, begins)] = False
        prints = _prints(batch, columns, groups, jumps[inside & ((step == 0) | (step > WINDOW))])
        same = jumps[inside & (step == 0)]
        last = np.array([(item.last_count, item.last_print) for item in streams])
        at_begin = (count[begins] == last[:, 0]) & (prints[begins] == last[:, 1])
        again = np.append(same[prints[same] == prints[same - 1]], begins[at_begin])
        place = np.array([item.packets for item in streams]) - begins
        for stream, size, newest, print_ in zip(
            streams, sizes.tolist(), count[ends].tolist(), prints[ends].tolist(), strict=True
        ):
            stream.packets += size
            stream.last_count, stream.last_print = newest, print_
        rest = np.arange(len(rows))
        if len(again):
            out.columns["duplicates"][rows[again]] = 1
            repeated = np.bincount(groups.owner(again), minlength=len(streams))
            for stream, more in zip(streams, repeated.tolist(), strict=True):
                stream.repeated += more
            rest = np.delete(rest, again)
            if not len(rest):
                return
            count, rows, prints = count[rest], rows[rest], prints[rest]
            jumps = _jumps(count, np.searchsorted(rest, begins))
        ends = np.append(jumps[1:], len(rows))
        owners = groups.owner(rest[jumps])
        steps = (count[jumps] - count[jumps - 1]).astype(np.int64) % MODULUS
        steps[np.flatnonzero(np.diff(owners, prepend=-1))] = 0
        mission = columns.mission_time_ns[rows]
        boots = np.where(mission > 0, batch.time_ns[rows] - mission, _NO_BOOT)
        runs = _Runs(jumps, ends, steps, count, rows, prints, rest + np.repeat(place, sizes)[rest], boots)
        parted = (steps <= 1) | (steps >= FORWARD) | (steps > WINDOW) & (count[jumps] < _FIRST_COUNTS)
        bare = (ends - jumps == 1) & (mission[jumps] <= 0)
        for owner, own in by_value(owners):
            stream, first = streams[owner], int(count[jumps[own[0]]])
            # Of a stream that does not count, only the first and the newest packet matter (rules 2 and 4d).
            still = bare[own].all() and (count[jumps[own]] == first).all() and stream.stands_at(first)
            if still:
                stream.take(runs, int(own[0]), out)
                stream.stay(int(prints[jumps[own[-1]]]))
                continue
            for begin, end in pairwise([*own[parted[own]].tolist(), int(own[-1]) + 1]):
                stream.take_all(runs, begin, end, out)

    def _stream(self, key: int) -> int:
        if key not in self._index:
            if len(self.streams) == _MOST_STREAMS:
                return -1
            self._index[key] = len(self.streams)
            self.streams.append(SequenceStream())
        return self._index[key]


class _Groups(msgspec.Struct, frozen=True, eq=False):
    """Rows of a batch grouped by stream, in their order; the start of each stream; its key."""

    rows: Integers
    begins: Integers
    keys: NDArray[np.uint64]

    def owner(self, at: Integers) -> Integers:
        """Return the stream that each place in ``rows`` belongs to."""
        return np.searchsorted(self.begins, at, side="right") - 1


def _ordered(batch: PacketBatch, columns: Columns, rows: Integers) -> _Groups:
    """Group the rows by stream (rule 1); most are grouped already."""
    fresh = changes(
        rows,
        columns.link,
        columns.spacecraft,
        columns.msg_id,
        columns.processor_id,
        columns.spacecraft_id,
        batch.source_address,
        batch.source_port,
        batch.destination_address,
        batch.destination_port,
        *((batch.ip_version,) if batch.ipv6 else ()),
    )
    starts = np.flatnonzero(fresh)
    first = rows[starts]
    identity = columns.spacecraft_id[first].astype(np.uint64) << np.uint64(32)
    identity |= columns.processor_id[first]
    source = _endpoints(batch, batch.source_address, batch.source_port, first)
    receiver = _endpoints(batch, batch.destination_address, batch.destination_port, first)
    route = columns.link[first].astype(np.uint64) << 32 | columns.msg_id[first].astype(np.uint64)
    route += (columns.spacecraft[first].astype(np.uint64) - 1) << 40
    sender = np.where(identity, identity, source).astype(np.uint64)
    keys = arrays.stirred(route + sender * arrays.MIX)
    keys = arrays.stirred(keys + receiver * (identity != 0))
    unique, _, which = distinct_rows(keys)
    if len(unique) == len(keys):
        return _Groups(rows, starts, keys)
    group = np.full(len(batch), len(unique), np.min_scalar_type(len(unique)))
    group[rows] = np.repeat(which, np.diff(starts, append=len(rows)))
    sizes = np.bincount(group[rows], minlength=len(unique))
    return _Groups(np.argsort(group, kind="stable")[: len(rows)], np.cumsum(sizes) - sizes, unique)


def _endpoints(
    batch: PacketBatch, address: NDArray[np.uint32], port: NDArray[np.uint16], rows: Integers
) -> NDArray[np.uint64]:
    """Return a number for the endpoint of each row, the same in every batch."""
    return np.asarray(batch.fixed(address)[rows] << np.uint64(16) | port[rows], np.uint64)


def _prints(batch: PacketBatch, columns: Columns, groups: _Groups, odd: Integers) -> NDArray[np.uint32]:
    """Return the fingerprints of those rows that may be compared with another; 0 for the others.

    They are the first and the newest ones of each stream, and all of a stream with an ``odd`` row, whose
    count is not a little ahead of the one before.
    """
    ends = np.append(groups.begins[1:], len(groups.rows))
    starts = np.maximum(groups.begins, ends - REPEATED)
    whole = groups.owner(odd)
    starts[whole] = groups.begins[whole]
    selection = np.zeros(len(groups.rows), np.bool_)
    selection[groups.begins] = True
    for first, end in zip(starts.tolist(), ends.tolist(), strict=True):
        selection[first:end] = True
    own = groups.rows[selection]
    prints = np.zeros(len(groups.rows), np.uint32)
    prints[selection] = (
        arrays.of_bytes(batch.data, columns.packet_offset[own], columns.packet_length[own]) >> 32
    )
    return prints


def _jumps(count: NDArray[np.uint16], begins: Integers) -> Integers:
    """Return the places where a stream begins, or its count does not increase by one."""
    jump = np.ones(len(count), np.bool_)
    jump[1:] = (count[1:] - count[:-1]) & np.uint16(MODULUS - 1) != 1
    jump[begins[begins < len(count)]] = True
    return np.flatnonzero(jump)


def _newest(boots: Integers) -> int:
    """Return the last boot that is known, else ``_NO_BOOT``."""
    if (last := int(boots[-1])) != _NO_BOOT or len(boots) == 1:  # nearly always: a tenth of the time
        return last
    dated = boots[boots != _NO_BOOT]
    return int(dated[-1]) if len(dated) else _NO_BOOT


def _same_boot(boots: Integers, at: int) -> int:
    """Return the end of the packets from ``at`` on that are of one boot, or all without a time."""
    boots = boots[at:]
    dated = boots != _NO_BOOT
    breaks = (dated[1:] != dated[:-1]) | (np.abs(np.diff(boots)) > BOOT_APART_NS)
    return at + (int(breaks.argmax()) + 1 if breaks.any() else len(boots))

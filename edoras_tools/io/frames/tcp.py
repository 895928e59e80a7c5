"""TCP segments to messages, in columns, with limited memory (RFC 9293).

The rules:

1. A row of the result is one message, as the link's ``Framing`` cuts it. Its time and number are those of the
   segment that completes it and all messages before it; rows are in the order of these segments.
2. A message that is alone in its segment keeps the captured frame. For any other message a segment is made
   that holds only this message: it has the headers of the segment that completed it, with the right sequence
   number, length and checksums, without SYN, FIN and RST. So a recording of the rows is again a capture of
   the same stream.
3. Bytes that are no message (the rest of one after missing bytes, or another protocol) are a row without a
   payload, with ``FRAGMENT`` and ``STREAM_GAP``; its frame has the bytes. A segment with bytes that came
   before is a row with ``FRAGMENT`` and ``STREAM_RESENT``. The first message after missing bytes has
   ``STREAM_GAP``.
4. Segments without bytes (SYN, FIN, acknowledgements) have no row.
5. Missing bytes are waited for ``_PATIENCE_NS`` of capture time, ``_LATE_NS`` if the other end acknowledged
   them (then they are missing only in the capture), or until 16 MiB wait. Whole frames wait and are put in
   front of the next batch; besides them, the state of a connection is small.
6. A connection whose beginning was not captured, or that lost bytes, is read from the first place on where a
   message surely starts (``_Cut._sure``).

In the usual case, one message a segment and all in order, no byte is copied and no Python runs per segment.
If bytes came twice with different values, the first ones are used.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any, Final

import msgspec
import numpy as np

from edoras_tools.io.frames.frame_batch import walk_records
from edoras_tools.io.frames.network import SegmentBytes, Segments, rebuilt
from edoras_tools.links.doors import NOT_A_MESSAGE, NOT_YET, Framing, StreamState
from edoras_tools.model import Finding, PacketBatch
from edoras_tools.wire.arrays import (
    PADDING,
    Integers,
    Mask,
    Octets,
    Places,
    by_key,
    copy_rows,
    gather,
    numbered,
)

if TYPE_CHECKING:
    from numpy.typing import NDArray


CONNECTIONS: Final = 1 << 16
"""Most directions that are remembered; above it, the oldest are forgotten."""
_PATIENCE_NS: Final = 1_000_000_000
_LATE_NS: Final = 50_000_000
_FAR: Final = 1 << 26
"""Bytes in sequence between two segments from which on they belong to different connections."""
_BEFORE: Final = 64
"""Segments of a connection that may come before its first one, at most."""
_MANY: Final = 8
"""Gaps in one direction from which on the pieces between them are handled together."""
_FIRST_WINDOW: Final = 1 << 10
_WINDOW: Final = 1 << 16
"""Bytes that are searched at once for the start of a message; ``_FIRST_WINDOW`` at first, then up to this."""
_FOLLOWERS: Final = 3
"""Messages that must follow a start of a message to prove it, as far as there are bytes."""
_SYN: Final = 2
_ACK: Final = 16
_WRAP: Final = 1 << 32
_PART: Final = np.uint32(Finding.FRAGMENT)
_GAP: Final = np.uint32(Finding.STREAM_GAP)
_RESENT: Final = np.uint32(Finding.STREAM_RESENT)


class _Shared(msgspec.Struct, eq=False):
    """State that both directions of a connection share.

    Attributes:
        state: state that the messages' contents depend on; None if each message is its own content.
    """

    state: StreamState | None

    @property
    def foreign(self) -> bool:
        """Whether the connection is another program's."""
        return self.state is not None and self.state.foreign


class _Direction(msgspec.Struct, eq=False):
    """One direction of a connection.

    Attributes:
        framing: framing that cuts its messages.
        shared: state of both directions.
        forward: whether it is the direction seen first.
        next: sequence number of the first byte that was not handed over; -1 before the first.
        begin: sequence number of the first byte after SYN; -1 if SYN was not captured.
        synced: whether a message starts at ``next``.
        gap: whether bytes before ``next`` are missing.
        synchronized: whether a message was ever read.
        sender: header bytes that identify the sender in all its messages; None if unknown.
    """

    framing: Framing
    shared: _Shared
    forward: bool
    next: int = -1
    begin: int = -1
    synced: bool = False
    gap: bool = False
    synchronized: bool = False
    sender: Octets | None = None


class _Pieces(msgspec.Struct, eq=False):
    """New bytes of a direction, in the order of the stream; all arrays have the same length.

    Attributes:
        segment: index of the segment that each is from, i64.
        offset: first byte in the data of the segments, i64.
        begin: place in the stream, i64, relative to the first byte that was not handed over.
        length: number of bytes, i64.
        untrimmed: whether the piece is all the data of its segment, bool.
    """

    segment: Integers
    offset: Integers
    begin: Integers
    length: Integers
    untrimmed: Mask

    def part(self, rows: slice) -> _Pieces:
        return _Pieces(*(getattr(self, name)[rows] for name in self.__struct_fields__))

    def __len__(self) -> int:
        return len(self.segment)


class _Rows(msgspec.Struct, eq=False):
    """The rows of the result; a list of arrays for each column.

    Attributes:
        segment: index of the segment that completes the row.
        offset: first byte, in the data of the segments followed by ``appended``.
        length: number of bytes.
        sequence: sequence number of the first byte.
        whole: whether the captured frame holds only this row.
        findings: ``Finding`` bits.
        direction: index of the direction in the present call.
        appended: bytes that were put in order; they follow the data of the segments.
        bytes: number of bytes in ``appended``.
    """

    segment: list[Integers] = msgspec.field(default_factory=list)
    offset: list[Integers] = msgspec.field(default_factory=list)
    length: list[Integers] = msgspec.field(default_factory=list)
    sequence: list[Integers] = msgspec.field(default_factory=list)
    whole: list[Mask] = msgspec.field(default_factory=list)
    findings: list[NDArray[np.uint32]] = msgspec.field(default_factory=list)
    direction: list[Integers] = msgspec.field(default_factory=list)
    appended: list[Octets] = msgspec.field(default_factory=list)
    bytes: int = 0


class StreamReassembler:
    """Puts the bytes of connections in order and cuts them into messages; see the rules of this module.

    Args:
        framings: framing of streams, by the port that is listened on.
    """

    def __init__(self, framings: Mapping[int, Framing]) -> None:
        self._framings = framings
        self._directions: dict[tuple[Any, ...], _Direction] = {}

    def messages(self, segments: Segments, *, final: bool = False) -> tuple[PacketBatch, Integers]:
        """Return the messages that some segments complete, except those of other programs' connections.

        Args:
            segments: the segments that wait from the last call, then new ones, in the order of their capture.
            final: nothing follows: do not wait for missing bytes.

        Returns:
            The messages, and the segments that wait for more: give their frames again with the next ones.
        """
        rows, waiting = _Rows(), [np.empty(0, np.int64)]
        used: list[_Direction] = []
        groups = list(self._groups(segments))
        acknowledged = {key: members[segments.flags[members] & _ACK != 0] for key, members in groups}
        for key, members in groups:
            way = self._direction(key)
            answers = acknowledged.get((key[0], key[3], key[4], key[1], key[2]))
            reached = segments.acknowledged[answers] if answers is not None else None
            follow = _Follow(segments, rows, way, len(used))
            used.append(way)
            waiting.append(follow.all(members, reached, final=final))
        while len(self._directions) > CONNECTIONS:
            del self._directions[next(iter(self._directions))]
        return _batch(segments, rows, used), np.unique(np.concatenate(waiting))

    def _groups(self, segments: Segments) -> Iterator[tuple[tuple[Any, ...], Integers]]:
        """Yield each direction that has segments: its key, and the indices of its segments."""
        ip = segments.ip
        addresses = ip.source.astype(np.uint64) << np.uint64(32) | ip.destination
        ports = segments.source_port.astype(np.uint64) << np.uint64(16) | segments.destination_port
        first, which = numbered(addresses, ports | ip.version.astype(np.uint64) << np.uint64(32))
        order = np.argsort(which, kind="stable")
        ends = np.cumsum(np.bincount(which, minlength=len(first)))[:-1]
        for members in np.split(order, ends) if len(first) else ():
            row = int(members[0])
            key = [int(ip.version[row])]
            for address, port in (
                (ip.source, segments.source_port),
                (ip.destination, segments.destination_port),
            ):
                key += [ip.addresses[address[row]] if key[0] == 6 else int(address[row]), int(port[row])]
            yield tuple(key), members

    def _direction(self, key: tuple[Any, ...]) -> _Direction:
        way = self._directions.get(key)
        if way is None:
            other = self._directions.get((key[0], key[3], key[4], key[1], key[2]))
            framing = self._framings.get(key[4]) or self._framings[key[2]]
            shared = other.shared if other else _Shared(framing.state())
            forward = not other.forward if other else True
            way = self._directions[key] = _Direction(framing, shared, forward)
        return way


class _Follow:
    """Follows one direction through the segments of one call."""

    def __init__(self, segments: Segments, rows: _Rows, way: _Direction, direction: int) -> None:
        self.segments, self.rows, self.way, self.direction = segments, rows, way, direction

    def all(self, members: Integers, reached: Integers | None, *, final: bool) -> Integers:
        """Follow the direction; return the segments that wait.

        Args:
            members: indices of its segments, in the order of their capture.
            reached: sequence numbers that the other end acknowledged in this call; None: no acknowledgement.
            final: see ``StreamReassembler.messages``.
        """
        way, segments = self.way, self.segments
        opening = members[segments.flags[members] & _SYN != 0]
        opening = opening[np.diff(segments.sequence[opening], prepend=way.begin) != 0]
        begin = [way.begin, *segments.sequence[opening].tolist()]
        places = np.searchsorted(members, opening)
        for number, first in enumerate(begin[1:]):
            places[number] = self._opened(members, int(places[number]), first)
        parts = np.split(members, np.maximum.accumulate(places))
        waiting = [members[:0]]
        for place, part in enumerate(parts):
            if place:
                way.next = way.begin = begin[place]
                way.synced, way.gap, way.sender = True, False, None
                if not segments.flags[opening[place - 1]] & _ACK:  # the first segment of a connection
                    way.shared.state = way.framing.state()
            if way.shared.foreign:
                continue
            holding = part[segments.length[part] > 0]
            sequence = segments.sequence[holding]
            far = np.flatnonzero(np.abs(_from(sequence[:-1], sequence[1:])) > _FAR) + 1
            pieces = np.split(holding, far)
            for number, piece in enumerate(pieces):
                last = place == len(parts) - 1 and number == len(pieces) - 1
                waiting.append(self._part(piece, reached if last else None, final=final or not last))
        return np.concatenate(waiting)

    def _opened(self, members: Integers, place: int, begin: int) -> int:
        """Return the index of a connection's first segment; it may be captured after later ones."""
        before = members[max(place - _BEFORE, 0) : place]
        ahead = _from(begin, self.segments.sequence[before])
        late = (ahead >= 0) & (ahead < _FAR) & (self.segments.length[before] > 0)
        return place - len(before) + int(np.argmax(late)) if late.any() else place

    def _part(self, members: Integers, reached: Integers | None, *, final: bool) -> Integers:
        """Follow one connection; see ``all``."""
        way, segments = self.way, self.segments
        if not len(members):
            return members
        sequence = segments.sequence[members]
        if way.next < 0 or abs(_from(way.next, sequence[:1])[0]) > _FAR:
            first = int(sequence[0] + _from(sequence[:1], sequence).min()) % _WRAP
            way.next, way.synced, way.gap = first, False, way.next >= 0
        base = way.next
        pieces, again = self._pieces(members, base)
        breaks = np.flatnonzero(pieces.begin > np.append(0, (pieces.begin + pieces.length)[:-1]))
        edges = [*breaks.tolist(), len(pieces)]
        given_up = self._lost(pieces, breaks, reached, base) | final
        ends = self._alone(pieces, breaks, given_up)
        waiting = members[:0]
        at = skipped = 0
        for place, edge in enumerate(edges):
            if place < skipped:
                continue
            more = edge < len(pieces)
            lost = more and bool(given_up[place])
            if lost and ends[place] > place and self._is_known(pieces, at):
                skipped, edge = int(ends[place]), edges[ends[place] - 1]  # noqa: PLW2901
                self._put_alone(pieces.part(slice(at, edge)), base)
                way.next = (base + int(pieces.begin[edge])) % _WRAP
                at = edge
                continue
            waiting = self._run(pieces.part(slice(at, edge)), base, keep=not (lost or final))
            if more and not lost:
                waiting = np.concatenate((waiting, pieces.segment[edge:]))
                break
            if more:
                way.next = (base + int(pieces.begin[edge])) % _WRAP
                way.synced, way.gap = False, True
            at = edge
        self._add(again, segments.start[again], segments.length[again], segments.sequence[again])
        if len(again):
            self.rows.whole[-1][:] = True
            self.rows.findings[-1][:] = _PART | _RESENT
        return waiting

    def _pieces(self, members: Integers, base: int) -> tuple[_Pieces, Integers]:
        """Put segments in the order of the stream; return new bytes, and the segments with resent bytes."""
        segments = self.segments
        start, length = _from(base, segments.sequence[members]), segments.length[members]
        if (start[1:] < start[:-1]).any():
            order = np.argsort(start, kind="stable")
            members, start, length = members[order], start[order], length[order]
        stop = start + length
        before = np.maximum(np.append(0, np.maximum.accumulate(stop)[:-1]), 0)
        twice = start < before
        if not twice.any():
            whole = np.ones(len(members), bool)
            return _Pieces(members, segments.start[members], start, length, whole), members[:0]
        # Runs of segments that overlap; all other segments stay as they are.
        run = np.cumsum(~twice)
        alone = ~twice & (np.append(run[1:], -1) != run)
        single = np.flatnonzero(alone)
        parts = [np.stack((single, start[single], stop[single]), axis=1)]
        again: list[int] = []
        apart = np.flatnonzero(~alone)
        for overlapping in np.split(apart, np.flatnonzero(np.diff(run[apart])) + 1):
            spans, resent = _first_bytes(members, start, stop, overlapping)
            parts.append(spans)
            again += resent
        row, begin, end = np.concatenate(parts)[np.argsort(np.concatenate(parts)[:, 1], kind="stable")].T
        segment = members[row]
        pieces = _Pieces(
            segment,
            segments.start[segment] + begin - start[row],
            begin,
            end - begin,
            (begin == start[row]) & (end == stop[row]),
        )
        copies = members[np.array(sorted(again), np.int64)]
        return pieces, copies[segments.fresh[copies]]

    def _lost(self, pieces: _Pieces, breaks: Places, reached: Integers | None, base: int) -> Mask:
        """Return, for each piece after missing bytes, whether these bytes are given up."""
        time_ns = self.segments.frames.time_ns
        passed = time_ns.max() - time_ns[pieces.segment[breaks]]
        lost = passed > _PATIENCE_NS
        if reached is not None and len(reached):
            lost |= (passed > _LATE_NS) & (_from(base, reached).max() >= pieces.begin[breaks])
        return np.asarray(lost)

    def _alone(self, pieces: _Pieces, breaks: Places, lost: Mask) -> Places:
        """Return the ends of runs of pieces that are one message each, with lost bytes between them.

        Returns:
            For each piece before a gap, the index of the first piece from it on that is no such message, or
            is of another sender; its own index if it is none itself.
        """
        framing, nobody = self.way.framing, np.arange(len(breaks))
        if len(breaks) < _MANY or framing.sender == slice(0):
            return nobody
        data, first = self.segments.frames.data, np.append(0, breaks[:-1])
        offset, length = pieces.offset[first], pieces.length[first]
        alone = lost & (breaks - first == 1) & (framing.lengths(data, offset, offset + length) == length)
        sender = gather(data, offset, framing.head)[:, framing.sender]
        others = np.append(True, (sender[1:] != sender[:-1]).any(axis=1))
        bounds = np.append(np.flatnonzero(~alone | others), len(breaks))
        return np.where(alone, bounds[np.searchsorted(bounds, nobody, side="right")], nobody)

    def _is_known(self, pieces: _Pieces, at: int) -> bool:
        """Return whether a piece begins like all messages of this direction."""
        way, data = self.way, self.segments.frames.data
        own = gather(data, pieces.offset[at : at + 1], way.framing.head)[:, way.framing.sender]
        return way.sender is not None and bool((own == way.sender).all())

    def _put_alone(self, pieces: _Pieces, base: int) -> None:
        """Add pieces that are one message each, with missing bytes after each of them."""
        self._add(pieces.segment, pieces.offset, pieces.length, base + pieces.begin)
        self.rows.whole[-1][:] = pieces.untrimmed
        self.rows.findings[-1][1:] = _GAP
        self._mark_gap()
        self.way.synced, self.way.synchronized, self.way.gap = False, True, True

    def _run(self, pieces: _Pieces, base: int, *, keep: bool) -> Integers:
        """Cut bytes without a gap; return the segments that wait for the rest of a message.

        Args:
            pieces: the bytes.
            base: sequence number of place 0 in the stream.
            keep: whether more bytes may follow.
        """
        way, segments = self.way, self.segments
        if not len(pieces):
            return pieces.segment
        data, length = segments.frames.data, pieces.length
        if way.synced and (way.framing.lengths(data, pieces.offset, pieces.offset + length) == length).all():
            latest = np.maximum.accumulate(pieces.segment)
            self._add(latest, pieces.offset, length, base + pieces.begin)
            self.rows.whole[-1][:] = pieces.untrimmed & (latest == pieces.segment)
            self._mark_gap()
            way.next = (base + int(pieces.begin[-1]) + int(length[-1])) % _WRAP
            return pieces.segment[:0]
        cut = _Cut(way, segments, pieces)
        spans, messages, consumed = cut.spans(keep=keep)
        self._add_spans(cut, spans, base, messages)
        way.next = (base + int(pieces.begin[0]) + consumed) % _WRAP
        return np.asarray(pieces.segment[cut.local + length > consumed])

    def _add_spans(self, cut: _Cut, spans: Integers, base: int, messages: Mask) -> None:
        """Add rows of bytes that were put in order; ``spans`` has the start and length of each row."""
        pieces, rows = cut.pieces, self.rows
        start, length = spans[:, 0], spans[:, 1]
        latest = np.maximum.accumulate(pieces.segment)
        last = np.searchsorted(cut.local + pieces.length, start + length)
        whole = (cut.local[last] == start) & (pieces.length[last] == length) & pieces.untrimmed[last]
        whole &= latest[last] == pieces.segment[last]
        used = len(self.segments.frames.data) + rows.bytes
        rows.appended.append(cut.buffer)
        rows.bytes += len(cut.buffer)
        self._add(
            latest[last],
            np.where(whole, pieces.offset[last], used + start),
            length,
            base + pieces.begin[0] + start,
        )
        rows.whole[-1][:] = whole
        rows.findings[-1][~messages] = _PART | _GAP
        # A message directly after bytes that are no message follows missing bytes.
        rows.findings[-1][1:][messages[1:] & ~messages[:-1]] |= _GAP
        if messages.any():
            self.way.gap |= bool(not messages[: int(np.argmax(messages))].all())
            self._mark_gap(int(np.argmax(messages)))
        self.way.gap |= len(messages) > 0 and not messages[-1]

    def _mark_gap(self, place: int = 0) -> None:
        """Set ``STREAM_GAP`` at the first message after missing bytes."""
        if self.way.gap:
            self.rows.findings[-1][place] |= _GAP
            self.way.gap = False

    def _add(self, segment: Integers, offset: Integers, length: Integers, sequence: Integers) -> None:
        rows, count = self.rows, len(segment)
        rows.segment.append(segment)
        rows.offset.append(offset)
        rows.length.append(length)
        rows.sequence.append(sequence % _WRAP)
        rows.whole.append(np.zeros(count, bool))
        rows.findings.append(np.zeros(count, np.uint32))
        rows.direction.append(np.full(count, self.direction))


class _Cut:
    """Consecutive bytes, copied end to end, that are cut into messages.

    Attributes:
        pieces: pieces that the bytes come from.
        local: start of each piece in ``buffer``, i64.
        buffer: the bytes with padding, u8.
    """

    def __init__(self, way: _Direction, segments: Segments, pieces: _Pieces) -> None:
        self.way, self.pieces = way, pieces
        self.local = pieces.begin - pieces.begin[0]
        self.total = int(self.local[-1] + pieces.length[-1])
        self.buffer = np.zeros(self.total + PADDING, np.uint8)
        copy_rows(self.buffer, self.local, segments.frames.data, pieces.offset, pieces.length)

    def spans(self, *, keep: bool) -> tuple[Integers, Mask, int]:
        """Cut the bytes.

        Returns:
            Start and length of each part, i64 (n, 2); whether each is a message, bool (n,); and the number of
            bytes of all parts. The rest of the bytes is the start of a message.
        """
        way, framing = self.way, self.way.framing
        bounds: list[Integers] = [np.empty((0, 2), np.int64)]
        kinds: list[Mask] = [np.empty(0, bool)]
        view = memoryview(self.buffer)  # type: ignore[arg-type]
        position = 0

        def put(starts: Integers, end: int, *, message: bool) -> None:
            bounds.append(np.stack((starts, np.diff(starts, append=end)), axis=1))
            kinds.append(np.full(len(starts), message))

        while position < self.total:
            if not way.synced:
                start = self._message_start(position)
                if start is None:
                    if keep and self.total - position <= min(framing.largest, _WINDOW):
                        break
                    if way.shared.state is not None and not way.synchronized:
                        way.shared.state.foreign = True
                    if self.total - position > _FIRST_WINDOW:
                        way.sender = None
                    start = self.total
                if start > position:
                    put(np.array([position]), start, message=False)
                position = start
                way.synced = position < self.total
                way.synchronized |= way.synced
                continue
            starts, end = walk_records(
                position,
                self.total,
                self.local,
                lambda at: (
                    at + np.maximum(framing.lengths(self.buffer, np.minimum(at, self.total), self.total), 0)
                ),
                lambda at: at + max(framing.length(view, at, self.total), 0),
            )
            if len(starts):
                put(starts, end, message=True)
                way.synchronized, way.sender = True, self._senders(starts[:1])
            position = end
            if position < self.total:
                if framing.length(view, position, self.total) == NOT_A_MESSAGE:
                    way.synced = False
                elif keep:
                    break
                else:
                    put(np.array([position]), self.total, message=False)
                    position = self.total
                    way.synced = False
        return np.concatenate(bounds), np.concatenate(kinds), position

    def _message_start(self, position: int) -> int | None:
        """Return the first place where a message surely starts; None if there is none."""
        framing, total = self.way.framing, self.total
        size = _FIRST_WINDOW
        while position < total:
            places = np.arange(position, min(position + size, total))
            lengths = framing.lengths(self.buffer, places, total)
            likely = (lengths > 0) & (places + lengths <= total) & self._likely(places)
            places, behind = places[likely], (places + lengths)[likely]
            sure = self._sure(places, behind)
            if sure.any():
                return int(places[np.argmax(sure)])
            position, size = position + size, min(2 * size, _WINDOW)
        return None

    def _likely(self, places: Integers) -> Mask:
        """Return at which places a message of the known sender, or a likely message, starts; bool (n,)."""
        way = self.way
        if way.sender is None or way.framing.sender == slice(0):
            return way.framing.likely(self.buffer, places, self.total)
        return np.asarray((self._senders(places) == way.sender).all(axis=1))

    def _sure(self, places: Integers, behind: Integers) -> Mask:
        """Return at which of some likely messages a message surely starts; bool (n,).

        Other messages of the same sender must follow, as far as there are bytes. If there are none, the
        sender must be known, or the message must fill whole segments.
        """
        framing, total = self.way.framing, self.total
        if framing.checked or not len(places):
            return np.ones(len(places), bool)
        fixed = framing.sender != slice(0)
        sender, starts, sure = self._senders(places), behind, np.ones(len(places), bool)
        for _ in range(_FOLLOWERS):
            lengths = framing.lengths(self.buffer, starts, total)
            if fixed:
                same = (self._senders(starts) == sender).all(axis=1)
            else:
                same = (starts + lengths > total) | framing.likely(self.buffer, starts, total)
            sure &= (lengths != NOT_A_MESSAGE) & (same | (lengths == NOT_YET))
            starts = np.minimum(starts + np.maximum(lengths, 0), total)
        edges = np.append(self.local, total)
        senders = np.isin(places, edges) & np.isin(behind, edges) | (fixed and self.way.sender is not None)
        return np.asarray(sure & (senders | (framing.lengths(self.buffer, behind, total) != NOT_YET)))

    def _senders(self, places: Integers) -> Octets:
        """Return the header bytes that identify the sender, one row a place; bytes past the end are zeros."""
        return gather(self.buffer, places, self.way.framing.head)[:, self.way.framing.sender]


def _first_bytes(
    members: Integers, start: Integers, stop: Integers, rows: Places
) -> tuple[Integers, list[int]]:
    """Choose, in segments that overlap, the bytes that came first.

    Args:
        members: numbers that increase in the order of arrival.
        start: place of each segment's first byte; bytes before 0 came earlier.
        stop: place after its last byte.
        rows: indices of the segments that overlap, in the order of ``start``.

    Returns:
        Row, start and end of the new bytes, i64 (n, 3); and the rows with bytes that came before.
    """
    spans: list[tuple[int, int, int]] = []
    again: list[int] = []
    covered = [(-_WRAP, 0)]  # in order, apart from each other
    for row in sorted(rows.tolist(), key=lambda item: int(members[item])):
        begin, end = int(start[row]), int(stop[row])
        first = bisect_right(covered, begin, key=lambda item: item[1])
        at, last, overlaps = begin, first, 0
        while last < len(covered) and covered[last][0] < end:
            low, high = covered[last]
            if at < low:
                spans.append((row, at, low))
            overlaps += min(high, end) - max(low, begin)
            at = max(at, high)
            last += 1
        if at < end:
            spans.append((row, at, end))
        span = [begin, end, *(edge for item in covered[first:last] for edge in item)]
        covered[first:last] = [(min(span), max(span))]
        # One byte that came before is a keep-alive (RFC 1122 section 4.2.3.6).
        if overlaps > (end - begin == 1):
            again.append(row)
    return np.array(spans, np.int64).reshape(-1, 3), again


def _from(base: int | Integers, sequence: Integers) -> Integers:
    """Return the distance of sequence numbers from ``base``, modulo 2**32, between -2**31 and 2**31."""
    return np.asarray((sequence - base + _WRAP // 2) % _WRAP - _WRAP // 2)


def _batch(segments: Segments, rows: _Rows, ways: list[_Direction]) -> PacketBatch:
    """Return the rows as a batch."""
    column: dict[str, NDArray[Any]] = {
        name: np.concatenate([np.empty(0, bool if name == "whole" else np.int64), *getattr(rows, name)])
        for name in _Rows.__struct_fields__
        if name not in {"appended", "bytes"}
    }
    order = np.argsort(column["segment"], kind="stable")
    column = {name: values[order] for name, values in column.items()}
    frames, ip = segments.frames, segments.ip
    segment, whole = column["segment"].astype(np.int64), column["whole"].astype(bool)
    findings = column["findings"].astype(np.uint32)
    data = np.concatenate((frames.data, *rows.appended))
    rebuilt_rows = np.flatnonzero(~whole)
    source = SegmentBytes(
        data, column["offset"][rebuilt_rows], column["length"][rebuilt_rows], column["sequence"][rebuilt_rows]
    )
    added, frame_offset, header = rebuilt(segments, segment[rebuilt_rows], source)
    offset, length = column["offset"].copy(), column["length"].copy()
    place, size = frames.offset[segment], frames.length[segment].astype(np.int64)
    place[rebuilt_rows] = frame_offset + len(data)
    size[rebuilt_rows] = header + length[rebuilt_rows]
    offset[rebuilt_rows] = place[rebuilt_rows] + header
    contents = _contents(data, column, findings, ways, len(data) + len(added))
    extra, rest, offset[rest], length[rest], part = contents
    findings[rest[part]] |= _PART
    foreign = np.array([way.shared.foreign for way in ways], bool)[column["direction"].astype(np.int64)]
    length[(findings & _PART) != 0] = 0
    original = frames.original_length[segment].astype(np.int64)
    original[rebuilt_rows] = size[rebuilt_rows]
    cut = whole & segments.cut[segment]
    batch = PacketBatch(
        data=np.concatenate((data, added, *extra, np.zeros(PADDING, np.uint8))),
        number=frames.number[segment],
        time_ns=frames.time_ns[segment],
        link_type=frames.link_type[segment],
        frame_offset=place,
        frame_length=size.astype(np.int32),
        original_length=original.astype(np.int32),
        offset=offset,
        length=length.astype(np.int32),
        source_address=ip.source[segment],
        source_port=segments.source_port[segment],
        destination_address=ip.destination[segment],
        destination_port=segments.destination_port[segment],
        ip_version=ip.version[segment],
        capture_findings=findings | cut * np.uint32(Finding.CAPTURE_CUT),
        ipv6=ip.addresses,
        streams=np.ones(len(segment), bool),
    )
    return batch.take(~foreign) if foreign.any() else batch


def _contents(
    data: Octets,
    column: Mapping[str, NDArray[Any]],
    findings: NDArray[np.uint32],
    ways: list[_Direction],
    used: int,
) -> tuple[list[Octets], Places, Integers, Integers, Mask]:
    """Return the contents of messages that differ from their bytes in the stream.

    Returns:
        The bytes; the rows they belong to; start and length of each, counted from ``used`` on; and which of
        them are only parts.
    """
    extra: list[Octets] = []
    parts: list[tuple[NDArray[Any], ...]] = [
        (np.empty(0, np.intp), np.empty(0, np.int64), np.empty(0, np.int64), np.empty(0, bool))
    ]
    own = (index for index, way in enumerate(ways) if way.shared.state is not None)
    for members in by_key(own, lambda index: id(ways[index].shared)).values():
        rows = np.flatnonzero(np.isin(column["direction"], members) & (findings & _PART == 0))
        talk = ways[members[0]].shared.state
        if not len(rows) or talk is None:
            continue
        forward = np.array([way.forward for way in ways])[column["direction"][rows].astype(np.int64)]
        content = talk.contents(data, column["offset"][rows], column["length"][rows], forward)
        extra.append(content.data)
        parts.append((rows, content.offset + used, content.length, content.part))
        used += len(content.data)
    rows, offset, length, part = (np.concatenate(items) for items in zip(*parts, strict=True))
    return extra, rows, offset, length, part

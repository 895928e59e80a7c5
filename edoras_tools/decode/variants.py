"""Detects the headers and envelopes of a source from its first packets.

Three kinds of build are in use (:data:`edoras_tools.wire.cfe.DETECTABLE`), and five formats of the envelope.
Nothing in a packet names them, so each sound packet is a vote for every kind that fits it:

1. Telemetry with a 16-byte header has four spare bytes of 0 at its end. If they are not 0, the bytes are
   either the low half of an extended header's time, which runs with the capture's clock, or the payload
   after a 12-byte header.
2. A payload starts where known content fits: an event with a printable name, a C struct of that length, a
   command that its app accepts with that length, or an envelope in front of CDR.
3. Another kind replaces the usual one only if it fits more packets, and at least two.
4. A conversation is read with the kinds that are the first to fit two of its packets; if there are several,
   each packet is read with the first that fits it (:mod:`edoras_tools.decode.spacecraft`). The first packets
   of each conversation are examined, and a sample of all that follow.
5. A value that an option or a route states is never detected.
6. Mission time is read in another byte order, or with other subseconds, if the times of 64 packets of one
   clock are then nearer to the capture's times by far, and no subseconds exceed a second. Its epoch is a
   usual one, possibly shifted by today's leap seconds, if packets then have the times at which they were
   captured.
"""

from __future__ import annotations

from collections.abc import Iterable
from itertools import product
from operator import itemgetter
from typing import TYPE_CHECKING, Any, Final, Literal, NamedTuple

import numpy as np
from msgspec.structs import replace

from edoras_tools.decode.spacecraft import LOOKED_AT, PLACES, Fitting, conversations
from edoras_tools.links.table import accepted
from edoras_tools.model import NO_ROUTE, PacketBatch
from edoras_tools.units import SECOND
from edoras_tools.wire import ccsds, cfe
from edoras_tools.wire.arrays import Octets, by_value, distinct, distinct_rows, gather, quantiles
from edoras_tools.wire.ccsds import VERSION_1
from edoras_tools.wire.envelope import DEFAULT, ENVELOPE_FORMATS, EnvelopeFormat, holds

if TYPE_CHECKING:
    from edoras_tools.decode.context import Context
    from edoras_tools.wire.arrays import Integers, Mask, Places

_ENOUGH: Final = 512
"""Sound packets after which detection ends."""
_MOST: Final = 4096
"""Most packets of a batch that are examined."""
_FIRST: Final = 64
"""Sound packets of each conversation that are examined, from its first on."""
_UNSOUND: Final = 16
"""Number of unsound packets that count as one sound packet: a conversation may have no sound ones."""
_SAMPLE: Final = 256
"""Packets of a later batch that are examined, and packets that must have passed before."""
_NAMED: Final = 3
_EXTENDED: Final = cfe.HEADERS.index(cfe.WITH_EXTENDED)
_PLAIN: Final = len(cfe.DETECTABLE)
"""Vote of a command without an extended header, which is the same with both telemetry headers."""
_NOTHING: Final = _PLAIN + 1
_LEAST: Final = 2
_TIMED: Final = 64
"""Fewest packets with a time that show the format of mission time."""
_WIDE_NS: Final = 3 * SECOND
"""Capture time that these packets must cover; their clock may wait for less than a second of it."""
_NEAR: Final = 0.7
"""Largest ratio of the spread of times to the next best spread."""
_ORDERS: Final[tuple[Literal["little"] | None, ...]] = (None, "little")
_TICKS: Final = (None, 10_000, 1_000, 100)
_EPOCHS: Final = (0, -378_691_200, 315_532_800, 315_964_800, 946_684_800, 946_728_000)
"""1970, 1958, 1980, 1980-01-06, 2000, and noon of 2000-01-01, in s since 1970."""
_LEAPS: Final = (0, 18, 37)
"""Seconds by which UTC is behind a clock without leap seconds: UTC itself, GPS, TAI."""
_GOES_ON_S: Final = 5
"""Largest difference, in s, between a clock that counts seconds and the capture's."""

_TIME_NOTE: Final = (
    "telemetry has mission time as {}, as its bytes show; 'time' of 'cfs' in a mission file says otherwise"
)


class _Kept(NamedTuple):
    """The parts of packets that are kept: first bytes, length, capture time in ns, row of the batch."""

    head: Octets
    length: Integers
    time_ns: Integers
    row: Places

    def take(self, rows: Places) -> _Kept:
        return _Kept(self.head[rows], self.length[rows], self.time_ns[rows], self.row[rows])

    def and_(self, other: _Kept) -> _Kept:
        pairs: Iterable[Any] = zip(self, other, strict=True)
        return _Kept(*map(np.concatenate, pairs))


class Variants:
    """Settles the headers and envelopes of a context while a source's first packets are decoded.

    Args:
        context: context whose ``headers`` and ``envelopes`` are set; ``notes`` gets a line for each.

    Attributes:
        settled: whether nothing is left to detect.
    """

    def __init__(self, context: Context) -> None:
        self._context = context
        self._packets = accepted(lambda item: item.packets)
        self._seek_headers = context.options.headers is None
        routes = context.mission.routes
        seek = context.options.envelope is None
        self._seek_envelopes = {at for at, route in enumerate(routes) if seek and not route.envelope}
        none = np.zeros(0, np.int64)
        self._sample = _Kept(np.zeros((0, LOOKED_AT), np.uint8), none, none, none)
        self._last_count = 0
        self._left = np.full(PLACES, _FIRST * _UNSOUND, np.int64)
        self._passed = self._since = 0
        self._votes = np.zeros((_NOTHING + 1, PLACES), np.int64)
        self._names: dict[int, str] = {}
        self._note = ""
        self._all_seen = self.settled = not (self._seek_headers or seek or context.options.time is None)

    def examine(self, batch: PacketBatch, link: Octets) -> None:
        """Examine a batch that is about to be decoded; ``link`` has the link of each row."""
        rows = np.flatnonzero(self._packets[link])
        if not self._all_seen:
            self._sample = self._sample.and_(self._sound(batch, rows[:_MOST], link))
            count = len(self._sample.length)
            # Live batches are small: the result is computed again each time the number has doubled.
            if count >= min(2 * self._last_count, _ENOUGH) and count > self._last_count:
                self._last_count = count
                self._detect()
            self._all_seen = count >= _ENOUGH
        if self._seek_headers and len(rows):
            self._examine_conversations(batch, rows, link)
        self.settled = self._all_seen and not self._seek_headers

    def _sound(self, batch: PacketBatch, rows: Places, link: Octets) -> _Kept:
        """Return the kept parts of those of some packets whose length field is right."""
        start = self._context.header_bytes[link[rows]]
        length = batch.length[rows].astype(np.int64) - start
        head = gather(batch.data, batch.offset[rows] + start, LOOKED_AT)
        total = ccsds.PRIMARY.column("packet_data_length", head).astype(np.int64) + ccsds.LENGTH_BIAS
        sound = (length > ccsds.PRIMARY.size) & (total == length)
        sound &= ccsds.PRIMARY.column("packet_version_number", head) == 0
        if self._context.msg_ids is VERSION_1:
            # With version 2, cFE sets the flag only where an app does.
            sound &= ccsds.PRIMARY.column("secondary_header_flag", head) == 1
        return _Kept(head[sound], length[sound], batch.time_ns[rows][sound], rows[sound])

    def _detect(self) -> None:
        context = self._context
        if self._seek_headers:
            votes = [int(part.sum()) for part in self._explained(self._sample)]
            best = int(np.argmax(votes))
            headers = cfe.DETECTABLE[best] if votes[best] >= _LEAST else cfe.STANDARD
            if headers is not context.headers:
                context.headers = headers
                context.described["headers"] = headers.name
                context.notes.append(
                    f"read with cFE's {headers.name}, as the packets' bytes show; "
                    "--set telemetry-header=16 reads them with the usual one"
                )
            self._settle()
        if context.options.envelope is None:
            self._detect_envelopes()
        self._detect_time()

    def _detect_time(self) -> None:
        """Detect the format of mission time in telemetry headers, if no other fits (rule 6)."""
        context, headers = self._context, self._context.headers
        timed = (self._sample.length >= headers.telemetry_bytes) & ~_commands(self._sample)
        timed &= headers.telemetry.column("seconds", self._sample.head, headers.start) != 0
        sample = self._sample.take(np.flatnonzero(timed))
        if len(sample.length) < _TIMED or np.ptp(sample.time_ns) < _WIDE_NS:
            return
        stated, spreads = cfe.MissionTime.of_text(context.options.time or ""), []
        for order, ticks in product(_ORDERS, _TICKS):
            time = replace(stated, byte_order=stated.byte_order or order, ticks=stated.ticks or ticks)
            words = time.layout(headers.telemetry).columns(sample.head, headers.start)
            seconds, subseconds = (words[name].astype(np.int64) for name in ("seconds", "subseconds"))
            low, middle, high = quantiles(sample.time_ns - time.ns(seconds, subseconds), 0.05, 0.5, 0.95)
            whole = subseconds.max() < (time.ticks or cfe.USUAL_TICKS)
            if whole and (ticks is None or len(distinct(subseconds)) > _TIMED // 2):
                spreads.append((high - low, middle, time))
        spread, middle, time = min(spreads, key=itemgetter(0), default=(np.inf, 0, stated))
        if spread > SECOND or any(item[0] * _NEAR < spread and item[2] != time for item in spreads):
            return
        for epoch_s in (base - leap for base in _EPOCHS for leap in _LEAPS):
            if stated.epoch_s is None and abs(middle - epoch_s * SECOND) < SECOND:
                time = replace(time, epoch_s=epoch_s)
        if time != context.time:
            note = _TIME_NOTE.format(context.time)
            context.time, context.described["time"] = time, str(time)
            context.notes[:] = [*(item for item in context.notes if item != note), _TIME_NOTE.format(time)]

    def _fitting(self, sample: _Kept) -> Fitting:
        return Fitting(self._context.structs, self._context.command_table, sample.head, sample.length)

    def _explained(self, sample: _Kept) -> list[Mask]:
        """Return which packets each kind of headers explains; an extended header's clock must run on."""
        fitting = self._fitting(sample)
        explained = [fitting.by(headers) for headers in cfe.DETECTABLE]
        timed = np.flatnonzero(explained[_EXTENDED] & ~_commands(sample))
        if len(timed):
            explained[_EXTENDED][timed] = _goes_on(sample.take(timed))
        return explained

    def _examine_conversations(self, batch: PacketBatch, rows: Places, link: Octets) -> None:
        """Count, for some packets of each conversation, the first headers that explain them."""
        place = conversations(batch)
        place = place if len(rows) == len(place) else place[rows]
        fresh = np.flatnonzero((self._left > 0).take(place))[:_MOST]
        self._passed += len(rows)
        self._since += len(rows)
        # Every batch is sampled where there are several builds, else a few batches in all: another build is
        # another boot, whose Telemetry Output sends from another port.
        rare = 0 if self._context.builds.several else self._passed // 4
        if not len(fresh) and self._since < max(_SAMPLE, rare):
            return
        self._since = 0
        picked = np.zeros(len(rows), bool)
        picked[fresh] = picked[:: max(1, len(rows) // _SAMPLE)] = True
        sample = self._sound(batch, rows[picked], link)
        own = place[np.searchsorted(rows, sample.row)]
        first = self._first(sample, own)
        touched, members, _ = distinct_rows(own)
        before = [self._kinds_of(value) for value in touched.tolist()]
        np.subtract.at(self._left, place[picked], 1)
        np.subtract.at(self._left, own, _UNSOUND - 1)
        np.add.at(self._votes, (first, own), 1)
        changed = False
        for value, member, kinds in zip(touched.tolist(), members.tolist(), before, strict=True):
            if self._kinds_of(value) != kinds:
                self._names[value] = _endpoint_names(batch, int(sample.row[member]))
                changed = True
        if changed:
            if not self._all_seen:
                self._last_count = len(self._sample.length)
                self._detect()
            self._settle()

    def _first(self, sample: _Kept, conversation: Places) -> Places:
        """Return the first kind that explains each packet; ``_PLAIN`` for plain commands, or ``_NOTHING``."""
        fitting = self._fitting(sample)
        first = np.select(
            [fitting.by(headers) for headers in cfe.DETECTABLE], range(len(cfe.DETECTABLE)), _NOTHING
        )
        timed = np.flatnonzero((first == _EXTENDED) & ~_commands(sample))
        for _, members in by_value(conversation[timed]):
            if len(members) > 1:
                first[timed[members[~_goes_on(sample.take(timed[members]))]]] = _NOTHING
        first[(first == 0) & _commands(sample)] = _PLAIN
        return first

    def _kinds_of(self, place: int) -> int:
        """Return the headers of a conversation, as a bit mask."""
        usual = self._context.headers
        plain = cfe.HEADERS.index(cfe.STANDARD if usual.extended else usual)
        bits = 0
        for number in np.flatnonzero(self._votes[:_NOTHING, place] >= _LEAST).tolist():
            bits |= 1 << (plain if number == _PLAIN else number)
        return bits

    def _settle(self) -> None:
        """Apply the detected headers, and add a note if they are not the usual ones."""
        context, usual = self._context, 1 << cfe.HEADERS.index(self._context.headers)
        kinds_of = {place: self._kinds_of(place) for place in self._names}
        context.builds.settle(
            context.headers, np.array(list(kinds_of), np.intp), np.array(list(kinds_of.values()), np.uint8)
        )
        if self._note in context.notes:
            context.notes.remove(self._note)
        if others := {place: bits for place, bits in kinds_of.items() if bits not in {0, usual}}:
            context.described.pop("headers", None)
            names = [self._names[place] for place in others]
            more = f" and {len(names) - _NAMED} more" if len(names) > _NAMED else ""
            kinds = {
                headers.name
                for number, headers in enumerate(cfe.DETECTABLE)
                for bits in others.values()
                if bits >> number & 1
            }
            self._note = (
                f"{', '.join(names[:_NAMED])}{more}: read with cFE's {' or '.join(sorted(kinds))}, as "
                f"the packets' bytes show; all else with the {context.headers.name}"
            )
            context.notes.append(self._note)

    def _detect_envelopes(self) -> None:
        """Give each route the envelope format of most of its packets."""
        context = self._context
        msg_ids = context.msg_ids
        msg_id = msg_ids.column(self._sample.head, self._sample.length)
        for index, members in by_value(context.any_route_of[msg_id]):
            if index != NO_ROUTE and index not in self._seek_envelopes:
                continue
            for command in (False, True):
                rows = members[msg_ids.is_command(msg_id[members]) == command]
                envelope = self._format(rows, command=command)
                if envelope is None:
                    continue
                if index == NO_ROUTE:
                    context.unrouted[command] = envelope
                elif envelope != context.envelopes[index]:
                    context.envelopes[index] = envelope
                    context.notes.append(
                        f"{context.mission.routes[index].topic} is read with the {envelope} envelope, as its "
                        "bytes show; --set envelope names another"
                    )

    def _format(self, rows: Places, *, command: bool) -> EnvelopeFormat | None:
        """Return the format that fits most of some packets; None if none fits two."""
        headers = self._context.headers
        at = headers.command_bytes if command else headers.telemetry_bytes
        body, have = self._sample.head[rows, at : at + DEFAULT.size + 4], self._sample.length[rows] - at
        votes = [int(holds(body, have, item).sum()) for item in ENVELOPE_FORMATS]
        best = int(np.argmax(votes))
        return ENVELOPE_FORMATS[best] if votes[best] >= _LEAST else None


def _commands(sample: _Kept) -> Mask:
    return np.asarray(VERSION_1.is_command(VERSION_1.column(sample.head, sample.length)))


def _goes_on(sample: _Kept) -> Mask:
    """Return in which telemetry the extended header's clock runs with the capture's clock."""
    extended = cfe.WITH_EXTENDED
    seconds = extended.telemetry.column("seconds", sample.head, extended.start).astype(np.int64)
    ahead = seconds - sample.time_ns // SECOND
    return np.asarray(np.abs(ahead - np.median(ahead)) <= _GOES_ON_S)


def _endpoint_names(batch: PacketBatch, row: int) -> str:
    """Return the text for the user that names a row's conversation."""
    source, target = batch.ends(row)
    return f"{source} > {target}"

"""Reassembles DDS samples from fragments: each becomes its own row behind the row of its last fragment.

Rules:

1. The row of a datagram is unchanged. A complete sample becomes its own message, as its writer could have
   sent
   it: header, time, one DATA. It has the time, number and endpoints of the datagram with its last fragment;
       its
   ``original_length`` is -1.
2. If all bytes of a sample come again, it becomes a message again: a copy, sent again or to another reader.
   Fewer bytes only replace those that a reader did not receive.
3. Memory is limited. Of incomplete samples at most ``MOST_OPEN`` and ``MOST_FRAGMENT_BYTES`` are kept; the
   oldest are dropped. A sample that claims more than ``LARGEST_SAMPLE`` is ignored. Of complete samples
   ``MOST_WHOLE_BYTES`` are kept; copies of older ones are not recognised.
"""

from __future__ import annotations

from collections import OrderedDict
from typing import TYPE_CHECKING, Final

import msgspec
import numpy as np

from edoras_tools.addons.rtps.link import RTPS, RTPS_MAGIC
from edoras_tools.addons.rtps.reader import distinct_guids, rtps_messages
from edoras_tools.addons.rtps.samples import LeftSamples
from edoras_tools.addons.rtps.wire import headers as rtps
from edoras_tools.addons.rtps.wire.messages import SubmessageFields, read_samples
from edoras_tools.io.frames.frame_batch import order_behind, packets_behind
from edoras_tools.links.doors import MOST_ENDPOINTS, Site
from edoras_tools.model import Columns, PacketBatch
from edoras_tools.sessions.ranges import KnownRanges
from edoras_tools.units import SECOND
from edoras_tools.wire.arrays import PADDING, Integers, Octets, copy_rows, numbered
from edoras_tools.words import plural

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator


MOST_FRAGMENT_BYTES: Final = 64 << 20
MOST_WHOLE_BYTES: Final = 16 << 20
MOST_OPEN: Final = 1 << 10
LARGEST_SAMPLE: Final = 32 << 20


class _Sample(msgspec.Struct, eq=False):
    """A sample, and the number of its bytes that came again."""

    data: Octets
    fragment_size: int
    fragments: KnownRanges = msgspec.field(default_factory=KnownRanges)
    again: int = 0

    def add(self, begin: int, end: int) -> bool:
        """Add a fragment; return whether it completes the sample, or a copy of it."""
        before, size = self.fragments.size, len(self.data)
        self.fragments.add(begin, end)
        new = self.fragments.size - before
        self.again += end - begin - new
        if self.fragments.size < size or not (new or self.again >= size):
            return False
        self.again -= 0 if new else size
        return True


class FragmentedSamples:
    """Reassembles the samples of a stream.

    Attributes:
        whole: number of reassembled samples.
        given_up: number of incomplete samples that were dropped for others.
        too_large: number of fragments of samples that are too large, or contradict each other.
    """

    def __init__(self) -> None:
        self.whole = self.given_up = self.too_large = 0
        self._open: OrderedDict[tuple[bytes, int], _Sample] = OrderedDict()
        self._whole: OrderedDict[tuple[bytes, int], _Sample] = OrderedDict()
        self._bytes = self._whole_bytes = 0
        self._done: dict[bytes, KnownRanges] = {}

    def notes(self) -> list[str]:
        """Return notes for users, one line each."""
        unfinished = len(self._open) + self.given_up
        lines = [f"DDS: {plural(self.whole, 'sample')} put together from fragments"] if self.whole else []
        if unfinished:
            lines.append(f"DDS: of {plural(unfinished, 'sample')} not all fragments came")
        if self.too_large:
            lines.append(
                f"DDS: {plural(self.too_large, 'fragment')} left out: of samples over 32 MiB, or odd"
            )
        return lines

    def take(
        self, batch: PacketBatch, columns: Columns, decode: Callable[[PacketBatch], Columns]
    ) -> tuple[PacketBatch, Columns]:
        """Return a batch and its columns with the samples that are completed in it."""
        rows = np.flatnonzero(columns.link == RTPS)
        rows = rows[batch.original_length[rows] >= 0]
        submessages = rtps_messages(batch, rows).submessages
        samples = read_samples(batch.data, submessages, rtps.SubmessageKind.DATA_FRAG)
        samples = samples.take(samples.fits)
        if not len(samples.which):
            return batch, columns
        own = submessages.take(samples.which)
        numbers = SubmessageFields(batch.data, own, rtps.SubmessageKind.DATA_FRAG)
        number = {
            name: numbers.number(name)
            for name in ("fragment_starting_num", "fragments_in_submessage", "fragment_size", "sample_size")
        }
        sequence = numbers.sequence_number("writer_sn")
        guids, writer = distinct_guids(numbers.guid("writer_id"))
        rebuilt: list[tuple[int, bytes]] = []
        first, which = numbered(writer, sequence)
        for index, at in enumerate(first.tolist()):
            members = np.flatnonzero(which == index)
            key = guids[writer[at]], int(sequence[at])
            some = {name: values[members] for name, values in number.items()}
            for place in self._add(key, some, batch.data, samples.start[members], samples.end[members]):
                last = int(members[place])
                body = self._finished(key)
                key_only = bool(own.flags[last] & rtps.SubmessageFlag.FRAGMENT_KEY)
                raw = sample_message(key, body, int(own.time_ns[last]), key_only=key_only)
                rebuilt.append((int(rows[own.row[last]]), raw))
        if not rebuilt:
            return batch, columns
        return _with_messages(batch, columns, sorted(rebuilt, key=lambda item: item[0]), decode)

    def _add(
        self,
        key: tuple[bytes, int],
        fields: dict[str, Integers],
        data: Octets,
        start: Integers,
        end: Integers,
    ) -> Iterator[int]:
        """Add fragments of one sample; yield the index of each that completes it, or a copy of it."""
        size, step = int(fields["sample_size"][0]), int(fields["fragment_size"][0])
        begin = (fields["fragment_starting_num"] - 1) * step
        stop = np.minimum(begin + fields["fragments_in_submessage"] * step, size)
        sound = (fields["sample_size"] == size) & (fields["fragment_size"] == step) & (begin >= 0)
        sound &= (stop > begin) & (end - start >= stop - begin)
        partial = self._open.get(key) or self._whole.get(key)
        if partial is not None:
            sound &= (len(partial.data) == size) & (partial.fragment_size == step)
        if not 0 < size <= LARGEST_SAMPLE or not step:
            sound[:] = False
        self.too_large += int(np.count_nonzero(~sound))
        ended = self._done.get(key[0])
        expired = partial is None and ended is not None and not ended.missing(key[1], key[1] + 1)
        if expired or not sound.any():
            return
        if partial is None:
            partial = self._open[key] = _Sample(np.zeros(size, np.uint8), step)
            self._bytes += size
            self._make_room()
        places = np.flatnonzero(sound)
        copy_rows(partial.data, begin[places], data, start[places], (stop - begin)[places])
        for place in places.tolist():
            if partial.add(int(begin[place]), int(stop[place])):
                yield place

    def _make_room(self) -> None:
        while len(self._open) > 1 and (self._bytes > MOST_FRAGMENT_BYTES or len(self._open) > MOST_OPEN):
            _, oldest = self._open.popitem(last=False)
            self._bytes -= len(oldest.data)
            self.given_up += 1

    def _finished(self, key: tuple[bytes, int]) -> bytes:
        """Return a complete sample, and move it from the incomplete to the complete ones."""
        if key not in self._open:
            return self._whole[key].data.tobytes()
        sample = self._whole[key] = self._open.pop(key)
        self._bytes -= len(sample.data)
        self._whole_bytes += len(sample.data)
        self.whole += 1
        if key[0] in self._done or len(self._done) < MOST_ENDPOINTS:
            self._done.setdefault(key[0], KnownRanges()).add(key[1], key[1] + 1)
        while len(self._whole) > 1 and (self._whole_bytes > MOST_WHOLE_BYTES or len(self._whole) > MOST_OPEN):
            self._whole_bytes -= len(self._whole.popitem(last=False)[1].data)
        return sample.data.tobytes()


def sample_message(key: tuple[bytes, int], body: bytes, time_ns: int, *, key_only: bool) -> bytes:
    """Return the message with a sample in one piece; its submessage length is 0: up to the end."""
    guid, sequence = key
    little = int(rtps.SubmessageFlag.LITTLE_ENDIAN)
    version = {"magic": int.from_bytes(RTPS_MAGIC, "big"), "version_major": 2, "version_minor": 5}
    head = rtps.RTPS_HEADER.emit(version | {"guid_prefix": guid[: rtps.PREFIX_BYTES]})
    if time_ns >= 0:
        layout = rtps.SUBMESSAGE_LAYOUTS[rtps.SubmessageKind.INFO_TS].little
        seconds, rest = divmod(time_ns, SECOND)
        # Rounded up, so that the same nanosecond is read again.
        stamp = {"seconds": seconds & 0xFFFFFFFF, "fraction": -(-(rest << 32) // SECOND)}
        numbers = {"submessage_id": rtps.SubmessageKind.INFO_TS, "flags": little, "octets_to_next_header": 8}
        head += layout.emit(numbers | stamp)
    layout = rtps.SUBMESSAGE_LAYOUTS[rtps.SubmessageKind.DATA].little
    values = {
        "submessage_id": rtps.SubmessageKind.DATA,
        "flags": little | (rtps.SubmessageFlag.KEY if key_only else rtps.SubmessageFlag.DATA),
        "octets_to_inline_qos": 16,
        "writer_id": guid[rtps.PREFIX_BYTES : rtps.GUID_BYTES],
        "writer_sn_high": sequence >> 32,
        "writer_sn_low": sequence & 0xFFFFFFFF,
    }
    return head + layout.emit(values) + body


def _with_messages(
    batch: PacketBatch,
    columns: Columns,
    messages: list[tuple[int, bytes]],
    decode: Callable[[PacketBatch], Columns],
) -> tuple[PacketBatch, Columns]:
    """Return a batch and its columns with the made messages behind their rows."""
    row = np.array([at for at, _ in messages])
    length = np.array([len(raw) for _, raw in messages], np.int64)
    data = np.frombuffer(b"".join(raw for _, raw in messages) + bytes(PADDING), np.uint8)
    whole = packets_behind(batch, data, row, np.cumsum(length) - length, length)
    order = order_behind(len(batch), row)
    more = decode(whole.take(np.flatnonzero(order >= len(batch))))
    joined = {
        name: np.concatenate([getattr(columns, name), getattr(more, name)])[order]
        for name in Columns.__struct_fields__
    }
    return whole, Columns(**joined)


class SampleRows:
    """Reassembles samples, and counts those without a topic."""

    def __init__(self, site: Site) -> None:
        self._site = site
        self._fragmented, self._left = FragmentedSamples(), LeftSamples()

    def take(
        self, batch: PacketBatch, columns: Columns, decode: Callable[[PacketBatch], Columns]
    ) -> tuple[PacketBatch, Columns]:
        """Return a batch and its columns with the samples that are completed in it."""
        if not (columns.link == RTPS).any():
            return batch, columns
        batch, columns = self._fragmented.take(batch, columns, decode)
        self._left.add(batch, np.flatnonzero(columns.link == RTPS), self._site.endpoints)
        return batch, columns

    def notes(self) -> list[str]:
        """Return notes for users, one line each."""
        return self._fragmented.notes() + self._left.notes(self._site.types, self._site.endpoints)

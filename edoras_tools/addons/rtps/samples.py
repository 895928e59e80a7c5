"""Samples whose topic was announced and whose type is known: as CDR in columns, and as messages on topics.

Also the filter fields of samples. ``SampleRows`` reassembles samples from fragments: each becomes its own row
behind the row of its last fragment. Rules:

1. The row of a datagram is unchanged. A complete sample becomes its own message, as its writer could have
   sent it: header, time, one DATA. It has the time, number and endpoints of the datagram with its last
   fragment; its ``original_length`` is -1.
2. If all bytes of a sample come again, it becomes a message again: a copy, sent again or to another reader.
   Fewer bytes only replace those that a reader did not receive.
3. Memory is limited. Of incomplete samples at most ``MOST_OPEN`` and ``MOST_FRAGMENT_BYTES`` are kept; the
   oldest are dropped. A sample that claims more than ``LARGEST_SAMPLE`` is ignored. Of complete samples
   ``MOST_WHOLE_BYTES`` are kept; copies of older ones are not recognised.
"""

from __future__ import annotations

from collections import Counter, OrderedDict
from collections.abc import Callable, Iterator
from functools import partial
from typing import TYPE_CHECKING, Any, Final

import msgspec
import numpy as np

from edoras_tools.addons.rtps import reader
from edoras_tools.addons.rtps import wire as rtps
from edoras_tools.addons.rtps.link import RTPS, RTPS_MAGIC
from edoras_tools.addons.rtps.reader import NamedSubmessages, distinct_guids, named_submessages, rtps_messages
from edoras_tools.addons.rtps.wire import SubmessageFields, guid_text, read_samples
from edoras_tools.decode.filters.rows import (
    BYTES_COST,
    INDEX_DTYPE,
    ColumnRows,
    FilterField,
    PacketRows,
    Series,
    ValueKind,
)
from edoras_tools.io.frames.frame_batch import order_behind, packets_behind
from edoras_tools.io.topics.messages import APART, RECORD, Messages, whole_messages
from edoras_tools.links.doors import MOST_ENDPOINTS, Endpoints, KnownSamples, Site, TopicSpace
from edoras_tools.model import Columns, Decoded, PacketBatch
from edoras_tools.sessions.ranges import MOST_RANGES, KnownRanges
from edoras_tools.units import SECOND
from edoras_tools.wire import arrays
from edoras_tools.wire.arrays import PADDING, Integers, Octets, copy_rows, numbered
from edoras_tools.wire.envelope import CDR_LE, ENCAPSULATION
from edoras_tools.words import listed, plural

if TYPE_CHECKING:
    from edoras_tools.ros import TypeStore


def known_samples(
    types: TypeStore | None, endpoints: Endpoints, batch: PacketBatch, rows: arrays.Places
) -> Iterator[KnownSamples]:
    """Yield the samples of each topic and type.

    Args:
        types: types; None: no type is known.
        rows: indices of rows with RTPS.
    """
    if types is None or not len(rows):
        return
    writers, samples = reader.topic_samples(batch.data, reader.rtps_messages(batch, rows).submessages)
    groups: dict[tuple[str, str], list[int]] = {}
    for index, guid in enumerate(writers):
        announced = endpoints.find(guid)
        if announced is not None and announced.topic and types.has(announced.ros_type):
            groups.setdefault((announced.ros_topic, announced.ros_type), []).append(index)
    after = batch.number[rows[samples.row]] >= endpoints.since(writers)[samples.writer]
    plain = _is_plain(batch.data, samples) & after
    for (topic, type_name), members in groups.items():
        members_rows = np.flatnonzero(plain & np.isin(samples.writer, members))
        if not len(members_rows):
            continue
        one = reader.TopicSamples(*(column[members_rows] for column in samples))
        length = (one.end - one.start).astype(np.int32)
        valid = types.valid(type_name, batch.data, one.start, length)
        of = one.writer, one.sequence_number, one.start, length, one.time_ns, valid
        yield KnownSamples(topic, type_name, rows[one.row], writers, *of)


class _Reader:
    """See :class:`~edoras_tools.links.doors.SampleReader`."""

    known_samples = staticmethod(known_samples)
    rows_on = staticmethod(reader.rows_on)

    def writers(self, batch: PacketBatch, rows: arrays.Places) -> list[bytes]:
        """Return the GUIDs of the writers in some rows."""
        return reader.named_submessages(batch, rows).writers

    def topic_of(self, guid: bytes, endpoints: Endpoints) -> str:
        """Return the name of a writer's topic; its GUID if it was not announced."""
        endpoint = endpoints.find(guid)
        return endpoint.ros_topic if endpoint and endpoint.topic else f"writer {guid_text(guid)}"


READER: Final = _Reader()


def _is_plain(data: arrays.Octets, samples: reader.TopicSamples) -> arrays.Mask:
    """Return which samples are plain CDR, like ROS messages: bool (n,)."""
    whole = samples.end - samples.start >= ENCAPSULATION.size
    head = arrays.gather(data, np.where(whole, samples.start, 0), ENCAPSULATION.size)
    return whole & (ENCAPSULATION.column("representation", head) <= CDR_LE)


class LeftSamples:
    """Counts the captured samples without a topic, or with an unknown type."""

    def __init__(self) -> None:
        self._early: Counter[bytes] = Counter()
        self._all: Counter[bytes] = Counter()

    def add(self, batch: PacketBatch, rows: arrays.Places, endpoints: Endpoints) -> None:
        """Count the samples of a batch.

        Args:
            rows: indices of rows with RTPS.
            endpoints: endpoints announced so far.
        """
        writers, samples = reader.topic_samples(batch.data, reader.rtps_messages(batch, rows).submessages)
        early = batch.number[rows[samples.row]] < endpoints.since(writers)[samples.writer]
        for counter, which in ((self._early, samples.writer[early]), (self._all, samples.writer)):
            for writer, number in enumerate(np.bincount(which, minlength=len(writers)).tolist()):
                if number and (writers[writer] in counter or len(counter) < MOST_ENDPOINTS):
                    counter[writers[writer]] += number

    def notes(self, types: TypeStore | None, endpoints: Endpoints) -> list[str]:
        """Return the numbers of such samples with the reason, one line each, for users."""
        endpoint_of = {guid: endpoints.find(guid) for guid in self._all}
        announced = {guid: item for guid, item in endpoint_of.items() if item is not None and item.topic}
        early = sum(number for guid, number in self._early.items() if guid in announced)
        never = {guid: number for guid, number in self._early.items() if guid not in announced}
        unread = Counter[str]()
        for guid, item in announced.items():
            if item.ros_topic.startswith("/") and types is not None and not types.has(item.ros_type):
                unread[item.ros_type] += self._all[guid] - self._early[guid]
        notes = []
        if early:
            notes.append(
                f"DDS: {plural(early, 'sample')} (and copies) came before the writer was announced: no topic"
            )
        if never:
            samples, writers = plural(sum(never.values()), "sample"), plural(len(never), "writer")
            notes.append(
                f"DDS: {samples} (and copies) of {writers} that the capture does not announce: no topic"
            )
        if unread := +unread:
            names, samples = listed(sorted(unread)), plural(unread.total(), "sample")
            notes.append(f"DDS: {samples} of unknown types ({names}): only bytes; --set msg-path adds types")
        return notes


def sample_fields() -> Iterator[FilterField]:
    """Yield the filter fields for the subjects of DDS submessages."""
    text, number = ValueKind.TEXT, ValueKind.NUMBER
    for name, kind, column, doc in (
        ("writer", text, _writers, "GUIDs of the writers that submessages are about, or from"),
        ("topic", text, _topics, "topics of these writers, as they were announced"),
        ("writer_sn", number, _numbers, "sequence numbers of samples, and of their fragments"),
    ):
        limits = (-(1 << 63), (1 << 63) - 1) if kind is number else None
        label, pick = f"{RTPS.label}.{name}", partial(_pick, name)
        yield FilterField(label, kind, pick, column, cost=BYTES_COST, limits=limits, many=True, doc=doc)


def _pick(name: str, _: PacketRows, decoded: Decoded) -> Any:
    values = (layer.values() for layer in decoded.layers if decoded.link is RTPS)
    return [item[name] for item in values if name in item] or None


def _submessages(rows: ColumnRows) -> NamedSubmessages:
    def make() -> NamedSubmessages:
        own = np.flatnonzero(rows.column("link") == RTPS)
        table = named_submessages(rows.batch, rows.indices()[own])
        return table._replace(row=own[table.row])

    return rows.once("rtps", make)


def _writers(rows: ColumnRows) -> Series:
    table = _submessages(rows)
    texts = [guid_text(guid) for guid in table.writers]
    return Series(len(rows), table.writer.astype(INDEX_DTYPE), table.row, table=texts)


def _topics(rows: ColumnRows) -> Series:
    table = _submessages(rows)
    endpoints = rows.context.endpoints
    endpoint = map(endpoints.find, table.writers)
    texts = [item.ros_topic if item else "" for item in endpoint]
    announced = rows.datagram("number")[table.row] >= endpoints.since(table.writers)[table.writer]
    return Series(len(rows), table.writer[announced].astype(INDEX_DTYPE), table.row[announced], table=texts)


def _numbers(rows: ColumnRows) -> Series:
    table = _submessages(rows)
    numbered = table.numbered
    return Series(len(rows), table.number[numbered], table.row[numbered])


MOST_SAMPLE_TOPICS: Final = 1 << 10
"""Most topics that are added; samples of further ones are left out."""
_METADATA: Final = {"link": RTPS.label}
_LOW: Final = (1 << 32) - 1


class SampleMessages:
    """Makes messages of samples; copies, and samples for several readers, make one message.

    Args:
        endpoints: endpoints announced so far.
    """

    def __init__(self, space: TopicSpace, endpoints: Endpoints) -> None:
        self._space, self._other_topics, self._endpoints = space, space.used_names(), endpoints
        self._announced = 0
        self._ranges: dict[bytes, KnownRanges] = {}
        self._floor: dict[bytes, int] = {}
        """Writer to the number below which a sample counts as a copy: older numbers are forgotten."""
        self._names: dict[tuple[str, str], str] = {}

    def messages(self, batch: PacketBatch, columns: Columns) -> list[Messages]:
        """Return the messages of the samples in a batch."""
        rows = np.flatnonzero(columns.link == RTPS)
        messages = (
            self._of(batch, item) for item in known_samples(self._space.types, self._endpoints, batch, rows)
        )
        return [item for item in messages if item is not None]

    def offer(self) -> None:
        """Add the announced topics of known types, before their first samples."""
        if len(self._endpoints.announced) == self._announced:
            return
        self._announced = len(self._endpoints.announced)
        for topic, type_name in self._endpoints.topics().items():
            if self._space.types.has(type_name) and (name := self._name(topic, type_name)):
                self._space.place(name, type_name, _METADATA)

    def _name(self, topic: str, type_name: str) -> str:
        """Return the name of the topic in the recording; empty if there are too many."""
        key = topic, type_name
        if key not in self._names and len(self._names) < MOST_SAMPLE_TOPICS:
            name = topic
            if name in self._other_topics:
                name = f"{APART}{name}"
            if name in self._names.values():
                name = f"{APART}/{type_name}{topic}"
            self._names[key] = name
        return self._names.get(key, "")

    def _new(self, item: KnownSamples) -> arrays.Mask:
        """Return which samples are new: bool (n,)."""
        new = np.ones(len(item.row), bool)
        for writer, at in arrays.by_value(item.writer):
            guid = item.writers[writer]
            if guid not in self._ranges and len(self._ranges) >= MOST_ENDPOINTS:
                continue
            ranges, floor = self._ranges.setdefault(guid, KnownRanges()), self._floor.get(guid, 0)
            new[at] = ranges.fresh(item.sequence_number[at]) & (item.sequence_number[at] >= floor)
            if ranges.count >= MOST_RANGES // 2:
                self._floor[guid] = ranges.start_of(ranges.count // 2)
                ranges.forget(self._floor[guid])
        return new

    def _of(self, batch: PacketBatch, item: KnownSamples) -> Messages | None:
        """Return the messages of one topic, with copied bytes: another process may write them."""
        trailing = self._space.types.trailing(item.type, batch.data, item.offset, item.length)
        whole = np.flatnonzero((trailing >= 0) & self._new(item))
        name = self._name(item.topic, item.type)
        if not len(whole) or not name:
            return None
        size = (item.length - trailing)[whole].astype(np.int32)
        start: arrays.Integers = np.cumsum(size, dtype=np.int64) - size
        data = np.zeros(int(size.sum()) + arrays.PADDING, np.uint8)
        arrays.copy_rows(data, start, batch.data, item.offset[whole], size)
        row, number = item.row[whole], self._space.place(name, item.type, _METADATA)
        log_ns = batch.time_ns[row]
        written_ns = np.where(item.written_ns[whole] >= 0, item.written_ns[whole], log_ns)
        heads = np.empty(len(whole), np.dtype(RECORD))
        sequence = item.sequence_number[whole] & _LOW
        return whole_messages(
            row, heads, number, sequence, log_ns, written_ns, (data, start, size), repeats=True
        )


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

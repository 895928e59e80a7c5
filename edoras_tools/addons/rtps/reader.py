"""Reads RTPS messages: one for people, many as columns; it also learns the announcements of participants."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from edoras_tools.addons.rtps import wire
from edoras_tools.addons.rtps import wire as rtps
from edoras_tools.links.protocol import BatchRows, Located
from edoras_tools.model import Decoded, Finding, LayerField, Link, PacketBatch
from edoras_tools.wire.arrays import Integers, Mask, Octets, Places, numbered

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from edoras_tools.addons.rtps.wire import SampleData
    from edoras_tools.links.doors import Endpoints, Reading, Site
    from edoras_tools.wire.layout import Layout

_TOLD_SETS: Final = {rtps.SubmessageKind.ACKNACK: "missing", rtps.SubmessageKind.GAP: "irrelevant"}
_NUMBERS: Final = {
    rtps.SubmessageKind.DATA: ("writer_sn",),
    rtps.SubmessageKind.DATA_FRAG: ("writer_sn",),
    rtps.SubmessageKind.HEARTBEAT_FRAG: ("writer_sn",),
    rtps.SubmessageKind.NACK_FRAG: ("writer_sn",),
    rtps.SubmessageKind.HEARTBEAT: ("first", "last"),
    rtps.SubmessageKind.ACKNACK: ("base",),
    rtps.SubmessageKind.GAP: ("gap_start", "base"),
}
"""Names of the sequence numbers in each kind of submessage."""
_MOST_TOLD: Final = 6


class TopicSamples(NamedTuple):
    """Complete samples in some messages, of user writers; columns of one length.

    Attributes:
        row: i64 (n,), index of the message.
        writer: i64 (n,), index of the writer.
        sequence_number: i64 (n,), the writer's sequence number.
        start: i64 (n,), first byte of the encapsulation.
        end: i64 (n,), one past the sample.
        time_ns: i64 (n,), time of writing, ns since 1970; -1 if it is not given.
    """

    row: Integers
    writer: Integers
    sequence_number: Integers
    start: Integers
    end: Integers
    time_ns: Integers


def topic_samples(data: Octets, submessages: wire.Submessages) -> tuple[list[bytes], TopicSamples]:
    """Return the GUIDs of writers, and their samples, without the keys of disposed instances.

    Args:
        data: u8, buffer of the submessages.
    """
    samples, own = _whole_samples(data, submessages)
    fields = wire.SubmessageFields(data, own, rtps.SubmessageKind.DATA)
    guids = fields.guid("writer_id")
    users = np.flatnonzero(_of_users(guids))
    writers, which = distinct_guids(guids[users])
    return writers, TopicSamples(
        own.row[users],
        which,
        fields.sequence_number("writer_sn")[users],
        samples.start[users],
        samples.end[users],
        own.time_ns[users],
    )


def rows_on(batch: PacketBatch, rows: Places, endpoints: Endpoints, holds: Callable[[str], bool]) -> Places:
    """Return those rows that have a complete sample of a topic announced before.

    Args:
        rows: indices of rows with RTPS.
        endpoints: endpoints announced so far.
        holds: function that returns whether a ROS topic is selected.
    """
    writers, samples = topic_samples(batch.data, rtps_messages(batch, rows).submessages)
    entries = [endpoints.find(guid) for guid in writers]
    own = np.array([item is not None and holds(item.ros_topic) for item in entries], bool)
    announced = batch.number[rows[samples.row]] >= endpoints.since(writers)[samples.writer]
    return rows[samples.row[own[samples.writer] & announced]]


def _whole_samples(data: Octets, parts: wire.Submessages) -> tuple[SampleData, wire.Submessages]:
    """Return the complete samples in DATA, and their submessages."""
    samples = wire.read_samples(data, parts, rtps.SubmessageKind.DATA)
    samples = samples.take(samples.fits & ((parts.flags[samples.which] & rtps.SubmessageFlag.DATA) != 0))
    return samples, parts.take(samples.which)


def _of_users(guids: NDArray[np.void]) -> Mask:
    """Return which endpoints are not built in: bool (n,)."""
    kind = guids.view(np.uint8).reshape(-1, rtps.GUID_BYTES)[:, -1]
    return (kind & rtps.BUILT_IN_KIND) != rtps.BUILT_IN_KIND


def distinct_guids(guids: NDArray[np.void]) -> tuple[list[bytes], Integers]:
    """Return the distinct GUIDs in order of their first use, and the index of each input's GUID, i64 (n,)."""
    halves = np.ascontiguousarray(guids).view(np.uint64).reshape(-1, 2)
    first, which = numbered(halves[:, 0], halves[:, 1])
    return [guids[at].tobytes() for at in first.tolist()], which


def rtps_messages(batch: PacketBatch, rows: Places) -> wire.RtpsMessages:
    """Read the messages of some rows of a batch."""
    return wire.read_messages(batch.data, batch.offset[rows], batch.length[rows])


def locate_samples(batch: PacketBatch, rows: Places, site: Site) -> Located:
    """Judge messages, and learn the endpoints that they announce."""
    located, messages = Located(len(rows)), rtps_messages(batch, rows)
    located.flag(Finding.TRUNCATED, messages.truncated)
    located.flag(Finding.LENGTH_MISMATCH, messages.odd)
    submessages = messages.submessages
    for kind in (rtps.SubmessageKind.DATA, rtps.SubmessageKind.DATA_FRAG):
        samples = wire.read_samples(batch.data, submessages, kind)
        odd = samples.which[~samples.fits]
        located.findings[submessages.row[odd]] |= np.uint32(Finding.LENGTH_MISMATCH)
    learn(batch.data, submessages, batch.number[rows], site.endpoints)
    return located


def learn(data: Octets, submessages: wire.Submessages, number: Integers, endpoints: Endpoints) -> None:
    """Learn the announcements of participants.

    Args:
        data: u8, buffer of the submessages.
        number: i64 (n,), number of the datagram of each message.
        endpoints: endpoints, which are extended.
    """
    samples, own = _whole_samples(data, submessages)
    guids = wire.SubmessageFields(data, own, rtps.SubmessageKind.DATA).guid("writer_id")
    announcing = np.isin(guids.view(">u4")[3::4], rtps.ANNOUNCING)  # the last word is the entity id
    for at in np.flatnonzero(announcing).tolist():
        payload = data[samples.start[at] : samples.end[at]].tobytes()
        if endpoints.is_new(payload):
            announcement = wire.read_announcement(payload)
            if announcement is not None:
                endpoints.learn(announcement, int(number[own.row[at]]))


def dissect_message(reading: Reading, site: Site) -> None:
    """Read one message, submessage by submessage.

    Raises:
        WireError: the message is cut. The layers read before stay.
    """
    data = reading.data
    reading.read(rtps.RTPS_HEADER, 0)
    octets = np.frombuffer(data, np.uint8)
    messages = wire.read_messages(octets, np.array([0]), np.array([len(data)]))
    submessages = messages.submessages
    learn(octets, submessages, np.array([reading.datagram.number]), site.endpoints)
    inside = _insides(octets, submessages)
    if messages.odd[0] or any(not fits for _, _, fits in inside.values()):
        reading.findings |= Finding.LENGTH_MISMATCH
    for index in range(len(submessages.row)):
        _submessage(reading, site.endpoints, submessages.take(np.array([index])), inside.get(index))
    if messages.truncated[0]:
        last = int(submessages.end[-1]) if len(submessages.end) else rtps.RTPS_HEADER.size
        reading.truncated(rtps.SUBMESSAGE.little.name, last, rtps.SUBMESSAGE.little.size)


def _insides(octets: Octets, submessages: wire.Submessages) -> dict[int, tuple[int, int, bool]]:
    """Return the start and end of each submessage's data, and whether its headers are sound."""
    out: dict[int, tuple[int, int, bool]] = {}
    for kind in (rtps.SubmessageKind.DATA, rtps.SubmessageKind.DATA_FRAG):
        samples = wire.read_samples(octets, submessages, kind)
        for at, which in enumerate(samples.which.tolist()):
            out[which] = (int(samples.start[at]), int(samples.end[at]), bool(samples.fits[at]))
    return out


def _submessage(
    reading: Reading, endpoints: Endpoints, one: wire.Submessages, inside: tuple[int, int, bool] | None
) -> None:
    """Read one submessage, and the sample in it."""
    kind, flags, at, end = (int(item[0]) for item in (one.kind, one.flags, one.start, one.end))
    little = bool(flags & rtps.SubmessageFlag.LITTLE_ENDIAN)
    timeless = kind == rtps.SubmessageKind.INFO_TS and flags & rtps.SubmessageFlag.NO_TIMESTAMP
    orders = rtps.SUBMESSAGE if timeless else rtps.SUBMESSAGE_LAYOUTS.get(kind, rtps.SUBMESSAGE)
    layout = orders.of(little=little)
    if not one.whole[0]:
        # Show the existing part, and where it should have ended.
        reading.read((layout if end - at >= layout.size else rtps.SUBMESSAGE.of(little=little)), at)
        claimed = rtps.SUBMESSAGE.of(little=little).parse(reading.data, at)["octets_to_next_header"]
        reading.truncated(layout.name, at, max(layout.size, rtps.SUBMESSAGE.little.size + claimed))
    values = reading.read(layout, at)
    if kind not in _NUMBERS or orders is rtps.SUBMESSAGE:
        return
    numbers, behind = {}, at + layout.size
    for name in _NUMBERS[rtps.SubmessageKind(kind)]:
        value = numbers[name] = (values[f"{name}_high"] << 32) + values[f"{name}_low"]
        place = at + layout.by_name[f"{name}_high"].start
        label = name if name.endswith("_sn") else f"{name}_sn"
        reading.extend(LayerField(label, value, place, place + 8, str(value), "the sequence number"))
    if kind in rtps.WITH_SEQUENCE_SET:
        name = _TOLD_SETS[rtps.SubmessageKind(kind)]
        listed = wire.sequence_set(
            reading.data, behind, end, little=little, base=numbers["base"], bits=values["num_bits"]
        )
        reading.extend(
            LayerField(name, listed, behind, end, _numbers_text(listed), "the samples whose bits are set")
        )
    fields = wire.SubmessageFields(np.frombuffer(reading.data, np.uint8), one, rtps.SubmessageKind(kind))
    guid = fields.guid("writer_id")[0].tobytes()
    place = at + layout.by_name["writer_id"].start
    endpoint = endpoints.find(guid, reading.datagram.number)
    told_of = {"writer": (wire.guid_text(guid), "GUID of the writer")}
    topic = endpoint.ros_topic if endpoint is not None else ""
    if endpoint is not None and topic:
        told_of |= {"topic": (topic, "as it announced"), "type": (endpoint.ros_type, "as it announced")}
    for name, (text, doc) in told_of.items():
        reading.extend(LayerField(name, text, place, place + rtps.ENTITY_BYTES, text, doc))
    if kind == rtps.SubmessageKind.DATA and flags & rtps.SubmessageFlag.INLINE_QOS:
        start = at + rtps.INLINE_AT + values["octets_to_inline_qos"]
        if status := wire.read_status(reading.data[start:end], "little" if little else "big"):
            reading.extend(LayerField("status", status, start, end, status, "what became of the instance"))
    sample = kind == rtps.SubmessageKind.DATA and flags & rtps.SubmessageFlag.DATA
    if endpoint is not None and topic and sample and inside and inside[2]:
        reading.sample(topic, endpoint.ros_type, inside[0], inside[1])


def _numbers_text(numbers: list[int]) -> str:
    return ", ".join(map(str, numbers)) or "none"


def submessage_places(layout: Layout, rows: BatchRows, link: Link) -> tuple[Places, Integers]:
    """Find the message header, or every submessage of one kind and byte order; a row may have several."""
    owner = np.flatnonzero(rows.column("link") == link)
    offset, length = rows.datagram("offset")[owner], rows.datagram("length")[owner]
    if layout is rtps.RTPS_HEADER:
        present = length >= layout.size
        return owner[present], offset[present]
    parts = wire.read_messages(rows.batch.data, offset, length).submessages
    little = parts.little == (layout.byte_order == "little")
    of_time = (parts.kind == rtps.SubmessageKind.INFO_TS) & (
        (parts.flags & rtps.SubmessageFlag.NO_TIMESTAMP) != 0
    )
    kinds = [kind for kind, orders in rtps.SUBMESSAGE_LAYOUTS.items() if layout in orders]
    if kinds:
        mask = little & (parts.kind == kinds[0]) & ~of_time & (parts.end - parts.start >= layout.size)
    else:
        plain = ~np.isin(parts.kind, list(rtps.SUBMESSAGE_LAYOUTS)) | of_time
        plain |= ~parts.whole & (parts.end - parts.start < wire.LEAST_BYTES[parts.kind])
        mask = little & plain
    return owner[parts.row[mask]], parts.start[mask]


def named_layers(decoded: Decoded) -> Iterator[tuple[str, Mapping[str, Any]]]:
    """Yield the kinds of the submessages, their topics or built-in endpoints, and their values."""
    for layer in decoded.layers:
        values = layer.values()
        if "submessage_id" not in values:
            continue
        name = rtps.SUBMESSAGE_NAMES.get(values["submessage_id"], f"0x{values['submessage_id']:02x}")
        if name in {"INFO_TS", "INFO_DST", "INFO_SRC", "PAD"}:
            continue
        of = values.get("topic") or rtps.BUILT_IN.get(values.get("writer_id", b""), "")
        yield f"{name} {of}".strip(), values


def rtps_summary(decoded: Decoded) -> str:
    """Return the kinds of the submessages, with their topics or built-in endpoints."""
    texts: list[str] = []
    for name, values in named_layers(decoded):
        numbers = [values[item] for item in ("writer_sn", "first_sn", "last_sn", "base_sn") if item in values]
        text = f"{name} {'..'.join(map(str, numbers))}".strip()
        if "status" in values:
            text += f" {values['status']}"
        if values.get("missing"):
            text += f" missing {_numbers_text(values['missing'])}"
        texts.append(text)
    return _listed(texts) or str(decoded.stop or "")


def rtps_kind(decoded: Decoded) -> str:
    """Return the kinds of the submessages, each once; empty if there are none."""
    return _listed(list(dict.fromkeys(name for name, _ in named_layers(decoded))))


def _listed(texts: list[str]) -> str:
    more = len(texts) - _MOST_TOLD
    return ", ".join(texts[:_MOST_TOLD]) + (f", ... {more} more" if more > 0 else "")


class UserSubmessages(NamedTuple):
    """DATA, HEARTBEAT, GAP and ACKNACK submessages about user writers, in order; columns of one length.

    Attributes:
        writers: GUIDs of writers.
        readers: GUIDs of readers.
        writer: i64 (n,), index of the writer.
        reader: i64 (n,), index of the reader.
        kind: i64 (n,), a ``SubmessageKind``.
        time_ns: i64 (n,), capture time, ns since 1970.
        first: i64 (n,), number of the sample (DATA); first available number (HEARTBEAT); first number that
            will not come (GAP); first number that is not acknowledged (ACKNACK).
        last: i64 (n,), number of the sample (DATA); last written number (HEARTBEAT); base of the set (GAP,
            ACKNACK).
        bits: i64 (n,), number of bits of the set.
        set_at: i64 (n,), position of the set's words in ``data``.
        end: i64 (n,), one past the submessage.
        little: bool (n,), whether the byte order is little-endian.
        data: u8, buffer of the submessages.
    """

    writers: list[bytes]
    readers: list[bytes]
    writer: Integers
    reader: Integers
    kind: Integers
    time_ns: Integers
    first: Integers
    last: Integers
    bits: Integers
    set_at: Integers
    end: Integers
    little: Mask
    data: Octets

    def of(self, writer: int) -> UserSubmessages:
        """Return the submessages about one writer."""
        mask = self.writer == writer
        shared = {"writers", "readers", "data"}
        return self._replace(
            **{name: getattr(self, name)[mask] for name in self._fields if name not in shared}
        )

    def numbers(self, index: int) -> list[int]:
        """Return the numbers in a set, whose bits are 1."""
        at, end = int(self.set_at[index]), int(self.end[index])
        words = self.data[at:end].tobytes()
        base, bits = int(self.last[index]), int(self.bits[index])
        return wire.sequence_set(words, 0, len(words), little=bool(self.little[index]), base=base, bits=bits)


_FOLLOWED: Final = {
    rtps.SubmessageKind.DATA: ("writer_sn", "writer_sn"),
    rtps.SubmessageKind.HEARTBEAT: ("first", "last"),
    rtps.SubmessageKind.GAP: ("gap_start", "base"),
    rtps.SubmessageKind.ACKNACK: ("base", "base"),
}


def user_submessages(batch: PacketBatch, rows: Places) -> UserSubmessages:
    """Return the submessages about user writers.

    Args:
        rows: indices of rows with RTPS.
    """
    submessages = rtps_messages(batch, rows).submessages
    parts: list[tuple[NDArray[Any], ...]] = []
    for kind, names in _FOLLOWED.items():
        at = np.flatnonzero((submessages.kind == kind) & submessages.whole)
        own = submessages.take(at)
        fields = wire.SubmessageFields(batch.data, own, kind)
        guids = fields.guid("writer_id")
        users = _of_users(guids)
        sets = kind in rtps.WITH_SEQUENCE_SET
        columns = (
            *(at, guids, fields.guid("reader_id"), np.full(len(at), int(kind)), batch.time_ns[rows[own.row]]),
            *(fields.sequence_number(name) for name in names),
            fields.number("num_bits") if sets else np.zeros(len(at), np.int64),
            *(own.start + rtps.SUBMESSAGE_LAYOUTS[kind].little.size, own.end, own.little),
        )
        parts.append(tuple(column[users] for column in columns))
    _, guids, reader_guids, *rest = _in_order(parts)
    writers, writer = distinct_guids(guids)
    readers, reader = distinct_guids(reader_guids)
    return UserSubmessages._make([writers, readers, writer, reader, *rest, batch.data])


def _in_order(parts: list[tuple[NDArray[Any], ...]]) -> list[NDArray[Any]]:
    """Join columns of several kinds of submessages, in the order of the first column."""
    joined = [np.concatenate(column) for column in zip(*parts, strict=True)]
    order = np.argsort(joined[0], kind="stable")
    return [column[order] for column in joined]


class NamedSubmessages(NamedTuple):
    """Submessages about one writer each, in order; columns of one length.

    Attributes:
        row: i64 (n,), index into the rows.
        writers: GUIDs of writers.
        writer: i64 (n,), index of the writer.
        number: i64 (n,), number of the sample; 0 for a submessage about several samples.
        numbered: bool (n,), whether it is about one sample.
    """

    row: Integers
    writers: list[bytes]
    writer: Integers
    number: Integers
    numbered: Mask


def named_submessages(batch: PacketBatch, rows: Places) -> NamedSubmessages:
    """Return the submessages that are about a writer.

    Args:
        rows: indices of rows with RTPS.
    """
    submessages = rtps_messages(batch, rows).submessages
    parts: list[tuple[NDArray[Any], ...]] = []
    for kind, names in _NUMBERS.items():
        at = np.flatnonzero((submessages.kind == kind) & submessages.whole)
        fields = wire.SubmessageFields(batch.data, submessages.take(at), kind)
        single = names == ("writer_sn",)
        number = fields.sequence_number("writer_sn") if single else np.zeros(len(at), np.int64)
        parts.append((at, fields.guid("writer_id"), number, np.full(len(at), single)))
    at, guids, *rest = _in_order(parts)
    writers, writer = distinct_guids(guids)
    return NamedSubmessages(submessages.row[at], writers, writer, *rest)

"""Samples whose topic was announced and whose type is known, as CDR in columns; and their filter fields."""

from __future__ import annotations

from collections import Counter
from functools import partial
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from edoras_tools.addons.rtps import reader
from edoras_tools.addons.rtps.link import RTPS
from edoras_tools.addons.rtps.reader import NamedSubmessages, named_submessages
from edoras_tools.addons.rtps.wire.messages import guid_text
from edoras_tools.decode.filters.rows import (
    BYTES_COST,
    INDEX_DTYPE,
    ColumnRows,
    FilterField,
    PacketRows,
    Series,
    ValueKind,
)
from edoras_tools.links.doors import MOST_ENDPOINTS, Endpoints, KnownSamples
from edoras_tools.wire.arrays.window import gather
from edoras_tools.wire.envelope import CDR_LE, ENCAPSULATION
from edoras_tools.words import listed, plural

if TYPE_CHECKING:
    from collections.abc import Iterator

    from edoras_tools.model import Decoded, PacketBatch
    from edoras_tools.ros import TypeStore
    from edoras_tools.wire.arrays.order import Mask, Octets, Places


def known_samples(
    types: TypeStore | None, endpoints: Endpoints, batch: PacketBatch, rows: Places
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

    def writers(self, batch: PacketBatch, rows: Places) -> list[bytes]:
        """Return the GUIDs of the writers in some rows."""
        return reader.named_submessages(batch, rows).writers

    def topic_of(self, guid: bytes, endpoints: Endpoints) -> str:
        """Return the name of a writer's topic; its GUID if it was not announced."""
        endpoint = endpoints.find(guid)
        return endpoint.ros_topic if endpoint and endpoint.topic else f"writer {guid_text(guid)}"


READER: Final = _Reader()


def _is_plain(data: Octets, samples: reader.TopicSamples) -> Mask:
    """Return which samples are plain CDR, like ROS messages: bool (n,)."""
    whole = samples.end - samples.start >= ENCAPSULATION.size
    head = gather(data, np.where(whole, samples.start, 0), ENCAPSULATION.size)
    return whole & (ENCAPSULATION.column("representation", head) <= CDR_LE)


class LeftSamples:
    """Counts the captured samples without a topic, or with an unknown type."""

    def __init__(self) -> None:
        self._early: Counter[bytes] = Counter()
        self._all: Counter[bytes] = Counter()

    def add(self, batch: PacketBatch, rows: Places, endpoints: Endpoints) -> None:
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

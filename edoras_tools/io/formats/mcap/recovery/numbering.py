"""Schemas and channels in a recovery: those read, those assumed, and their numbers in the new file."""

from __future__ import annotations

import struct
from contextlib import suppress
from dataclasses import replace
from functools import cached_property
from typing import TYPE_CHECKING

import msgspec
import numpy as np
from mcap.records import Channel, Schema

from edoras_tools.errors import RouteError
from edoras_tools.io.formats.mcap.file import McapFile, record_bytes
from edoras_tools.io.topics.messages import RECORD_BYTES
from edoras_tools.io.topics.streams import Streams
from edoras_tools.mission import Mission
from edoras_tools.ros import TypeStore

if TYPE_CHECKING:
    from collections.abc import Container, Hashable, Mapping

    from edoras_tools.io.formats.mcap.recovery.records import Walked

RecordId = tuple[type, int]
"""The kind of a record, ``Schema`` or ``Channel``, and its number."""


class Definitions:
    """The schemas and channels of one file.

    Args:
        schemas: proved schemas by id.
        channels: proved channels by id.

    Attributes:
        altered: whether a record differed from a proved one.
        late: records that later chunks prove, by type and id; None where two of them differ.
    """

    def __init__(self, schemas: dict[int, Schema], channels: dict[int, Channel]) -> None:
        self._proved = {*((Schema, key) for key in schemas), *((Channel, key) for key in channels)}
        self._known: dict[RecordId, Schema | Channel | None] = {}
        self._known |= {(Schema, key): item for key, item in schemas.items()}
        self._known |= {(Channel, key): item for key, item in channels.items()}
        self.altered = False
        self.late: Mapping[RecordId, Schema | Channel | None] = {}

    @property
    def complete(self) -> bool:
        """Whether a summary lists the channels."""
        return any(kind is Channel for kind, _ in self._proved)

    def _record(self, kind: type, number: int) -> Schema | Channel | None:
        key = kind, number
        return self._known.get(key) if key in self._proved else self.late.get(key) or self._known.get(key)

    def learn(self, record: Schema | Channel) -> None:
        """Add a record. Proved records are never replaced; of two that differ, neither is used."""
        key = type(record), record.id
        if key not in self._known and any(kind is type(record) for kind, _ in self._proved):
            return  # it belongs to a recording inside an attachment, not to this file
        if key in self._known and self._known[key] != record:
            self.altered = True
            if key not in self._proved:
                self._known[key] = None
            return
        self._known.setdefault(key, record)

    def agrees(self, record: Schema | Channel) -> bool:
        """Return whether a record equals the one in use, or is the only one of its kind and number."""
        return (self._record(type(record), record.id) or record) == record

    def channel(self, channel_id: int) -> tuple[Channel, Schema | None] | None:
        """Return a channel and its schema (None if unknown); None if the channel is unknown."""
        channel = self._record(Channel, channel_id)
        return (channel, self.schema(channel.schema_id)) if isinstance(channel, Channel) else None

    def below(self, record: Schema | Channel) -> Schema | None:
        """Return the schema of a channel; None if it is unknown, or if the record is a schema."""
        return self.schema(record.schema_id) if isinstance(record, Channel) else None

    def schema(self, schema_id: int) -> Schema | None:
        """Return a schema; None if it is unknown."""
        schema = self._record(Schema, schema_id)
        return schema if isinstance(schema, Schema) else None


class Stretch(msgspec.Struct):
    """The results of one reading for a stretch of the file without damage, for the next reading.

    Attributes:
        proved: schemas and channels in chunks whose checksum is right; None where two of them differ.
        fits: whether all messages of a channel without a record could be of our recorder, by channel.
    """

    proved: dict[RecordId, Schema | Channel | None] = msgspec.field(default_factory=dict)
    fits: dict[int, bool] = msgspec.field(default_factory=dict)

    def learn(self, record: Schema | Channel) -> None:
        """Add a record of a chunk whose checksum is right."""
        key = type(record), record.id
        self.proved[key] = record if self.proved.get(key, record) == record else None


class KnownTopics:
    """The channels of a recording of ours, with their usual numbers: the project's, then the mission's."""

    def __init__(self, mission: Mission | None = None, types: TypeStore | None = None) -> None:
        self._mission, self._types = mission or Mission(), types or TypeStore()

    @cached_property
    def _channels(self) -> list[tuple[Channel, Schema]]:
        streams = Streams(self._mission, self._types)
        schemas = {
            name: Schema(id=number, name=name, encoding="ros2msg", data=text.encode())
            for number, (name, text) in enumerate(streams.definitions.items(), 1)
        }
        return [
            (
                Channel(
                    id=number,
                    topic=topic.name,
                    message_encoding=topic.encoding,
                    metadata={"offered_qos_profiles": "", **topic.metadata},
                    schema_id=schemas[topic.type].id,
                ),
                schemas[topic.type],
            )
            for number, topic in enumerate(streams.topics, 1)
        ]

    def fits(self, number: int, walked: Walked) -> bool:
        """Return whether all messages of a channel in a chunk are valid for our channel of that number."""
        if not 0 < number <= len(self._channels):
            return False
        rows = walked.channel == number
        offset = walked.start[rows] + RECORD_BYTES
        length = (walked.end[rows] - offset).astype(np.int32)
        name = self._channels[number - 1][1].name
        behind = self._types.trailing(name, walked.data, offset, length)
        return bool(((behind >= 0) & (behind <= self._types.most_trailing(name))).all())

    def channel(self, number: int, stretch: Stretch) -> tuple[Channel, Schema] | None:
        """Return our channel and its schema; None if the stretch is not of our recorder (no datagrams)."""
        return self._channels[number - 1] if stretch.fits.get(1) and stretch.fits.get(number) else None

    def definition(self, name: str) -> str:
        """Return the definition of a type; empty if it is unknown."""
        with suppress(RouteError):
            return self._types.definition(name)
        return ""

    def schema(self, topic: str) -> Schema | None:
        """Return the schema of a topic whose own record is lost; None if the topic is unknown."""
        return next((schema for channel, schema in self._channels if channel.topic == topic), None)


class Numbering:
    """Assigns a unique number to each channel and schema; it keeps its own number if that is free.

    Args:
        out: the file to write them to; None to write nothing.

    Attributes:
        topics: topic of each channel, by number.
    """

    def __init__(self, out: McapFile | None) -> None:
        self._out = out
        self._numbers: dict[Hashable, int] = {}
        self._records: dict[RecordId, Schema | Channel] = {}
        self._written: set[RecordId] = set()
        self._last: dict[tuple[int, int], tuple[int, Channel, Schema | None]] = {}
        """Numbers already assigned, by the identity of the objects, which are kept alive here."""
        self.topics: dict[int, str] = {}

    def schema(self, schema: Schema, *, write: bool = True, inside: Container[RecordId] = ()) -> int:
        """Number a schema, and write it if it is new; see ``channel``."""
        key = (schema.id, schema.name, schema.encoding, bytes(schema.data))
        return self._put(key, schema, write=write, inside=inside)

    def keeps(self, record: Schema | Channel, schema: Schema | None) -> bool:
        """Return whether a record, and the schema of a channel, keep their numbers; nothing is written."""
        if isinstance(record, Schema):
            return self.schema(record, write=False) == record.id
        number = self.number(record, schema)
        return number == record.id and self._records[Channel, number] == record

    def number(self, channel: Channel, schema: Schema | None) -> int:
        """Number a channel and its schema, without writing them."""
        return self.channel(channel, schema, write=False)

    def channel(
        self, channel: Channel, schema: Schema | None, *, write: bool = True, inside: Container[RecordId] = ()
    ) -> int:
        """Number a channel, and write it and its schema if they are new.

        Args:
            schema: its schema, or None.
            inside: kinds and numbers of records in the chunk itself, which are not written again.
        """
        last = self._last.get((id(channel), id(schema)))
        if last is not None:
            return last[0]
        below = 0
        if schema is not None:
            below = self.schema(schema, write=write, inside=inside)
        meta = tuple(sorted(channel.metadata.items()))
        number = self._put(
            (channel.id, channel.topic, channel.message_encoding, meta, below),
            replace(channel, schema_id=below),
            write=write,
            inside=inside,
        )
        self.topics[number] = channel.topic
        if write:
            self._last[id(channel), id(schema)] = number, channel, schema
        return number

    def _put(
        self, key: Hashable, record: Schema | Channel, *, write: bool, inside: Container[RecordId]
    ) -> int:
        kind = type(record)
        if key not in self._numbers:
            number = record.id
            while (kind, number) in self._records:
                number = number % 0xFFFF + 1
            self._numbers[key] = number
            self._records[kind, number] = replace(record, id=number)
        number = self._numbers[key]
        if write and (kind, number) not in self._written:
            self._written.add((kind, number))
            self._write(self._records[kind, number], inside=(kind, number) in inside)
        return number

    def _write(self, record: Schema | Channel, *, inside: bool) -> None:
        if self._out is None:
            return
        if isinstance(record, Schema):
            self._out.summary.schemas[record.id] = record
        else:
            self._out.summary.channels[record.id] = record
        if not inside:
            self._out.add_bytes(record_bytes(record))


def renumbered(message: bytes, channel_id: int) -> bytes:
    """Return a message's content with another channel id."""
    return struct.pack("<H", channel_id) + message[2:]

"""Schemas and channels of one or several files, numbered and written for one file."""

from __future__ import annotations

import struct
from dataclasses import replace
from typing import TYPE_CHECKING

from mcap.records import Channel, Schema

from edoras_tools.io.formats.mcap.file import McapFile, record_bytes

if TYPE_CHECKING:
    from collections.abc import Hashable


class Definitions:
    """The schemas and channels of one file.

    Args:
        schemas: the proved ones, by id.
        channels: the proved ones, by id.

    Attributes:
        altered: whether a record differed from a proved one.
    """

    def __init__(self, schemas: dict[int, Schema], channels: dict[int, Channel]) -> None:
        self._proved = {*((Schema, key) for key in schemas), *((Channel, key) for key in channels)}
        self._known: dict[tuple[type, int], Schema | Channel | None] = {}
        self._known |= {(Schema, key): item for key, item in schemas.items()}
        self._known |= {(Channel, key): item for key, item in channels.items()}
        self.altered = False

    def learn(self, record: Schema | Channel) -> None:
        """Add a record. Proved records are never replaced; of two that differ, neither is used."""
        key = type(record), record.id
        if key not in self._known and any(kind is type(record) for kind, _ in self._proved):
            return  # not of this file: of a recording inside an attachment
        if key in self._known and self._known[key] != record:
            self.altered = True
            if key not in self._proved:
                self._known[key] = None
            return
        self._known.setdefault(key, record)

    def agrees(self, record: Schema | Channel) -> bool:
        """Return whether a record is the one that is used, or the only one of its kind and number."""
        return self._known.get((type(record), record.id), record) == record

    def channel(self, channel_id: int) -> tuple[Channel, Schema | None] | None:
        """Return a channel and its schema; None if either is unknown."""
        channel = self._known.get((Channel, channel_id))
        if not isinstance(channel, Channel):
            return None
        schema = self._known.get((Schema, channel.schema_id))
        if isinstance(schema, Schema):
            return channel, schema
        return None if channel.schema_id else (channel, None)

    def below(self, record: Schema | Channel) -> Schema | None:
        """Return the schema of a channel; None if it is unknown, and for a schema."""
        return self.schema(record.schema_id) if isinstance(record, Channel) else None

    def schema(self, schema_id: int) -> Schema | None:
        """Return a schema; None if it is unknown."""
        schema = self._known.get((Schema, schema_id))
        return schema if isinstance(schema, Schema) else None


class Numbering:
    """Assigns a unique number to each channel and schema; its own number if that is free.

    Args:
        out: the file to write them to; None to write nothing.

    Attributes:
        topics: the topic of each channel, by its number.
    """

    def __init__(self, out: McapFile | None) -> None:
        self._out = out
        self._numbers: dict[Hashable, int] = {}
        self._records: dict[tuple[type, int], Schema | Channel] = {}
        self._written: set[tuple[type, int]] = set()
        self._last: dict[tuple[int, int], tuple[int, Channel, Schema | None]] = {}
        """Numbers already assigned, by the identity of the objects, which are kept alive here."""
        self.topics: dict[int, str] = {}

    def schema(self, schema: Schema, *, write: bool = True, inside: bool = False) -> int:
        """Number a schema, and write it if it is new; see ``channel``."""
        key = (schema.id, schema.name, schema.encoding, bytes(schema.data))
        return self._put(key, schema, write=write, inside=inside)

    def keeps(self, record: Schema | Channel, schema: Schema | None) -> bool:
        """Return whether a record keeps its number, a channel that of its schema too; nothing is written."""
        if isinstance(record, Schema):
            return self.schema(record, write=False) == record.id
        number = self.number(record, schema)
        return number == record.id and self._records[Channel, number] == record

    def number(self, channel: Channel, schema: Schema | None) -> int:
        """Number a channel and its schema, without writing them."""
        return self.channel(channel, schema, write=False)

    def channel(
        self, channel: Channel, schema: Schema | None, *, write: bool = True, inside: bool = False
    ) -> int:
        """Number a channel, and write it and its schema if they are new.

        Args:
            schema: its schema, or None.
            inside: a chunk contains it, so it is not written again.
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
        self, key: Hashable, record: Schema | Channel, *, write: bool = True, inside: bool = False
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
            self._write(self._records[kind, number], inside=inside)
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

"""Decides the link of a datagram: among the links that claim its port, the one with the best evidence.

On the demos' single host cpu2's CI port equals TO's destination port (both 1235): the port is not enough.
"""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from edoras_tools.links import table
from edoras_tools.model import OTHER, Datagram, Finding, Link, PacketBatch
from edoras_tools.wire.arrays.order import Mask, Octets, Places, by_value
from edoras_tools.wire.arrays.window import gather

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from edoras_tools.decode.context import Context
    from edoras_tools.wire.layout import Layout


class _Datagram:
    """One datagram as a :class:`~edoras_tools.links.protocol.Seen`."""

    def __init__(self, datagram: Datagram, context: Context) -> None:
        self._payload = datagram.payload
        self._have = len(datagram.payload)
        # Bytes that the capture cut off count.
        self.length = self._have + max(datagram.original_length - len(datagram.frame), 0)
        self.destination_port = datagram.destination.port
        self._context = context
        self.to_cfs = context.is_cfs(datagram.destination)
        self.from_cfs = context.is_cfs(datagram.source)

    @property
    def bound(self) -> Any:
        return self._context.structs.on_ports(self.destination_port, self.length)

    def field(self, layout: Layout, name: str, at: int = 0) -> Any:
        """Return a number of a header at byte ``at``; -1 if the payload ends before it."""
        slot = layout.by_name[name]
        return layout.read(slot, self._payload, at) if at + slot.end <= self._have else -1


class _Rows:
    """Some datagrams of a batch as a :class:`~edoras_tools.links.protocol.Seen`; each number is an array."""

    def __init__(self, batch: PacketBatch, rows: Places, context: Context) -> None:
        self._batch, self._rows, self._context = batch, rows, context
        self._fields: dict[tuple[str, str, int], NDArray[Any]] = {}
        self._have = batch.length[rows]
        self.length = self._have + np.maximum(batch.original_length[rows] - batch.frame_length[rows], 0)
        self.destination_port = batch.destination_port[rows]

    @cached_property
    def to_cfs(self) -> Mask:
        return self._is_cfs(self._batch.destination_address[self._rows])

    @cached_property
    def from_cfs(self) -> Mask:
        return self._is_cfs(self._batch.source_address[self._rows])

    @property
    def bound(self) -> Any:
        return self._context.structs.on_ports(self.destination_port, self.length)

    def _is_cfs(self, address: NDArray[np.uint32]) -> Mask:
        matches = np.zeros(len(address), bool)
        for cfs in self._context.cfs_addresses:
            matches |= address == cfs
        matches &= self._batch.ip_version[self._rows] == 4
        return matches

    def field(self, layout: Layout, name: str, at: int = 0) -> Any:
        """Return a number of a header at byte ``at`` of each payload; -1 if the payload ends before it."""
        key = layout.name, name, at
        if key not in self._fields:
            self._fields[key] = self._read(layout, name, at)
        return self._fields[key]

    def _read(self, layout: Layout, name: str, at: int) -> NDArray[Any]:
        slot = layout.by_name[name]
        offset = self._batch.offset[self._rows] + at + slot.start
        absent = self._have < at + slot.end
        if some := absent.any():
            offset[absent] = 0
        window = gather(self._batch.data, offset, slot.end - slot.start)
        values = layout.column(name, window, -slot.start)
        return np.where(absent, -1, values.astype(np.int64)) if some else values


def link_columns(batch: PacketBatch, context: Context) -> Octets:
    """Return the link of every datagram of a batch, u8 (n,); fragments without a payload have none."""
    claim = context.claim.take(batch.destination_port)
    link = context.decided.take(claim)
    undecided = np.flatnonzero(link == 0)
    for index, members in by_value(claim[undecided]):
        if context.claimants[index]:
            rows = undecided[members]
            facts, best = _Rows(batch, rows, context), np.zeros(len(rows), np.int8)
            for item in context.claimants[index]:
                sure = np.asarray(item.recognise(facts))
                better = (sure > 0) & (sure >= best)
                link[rows[better]] = item
                best[better] = sure[better]
    if context.frames:
        framed = np.flatnonzero((batch.original_length < 0) & (link == 0))
        link[framed] = context.framed_links[batch.source_port[framed]]
    if context.by_sender.any():
        unlinked = np.flatnonzero(link == 0)
        link[unlinked] = context.by_sender[context.claim[batch.source_port[unlinked]]]
    for item in context.by_magic:
        link[beginning(batch, np.flatnonzero(link == OTHER), item.magic)] = item
    if batch.streams is not None:
        _stream_links(batch, context, link)
    link[(batch.capture_findings & Finding.FRAGMENT) != 0] = OTHER
    if context.frames:
        for item in context.links:
            link[item.claimed(batch, context)] = item
    return link


def beginning(batch: PacketBatch, rows: Places, magic: bytes) -> Places:
    """Return those of some rows of a batch whose payloads begin with a magic number."""
    rows = rows[batch.length[rows] >= len(magic)]
    rows = rows[batch.data[batch.offset[rows]] == magic[0]]
    if len(rows):
        begins = gather(batch.data, batch.offset[rows], len(magic))
        return rows[np.all(begins == np.frombuffer(magic, np.uint8), axis=1)]
    return rows


def _stream_links(batch: PacketBatch, context: Context, link: Octets) -> None:
    """Set the link of TCP messages: by the port of either end, then by content if the link needs that."""
    assert batch.streams is not None
    streams = np.flatnonzero(batch.streams)
    claimed = context.stream_links[batch.destination_port[streams]]
    claimed = np.where(claimed == 0, context.stream_links[batch.source_port[streams]], claimed)
    link[streams] = claimed
    for item in context.links:
        if item.transport.tcp and not item.port_decides and len(rows := streams[claimed == item]):
            sure = np.broadcast_to(np.asarray(item.recognise(_Rows(batch, rows, context))), len(rows))
            link[rows[sure == 0]] = OTHER


def _stream_link(datagram: Datagram, context: Context) -> Link:
    """Return the link of one message of a TCP stream: the same answer as ``_stream_links``."""
    claimed = context.stream_links[datagram.destination.port] or context.stream_links[datagram.source.port]
    link = table.link(int(claimed))
    if link is OTHER:
        return link
    item = table.protocol(link)
    return link if item.port_decides or item.recognise(_Datagram(datagram, context)) else OTHER


def link_of(datagram: Datagram, context: Context) -> Link:
    """Return the link of one datagram: the same answer as :func:`link_columns`."""
    if Finding.FRAGMENT in datagram.findings:
        return OTHER
    for item in context.links if context.frames else ():
        if item.claims(datagram, context):
            return item
    if datagram.stream:
        return _stream_link(datagram, context)
    claim = context.claim[datagram.destination.port]
    link, best = table.link(context.decided[claim]), 0
    if link is OTHER and context.claimants[claim]:
        facts = _Datagram(datagram, context)
        for item in context.claimants[claim]:
            sure = int(item.recognise(facts))
            if sure and sure >= best:
                link, best = item, sure
    if link is OTHER and datagram.original_length < 0:
        link = table.link(context.framed_links[datagram.source.port])
    if link is OTHER:
        link = table.link(context.by_sender[context.claim[datagram.source.port]])
    if link is OTHER:
        link = next((item for item in context.by_magic if datagram.payload.startswith(item.magic)), OTHER)
    return link

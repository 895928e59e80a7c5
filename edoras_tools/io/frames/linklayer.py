"""Captured frames to UDP datagrams, in columns: link layer, VLAN tags, IPv4, IPv6 and their fragments.

Every source of frames uses this. The result has one row for each frame that contains UDP over IP:

- A payload has the length in the UDP header, limited by the length in the IP header and by the captured
  bytes; so padding of short Ethernet frames is left out. A UDP length of 0, or above that of IP, is not
  trusted: the IP length is used.
- ``CAPTURE_CUT`` is set if the capture cut the frame, or the IP length exceeds the frame.
- A fragment's row has no payload and ``FRAGMENT`` is set, so that all frames can be written again. The row
  of the fragment that completes the datagram has the whole payload, which is appended to the batch's
  ``data``, and ``FRAGMENT`` is not set. Ports are 0 until the first fragment of a datagram was seen.

TCP segments from or to a link's port become rows as well, one for each message: see
:mod:`edoras_tools.io.frames.tcp`, which is imported with the first of them. So do ICMP errors that quote a
UDP datagram: their payload is the ICMP message, their ports are 0.

All other frames, and those whose IP header is incomplete or damaged, are skipped and counted.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator, Mapping
from functools import cached_property
from ipaddress import ip_address
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from msgspec.structs import replace

from edoras_tools.io import SourceDefaults
from edoras_tools.io.frames import network
from edoras_tools.io.frames.frame_batch import (
    LINKTYPE_RAW,
    FrameBatch,
    MadeFrames,
    frames_at,
    joined_frames,
    packed_frames,
)
from edoras_tools.links.table import framings
from edoras_tools.model import CutDatagram, Datagram, Endpoint, Finding, PacketBatch, concatenate
from edoras_tools.units import MILLISECOND
from edoras_tools.wire.arrays import PADDING, Integers, Mask, Octets, read_at

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from edoras_tools.io.frames.tcp import StreamReassembler
    from edoras_tools.links.doors import Framing
    from edoras_tools.model import SourceInfo, SourceStatistics

_PROTOCOL_FIELD = {1: (14, 12), 113: (16, 14), 276: (20, 0)}
"""Bytes of the link header, and position of its EtherType: Ethernet, Linux cooked v1 and v2."""
_FAMILY_FIELD = (0, 108)
"""BSD loopback: 4 bytes of address family, in the byte order of the capturing host (0) or network (108)."""
_RAW = (12, 14, LINKTYPE_RAW, 228, 229)
"""Raw IP: no link header; the first nibble is the version."""
_VLAN = (0x8100, 0x88A8, 0x9100)
_IPV4 = 0x0800
_IPV6 = 0x86DD
_FAMILY_VERSION = {2: 4, 10: 6, 24: 6, 28: 6, 30: 6}
"""AF_INET is 2 everywhere; AF_INET6 differs on Linux, NetBSD and OpenBSD, FreeBSD, macOS."""


_PROTOCOL_AT = {4: 9, 6: 6}
"""Offset of the protocol field in an IP header, by version."""
_CONTROL = (1, 58)
"""ICMP, ICMPv6."""
_TCP_BYTES = 20
_MADE_BYTES = 20 + network.UDP_BYTES
"""Bytes of the headers of frames that ``build`` makes."""
_IDENTIFICATION = 4
_LATE_IPV4 = np.dtype([("identification", ">u2"), ("fragment", ">u2"), ("time_to_live", "u1")])
"""A part of ``IPV4_HEADER``, from byte 4 on."""
_PORTS = np.dtype([("source_port", ">u2"), ("destination_port", ">u2")])
_WAITING_BYTES = 16 << 20
"""Most bytes of TCP segments that wait for others."""
_TYPE_AND_IPV4 = np.dtype([("ether_type", ">u2"), *network.IPV4_HEADER.descr])
"""An EtherType, and the header that usually follows: one memory access instead of two."""


def network_headers(batch: PacketBatch) -> tuple[Integers, NDArray[np.uint16], Octets]:
    """Return the start of each row's network header, its IPv4 identification, and its time to live.

    The identification is 0 for IPv6, which has none.
    """
    kind = int(batch.link_type[0]) if len(batch) else 0
    if kind in _PROTOCOL_FIELD and (batch.link_type == kind).all() and (batch.ip_version == 4).all():
        size = _PROTOCOL_FIELD[kind][0]
        ahead = size + _MADE_BYTES
        # No payload begins earlier, so there are no VLAN tags. If a frame was cut, its payload may begin
        # there.
        whole = (batch.frame_length > ahead) | (batch.frame_length == batch.original_length)
        if (batch.offset - batch.frame_offset == ahead).all() and whole.all():
            place = batch.frame_offset + size
            late = read_at(batch.data, place + _IDENTIFICATION, _LATE_IPV4)
            return place, late["identification"].astype(np.uint16), late["time_to_live"].copy()
    frames = FrameBatch(
        batch.data,
        batch.number,
        batch.time_ns,
        batch.link_type,
        batch.frame_offset,
        batch.frame_length,
        batch.original_length,
    )
    ip_start = Demux()._locate(batch.data, frames).network  # noqa: SLF001  of this module
    header = read_at(batch.data, ip_start, network.IPV4_HEADER)
    four = batch.ip_version == 4
    life = read_at(batch.data, ip_start + network.HOP_LIMIT, np.uint8)
    return (
        ip_start,
        np.where(four, header["identification"], 0).astype(np.uint16),
        np.where(four, header["time_to_live"], life),
    )


def checksum_faults(batch: PacketBatch) -> list[str]:
    """Return the wrong checksums of each datagram, in words; empty if none is wrong or can be checked."""
    codes = np.zeros(len(batch), np.uint8)
    if batch.recorded is None:  # else the rows are messages without frames
        codes = network.wrong_checksums(batch, network_headers(batch)[0])
    return [network.CHECKSUMS[code] for code in codes.tolist()]


def checksum_fault(datagram: Datagram) -> str:
    """Return the wrong checksums of one datagram; see ``checksum_faults``."""
    size = len(datagram.frame)
    about = datagram.number, datagram.time_ns, datagram.link_type, 0, size, datagram.original_length
    frame = FrameBatch(np.frombuffer(datagram.frame, np.uint8), *(np.array([item]) for item in about))
    return max(checksum_faults(demux(frame)), default="")


def demux(frames: FrameBatch) -> PacketBatch:
    """Turn frames into datagrams without state from earlier frames; see ``Demux``."""
    return Demux().demux(frames)


class Demux:
    """Turns frames into datagrams; remembers fragments and TCP connections from batch to batch.

    Attributes:
        skipped: number of frames so far without UDP over IP, without bytes of a link's TCP stream, and
            without an ICMP error about UDP.
        unknown_link_types: link types that cannot be read.
        framings: framing of TCP streams by port; by default those of the links' usual ports.
    """

    def __init__(self) -> None:
        self.skipped = 0
        self.unknown_link_types: set[int] = set()
        self._reassembler = network.Reassembler()
        self._streams: StreamReassembler | None = None
        self._waiting: FrameBatch | None = None

    @cached_property
    def framings(self) -> Mapping[int, Framing]:
        """Framing of TCP streams, by port."""
        return framings()

    @property
    def incomplete(self) -> int:
        """Number of fragmented datagrams that were dropped or still wait for fragments."""
        return self._reassembler.abandoned + self._reassembler.pending

    def beginnings(self) -> list[CutDatagram]:
        """Return the datagrams that lack fragments."""
        return [
            CutDatagram(item.time_ns, *_ends(item), item.head[network.UDP_BYTES :])
            for item in self._reassembler.beginnings()
        ]

    def demux(self, frames: FrameBatch) -> PacketBatch:
        """Turn frames into datagrams: one row for each frame that contains UDP or a fragment of it.

        Messages of TCP streams that these frames complete have a row each.
        """
        if isinstance(frames, MadeFrames):
            return _datagrams(frames)
        data, end = frames.data, frames.offset + frames.length
        if len(frames) and int(end.max()) + PADDING > data.size:
            data = np.concatenate((data, np.zeros(PADDING, dtype=np.uint8)))
        headers = self._locate(data, frames)
        version = headers.version
        transport = network.ipv4(headers) if (version == 4).all() else network.ip_payloads(headers)
        self.skipped += len(frames) - len(transport.position)
        batch = self._datagrams(data, frames_at(frames, transport.rows), transport)
        if transport.rows is None or len(transport.rows) == len(frames):
            return batch
        others = np.ones(len(frames), bool)
        others[transport.rows] = False
        rest = np.flatnonzero(others & (version > 0))
        if not len(rest):
            return batch
        at = np.where(version[rest] == 4, _PROTOCOL_AT[4], _PROTOCOL_AT[6])
        control = rest[np.isin(read_at(data, headers.network[rest] + at, np.uint8), _CONTROL)]
        if len(control):
            batch = self._with_errors(batch, replace(frames, data=data), headers, control)
        rows = self._stream_rows(headers, rest)
        return self._with_streams(batch, frames_at(replace(frames, data=data), rows)) if len(rows) else batch

    def finish(self) -> PacketBatch | None:
        """Return the rows of TCP bytes that still wait, at the end of the frames; None if there are none."""
        if self._streams is None or self._waiting is None:
            return None
        return self._messages(self._waiting, len(self._waiting), final=True)

    def _with_errors(
        self, batch: PacketBatch, frames: FrameBatch, headers: network.IpHeaders, rows: Integers
    ) -> PacketBatch:
        """Add a row for each ICMP error among some frames, with ports 0, in the order of the frames."""
        from edoras_tools.io.frames.network import find_errors

        errors = find_errors(headers, rows)
        if errors is None:
            return batch
        frames = frames_at(frames, errors.rows)
        self.skipped -= len(frames)
        messages = self._datagrams(frames.data, frames, errors)
        # The bytes that were read as a UDP header begin the ICMP message.
        start = messages.offset - network.UDP_BYTES
        length = np.minimum(errors.end, frames.offset + frames.length) - start
        none = np.zeros(len(frames), np.uint16)
        own = replace(
            messages, offset=start, length=length.astype(np.int32), source_port=none, destination_port=none
        )
        return by_time([batch, own])

    def _stream_rows(self, headers: network.IpHeaders, rows: Integers) -> Integers:
        """Return which of some frames are TCP segments from or to a link's port."""
        payloads = network.transport_payloads(headers.take(rows), (network.TCP, network.TCP), _TCP_BYTES)
        members = np.arange(len(rows)) if payloads.rows is None else payloads.rows
        ports = read_at(headers.data, payloads.position, _PORTS)
        link_ports = np.zeros(1 << 16, bool)
        link_ports[list(self.framings)] = True
        of_link: Mask = link_ports[ports["source_port"]]
        of_link |= link_ports[ports["destination_port"]]
        return np.asarray(rows[members[of_link]])

    def _with_streams(self, batch: PacketBatch, frames: FrameBatch) -> PacketBatch:
        """Add the messages of TCP segments to the datagrams, in the order of the frames."""
        waiting = self._waiting
        parts = [packed_frames(frames)] if waiting is None else [waiting, packed_frames(frames)]
        size = sum(len(part.data) for part in parts)
        old = len(waiting) if waiting is not None else 0
        messages = self._messages(
            joined_frames(parts), old, final=size - len(parts[-1].data) > _WAITING_BYTES
        )
        return by_time([batch, messages])

    def _messages(self, frames: FrameBatch, old: int, *, final: bool) -> PacketBatch:
        from edoras_tools.io.frames.network import read_segments
        from edoras_tools.io.frames.tcp import StreamReassembler

        if self._streams is None:
            self._streams = StreamReassembler(self.framings)
        headers = self._locate(frames.data, frames)
        payloads = network.transport_payloads(headers, (network.TCP, network.TCP), _TCP_BYTES)
        segments = read_segments(frames, headers.network, payloads, old)
        batch, waiting = self._streams.messages(segments, final=final)
        self.skipped -= int(np.count_nonzero(segments.length[old:]))
        self._waiting = packed_frames(frames_at(frames, waiting)) if len(waiting) else None
        return batch

    def _locate(self, data: Octets, frames: FrameBatch) -> network.IpHeaders:
        """Find the start of each network header, and the IP version."""
        types, end = frames.link_type, frames.offset + frames.length
        if len(types) and (types == types[0]).all():
            return self._locate_one(int(types[0]), data, frames.offset, end)
        ip_start = frames.offset.copy()
        version = np.zeros(len(frames), dtype=np.uint8)
        for link_type in np.unique(types):
            rows = np.flatnonzero(types == link_type)
            part = self._locate_one(int(link_type), data, frames.offset[rows], end[rows])
            ip_start[rows], version[rows] = part.network, part.version
        return network.IpHeaders(data, ip_start, version, end)

    def _locate_one(self, link_type: int, data: Octets, offset: Integers, end: Integers) -> network.IpHeaders:
        if link_type in _PROTOCOL_FIELD:
            size, at = _PROTOCOL_FIELD[link_type]
            if at + 2 < size:
                protocol = read_at(data, offset + at, ">u2")
                return _untag(data, offset + size, protocol.astype(np.uint16), end)
            header = read_at(data, offset + at, _TYPE_AND_IPV4)
            return _untag(data, offset + size, header["ether_type"].astype(np.uint16), end, header)
        version = np.zeros(len(offset), dtype=np.uint8)
        if link_type in _RAW:
            version[:] = read_at(data, offset, np.uint8) >> 4
            return network.IpHeaders(data, offset, version, end)
        if link_type not in _FAMILY_FIELD:
            self.unknown_link_types.add(link_type)
            return network.IpHeaders(data, offset, version, end)
        family = read_at(data, offset, "<u4")
        for value, number in _FAMILY_VERSION.items():
            version[(family == value) | (family == value << 24)] = number
        return network.IpHeaders(data, offset + 4, version, end)

    def _datagrams(self, data: Octets, frames: FrameBatch, transport: network.IpPayloads) -> PacketBatch:
        """Read UDP headers; ``frames`` and ``transport`` have the same rows."""
        frame_end = frames.offset + frames.length
        start = np.minimum(transport.position, frame_end)
        have = np.minimum(transport.end, frame_end) - start
        udp = read_at(data, start, network.UDP_HEADER) if transport.udp is None else transport.udp
        announced = transport.end - transport.position
        length = udp["length"].astype(np.int64)
        believed = (length >= network.UDP_BYTES) & (length <= announced)
        if not believed.all():
            length = np.where(believed, length, announced)
        source_port = udp["source_port"].astype(np.uint16)
        destination_port = udp["destination_port"].astype(np.uint16)
        if len(have) and have.min() < network.UDP_BYTES:
            source_port[have < 4] = destination_port[have < 4] = 0
            length = np.maximum(length, network.UDP_BYTES)
            have = np.maximum(have, network.UDP_BYTES)
        cut = (transport.end > frame_end) | (frames.length < frames.original_length)
        batch = PacketBatch(
            data=data,
            **_heads(frames),
            offset=np.minimum(start + network.UDP_BYTES, frame_end),
            length=(np.minimum(length, have) - network.UDP_BYTES).astype(np.int32),
            source_address=transport.source,
            source_port=source_port,
            destination_address=transport.destination,
            destination_port=destination_port,
            ip_version=transport.version,
            capture_findings=cut * np.uint32(Finding.CAPTURE_CUT),
            ipv6=transport.addresses,
        )
        return self._assemble(batch, transport) if transport.fragment.any() else batch

    def _assemble(self, batch: PacketBatch, transport: network.IpPayloads) -> PacketBatch:
        """Write the rows of fragments into the new columns of ``batch``, and add completed datagrams."""
        data, used = [batch.data], batch.data.size
        frame_end = batch.frame_offset + batch.frame_length
        for row in np.flatnonzero(transport.fragment).tolist():
            start, end = int(transport.position[row]), int(transport.end[row])
            payload, ports = self._reassembler.add(
                network.Fragment(
                    key=_key(batch, row, int(transport.identification[row])),
                    time_ns=int(batch.time_ns[row]),
                    start=int(transport.fragment[row]) & 0xFFF8,
                    more=bool(transport.fragment[row] & 1),
                    whole=end <= frame_end[row],
                    data=batch.data[start : min(end, int(frame_end[row]))].tobytes(),
                )
            )
            batch.source_port[row], batch.destination_port[row] = ports
            if payload is None or len(payload) < network.UDP_BYTES:
                batch.length[row] = 0
                batch.capture_findings[row] |= Finding.FRAGMENT
                continue
            announced = int.from_bytes(payload[4:6], "big")
            size = announced if network.UDP_BYTES <= announced <= len(payload) else len(payload)
            data.append(np.frombuffer(payload, dtype=np.uint8)[network.UDP_BYTES : size])
            batch.offset[row], batch.length[row] = used, size - network.UDP_BYTES
            used += size - network.UDP_BYTES
        data.append(np.zeros(PADDING, dtype=np.uint8))
        return replace(batch, data=np.concatenate(data))


_SPREAD_NS: Final = 100 * MILLISECOND
"""Longest time from the first to the last fragment of a datagram, but for unusual ones."""


class FrameSource(SourceDefaults):
    """What sources of frames share: they find the datagrams in them, and count both.

    Attributes:
        statistics: counts of what was read.
    """

    _info: SourceInfo

    def __init__(self, statistics: SourceStatistics) -> None:
        self.statistics = statistics
        self._demux = Demux()
        self._times_ns = 0, 0
        """Times of the first and the last frame so far."""

    @property
    def info(self) -> SourceInfo:
        """Information on the part of the source that has been read."""
        return self._info

    def follow(self, framings: Mapping[int, Framing]) -> None:
        """Read the TCP streams of these ports, and no others; call it before the first batch."""
        self._demux.framings = framings

    def batches(self) -> Iterator[PacketBatch]:
        """Yield all datagrams, then tell which lack fragments; see ``Source.batches``."""
        try:
            yield from self._batches()
        finally:
            # Those that were passed over may have the other fragments.
            if (number := self._demux.incomplete) and not self.statistics.passed_over:
                self.statistics.cut[:] = filter(self._is_inside, self._demux.beginnings())
                lacking = f"{self.info.name}: {number} fragmented datagrams lack fragments in the capture"
                self.statistics.warnings.append(lacking)

    def _is_inside(self, cut: CutDatagram) -> bool:
        """Return whether the other fragments of a datagram cannot be before or after the frames."""
        first_ns, last_ns = self._times_ns
        return cut.time_ns < last_ns - _SPREAD_NS and (bool(cut.head) or cut.time_ns > first_ns + _SPREAD_NS)

    @abstractmethod
    def _batches(self) -> Iterator[PacketBatch]:
        """Yield all datagrams."""

    def _demuxed(self, frames: FrameBatch) -> PacketBatch:
        """Return the datagrams of some frames."""
        batch, statistics = self._demux.demux(frames), self.statistics
        if len(frames):
            self._times_ns = self._times_ns[0] or int(frames.time_ns[0]), int(frames.time_ns[-1])
        statistics.frames += len(frames)
        statistics.bytes += int(frames.length.sum())
        statistics.datagrams += len(batch)
        statistics.skipped = self._demux.skipped
        return batch

    def _rest(self) -> Iterator[PacketBatch]:
        """Yield the datagrams that waited for more bytes of a TCP stream."""
        rest = self._demux.finish()
        if rest is not None and len(rest):
            self.statistics.datagrams += len(rest)
            yield rest


def _heads(frames: Any) -> dict[str, Any]:
    """Return the columns of datagrams that are the same as those of their frames."""
    same = {name: getattr(frames, name) for name in ("number", "time_ns", "link_type", "original_length")}
    return {**same, "frame_offset": frames.offset, "frame_length": frames.length}


def _datagrams(frames: MadeFrames) -> PacketBatch:
    """Return the datagrams from which frames were made."""
    ends, count = frames.ends, len(frames)
    source, destination = (
        ends[name][:, :4].copy().view(">u4")[:, 0].astype(np.uint32) for name in ("source", "destination")
    )
    return PacketBatch(
        data=frames.data,
        **_heads(frames),
        offset=frames.offset + _MADE_BYTES,
        length=frames.length - np.int32(_MADE_BYTES),
        source_address=source,
        source_port=ends["source_port"].copy(),
        destination_address=destination,
        destination_port=ends["destination_port"].copy(),
        ip_version=np.full(count, 4, np.uint8),
        capture_findings=np.zeros(count, np.uint32),
    )


def by_time(batches: list[PacketBatch]) -> PacketBatch:
    """Return the rows of batches of the same frames, in the order of the frames."""
    batches = [batch for batch in batches if len(batch)] or batches[:1]
    if len(batches) == 1:
        return batches[0]
    both = concatenate(batches)
    return both.take(np.argsort(both.number, kind="stable"))


def _untag(
    data: Octets,
    position: Integers,
    protocol: NDArray[np.uint16],
    end: Integers,
    header: NDArray[np.void] | None = None,
) -> network.IpHeaders:
    """Skip VLAN tags (IEEE 802.1Q, nested too) and return the IP version from the EtherType.

    Args:
        data: buffer, u8.
        position: start of the data after the EtherType, i64; modified.
        protocol: EtherType, u16; modified.
        end: offset after each frame's last captured byte, i64.
        header: bytes that are IPv4 headers if there are no tags.
    """
    rows = np.flatnonzero(np.isin(protocol, _VLAN))
    if len(rows):
        header = None
    while len(rows := rows[position[rows] + 4 <= end[rows]]):
        protocol[rows] = read_at(data, position[rows] + 2, ">u2")
        position[rows] += 4
        rows = rows[np.isin(protocol[rows], _VLAN)]
    version = (protocol == _IPV4) * np.uint8(4) + (protocol == _IPV6) * np.uint8(6)
    return network.IpHeaders(data, position, version, end, header)


def _ends(item: network.Beginning) -> tuple[Endpoint, Endpoint]:
    hosts = (str(ip_address(address)) for address in (item.source, item.destination))
    ports = int.from_bytes(item.head[0:2], "big"), int.from_bytes(item.head[2:4], "big")
    source, destination = (Endpoint(host, port) for host, port in zip(hosts, ports, strict=True))
    return source, destination


def _key(batch: PacketBatch, row: int, identification: int) -> tuple[int, int, bytes, bytes]:
    version = int(batch.ip_version[row])
    addresses = int(batch.source_address[row]), int(batch.destination_address[row])
    if version == 6:
        return version, identification, batch.ipv6[addresses[0]], batch.ipv6[addresses[1]]
    return version, identification, addresses[0].to_bytes(4, "big"), addresses[1].to_bytes(4, "big")

"""IPv4 and IPv6 in columns: headers from their start to that of the transport header, and fragments.

RFC 791 and RFC 8200. Only packets of one transport protocol are kept, usually UDP. ``Reassembler`` joins
fragments, with limited memory and time (RFC 791 section 3.2, RFC 8200 section 4.5).

Also TCP segments in columns: read from frames, and rebuilt with one message each (RFC 9293 section 3.1).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final, NamedTuple

import msgspec
import numpy as np
from msgspec.structs import replace

from edoras_tools.io.frames.frame_batch import FrameBatch, internet_checksum, put_words, words_of
from edoras_tools.links.icmp import FORMS, LONGEST, QUOTED_UDP
from edoras_tools.model import Finding, PacketBatch
from edoras_tools.wire import arrays
from edoras_tools.wire.arrays import Integers, Mask, Octets, Places, gather, read_at, word_sums

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from edoras_tools.wire.layout import Layout

_PROTOCOLS: Final = FORMS[0].protocol, FORMS[1].protocol


def find_errors(headers: IpHeaders, rows: Integers) -> IpPayloads | None:
    """Return the ICMP errors that quote UDP, among some frames; None if there are none.

    Args:
        headers: the IP headers of all frames.
        rows: frames that may be errors, i64.

    Returns:
        The errors; ``rows`` are the indices of their frames.
    """
    payloads = transport_payloads(headers.take(rows), _PROTOCOLS, min(form.size for form in FORMS))
    assert payloads.rows is not None
    window = gather(headers.data, payloads.position, LONGEST)
    have = np.minimum(payloads.end, headers.end[rows][payloads.rows]) - payloads.position

    def field(layout: Layout, name: str, at: int) -> NDArray[Any]:
        values = layout.column(name, window, at).astype(np.int64)
        return np.where(have >= at + layout.by_name[name].end, values, -1)

    fits = np.zeros(len(have), bool)
    for form in FORMS:
        fits |= (payloads.version == form.version) & form.fits(field)
    if not fits.any():
        return None
    payloads = payloads.take(fits)
    assert payloads.rows is not None
    return replace(payloads, rows=rows[payloads.rows])


def error_rows(batch: PacketBatch) -> Mask:
    """Return which rows of a batch are ICMP errors: only they have no ports."""
    return np.asarray((batch.source_port == 0) & (batch.destination_port == 0))


def quoted_ports(batch: PacketBatch, rows: Places) -> NDArray[np.uint16]:
    """Return the source and destination port that errors quote, u16 (n, 2).

    Args:
        rows: rows of the errors.
    """
    start = np.array([form.start(QUOTED_UDP) for form in FORMS])
    at = batch.offset[rows] + start[(batch.ip_version[rows] == FORMS[1].version).astype(np.intp)]
    return gather(batch.data, at, 4).view(">u2").astype(np.uint16)


MAX_PAYLOAD = 65535
"""Maximum bytes of IP payload that fragments can address."""
QUOTED_BYTES = 64
"""Bytes of an incomplete datagram's IP payload that are kept: ports and the first headers."""
_MOST_LACKING = 1 << 14
_PIECE_OVERHEAD = 128
"""Memory of a stored piece besides its bytes; counted so that floods of tiny fragments are limited, too."""


class _Partial(msgspec.Struct, eq=False):
    """An incomplete datagram.

    Attributes:
        time_ns: capture time of the fragment that arrived first.
        pieces: start and bytes of each fragment, in order of arrival.
        units: bit mask with one bit for each 8 bytes that have arrived.
        total: bytes of the whole payload; -1 until the last fragment has come.
        size_stored: bytes that count for the reassembler's limit.
        ports: source and destination port; 0 until the first fragment has come.
    """

    time_ns: int
    pieces: list[tuple[int, bytes]] = msgspec.field(default_factory=list)
    units: int = 0
    total: int = -1
    size_stored: int = 0
    ports: tuple[int, int] = (0, 0)


class Fragment(msgspec.Struct, frozen=True):
    """One captured fragment of a UDP datagram.

    Attributes:
        key: IP version, identification, source and destination address, which all fragments of a datagram
            share.
        time_ns: capture time.
        start: offset of its bytes in the IP payload; a multiple of 8.
        more: whether more fragments follow it.
        whole: whether the capture has all of its bytes.
        data: captured bytes.
    """

    key: tuple[int, int, bytes, bytes]
    time_ns: int
    start: int
    more: bool
    whole: bool
    data: bytes


class Beginning(msgspec.Struct, frozen=True):
    """What came of a datagram that lacks fragments.

    Attributes:
        time_ns: capture time of the first of its fragments.
        source: source IP address, 4 or 16 bytes.
        destination: destination IP address, 4 or 16 bytes.
        head: at most ``QUOTED_BYTES`` of the IP payload, UDP header first, if its first fragment came and no
            other; else empty.
    """

    time_ns: int
    source: bytes
    destination: bytes
    head: bytes


class Reassembler:
    """Collects fragments until a datagram is complete.

    If bytes arrive twice, the first are kept. A fragment that contradicts the others (past the end, another
    end, a length that is not a multiple of 8) is ignored, and so is one that the capture cut.

    Attributes:
        abandoned: number of datagrams dropped after a timeout or at the memory limit.
        lacking: dropped datagrams that did not come whole before, and of which the capture cut no
            fragment; at most 16,384.
    """

    def __init__(self, *, timeout_ns: int = 30_000_000_000, limit: int = 16 << 20) -> None:
        self.abandoned = 0
        self.lacking: list[Beginning] = []
        self._timeout_ns = timeout_ns
        self._limit = limit
        self._stored = 0
        self._partials: dict[tuple[int, int, bytes, bytes], _Partial] = {}
        self._unlisted: dict[tuple[int, int, bytes, bytes], int] = {}

    @property
    def pending(self) -> int:
        """Number of incomplete datagrams."""
        return len(self._partials)

    def beginnings(self) -> list[Beginning]:
        """Return ``lacking``, and the datagrams like these that still wait for fragments."""
        return [*self.lacking, *(item for key in self._partials if (item := self._beginning(key)))]

    def _beginning(self, key: tuple[int, int, bytes, bytes]) -> Beginning | None:
        partial = self._partials[key]
        if key in self._unlisted or not partial.pieces:
            return None
        (start, head), *later = partial.pieces
        return Beginning(partial.time_ns, key[2], key[3], b"" if start or later else head[:QUOTED_BYTES])

    def add(self, fragment: Fragment) -> tuple[bytes | None, tuple[int, int]]:
        """Add a fragment.

        Returns:
            The IP payload if this fragment completed it, else None; and the UDP ports, 0 while unknown.
        """
        self._expire(fragment.time_ns)
        partial = self._partials.setdefault(fragment.key, _Partial(fragment.time_ns))
        self._store(partial, fragment)
        is_whole = partial.total >= 0 and partial.units == (1 << -(-partial.total // 8)) - 1
        if is_whole or not fragment.whole:
            self._unlisted[fragment.key] = fragment.time_ns
        if is_whole:
            del self._partials[fragment.key]
            self._stored -= partial.size_stored
            return _join(partial), partial.ports
        while self._stored > self._limit:
            self._abandon_oldest()
        return None, partial.ports

    def _store(self, partial: _Partial, fragment: Fragment) -> None:
        start, data = fragment.start, fragment.data
        if start == 0 and len(data) >= 4:
            partial.ports = int.from_bytes(data[0:2], "big"), int.from_bytes(data[2:4], "big")
        stop = start + len(data)
        first, last = start // 8, -(-stop // 8)
        if (
            not fragment.whole
            or not data
            or stop > MAX_PAYLOAD
            or (fragment.more and len(data) % 8)
            or (partial.total >= 0 and (stop > partial.total if fragment.more else stop != partial.total))
            or (not fragment.more and partial.units >> last)
        ):
            return
        if not fragment.more:
            partial.total = stop
        units = ((1 << (last - first)) - 1) << first
        if units & ~partial.units:
            partial.units |= units
            partial.pieces.append((start, data))
            partial.size_stored += len(data) + _PIECE_OVERHEAD
            self._stored += len(data) + _PIECE_OVERHEAD

    def _expire(self, now_ns: int) -> None:
        while self._partials and now_ns - next(iter(self._partials.values())).time_ns > self._timeout_ns:
            self._abandon_oldest()
        # Those that still wait may be copies of these; and an identification comes again.
        while self._unlisted and now_ns - next(iter(self._unlisted.values())) > 2 * self._timeout_ns:
            del self._unlisted[next(iter(self._unlisted))]

    def _abandon_oldest(self) -> None:
        key = next(iter(self._partials))
        if (item := self._beginning(key)) and len(self.lacking) < _MOST_LACKING:
            self.lacking.append(item)
        partial = self._partials.pop(key)
        self._stored -= partial.size_stored
        self.abandoned += 1


def _join(partial: _Partial) -> bytes:
    """Join the pieces; where they overlap, the first to arrive is used."""
    payload = bytearray(partial.total)
    for start, data in reversed(partial.pieces):
        payload[start : start + len(data)] = data
    return bytes(payload)


UDP = 17
TCP = 6
UDP_HEADER = np.dtype([("source_port", ">u2"), ("destination_port", ">u2"), ("length", ">u2")])
"""RFC 768, without the checksum."""
UDP_BYTES = 8

IPV4_HEADER = np.dtype(
    [
        ("version_length", "u1"),
        ("service", "u1"),
        ("total_length", ">u2"),
        ("identification", ">u2"),
        ("fragment", ">u2"),
        ("time_to_live", "u1"),
        ("protocol", "u1"),
        ("checksum", ">u2"),
        ("source", ">u4"),
        ("destination", ">u4"),
        ("source_port", ">u2"),
        ("destination_port", ">u2"),
        ("length", ">u2"),
    ]
)
"""Without options, and the UDP header that follows: one memory access instead of two."""
_IPV6 = np.dtype(
    [
        ("version_class_flow", ">u4"),
        ("payload_length", ">u2"),
        ("next_header", "u1"),
        ("hop_limit", "u1"),
        ("source", "V16"),
        ("destination", "V16"),
    ]
)
HOP_LIMIT = 7
"""Offset of the hop limit, IPv6's time to live."""
_EXTENSION = np.dtype(
    [("next_header", "u1"), ("length", "u1"), ("fragment", ">u2"), ("identification", ">u4")]
)
_FRAGMENT_HEADER = 44
_AUTHENTICATION_HEADER = 51
_NO_NEXT_HEADER = 59
_EXTENSIONS = (0, 43, _FRAGMENT_HEADER, _AUTHENTICATION_HEADER, 60, 135, 139, 140)
"""Hop-by-hop, routing, fragment, authentication, destination options, mobility, HIP, shim6."""


class IpPayloads(msgspec.Struct, frozen=True, eq=False):
    """UDP or TCP payloads, or fragments of them, from IP headers; one element for each kept packet.

    Attributes:
        rows: indices of the kept packets among those given, i64, in order; None for all of them.
        version: IP version, u8, 4 or 6.
        source: IPv4 address, or index into ``addresses``, u32.
        destination: like ``source``, u32.
        position: start of the transport header or of a fragment's data, i64.
        end: offset after the last byte of the IP payload, captured or not, i64.
        fragment: 0 for a whole packet; for a fragment, the offset of its bytes in the whole payload (a
            multiple of 8), plus 1 if more follow, u16.
        identification: number that all fragments of a packet share, u32; 0 for a whole IPv6 packet.
        addresses: IPv6 addresses, 16 bytes each.
        udp: record with the fields of ``UDP_HEADER``; None if not read yet.
    """

    rows: Integers | None
    version: Octets
    source: NDArray[np.uint32]
    destination: NDArray[np.uint32]
    position: Integers
    end: Integers
    fragment: NDArray[np.uint16]
    identification: NDArray[np.uint32]
    addresses: tuple[bytes, ...] = ()
    udp: NDArray[np.void] | None = None

    def take(self, mask: Mask) -> IpPayloads:
        """Return the packets that a mask selects."""
        columns: dict[str, Any] = {}
        for name in self.__struct_fields__:
            value = getattr(self, name)
            columns[name] = value[mask] if isinstance(value, np.ndarray) else value
        return IpPayloads(**columns)


class IpHeaders(NamedTuple):
    """Where the network headers of frames are; one element for each frame.

    Attributes:
        data: buffer, u8; it has at least 40 bytes from the start of each header.
        network: start of each header, i64.
        version: IP version, u8; 0 if there is no IP header.
        end: offset after each frame's last captured byte, i64.
        header: record with the fields of ``IPV4_HEADER``, whatever the bytes are; None if not read.
    """

    data: Octets
    network: Integers
    version: Octets
    end: Integers
    header: NDArray[np.void] | None = None

    def take(self, rows: Integers) -> IpHeaders:
        """Return the headers of some frames; ``header`` is not taken along."""
        return IpHeaders(self.data, self.network[rows], self.version[rows], self.end[rows])


def ipv4(headers: IpHeaders, protocol: int = UDP) -> IpPayloads:
    """Read IPv4 headers, and keep the packets of one transport protocol."""
    data, network, _, end, header = headers
    if header is None:
        header = read_at(data, network, IPV4_HEADER)
    # Version 4 and 5 to 15 words: 0 to 10.
    words = header["version_length"] - np.uint8(0x45)
    length: Integers = (words.astype(np.int64) << 2) + 20
    total = header["total_length"].astype(np.int64)
    if not total.all():
        # A length of 0 is a packet captured before the interface segmented it (segmentation offload).
        total = np.where(total == 0, end - network, total)
    flags = header["fragment"].astype(np.uint16)
    fragment = ((flags & 0x1FFF) << 3 | flags >> 13 & 1).astype(np.uint16)
    keep = (words <= 10) & (header["protocol"] == protocol)
    keep &= end - network >= 20
    keep &= total - length >= (np.where(fragment, 1, UDP_BYTES) if fragment.any() else UDP_BYTES)
    rows = None
    if not keep.all():
        rows = np.flatnonzero(keep)
        header, words, network, length = header[rows], words[rows], network[rows], length[rows]
        total, fragment = total[rows], fragment[rows]
    return IpPayloads(
        rows=rows,
        version=np.full(len(header), 4, dtype=np.uint8),
        source=header["source"].astype(np.uint32),
        destination=header["destination"].astype(np.uint32),
        position=network + length,
        end=network + total,
        fragment=fragment,
        identification=header["identification"].astype(np.uint32),
        udp=header if not words.any() else None,
    )


def ipv6(headers: IpHeaders, protocol: int = UDP) -> IpPayloads:
    """Read IPv6 headers and their extension headers, and keep the packets of one transport protocol."""
    data, network, _, end, _ = headers
    header = read_at(data, network, _IPV6)
    position = network + 40
    length = header["payload_length"].astype(np.int64)
    # A length of 0 is a jumbogram or segmentation offload: the rest of the frame.
    stop = np.where(length == 0, end, position + length)
    whole = (header["version_class_flow"] >> 28 == 6) & (position <= end)
    following = np.where(whole, header["next_header"], _NO_NEXT_HEADER)
    fragment = np.zeros(len(network), dtype=np.uint16)
    identification = np.zeros(len(network), dtype=np.uint32)
    reach = np.minimum(stop, end)
    rows = np.flatnonzero(np.isin(following, _EXTENSIONS))
    while len(rows := rows[position[rows] + 8 <= reach[rows]]):
        extension = read_at(data, position[rows], _EXTENSION)
        kind = following[rows]
        units = extension["length"].astype(np.int64)
        size = np.where(kind == _AUTHENTICATION_HEADER, (units + 2) << 2, (units + 1) << 3)
        position[rows] += np.where(kind == _FRAGMENT_HEADER, 8, size)
        following[rows] = extension["next_header"]
        # A fragment header for the whole packet (RFC 6946) is skipped like any other.
        split = np.where(kind == _FRAGMENT_HEADER, extension["fragment"] & 0xFFF9, 0)
        fragment[rows] = split
        identification[rows] = np.where(split, extension["identification"], 0)
        rows = rows[(split == 0) & np.isin(following[rows], _EXTENSIONS)]
    complete = np.flatnonzero((following == protocol) & (stop >= position + np.where(fragment, 1, UDP_BYTES)))
    source, destination, addresses = _number(header["source"][complete], header["destination"][complete])
    return IpPayloads(
        rows=complete,
        version=np.full(len(complete), 6, dtype=np.uint8),
        source=source,
        destination=destination,
        position=position[complete],
        end=stop[complete],
        fragment=fragment[complete],
        identification=identification[complete],
        addresses=addresses,
    )


def _number(
    source: NDArray[np.void], destination: NDArray[np.void]
) -> tuple[NDArray[np.uint32], NDArray[np.uint32], tuple[bytes, ...]]:
    """Replace 16-byte addresses by indices into a table of the distinct ones."""
    every = np.concatenate((source, destination))
    halves = every.view(np.uint64).reshape(-1, 2)
    order = np.lexsort((halves[:, 0], halves[:, 1]))
    inorder = halves[order]
    first = np.ones(len(every), dtype=np.bool_)
    first[1:] = (inorder[1:] != inorder[:-1]).any(axis=1)
    index = np.empty(len(every), dtype=np.uint32)
    index[order] = np.cumsum(first) - 1
    table = tuple(every[row].tobytes() for row in order[first])
    return index[: len(source)], index[len(source) :], table


def merge_rows(parts: list[tuple[Integers, IpPayloads]]) -> IpPayloads:
    """Merge the results for several selections of rows, in the order of the rows.

    Args:
        parts: indices of the selected packets, and their payloads; at most one part has addresses.
    """
    selections = [replace(part, rows=rows if part.rows is None else rows[part.rows]) for rows, part in parts]
    columns = {
        name: np.concatenate([getattr(part, name) for part in selections])
        for name in IpPayloads.__struct_fields__
        if name not in {"addresses", "udp"}
    }
    order = np.argsort(columns["rows"], kind="stable")
    addresses = next((part.addresses for part in selections if part.addresses), ())
    return IpPayloads(**{name: column[order] for name, column in columns.items()}, addresses=addresses)


def ip_payloads(headers: IpHeaders, protocols: tuple[int, int] = (UDP, UDP)) -> IpPayloads:
    """Read headers of both IP versions, and keep the packets of a protocol, whose number each version has."""
    four, six = np.flatnonzero(headers.version == 4), np.flatnonzero(headers.version == 6)
    return merge_rows(
        [(four, ipv4(headers.take(four), protocols[0])), (six, ipv6(headers.take(six), protocols[1]))]
    )


def transport_payloads(headers: IpHeaders, protocols: tuple[int, int], least: int) -> IpPayloads:
    """Find the unfragmented payloads of one transport protocol, in packets with an IP header.

    Args:
        headers: the packets.
        protocols: numbers of the protocol in IPv4, and in IPv6.
        least: fewest captured bytes of a payload.
    """
    payloads = ip_payloads(headers, protocols)
    assert payloads.rows is not None
    keep = np.minimum(payloads.end, headers.end[payloads.rows]) - payloads.position >= least
    keep &= payloads.fragment == 0
    return payloads if keep.all() else payloads.take(keep)


_HEADS: Final = {4: (np.dtype((">u2", 14)), slice(6, 10)), 6: (np.dtype((">u2", 24)), slice(4, 20))}
"""Words of an IP header without options and the UDP header after it, and which of them are addresses."""
_ONES = 0xFFFF
CHECKSUMS: Final = "", "UDP checksum wrong", "IPv4 checksum wrong", "UDP and IPv4 checksums wrong"
"""Texts of the codes that :func:`wrong_checksums` returns."""


def wrong_checksums(batch: PacketBatch, network: Integers) -> Octets:
    """Return a code of each datagram's wrong checksums: 1 UDP, 2 IPv4, 3 both; a receiver drops these.

    The code is 0, too, where a checksum cannot be judged: for fragments, datagrams that were cut, have no
    checksum (0) or IP options, and where the sender left the checksum to its network card: then the field has
    the sum of the pseudo-header alone (RFC 768).

    Args:
        network: start of each row's network header, i64.
    """
    wrong = np.zeros(len(batch), np.uint8)
    end = batch.frame_offset + batch.frame_length
    whole = (batch.source_port > 0) & (batch.frame_length == batch.original_length)
    whole &= batch.offset + batch.length <= end
    whole &= (batch.capture_findings & np.uint32(Finding.FRAGMENT | Finding.CAPTURE_CUT)) == 0
    if batch.streams is not None:
        whole &= ~batch.streams
    for version, (kind, addresses) in _HEADS.items():
        plain = batch.offset == network + kind.itemsize
        rows = np.flatnonzero(whole & (batch.ip_version == version) & plain)
        words = np.array(read_at(batch.data, network[rows], kind).T, np.int64, order="C")
        head, size = words[-4:], batch.length[rows].astype(np.int64) + UDP_BYTES
        pseudo = words[addresses].sum(axis=0) + UDP + size
        suspects = (head[3] > 0) & (head[2] == size) & ((pseudo - head[3]) % _ONES != 0)
        if suspects.any():
            some, sums = rows[suspects], pseudo[suspects] + head[:, suspects].sum(axis=0)
            sums += word_sums(batch.data, batch.offset[some], batch.length[some])
            wrong[some] = sums % _ONES != 0
        if version == 4:
            wrong[rows[(words[5] > 0) & (words[:-4].sum(axis=0) % _ONES != 0)]] += 2
    return wrong


TCP_BYTES: Final = 20
"""Bytes of a header without options."""
_HEADER: Final = np.dtype(
    [
        ("source_port", ">u2"),
        ("destination_port", ">u2"),
        ("sequence", ">u4"),
        ("acknowledged", ">u4"),
        ("words", "u1"),
        ("flags", "u1"),
    ]
)
_SYN: Final = 2
_KEPT_FLAGS: Final = 0xF8
"""All but FIN, SYN and RST."""
_FLAGS_AT: Final = 13


class Segments(msgspec.Struct, frozen=True, eq=False):
    """TCP segments; all arrays have the same length.

    Attributes:
        frames: frames of the segments.
        network: start of each IP header, i64.
        ip: contents of the IP headers.
        source_port: source port, u16.
        destination_port: destination port, u16.
        sequence: sequence number of the first byte of data, i64.
        acknowledged: acknowledgement number, i64.
        flags: TCP flags, u8.
        start: first byte of data, i64.
        length: captured bytes of data, i64.
        cut: whether some of the data was not captured, bool.
        fresh: whether the segment is seen for the first time, bool.
    """

    frames: FrameBatch
    network: arrays.Integers
    ip: IpPayloads
    source_port: NDArray[np.uint16]
    destination_port: NDArray[np.uint16]
    sequence: arrays.Integers
    acknowledged: arrays.Integers
    flags: arrays.Octets
    start: arrays.Integers
    length: arrays.Integers
    cut: arrays.Mask
    fresh: arrays.Mask


def read_segments(frames: FrameBatch, network: arrays.Integers, ip: IpPayloads, old: int) -> Segments:
    """Read TCP headers; a segment with a damaged header has no data.

    Args:
        frames: frames, with ``PADDING`` bytes after the last.
        network: start of each IP header, i64 (n,).
        ip: IP payloads of the same rows; each has at least ``TCP_BYTES``.
        old: number of segments, from the first on, that were read before.
    """
    frame_end = frames.offset + frames.length
    header = arrays.read_at(frames.data, ip.position, _HEADER)
    start = ip.position + (header["words"] >> 4).astype(np.int64) * 4
    end = np.minimum(ip.end, frame_end)
    sound = (start >= ip.position + TCP_BYTES) & (start <= end)
    start = np.where(sound, start, end)
    flags = header["flags"].astype(np.uint8)
    return Segments(
        frames=frames,
        network=network,
        ip=ip,
        source_port=header["source_port"].astype(np.uint16),
        destination_port=header["destination_port"].astype(np.uint16),
        sequence=(header["sequence"].astype(np.int64) + (flags & _SYN != 0)) % (1 << 32),
        acknowledged=header["acknowledged"].astype(np.int64),
        flags=np.where(sound, flags, 0).astype(np.uint8),
        start=start,
        length=end - start,
        cut=(ip.end > frame_end) | (frames.length < frames.original_length),
        fresh=np.arange(len(frames)) >= old,
    )


class SegmentBytes(msgspec.Struct, frozen=True, eq=False):
    """Data of new segments; all arrays have the same length.

    Attributes:
        data: buffer with the bytes, u8.
        offset: start of each segment's data, i64.
        length: bytes of each segment's data, i64.
        sequence: sequence number of the first byte, i64.
    """

    data: arrays.Octets
    offset: arrays.Integers
    length: arrays.Integers
    sequence: arrays.Integers


def rebuilt(
    segments: Segments, rows: arrays.Integers, contents: SegmentBytes
) -> tuple[arrays.Octets, arrays.Integers, arrays.Integers]:
    """Make segments with the headers of others.

    A packet that is longer than its IP header can say has the length 0 there, as segmentation offload leaves
    it.

    Args:
        rows: indices of the segments whose headers are used, i64 (n,).
        contents: data of the new segments, (n,).

    Returns:
        The frames, u8; the start of each, i64 (n,); the bytes of its headers, i64 (n,).
    """
    offset = segments.frames.offset[rows]
    header = segments.start[rows] - offset
    # Checksums are sums of 16-bit words: TCP headers start at even places, a zero byte follows each frame.
    transport = segments.ip.position[rows] - offset
    stride = (header + contents.length + 3) & ~1
    place = np.cumsum(stride) - stride + (transport & 1)
    out = np.zeros(int(stride.sum()) + 1 + arrays.PADDING, np.uint8)
    arrays.copy_rows(out, place + header, contents.data, contents.offset, contents.length)
    shape = header << 16 | transport << 8 | (segments.network[rows] - offset)
    for _, group in arrays.by_value(shape):
        first = group[0]
        _put_headers(
            out,
            (int(header[first]), int(transport[first]), int(segments.network[rows[first]] - offset[first])),
            arrays.gather(segments.frames.data, offset[group], int(header[first])),
            place[group],
            contents.length[group],
            contents.sequence[group],
        )
    return out[: len(out) - arrays.PADDING], place, header


def _put_headers(
    out: arrays.Octets,
    shape: tuple[int, int, int],
    head: arrays.Octets,
    place: arrays.Integers,
    length: arrays.Integers,
    sequence: arrays.Integers,
) -> None:
    """Write the headers of segments of one shape: size of all headers, start of the TCP and the IP header."""
    size, transport, network = shape
    four = head[0, network] >> 4 == 4
    total = size - network + length
    if four:
        put_words(head, network + 2, np.where(total > 0xFFFF, 0, total))
        put_words(head, network + 10, np.zeros(len(head), np.int64))
        put_words(head, network + 10, internet_checksum(words_of(head[:, network:transport]).sum(axis=1)))
        addresses = head[:, network + 12 : network + 20]
    else:
        rest = total - 40
        put_words(head, network + 4, np.where(rest > 0xFFFF, 0, rest))
        addresses = head[:, network + 8 : network + 40]
    tcp = head[:, transport:]
    tcp[:, 4:8] = sequence.astype(">u4").view(np.uint8).reshape(-1, 4)
    tcp[:, _FLAGS_AT] &= _KEPT_FLAGS
    put_words(tcp, 16, np.zeros(len(head), np.int64))
    whole = size - transport + length
    total = (
        words_of(addresses).sum(axis=1) + TCP + (whole & 0xFFFF) + (whole >> 16) + words_of(tcp).sum(axis=1)
    )
    put_words(tcp, 16, internet_checksum(total + arrays.word_sums(out, place + size, length)))
    out[place[:, None] + np.arange(size)] = head

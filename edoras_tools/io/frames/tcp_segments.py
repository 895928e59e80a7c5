"""TCP segments in columns: read from frames, and rebuilt with one message each (RFC 9293 section 3.1)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import msgspec
import numpy as np

from edoras_tools.io.frames.frame_batch import FrameBatch, internet_checksum, put_words, words_of
from edoras_tools.io.frames.network import TCP, IpPayloads
from edoras_tools.wire import arrays

if TYPE_CHECKING:
    from numpy.typing import NDArray


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

"""Frames that contain many UDP datagrams at once, cut into the frames that are sent on the wire.

With UDP segmentation offload a program passes many datagrams of one size to the kernel as one
(``UDP_SEGMENT``), and a capture on the sending machine sees them before they are separated: one frame, larger
than any on the link. The frame does not contain the size of its parts; the kernel reports it separately
(``virtio_net_hdr``). This does what the kernel does (``__udp_gso_segment``): each part has its own lengths,
IPv4 identification and checksums.
"""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from msgspec.structs import replace

from edoras_tools.io.frames.build import internet_checksum
from edoras_tools.io.frames.frame_batch import FrameBatch
from edoras_tools.io.frames.linklayer import demux, network_headers
from edoras_tools.model import Finding
from edoras_tools.wire.arrays.window import PADDING

if TYPE_CHECKING:
    from numpy.typing import NDArray

_UDP: Final = 17
_UDP_BYTES: Final = 8


def cut(frames: FrameBatch, size: NDArray[np.integer[Any]], header: NDArray[np.integer[Any]]) -> FrameBatch:
    """Return frames of one datagram each; numbers continue from the first frame's.

    Args:
        size: payload bytes of each part, integer (n,); 0 for a frame that is not cut.
        header: bytes from the IP header to the UDP header whose payload is cut, integer (n,); in a tunnel
            from the inner IP header, and the headers before it are repeated.
    """
    rows = np.flatnonzero(size)
    if not len(rows):
        return frames
    batch = demux(
        FrameBatch(
            frames.data,
            rows.astype(np.int64),  # frames without UDP are left out; the others are identified by their row
            frames.time_ns[rows],
            frames.link_type[rows],
            frames.offset[rows],
            frames.length[rows],
            frames.original_length[rows],
        )
    )
    headers = zip(
        batch.number.tolist(), network_headers(batch)[0].tolist(), batch.offset.tolist(), strict=True
    )
    parts: dict[int, list[tuple[bytes, int]]] = {}
    for (row, network, payload), findings in zip(headers, batch.capture_findings.tolist(), strict=True):
        if not findings & Finding.FRAGMENT and payload - _UDP_BYTES - network == header[row]:
            start, end = int(frames.offset[row]), int(frames.offset[row] + frames.length[row])
            whole = start + int(frames.original_length[row]) - payload
            frame = frames.data[start:end].tobytes()
            parts[row] = _parts(frame, network - start, payload - start, int(size[row]), whole)
    return _put(frames, {row: pieces for row, pieces in parts.items() if len(pieces) > 1})


def _parts(frame: bytes, network: int, payload: int, size: int, whole: int) -> list[tuple[bytes, int]]:
    """Return the frames into which a frame is cut, each with its captured bytes and its length on the wire.

    Args:
        frame: captured bytes.
        network: start of the IP header.
        payload: start of the UDP payload.
        size: payload bytes of a part.
        whole: payload bytes in total, captured or not.
    """
    pieces = []
    four = frame[network] >> 4 == 4
    addresses = frame[network + 12 : network + 20] if four else frame[network + 8 : network + 40]
    for number, at in enumerate(range(0, whole, size)):
        length = min(size, whole - at)
        body, header = frame[payload + at : payload + at + length], bytearray(frame[:payload])
        if four:
            (identification,) = struct.unpack_from(">H", frame, network + 4)
            struct.pack_into(
                ">HH", header, network + 2, payload - network + length, (identification + number) & 0xFFFF
            )
            struct.pack_into(">H", header, network + 10, 0)
            words = header[network : network + 4 * (frame[network] & 15)]
            struct.pack_into(">H", header, network + 10, _checksum(bytes(words)))
        else:
            struct.pack_into(">H", header, network + 4, payload - network - 40 + length)
        udp = payload - _UDP_BYTES
        struct.pack_into(">HH", header, udp + 4, _UDP_BYTES + length, 0)
        if len(body) == length:  # else the checksum is unknown; 0 means that there is none
            pseudo = addresses + struct.pack(">HH", _UDP, _UDP_BYTES + length)
            value = _checksum(pseudo + bytes(header[udp:]) + body) or 0xFFFF
            struct.pack_into(">H", header, udp + 6, value)
        pieces.append((bytes(header) + body, payload + length))
    return pieces


def _put(frames: FrameBatch, parts: dict[int, list[tuple[bytes, int]]]) -> FrameBatch:
    """Replace frames by their parts."""
    count = np.ones(len(frames), np.int64)
    count[list(parts)] = [len(pieces) for pieces in parts.values()]
    row = np.repeat(np.arange(len(frames)), count)
    first = np.cumsum(count) - count
    offset, length, original = frames.offset[row], frames.length[row], frames.original_length[row]
    data, used = [frames.data], frames.data.size
    for place, pieces in parts.items():
        span = slice(int(first[place]), int(first[place]) + len(pieces))
        length[span] = [len(frame) for frame, _ in pieces]
        original[span] = [wire for _, wire in pieces]
        offset[span] = used + np.cumsum(length[span]) - length[span]
        used += int(length[span].sum())
        data += [np.frombuffer(frame, np.uint8) for frame, _ in pieces]
    return replace(
        frames,
        data=np.concatenate([*data, np.zeros(PADDING, np.uint8)]),
        number=frames.number[0] + np.arange(len(row)) if len(row) else frames.number,
        time_ns=frames.time_ns[row],
        link_type=frames.link_type[row],
        offset=offset,
        length=length,
        original_length=original,
    )


def _checksum(octets: bytes) -> int:
    words = np.frombuffer(octets + bytes(len(octets) % 2), ">u2")
    return int(internet_checksum(words.sum(dtype=np.int64)))

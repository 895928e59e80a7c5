"""IP and UDP headers for datagrams that came through a socket, which keeps their headers to itself.

The frames are LINKTYPE_RAW, so that the rest of the pipeline, and every reader of a capture written from
them, sees what a capture would have shown. Lengths, addresses, ports and checksums are right; what a socket
cannot know has the usual value (identification 0, time to live 64).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

UDP_LENGTH: Final = 8
ROOM: Final = {4: 20 + UDP_LENGTH, 6: 40 + UDP_LENGTH}
"""By IP version: bytes of header to leave before each payload."""
_TIME_TO_LIVE: Final = 64
_UDP: Final = 17


def write_headers(
    data: NDArray[np.uint8],
    version: int,
    offset: NDArray[np.int64],
    length: NDArray[np.int32],
    source: tuple[NDArray[np.uint8], NDArray[np.uint16]],
    destination: tuple[NDArray[np.uint8], NDArray[np.uint16]],
) -> None:
    """Write the headers before some payloads (RFC 791, RFC 8200, RFC 768).

    Args:
        data: u8, each payload ``ROOM[version]`` bytes behind its offset, and a zero byte behind it.
        version: 4 or 6.
        offset: where each frame starts; even.
        length: bytes of each payload.
        source: addresses, 4 or 16 bytes a row, and ports.
        destination: the same.
    """
    size = ROOM[version] - UDP_LENGTH
    header = np.zeros((len(offset), ROOM[version]), dtype=np.uint8)
    if version == 4:
        header[:, 0] = 0x45
        _put(header, 2, ROOM[4] + length)
        header[:, 8] = _TIME_TO_LIVE
        header[:, 9] = _UDP
        addresses = 12
    else:
        header[:, 0] = 0x60
        _put(header, 4, UDP_LENGTH + length)
        header[:, 6] = _UDP
        header[:, 7] = _TIME_TO_LIVE
        addresses = 8
    width = (size - addresses) // 2
    header[:, addresses : addresses + width] = source[0]
    header[:, addresses + width : size] = destination[0]
    _put(header, size, source[1])
    _put(header, size + 2, destination[1])
    _put(header, size + 4, UDP_LENGTH + length)
    if version == 4:
        _put(header, 10, _checksum(_words(header[:, :size]).sum(axis=1)))
    # The UDP checksum covers addresses, protocol and UDP length, then header and payload (RFC 768).
    total = _words(header[:, addresses:]).sum(axis=1) + _UDP + UDP_LENGTH + length
    checksum = _checksum(total + _payload_sums(data, offset + ROOM[version], length))
    _put(header, size + 6, np.where(checksum == 0, 0xFFFF, checksum))
    data[offset[:, None] + np.arange(ROOM[version])] = header


def _put(header: NDArray[np.uint8], at: int, values: NDArray[Any]) -> None:
    """Write a column of 16-bit fields, big-endian."""
    header[:, at : at + 2] = values.astype(">u2").view(np.uint8).reshape(-1, 2)


def _words(header: NDArray[np.uint8]) -> NDArray[np.int64]:
    """Read rows of bytes as rows of big-endian 16-bit words."""
    return np.ascontiguousarray(header).view(">u2").astype(np.int64)


def _payload_sums(
    data: NDArray[np.uint8], start: NDArray[np.int64], length: NDArray[np.int32]
) -> NDArray[np.int64]:
    """Add up the 16-bit words of each payload; an odd last byte has the zero byte behind it as partner."""
    running = np.concatenate(([0], np.cumsum(data[: data.size // 2 * 2].view(">u2"), dtype=np.int64)))
    sums: NDArray[np.int64] = running[(start + length + 1) // 2] - running[start // 2]
    return sums


def _checksum(total: NDArray[np.int64]) -> NDArray[np.int64]:
    """Fold sums into the Internet checksum (RFC 1071)."""
    total = (total & 0xFFFF) + (total >> 16)
    total = (total & 0xFFFF) + (total >> 16)
    return ~total & 0xFFFF

"""WebSocket: the header of a frame, and the masking of its bytes (RFC 6455 section 5), big-endian."""

from __future__ import annotations

from enum import IntEnum
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from edoras_tools.wire.arrays.window import gather

if TYPE_CHECKING:
    from edoras_tools.wire.arrays.order import Integers, Mask, Octets


class Opcode(IntEnum):
    """The type of a frame (section 5.2)."""

    CONTINUATION = 0
    TEXT = 1
    BINARY = 2
    CLOSE = 8
    PING = 9
    PONG = 10


LARGEST_HEADER: Final = 14
"""Bytes of a header with an 8-byte length and a masking key."""
_KNOWN: Final = np.isin(np.arange(16), list(Opcode))
_CONTROL: Final = 8
"""First opcode of control frames, which are never split and hold at most ``_LARGEST_CONTROL`` bytes."""
_LARGEST_CONTROL: Final = 125
_KEY_BYTES: Final = 4


class FrameHeaders(NamedTuple):
    """The headers of some frames; arrays of one length.

    Attributes:
        final: bool, whether the frame ends its message.
        compressed: bool, RSV1: the message is compressed (RFC 7692).
        opcode: u8.
        masked: bool, whether the payload is masked.
        size: i64, size of the header in bytes.
        length: i64, size of the payload in bytes.
        valid: bool, whether a frame can begin like this.
        complete: bool, whether the header is complete.
    """

    final: Mask
    compressed: Mask
    opcode: Octets
    masked: Mask
    size: Integers
    length: Integers
    valid: Mask
    complete: Mask


def read_headers(data: Octets, at: Integers, end: Integers | int) -> FrameHeaders:
    """Read the headers of the frames that start at some positions.

    Args:
        data: u8.
        at: i64 (n,), positions in ``data``.
        end: one past the last byte that is available.
    """
    head = gather(data, at, LARGEST_HEADER)
    first, second = head[:, 0], head[:, 1]
    opcode: Octets = np.bitwise_and(first, 15, dtype=np.uint8)
    final, short = first >= 0x80, (second & 0x7F).astype(np.int64)
    masked = second >= 0x80
    two = head[:, 2:4].view(">u2")[:, 0].astype(np.int64)
    eight = np.ascontiguousarray(head[:, 2:10]).view(">u8")[:, 0]
    length = np.select([short == 126, short == 127], [two, eight.astype(np.int64)], short)
    extended = np.select([short == 126, short == 127], [2, 8], 0)
    size = 2 + extended + _KEY_BYTES * masked
    control = opcode >= _CONTROL
    compressed = first & 0x40 != 0
    valid = _KNOWN[opcode] & (first & 0x30 == 0) & (length >= 0)
    valid &= ~control | (final & ~compressed & (short <= _LARGEST_CONTROL))
    valid &= ~compressed | (opcode != Opcode.CONTINUATION)
    return FrameHeaders(final, compressed, opcode, masked, size, length, valid, end - at >= 2 + extended)


def unmask(data: Octets, start: Integers, length: Integers, keys: Octets) -> None:
    """Remove the masks of payloads, in place (section 5.3).

    Args:
        data: u8, the payloads end to end.
        start: i64 (n,), first byte of each payload.
        length: i64 (n,), size of each payload in bytes.
        keys: u8 (n, 4), masking keys; zeros for payloads that are not masked.
    """
    row = np.repeat(np.arange(len(start)), length)
    place = np.arange(len(row)) - np.repeat(np.cumsum(length) - length, length)
    data[start[row] + place] ^= keys[row, place & 3]


def masking_keys(data: Octets, at: Integers, headers: FrameHeaders) -> Octets:
    """Return the masking key of each frame, u8 (n, 4); zeros where there is none."""
    keys = gather(data, np.maximum(at + headers.size - _KEY_BYTES, 0), _KEY_BYTES)
    keys[~headers.masked] = 0
    return keys

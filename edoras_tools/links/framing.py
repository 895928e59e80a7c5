"""The interface that cuts a link's messages from a TCP stream.

A link over TCP sets ``LinkProtocol.framing`` to an object of a class derived from :class:`Framing`, and names
its ports in ``LinkProtocol.transport`` with ``protocol="tcp"`` (or ``"either"``). Most links only implement
:meth:`Framing.lengths`: the length of the message that starts at a byte. ``io.frames.tcp`` puts the bytes of
each connection in order, calls it, and makes one row of a ``PacketBatch`` from each message, so
``recognise``, ``locate`` and ``dissect`` of the link see a message like a datagram.

Rules that every framing keeps:

1. It is frozen: knowledge of one connection is kept in the object that :meth:`Framing.state` returns.
2. It raises nothing, for any bytes.
3. A message longer than ``largest`` is none: no stream can make a reader keep more than that.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar, Final, Protocol

import msgspec
import numpy as np

from edoras_tools.wire.arrays.window import PADDING

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from edoras_tools.wire.arrays.order import Integers, Mask, Octets

NOT_YET: Final = 0
"""The length of a message whose header is not complete yet."""
NOT_A_MESSAGE: Final = -1
"""The length at a byte where no message starts."""


class MessageContents(msgspec.Struct, frozen=True, eq=False):
    """The contents of the messages of one connection, if they differ from the messages' bytes.

    Attributes:
        data: contents end to end, u8.
        offset: start of each in ``data``, i64 (n,).
        length: bytes of each, i64 (n,).
        part: whether the message is only a part of one, bool (n,): its content comes with a later message.
    """

    data: Octets
    offset: Integers
    length: Integers
    part: Mask


class StreamState(Protocol):
    """The state of one connection, for a link whose messages depend on earlier ones.

    Attributes:
        foreign: whether the connection is another program's on the same port, so that nothing of it is kept.
    """

    foreign: bool

    def contents(self, data: Octets, offset: Integers, length: Integers, forward: Mask) -> MessageContents:
        """Return the contents of the next messages; they come in the order in which they were complete.

        Args:
            data: buffer with the messages, u8.
            offset: start of each, i64 (n,).
            length: bytes of each, i64 (n,).
            forward: direction of each, bool (n,); which end is which is unknown.
        """


class Framing:
    """Cuts a byte stream into messages.

    Attributes:
        head: number of bytes that are enough to know the length of any message.
        largest: bytes of the longest message.
        sender: bytes of ``head`` that are the same in all messages of one end of a connection.
        checked: whether a message that is ``likely`` surely is one, for example by a check value.
    """

    head: ClassVar[int] = 1
    largest: ClassVar[int] = 65535
    sender: ClassVar[slice] = slice(0)
    checked: bool = False

    def lengths(self, data: Octets, at: Integers, end: Integers | int) -> Integers:
        """Return the bytes of the message that starts at each position.

        Args:
            data: contiguous buffer, u8; at least ``wire.arrays.window.PADDING`` bytes follow each ``end``.
            at: positions, i64 (n,), at most ``end``.
            end: end of the present bytes, for all or i64 (n,).

        Returns:
            Lengths, i64 (n,), header included; ``NOT_YET`` if more bytes are needed, and ``NOT_A_MESSAGE``
            if no message of this link starts there.
        """
        raise NotImplementedError

    def length(self, data: memoryview, at: int, end: int) -> int:
        """Return the same as ``lengths`` for one position; override it if that is faster."""
        return int(self.lengths(np.frombuffer(data, np.uint8), np.array([at], np.int64), end)[0])

    def cut(self, data: bytes) -> tuple[list[bytes], bytes, bool]:
        """Return the complete messages at the start of a stream, the rest, and whether that is no message."""
        messages: list[bytes] = []
        at, size, padded = 0, NOT_YET, memoryview(data + bytes(PADDING))
        while at < len(data):
            size = self.length(padded, at, len(data))
            if size <= 0 or at + size > len(data):
                break
            messages.append(data[at : at + size])
            at += size
        return messages, data[at:], size == NOT_A_MESSAGE

    def likely(self, data: Octets, at: Integers, end: Integers | int) -> Mask:
        """Return where a message probably starts, bool (n,): used to find the first one after missing bytes.

        The stricter it is, the better; ``lengths`` may accept positions that it does not.
        """
        return self.lengths(data, at, end) > 0

    def state(self) -> StreamState | None:
        """Return a new object for a new connection; None if each message is its own content."""
        return None


def prefixed(
    head: NDArray[Any], size: NDArray[Any], room: Integers | int, needed: int, largest: int
) -> Integers:
    """Return lengths like :meth:`Framing.lengths`, for a header that states them.

    Args:
        head: whether the header is possible, bool (n,).
        size: bytes of the message by its header, header included, integer (n,).
        room: number of present bytes from each position on.
        needed: bytes of the header.
        largest: see ``Framing``.
    """
    fits = head & (size >= needed) & (size <= largest)
    return np.where(room < needed, NOT_YET, np.where(fits, size, NOT_A_MESSAGE)).astype(np.int64)

"""How a link's messages are cut from a TCP stream.

A link that travels over TCP sets ``LinkProtocol.framing`` to an object of a class made from :class:`Framing`,
and names its ports in ``LinkProtocol.transport`` with ``protocol="tcp"`` (or ``"either"``). For most links
:meth:`Framing.lengths` is all that there is to write: how long the message is that starts at a byte.
``io.frames.tcp`` puts the bytes of each connection in order, calls it, and makes of each message one row of a
``PacketBatch``, so ``recognise``, ``locate`` and ``dissect`` of the link see a message like a datagram.

Rules that every framing keeps:

1. It is frozen: what is learnt from one connection is kept in what :meth:`Framing.state` returns.
2. Whatever the bytes, it raises nothing.
3. A message longer than ``largest`` is none: no stream can make a reader keep more than that.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar, Final, Protocol

import msgspec
import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from edoras_tools.wire.arrays.order import Integers, Mask

NOT_YET: Final = 0
"""The length of a message whose header is not complete yet."""
NOT_A_MESSAGE: Final = -1
"""The length where no message starts."""


class MessageContents(msgspec.Struct, frozen=True, eq=False):
    """What the messages of one connection hold, where that is not their bytes as they are.

    Attributes:
        data: u8, the contents end to end.
        offset: i64 (n,), start of each in ``data``.
        length: i64 (n,), bytes of each.
        part: bool (n,), messages that are only a part of one: their content comes with a later one.
    """

    data: NDArray[np.uint8]
    offset: Integers
    length: Integers
    part: Mask


class StreamState(Protocol):
    """What is known of one connection, for a link whose messages depend on those before.

    Attributes:
        foreign: whether it is another program's, which uses the same port: nothing of it is kept.
    """

    foreign: bool

    def contents(
        self, data: NDArray[np.uint8], offset: Integers, length: Integers, forward: Mask
    ) -> MessageContents:
        """Return what the next messages hold; they come in the order in which they were complete.

        Args:
            data: u8, holds the messages.
            offset: i64 (n,), start of each.
            length: i64 (n,), bytes of each.
            forward: bool (n,), the direction of each; which of the two is which end is not known.
        """


class Framing:
    """Cuts a byte stream into messages.

    Attributes:
        head: bytes that are enough to know the length of any message.
        largest: bytes of the longest message.
        sender: bytes of ``head`` that are the same in all messages that one end of a connection sends.
        checked: whether a message that is ``likely`` surely is one, as with a check value.
    """

    head: ClassVar[int] = 1
    largest: ClassVar[int] = 65535
    sender: ClassVar[slice] = slice(0)
    checked: bool = False

    def lengths(self, data: NDArray[np.uint8], at: Integers, end: Integers | int) -> Integers:
        """Return the bytes of the message that starts at each position.

        Args:
            data: u8, contiguous; at least ``wire.arrays.window.PADDING`` bytes follow each ``end``.
            at: i64 (n,), positions, at most ``end``.
            end: one past the last byte that is there, for all or i64 (n,).

        Returns:
            i64 (n,), header included; ``NOT_YET`` where more bytes are needed to tell, and ``NOT_A_MESSAGE``
            where none of this link starts.
        """
        raise NotImplementedError

    def length(self, data: memoryview, at: int, end: int) -> int:
        """Return what ``lengths`` does for one position; override it where that is faster."""
        return int(self.lengths(np.frombuffer(data, np.uint8), np.array([at], np.int64), end)[0])

    def likely(self, data: NDArray[np.uint8], at: Integers, end: Integers | int) -> Mask:
        """Tell where a message probably starts, bool (n,): used to find the first one behind missing bytes.

        The more it asks for, the better; ``lengths`` may accept what this does not.
        """
        return self.lengths(data, at, end) > 0

    def state(self) -> StreamState | None:
        """Return a new object for a new connection; None where each message is its own content."""
        return None


def prefixed(
    head: NDArray[Any], size: NDArray[Any], room: Integers | int, needed: int, largest: int
) -> Integers:
    """Return lengths as :meth:`Framing.lengths` does, for a header that states them.

    Args:
        head: bool (n,), whether the header can be one.
        size: integer (n,), bytes of the message as its header states them, header included.
        room: bytes that are there from each position on.
        needed: bytes of the header.
        largest: see ``Framing``.
    """
    fits = head & (size >= needed) & (size <= largest)
    return np.where(room < needed, NOT_YET, np.where(fits, size, NOT_A_MESSAGE)).astype(np.int64)

"""One datagram sent, and the result: the form in which every sender reports it."""

from __future__ import annotations

import errno
from typing import TYPE_CHECKING, Final, NamedTuple

if TYPE_CHECKING:
    import socket
    from collections.abc import Mapping

    from edoras_tools.io.net.address import Address

MOST_REFUSALS: Final = 8
"""Refusals in a row for the same datagram; each is about an earlier one."""


class SendResult(NamedTuple):
    """The result of sending datagrams.

    Attributes:
        done: datagrams from the first on that were sent or failed.
        refused: answers that nothing listens (ICMP port unreachable); each is about an earlier datagram.
        errors: system errors of the others, with counts.
        full: whether the socket accepts no more now.
    """

    done: int
    refused: int = 0
    errors: Mapping[str, int] = {}
    full: bool = False

    @property
    def taken(self) -> int:
        """Number of datagrams that the system accepted."""
        return self.done - self.failed

    @property
    def failed(self) -> int:
        """Number of datagrams that the system did not send."""
        return sum(self.errors.values())


def send_one(opened: socket.socket, payload: bytes | memoryview, to: Address | None = None) -> SendResult:
    """Send one datagram; on a non-blocking socket, without waiting.

    Args:
        payload: the bytes to send.
        to: the receiver; None for a connected socket.
    """
    refused = 0
    while True:
        try:
            if to is None:
                opened.send(payload)
            else:
                opened.sendto(payload, to.host)
        except (BlockingIOError, InterruptedError):
            return SendResult(0, refused, full=True)
        except OSError as error:
            if error.errno == errno.ECONNREFUSED and refused < MOST_REFUSALS:
                refused += 1
                continue
            if error.errno == errno.ENOBUFS:
                return SendResult(0, refused, full=True)
            return SendResult(1, refused, {error.strerror or str(error): 1})
        else:
            return SendResult(1, refused)

"""Records the ICMP errors of a capture, each once, and when ports sent datagrams that are no packets."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from edoras_tools.decode.conversations import conversation_of
from edoras_tools.io.frames.linklayer import network_headers
from edoras_tools.links.icmp import quoted_rows
from edoras_tools.links.table import among
from edoras_tools.model import OTHER, Columns, PacketBatch
from edoras_tools.units import MILLISECOND, SECOND
from edoras_tools.wire.arrays import of_bytes

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from edoras_tools.wire.arrays import Integers, Mask, Places

    Numbers = Callable[[PacketBatch], tuple[NDArray[np.int32], NDArray[np.int32]]]
    """Returns the endpoint numbers of source and destination of each datagram: i32 (n,) each."""

_AGAIN_NS: Final = MILLISECOND
"""Equal errors within this time are one error that was captured twice."""
_ELSEWHERE_NS: Final = 5 * SECOND
"""The same if their host numbers them: a network doubled the error, or another host captured it, too."""
_ADDRESSES: Final = 12
"""What of an IP header each router changes stands before this byte."""


class PortErrors(NamedTuple):
    """The n errors of a capture as columns.

    Attributes:
        time_ns: i64 (n,), capture time.
        source: i64 (n,), number of the endpoint that sent the quoted datagram.
        destination: i64 (n,), number of the endpoint that did not get it.
        identification: i64 (n,), IP identification of the quoted datagram; 0 if it has none.
        closed: bool (n,), whether the receiver's host reports that nobody listens on the port.
        reason: i64 (n,), what the error says; ``error_text`` of the link has its text.
        number: i64 (n,), IP identification of the error itself; 0 if it has none.
        print: i64 (n,), fingerprint of the error from the addresses on.
    """

    time_ns: Integers
    source: Integers
    destination: Integers
    identification: Integers
    closed: Mask
    reason: Integers
    number: Integers
    print: Integers

    def take(self, rows: Places | Mask) -> PortErrors:
        """Return the errors that an index array or a mask selects."""
        columns: list[Any] = [column[rows] for column in self]
        return PortErrors(*columns)


class ErrorRecorder:
    """Records the errors of a capture, and the datagrams without packets: a robot's, or those on other links.

    Args:
        numbers: function that numbers the endpoints of a batch.
    """

    def __init__(self, numbers: Numbers) -> None:
        self._numbers = numbers
        self._ways = self._seen = none = np.zeros(0, np.int64)
        self._errors = [PortErrors(none, none, none, none, none.astype(bool), none, none, none)]
        self._voices: list[tuple[NDArray[Any], ...]] = [(none, none, none)]

    def about(self, batch: PacketBatch, columns: Columns) -> Mask:
        """Return the datagrams without a link in conversations that an error quoted so far: bool (n,).

        Of datagrams with equal identification, only the first of the capture is marked.
        """
        error = np.flatnonzero(among(columns.link, lambda link: link.quotes))
        if len(error):  # mostly there is none
            self._ways = np.union1d(self._ways, conversation_of(quoted_rows(batch, error).datagrams))
        mask = np.zeros(len(batch), bool)
        rows = np.flatnonzero(columns.link == OTHER) if len(self._ways) else error[:0]
        if len(rows):
            way, identification = conversation_of(batch)[rows], network_headers(batch)[1][rows]
            own = np.isin(way, self._ways)
            rows, number = rows[own], way[own] << 16 | identification[own]
            first = np.unique(number, return_index=True)[1]
            first = first[~np.isin(number[first], self._seen)]
            mask[rows[identification[own] == 0]] = mask[rows[first]] = True
            self._seen = np.append(self._seen, number[first])
        return mask

    def add(self, batch: PacketBatch, columns: Columns) -> None:
        """Record the errors of a batch; each other datagram shows that its sender is alive."""
        error = among(columns.link, lambda link: link.quotes)
        others = batch.take(~error)
        self._voices.append((others.time_ns, *self._numbers(others)))
        if not error.any():
            return
        own, quoted = batch.take(error), quoted_rows(batch, np.flatnonzero(error))
        network, number, _ = network_headers(own)
        inner = network + _ADDRESSES
        message = of_bytes(own.data, inner, own.frame_offset + own.frame_length - inner)
        source, destination = (item.astype(np.int64) for item in self._numbers(quoted.datagrams))
        identification = quoted.identification.astype(np.int64)
        rest = quoted.closed, quoted.reason, number.astype(np.int64), message.view(np.int64)
        self._errors.append(PortErrors(own.time_ns, source, destination, identification, *rest))

    def errors(self) -> PortErrors:
        """Return the errors, each once, in order of time."""
        columns: list[NDArray[Any]] = [np.concatenate(parts) for parts in zip(*self._errors, strict=True)]
        every = PortErrors(*columns)
        every = every.take(np.lexsort((every.time_ns, every.number, every.print)))
        within_ns = np.where(every.number[1:] > 0, _ELSEWHERE_NS, _AGAIN_NS)
        again = np.zeros(len(every.print), bool)
        same = (np.diff(every.print) == 0) & (np.diff(every.number) == 0)
        again[1:] = same & (np.diff(every.time_ns) < within_ns)
        every = every.take(~again)
        return every.take(np.argsort(every.time_ns, kind="stable"))

    def voices(self) -> tuple[NDArray[Any], ...]:
        """Return the other datagrams as columns: i64 time, source and destination endpoint."""
        return tuple(np.concatenate(parts) for parts in zip(*self._voices, strict=True))

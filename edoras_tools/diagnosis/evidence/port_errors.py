"""ICMP errors of a capture, each once, and when ports spoke: what shows which ports were closed."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from edoras_tools.decode.conversations import conversation_of
from edoras_tools.io.frames.linklayer import network_headers
from edoras_tools.links.icmp import quoted_rows
from edoras_tools.links.table import among
from edoras_tools.model import OTHER, Columns, PacketBatch
from edoras_tools.units import MILLISECOND
from edoras_tools.wire.arrays.fingerprint import of_bytes

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from edoras_tools.wire.arrays.order import Integers, Mask, Places

    Numbers = Callable[[PacketBatch], tuple[NDArray[np.int32], NDArray[np.int32]]]
    """Returns the numbers of the source and of the destination of each row."""

_AGAIN_NS: Final = MILLISECOND
"""The same error within this time was captured twice."""


class PortErrors(NamedTuple):
    """The errors of a capture, in order of time; an element each.

    Attributes:
        time_ns: i64, when it was captured.
        source: i64, number of the endpoint that sent the quoted datagram,
        destination: i64, and of the one that did not get it.
        identification: i64, of the quoted datagram; 0 where it has none.
        closed: bool, whether the receiver's host says that nobody listens on the port.
        print: i64, fingerprint of the error's own IP packet.
    """

    time_ns: Integers
    source: Integers
    destination: Integers
    identification: Integers
    closed: Mask
    print: Integers

    def take(self, rows: Places | Mask) -> PortErrors:
        """Return some of them."""
        columns: list[Any] = [column[rows] for column in self]
        return PortErrors(*columns)


class ErrorRecorder:
    """Keeps the errors of a capture, and when ports whose datagrams are no packets, as robots', spoke.

    Args:
        numbers: numbers the endpoints of a batch.
    """

    def __init__(self, numbers: Numbers) -> None:
        self._numbers = numbers
        self._ways = self._seen = none = np.zeros(0, np.int64)
        self._errors = [PortErrors(none, none, none, none, none.astype(bool), none)]
        self._voices: list[tuple[NDArray[Any], ...]] = [(none, none, none)]

    def about(self, batch: PacketBatch, columns: Columns) -> Mask:
        """Tell which of no link went where an error came back, in this batch or before: each of them once."""
        error = np.flatnonzero(among(columns.link, lambda link: link.quotes))
        if len(error):
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
        """Take the errors of a batch; all else in it is a sign of life of its sender."""
        error = among(columns.link, lambda link: link.quotes)
        others = batch.take(~error)
        self._voices.append((others.time_ns, *self._numbers(others)))
        if not error.any():
            return
        own, quoted = batch.take(error), quoted_rows(batch, np.flatnonzero(error))
        network = network_headers(own)[0]
        message = of_bytes(own.data, network, own.frame_offset + own.frame_length - network)
        source, destination = (item.astype(np.int64) for item in self._numbers(quoted.datagrams))
        identification = quoted.identification.astype(np.int64)
        prints = message.view(np.int64)
        self._errors.append(
            PortErrors(own.time_ns, source, destination, identification, quoted.closed, prints)
        )

    def errors(self) -> PortErrors:
        """Return the errors, each once."""
        columns: list[NDArray[Any]] = [np.concatenate(parts) for parts in zip(*self._errors, strict=True)]
        every = PortErrors(*columns)
        every = every.take(np.lexsort((every.time_ns, every.print)))
        again = np.zeros(len(every.print), bool)
        again[1:] = (np.diff(every.print) == 0) & (np.diff(every.time_ns) < _AGAIN_NS)
        every = every.take(~again)
        return every.take(np.argsort(every.time_ns, kind="stable"))

    def voices(self) -> tuple[NDArray[Any], ...]:
        """Return when other datagrams came, and the numbers of the endpoints that sent them and got them."""
        return tuple(np.concatenate(parts) for parts in zip(*self._voices, strict=True))

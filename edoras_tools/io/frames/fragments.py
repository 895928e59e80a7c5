"""Reassembles IP fragments, with limited memory and time (RFC 791 section 3.2, RFC 8200 section 4.5)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import msgspec
import numpy as np
from msgspec.structs import replace

from edoras_tools.io.frames.network import IpHeaders, IpPayloads, transport_payloads
from edoras_tools.wire.arrays.window import gather
from edoras_tools.wire.icmp import FORMS, LONGEST, QUOTED_UDP

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from edoras_tools.model import PacketBatch
    from edoras_tools.wire.arrays.order import Integers, Mask, Places
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
    """The first fragment of a datagram of which no other fragment came.

    Attributes:
        time_ns: capture time of the first of its fragments.
        source: source IP address, 4 or 16 bytes.
        destination: destination IP address, 4 or 16 bytes.
        head: at most ``QUOTED_BYTES`` of the IP payload: the UDP header and the bytes after it.
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
        lacking: beginnings of the dropped datagrams of which only the first fragment came; at most 16,384.
    """

    def __init__(self, *, timeout_ns: int = 30_000_000_000, limit: int = 16 << 20) -> None:
        self.abandoned = 0
        self.lacking: list[Beginning] = []
        self._timeout_ns = timeout_ns
        self._limit = limit
        self._stored = 0
        self._partials: dict[tuple[int, int, bytes, bytes], _Partial] = {}

    @property
    def pending(self) -> int:
        """Number of incomplete datagrams."""
        return len(self._partials)

    def beginnings(self) -> list[Beginning]:
        """Return ``lacking``, and the beginnings of datagrams that still wait for fragments."""
        return [*self.lacking, *(item for key in self._partials if (item := self._beginning(key)))]

    def _beginning(self, key: tuple[int, int, bytes, bytes]) -> Beginning | None:
        partial = self._partials[key]
        (start, head), *later = partial.pieces or [(0, b"")]
        alone = head and not start and not later
        return Beginning(partial.time_ns, key[2], key[3], head[:QUOTED_BYTES]) if alone else None

    def add(self, fragment: Fragment) -> tuple[bytes | None, tuple[int, int]]:
        """Add a fragment.

        Returns:
            The IP payload if this fragment completed it, else None; and the UDP ports, 0 while unknown.
        """
        self._expire(fragment.time_ns)
        partial = self._partials.setdefault(fragment.key, _Partial(fragment.time_ns))
        self._store(partial, fragment)
        if partial.total >= 0 and partial.units == (1 << -(-partial.total // 8)) - 1:
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
        while self._partials:
            oldest = next(iter(self._partials.values()))
            if now_ns - oldest.time_ns <= self._timeout_ns:
                return
            self._abandon_oldest()

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

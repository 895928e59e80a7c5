"""Finds the bytes of a batch that may hold C structs: after headers of packets, and on the robot link."""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from edoras_tools.links.table import accepted, among
from edoras_tools.wire import ccsds

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from numpy.typing import NDArray

    from edoras_tools.structs import Structs
    from edoras_tools.wire.arrays.order import Integers, Mask, Octets, Places


class StructPayloads(NamedTuple):
    """Bytes that may hold structs, as columns of one length; for packets, the bytes after the cFE header.

    Attributes:
        row: i64, row of the packet or datagram in the batch.
        key: i32, MsgId, or UDP port as in ``Key``.
        code: i32, function code of a command; for datagrams, their bytes.
        offset: i64, first byte in the data of the batch.
        length: i32, bytes.
    """

    row: Places
    key: NDArray[np.int32]
    code: NDArray[np.int32]
    offset: Integers
    length: NDArray[np.int32]

    def take(self, some: Any) -> StructPayloads:
        """Return some of the payloads, chosen by indices, a mask or a slice."""
        return StructPayloads(*(column[some] for column in self))

    def join(self, others: StructPayloads) -> StructPayloads:
        """Return these payloads, followed by others."""
        pairs: Iterator[tuple[Any, Any]] = zip(self, others, strict=True)
        return StructPayloads(*(np.concatenate(pair) for pair in pairs))


_NOTHING: Final = StructPayloads(
    np.zeros(0, np.intp),
    np.zeros(0, np.int32),
    np.zeros(0, np.int32),
    np.zeros(0, np.int64),
    np.zeros(0, np.int32),
)


def payloads(
    structs: Structs,
    columns: Callable[[str], NDArray[Any]],
    datagrams: Callable[[str], NDArray[Any]],
    data: Octets,
) -> StructPayloads:
    """Return all payloads of a batch that structs are bound to.

    Args:
        columns: returns a column of the decoder by name.
        datagrams: returns a column of the batch by name; the same rows.
        data: u8, the buffer that the offsets point into.
    """
    key = columns("msg_id")
    bound_rows, bare = structs.has.take(key), _last_hops().take(columns("link"))
    if structs.dictionary is None and not np.count_nonzero(bound_rows) and not np.count_nonzero(bare):
        return _NOTHING  # the case of most small batches of a live link
    rows = np.flatnonzero(bound_rows)
    rows = rows[columns("header_length")[rows] > ccsds.PRIMARY.size]
    header = columns("header_length")[rows]
    samples = StructPayloads(
        rows,
        key[rows],
        columns("function_code")[rows],
        columns("packet_offset")[rows] + header,
        columns("packet_length")[rows] - header,
    )
    if structs.dictionary is not None:
        described = np.flatnonzero(among(columns("link"), lambda link: link.dictionary))
        offset, size = datagrams("offset")[described], datagrams("length")[described]
        entries = structs.dictionary.payloads(data, offset, size)
        samples = samples.join(entries._replace(row=described[entries.row]))
    described_rows = np.flatnonzero(bare)
    if not len(described_rows):
        return samples
    length = datagrams("length")[described_rows]
    ports = structs.of_port(datagrams("destination_port")[described_rows])
    return samples.join(
        StructPayloads(described_rows, ports, length, datagrams("offset")[described_rows], length)
    )


@cache
def _last_hops() -> Mask:
    return accepted(lambda link: link.last_hop)

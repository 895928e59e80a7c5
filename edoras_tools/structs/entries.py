"""Dictionaries: layouts whose structs follow an ID of their link, not a cFE header.

The layout of a dictionary, which an add-on or a package reads (``structs.files.Database``), has
``shapes.LayoutEntries``. Their method ``table`` makes the ``LayoutEntryTable`` that this package uses.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Protocol

if TYPE_CHECKING:
    from collections.abc import Iterator

    import numpy as np
    from numpy.typing import NDArray

    from edoras_tools.links.reading import Reading
    from edoras_tools.structs.bound import Bound
    from edoras_tools.structs.payloads import StructPayloads
    from edoras_tools.structs.shapes import LayoutEntry
    from edoras_tools.wire.arrays.order import Integers, Octets


class LayoutEntryTable(Protocol):
    """The entries of a dictionary by key; finds them in the datagrams of a link.

    Attributes:
        unknown: key of an ID that is not in the dictionary.
        odd: key of bytes after the last value that are not an ID.
    """

    unknown: int
    odd: int

    def __getitem__(self, key: int, /) -> Bound:
        """Return the struct of a key."""

    def entry(self, key: int) -> LayoutEntry:
        """Return the entry of a key."""

    def payloads(self, data: Octets, offset: Integers, length: NDArray[np.int32]) -> StructPayloads:
        """Return the payloads of all entries in the datagrams, in order; rows number the datagrams.

        Args:
            data: u8, the buffer that the offsets point into.
            offset: i64 (n,), first byte of each datagram.
            length: i32 (n,), bytes of each datagram.
        """

    def whole(self, payloads: StructPayloads) -> StructPayloads:
        """Return the payloads that belong to an entry of the dictionary and are complete."""

    def read(self, reading: Reading, kind: int, at: int, end: int) -> bool:
        """Read the entry that one packet of a datagram holds; see ``links.reading.Reading.described``."""

    def logs(self, payloads: StructPayloads, data: Octets) -> Iterator[tuple[int, int, dict[str, Any]]]:
        """Yield row, place and fields of ``rcl_interfaces/msg/Log``, except the time, for each event."""

    def engine_values(self) -> dict[str, Any]:
        """Return the data of the entries that the engine of the Wireshark dissector uses, as plain values."""

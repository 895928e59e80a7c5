"""Dictionaries: layouts whose structs stand behind an ID of a link's own, not behind a cFE header.

An add-on or a package that reads one (``structs.files.Database``) gives its layout
``shapes.LayoutEntries``; these make the table that is asked here.
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


class LayoutEntryTable(Protocol):
    """The entries of a dictionary by their keys, and what finds them in the datagrams of a link.

    Attributes:
        unknown: key of an ID that the dictionary has not.
        odd: key of bytes behind the last value that are not an ID.
    """

    unknown: int
    odd: int

    def __getitem__(self, key: int, /) -> Bound:
        """Return the struct of a key."""

    def entry(self, key: int) -> LayoutEntry:
        """Return the entry of a key."""

    def payloads(
        self, data: NDArray[np.uint8], offset: NDArray[np.int64], length: NDArray[np.int32]
    ) -> StructPayloads:
        """Return all that datagrams hold, behind the IDs, in order; rows count the datagrams.

        Args:
            data: u8, what the offsets point into.
            offset: i64 (n,), the first byte of each datagram.
            length: i32 (n,), its bytes.
        """

    def whole(self, payloads: StructPayloads) -> StructPayloads:
        """Return those of payloads that are entries and not cut."""

    def read(self, reading: Reading, kind: int, at: int, end: int) -> bool:
        """Read what one packet of a datagram holds; see ``links.reading.Reading.described``."""

    def logs(
        self, payloads: StructPayloads, data: NDArray[np.uint8]
    ) -> Iterator[tuple[int, int, dict[str, Any]]]:
        """Yield row, place and the fields of ``rcl_interfaces/msg/Log``, but its time, of each event."""

    def engine_values(self) -> dict[str, Any]:
        """Return what the engine of the Wireshark dissector reads of the entries, as plain values."""

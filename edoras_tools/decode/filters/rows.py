"""Packets as a filter sees them: a batch with its columns, or packets that were decoded one by one.

Both give the same series for every field.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from edoras_tools.decode.stack import Dissector
from edoras_tools.model import NO_ROUTE, Columns, Decoded, PacketBatch

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray
    from typing_extensions import Self

    from edoras_tools.decode.context import Context


class PacketRows:
    """Some packets, decoded one by one.

    Args:
        begin_ns: time of the capture's first datagram.
    """

    def __init__(self, context: Context, begin_ns: int, packets: Sequence[Decoded] = ()) -> None:
        self.context = context
        self.begin_ns = begin_ns
        self._packets = packets

    def __len__(self) -> int:
        return len(self._packets)

    def packets(self) -> Sequence[Decoded]:
        """Return the packets."""
        return self._packets

    def take(self, rows: NDArray[np.int64]) -> Self:
        """Return some of the packets, given by index."""
        return type(self)(self.context, self.begin_ns, [self._packets[row] for row in rows])


class ColumnRows(PacketRows):
    """Rows of a batch, read in bulk where a field allows it.

    Attributes:
        batch: the whole batch.
        columns: what was decoded from it.
        selection: which rows; an index array, or a slice for all.
    """

    def __init__(
        self,
        context: Context,
        begin_ns: int,
        batch: PacketBatch,
        columns: Columns,
        selection: NDArray[np.int64] | slice = slice(None),
    ) -> None:
        super().__init__(context, begin_ns)
        self.batch = batch
        self.columns = columns
        self.selection = selection
        self._count = len(batch) if isinstance(selection, slice) else len(selection)
        self._known: dict[object, Any] = {}

    def __len__(self) -> int:
        return self._count

    def column(self, name: str) -> NDArray[Any]:
        """Return one of the decoder's columns for these rows."""
        column: NDArray[Any] = getattr(self.columns, name)[self.selection]
        return column

    def datagram(self, name: str) -> NDArray[Any]:
        """Return one of the batch's columns for these rows."""
        column: NDArray[Any] = getattr(self.batch, name)[self.selection]
        return column

    def indices(self) -> NDArray[np.int64]:
        """Return where in the batch these rows are."""
        return np.arange(len(self.batch))[self.selection]

    def alone(self) -> tuple[PacketBatch, Columns]:
        """Return these rows as a batch and columns of their own; the whole ones where all are chosen."""
        if len(self) == len(self.batch):
            return self.batch, self.columns
        rows = self.indices()
        return self.batch.take(rows), self.columns.take(rows)

    def routes(self) -> NDArray[np.int16]:
        """Return the route of a packet's message: one of its link, else of any link."""

        def make() -> NDArray[np.int16]:
            exact, msg_id = self.column("route"), self.column("msg_id")
            return np.where(exact == NO_ROUTE, self.context.any_route_of[msg_id], exact)

        routes: NDArray[np.int16] = self.once("routes", make)
        return routes

    def packets(self) -> Sequence[Decoded]:
        """Return the packets, dissected one by one."""
        dissector = Dissector(self.context, detail=False)
        packets: Sequence[Decoded] = self.once(
            "packets", lambda: [dissector.dissect(self.batch[row]) for row in self.indices().tolist()]
        )
        return packets

    def take(self, rows: NDArray[np.int64]) -> Self:
        """Return some of the rows, given by index."""
        selection = rows if isinstance(self.selection, slice) else self.selection[rows]
        return type(self)(self.context, self.begin_ns, self.batch, self.columns, selection)

    def once(self, key: object, make: Callable[[], Any]) -> Any:
        """Return what was made under a key, and make it the first time."""
        if key not in self._known:
            self._known[key] = make()
        return self._known[key]

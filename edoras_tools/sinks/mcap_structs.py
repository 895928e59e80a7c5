"""The C structs of packets to messages, a topic each."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from edoras_tools.sinks.mcap_rows import RECORD, Messages, fill_record

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from numpy.typing import NDArray

    from edoras_tools.model import Columns, PacketBatch
    from edoras_tools.structs import Structs
    from edoras_tools.structs.bound import Bound


def struct_messages(
    batch: PacketBatch,
    columns: Columns,
    rows: NDArray[np.intp],
    structs: Structs,
    channel_id: Callable[[Bound], int],
    published: NDArray[np.int64],
) -> Iterator[Messages]:
    """Yield the messages of every struct that a batch holds.

    Args:
        batch: the datagrams.
        columns: of the same rows.
        rows: those whose MsgIds have a struct.
        structs: the structs.
        channel_id: returns the MCAP channel of one.
        published: i64, publish time, ns since 1970.
    """

    def column(name: str) -> NDArray[np.generic]:
        values: NDArray[np.generic] = getattr(columns, name)
        return values

    for bound, members, encoded in structs.messages(rows, column, batch.data):
        width, length = encoded.width, encoded.size
        heads = np.empty(len(members), dtype=[*RECORD, ("message", f"V{width}")])
        if width:  # messages of one length are a part of their heads, and moved with them
            heads["message"] = encoded.data.view(f"V{width}")
            length = np.zeros_like(length)
        sequence, time_ns = columns.sequence_count[members], batch.time_ns[members]
        fill_record(heads, channel_id(bound), length, sequence, time_ns, published[members])
        yield Messages(members, heads.itemsize, heads.__getitem__, encoded.data, encoded.start, length)

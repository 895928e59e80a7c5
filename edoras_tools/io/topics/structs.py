"""Messages of the C structs in packets, one topic each; events of a dictionary are log messages."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Final

import numpy as np

from edoras_tools.io.topics.rows import RECORD, RECORD_BYTES, Messages, bodies_of, whole_messages
from edoras_tools.structs.payloads import payloads
from edoras_tools.units import SECOND
from edoras_tools.wire.cdr import ENCAPSULATION

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from numpy.typing import NDArray

    from edoras_tools.model import Columns, PacketBatch
    from edoras_tools.ros import TypeStore
    from edoras_tools.structs import Structs
    from edoras_tools.structs.bound import Held
    from edoras_tools.wire.arrays.order import Integers


_FEW: Final = 1024
"""Messages of a struct in a batch below which they are joined with others: one call for all is faster."""


def struct_messages(
    batch: PacketBatch,
    columns: Columns,
    structs: Structs,
    channel_ids: Mapping[str, int],
    published: Integers,
) -> Iterator[Messages]:
    """Yield the messages of every struct in a batch.

    Args:
        published: i64, publish time, ns since 1970.
    """

    def column(name: str) -> NDArray[np.generic]:
        return getattr(columns, name)

    samples = payloads(structs, column, partial(getattr, batch), batch.data)
    some: list[Held] = []
    for payload in structs.payloads_of(samples, column, batch.data):
        if len(payload.rows) < _FEW and not payload.repeats:
            some.append(payload)
        else:
            yield _messages(payload, batch, columns, channel_ids[payload.bound.topic], published)
    if some:
        yield _joined(some, batch, columns, channel_ids, published)


def _joined(
    some: list[Held], batch: PacketBatch, columns: Columns, ids: Mapping[str, int], published: Integers
) -> Messages:
    """Return the messages of several structs, each of which is at most once in a row."""
    encoded = [payload.encode() for payload in some]
    channels = np.array([ids[payload.bound.topic] for payload in some], np.uint16)
    rows = np.concatenate([payload.rows for payload in some])
    order = np.argsort(rows, kind="stable")
    base = np.cumsum([0, *(len(item.data) for item in encoded)])
    start = np.concatenate([item.start + at for item, at in zip(encoded, base.tolist(), strict=False)])
    size = np.concatenate([item.size for item in encoded])
    channels = np.repeat(channels, [len(payload.rows) for payload in some])
    rest = np.concatenate([item.data for item in encoded]), start[order], size[order]
    rows, heads = rows[order], np.empty(len(rows), RECORD)
    times = batch.time_ns[rows], published[rows]
    return whole_messages(rows, heads, channels[order], columns.sequence_count[rows], *times, rest)


def _messages(
    payload: Held, batch: PacketBatch, columns: Columns, channel_id: int, published: Integers
) -> Messages:
    """Return the messages of one struct."""
    rows = payload.rows
    encoded = None if payload.size else payload.encode()
    # Messages of the same length become part of their heads, and are copied with them.
    width = encoded.width if encoded else payload.size
    heads = np.zeros(len(rows), [*RECORD, ("message", f"V{width}")])
    if encoded is None:
        payload.fill(heads.view(np.uint8).reshape(len(rows), -1)[:, RECORD_BYTES:])
    elif width:
        heads["message"] = encoded.data.view(f"V{width}")
    rest = (encoded.data, encoded.start, encoded.size) if encoded and not width else None
    times = batch.time_ns[rows], published[rows]
    sequence = columns.sequence_count[rows]
    return whole_messages(rows, heads, channel_id, sequence, *times, rest, repeats=payload.repeats)


def log_messages(
    batch: PacketBatch, columns: Columns, structs: Structs, types: TypeStore, channel_id: int
) -> Messages:
    """Return one ``rcl_interfaces/msg/Log`` for every event of a dictionary, stamped with the capture time.

    Args:
        structs: structs with a dictionary.
        types: types that include the Log message.
    """
    table = structs.dictionary
    assert table is not None, "called with one"
    samples = payloads(structs, partial(getattr, columns), partial(getattr, batch), batch.data)
    logs: list[tuple[int, int, bytes]] = []
    for row, at, fields in table.logs(samples, batch.data):
        seconds, rest = divmod(int(batch.time_ns[row]), SECOND)
        log = {"stamp": {"sec": seconds, "nanosec": rest}, **fields}
        logs.append((row, at, types.encode("rcl_interfaces/msg/Log", log)[ENCAPSULATION.size :]))
    logs.sort()
    rows = np.array([row for row, _, _ in logs], np.int64)
    bodies = [body for _, _, body in logs]
    return bodies_of(bodies, batch.time_ns[rows].tolist(), channel_id, rows, repeats=True)

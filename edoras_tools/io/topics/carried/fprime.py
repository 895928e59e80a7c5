"""F Prime's events as log messages, for Foxglove's log panel."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Final

import numpy as np

from edoras_tools.io.topics.rows import Messages, bodies_of
from edoras_tools.structs.payloads import payloads
from edoras_tools.wire.arrays.order import by_value
from edoras_tools.wire.cdr import ENCAPSULATION

if TYPE_CHECKING:
    from edoras_tools.model import Columns, PacketBatch
    from edoras_tools.ros import TypeStore
    from edoras_tools.structs import Structs

_NS: Final = 1_000_000_000


def log_messages(
    batch: PacketBatch, columns: Columns, structs: Structs, types: TypeStore, channel_id: int
) -> Messages:
    """Return one ``rcl_interfaces/msg/Log`` for every event that a dictionary names.

    ``name`` is the component, ``function`` the event, ``msg`` its text, ``line`` 0, ``file`` empty; the time
    is that of the capture, because F Prime's clock may have any epoch.

    Args:
        structs: has a dictionary.
        types: has the type.
    """
    table = structs.dictionary
    assert table is not None, "called with one"
    found = payloads(structs, partial(getattr, columns), partial(getattr, batch), batch.data)
    whole = table.whole(found)
    told: list[tuple[int, int, bytes]] = []
    for key, members in by_value(whole.key):
        bound = table[key]
        if bound.entry.severity is None:
            continue
        component, _, name = bound.entry.name.rpartition(".")
        events = whole.take(members)
        for row, at, size in zip(
            events.row.tolist(), events.offset.tolist(), events.length.tolist(), strict=True
        ):
            values = structs.types.decode(bound.type, bound.message(batch.data[at : at + size].tobytes()))
            seconds, rest = divmod(int(batch.time_ns[row]), _NS)
            log = {
                "stamp": {"sec": seconds, "nanosec": rest},
                "level": bound.entry.severity.level,
                "name": component,
                "msg": bound.text_of(values),
                "file": "",
                "function": name,
                "line": 0,
            }
            told.append((row, at, types.encode("rcl_interfaces/msg/Log", log)[ENCAPSULATION.size :]))
    told.sort()
    rows = np.array([row for row, _, _ in told], np.int64)
    messages = bodies_of([body for _, _, body in told], batch.time_ns[rows].tolist(), channel_id)
    return replace(messages, rows=rows, repeats=True)

"""Messages of one topic in columns: the input of tables."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Mapping

    import numpy as np
    from numpy.typing import NDArray

    from edoras_tools.ros.cdr.columns import MessageColumns


@dataclass(frozen=True, slots=True)
class TopicBlock:
    """Messages of one topic, one row each.

    Attributes:
        topic: with its leading slash.
        time_ns: i64, capture or recording time, ns since 1970.
        message: the fields.
        publish_ns: i64, publish time in the packet; None if the input has none.
        sequence: packet sequence counts; None if there are none.
        present: the rows that have a field, by field; a field that is not listed is in all rows.
    """

    topic: str
    time_ns: NDArray[np.int64]
    message: MessageColumns
    publish_ns: NDArray[np.int64] | None = None
    sequence: NDArray[np.unsignedinteger] | None = None
    present: Mapping[str, NDArray[np.bool_]] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.time_ns)

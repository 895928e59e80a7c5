"""Topics of which only the last message counts, whenever a reader begins: it is repeated in each new file."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from edoras_tools.io.topics.rows import RECORD, RECORD_BYTES, Messages, fill_record

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from edoras_tools.mission import Mission
    from edoras_tools.model import Columns

LATCHED_NAMES: Final = ("tf_static", "robot_description")
"""Last parts of names of topics that ROS latches; others are by ``durability: transient_local``."""


class LatchedTopics:
    """The last message of each latched topic.

    Attributes:
        routes: their indices in ``Mission.routes``.
    """

    def __init__(self, mission: Mission) -> None:
        self.routes = [
            index
            for index, route in enumerate(mission.routes)
            if route.handling.transient_local or route.topic.rpartition("/")[2] in LATCHED_NAMES
        ]
        self._last: dict[int, tuple[bytes, int, int]] = {}

    def keep(self, columns: Columns, messages: Messages) -> None:
        """Keep the last messages of a batch."""
        routes = columns.route[messages.rows]
        for route in self.routes:
            for at in np.flatnonzero(routes == route)[-1:].tolist():
                start = int(messages.offset[at])
                head = messages.heads(slice(at, at + 1))[0]
                data = messages.data[start : start + int(messages.length[at])].tobytes()
                self._last[route] = data, int(head["sequence"]), int(head["publish_time"])

    def again(self, channel_ids: NDArray[np.uint16], time_ns: int) -> Messages:
        """Return the last message of each, as logged at a time; all belong to row 0.

        Args:
            channel_ids: MCAP channel of each of ``Mission.routes``.
            time_ns: since 1970.
        """
        kept = list(self._last.values())
        length = np.array([len(data) for data, _, _ in kept], np.int64)
        heads = np.empty(len(kept), np.dtype(RECORD))
        channels = channel_ids[list(self._last)] if kept else np.zeros(0, np.uint16)
        sequence, published = (np.array([item[at] for item in kept], np.int64) for at in (1, 2))
        log_time = np.full(len(kept), time_ns, np.int64)
        fill_record(heads, channels, length, sequence, log_time, published)
        pool = np.frombuffer(b"".join(data for data, _, _ in kept), np.uint8)
        rows, offset = np.zeros(len(kept), np.int64), np.cumsum(length) - length
        return Messages(
            rows, channels, log_time, RECORD_BYTES, heads.__getitem__, pool, offset, length, repeats=True
        )

"""``/tf``: the poses of the mission as coordinate frames, so that a 3D view can follow one."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from edoras_tools.io.topics.rows import RECORD, Messages, whole_messages
from edoras_tools.ros.types.schema import full_name

if TYPE_CHECKING:
    from collections.abc import Iterator

    from edoras_tools.mission import Mission
    from edoras_tools.model import Columns, PacketBatch
    from edoras_tools.ros import TypeStore

TF_TOPIC: Final = "/tf"
TF_TYPE: Final = "tf2_msgs/msg/TFMessage"
_POSES: Final = {
    "geometry_msgs/msg/PoseStamped": "pose",
    "geometry_msgs/msg/PoseWithCovarianceStamped": "pose.pose",
    "nav_msgs/msg/Odometry": "pose.pose",
}
"""Types with a pose in the frame of their header, and the field that has it."""
_VALUES: Final = (*(f"position.{axis}" for axis in "xyz"), *(f"orientation.{axis}" for axis in "xyzw"))
_WORD: Final = 4
_BEFORE_NAMES: Final = 16
"""Bytes of the CDR before the characters of the first frame name."""
_DOUBLE: Final = 8


class Transforms:
    """Makes a transform from each message with a pose: from its header's frame to one named like its topic.

    Args:
        mission: mission whose routes with poses are used; none if ``/tf`` is a route itself.

    Attributes:
        frames: frame name of each such route, by the route's index: its topic without the leading ``/``.
    """

    def __init__(self, mission: Mission, types: TypeStore) -> None:
        self._types, self._mission = types, mission
        routes = mission.routes
        has_tf = any(route.topic == TF_TOPIC for route in routes)
        self.frames = {
            place: route.topic.strip("/")
            for place, route in enumerate(routes)
            if full_name(route.type) in _POSES and not has_tf
        }

    def are_in(self, columns: Columns) -> bool:
        """Return whether any row may have a pose."""
        return bool(self.frames) and bool(np.isin(columns.route, list(self.frames)).any())

    def messages(self, batch: PacketBatch, columns: Columns, channel_id: int) -> Iterator[Messages]:
        """Yield the transforms of a batch, for each route and frame; poses without a frame are left out."""
        for place, child in self.frames.items():
            rows = np.flatnonzero((columns.route == place) & (columns.cdr_length > 0))
            if not len(rows):
                continue
            type_name = full_name(self._mission.routes[place].type)
            offset, length = columns.cdr_offset[rows], columns.cdr_length[rows]
            read = self._types.columns(type_name, batch.data, offset, length)
            names = np.asarray(read.fields["header.frame_id"])
            for frame in sorted({*names[read.valid].tolist()} - {"", child}):
                these = np.flatnonzero(read.valid & (names == frame))
                heads = np.zeros(len(these), _record(frame.encode(), child.encode()))
                heads["count"] = 1
                for name in ("sec", "nanosec"):
                    heads[name] = np.asarray(read.fields[f"header.stamp.{name}"])[these]
                for name, text in (("frame", frame.encode()), ("child", child.encode())):
                    heads[f"{name}_length"], heads[name] = len(text) + 1, text
                for index, name in enumerate(_VALUES):
                    field = f"{_POSES[type_name]}.{name}"
                    heads["values"][:, index] = np.asarray(read.fields[field])[these]
                own = rows[these]
                sequence, log_time = columns.sequence_count[own], batch.time_ns[own]
                yield whole_messages(own, heads, channel_id, sequence, log_time, log_time)


def _record(frame: bytes, child: bytes) -> np.dtype[np.void]:
    """Return the record of a transform between two frames: CDR names end with NUL and are padded."""
    first = _up(len(frame) + 1, _WORD)
    second_at = _BEFORE_NAMES + first + _WORD
    second = _up(second_at + len(child) + 1, _DOUBLE) - second_at
    return np.dtype(
        [
            *RECORD,
            ("encapsulation", "<u4"),
            ("count", "<u4"),
            ("sec", "<i4"),
            ("nanosec", "<u4"),
            ("frame_length", "<u4"),
            ("frame", f"S{first}"),
            ("child_length", "<u4"),
            ("child", f"S{second}"),
            ("values", "<f8", (len(_VALUES),)),
        ]
    )


def _up(size: int, to: int) -> int:
    return -(-size // to) * to

"""Finds the ROS types that messages of unknown type may have."""

from __future__ import annotations

from contextlib import suppress
from typing import TYPE_CHECKING, Final

import numpy as np

from edoras_tools.errors import EdorasError
from edoras_tools.ros.cdr.plan import ROUNDING

if TYPE_CHECKING:
    from collections.abc import Collection, Sequence

    from edoras_tools.ros.store import TypeStore

PACKAGES: Final = ("geometry_msgs", "sensor_msgs", "std_msgs", "nav_msgs", "builtin_interfaces")
"""Packages whose types are tried, besides the types that the caller names."""
USUAL: Final = (
    "geometry_msgs/msg/Pose",
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/Twist",
    "sensor_msgs/msg/JointState",
)
"""Types that the EDORAS demos send: more likely than another type of the same shape."""


def types_that_fit(types: TypeStore, samples: Collection[bytes], own: Collection[str] = ()) -> list[str]:
    """Return the types whose last field ends every sample, or leaves at most their ``excess`` after it.

    Args:
        types: the type store.
        samples: CDR of the messages, encapsulation included.
        own: types to try besides those of ``PACKAGES``; they come first in the result, then ``USUAL``.
    """
    return types_that_fit_each(types, [samples], own)[0]


def types_that_fit_each(
    types: TypeStore, groups: Sequence[Collection[bytes]], own: Collection[str] = ()
) -> list[list[str]]:
    """Return the result of ``types_that_fit`` for each group of samples; no types for an empty group."""
    some = [group for group in groups if group]
    if not some:
        return [[] for _ in groups]
    cdrs = [cdr for group in some for cdr in group]
    length = np.array([len(cdr) for cdr in cdrs], np.int32)
    offset = np.cumsum(length, dtype=np.int64) - length
    data, begins = np.frombuffer(b"".join(cdrs), np.uint8), np.cumsum([0, *map(len, some[:-1])])
    names = {name for name in types.types() if name.startswith(tuple(f"{item}/msg/" for item in PACKAGES))}
    fits: list[list[str]] = [[] for _ in some]
    for name in sorted({*names, *own}, key=lambda name: (name not in own, name not in USUAL, name)):
        with suppress(EdorasError):
            size, most = types.fixed_size(name), types.most_trailing(name) - ROUNDING
            if size and not np.logical_and.reduceat((size <= length) & (length <= size + most), begins).any():
                continue  # the case of most types: each group has a message of another size
            behind = types.trailing(name, data, offset, length)
            ends = (behind >= 0) & (behind <= most)
            for place in np.flatnonzero(np.logical_and.reduceat(ends, begins)).tolist():
                fits[place].append(name)
    lists = iter(fits)
    return [next(lists) if group else [] for group in groups]

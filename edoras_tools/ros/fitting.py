"""Which ROS types some messages of unknown type could be."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from edoras_tools.errors import EdorasError
from edoras_tools.ros.cdr.plan import ROUNDING

if TYPE_CHECKING:
    from collections.abc import Collection, Sequence

    from edoras_tools.ros.store import TypeStore

PACKAGES: Final = ("geometry_msgs", "sensor_msgs", "std_msgs", "nav_msgs", "builtin_interfaces")
"""Where types are looked for, besides those that are named."""
USUAL: Final = (
    "geometry_msgs/msg/Pose",
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/Twist",
    "sensor_msgs/msg/JointState",
)
"""What the EDORAS demos send: likelier than another type of the same shape."""


def types_that_fit(types: TypeStore, samples: Sequence[bytes], own: Collection[str] = ()) -> list[str]:
    """Return the types that end at the last byte of all samples, or where a writer might leave bytes behind.

    Args:
        samples: CDR, encapsulation included.
        own: types to try besides those of ``PACKAGES``; they come first, then the usual ones.
    """
    if not samples:
        return []
    names = [name for name in types.types() if name.startswith(tuple(f"{item}/msg/" for item in PACKAGES))]
    found = []
    for name in {*names, *own}:
        try:
            if all(_ends(types, name, cdr) for cdr in samples):
                found.append(name)
        except EdorasError:
            continue
    return sorted(found, key=lambda name: (name not in own, name not in USUAL, name))


def _ends(types: TypeStore, name: str, cdr: bytes) -> bool:
    """Tell whether a message of a type ends with these bytes.

    Raises:
        EdorasError: they are none of its messages.
    """
    types.decode(name, cdr)
    return len(cdr) - types.extent(name, cdr) <= types.most_trailing(name) - ROUNDING

"""ROS 2 messages: types, conversion between CDR and values one by one, and CDR to columns in bulk."""

from typing import TYPE_CHECKING

from edoras_tools.doors import later

if TYPE_CHECKING:
    from edoras_tools.ros.cdr.bulk import MessageColumns, Ragged
    from edoras_tools.ros.cdr.values import ValueSpan
    from edoras_tools.ros.store import TypeStore

__all__ = ["MessageColumns", "Ragged", "TypeStore", "ValueSpan"]

__getattr__ = later(
    __name__, **{"cdr.bulk": "MessageColumns Ragged", "cdr.values": "ValueSpan"}, store="TypeStore"
)

"""ROS 2 messages: types, conversion between CDR and values one by one, and CDR to columns in bulk."""

from edoras_tools.ros.cdr.columns import MessageColumns, Ragged
from edoras_tools.ros.cdr.reader import ValueSpan
from edoras_tools.ros.store import TypeStore

__all__ = ["MessageColumns", "Ragged", "TypeStore", "ValueSpan"]

"""ROS 2 messages: their types, CDR to plain values and back one by one, and CDR to columns in bulk."""

from edoras_tools.ros.columns import MessageColumns, Ragged
from edoras_tools.ros.reader import Span
from edoras_tools.ros.store import TypeStore

__all__ = ["MessageColumns", "Ragged", "Span", "TypeStore"]

"""Reads EDORAS bridge YAML into a frozen mission: which topic, type, MsgId and link belong together.

``tree`` reads YAML with rcl's rules for numbers and words. ``parameters`` reads a ROS 2 parameter file into
dotted names. ``bridges`` makes a link and its routes from one node, with the keys that only edoras-tools
knows. ``loading`` joins several files, and reads the groups for transfer frames, spacecraft and cFS. Every
mistake of every file is reported at once, each with its file, line and key.
"""

from typing import TYPE_CHECKING

from edoras_tools.doors import later
from edoras_tools.mission.model import (
    Bridge,
    FlightLink,
    FlightSoftware,
    FramedPort,
    GroundLink,
    Handling,
    Mission,
    RecordedTopic,
    Route,
    StoredTopic,
    TransferLink,
)
from edoras_tools.mission.tree import read_scalar

if TYPE_CHECKING:
    from edoras_tools.mission.loading import load, loads

__all__ = [
    "Bridge",
    "FlightLink",
    "FlightSoftware",
    "FramedPort",
    "GroundLink",
    "Handling",
    "Mission",
    "RecordedTopic",
    "Route",
    "StoredTopic",
    "TransferLink",
    "load",
    "loads",
    "read_scalar",
]

__getattr__ = later(__name__, loading="load loads")

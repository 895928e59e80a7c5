"""EDORAS bridge YAML to a frozen mission: which topic, type, MsgId and link belong together.

``scalars`` holds rcl's rules for numbers and words, ``parameters`` reads a ROS 2 parameter file into dotted
names, ``bridges`` makes a link and its routes of one node, ``loading`` puts files together. Every mistake of
every file is reported at once, each with its file, line and key.
"""

from edoras_tools.mission.loading import load, loads
from edoras_tools.mission.model import FlightLink, GroundLink, Mission, Route
from edoras_tools.mission.scalars import read_scalar

__all__ = ["FlightLink", "GroundLink", "Mission", "Route", "load", "loads", "read_scalar"]

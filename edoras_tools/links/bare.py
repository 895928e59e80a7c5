"""The links whose datagrams have no header of their own: Command Ingest, Telemetry Output, the robots.

Ground and cFS exchange bare space packets (CI_LAB reads them, TO_LAB sends them), one a datagram. The public
flight apps and their robots exchange bare doubles over UDP, which the paper calls serial, in the sender's
native byte order: little-endian in practice.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar, Final

from edoras_tools.cfs.command_ingest import CI_BUFFER
from edoras_tools.cfs.edoras_app import BRIDGE_BUFFER
from edoras_tools.links import CFS_PORT, PORTS, ROBOT_PORT
from edoras_tools.links.protocol import CERTAIN, Form, LinkProtocol, LinkSending, Seen
from edoras_tools.model import Finding, Transport
from edoras_tools.wire.layout import Field, Layout

if TYPE_CHECKING:
    from edoras_tools.links.doors import Site


class CommandIngestLink(LinkProtocol):
    """The link to CI_LAB.

    Its ports are 1234 + (CPU number - 1), so the port of cpu2 is also the one that TO_LAB sends to. The
    addresses of the mission decide between the two; without them, the packet's type bit does.
    """

    code = 1
    name = "CI"
    label = "ci"
    colour = "cyan"
    doc = "ground to cFS, one space packet a datagram (Command Ingest)"
    transport = Transport(ports=PORTS["ci"])
    to_cfs = True
    packets = True
    bridge = "ground"
    bridge_ports = ("fsw_port",)
    receive_buffer = CI_BUFFER
    over_receive_buffer = Finding.OVER_CI_BUFFER


CI: Final = CommandIngestLink()


class TelemetryOutputLink(LinkProtocol):
    """The link from TO_LAB, which sends to one address at a time once it is enabled."""

    code = 2
    name = "TO"
    label = "to"
    colour = "green"
    doc = "cFS to ground, one space packet a datagram (Telemetry Output)"
    transport = Transport(ports=PORTS["to"], first="server")
    from_cfs = True
    packets = True
    bridge = "ground"
    bridge_ports = ("bridge_port",)
    receive_buffer = BRIDGE_BUFFER
    over_receive_buffer = Finding.OVER_BRIDGE_BUFFER


TO: Final = TelemetryOutputLink()


def _doubles(name: str, letters: str, doc: str) -> list[Field]:
    return [Field(f"{name}_{letter}", 64, doc, kind="float") for letter in letters]


_PLACE: Final = (
    *_doubles("position", "xyz", "m; an arm's joints 1 to 3, rad"),
    *_doubles("orientation", "xyzw", "quaternion; an arm's joints 4 to 7, rad"),
)
ROBOT_COMMAND: Final = Layout(
    "robot_command",
    "Robot command",
    *_doubles("linear", "xyz", "velocity, m/s"),
    *_doubles("angular", "xyz", "velocity, rad/s"),
    byte_order="little",
)
ROBOT_POSE: Final = Layout("robot_pose", "Robot pose", *_PLACE, byte_order="little")
ROBOT_STATE: Final = Layout(
    "robot_state",
    "Robot state",
    *_PLACE,
    Field("stamp_seconds", 32, "the robot's time", kind="int"),
    Field("stamp_nanoseconds", 32, "the robot's time: beyond its seconds"),
    byte_order="little",
)
SENT_TO: Final = {ROBOT_COMMAND: ROBOT_PORT, ROBOT_POSE: ROBOT_PORT, ROBOT_STATE: CFS_PORT}
"""Destination port of each message; a message is recognised by its length."""


class RobotLink(LinkProtocol):
    """The link of the public flight apps to the robot.

    Other programs use port 8080 too, so the lengths of its messages and likely doubles identify it.
    """

    code = 4
    name = "ROBOT"
    label = "robot"
    colour = "yellow"
    doc = "between a flight app and its robot, bare doubles over UDP"
    transport = Transport(ports=PORTS["robot"], first="either")
    to_cfs = True
    from_cfs = True
    last_hop = True
    sends = True
    layouts = tuple(SENT_TO)
    forms: ClassVar = {
        layout.size: Form((layout,), port, doubles=sum(slot.field.kind == "float" for slot in layout.slots))
        for layout, port in SENT_TO.items()
    }

    def send(self, site: Site, *, up: bool) -> LinkSending:
        """Return a sender of commands to the robot, or of its states to the flight app."""
        port = CFS_PORT if up else ROBOT_PORT
        layouts = [layout for layout, to in SENT_TO.items() if to == port]
        return self.part("protocol:FormSending")(self, port, layouts)

    def recognise(self, facts: Seen) -> Any:
        """Return the confidence: certain if a struct of that length is bound to that port."""
        return super().recognise(facts) + CERTAIN * facts.bound


ROBOT: Final = RobotLink()

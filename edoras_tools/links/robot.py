"""The robot link: between a flight app and its robot over UDP, bare doubles without a header.

The paper calls it serial.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar, Final

from edoras_tools.links.protocol import CERTAIN, Form, LinkProtocol, Seen
from edoras_tools.model import Transport
from edoras_tools.wire.robot import CFS_PORT, ROBOT_PORT, SENT_TO

if TYPE_CHECKING:
    from edoras_tools.links.doors import Site
    from edoras_tools.links.sending import LinkSending


class RobotLink(LinkProtocol):
    """The link of the public flight apps to the robot.

    Other programs use port 8080 too, so the lengths of its messages and likely doubles identify it.
    """

    code = 4
    name = "ROBOT"
    label = "robot"
    colour = "yellow"
    doc = "between a flight app and its robot, bare doubles over UDP"
    transport = Transport(ports=(CFS_PORT, ROBOT_PORT), first="either")
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
        return self.part("sending:FormSending")(self, port, layouts)

    def recognise(self, facts: Seen) -> Any:
        """Return the confidence: certain if a struct of that length is bound to that port."""
        return super().recognise(facts) + CERTAIN * facts.bound


ROBOT: Final = RobotLink()

"""An example of a link: a radio modem that puts a header of its own in front of each space packet.

The modem is made up. It sends to UDP port 5600 in both directions, and its header begins with a constant that
tells its datagrams from whatever else goes to that port. What needs state stands in ``edoras_radio_state``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar, Final

from edoras_tools.links.protocol import LinkProtocol
from edoras_tools.model import Transport
from edoras_tools.wire.layout import Field, Layout

if TYPE_CHECKING:
    from edoras_tools.links.doors import LinkEvidence, OwnTopics, Site, TopicSpace
    from edoras_tools.links.protocol import LinkSending

MAGIC: Final = 0xED0A
PORT: Final = 5600

HEADER: Final = Layout(
    "radio",
    "Radio modem",
    Field("magic", 16, "always 0xED0A", base=16),
    Field("station", 8, "the ground station that heard it"),
    Field("signal_dbm", 8, "strength of the signal", kind="int"),
    Field("frame_count", 16, "frames since the modem was started"),
)


class RadioLink(LinkProtocol):
    """Between a ground station's modem and cFS, one space packet a datagram."""

    code = 64
    name = "RADIO"
    label = "radio"
    colour = "bright_red"
    doc = "between a ground station's modem and cFS"
    transport = Transport(ports=(PORT,), first="either")
    to_cfs = True
    from_cfs = True
    packets = True
    layouts = (HEADER,)
    header_bytes = HEADER.size
    constants: ClassVar = {"magic": MAGIC}
    sends = True

    def topics(self, space: TopicSpace) -> OwnTopics:
        """Return what makes messages of the signal's strength."""
        topics: OwnTopics = self.part("edoras_radio_state:SignalTopics")(space)
        return topics

    def evidence(self, site: Site) -> LinkEvidence:
        """Return what follows the frame counts."""
        del site
        frames: LinkEvidence = self.part("edoras_radio_state:RadioFrames")()
        return frames

    follow = evidence

    def send(self, site: Site, *, up: bool) -> LinkSending:
        """Return how its frames are sent again."""
        del site
        sending: LinkSending = self.part("edoras_radio_state:RadioSending")(self, up=up)
        return sending


RADIO: Final = RadioLink()

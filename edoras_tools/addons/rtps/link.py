"""DDS over UDP: RTPS, one message of several submessages a datagram, on any port."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any, Final

from edoras_tools.links.protocol import BY_CONTENT, BatchRows, LinkProtocol, LinkSending, Located, Seen
from edoras_tools.model import Decoded, PacketBatch, Transport

if TYPE_CHECKING:
    from edoras_tools.links.doors import (
        Follower,
        LinkEvidence,
        OwnRows,
        OwnTopics,
        Reading,
        SampleReader,
        Site,
        TopicSpace,
    )
    from edoras_tools.wire.arrays import Integers, Places
    from edoras_tools.wire.layout import Layout

RTPS_MAGIC: Final = b"RTPS"
"""First bytes of every message."""


class PublishSubscribeLink(LinkProtocol):
    """The link between DDS participants; its first bytes identify it, because any port is possible."""

    code = 8
    name = "RTPS"
    label = "rtps"
    colour = "yellow"
    doc = "between DDS participants, as ROS 2 nodes are: RTPS messages, on any port"
    transport = Transport(first="either")
    to_cfs = True
    from_cfs = True
    port_decides = False
    magic = RTPS_MAGIC
    several = True
    samples = True
    sends = True
    wireshark = "rtps"

    @property
    def layouts(self) -> tuple[Layout, ...]:  # type: ignore[override]
        """Its headers, for each submessage in both byte orders; made at the first use."""
        from edoras_tools.addons.rtps.wire import EVERY_RTPS_LAYOUT

        return EVERY_RTPS_LAYOUT

    def recognise(self, facts: Seen) -> Any:
        """Recognise the four letters at the start of every message."""
        from edoras_tools.addons.rtps.wire import RTPS_HEADER

        version = facts.field(RTPS_HEADER, "version_major")
        letters = facts.field(RTPS_HEADER, "magic") == int.from_bytes(RTPS_MAGIC, "big")
        return BY_CONTENT * (letters & (version >= 0))

    def locate(self, batch: PacketBatch, rows: Places, site: Site) -> Located:
        """Judge messages, and learn the announced endpoints; see :meth:`LinkProtocol.locate`."""
        return self.part("reader:locate_samples")(batch, rows, site)

    def dissect(self, reading: Reading, site: Site) -> None:
        """Read one message."""
        self.part("reader:dissect_message")(reading, site)

    def places(self, layout: Layout, rows: BatchRows, field: str = "") -> tuple[Places, Integers]:
        """Find the message header, or every submessage of one kind and byte order."""
        return self.part("reader:submessage_places")(layout, rows, self)

    def rows(self, site: Site) -> OwnRows:
        """Return the object that reassembles samples from fragments."""
        return self.part("samples:SampleRows")(site)

    def topics(self, space: TopicSpace) -> OwnTopics | None:
        """Return the object that makes messages of samples; None if nothing decodes topics' announcements."""
        heard = space.endpoints
        return None if heard is None else self.part("samples:SampleMessages")(space, heard)

    def follow(self, site: Site) -> Follower:
        """Return a follower of the samples of every writer."""
        return self.part("writers:SampleFollower")(site.endpoints)

    def evidence(self, site: Site) -> LinkEvidence:
        """Return a follower of the samples as rows of the ledger."""
        return self.part("rules:SampleEvidence")(site.endpoints)

    def fields(self) -> Iterable[Any]:
        """Return the filter fields for the subjects of submessages."""
        return self.part("samples:sample_fields")()

    def send(self, site: Site, *, up: bool) -> LinkSending | None:
        """Return the way in which samples go to subscribers; there is no up direction."""
        return None if up else self.part("sending:SampleSending")(self, site)

    def sample_reader(self) -> SampleReader:
        """Return the reader of samples."""
        return self.part("samples:READER")

    def summary(self, decoded: Decoded) -> str:
        """Return the kinds of the submessages, with their topics."""
        return self.part("reader:rtps_summary")(decoded)

    def kind_name(self, decoded: Decoded) -> str:
        """Return the kinds of the submessages, each once, with their topics."""
        return self.part("reader:rtps_kind")(decoded)


RTPS: Final = PublishSubscribeLink()

"""DDS over UDP: RTPS, one message of several submessages a datagram, on any port."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

from edoras_tools.links.protocol import BY_CONTENT, BatchRows, Endpoints, LinkProtocol, Located, Seen, Site
from edoras_tools.model import Decoded, PacketBatch, Transport
from edoras_tools.wire.rtps import RTPS_MAGIC

if TYPE_CHECKING:
    from collections.abc import Callable

    import numpy as np
    from numpy.typing import NDArray

    from edoras_tools.links.reading import Reading
    from edoras_tools.wire.layout import Layout


class PublishSubscribeLink(LinkProtocol):
    """The link between DDS participants, which is told by its first bytes: their ports are any."""

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
    wireshark = "rtps"

    @property
    def layouts(self) -> tuple[Layout, ...]:  # type: ignore[override]
        """Its headers, of each submessage in both byte orders; made when they are asked for."""
        from edoras_tools.wire.rtps.headers import EVERY_RTPS_LAYOUT

        return EVERY_RTPS_LAYOUT

    def recognise(self, facts: Seen) -> Any:
        """Recognise the four letters that begin every message."""
        from edoras_tools.wire.rtps.headers import RTPS_HEADER

        version = facts.field(RTPS_HEADER, "version_major")
        letters = facts.field(RTPS_HEADER, "magic") == int.from_bytes(RTPS_MAGIC, "big")
        return BY_CONTENT * (letters & (version >= 0))

    def locate(self, batch: PacketBatch, rows: NDArray[np.intp], site: Site) -> Located:
        """Judge messages, and learn which endpoints they announce; see :meth:`LinkProtocol.locate`."""
        from edoras_tools.links.rtps import reader

        return reader.locate_samples(batch, rows, site)

    def dissect(self, reading: Reading, site: Site) -> None:
        """Read one message."""
        from edoras_tools.links.rtps import reader

        reader.dissect_message(reading, site)

    def places(
        self, layout: Layout, rows: BatchRows, field: str = ""
    ) -> tuple[NDArray[np.intp], NDArray[np.int64]]:
        """Find the message header, or every submessage of one kind and byte order."""
        from edoras_tools.links.rtps import reader

        del field
        return reader.submessage_places(layout, rows, self)

    def rows_on(
        self, batch: PacketBatch, rows: NDArray[np.intp], endpoints: Endpoints, holds: Callable[[str], bool]
    ) -> NDArray[np.intp]:
        """Return those of some rows that have a sample of a topic; see :func:`reader.rows_on`."""
        from edoras_tools.links.rtps import reader

        return reader.rows_on(batch, rows, endpoints, holds)

    def summary(self, decoded: Decoded) -> str:
        """Return what the submessages are, and of which topics."""
        from edoras_tools.links.rtps import reader

        return reader.rtps_summary(decoded)


RTPS: Final = PublishSubscribeLink()

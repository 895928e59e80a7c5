"""F Prime: the link between flight software and its ground system (GDS), one frame a datagram."""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from edoras_tools.addons.fprime import wire as fprime
from edoras_tools.links.framing import Framing, prefixed
from edoras_tools.links.protocol import BY_CONTENT, BatchRows, LinkProtocol, Located, Seen
from edoras_tools.model import Decoded, Finding, LayerField, Link, PacketBatch, Transport

if TYPE_CHECKING:
    from collections.abc import Mapping

    from edoras_tools.links.doors import LinkEvidence
    from edoras_tools.links.reading import Reading
    from edoras_tools.links.sending import LinkSending
    from edoras_tools.links.site import Site
    from edoras_tools.wire.arrays.order import Integers, Mask, Octets, Places
    from edoras_tools.wire.layout import Layout

_VERDICTS: Final = {
    "truncated": Finding.TRUNCATED,
    "longer": Finding.LENGTH_MISMATCH,
    "corrupt": Finding.CHECKSUM_BAD,
}


class GroundDataFraming(Framing):
    """Frames that follow each other in a TCP stream, and the keep-alive texts between them."""

    head = fprime.STREAM_HEAD
    checked = True

    def __init__(self, tm_bytes: int = fprime.TM_FRAME_BYTES) -> None:
        self.tm_bytes = tm_bytes

    def lengths(self, data: Octets, at: Integers, end: Integers | int) -> Integers:
        """Return the size of the frame that starts at each position, bytes."""
        starts, size = fprime.frame_lengths(data, at, self.tm_bytes)
        return prefixed(starts, size, end - at, self.head, self.largest)

    def likely(self, data: Octets, at: Integers, end: Integers | int) -> Mask:
        """Return at which positions a complete frame with a correct check starts."""
        size = self.lengths(data, at, end)
        likely = (size > 0) & (at + size <= end)
        rows = np.flatnonzero(likely & (size != len(fprime.KEEP_ALIVE)))
        frames = fprime.read_ground_frames(data, at[rows], size[rows].astype(np.int32))
        likely[rows] = ~frames.corrupt & ~frames.cut
        return likely


class GroundDataLink(LinkProtocol):
    """The link between F Prime and its ground system: its own frames, or TC and TM frames of CCSDS.

    If a mission has space packets in transfer frames, these are taken out one by one.
    """

    code = 7
    name = "FPRIME"
    label = "fprime"
    colour = "magenta"
    doc = "between F Prime and its ground data system (GDS), one frame a datagram"
    transport = Transport("either", (50000, 50001), first="either")
    framing = GroundDataFraming()
    to_cfs = True
    from_cfs = True
    layouts = fprime.LINK_LAYOUTS
    port_decides = False
    sends = True
    dictionary = True
    several = True

    def send(self, site: Site, *, up: bool) -> LinkSending:
        """Return the way in which its frames go to the ground system, or to flight software."""
        return self.part("sending:GroundDataSending")(self, self.framing, up=up)

    def recognise(self, facts: Seen) -> Any:
        """Recognise a start word, or the header of a TC or TM frame that fits the datagram."""
        own, space, command, telemetry = fprime.frame_shapes_of(facts.field, facts.length)
        return BY_CONTENT * (own | space | command | telemetry)

    def locate(self, batch: PacketBatch, rows: Places, site: Site) -> Located:
        """Judge frames; see :meth:`LinkProtocol.locate`."""
        located = Located(len(rows))
        frames = fprime.read_ground_frames(batch.data, batch.offset[rows], batch.length[rows])
        for name, finding in _VERDICTS.items():
            located.flag(finding, getattr(frames, name))
        return located

    def dissect(self, reading: Reading, site: Site) -> None:
        """Read one frame, and the packets in it."""
        data = reading.data
        frames = fprime.read_ground_frames(
            np.frombuffer(data, np.uint8), np.array([0]), np.array([len(data)])
        )
        framing, check = fprime.FRAME_SHAPES[frames.shape[0]], int(frames.check[0])
        if framing.check:
            reading.read(framing.header, 0)
        if frames.cut[0]:
            reading.truncated(framing.header.name, 0, check + framing.check_bytes)
        for name, finding in _VERDICTS.items():
            reading.findings |= finding if getattr(frames, name)[0] else Finding(0)
        if framing.check:
            end = check + framing.check_bytes
            number = int.from_bytes(data[check:end], "big")
            text = framing.check.text(number) + (", which is wrong" if frames.corrupt[0] else "")
            reading.extend(LayerField(framing.check.name, number, check, end, text, framing.check.doc))
        for index in range(len(frames.packets.row)):
            _packet(reading, frames.packets, index)

    def places(self, layout: Layout, rows: BatchRows, field: str = "") -> tuple[Places, Integers]:
        """Find the frame, the first packet of each datagram, or the first header of one kind."""
        owner = np.flatnonzero(rows.column("link") == self)
        offset, length = rows.datagram("offset")[owner], rows.datagram("length")[owner]
        frames = fprime.read_ground_frames(rows.batch.data, offset, length)
        kinds = [item.header for item in fprime.FRAME_SHAPES]
        if layout in kinds and layout is not fprime.SPACE_PACKET:
            present = (frames.shape == kinds.index(layout)) & (length >= layout.size)
            return owner[present], offset[present]
        packets = frames.packets
        if layout is fprime.SPACE_PACKET:
            members = (packets.space >= 0) & (packets.start - packets.space >= layout.size)
            start = packets.space
        elif layout is fprime.PACKET:
            members, start = packets.kind >= 0, packets.start
        else:
            kind = next(kind for kind, item in fprime.ENTRY_HEADERS.items() if item is layout)
            members, start = (packets.kind == kind) & packets.whole, packets.start + fprime.PACKET.size
        row, first = np.unique(packets.row[members], return_index=True)
        return owner[row], start[members][first]

    def framing_of(self, carried: Link, form: Any) -> Framing | None:
        """Return the framing of TM frames that carry its packets; its own frames are separate."""
        return GroundDataFraming(form.length) if carried is self and form.kind == "tm" else None

    def engine_values(self) -> Mapping[str, Any]:
        """Return the values for ``engine/fprime.lua``."""
        return {
            "start_word": fprime.START_WORD,
            "keep_alive": fprime.KEEP_ALIVE.decode(),
            "tm_bytes": fprime.TM_FRAME_BYTES,
            "time_bytes": fprime.TIME_BYTES,
            "entry_headers": {int(kind): layout.name for kind, layout in fprime.ENTRY_HEADERS.items()},
        }

    def evidence(self, site: Site) -> LinkEvidence:
        """Return a follower of the sequence counts of space packets."""
        return self.part("counts:GroundCounts")()

    follow = evidence

    def summary(self, decoded: Decoded) -> str:
        """Return the contents of the packets, by number if no dictionary names them."""
        texts: list[str] = []
        ids = [layout.name for layout in fprime.ENTRY_HEADERS.values()]
        for layer, after in pairwise((*decoded.layers, None)):
            assert layer is not None, "only the last one is"
            header = after is not None and after.name in ids
            if layer.name == fprime.VALUES_LAYER or (layer.name == fprime.PACKET.name and not header):
                texts.append(layer.title if layer.name == fprime.VALUES_LAYER else layer.fields[0].text)
            elif layer.name in ids and not (after is not None and after.name == fprime.VALUES_LAYER):
                texts.append(f"{layer.title.removeprefix('F Prime ').lower()} {layer.fields[0].text}")
        return "; ".join(texts) or ("" if decoded.stop else "no packet")


FPRIME: Final = GroundDataLink()


def _packet(reading: Reading, packets: fprime.PacketPlaces, index: int) -> None:
    """Read one packet of a frame: its contents by name, if the reader has a dictionary."""
    _, space, start, end, kind, whole = (column[index].item() for column in packets)
    if 0 <= space <= start - fprime.SPACE_PACKET.size:
        reading.read(fprime.SPACE_PACKET, space)
    if kind >= 0:
        reading.read(fprime.PACKET, start)
    behind = start + fprime.PACKET.size
    if whole and kind in fprime.ENTRY_HEADERS and not reading.described(kind, behind, end):
        reading.read(fprime.ENTRY_HEADERS[fprime.PacketType(kind)], behind)

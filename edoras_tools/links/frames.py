"""CCSDS transfer frames over UDP, one a datagram: what carries the packets of another link.

A mission says which ports carry them. The packets in them are rows of their own, of the link that the mission
names; see :mod:`edoras_tools.io.frames.transfer`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import numpy as np

from edoras_tools.links.protocol import BatchRows, LinkProtocol, Seen, Site
from edoras_tools.model import Datagram, Decoded, LayerField, PacketBatch
from edoras_tools.wire.arrays.crc import CRC16_BYTES, crc16
from edoras_tools.wire.arrays.order import by_value
from edoras_tools.wire.arrays.window import gather
from edoras_tools.wire.transfer_frames import headers
from edoras_tools.wire.transfer_frames.fields import (
    FRAME_LAYOUTS,
    FRAME_VERSIONS,
    NO_FIRST,
    FrameFormat,
)

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from numpy.typing import NDArray

    from edoras_tools.links.reading import Reading
    from edoras_tools.wire.layout import Layout

_TM_FLAGS: Final = headers.TM.by_name["secondary_header_flag"].start
_TOLD: Final = ("virtual_channel_frame_count", "frame_sequence_number")


class TransferFramesLink(LinkProtocol):
    """The layer of frames below a link; its ports are those of the mission, whatever other links claim.

    What is wrong with a frame is judged where its packets are taken out, once.
    """

    code = 6
    name = "FRAMES"
    label = "frames"
    colour = "cyan"
    doc = "CCSDS transfer frames (TM, AOS, TC), which carry the packets of another link"
    to_cfs = True
    from_cfs = True
    layouts = (
        *FRAME_LAYOUTS.values(),
        headers.TM_SECONDARY,
        headers.AOS_PACKETS,
        headers.TC_SEGMENT,
    )
    wireshark = "data"
    port_decides = False

    def recognise(self, seen: Seen) -> Any:
        """Recognise nothing by the datagram alone: a mission has to say what it is."""
        return 0 * seen.length

    def dissect(self, reading: Reading, site: Site) -> None:
        """Read the headers of one frame."""
        form, data = site.frames[reading.datagram.destination.port], reading.data
        for layout, start in _headers(form, bool(form.kind == "tm" and data[_TM_FLAGS] >> 7)):
            reading.read(layout, start)
        if form.fecf:
            start, end = len(data) - CRC16_BYTES, len(data)
            value, right = int.from_bytes(data[start:], "big"), crc16(data[:start])
            text = f"0x{value:04x}" + (f", but the frame has 0x{right:04x}" if value != right else "")
            reading.extend(LayerField("frame_error_control", value, start, end, text, "CRC-16 of the frame"))

    def places(
        self, layout: Layout, rows: BatchRows, field: str = ""
    ) -> tuple[NDArray[np.intp], NDArray[np.int64]]:
        """Find one of the headers; which ones there are depends on the kind of frame."""
        del field
        found = np.full(len(rows.column("link")), NO_FIRST, np.int64)
        owner = np.flatnonzero(rows.column("link") == self)
        for port, picked in by_value(rows.datagram("destination_port")[owner]):
            at, form = owner[picked], rows.context.frames[port]
            offset, end = rows.datagram("offset")[at], rows.datagram("length")[at]
            second = headers.TM.column(
                "secondary_header_flag", gather(rows.batch.data, offset, headers.TM.size)
            )
            for known, start in _headers(form, second=True):
                if known is layout:
                    there = end >= start + layout.size
                    there &= (layout is not headers.TM_SECONDARY) | (second == 1)
                    found[at[there]] = offset[there] + start
        some = np.flatnonzero(found != NO_FIRST)
        return some, found[some]

    def summary(self, decoded: Decoded) -> str:
        """Return the channel, the count, and where the first packet starts."""
        if not decoded.layers:
            return ""
        values = decoded.layers[0].values()
        count = next((values[name] for name in _TOLD if name in values), None)
        kind = decoded.layers[0].name.removesuffix("_frame").upper()
        return f"{kind} frame {count} of channel {values['virtual_channel_id']}"


FRAMES: Final = TransferFramesLink()


def _headers(form: FrameFormat, second: bool) -> Iterator[tuple[Layout, int]]:
    """Yield the headers of a frame, and where each starts; the secondary header only where there is one."""
    yield form.layout, 0
    if form.kind == "tm" and second:
        yield headers.TM_SECONDARY, form.data_start
    elif form.kind == "aos":
        yield headers.AOS_PACKETS, form.data_start
    elif form.segment_header:
        yield headers.TC_SEGMENT, form.data_start


def frame_rows(batch: PacketBatch, formats: Mapping[int, FrameFormat]) -> tuple[NDArray[np.intp], int]:
    """Find the frames of a batch, by port, version and length.

    Args:
        batch: of captured datagrams, and of packets that were taken out of frames.
        formats: of the frames that come to a port.

    Returns:
        the rows, and how many other datagrams came to these ports.
    """
    ports = np.isin(batch.destination_port, list(formats))
    if batch.streams is not None:
        ports &= ~batch.streams
    rows = np.flatnonzero(ports & (batch.original_length >= 0))
    frames = np.zeros(len(rows), bool)
    for port, at in by_value(batch.destination_port[rows]):
        frames[at] = _are_frames(batch, rows[at], formats[port])
    return rows[frames], len(rows) - int(np.count_nonzero(frames))


def _are_frames(batch: PacketBatch, rows: NDArray[np.intp], form: FrameFormat) -> NDArray[np.bool_]:
    layout, have = form.layout, batch.length[rows]
    head = gather(batch.data, batch.offset[rows], layout.size)
    length = have + np.maximum(batch.original_length[rows] - batch.frame_length[rows], 0)
    right: NDArray[np.bool_] = (have >= layout.size) & (length >= form.smallest)
    right &= layout.column("transfer_frame_version_number", head) == FRAME_VERSIONS[form.kind]
    tc = form.kind == "tc"
    right &= length == (layout.column("frame_length", head) + headers.TC_LENGTH_BIAS if tc else form.length)
    return right


def is_frame(datagram: Datagram, formats: Mapping[int, FrameFormat]) -> bool:
    """Tell whether a datagram is a frame: the same answer as :func:`frame_rows`."""
    form = formats.get(datagram.destination.port)
    if (
        form is None
        or datagram.stream
        or datagram.original_length < 0
        or len(datagram.payload) < form.layout.size
    ):
        return False
    head = form.layout.parse(datagram.payload)
    length = len(datagram.payload) + max(datagram.original_length - len(datagram.frame), 0)
    right = head["transfer_frame_version_number"] == FRAME_VERSIONS[form.kind] and length >= form.smallest
    stated = head["frame_length"] + headers.TC_LENGTH_BIAS if form.kind == "tc" else form.length
    return bool(right and length == stated)

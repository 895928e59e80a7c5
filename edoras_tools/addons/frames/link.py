"""CCSDS transfer frames, one per datagram or end to end in TCP streams, which carry the packets of a link.

A mission says which ports carry frames. The packets in them become rows of their own, of the link that the
mission names; see :mod:`edoras_tools.addons.frames.unframer`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import partial
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from edoras_tools.errors import ConfigError
from edoras_tools.links.doors import Framing, Reading, Site, Unwrapper, prefixed
from edoras_tools.links.protocol import BatchRows, LinkProtocol, LinkSending, Seen
from edoras_tools.model import Datagram, Decoded, Finding, LayerField, Link, PacketBatch
from edoras_tools.wire import arrays
from edoras_tools.wire import transfer_frames as headers
from edoras_tools.wire.transfer_frames import FRAME_LAYOUTS, FRAME_VERSIONS, NO_FIRST, FrameFormat

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from edoras_tools.wire.layout import Layout

_TM_FLAGS: Final = headers.TM.by_name["secondary_header_flag"].start
_COUNTS: Final = {
    "tm": "master_channel_frame_count",
    "aos": "virtual_channel_frame_count",
    "tc": "frame_sequence_number",
}
_TOLD: Final = ("virtual_channel_frame_count", "frame_sequence_number")


class TransferFraming(Framing):
    """Frames of one kind that follow each other in a TCP stream."""

    head = max(layout.size for layout in FRAME_LAYOUTS.values())

    def __init__(self, form: FrameFormat) -> None:
        self.form = form
        self.checked = form.fecf

    def lengths(
        self, data: arrays.Octets, at: arrays.Integers, end: arrays.Integers | int
    ) -> arrays.Integers:
        """Return the size in bytes of the frame that starts at each position."""
        layout = self.form.layout
        field = partial(layout.column, window=arrays.gather(data, at, layout.size))
        size = np.broadcast_to(_stated_length(self.form, field), at.shape)
        starts = _begins_frame(self.form, field, size)
        return prefixed(starts, size, end - at, layout.size, self.largest)

    def likely(self, data: arrays.Octets, at: arrays.Integers, end: arrays.Integers | int) -> arrays.Mask:
        """Find whole frames: with a correct CRC; without CRCs, the last one, or before a matching one."""
        size = self.lengths(data, at, end)
        likely = (size > 0) & (at + size <= end)
        rows = np.flatnonzero(likely)
        if self.form.fecf:
            likely[rows] = arrays.crc16_rows(data, at[rows], size[rows].astype(np.int32)) == 0
        else:
            likely[rows] = self._goes_on(
                data, at[rows], at[rows] + size[rows], np.broadcast_to(end, len(at))[rows]
            )
        return likely

    def _goes_on(
        self, data: arrays.Octets, at: arrays.Integers, behind: arrays.Integers, end: arrays.Integers
    ) -> arrays.Mask:
        """Return where the end or a frame that matches follows: next count, or, in AOS, another channel."""
        layout, count = self.form.layout, _COUNTS[self.form.kind]
        followed = behind + layout.size <= end
        one, other = (
            layout.columns(arrays.gather(data, place, layout.size))
            for place in (at, np.where(followed, behind, at))
        )
        step = (other[count].astype(np.int64) - one[count]) & layout.by_name[count].mask
        same = other["virtual_channel_id"] == one["virtual_channel_id"]
        goes_on = (step == 1) | ~(same | (self.form.kind != "aos"))
        agree: arrays.Mask = goes_on & (other["spacecraft_id"] == one["spacecraft_id"])
        version = "transfer_frame_version_number"
        agree &= other[version] == one[version]
        agree &= followed
        agree[behind == end] = True
        return agree


class TransferFramesLink(LinkProtocol):
    """The layer of frames below a link; it has the ports of the mission, whatever other links claim.

    The errors of a frame are judged once, where its packets are extracted.
    """

    code = 6
    name = "FRAMES"
    label = "frames"
    colour = "cyan"
    doc = "CCSDS transfer frames (TM, AOS, TC), which carry the packets of another link"
    to_cfs = True
    from_cfs = True
    layouts = (*FRAME_LAYOUTS.values(), headers.TM_SECONDARY, headers.AOS_PACKETS, headers.TC_SEGMENT)
    port_decides = False
    sends = True

    def recognise(self, facts: Seen) -> Any:
        """Recognise nothing: a datagram alone does not show that it is a frame; the mission has to say so."""
        return 0 * facts.length

    def claims(self, datagram: Datagram, site: Site) -> bool:
        """Return whether a datagram is a frame: the mission says which ports carry frames."""
        form, payload = format_of(datagram, site.frames), datagram.payload
        if form is None or datagram.original_length < 0 or len(payload) < form.layout.size:
            return False
        length = len(payload) + max(datagram.original_length - len(datagram.frame), 0)
        field = form.layout.parse(payload).__getitem__
        return bool(_begins_frame(form, field, length) & (length == _stated_length(form, field)))

    def claimed(self, batch: PacketBatch, site: Site) -> arrays.Places:
        """Return the rows of a batch that are frames."""
        return frame_rows(batch, site.frames)[0]

    def framing_of(self, carried: Link, form: Any) -> Framing:
        """Return the framing that cuts a TCP stream into frames."""
        return TransferFraming(form)

    def unwrapper(self, site: Site) -> Unwrapper | None:
        """Return the object that extracts packets from frames; None if the mission has no frames."""
        return self.part("unframer:Unframer")(site.frames) if site.frames else None

    def send(self, site: Site, *, up: bool) -> LinkSending:
        """Return what sends packets in frames of the first TC port (up), or TM or AOS port (down).

        Raises:
            ConfigError: the mission has no such port.
        """
        kinds = "TC" if up else "TM or AOS"
        port, form = next(
            (item for item in sorted(site.frames.items()) if (item[1].kind == "tc") == up), (0, None)
        )
        if form is None:
            raise ConfigError(f"no mission file says where {kinds} frames go: name one with 'frames' by -c")
        return self.part("sending:FrameSending")(self, port, form)

    def dissect(self, reading: Reading, site: Site) -> None:
        """Read the headers of one frame."""
        form, data = format_of(reading.datagram, site.frames), reading.data
        assert form is not None, "it is a frame"
        for layout, start in _headers(form, bool(form.kind == "tm" and data[_TM_FLAGS] >> 7)):
            reading.read(layout, start)
        if form.fecf and Finding.CAPTURE_CUT not in reading.findings:
            start, end = len(data) - arrays.CRC16_BYTES, len(data)
            value, right = int.from_bytes(data[start:], "big"), arrays.crc16(data[:start])
            text = f"0x{value:04x}" + (f", but the frame has 0x{right:04x}" if value != right else "")
            reading.extend(LayerField("frame_error_control", value, start, end, text, "CRC-16 of the frame"))

    def places(
        self, layout: Layout, rows: BatchRows, field: str = ""
    ) -> tuple[arrays.Places, arrays.Integers]:
        """Find one of the headers; which ones there are depends on the kind of frame."""
        places = np.full(len(rows.column("link")), NO_FIRST, np.int64)
        owner = np.flatnonzero(rows.column("link") == self)
        to_port, from_port = (rows.datagram(f"{end}_port")[owner] for end in ("destination", "source"))
        streams = rows.batch.streams is not None and rows.datagram("streams")[owner]
        for port, picked in arrays.by_value(_framed_ports(to_port, from_port, streams, rows.context.frames)):
            at, form = owner[picked], rows.context.frames[port]
            offset, end = rows.datagram("offset")[at], rows.datagram("length")[at]
            second = headers.TM.column(
                "secondary_header_flag", arrays.gather(rows.batch.data, offset, headers.TM.size)
            )
            for header, start in _headers(form, second=True):
                if header is layout:
                    whole = end >= start + layout.size
                    whole &= (layout is not headers.TM_SECONDARY) | (second == 1)
                    places[at[whole]] = offset[whole] + start
        some = np.flatnonzero(places != NO_FIRST)
        return some, places[some]

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


def frame_rows(
    batch: PacketBatch, formats: Mapping[int, FrameFormat]
) -> tuple[arrays.Places, NDArray[np.uint16], int]:
    """Find the frames of a batch, by port, version and length.

    Args:
        batch: captured datagrams, and packets extracted from frames.
        formats: format of the frames of each port.

    Returns:
        the rows of frames, the port that determines the format of each, u16, and the number of other
        datagrams to these ports; other pieces of a stream are not counted.
    """
    streams = False if batch.streams is None else batch.streams
    ports = _framed_ports(batch.destination_port, batch.source_port, streams, formats)
    rows = np.flatnonzero((ports != 0) & (batch.original_length >= 0))
    frames = np.zeros(len(rows), bool)
    for port, at in arrays.by_value(ports[rows]):
        frames[at] = _are_frames(batch, rows[at], formats[port])
    others = rows[~frames]
    if batch.streams is not None:
        others = others[~batch.streams[others]]
    rows = rows[frames]
    return rows, ports[rows], len(others)


def _framed_ports(
    destination: NDArray[np.uint16],
    source: NDArray[np.uint16],
    streams: arrays.Mask | bool,
    formats: Mapping[int, FrameFormat],
) -> NDArray[np.uint16]:
    """Return the port that determines the format of each row as a frame, u16 (n,); 0 for none.

    It is the destination port; in a stream, which may carry frames in both directions, the port of either
    end.
    """
    of_streams = [port for port, form in formats.items() if form.stream]
    of_datagrams = np.isin(destination, [port for port in formats if port not in of_streams])
    ports = np.where(of_datagrams & np.logical_not(streams), destination, 0)
    for end in (source, destination) if of_streams else ():
        ports = np.where(np.isin(end, of_streams) & streams, end, ports)
    return ports.astype(np.uint16)


def format_of(datagram: Datagram, formats: Mapping[int, FrameFormat]) -> FrameFormat | None:
    """Return the format that a datagram has if it is a frame: by the same port as ``_framed_ports``."""
    ends = (datagram.destination, datagram.source) if datagram.stream else (datagram.destination,)
    candidates = (formats.get(end.port) for end in ends)
    return next((form for form in candidates if form is not None and form.stream == datagram.stream), None)


def _stated_length(form: FrameFormat, field: Callable[[str], Any]) -> Any:
    """Return the bytes that the header of a frame states, or each of many; ``field`` returns its fields."""
    if form.kind == "tc":
        return field("frame_length") + np.int64(headers.TC_LENGTH_BIAS)
    return np.int64(form.length)


def _begins_frame(form: FrameFormat, field: Callable[[str], Any], length: Any) -> Any:
    """Return whether a frame, or each of many, may have this header and so many bytes."""
    return (field("transfer_frame_version_number") == FRAME_VERSIONS[form.kind]) & (length >= form.smallest)


def _are_frames(batch: PacketBatch, rows: arrays.Places, form: FrameFormat) -> arrays.Mask:
    layout, have = form.layout, batch.length[rows]
    field = partial(layout.column, window=arrays.gather(batch.data, batch.offset[rows], layout.size))
    length = have + np.maximum(batch.original_length[rows] - batch.frame_length[rows], 0)
    whole: arrays.Mask = (have >= layout.size) & (length == _stated_length(form, field))
    return whole & _begins_frame(form, field, length)

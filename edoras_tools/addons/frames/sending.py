"""Sends packets in transfer frames: new frames with the mission's settings and new counts."""

from __future__ import annotations

from collections import Counter
from collections.abc import (
    Iterator,
    Sequence,
)
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from edoras_tools.addons.frames.link import TransferFraming
from edoras_tools.addons.frames.unframer import read_frames
from edoras_tools.links.protocol import LinkSending
from edoras_tools.links.table import among
from edoras_tools.units import MILLISECOND
from edoras_tools.wire import ccsds
from edoras_tools.wire import transfer_frames as headers
from edoras_tools.wire.arrays import CRC16_BYTES, Integers, Mask, Places, crc16

if TYPE_CHECKING:
    from edoras_tools.model import Columns, Link, PacketBatch

_TOGETHER_NS: Final = 50 * MILLISECOND
"""Longest time to the next packet for the same TM or AOS frame; else the rest of the frame is idle."""
_LARGEST_TC: Final = 1024
_GENERATOR: Final = (3, 1, 3, 0)
"""The code's generator x^4 + a^3 x^3 + a x^2 + a^3 x + 1, as powers of a."""


class _Channel(NamedTuple):
    """A virtual channel of a spacecraft."""

    spacecraft_id: int
    virtual_channel_id: int


class _Content(NamedTuple):
    """Content of a frame: its time, its channel, its data, and the offset of the first packet that starts."""

    time_ns: int
    channel: _Channel
    data: bytes
    first: int = 0


_USUAL: Final = _Channel(0x42, 0)


class FrameSending(LinkSending):
    """The virtual channels at a port: a packet goes in the channel in which it was recorded at this port.

    Other packets go in the channel of the first recorded frame with packets at this port, if there is one.

    Args:
        link: link of the frames.
        port: port in the mission's ``frames``.
        form: format of the frames at this port.
    """

    renews = packets = True

    def __init__(self, link: Link, port: int, form: headers.FrameFormat) -> None:
        super().__init__(link)
        self.port, self.form = port, form
        self.framing = TransferFraming(form) if form.stream else None
        self._usual: _Channel | None = None
        self._in_batch: dict[int, _Channel] = {}
        self._channels: list[_Channel | None] = []
        self._counts: Counter[_Channel | int] = Counter()

    def outgoing_rows(self, batch: PacketBatch, columns: Columns) -> Mask:
        """Return which rows hold packets that are sent in this direction, bool (n,)."""
        frames = np.flatnonzero(super().outgoing_rows(batch, columns))
        up = self.form.kind == "tc"
        way = among(columns.link, lambda link: link.packets and link.to_cfs == up and link.from_cfs != up)
        way &= columns.packet_offset >= 0
        self._in_batch = self._recorded_channels(batch, frames, np.flatnonzero(way))
        return way

    def keep(self, batch: PacketBatch) -> None:
        """Note the channel in which each packet to be sent was recorded."""
        self._channels += [self._in_batch.get(place) for place in batch.offset.tolist()]

    def _recorded_channels(self, batch: PacketBatch, frames: Places, packets: Places) -> dict[int, _Channel]:
        """Return the channel of packets from frames at the port, by the packet's offset in the data."""
        inbound = frames[batch.destination_port[frames] == self.port]
        if not len(inbound):
            return {}
        read = read_frames(batch.data, batch.offset[inbound], batch.length[inbound], self.form)
        names = zip(read.spacecraft_id.tolist(), read.virtual_channel_id.tolist(), strict=True)
        channels = [_Channel(*item) for item in names]
        if self._usual is None and not read.idle.all():
            self._usual = channels[int(np.argmin(read.idle))]
        packets = packets[batch.original_length[packets] == -1]
        packets = packets[packets > frames[0]]
        frame = frames[np.searchsorted(frames, packets) - 1]  # a packet's row is behind its frame's
        inside = np.isin(frame, inbound)
        which = np.searchsorted(inbound, frame[inside]).tolist()
        places = batch.offset[packets[inside]].tolist()
        return {place: channels[index] for place, index in zip(places, which, strict=True)}

    def renew(self, messages: Sequence[bytes], time_ns: Integers) -> tuple[list[bytes], Integers]:
        """Put packets in frames; a frame leaves with the packet that fills it."""
        self._counts.clear()
        usual = self._usual or _USUAL
        channels = [item or usual for item in self._channels] or [usual] * len(messages)
        packets = [*zip(time_ns.tolist(), channels, messages, strict=True)]
        if self.form.kind == "tc":
            contents = [*self._segments(packets)]
        else:
            contents = []
            for channel in dict.fromkeys(channels):
                contents += self._filled(channel, [item for item in packets if item[1] == channel])
            contents.sort(key=lambda item: item.time_ns)
        return [self._frame(item) for item in contents], np.array(
            [item.time_ns for item in contents], np.int64
        )

    def _segments(self, packets: Sequence[tuple[int, _Channel, bytes]]) -> Iterator[_Content]:
        """Yield the content of TC frames: a packet each; a long one in segments, if the mission has them."""
        form, too_long = self.form, 0
        room = _LARGEST_TC - form.smallest + 1
        for at, channel, packet in packets:
            if len(packet) > room and not form.segment_header:
                too_long += 1
                continue
            parts = [packet[start : start + room] for start in range(0, len(packet), room)]
            for number, part in enumerate(parts):
                flags = (number == 0) | (number == len(parts) - 1) << 1
                segment = (
                    headers.TC_SEGMENT.emit({"segment_sequence_flags": flags}) if form.segment_header else b""
                )
                yield _Content(at, channel, segment + part)
        text = f"packets are longer than the {room} bytes of a TC frame without segments"
        self.refusals = [f"{too_long:,} {text}"] if too_long else []

    def _filled(
        self, channel: _Channel, packets: Sequence[tuple[int, _Channel, bytes]]
    ) -> Iterator[_Content]:
        """Yield the content of TM or AOS frames: packets end to end, an idle one if no other comes soon."""
        room = self.form.length - self.form.smallest + 1
        data, starts = b"", []
        for number, (at, _, packet) in enumerate(packets):
            starts.append(len(data))
            data += packet
            ends = number == len(packets) - 1 or packets[number + 1][0] - at > _TOGETHER_NS
            while len(data) >= room or ends:
                if len(data) < room:  # the surplus of an idle packet begins the next frame
                    starts.append(len(data))
                    data += _idle(max(room - len(data), ccsds.PRIMARY.size + 1))
                    ends = False
                first = next((start for start in starts if start < room), headers.NO_PACKET_STARTS)
                yield _Content(at, channel, data[:room], first)
                data, starts = data[room:], [start - room for start in starts if start >= room]
                ends = ends and len(data) > 0

    def _frame(self, content: _Content) -> bytes:
        """Return a frame with the next count of its channel, and with a CRC if the mission has one."""
        form, kind, channel, data = self.form, self.form.kind, content.channel, content.data
        count, of_all = self._counts[channel], self._counts[channel.spacecraft_id]
        self._counts.update([channel, channel.spacecraft_id])
        values: dict[str, Any] = {
            **channel._asdict(),
            "transfer_frame_version_number": headers.FRAME_VERSIONS[kind],
            "virtual_channel_frame_count": count % headers.count_modulus(kind),
        }
        if kind == "tc":
            values["frame_sequence_number"] = values.pop("virtual_channel_frame_count")
            values["frame_length"] = (
                form.data_start + len(data) + CRC16_BYTES * form.fecf - headers.TC_LENGTH_BIAS
            )
        elif kind == "aos":
            high, low = divmod(channel.spacecraft_id, 256)
            values |= {"spacecraft_id_high": high, "spacecraft_id": low}
            data = (
                bytes(form.insert_zone)
                + headers.AOS_PACKETS.emit({"first_header_pointer": content.first})
                + data
            )
        else:
            values |= {
                "ocf_flag": int(form.ocf),
                "master_channel_frame_count": of_all % headers.count_modulus(kind),
                "segment_length_id": 3,
                "first_header_pointer": content.first,
            }
        head = form.layout.emit(values)
        if form.header_error_control:
            head += header_check(head)
        frame = head + data + bytes(headers.OCF_BYTES * form.ocf)
        return frame + crc16(frame).to_bytes(CRC16_BYTES, "big") if form.fecf else frame


def header_check(head: bytes) -> bytes:
    """Return the error control of an AOS header: a Reed-Solomon code (10,6) over 4 bits (732.0-B 4.1.2.6).

    It covers the identifications, bytes 0 and 1, and the signaling field, byte 5.
    """
    symbols = [part for octet in (head[0], head[1], head[5]) for part in (octet >> 4, octet & 15)]
    rest = [0, 0, 0, 0]
    for symbol in symbols:
        factor = symbol ^ rest[0]
        rest = [item ^ _times(power, factor) for item, power in zip([*rest[1:], 0], _GENERATOR, strict=True)]
    return bytes([rest[0] << 4 | rest[1], rest[2] << 4 | rest[3]])


def _times(power: int, symbol: int) -> int:
    """Return a symbol times a power of a root of x^4 + x + 1."""
    for _ in range(power):
        symbol = symbol << 1 ^ (symbol >> 3) * 0b10011
    return symbol


def _idle(size: int) -> bytes:
    """Return an idle packet of a given size in bytes."""
    values = {
        "apid": ccsds.IDLE_APID,
        "sequence_flags": ccsds.UNSEGMENTED,
        "packet_data_length": size - ccsds.LENGTH_BIAS,
    }
    return ccsds.PRIMARY.emit(values) + bytes(size - ccsds.PRIMARY.size)

"""How packets are sent in transfer frames: made anew, with the mission's settings and counts of their own."""

from __future__ import annotations

from collections.abc import Iterator  # noqa: TC003
from typing import TYPE_CHECKING, Final

import numpy as np

from edoras_tools.addons.frames.link import TransferFraming
from edoras_tools.links.sending import LinkSending
from edoras_tools.links.table import among
from edoras_tools.units import MILLISECOND
from edoras_tools.wire import ccsds
from edoras_tools.wire.arrays.crc import CRC16_BYTES, crc16
from edoras_tools.wire.transfer_frames import (
    AOS_PACKETS,
    FRAME_VERSIONS,
    NO_PACKET_STARTS,
    OCF_BYTES,
    TC_LENGTH_BIAS,
    TC_SEGMENT,
    FrameFormat,
    count_modulus,
    read_frames,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from edoras_tools.model import Columns, Link, PacketBatch

_TOGETHER_NS: Final = 50 * MILLISECOND
"""A packet waits so long for others in its TM or AOS frame; then the rest of the frame is idle."""
_LARGEST_TC: Final = 1024
_GENERATOR: Final = (3, 1, 3, 0)
"""The code's generator x^4 + a^3 x^3 + a x^2 + a^3 x + 1, as powers of a."""
_SPACECRAFT: Final = 0x42


class FrameSending(LinkSending):
    """One virtual channel at a port; its ids are those of the first recorded frame there, if there is one.

    Args:
        link: of the frames.
        port: of the mission's ``frames``.
        form: what is there.
    """

    renews = packets = True

    def __init__(self, link: Link, port: int, form: FrameFormat) -> None:
        super().__init__(link)
        self.port, self.form = port, form
        self.framing = TransferFraming(form) if form.stream else None
        self._ids = {"spacecraft_id": _SPACECRAFT, "virtual_channel_id": 0}
        self._count = 0
        self._recorded = False

    def outgoing_rows(self, batch: PacketBatch, columns: Columns) -> NDArray[np.bool_]:
        """Tell which rows have packets that go this way."""
        at = np.flatnonzero(super().outgoing_rows(batch, columns) & (batch.destination_port == self.port))
        if len(at) and not self._recorded:
            self._recorded = True
            one = read_frames(batch.data, batch.offset[at[:1]], batch.length[at[:1]], self.form)
            self._ids = {name: int(getattr(one, name)[0]) for name in self._ids}
        up = self.form.kind == "tc"
        way = among(columns.link, lambda link: link.packets and link.to_cfs == up and link.from_cfs != up)
        return way & (columns.packet_offset >= 0)

    def renew(
        self, messages: Sequence[bytes], time_ns: NDArray[np.int64]
    ) -> tuple[list[bytes], NDArray[np.int64]]:
        """Put packets in frames; a frame leaves with the packet that fills it."""
        self._count = 0
        made = [*(self._tc if self.form.kind == "tc" else self._filled)(messages, time_ns.tolist())]
        return [frame for frame, _ in made], np.array([at for _, at in made], np.int64)

    def _tc(self, packets: Sequence[bytes], times: Sequence[int]) -> Iterator[tuple[bytes, int]]:
        """Yield a frame a packet; of a longer one a frame a segment, where the mission has segments."""
        form, left = self.form, 0
        room = _LARGEST_TC - form.smallest + 1
        for packet, at in zip(packets, times, strict=True):
            if len(packet) > room and not form.segment_header:
                left += 1
                continue
            parts = [packet[start : start + room] for start in range(0, len(packet), room)]
            for number, part in enumerate(parts):
                flags = (number == 0) | (number == len(parts) - 1) << 1
                segment = TC_SEGMENT.emit({"segment_sequence_flags": flags}) if form.segment_header else b""
                yield (
                    self._frame(segment + part, frame_length=form.smallest - 1 + len(part) - TC_LENGTH_BIAS),
                    at,
                )
        text = f"packets are longer than the {room} bytes of a TC frame without segments"
        self.refusals = [f"{left:,} {text}"] if left else []

    def _filled(self, packets: Sequence[bytes], times: Sequence[int]) -> Iterator[tuple[bytes, int]]:
        """Yield TM or AOS frames: packets behind each other, an idle one where none comes soon."""
        room = self.form.length - self.form.smallest + 1
        data, starts = b"", []
        for number, packet in enumerate(packets):
            at = times[number]
            starts.append(len(data))
            data += packet
            ends = number == len(packets) - 1 or times[number + 1] - at > _TOGETHER_NS
            while len(data) >= room or ends:
                if len(data) < room:  # what an idle packet has too much begins the next frame
                    starts.append(len(data))
                    data += _idle(max(room - len(data), ccsds.PRIMARY.size + 1))
                    ends = False
                first = next((start for start in starts if start < room), NO_PACKET_STARTS)
                yield self._data_frame(data[:room], first), at
                data, starts = data[room:], [start - room for start in starts if start >= room]
                ends = ends and len(data) > 0

    def _data_frame(self, data: bytes, first: int) -> bytes:
        if self.form.kind == "tm":
            return self._frame(
                data,
                master_channel_frame_count=self._count % 256,
                segment_length_id=3,
                first_header_pointer=first,
            )
        zone = bytes(self.form.insert_zone) + AOS_PACKETS.emit({"first_header_pointer": first})
        return self._frame(zone + data + bytes(OCF_BYTES * self.form.ocf))

    def _frame(self, data: bytes, **values: int) -> bytes:
        """Return a frame of the next count, with its CRC where the mission has one."""
        kind, layout, ids = self.form.kind, self.form.layout, dict(self._ids)
        if kind == "aos":
            ids["spacecraft_id_high"], ids["spacecraft_id"] = divmod(ids["spacecraft_id"], 256)
        name = "frame_sequence_number" if kind == "tc" else "virtual_channel_frame_count"
        values[name] = self._count % count_modulus(kind)
        values["transfer_frame_version_number"] = FRAME_VERSIONS[kind]
        self._count += 1
        head = layout.emit(ids | values)
        if self.form.header_error_control:
            head += header_check(head)
        frame = head + data
        return frame + crc16(frame).to_bytes(CRC16_BYTES, "big") if self.form.fecf else frame


def header_check(head: bytes) -> bytes:
    """Return the error control of an AOS header: a Reed-Solomon code (10,6) over 4 bits (732.0-B 4.1.2.6).

    It is of the identifications, bytes 0 and 1, and of the signaling field, byte 5.
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
    """Return an idle packet."""
    values = {
        "apid": ccsds.IDLE_APID,
        "sequence_flags": ccsds.UNSEGMENTED,
        "packet_data_length": size - ccsds.LENGTH_BIAS,
    }
    return ccsds.PRIMARY.emit(values) + bytes(size - ccsds.PRIMARY.size)

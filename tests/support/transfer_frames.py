"""Transfer frames made without the code under test: TM by ``spacepackets``, AOS and TC byte by byte."""

from __future__ import annotations

import struct

import msgspec
import numpy as np
from fastcrc import crc16
from rewriting import Udp, _packets
from spacepackets.ccsds import tm_frame

from edoras_tools.io.frames.linklayer import LINKTYPE_RAW, FrameBatch, demux
from edoras_tools.wire.arrays import PADDING

GROUND, CRAFT = ("10.0.0.1", 5111), ("10.0.0.2", 40000)


def space_packet(apid, body, count=0):
    """Return a telemetry packet with the cFE's bits; the body has at least one byte."""
    return struct.pack(">HHH", 0x0800 | apid, 0xC000 | count & 0x3FFF, len(body) - 1) + body


def with_crc(frame):
    """Return a frame with its error control behind it."""
    return frame + crc16.ibm_3740(frame).to_bytes(2, "big")


class Maker(msgspec.Struct):
    """Makes the frames of one virtual channel.

    ``room`` is the bytes of data in a TM or AOS frame.
    """

    kind: str
    room: int
    channel: int = 1
    craft: int = 42
    fecf: bool = True
    ocf: bool = False
    second: bytes = b""
    insert: bytes = b""
    segments: bool = False
    count: int = 0
    master: int = 0

    @property
    def length(self):
        """Bytes of a whole TM or AOS frame."""
        head = {"tm": 6 + (1 + len(self.second)) * bool(self.second), "aos": 8 + len(self.insert)}[self.kind]
        return head + self.room + 4 * self.ocf + 2 * self.fecf

    def format(self):
        """Return what the mission file says of them."""
        if self.kind == "tc":
            return {"kind": "tc", "fecf": self.fecf, "segment_header": self.segments}
        more = {"ocf": self.ocf, "insert_zone": len(self.insert)} if self.kind == "aos" else {}
        return {"kind": self.kind, "length": self.length, "fecf": self.fecf, **more}

    def frame(self, data, first=0, flags=3, map_id=0):
        """Return the next frame: ``first`` is its first header pointer, ``flags`` those of a TC segment."""
        made = getattr(self, f"_{self.kind}")(data, first, flags, map_id)
        self.count += 1
        self.master += 1
        return made

    def _tm(self, data, first, flags, map_id):
        status = tm_frame.TransferFrameDataFieldStatus(bool(self.second), False, False, 3, first)
        head = tm_frame.TmFramePrimaryHeader(
            tm_frame.MasterChannelId(0, self.craft),
            self.channel,
            self.ocf,
            self.master & 0xFF,
            self.count & 0xFF,
            status,
        )
        second = tm_frame.TransferFrameSecondaryHeader(0, len(self.second), self.second)
        made = tm_frame.TmTransferFrame(
            self.length - 2 * self.fecf,
            head,
            second if self.second else None,
            data,
            b"OCF!" if self.ocf else None,
            None,
        ).pack()
        return with_crc(made) if self.fecf else made

    def _aos(self, data, first, flags, map_id):
        word = 1 << 14 | (self.craft & 0xFF) << 6 | self.channel
        count = self.count & 0xFFFFFF
        head = struct.pack(">H", word) + count.to_bytes(3, "big") + bytes([(self.craft >> 8) << 4])
        made = head + self.insert + struct.pack(">H", first) + data + b"OCF!" * self.ocf
        return with_crc(made) if self.fecf else made

    def _tc(self, data, first, flags, map_id):
        body = bytes([flags << 6 | map_id]) * self.segments + data
        size = 5 + len(body) + 2 * self.fecf
        head = struct.pack(">HHB", self.craft, self.channel << 10 | size - 1, self.count & 0xFF)
        return with_crc(head + body) if self.fecf else head + body

    def carry(self, packets):
        """Return frames that carry packets, and which packets have bytes in each of them.

        TM and AOS: cut where the room ends, the last frame filled with an idle packet. TC: one packet in a
        frame, or with segments as many frames as its bytes need.
        """
        if self.kind != "tc":
            return self._stream(packets)
        if not self.segments:
            return [(self.frame(packet), {index}) for index, packet in enumerate(packets)]
        made = []
        for index, packet in enumerate(packets):
            parts = [packet[at : at + self.room] for at in range(0, len(packet), self.room)]
            for place, part in enumerate(parts):
                flags = (place == 0) | (place == len(parts) - 1) << 1
                made.append((self.frame(part, flags=flags), {index}))
        return made

    def _stream(self, packets):
        stream, starts, touched = b"", [], []
        for index, packet in enumerate(packets):
            starts.append(len(stream))
            touched.append((len(stream), len(stream) + len(packet), index))
            stream += packet
        while fill := -len(stream) % self.room:
            starts.append(len(stream))
            fill += -(-max(7 - fill, 0) // self.room) * self.room
            stream += space_packet(0x7FF, bytes(fill - 6))
        made = []
        for at in range(0, len(stream), self.room):
            first = next((start - at for start in starts if at <= start < at + self.room), 0x7FF)
            inside = {index for low, high, index in touched if low < at + self.room and at < high}
            made.append((self.frame(stream[at : at + self.room], first), inside))
        return made

    def idle(self):
        """Return a frame without packets."""
        return self.frame(b"\x55" * self.room, 0x7FE)


def batch_of(payloads, first=1, *, source=CRAFT, destination=GROUND):
    """Return a batch of datagrams, a millisecond apart."""
    raw = [b"".join(_packets(Udp(0, source, destination, payload), 0)) for payload in payloads]
    length = np.array([len(item) for item in raw], np.int32)
    number = np.arange(first, first + len(raw))
    return demux(
        FrameBatch(
            np.frombuffer(b"".join(raw) + bytes(PADDING), np.uint8),
            number.astype(np.int64),
            number * 1_000_000,
            np.full(len(raw), LINKTYPE_RAW, np.uint16),
            np.cumsum(length).astype(np.int64) - length,
            length,
            length,
        )
    )


def packets_of(batch):
    """Return the packets that were taken out: their bytes and the numbers of their frames."""
    rows = np.flatnonzero(batch.original_length < 0)
    return [(batch[row].payload, int(batch.number[row])) for row in rows.tolist()]

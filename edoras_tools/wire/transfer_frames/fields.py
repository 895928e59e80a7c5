"""What a mission lays down of its transfer frames, and many frames read at once."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Literal

import numpy as np

from edoras_tools.wire.arrays.crc import CRC16_BYTES, crc16_rows
from edoras_tools.wire.arrays.window import gather
from edoras_tools.wire.transfer_frames import headers

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from edoras_tools.wire.layout import Layout

FrameKind = Literal["tm", "aos", "tc"]
FRAME_LAYOUTS: Final[Mapping[str, Layout]] = {"tm": headers.TM, "aos": headers.AOS, "tc": headers.TC}
FRAME_VERSIONS: Final = {"tm": 0, "aos": 1, "tc": 0}
"""The transfer frame version number of each kind."""
FIRST_PART: Final = 1
"""The bit of a segment's sequence flags that says that a packet starts in it."""
LATE: Final = 32
"""How many counts of 8 bits back a frame is late, and not ahead."""
NO_FIRST: Final = -1
"""``FrameFields.first`` of a frame in which no packet starts."""


@dataclass(frozen=True, slots=True)
class FrameFormat:
    """What the bytes of a frame do not say themselves.

    Attributes:
        kind: ``tm``, ``aos`` or ``tc``.
        length: bytes of a whole TM or AOS frame; 0 for TC frames, which say theirs.
        fecf: the last two bytes are a CRC-16 of the frame.
        ocf: AOS: an operational control field is behind the data; TM frames say so themselves.
        insert_zone: AOS: bytes of the insert zone behind the header.
        header_error_control: AOS: two bytes of it are behind the header.
        segment_header: TC: the data begins with a segment header.
        stream: they follow each other in TCP streams, either way; if not, each is a datagram.
    """

    kind: FrameKind
    length: int = 0
    fecf: bool = True
    ocf: bool = False
    insert_zone: int = 0
    header_error_control: bool = False
    segment_header: bool = False
    stream: bool = False

    @property
    def layout(self) -> Layout:
        """The primary header."""
        return FRAME_LAYOUTS[self.kind]

    @property
    def data_start(self) -> int:
        """Bytes in front of the data, and of what a TM secondary header adds."""
        error_control = headers.HEADER_ERROR_CONTROL_BYTES * self.header_error_control
        return self.layout.size + error_control + self.insert_zone

    @property
    def smallest(self) -> int:
        """Bytes of a frame with headers and trailers, and one byte of data."""
        further = {"tm": 0, "aos": headers.AOS_PACKETS.size, "tc": headers.TC_SEGMENT.size}[self.kind]
        further *= self.kind == "aos" or self.segment_header
        trailer = CRC16_BYTES * self.fecf + headers.OCF_BYTES * self.ocf
        return self.data_start + further + trailer + 1


@dataclass(frozen=True, slots=True, eq=False)
class FrameFields:
    """What frames say, (n,) each; positions are in the data that was read.

    Attributes:
        fits: bool, headers, first header pointer and trailers fit the frame.
        error: bool, the CRC at its end is not that of the frame.
        spacecraft_id: u32.
        virtual_channel_id: u8.
        map_id: u8, of a TC segment; else 0.
        counted: bool, it has a count of its channel; TC frames of Type-B have none.
        count: u32, of the virtual channel.
        master_count: u8, of the master channel; 0 where the kind has none.
        start: i64, first byte of the data.
        end: i64, one past its last byte; that of ``start`` where there are no packets.
        first: i64, where the first packet starts; ``NO_FIRST`` for none.
        idle: bool, sent without packets.
    """

    fits: NDArray[np.bool_]
    error: NDArray[np.bool_]
    spacecraft_id: NDArray[np.uint32]
    virtual_channel_id: NDArray[np.uint8]
    map_id: NDArray[np.uint8]
    counted: NDArray[np.bool_]
    count: NDArray[np.uint32]
    master_count: NDArray[np.uint8]
    start: NDArray[np.int64]
    end: NDArray[np.int64]
    first: NDArray[np.int64]
    idle: NDArray[np.bool_]


def count_modulus(kind: str) -> int:
    """Return how many values the count of a virtual channel has."""
    name = "frame_sequence_number" if kind == "tc" else "virtual_channel_frame_count"
    return FRAME_LAYOUTS[kind].by_name[name].mask + 1


def read_frames(
    data: NDArray[np.uint8], offset: NDArray[np.int64], length: NDArray[np.int32], form: FrameFormat
) -> FrameFields:
    """Read many frames of one kind; nothing in them can make this raise.

    Args:
        data: u8, contiguous.
        offset: i64 (n,), where each begins.
        length: i32 (n,), bytes of each; at least those of the primary header.
        form: of all of them.
    """
    head = form.layout.columns(gather(data, offset, form.layout.size))
    none = np.zeros(len(offset), np.uint8)
    start = offset + form.data_start
    end = offset + length - CRC16_BYTES * form.fecf
    counted, map_id, master = np.ones(len(offset), bool), none, none
    spacecraft = head["spacecraft_id"].astype(np.uint32)
    # Positions past the end of the data are not read: the window of a short frame is filled with zeros.
    behind = gather(data, np.minimum(start, len(data)), 2)
    if form.kind == "tm":
        second = headers.TM_SECONDARY.column("secondary_header_length", behind) + np.int64(1)
        start = start + second * head["secondary_header_flag"]
        end = end - headers.OCF_BYTES * head["ocf_flag"].astype(np.int64)
        pointer, count = head["first_header_pointer"], head["virtual_channel_frame_count"]
        idle = (pointer == headers.ONLY_IDLE_DATA) | (head["synchronization_flag"] == 1)
        master = head["master_channel_frame_count"]
    elif form.kind == "aos":
        start = start + headers.AOS_PACKETS.size
        end = end - headers.OCF_BYTES * form.ocf
        pointer = headers.AOS_PACKETS.column("first_header_pointer", behind)
        idle = (head["virtual_channel_id"] == headers.AOS_IDLE_CHANNEL) | (pointer == headers.ONLY_IDLE_DATA)
        count = head["virtual_channel_frame_count"]
        spacecraft |= head["spacecraft_id_high"].astype(np.uint32) << 8
    else:
        idle, counted = head["control_command_flag"] == 1, head["bypass_flag"] == 0
        count, pointer = head["frame_sequence_number"], none
        if form.segment_header:
            start = start + headers.TC_SEGMENT.size
            map_id = headers.TC_SEGMENT.column("map_id", behind)
            flags = headers.TC_SEGMENT.column("segment_sequence_flags", behind)
            pointer = np.where(flags & FIRST_PART, 0, headers.NO_PACKET_STARTS)
    starts = ~idle & (pointer != headers.NO_PACKET_STARTS)
    first = np.where(starts, start + pointer, NO_FIRST)
    fits = (idle & (form.kind == "tc")) | (start <= end) & (first < np.maximum(end, start + 1))
    return FrameFields(
        fits,
        crc16_rows(data, offset, length) != 0 if form.fecf else np.zeros(len(offset), bool),
        spacecraft,
        head["virtual_channel_id"],
        map_id,
        counted,
        count.astype(np.uint32),
        master,
        start,
        np.where(idle, start, end),
        first,
        idle,
    )

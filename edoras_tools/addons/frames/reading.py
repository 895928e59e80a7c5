"""Reads many transfer frames at once."""

from __future__ import annotations

from typing import TYPE_CHECKING

import msgspec
import numpy as np

from edoras_tools.wire import transfer_frames as headers
from edoras_tools.wire.arrays.crc import CRC16_BYTES, crc16_rows
from edoras_tools.wire.arrays.window import gather

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from edoras_tools.wire.arrays.order import Integers, Mask, Octets


class FrameFields(msgspec.Struct, frozen=True, eq=False):
    """Fields of frames, (n,) each; positions are indices into the data that was read.

    Attributes:
        fits: bool, headers, first header pointer and trailers fit into the frame.
        error: bool, the CRC at the end is wrong.
        spacecraft_id: u32.
        virtual_channel_id: u8.
        map_id: u8, MAP of a TC segment; else 0.
        has_count: bool, the frame has a count of its virtual channel; TC frames of Type-B have none.
        count: u32, count of the virtual channel.
        master_count: u8, count of the master channel; 0 if the kind of frame has none.
        start: i64, position of the first byte of the data field.
        end: i64, one past the last byte of the data field; equal to ``start`` if there are no packets.
        first: i64, position where the first packet starts; ``NO_FIRST`` for none.
        idle: bool, the frame was sent without packets.
    """

    fits: Mask
    error: Mask
    spacecraft_id: NDArray[np.uint32]
    virtual_channel_id: Octets
    map_id: Octets
    has_count: Mask
    count: NDArray[np.uint32]
    master_count: Octets
    start: Integers
    end: Integers
    first: Integers
    idle: Mask


def read_frames(
    data: Octets, offset: Integers, length: NDArray[np.int32], form: headers.FrameFormat
) -> FrameFields:
    """Read many frames of one kind; no content of theirs can make this raise.

    Args:
        data: u8, contiguous.
        offset: i64 (n,), position where each frame begins.
        length: i32 (n,), size of each frame in bytes; at least that of the primary header.
        form: format of all of the frames.
    """
    head = form.layout.columns(gather(data, offset, form.layout.size))
    none = np.zeros(len(offset), np.uint8)
    start = offset + form.data_start
    end = offset + length - CRC16_BYTES * form.fecf
    has_count, map_id, master = np.ones(len(offset), bool), none, none
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
        idle, has_count = head["control_command_flag"] == 1, head["bypass_flag"] == 0
        count, pointer = head["frame_sequence_number"], none
        if form.segment_header:
            start = start + headers.TC_SEGMENT.size
            map_id = headers.TC_SEGMENT.column("map_id", behind)
            flags = headers.TC_SEGMENT.column("segment_sequence_flags", behind)
            pointer = np.where(flags & headers.FIRST_PART, 0, headers.NO_PACKET_STARTS)
    starts = ~idle & (pointer != headers.NO_PACKET_STARTS)
    first = np.where(starts, start + pointer, headers.NO_FIRST)
    fits = (idle & (form.kind == "tc")) | (start <= end) & (first < np.maximum(end, start + 1))
    return FrameFields(
        fits,
        crc16_rows(data, offset, length) != 0 if form.fecf else np.zeros(len(offset), bool),
        spacecraft,
        head["virtual_channel_id"],
        map_id,
        has_count,
        count.astype(np.uint32),
        master,
        start,
        np.where(idle, start, end),
        first,
        idle,
    )

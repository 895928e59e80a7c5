"""Frames of ``spacepackets`` and of bytes laid out by hand, read in columns."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from spacepackets.ccsds import tm_frame
from transfer_frames import Maker

from edoras_tools.addons.frames.reading import read_frames
from edoras_tools.wire import transfer_frames
from edoras_tools.wire.transfer_frames import NO_FIRST, FrameFormat, count_modulus

AOS = {
    "transfer_frame_version_number": 1,
    "spacecraft_id": 0xA5,
    "virtual_channel_id": 0x2A,
    "virtual_channel_frame_count": 0x123456,
    "replay_flag": 1,
    "frame_count_usage_flag": 0,
    "spacecraft_id_high": 2,
    "frame_count_cycle": 9,
}
TC = {
    "transfer_frame_version_number": 0,
    "bypass_flag": 1,
    "control_command_flag": 0,
    "reserved": 0,
    "spacecraft_id": 0x3FE,
    "virtual_channel_id": 0x21,
    "frame_length": 0x2AB,
    "frame_sequence_number": 0xCD,
}


@pytest.mark.parametrize(
    ("layout", "raw", "values"),
    [
        (transfer_frames.AOS, "696a123456a9", AOS),
        (
            transfer_frames.AOS_PACKETS,
            "07fe",
            {"reserved": 0, "first_header_pointer": transfer_frames.ONLY_IDLE_DATA},
        ),
        (transfer_frames.TC, "23fe86abcd", TC),
        (transfer_frames.TC_SEGMENT, "c5", {"segment_sequence_flags": 3, "map_id": 5}),
        (transfer_frames.TM_SECONDARY, "05", {"version_number": 0, "secondary_header_length": 5}),
    ],
)
def test_both_directions(layout, raw, values):
    assert layout.parse(bytes.fromhex(raw)) == values
    assert layout.emit(values).hex() == raw
    assert layout.size == len(raw) // 2


def test_tm_as_an_independent_package_writes_it():
    status = tm_frame.TransferFrameDataFieldStatus(True, False, False, 3, 0x5A5)
    head = tm_frame.TmFramePrimaryHeader(tm_frame.MasterChannelId(0, 0x2BC), 6, True, 0xE1, 0x17, status)
    values = {
        "transfer_frame_version_number": 0,
        "spacecraft_id": 0x2BC,
        "virtual_channel_id": 6,
        "ocf_flag": 1,
        "master_channel_frame_count": 0xE1,
        "virtual_channel_frame_count": 0x17,
        "secondary_header_flag": 1,
        "synchronization_flag": 0,
        "packet_order_flag": 0,
        "segment_length_id": 3,
        "first_header_pointer": 0x5A5,
    }
    assert transfer_frames.TM.parse(head.pack()) == values
    assert transfer_frames.TM.emit(values) == head.pack()


MAKERS = [
    Maker("tm", 20, channel=5, craft=0x2A7, second=b"abc", ocf=True, count=300, master=511),
    Maker("tm", 20, fecf=False),
    Maker("aos", 20, channel=62, craft=0x2A7, insert=b"zone", ocf=True, count=0xABCDEF),
    Maker("tc", 20, channel=63, craft=0x3FF, segments=True, count=255),
    Maker("tc", 20),
]


def read(frames, maker):
    length = np.array([len(frame) for frame in frames], np.int32)
    data = np.frombuffer(b"".join(frames), np.uint8)
    return read_frames(
        data, np.cumsum(length).astype(np.int64) - length, length, FrameFormat(**maker.format())
    )


@pytest.mark.parametrize("maker", MAKERS, ids=lambda item: f"{item.kind}{item.channel}")
def test_what_was_written_is_read(maker):
    count, master, data = maker.count, maker.master, bytes(range(20))
    found = read([maker.frame(data, 7, 1, 9), maker.frame(data, 0x7FF, 0, 9)], maker)
    assert found.fits.all()
    assert not found.error.any()
    assert found.spacecraft_id.tolist() == [maker.craft] * 2
    assert found.virtual_channel_id.tolist() == [maker.channel] * 2
    modulus = count_modulus(maker.kind)
    assert found.count.tolist() == [count % modulus, (count + 1) % modulus]
    assert found.master_count.tolist() == [(master + item) % 256 * (maker.kind == "tm") for item in (0, 1)]
    assert found.map_id.tolist() == [9 * maker.segments] * 2
    assert (found.end - found.start).tolist() == [20, 20]
    of_tc = 0 if maker.segments else found.start[1]
    first = found.start[0] + (0 if maker.kind == "tc" else 7)
    assert found.first.tolist() == [first, NO_FIRST if maker.kind != "tc" or maker.segments else of_tc]


@pytest.mark.parametrize("maker", MAKERS[:4:2], ids=lambda item: item.kind)
def test_idle_frames(maker):
    found = read([maker.idle()], maker)
    assert (found.idle[0], found.first[0]) == (True, NO_FIRST)
    assert found.start[0] == found.end[0]


def test_the_error_control_is_of_the_whole_frame():
    maker = Maker("aos", 20)
    frame = maker.frame(bytes(20))
    wrong = [frame[:at] + bytes([frame[at] ^ 1]) + frame[at + 1 :] for at in range(len(frame))]
    assert read([frame, *wrong], maker).error.tolist() == [False] + [True] * len(wrong)


def test_a_pointer_behind_the_data_does_not_fit():
    maker = Maker("tm", 20)
    assert read([maker.frame(bytes(20), 19), maker.frame(bytes(20), 20)], maker).fits.tolist() == [
        True,
        False,
    ]


@given(st.sampled_from(MAKERS), st.lists(st.binary(min_size=6, max_size=40), min_size=1, max_size=40))
def test_any_bytes(maker, frames):
    found = read(frames, maker)
    ends = np.cumsum([len(frame) for frame in frames])
    starts = ends - [len(frame) for frame in frames]
    fits = found.fits & ~found.idle
    assert (found.start[fits] >= starts[fits]).all()
    assert (found.end[fits] <= ends[fits]).all()
    pointed = fits & (found.first != NO_FIRST)
    assert (found.first[pointed] >= found.start[pointed]).all()
    assert (found.first[pointed] <= found.end[pointed]).all()

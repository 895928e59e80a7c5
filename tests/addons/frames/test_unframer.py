"""Packets into frames and out again: whatever the cuts, the losses and the batches."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from spacepackets.ccsds import tm_frame
from transfer_frames import GROUND, Maker, batch_of, packets_of, space_packet, with_crc

from edoras_tools.addons.frames.unframer import MOST_CHANNELS, Unframer, read_frames
from edoras_tools.model import Finding
from edoras_tools.wire import transfer_frames
from edoras_tools.wire.transfer_frames import NO_FIRST, FrameFormat, count_modulus

PORT = GROUND[1]

PACKETS = st.lists(st.integers(1, 400), min_size=1, max_size=30).map(
    lambda sizes: [
        space_packet(0x20 + index % 5, bytes([index + 1]) * size, index) for index, size in enumerate(sizes)
    ]
)
MAKERS = st.one_of(
    st.builds(
        Maker,
        kind=st.just("tm"),
        room=st.integers(1, 300),
        channel=st.integers(0, 7),
        fecf=st.booleans(),
        ocf=st.booleans(),
        second=st.sampled_from([b"", b"ab"]),
        count=st.integers(0, 255),
    ),
    st.builds(
        Maker,
        kind=st.just("aos"),
        room=st.integers(1, 300),
        channel=st.integers(0, 62),
        craft=st.sampled_from([42, 0x2A7]),
        fecf=st.booleans(),
        ocf=st.booleans(),
        insert=st.sampled_from([b"", b"zone"]),
        count=st.sampled_from([0, 5, 0xFFFFF0]),
    ),
    st.builds(
        Maker,
        kind=st.just("tc"),
        room=st.integers(1, 300),
        channel=st.integers(0, 63),
        fecf=st.booleans(),
        segments=st.booleans(),
        count=st.integers(0, 255),
    ),
)


def unframer(maker):
    return Unframer({PORT: FrameFormat(**maker.format())})


def taken(frames, splits, reader):
    """Return what comes out of frames that arrive in batches."""
    ends = sorted({min(end, len(frames)) for end in splits} | {len(frames)})
    found, rows, first = [], [], 0
    for end in ends:
        if end > first:
            out = reader.take(batch_of(frames[first:end], first))
            found += packets_of(out)
            rows += out.capture_findings[out.original_length >= 0].tolist()
            first = end
    assert len(rows) == len(frames)
    return found, rows


@given(PACKETS, MAKERS, st.lists(st.integers(0, 200), max_size=4))
def test_what_is_cut_into_frames_comes_out_the_same(packets, maker, splits):
    carried = maker.carry(packets)
    reader = unframer(maker)
    found, rows = taken([frame for frame, _ in carried], splits, reader)
    assert [packet for packet, _ in found] == packets
    last = {index: number for number, (_, inside) in enumerate(carried) for index in inside}
    assert [number for _, number in found] == [last[index] for index in range(len(packets))]
    assert not any(rows)
    (channel,) = reader.channels
    assert (channel.lost, channel.cut, channel.packets) == (0, 0, len(packets))
    assert (channel.frames, reader.damaged, reader.strange) == (len(carried), 0, 0)


@given(PACKETS, MAKERS, st.lists(st.integers(0, 200), max_size=3), st.data())
def test_a_lost_frame_loses_the_packets_that_it_touches_and_no_other(packets, maker, splits, data):
    carried = maker.carry(packets)
    most = min(len(carried), 200)  # a count of 8 bits tells no more of one gap
    lost = data.draw(st.sets(st.integers(0, most - 1), max_size=6))
    gone = lost | set(range(most, len(carried)))
    damage = maker.fecf and data.draw(st.booleans())
    frames = [
        frame if number not in lost else frame[:-1] + bytes([frame[-1] ^ 0x10])
        for number, (frame, _) in enumerate(carried[:most])
        if damage or number not in lost
    ]
    touched = {index for number in gone for index in carried[number][1]}
    reader = unframer(maker)
    found, _ = taken(frames, splits, reader)
    assert [packet for packet, _ in found] == [
        packet for index, packet in enumerate(packets) if index not in touched
    ]
    left = sorted(set(range(len(carried))) - gone)
    inner = [number for number in lost if left and left[0] < number < left[-1]]
    assert sum(channel.lost for channel in reader.channels) == len(inner)
    assert reader.damaged == (len(lost) if damage else 0)


def test_the_finding_is_at_the_frame_behind_the_gap():
    maker = Maker("tm", 50)
    carried = maker.carry([space_packet(1, bytes([number]) * 60) for number in range(5)])
    frames = [frame for frame, _ in carried]
    found, rows = taken(frames[:2] + frames[3:], [], reader := unframer(maker))
    assert [bool(item & Finding.STREAM_GAP) for item in rows].index(True) == 2
    assert sum(bool(item & Finding.STREAM_GAP) for item in rows) == reader.channels[0].cut == 1
    assert (reader.channels[0].lost, reader.masters[0].lost) == (1, 1)
    assert len(found) == 3


def test_virtual_channels_are_told_apart_and_their_master_counts_them_all():
    one, two = Maker("tm", 40, channel=1), Maker("tm", 40, channel=5)
    packets = [space_packet(3, bytes([number]) * 30) for number in range(12)]
    frames = []
    mine, yours = iter(packets[:6]), iter(packets[6:])
    for first, second in zip(one.carry(list(mine)), two.carry(list(yours)), strict=True):
        frames += [first[0], second[0]]
    # The master count is of both: written anew, with the error control.
    frames = [with_crc(frame[:2] + bytes([count]) + frame[3:-2]) for count, frame in enumerate(frames)]
    reader = unframer(one)
    found, _ = taken(frames[:3] + frames[4:], [5], reader)
    assert {packet for packet, _ in found} <= set(packets)
    assert [(item.virtual_channel_id, item.lost) for item in reader.channels] == [(1, 0), (5, 1)]
    assert [(item.frames, item.lost) for item in reader.masters] == [(len(frames) - 1, 1)]


def test_idle_frames_and_idle_packets_are_counted_and_left_out():
    maker = Maker("aos", 30)
    packets = [space_packet(2, b"x" * 40)]
    frames = [maker.idle(), *(frame for frame, _ in maker.carry(packets)), maker.idle(), maker.idle()]
    found, _ = taken(frames, [], reader := unframer(maker))
    (channel,) = reader.channels
    assert [packet for packet, _ in found] == packets
    assert (channel.idle, channel.idle_packets, channel.lost) == (3, 1, 0)


def test_a_frame_that_came_before_is_left_out():
    maker = Maker("tc", 40, segments=True)
    packets = [space_packet(2, bytes([number]) * 50) for number in range(3)]
    frames = [frame for frame, _ in maker.carry(packets)]
    found, _ = taken([*frames[:2], frames[1], *frames[2:], *frames[-3:]], [], reader := unframer(maker))
    assert [packet for packet, _ in found] == packets
    assert (reader.channels[0].counts.duplicates, reader.channels[0].lost) == (4, 0)


def test_frames_of_type_b_are_not_counted():
    maker = Maker("tc", 40)
    frames = []
    for number in range(4):
        maker.count = 0
        plain = maker.frame(space_packet(2, bytes([number]) * 9))
        frames.append(bytes([plain[0] | 0x20]) + plain[1:-2])
    found, _ = taken([with_crc(frame) for frame in frames], [2], reader := unframer(maker))
    assert len(found) == 4
    assert (reader.channels[0].has_count, reader.channels[0].counts) == (False, None)


F_PRIME = (
    "20440416001827c0000009000000000000000000003acd",
    "20440416001827c001000901010101010101010101891f",
    "20440416001827c0020009020202020202020202024d48",
)
"""TC frames of Type-B as ``fprime-gds`` 4.4.1 writes them around three packets."""


def test_tc_frames_of_an_independent_package():
    reader = Unframer({PORT: FrameFormat("tc")})
    found, rows = taken([bytes.fromhex(frame) for frame in F_PRIME], [], reader)
    assert [packet.hex() for packet, _ in found] == [frame[10:-4] for frame in F_PRIME]
    assert not any(rows)
    (channel,) = reader.channels
    assert (channel.spacecraft_id, channel.virtual_channel_id, channel.has_count) == (0x44, 1, False)


def test_a_pointer_is_believed_more_than_the_length_of_a_packet():
    maker = Maker("tm", 30)
    wrong = bytearray(space_packet(1, b"a" * 24))
    wrong[5] = 200
    right = [space_packet(1, b"b" * 24), space_packet(1, b"c" * 24)]
    frames = [maker.frame(bytes(wrong)), *(maker.frame(packet) for packet in right)]
    found, rows = taken(frames, [], reader := unframer(maker))
    assert [packet for packet, _ in found] == right
    assert [bool(item & Finding.STREAM_GAP) for item in rows] == [False, True, False]
    assert reader.channels[0].cut == 1


def test_what_is_no_space_packet_is_left_out_up_to_the_next_pointer():
    maker = Maker("aos", 30)
    good = space_packet(1, b"b" * 24)
    frames = [maker.frame(b"\xe0" * 30), maker.frame(good)]
    found, rows = taken(frames, [], reader := unframer(maker))
    assert [packet for packet, _ in found] == [good]
    assert (reader.channels[0].other_packets, reader.channels[0].cut, any(rows)) == (1, 0, False)


def test_other_datagrams_to_the_port_stay_as_they_are():
    maker = Maker("tm", 30)
    reader = unframer(maker)
    batch = batch_of([b"", b"x", bytes(maker.length - 1), b"\x80" * maker.length])
    assert reader.take(batch) is batch
    assert (reader.strange, reader.channels) == (4, [])


def test_channels_are_limited():
    makers = [
        Maker("tc", 9, channel=channel % 64, craft=channel // 64) for channel in range(MOST_CHANNELS + 70)
    ]
    reader = unframer(makers[0])
    found = packets_of(reader.take(batch_of([maker.frame(space_packet(1, b"abc")) for maker in makers])))
    assert (len(reader.channels), reader.left_out, len(found)) == (MOST_CHANNELS, 70, MOST_CHANNELS)


@pytest.mark.parametrize("kind", ["tm", "aos", "tc"])
@given(st.lists(st.binary(max_size=60), max_size=12), st.booleans(), st.booleans())
def test_any_bytes(kind, payloads, fecf, more):
    form = {"segment_header": more} if kind == "tc" else {"length": 40}
    reader = Unframer({PORT: FrameFormat(kind, fecf=fecf, **form)})
    version = b"\x40" if kind == "aos" else b"\x00"
    payloads = [version + item[1:] for item in payloads]
    if kind != "tc":
        payloads = [item.ljust(40, b"\x07")[:40] for item in payloads]
    else:
        payloads = [
            item[:2] + (len(item) - 1).to_bytes(2, "big") + item[4:] for item in payloads if len(item) > 4
        ]
    batch = batch_of(payloads)
    out = reader.take(reader.take(batch))
    own = out.take(out.original_length >= 0)
    assert own.number.tolist() == batch.number.tolist()
    assert np.all((out.offset >= 0) & (out.offset + out.length <= len(out.data)))


def test_a_batch_without_frames_is_the_same_object():
    reader = unframer(Maker("tm", 30))
    batch = batch_of([b"abc"], destination=("10.0.0.1", 1235))
    assert reader.take(batch) is batch


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


FRAME_MAKERS = [
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


@pytest.mark.parametrize("maker", FRAME_MAKERS, ids=lambda item: f"{item.kind}{item.channel}")
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


@pytest.mark.parametrize("maker", FRAME_MAKERS[:4:2], ids=lambda item: item.kind)
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


@given(st.sampled_from(FRAME_MAKERS), st.lists(st.binary(min_size=6, max_size=40), min_size=1, max_size=40))
def test_any_bytes_as_frames(maker, frames):
    found = read(frames, maker)
    ends = np.cumsum([len(frame) for frame in frames])
    starts = ends - [len(frame) for frame in frames]
    fits = found.fits & ~found.idle
    assert (found.start[fits] >= starts[fits]).all()
    assert (found.end[fits] <= ends[fits]).all()
    pointed = fits & (found.first != NO_FIRST)
    assert (found.first[pointed] >= found.start[pointed]).all()
    assert (found.first[pointed] <= found.end[pointed]).all()

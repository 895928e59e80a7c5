"""Packets into frames and out again: whatever the cuts, the losses and the batches."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from transfer_frames import GROUND, Maker, batch_of, packets_of, space_packet, with_crc

from edoras_tools.addons.frames.unframer import MOST_CHANNELS, Unframer
from edoras_tools.model import Finding
from edoras_tools.wire.transfer_frames import FrameFormat

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

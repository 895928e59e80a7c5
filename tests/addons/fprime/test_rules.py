"""Gaps in the counts of F Prime's space packets: bare, in frames, and as its own ground system counts."""

from __future__ import annotations

import struct

import pytest
from fprime_session import ask, own, space, tc, tm, why_not
from hypothesis import given
from hypothesis import strategies as st
from transfer_frames import batch_of

from edoras_tools.addons.fprime.rules import GroundCounts
from edoras_tools.decode import ColumnDecoder, Context

EVENT = struct.pack(">HIHBII", 2, 0x2000001, 2, 0, 7, 8)
CHANNEL = struct.pack(">HIHBIII", 1, 0x1000000, 2, 0, 7, 8, 42)


def followed(*batches):
    """Follow frames; return (APID, to F Prime, packets, missing, duplicates) of each stream."""
    counts, decoder = GroundCounts(), ColumnDecoder(Context())
    for frames in batches:
        batch = batch_of(frames, destination=("127.0.0.1", 50001))
        counts.add(batch, decoder.decode(batch))
    return [
        (item.apid, item.command, item.counts.packets, item.counts.gaps, item.counts.duplicates)
        for item in counts.streams
    ]


def test_each_apid_has_its_own_count():
    frames = [space(EVENT, number) for number in range(20) if number not in {3, 4, 11}]
    frames += [space(CHANNEL, number) for number in range(16380, 16384)] + [space(CHANNEL, 1)]
    assert followed(frames[:5], frames[5:]) == [(2, False, 17, 3, 0), (1, False, 5, 1, 0)]


def test_packets_of_a_lost_or_damaged_frame_are_missing():
    frames = [
        tm(space(EVENT, 2 * number), space(EVENT, 2 * number + 1), space(CHANNEL, number), count=number)
        for number in range(10)
    ]
    wrong = frames[4][:-1] + bytes([frames[4][-1] ^ 1])
    assert followed(frames) == [(2, False, 20, 0, 0), (1, False, 10, 0, 0)]
    assert followed([*frames[:2], *frames[3:4], wrong, *frames[5:]]) == [
        (2, False, 16, 4, 0),
        (1, False, 8, 2, 0),
    ]


def test_a_packet_that_comes_twice_is_not_missing():
    frames = [space(EVENT, number) for number in (0, 1, 1, 2, 3)]
    assert followed(frames) == [(2, False, 5, 0, 1)]


def test_f_primes_own_frames_have_no_count():
    assert followed([own(EVENT)] * 5) == []


@pytest.mark.skipif(bool(why_not()), reason=why_not())
def test_the_ground_system_counts_by_apid():
    command = {"command": "Rover.cmdDisp.CMD_NO_OP", "args": []}
    frames = [bytes.fromhex(item["frames"]["ccsds"]) for item in ask([command] * 12)["send"]]
    assert followed(frames) == [(0, True, 12, 0, 0)]
    assert followed(frames[:3] + frames[5:9], frames[10:]) == [(0, True, 9, 3, 0)]


@given(lost=st.sets(st.integers(1, 58)), first=st.integers(0, 16383), up=st.booleans())
def test_what_is_missing_is_what_was_lost(lost, first, up):
    every = [tc(space(EVENT, (first + number) % 16384, up=True)) for number in range(60)]
    if not up:
        every = [space(EVENT, (first + number) % 16384) for number in range(60)]
    kept = [frame for number, frame in enumerate(every) if number not in lost]
    ((apid, command, packets, missing, _),) = followed(kept)
    assert (apid, command, packets, missing) == (2, up, len(kept), len(lost))


@given(st.lists(st.binary(max_size=60), max_size=6))
def test_any_bytes_are_taken(payloads):
    head = struct.pack(">HHH", 2, 0xC000, 1)
    followed([head + item for item in payloads] + payloads)

"""Streams cut anywhere, with segments lost, doubled and swapped: every whole message is found, and no other.

What is whole is told by the bytes that were captured, without any code under test; only what is before the
first message that was found may be missing.
"""

from __future__ import annotations

import gzip
import random
import struct
from itertools import accumulate
from typing import NamedTuple

import numpy as np
import pytest
import zstandard
from effort import examples
from fprime_session import own, tc, tm
from fprime_session import space as f_prime_packet
from hypothesis import given, settings
from hypothesis import strategies as st
from places import ROOT
from streams import ACK, CLIENT, SERVER, Segment, packet, sbn_message, segments_of
from streams import frames as batch_of
from transfer_frames import Maker, space_packet

from edoras_tools.addons.fprime.link import GroundDataFraming
from edoras_tools.addons.frames.link import TransferFraming
from edoras_tools.io.frames.frame_batch import FrameBatch
from edoras_tools.io.frames.linklayer import Demux
from edoras_tools.model import Finding
from edoras_tools.wire.transfer_frames import FrameFormat

WRAP = 1 << 32
CAPTURES = ("samples/cfs_files/sbn_tcp.pcap.gz", "tests/captures/cfs7/two_tcp.pcap.zst")


class Sent(NamedTuple):
    """What one end of a connection sent: its messages, by the sequence number of their first byte."""

    first: int
    messages: list[bytes]

    def whole(self, captured):
        """Return which messages were captured whole, of ranges of sequence number and length, in order."""
        edges = [0, *accumulate(map(len, self.messages))]
        there = np.zeros(edges[-1] + 1, bool)
        for sequence, length in captured:
            at = (sequence - self.first + WRAP // 2) % WRAP - WRAP // 2
            there[max(at, 0) : max(at + length, 0)] = True
        places = zip(edges, edges[1:], self.messages, strict=False)
        return {(self.first + at) % WRAP: data for at, end, data in places if there[at:end].all()}


def segment_of(frame):
    """Return the ends of a segment, the sequence number of its data, and the data; Ethernet and IPv4."""
    size, total = (frame[14] & 15) * 4, int.from_bytes(frame[16:18], "big")
    tcp = frame[14 + size : 14 + total]
    ports = struct.unpack_from(">HHI", tcp)
    return (
        (frame[26:30], ports[0], frame[30:34], ports[1]),
        ports[2] + (tcp[13] >> 1 & 1),
        tcp[tcp[12] >> 4 << 2 :],
    )


def judge(sent, batch, framings=None):
    """Hold what is found in frames to what was sent, by the ends of each direction."""
    demux = Demux()
    if framings is not None:
        demux.framings = framings
    found = [demux.demux(batch), demux.finish()]
    rows = [item[row] for item in found if item is not None for row in range(len(item))]
    captured: dict[object, list[tuple[int, int]]] = {}
    for at, size in zip(batch.offset.tolist(), batch.length.tolist(), strict=True):
        key, sequence, data = segment_of(batch.data[at : at + size].tobytes())
        captured.setdefault(key, []).append((sequence, len(data)))
    got: dict[object, dict[int, bytes]] = {key: {} for key in sent}
    for row in rows:
        if Finding.FRAGMENT not in row.findings:
            key, sequence, data = segment_of(row.frame)
            assert sequence not in got[key], "a message came twice"
            got[key][sequence] = data
    total = 0
    for key, way in sent.items():
        whole = way.whole(captured.get(key, ()))
        assert got[key].items() <= whole.items(), "no message that is not there"
        behind = sorted((at - way.first) % WRAP for at in whole)
        first = min(((at - way.first) % WRAP for at in got[key]), default=WRAP)
        assert sorted((at - way.first) % WRAP for at in got[key]) == [at for at in behind if at >= first]
        total += len(got[key])
    return total


def damaged(chance, items):
    """Return a part of what was captured, with losses, doubles, and neighbours swapped."""
    first = chance.randrange(len(items) * 3 // 4)
    last = chance.randrange(first, len(items))
    rate = chance.choice([0.01, 0.05, 0.2])
    out = []
    for item in items[first : last + 1]:
        if chance.random() < rate:
            continue
        out += [item] * (2 if chance.random() < rate else 1)
        if chance.random() < rate:
            out.insert(max(len(out) - chance.randrange(1, 6), 0), out.pop())
    return out


def captured(path):
    """Return the frames with TCP in a capture with microseconds, their times, and what each end sent."""
    raw = path.read_bytes()
    raw = gzip.decompress(raw) if path.suffix == ".gz" else zstandard.decompress(raw, max_output_size=1 << 26)
    at, items, streams = 24, [], {}
    while at < len(raw):
        seconds, micro, size, _ = struct.unpack_from("<IIII", raw, at)
        frame, at = raw[at + 16 : at + 16 + size], at + 16 + size
        if frame[23] == 6:
            items.append((seconds * 10**9 + micro * 1000, frame))
            key, sequence, data = segment_of(frame)
            if data:
                streams.setdefault(key, {})[sequence] = data
    sent = {}
    for key, parts in streams.items():
        first, stream, messages = min(parts), b"", []
        for sequence in sorted(parts):
            stream += parts[sequence][first + len(stream) - sequence :]
        while stream:
            size = 11 + int.from_bytes(stream[:2], "big")
            messages, stream = [*messages, stream[:size]], stream[size:]
        sent[key] = Sent(first, messages)
    return items, sent


@pytest.mark.quick("samples*")
@pytest.mark.parametrize("path", CAPTURES)
def test_a_real_capture_with_damage(path):
    items, sent = captured(ROOT / path)
    found = 0
    for seed in range(examples(100, 5)):
        chosen = damaged(random.Random(seed), items)
        length = np.array([len(frame) for _, frame in chosen], np.int32)
        batch = FrameBatch(
            np.frombuffer(b"".join(frame for _, frame in chosen), np.uint8),
            np.arange(1, len(chosen) + 1),
            np.sort(np.array([time for time, _ in chosen], np.int64)),
            np.ones(len(chosen), np.uint16),
            np.cumsum(length, dtype=np.int64) - length,
            length,
            length,
        )
        found += judge(sent, batch)
    assert found > 1000


def floats(numbers):
    """Return values as packets hold them; those of 5.0, 80.0 and 1.25 look like SBN heartbeats."""
    return struct.pack(f"<{len(numbers)}f", *numbers)


VALUES = st.lists(st.sampled_from([0.0, 1.25, 5.0, 80.0, -1.5, 0.1]), max_size=30)
SBN_MESSAGE = st.one_of(
    st.just(sbn_message(0xA0, b"")),
    st.just(sbn_message(4, b"\x0b")),
    st.builds(lambda values: sbn_message(3, packet(0x1827, 1, floats(values))), VALUES),
    st.builds(lambda pad: sbn_message(3, packet(0x827, 2, bytes(pad))), st.integers(0, 40)),
)
OWN_FRAME = st.one_of(st.just(b"sitting well"), st.binary(max_size=60).map(lambda body: own(b"\0\1" + body)))
COMMAND_FRAME = st.binary(max_size=60).map(lambda body: tc(f_prime_packet(b"\0\0" + body, up=True)))


def numbered_frames(kind):
    """Return a strategy: the frames of one channel."""
    bodies = st.lists(st.binary(min_size=1, max_size=50), min_size=6, max_size=30)
    if kind == "tm of F Prime":
        return bodies.map(
            lambda items: [tm(f_prime_packet(b"\0\1" + it), count=n, size=300) for n, it in enumerate(items)]
        )
    return bodies.map(
        lambda items: [frame for frame, _ in Maker(kind, 40).carry([space_packet(5, it) for it in items])]
    )


STREAMS = {
    "sbn": (st.lists(SBN_MESSAGE, min_size=6, max_size=40), None),
    "fprime": (st.lists(OWN_FRAME, min_size=6, max_size=40), GroundDataFraming()),
    "tc of F Prime": (st.lists(COMMAND_FRAME, min_size=6, max_size=30), GroundDataFraming()),
    "tm of F Prime": (numbered_frames("tm of F Prime"), GroundDataFraming(300)),
    "tm": (numbered_frames("tm"), TransferFraming(FrameFormat("tm", 48))),
    "aos": (numbered_frames("aos"), TransferFraming(FrameFormat("aos", 50))),
    "tc": (numbered_frames("tc"), TransferFraming(FrameFormat("tc"))),
}


@pytest.mark.quick("sbn", "fprime", "tm")
@pytest.mark.parametrize("name", STREAMS)
@given(data=st.data())
@settings(max_examples=examples(100))
def test_any_stream_with_damage(name, data):
    drawn, framing = STREAMS[name]
    messages, chance = data.draw(drawn), random.Random(data.draw(st.integers(0, 1 << 32)))
    stream, first = b"".join(messages), data.draw(st.sampled_from([1000, WRAP - 500]))
    edges = list(accumulate(map(len, messages)))
    cuts = chance.sample(edges, len(edges) // 2) + chance.sample(range(1, len(stream)), chance.randrange(20))
    items = []
    for segment in segments_of(stream, cuts, first):
        items.append(segment)
        if segment.data and chance.random() < 0.5:
            reached = segment.sequence + len(segment.data)
            items.append(Segment(5, b"", ACK, reached, SERVER, CLIENT))
    sent = {segment_of(items[0].frame())[0]: Sent(first, messages)}
    judge(sent, batch_of(damaged(chance, items)), framing and {SERVER[1]: framing})

"""One frame of many datagrams: what is made of it is judged by the demultiplexer and by plain arithmetic."""

from __future__ import annotations

import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from edoras_tools.io.frames.build import frames_of
from edoras_tools.io.frames.frame_batch import FrameBatch
from edoras_tools.io.frames.linklayer import demux
from edoras_tools.io.frames.segments import cut
from edoras_tools.model import Endpoint, Finding
from edoras_tools.wire.arrays.window import PADDING

HOSTS = {4: ("10.0.0.1", "10.0.0.2"), 6: ("fd00::1", "fd00::2")}


def total(octets):
    """The Internet checksum's sum (RFC 1071): 0xFFFF over anything that carries its right checksum."""
    octets += bytes(len(octets) % 2)
    value = sum(struct.unpack(f">{len(octets) // 2}H", octets))
    while value >> 16:
        value = (value & 0xFFFF) + (value >> 16)
    return value


def captured(*datagrams, version=4, link=b"", captured=None):
    """Frames of payloads, the link header before each, of which so many bytes were captured."""
    ends = [Endpoint(host, 1000 + place) for place, host in enumerate(HOSTS[version])]
    made = [frames_of([(7, *ends, payload)]) for payload in datagrams]
    frames = [link + item.data[item.offset[0] :][: item.length[0]].tobytes() for item in made]
    kept = [frame[:captured] for frame in frames]
    length = np.array([len(frame) for frame in kept], np.int32)
    return FrameBatch(
        np.frombuffer(b"".join(kept) + b"\xa5" * PADDING, np.uint8),
        np.arange(5, 5 + len(kept)),
        np.arange(len(kept)) + 100,
        np.full(len(kept), 1 if link else 101, np.uint16),
        np.cumsum(length, dtype=np.int64) - length,
        length,
        np.array([len(frame) for frame in frames], np.int32),
    )


def payloads(batch):
    return [batch[row].payload for row in range(len(batch))]


@pytest.mark.parametrize("version", [4, 6])
@pytest.mark.parametrize("tag", [b"", b"\x81\x00\x00\x07"])
def test_a_frame_of_many_is_cut_and_the_others_stay(version, tag):
    link = bytes(12) + tag + {4: b"\x08\x00", 6: b"\x86\xdd"}[version]
    big = bytes(range(250)) * 10
    frames = captured(b"before", big, b"after", version=version, link=link)
    parts = cut(frames, np.array([0, 600, 0]), np.full(3, 20 if version == 4 else 40))
    assert parts.number.tolist() == list(range(5, 12))
    assert parts.time_ns.tolist() == [100, *[101] * 5, 102]
    batch = demux(parts)
    assert payloads(batch) == [b"before", *(big[at : at + 600] for at in range(0, 2500, 600)), b"after"]
    assert not batch.capture_findings.any()
    for row in range(1, 6):
        frame = batch[row].frame
        assert frame.startswith(link)
        packet = frame[len(link) :]
        head, addresses = (20, packet[12:20]) if version == 4 else (40, packet[8:40])
        pseudo = addresses + struct.pack(">HH", 17, len(packet) - head)
        assert total(pseudo + packet[head:]) == 0xFFFF
        if version == 4:
            assert total(packet[:20]) == 0xFFFF
            assert struct.unpack_from(">HH", packet, 2) == (len(packet), row - 1)
        else:
            assert struct.unpack_from(">H", packet, 4) == (len(packet) - 40,)


def test_of_a_cut_off_frame_the_parts_are_cut_off():
    frames = captured(b"a" * 1000, captured=28 + 450)
    batch = demux(cut(frames, np.array([200]), np.array([20])))
    assert [len(item) for item in payloads(batch)] == [200, 200, 50, 0, 0]
    assert (batch.capture_findings != 0).tolist() == [False, False, True, True, True]
    assert batch.capture_findings[2] == Finding.CAPTURE_CUT
    assert batch.original_length.tolist() == [228] * 5


def test_what_is_one_datagram_or_no_udp_stays():
    frames = captured(b"x" * 200, b"y" * 10)
    broken = np.array(frames.data)
    broken[frames.offset[1]] = 0
    frames = FrameBatch(broken, *(getattr(frames, name) for name in FrameBatch.__struct_fields__[1:]))
    parts = cut(frames, np.array([200, 4]), np.array([20, 20]))
    assert parts.length.tolist() == frames.length.tolist()
    assert cut(frames, np.zeros(2, int), np.zeros(2, int)) is frames
    inner = cut(frames, np.array([50, 0]), np.array([20 + 8 + 20, 0]))
    assert inner.length.tolist() == frames.length.tolist(), "what is cut in a tunnel stays whole"


@given(
    st.binary(max_size=300),
    st.integers(1, 400),
    st.sampled_from([1, 101, 113, 276]),
    st.integers(0, 300),
    st.sampled_from([20, 40]),
)
def test_any_frame_of_any_size_keeps_its_bytes(data, size, link_type, beyond, header):
    frames = FrameBatch(
        np.frombuffer(data + bytes(PADDING), np.uint8),
        np.array([1]),
        np.array([0]),
        np.array([link_type], np.uint16),
        np.array([0]),
        np.array([len(data)], np.int32),
        np.array([len(data) + beyond], np.int32),
    )
    whole, parts = demux(frames), demux(cut(frames, np.array([size]), np.array([header])))
    if len(whole):
        assert b"".join(payloads(parts)).startswith(b"".join(payloads(whole)))

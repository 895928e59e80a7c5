"""Packets and frames of F Prime for tests: those of the sample, some that are not right, and any."""

import struct
from contextlib import closing

from fprime_session import CAPTURE, own, space, tc, tm
from hypothesis import strategies as st

from edoras_tools.decode import Context, Dissector
from edoras_tools.io.formats.open import open_file


def packets_of_sample():
    """Return the F Prime packets of the sample."""
    with closing(open_file(CAPTURE)) as source:
        (batch,) = source.batches()
    found = []
    for index in range(len(batch)):
        decoded = Dissector(Context()).dissect(batch[index])
        data = batch[index].payload
        for layer in decoded.layers:
            if layer.name == "fprime_space_packet":
                end = layer.end + layer.values()["packet_data_length"] + 1
                found.append(data[layer.end : end])
    return found


PACKETS = packets_of_sample()
EVENT = struct.pack(">HIHBII", 2, 0x2000001, 2, 0, 7, 8)
COUNT = struct.pack(">IHBII", 0x1000000, 2, 0, 7, 8) + struct.pack(">I", 42)
TELEMETRY = struct.pack(">H", 1) + COUNT
BAD = {
    "a wrong CRC-32": (own(EVENT)[:-1] + b"\0", ["checksum_bad"], 1),
    "a wrong CRC-16": (tc(space(EVENT, up=True))[:-1] + b"\0", ["checksum_bad"], 1),
    "bytes behind the frame": (own(EVENT) + b"more", ["length_mismatch"], 1),
    "a length of 2^31": (struct.pack(">II", 0xDEADBEEF, 1 << 31) + EVENT, ["truncated"], 0),
    "a frame that is cut": (own(EVENT)[:-1], ["truncated"], 0),
    "a frame of its start word": (own(EVENT)[:4], ["truncated"], 0),
    "an empty packet": (own(b""), ["truncated"], 0),
    "a packet without its time": (own(EVENT[:10]), ["truncated"], 0),
    "an event that the dictionary has not": (own(EVENT[:2] + b"\x09" + EVENT[3:]), ["unknown_msg_id"], 0),
    "an event with bytes too many": (own(EVENT + b"xyz"), ["length_mismatch"], 1),
    "a channel that is cut": (own(TELEMETRY[:-1]), ["struct_length"], 0),
    "a second channel that is not there": (own(TELEMETRY + COUNT[:9]), ["struct_length"], 1),
    "a text that is longer than its bytes": (
        own(struct.pack(">HIH", 0, 0x1000001, 30) + b"hello"),
        ["struct_length"],
        0,
    ),
    "a text that is longer than it may be": (
        own(struct.pack(">HIH", 0, 0x1000001, 41) + b"a" * 41),
        ["struct_length"],
        0,
    ),
    "arguments too many": (own(struct.pack(">HI", 0, 0x1000000) + b"1"), ["length_mismatch"], 1),
    "a file": (own(struct.pack(">HBI", 3, 0, 0) + b"data"), [], 0),
    "another packet type": (own(struct.pack(">H", 77)), [], 0),
    "a space packet over the end of its frame": (
        tm(space(EVENT), space(bytes(900)), size=200),
        ["truncated"],
        1,
    ),
    "a frame in which no packet starts": (tm(space(EVENT), first=0x7FF), [], 0),
    "a frame that begins with the rest of a packet": (tm(b"rest", space(EVENT), first=4), [], 1),
    "two events": (own(EVENT + EVENT[2:]), [], 2),
    "a space packet without a frame": (space(EVENT), [], 1),
    "a space packet that says another packet type": (tc(space(EVENT, apid=1)), [], 1),
}


@st.composite
def any_frames(draw):
    """Frames with a few bytes changed, cut or added, some with the right check again."""
    packet = bytearray(draw(st.sampled_from([*PACKETS, EVENT, TELEMETRY, TELEMETRY + COUNT])))
    for _ in range(draw(st.integers(0, 2))):
        packet[draw(st.integers(0, len(packet) - 1))] = draw(st.integers(0, 255))
    packet = bytes(packet[: draw(st.integers(0, len(packet)) | st.just(len(packet)))])
    packet += draw(st.binary(max_size=5))
    kind = draw(st.integers(0, 4))
    if kind == 0:
        return draw(st.binary(max_size=60))
    frame = bytearray(
        own(packet)
        if kind == 1
        else tc(space(packet or b"\0\0", apid=draw(st.sampled_from([0, 2, 0x7FF]))))
        if kind == 2
        else space(packet or b"\0\0")
        if kind == 3
        else tm(space(packet or b"\0\0", apid=2), space(EVENT), size=400)
    )
    if draw(st.booleans()):
        frame[draw(st.integers(0, min(len(frame) - 1, 20)))] = draw(st.integers(0, 255))
    return bytes(frame[: draw(st.integers(0, len(frame)) | st.just(len(frame)))])

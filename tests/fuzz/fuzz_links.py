"""More of what is fuzzed: TCP streams, CFDP, RACS2, transfer frames, F Prime and its dictionary."""

from __future__ import annotations

import struct
import sys
from pathlib import Path
from typing import TYPE_CHECKING

sys.path.insert(0, str(Path(__file__).parents[1] / "support"))

from fprime_session import DICTIONARY, own, space, tc, tm
from pdus import eof, finished, metadata, nak, piece, with_crc
from racs2_peer import Talk, to_cfs, to_ros
from streams import Segment, frames, sbn_messages
from transfer_frames import Maker, batch_of, space_packet

from edoras_tools.addons.cfdp.transactions import FileEvidence
from edoras_tools.addons.frames.unframer import Unframer
from edoras_tools.decode import ColumnDecoder, Context, Dissector
from edoras_tools.diagnosis.examination import Examination
from edoras_tools.errors import ConfigError
from edoras_tools.io.frames.linklayer import Demux
from edoras_tools.io.topics.messages import lay_out
from edoras_tools.io.topics.streams import Streams
from edoras_tools.mission import loads
from edoras_tools.ros import TypeStore
from edoras_tools.structs import Structs
from edoras_tools.structs.files import load_layout, parse_layout

if TYPE_CHECKING:
    from collections.abc import Callable, Hashable

    from edoras_tools.model import PacketBatch

TYPES = TypeStore()
MISSION = loads(
    {
        "links.yaml": b"""\
link:
  ros__parameters:
    cfdp: {msg_ids: [0x18C8, 0x8C2]}
    frames:
      a: {port: 5301, kind: tm, length: 48}
      b: {port: 5302, kind: aos, length: 58, insert_zone: 4, ocf: true}
      c: {port: 5303, kind: tc, segment_header: true}
      d: {port: 5304, kind: tm, length: 46, transport: tcp, fecf: false}
      e: {port: 5305, kind: aos, length: 58, insert_zone: 4, ocf: true, transport: tcp}
      f: {port: 50000, kind: tm, length: 300, transport: tcp, link: fprime}
"""
    }
)
STRUCTS = Structs([load_layout(DICTIONARY)])
STREAM_PORTS = (2234, 8765, 50000, 50001, 5304, 5305)
DATAGRAM_PORTS = (5111, 1234, 1235, 50000, 5301, 5302, 5303)
EVENT = struct.pack(">HIHBII", 2, 0x2000001, 2, 0, 7, 8)


def _whole(batches: list[PacketBatch], context: Context) -> Hashable:
    """All that is made of batches: both readers agree, and what is counted or written can be."""
    decoder, dissector, follower = (
        ColumnDecoder(context),
        Dissector(context),
        FileEvidence(msg_ids=(0x18C8, 0x8C2)),
    )
    examination, unframer = Examination(context), Unframer(context.frames)
    topics: dict[str, int] = {}
    streams = Streams(
        MISSION, TYPES, structs=STRUCTS, add=lambda topic: topics.setdefault(topic.name, 100 + len(topics))
    )
    shown = set()
    for raw in batches:
        batch = unframer.take(raw)
        if not len(batch):
            continue
        columns = decoder.decode(batch)
        for row in range(len(batch)):
            decoded = dissector.dissect(batch[row])
            assert decoded.link == columns.link[row], "columns and stack differ in link"
            assert int(decoded.findings) == columns.findings[row], "columns and stack differ in findings"
            shown.add(
                (decoded.link.label, int(decoded.findings), decoded.layers[-1].name if decoded.layers else "")
            )
        follower.add(batch, columns)
        examination.add(batch, columns)
        lay_out(streams.messages(batch, columns), len(batch))
    found = examination.diagnose()
    assert all(verdict.start_ns <= verdict.end_ns for verdict in found.verdicts)
    states = tuple(sorted({item.state for item in follower.transactions}))
    return frozenset(shown), states, frozenset(item.rule for item in found.verdicts), len(topics)


def stream(data: bytes) -> Hashable:
    """Bytes of both directions of a TCP connection: a port, how it is cut, where the other side's begin."""
    port = STREAM_PORTS[(data[0] if data else 0) % len(STREAM_PORTS)]
    step = 1 + (data[1] if len(data) > 1 else 0) * 8
    first, _, second = data[2:20_000].partition(SPLIT)
    ends = ("10.0.0.1", 40000), ("10.0.0.2", port)
    segments = [
        Segment(99, flags=2, destination=ends[1]),
        Segment(499, flags=18, source=ends[1], destination=ends[0]),
    ]
    for octets, begin, (source, destination) in ((first, 100, ends), (second, 500, ends[::-1])):
        segments += [
            Segment(begin + at, octets[at : at + step], source=source, destination=destination)
            for at in range(0, len(octets), max(step, len(octets) // 40))
        ]
    context = Context(MISSION, TYPES, structs=STRUCTS)
    demux = Demux()
    demux.framings = context.framings
    batches = [demux.demux(frames(segments))]
    rest = demux.finish()
    return port, _whole([*batches, *([rest] if rest is not None else [])], context)


def datagrams(data: bytes) -> Hashable:
    """Datagrams to the port of one of the other links, each behind its length in two bytes."""
    port = DATAGRAM_PORTS[(data[0] if data else 0) % len(DATAGRAM_PORTS)]
    payloads, at = [], 1
    while at + 2 <= len(data) and len(payloads) < 30:
        (size,) = struct.unpack_from("<H", data, at)
        payloads.append(data[at + 2 : at + 2 + size][:60_000])
        at += 2 + size
    context = Context(MISSION, TYPES, structs=STRUCTS)
    return port, _whole([batch_of(payloads, destination=("10.0.0.1", port))] if payloads else [], context)


def dictionary(data: bytes) -> Hashable:
    """A dictionary of F Prime: its entries, or all of its mistakes, a line each."""
    try:
        layout = parse_layout(data, "fuzz.json")
        made = Structs([layout])
        entries = len(layout.entries or ())
        assert made.dictionary is None or made.types is not None
    except ConfigError as error:
        text = str(error).split("\n", 1)[0]
        assert text
        return "".join(letter for letter in text.rpartition(": ")[2][:30] if not letter.isdigit())
    return entries


SPLIT = b"\0other side\0"
"""Between the two directions of a stream."""
TARGETS: dict[str, Callable[[bytes], Hashable]] = {
    "stream": stream,
    "datagrams": datagrams,
    "dictionary": dictionary,
}


def _lengths(port: int, payloads: list[bytes]) -> bytes:
    parts = [struct.pack("<H", len(item)) + item for item in payloads]
    return bytes([DATAGRAM_PORTS.index(port)]) + b"".join(parts)


def seeds() -> dict[str, dict[str, bytes]]:
    """Return inputs by target and name."""
    content = bytes(range(90))
    file = [metadata(90), piece(0, content[:50]), piece(60, content[60:]), eof(content), nak((50, 60))]
    file += [piece(50, content[50:60]), piece(50, content[50:60]), finished()]
    checked = [with_crc(item) for item in file]
    checked[1] = checked[1][:-1] + b"?"
    packets = [space_packet(0x27, bytes([number]) * 30, number) for number in range(4)]
    makers = {5301: Maker("tm", 40), 5302: Maker("aos", 40, insert=b"zone", ocf=True)}
    makers[5303] = Maker("tc", 40, segments=True)
    framed = {port: [frame for frame, _ in maker.carry(packets)] for port, maker in makers.items()}
    talk = Talk()
    for item in (to_ros("/a/b", b"\x32\x05hello"), to_ros("c", bytes(128))):
        talk.cfs.send_binary(item)
    talk.ros.send_binary(to_cfs(0x1894, b"\x52\x08" + struct.pack("<d", 1.5)))
    talk.pass_on()
    small = {"tm": [tm(space(EVENT, number), count=number, size=300) for number in (0, 1, 3)]}
    up = [tc(space(EVENT, number, up=True)) for number in range(3)]
    in_packets = [struct.pack(">HHHBB", 0x18C8, 0xC000, len(item) + 1, 0, 0) + item for item in file]
    others = {5304: [frame for frame, _ in Maker("tm", 40, fecf=False).carry(packets)]}
    others[5305] = [frame for frame, _ in Maker("aos", 40, insert=b"zone", ocf=True).carry(packets)]

    def streamed(port: int, step: int, there: bytes, back: bytes = b"") -> bytes:
        return bytes([STREAM_PORTS.index(port), step]) + there + SPLIT + back

    return {
        "datagrams": {
            "cfdp": _lengths(5111, file),
            "cfdp_crc": _lengths(5111, checked),
            "cfdp_packets": _lengths(1234, in_packets),
            "fprime_own": _lengths(50000, [own(EVENT)] * 2),
            "fprime_spaces": _lengths(50000, [space(EVENT, number) for number in (0, 1, 4)]),
            "fprime_tm": _lengths(50000, small["tm"]),
            "fprime_tc": _lengths(50000, up),
            **{f"frames_{port}": _lengths(port, items) for port, items in framed.items()},
            "frames_lost": _lengths(5301, framed[5301][:1] + framed[5301][2:]),
        },
        "stream": {
            "sbn": streamed(2234, 8, b"".join(sbn_messages(8)), b"".join(sbn_messages(3))),
            "racs2": streamed(8765, 20, *talk.streams),
            "fprime": streamed(50000, 30, b"".join(small["tm"]), b"".join(up)),
            "fprime_own": streamed(50001, 3, own(EVENT) * 3, b"sitting well" + own(EVENT)),
            "tm": streamed(5304, 4, b"".join(others[5304])),
            "aos": streamed(5305, 4, b"", b"".join(others[5305])),
        },
        "dictionary": {
            "rover": DICTIONARY.read_bytes(),
            "short": b'{"metadata": {}, "typeDefinitions": [], "commands": []}',
            "other": b"structs: {}",
        },
    }

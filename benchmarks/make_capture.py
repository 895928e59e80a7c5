"""Write a large capture of mixed CI, TO and SBN traffic, made of the sample captures' own datagrams.

They come round and round, each with a time, a sequence count and an IP identification of its own. With
``--tcp``, this share of the frames is SBN over TCP, the same messages: most alone in a segment, one in ten
cut in two.

Run: python benchmarks/make_capture.py FILE [PACKETS] [--cfdp PERCENT] [--tcp PERCENT] [--sbn]
"""

from __future__ import annotations

import argparse
import struct
from collections import defaultdict
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING

from edoras_tools.addons.cfdp import link as cfdp
from edoras_tools.ros import TypeStore
from edoras_tools.wire.envelope import DEFAULT

if TYPE_CHECKING:
    from collections.abc import Iterator

SAMPLES = Path(__file__).parents[1] / "samples" / "captures"
STEP_US = 100
PAYLOAD, SBN_HEADER, SBN_APP = 42, 11, 3
SBN_PORTS = {2234, 2235, 2236}


def frames() -> list[tuple[bytearray, int, bytes]]:
    """Return the frames of the sample captures that belong to a link.

    Each comes with where its sequence word is, 0 where it has none that counts, and whose count that is.
    """
    found = []
    for path in sorted(SAMPLES.glob("*.pcap")):
        data, at = path.read_bytes(), 24
        while at < len(data):
            length = struct.unpack_from("<I", data, at + 8)[0]
            frame = bytearray(data[at + 16 : at + 16 + length])
            port = struct.unpack_from(">H", frame, 36)[0]
            if port in {1234, 1235, *SBN_PORTS}:
                network = port in SBN_PORTS
                start = PAYLOAD + SBN_HEADER * network
                packet = len(frame) >= start + 6 and (not network or frame[PAYLOAD + 2] == SBN_APP)
                counts = packet and frame[start + 2] & 0xC0
                owner = bytes(frame[34:38]) + bytes(frame[start : start + 2])
                found.append((frame, start + 2 if counts else 0, owner))
            at += 16 + length
    return found


def transfers() -> Iterator[bytes]:
    """Yield frames of one file after the other, as EDORAS's ``data_transfer`` sends laser scans: class 1."""
    scan = TypeStore().encode("sensor_msgs/msg/LaserScan", {"ranges": [1.5] * 7000})
    content = DEFAULT.emit(scan)
    head = (
        bytes(12) + struct.pack(">HBBHHHBBH", 0x800, 0x45, 0, 0, 0, 0, 64, 17, 0) + bytes([127, 0, 0, 1]) * 2
    )
    for number in count(1):
        told = cfdp.PDU_LAYOUTS[0][cfdp.Directive.METADATA].emit({"file_size": len(content)})
        total = {"file_checksum": cfdp.modular_checksum(content, 0), "file_size": len(content)}
        field = [bytes([cfdp.Directive.METADATA]) + told + b"\x04scan\x04scan"]
        field += [struct.pack(">I", at) + content[at : at + 1000] for at in range(0, len(content), 1000)]
        field += [
            bytes([cfdp.Directive.EOF]) + cfdp.PDU_LAYOUTS[0][cfdp.Directive.EOF].emit(total),
        ]
        for place, body in enumerate(field):
            piece = 0 < place < len(field) - 1
            values = {"pdu_type": piece, "transmission_mode": 1, "sequence_number_length": 3}
            pdu = cfdp.PDU_HEADER.emit({**values, "version": 1, "pdu_data_field_length": len(body)})
            payload = pdu + struct.pack(">BIB", 1, number, 2) + body
            udp = struct.pack(">HHHH", 5111, 5222, 8 + len(payload), 0) + payload
            yield head[:16] + struct.pack(">H", 20 + len(udp)) + head[18:] + udp


def is_message(frame: bytearray) -> bool:
    """Return whether it holds an SBN message of the size that its header says."""
    size = len(frame) - PAYLOAD - SBN_HEADER
    network = struct.unpack_from(">H", frame, 36)[0] in SBN_PORTS
    return network and size >= 0 and struct.unpack_from(">h", frame, PAYLOAD)[0] == size


class Streams:
    """SBN messages of some datagrams as TCP segments, one direction a connection."""

    def __init__(self, pool: list[tuple[bytearray, int, bytes]]) -> None:
        self._pool = [item for item in pool if is_message(item[0])]
        self._next: dict[bytes, int] = defaultdict(int)
        self._turn = 0
        self._waiting: list[bytes] = []

    def frame(self, counts: dict[bytes, int]) -> bytes:
        """Return the next frame."""
        if not self._waiting:
            datagram, at, owner = self._pool[self._turn % len(self._pool)]
            self._turn += 1
            if at:
                struct.pack_into(">H", datagram, at, 0xC000 | counts[owner] & 0x3FFF)
                counts[owner] += 1
            message = bytes(datagram[PAYLOAD:])
            cut = len(message) // 2 if self._turn % 10 == 0 else len(message)
            self._waiting = [self._segment(datagram, part) for part in (message[:cut], message[cut:]) if part]
        return self._waiting.pop(0)

    def _segment(self, datagram: bytearray, data: bytes) -> bytes:
        ends = bytes(datagram[26:38])
        tcp = ends[8:] + struct.pack(">IIBBHHH", self._next[ends] & 0xFFFFFFFF, 1, 5 << 4, 24, 65535, 0, 0)
        self._next[ends] += len(data)
        head = struct.pack(">BBHHHBBH", 0x45, 0, 40 + len(data), 0, 0, 64, 6, 0) + ends[:8]
        return bytes(datagram[:14]) + head + tcp + data


def main() -> None:
    """Write the file."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("path", type=Path)
    parser.add_argument("packets", type=int, nargs="?", default=1_000_000)
    parser.add_argument("--cfdp", type=int, default=0, help="percent of the packets that are CFDP")
    parser.add_argument("--tcp", type=int, default=0)
    parser.add_argument("--sbn", action="store_true", help="nine frames of ten are of SBN")
    options = parser.parse_args()
    pool = frames()
    if options.sbn:
        network = [item for item in pool if struct.unpack_from(">H", item[0], 36)[0] in SBN_PORTS]
        pool = network + [item for item in pool if item not in network][: len(network) // 9]
    streams = Streams(pool)
    counts: dict[bytes, int] = defaultdict(int)
    sent: dict[bytes, int] = defaultdict(int)
    files = transfers()
    with options.path.open("wb") as file:
        file.write(struct.pack("<IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 262144, 1))
        for number in range(options.packets):
            frame, at, owner = pool[number % len(pool)]
            if number % 100 < options.cfdp:
                frame, at = next(files), 0
            if number % 100 < options.tcp:
                frame, at = streams.frame(counts), 0
            if at:
                struct.pack_into(">H", frame, at, 0xC000 | counts[owner] & 0x3FFF)
                counts[owner] += 1
            if frame[18:20] != bytes(2):  # as a kernel counts: the same one twice would be the same datagram
                ends = bytes(frame[26:38])
                sent[ends] += 1
                struct.pack_into(">H", frame, 18, sent[ends] % 0xFFFF + 1)
            second, microsecond = divmod(1_795_241_000_000_000 + number * STEP_US, 1_000_000)
            file.write(struct.pack("<IIII", second, microsecond, len(frame), len(frame)) + frame)


if __name__ == "__main__":
    main()

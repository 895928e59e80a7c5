"""Write a large capture of mixed CI, TO and SBN traffic, made of the sample captures' own datagrams.

They come round and round, each with the time and the sequence count that it would have had.

Run: python benchmarks/make_capture.py FILE [PACKETS]
"""

from __future__ import annotations

import argparse
import struct
from collections import defaultdict
from pathlib import Path

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


def main() -> None:
    """Write the file."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("path", type=Path)
    parser.add_argument("packets", type=int, nargs="?", default=1_000_000)
    options = parser.parse_args()
    pool = frames()
    counts: dict[bytes, int] = defaultdict(int)
    with options.path.open("wb") as file:
        file.write(struct.pack("<IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 262144, 1))
        for number in range(options.packets):
            frame, at, owner = pool[number % len(pool)]
            if at:
                struct.pack_into(">H", frame, at, 0xC000 | counts[owner] & 0x3FFF)
                counts[owner] += 1
            second, microsecond = divmod(1_795_241_000_000_000 + number * STEP_US, 1_000_000)
            file.write(struct.pack("<IIII", second, microsecond, len(frame), len(frame)) + frame)


if __name__ == "__main__":
    main()

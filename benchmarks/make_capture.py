"""Write a large capture of mixed CI, TO and SBN traffic, made of the sample captures' own datagrams.

Run: python benchmarks/make_capture.py FILE [PACKETS]
"""

from __future__ import annotations

import struct
import sys
from pathlib import Path

SAMPLES = Path(__file__).parents[1] / "samples" / "captures"
STEP_US = 100


def frames() -> list[bytes]:
    """Return the frames of all sample captures that belong to a link, as recorded."""
    found = []
    for path in sorted(SAMPLES.glob("*.pcap")):
        data, at = path.read_bytes(), 24
        while at < len(data):
            length = struct.unpack_from("<I", data, at + 8)[0]
            frame = data[at + 16 : at + 16 + length]
            if struct.unpack_from(">H", frame, 36)[0] in {1234, 1235, 2234, 2235, 2236}:
                found.append(frame)
            at += 16 + length
    return found


def main() -> None:
    """Write the file."""
    path, packets = Path(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else 1_000_000
    pool = frames()
    with path.open("wb") as file:
        file.write(struct.pack("<IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 262144, 1))
        for number in range(packets):
            frame = pool[number % len(pool)]
            second, microsecond = divmod(1_795_241_000_000_000 + number * STEP_US, 1_000_000)
            file.write(struct.pack("<IIII", second, microsecond, len(frame), len(frame)) + frame)


if __name__ == "__main__":
    main()

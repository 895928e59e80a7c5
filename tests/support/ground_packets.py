"""What the independent readers of our ground descriptions are asked: samples, and packets of C structs."""

from __future__ import annotations

import struct

from places import CAPTURES, MISSIONS, SAMPLE_MISSIONS

from edoras_tools.io.formats.open import open_file
from edoras_tools.links.bare import TO
from edoras_tools.pipelines.workbench import Settings

GROUND_SAMPLES = ["a_rover", "b_arm_single", "e_ci_errors"]
LAYOUT = """
byte_order: {order}
bind: {{0x0890: Health, 0x1890/2: Drive, 0x1890/3: Drive, 0x1891/0: Reset, 0x1892: Any, 0x1893/1: Upload}}
enums: {{Mode: {{type: uint8, values: {{IDLE: 0, DRIVING: 1}}}}}}
structs:
  Point: {{members: {{x: float32, y: float64}}}}
  Word: {{union: true, members: {{number: uint32, raw: 'byte[4]'}}}}
  Health: {{members: {{
    count: uint16, charge: 'uint16:10', on: 'uint16:1', mode: Mode, name: 'char[5]',
    path: 'Point[2]', word: Word}}}}
  Drive: {{members: {{
    speed: int16, flags: 'uint16:3', more: 'uint16:7', mode: Mode, name: 'char[6]', to: Point, word: Word}}}}
  Reset: {{members: {{}}}}
  Any: {{members: {{x: uint8}}}}
  Upload: {{members: {{bytes: 'byte[]'}}}}
"""
DRIVE = {"speed": -300, "flags_more": 0x155, "mode": 1, "name": "base", "to_x": 0.5, "to_y": -2.25}
"""Arguments, by the names that they have in XTCE; of ``word`` each reader has its own form."""
WORD = b"\x01\x02\x03\x04"


def sample_bench(sample):
    """Return what reads a sample capture."""
    return Settings([MISSIONS / f"{item}.yaml" for item in SAMPLE_MISSIONS[sample]]).workbench()


def telemetry(sample, bench):
    """Return the packets of Telemetry Output in a sample that hold a message which is known, dissected."""
    port = TO.transport.ports[0]
    packets = (item for batch in open_file(CAPTURES / f"{sample}.pcap").batches() for item in batch)
    decoded = [bench.dissector.dissect(item) for item in packets if item.destination.port == port]
    return [item for item in decoded if item.message is not None]


def struct_bench(folder, order):
    """Return the rover's mission with C structs, of a byte order."""
    path = folder / "own.yaml"
    path.write_text(LAYOUT.format(order=order))
    return Settings([MISSIONS / "rover_ground.yaml"], structs=[path]).workbench()


def drive_payload(order):
    """Return the bytes that a compiler gives :data:`DRIVE`, written by Python's own ``struct``."""
    mark = "<" if order == "little" else ">"
    return struct.pack(f"{mark}hHB6s5xf4xd4s4x", -300, 0x155, 1, b"base", 0.5, -2.25, WORD)


def health_payload(order):
    """Return the bytes of a ``Health``: 700 of charge, on, driving, two points."""
    mark = "<" if order == "little" else ">"
    charge = 700 | 1 << 10 if order == "little" else 700 << 6 | 1 << 5
    return struct.pack(f"{mark}HHB5s6xf4xdf4xd4s4x", 7, charge, 1, b"rove", 1.5, 2.5, 3.5, 4.5, WORD)


def flat(value, prefix=""):
    """Yield (dotted name, value) of every leaf."""
    if isinstance(value, dict):
        for name, item in value.items():
            yield from flat(item, f"{prefix}.{name}" if prefix else name)
    elif isinstance(value, list):
        for place, item in enumerate(value):
            yield from flat(item, f"{prefix}[{place}]")
    else:
        yield prefix, value

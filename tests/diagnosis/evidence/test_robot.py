"""Commands to a robot whose struct is its own: each is the command whose numbers of the same names it has."""

from __future__ import annotations

import struct
from contextlib import closing

import numpy as np
import pytest
from msgspec.structs import replace
from places import ROOT

from edoras_tools.decode import ColumnDecoder, Context
from edoras_tools.diagnosis.examination import Examination
from edoras_tools.io.formats.open import open_file
from edoras_tools.links import ROBOT_PORT
from edoras_tools.mission import load
from edoras_tools.ros import TypeStore
from edoras_tools.structs import Structs, shipped_structs
from edoras_tools.structs.files import parse_layout

LAYOUT = """
edoras_structs: 1
byte_order: {order}
bind: {{'udp:{port}': rover_command}}
structs:
  rover_command: {{members: {{count: uint16, {speed}: float32, Angular_Z: float32}}}}
"""
MISSION = ROOT / "samples/missions/rover_ground.yaml"


def rewritten(batch, order, port):
    """Return the batch with the robot's commands as another struct, of 12 bytes, to another port."""
    rows = np.flatnonzero(batch.destination_port == ROBOT_PORT)
    data, length, ports = batch.data.copy(), batch.length.copy(), batch.destination_port.copy()
    for row in rows.tolist():
        at = int(batch.offset[row])
        values = struct.unpack("<6d", data[at : at + 48].tobytes())
        told = struct.pack(f"{order}Hxxff", row & 0xFFFF, values[0], values[5])
        data[at : at + len(told)] = np.frombuffer(told, np.uint8)
    length[rows], ports[rows] = 12, port
    shorter = batch.length - length
    return replace(
        batch,
        data=data,
        length=length,
        destination_port=ports,
        frame_length=batch.frame_length - shorter,
        original_length=batch.original_length - shorter,
    )


@pytest.mark.parametrize(
    ("order", "port", "speed", "out"),
    [("little", 8585, "linear_x", 508), ("big", 9000, "LinearX", 508), ("little", 9000, "throttle", 508)],
)
def test_the_last_hop_is_counted_through_a_struct_of_its_own(order, port, speed, out):
    layout = parse_layout(LAYOUT.format(order=order, port=port, speed=speed).encode(), "rover")
    structs = Structs([layout, *shipped_structs().layouts])
    context = Context(load([MISSION]), TypeStore(), structs=structs)
    examination, decoder = Examination(context), ColumnDecoder(context)
    with closing(open_file(ROOT / "samples/captures/a_rover.pcap")) as source:
        for batch in source.batches():
            other = rewritten(batch, "<" if order == "little" else ">", port)
            examination.add(other, decoder.decode(other))
    found = examination.diagnose()
    (row,) = [row for row in found.balance if row.hop == "application" and row.msg_id == 0x1827]
    assert (row.came, row.out, row.unaccounted) == (508, out, 0)
    assert row.counted["out"] == "same values on the robot link"
    assert found.lost == 92

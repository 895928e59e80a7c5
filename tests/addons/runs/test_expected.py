"""What came back in a replay, beside a good run: the first message that differs, or nothing."""

from __future__ import annotations

import struct
from dataclasses import replace

import pytest
from places import CAPTURES, MISSIONS
from rewriting import datagrams, write

from edoras_tools.addons.runs.expected import unlike
from edoras_tools.pipelines.workbench import Settings

ROVER = CAPTURES / "a_rover.pcap"
BENCH = Settings([MISSIONS / "rover_ground.yaml"]).workbench()


def changed(folder, change):
    """Write the run with its poses changed: a function from place and payload to payload, or None."""
    items, place = [], 0
    for item in datagrams(ROVER):
        if item.payload[:2] == b"\x08\x27":
            place += 1
            payload = change(place, item.payload)
            items += [] if payload is None else [replace(item, payload=payload)]
        else:
            items.append(item)
    return write(folder / "sent.pcap", items)


def moved(place, payload):
    """Move x by 0.5 m from the 30th pose on."""
    data, offset = bytearray(payload), x_offset(payload)
    (x,) = struct.unpack_from("<d", data, offset)
    struct.pack_into("<d", data, offset, x + 0.5 * (place >= 30))
    return bytes(data)


def x_offset(payload):
    """Return where x is: after headers, envelope, encapsulation, stamp and frame_id."""
    start = 16 + 16 + 4
    (length,) = struct.unpack_from("<I", payload, start + 8)
    end = 12 + length
    return start + end + -end % 8


def test_a_run_beside_itself():
    assert unlike(ROVER, ROVER, BENCH, {}) == []


def test_lost_messages_do_not_make_a_difference(tmp_path):
    few = changed(tmp_path, lambda place, payload: payload if place % 3 else None)
    assert unlike(ROVER, few, BENCH, {}) == []


@pytest.mark.parametrize(
    ("rooms", "differs"), [({"pose.position.x": 0.1}, True), ({"pose.position.x": 2.0}, False)]
)
def test_the_first_message_that_differs_is_named(rooms, differs, tmp_path):
    sent = changed(tmp_path, moved)
    lines = unlike(ROVER, sent, BENCH, rooms)
    poses = [number for number, item in enumerate(datagrams(ROVER), 1) if item.payload[:2] == b"\x08\x27"]
    assert [f"in message {poses[29]:,}," in line for line in lines] == [True] * differs
    assert all(line.startswith("/telemetry_pose pose.position.x is ") for line in lines)


def test_a_topic_that_does_not_come(tmp_path):
    none = changed(tmp_path, lambda _place, _payload: None)
    assert unlike(ROVER, none, BENCH, {}) == ["/telemetry_pose did not come"]

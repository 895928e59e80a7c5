"""The answers in a replay beside an earlier run: losses are no difference, a value far away is."""

from __future__ import annotations

import struct

import pytest
from msgspec.structs import replace
from places import CAPTURES, MISSIONS
from rewriting import datagrams, write

from edoras_tools.addons.runs.differences import unlike, unlike_lines
from edoras_tools.addons.runs.run import Run
from edoras_tools.pipelines.workbench import Settings, open_files

ITEMS = datagrams(CAPTURES / "a_rover.pcap")[:400]
BENCH = Settings([MISSIONS / "rover_ground.yaml"]).workbench()


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    return write(tmp_path_factory.mktemp("good") / "good.pcap", ITEMS)


@pytest.fixture(scope="module")
def good(path):
    return read(path)


def read(path):
    return Run.read(open_files([path]), BENCH.fresh())


def changed(folder, change):
    """Write the run with its poses changed: a function from place and payload to payload, or None."""
    items, place = [], 0
    for item in ITEMS:
        if item.payload[:2] == b"\x08\x27":
            place += 1
            payload = change(place, item.payload)
            items += [] if payload is None else [replace(item, payload=payload)]
        else:
            items.append(item)
    return write(folder / "sent.pcap", items)


def moved(place, payload):
    """Move x by 0.5 m from the 8th pose on."""
    data, offset = bytearray(payload), x_offset(payload)
    (x,) = struct.unpack_from("<d", data, offset)
    struct.pack_into("<d", data, offset, x + 0.5 * (place >= 8))
    return bytes(data)


def x_offset(payload):
    """Return where x is: after headers, envelope, encapsulation, stamp and frame_id."""
    start = 16 + 16 + 4
    (length,) = struct.unpack_from("<I", payload, start + 8)
    end = 12 + length
    return start + end + -end % 8


def test_a_run_beside_itself(good):
    assert [*unlike_lines(good, good, {})] == []


def test_lost_messages_do_not_make_a_difference(good, tmp_path):
    few = changed(tmp_path, lambda place, payload: payload if place % 3 else None)
    assert [*unlike_lines(good, read(few), {})] == []


def test_the_first_message_that_differs_is_named(good, tmp_path):
    sent = read(changed(tmp_path, moved))
    assert [*unlike_lines(good, sent, {"pose.position.x": 2.0})] == []
    (line,) = unlike_lines(good, sent, {"pose.position.x": 0.1})
    poses = [number for number, item in enumerate(ITEMS, 1) if item.payload[:2] == b"\x08\x27"]
    assert f"in message {poses[7]:,}," in line
    assert line.startswith("/telemetry_pose pose.position.x is ")


def test_a_topic_that_does_not_come(path, tmp_path):
    none = changed(tmp_path, lambda _place, _payload: None)
    assert unlike(path, none, BENCH, {}) == ["/telemetry_pose did not come"]

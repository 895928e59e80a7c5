"""Every layout, in both byte orders, both ways."""

from __future__ import annotations

import struct

import pytest
from effort import examples
from hypothesis import given, settings
from hypothesis import strategies as st
from rtps import PREFIX, TWIST, WRITER, announcement, parameter, text

from edoras_tools.addons.rtps.wire import (
    BUILT_IN,
    EVERY_RTPS_LAYOUT,
    LONGEST_TEXT,
    MOST_PARAMETERS_READ,
    RTPS_HEADER,
    SUBMESSAGE_LAYOUTS,
    Announcement,
    SubmessageKind,
    read_announcement,
    read_parameters,
    read_status,
    ros_name,
    ros_topic,
)
from edoras_tools.middleware.graph import dds_name
from edoras_tools.ros import TypeStore


def test_a_real_header():
    raw = b"RTPS\x02\x05\x01\x10" + PREFIX
    values = {
        "magic": 0x52545053,
        "version_major": 2,
        "version_minor": 5,
        "vendor_id": 0x0110,
        "guid_prefix": PREFIX,
    }
    assert RTPS_HEADER.parse(raw) == values
    assert RTPS_HEADER.emit(values) == raw


@pytest.mark.parametrize("kind", SUBMESSAGE_LAYOUTS)
def test_both_orders_hold_the_same(kind):
    little, big = SUBMESSAGE_LAYOUTS[kind]
    values = {
        slot.field.name: WRITER[: slot.end - slot.start].ljust(slot.end - slot.start, b"\1")
        if slot.field.kind == "bytes"
        else 1 + place
        for place, slot in enumerate(little.slots)
    }
    assert little.size == big.size
    assert little.parse(little.emit(values)) == values == big.parse(big.emit(values))
    if kind != SubmessageKind.INFO_DST:
        assert little.emit(values) != big.emit(values)


def test_names_are_unique():
    names = [layout.name for layout in EVERY_RTPS_LAYOUT]
    assert len(set(names)) == len(names)
    assert all(len(item) == 4 and item[-1] & 0xC0 == 0xC0 for item in BUILT_IN)


@pytest.mark.parametrize("order", ["<", ">"])
def test_a_writer_is_announced(order):
    raw = announcement("rt/cmd_vel", TWIST, order=order)
    assert read_announcement(raw) == Announcement(PREFIX + WRITER, "rt/cmd_vel", TWIST)


@pytest.mark.parametrize(("order", "name"), [("<", "little"), (">", "big")])
@pytest.mark.parametrize(
    ("flags", "told"),
    [(0, ""), (1, "disposed"), (2, "unregistered"), (3, "disposed and unregistered"), (4, "")],
)
def test_what_became_of_an_instance(order, name, flags, told):
    status = parameter(0x71, bytes([0, 0, 0, flags]), order)
    assert read_status(parameter(0x70, bytes(16), order) + status + parameter(1, b"", order), name) == told
    assert read_status(parameter(1, b"", order) + status, name) == ""
    assert read_status(status[:6], name) == ""


def test_what_is_not_said_is_unknown():
    assert read_announcement(b"\0\3\0\0" + parameter(5, text("rt/a"))) is None
    found = read_announcement(b"\0\3\0\0" + parameter(0x50, bytes(16)) + parameter(0x62, text("node")))
    assert found == Announcement(bytes(16), name="node")
    assert read_announcement(b"\0\1\0\0" + parameter(0x5A, bytes(16))) is None  # plain CDR is no list


def test_long_names_and_endless_lists_end():
    long = parameter(0x5A, bytes(16)) + parameter(5, text("x" * 5000))
    assert len(read_announcement(b"\0\3\0\0" + long).topic) <= LONGEST_TEXT
    assert len(list(read_parameters(b"\0\3\0\0" + parameter(0, b"") * 100_000))) == MOST_PARAMETERS_READ
    odd = parameter(0x5A, bytes(16)) + parameter(5, text("rt/\x1b[31m\n"))
    assert read_announcement(b"\0\3\0\0" + odd).topic == "rt/?[31m?"
    assert not list(read_parameters(b"\0\3\0\0" + struct.pack("<HH", 5, 0xFFFF) + bytes(100)))


@settings(max_examples=examples(300), deadline=None)
@given(st.binary(max_size=200), st.sampled_from([b"\0\2\0\0", b"\0\3\0\0", b""]))
def test_any_bytes(raw, head):
    found = read_announcement(head + raw)
    assert found is None or len(found.guid) == 16


@pytest.mark.parametrize(
    ("dds", "ros"),
    [
        ("rt/cmd_vel", "/cmd_vel"),
        ("rt/rover_1/pose", "/rover_1/pose"),
        ("rq/add_two_intsRequest", "rq/add_two_intsRequest"),
        ("ros_discovery_info", "ros_discovery_info"),
        ("rtx/a", "rtx/a"),
        ("", ""),
    ],
)
def test_topics(dds, ros):
    assert ros_topic(dds) == ros


def test_types():
    for name in TypeStore().types():
        assert ros_name(dds_name(name)) == name
    assert ros_name("HelloWorld") == "HelloWorld"
    assert ros_name("a::b::dds_::C") == "a::b::dds_::C"

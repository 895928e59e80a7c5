"""The generated C beside rosbags, and beside our own reader: every type, both directions."""

from __future__ import annotations

import math
import struct

import pytest
from effort import every, examples
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_typestore

from edoras_tools.errors import WireError

TOGETHER = "a library in C"
PACKAGES = ("geometry_msgs", "sensor_msgs", "std_msgs", "nav_msgs", "builtin_interfaces")
PROBES = [
    f"probe_msgs/msg/{name}" for name in ("All", "Bounds", "Deep", "Inner", "Wide", "Words", "Defaults")
]
STANDARD = [name for name in get_typestore(Stores.ROS2_JAZZY).fielddefs if name.split("/")[0] in PACKAGES]
TYPES = [*sorted(STANDARD), *PROBES]
NOT_OF_ROSBAGS = {"probe_msgs/msg/Wide", "probe_msgs/msg/Defaults"}
"""wstring is not of rosbags."""
few = settings(max_examples=examples(5, least=2), suppress_health_check=list(HealthCheck))


def exact(value):
    return struct.pack("<d", value) if isinstance(value, float) and not math.isnan(value) else str(value)


def test_every_package_is_there():
    assert len(STANDARD) > 85
    assert {name.split("/")[0] for name in STANDARD} == set(PACKAGES)


@pytest.mark.each(5)
@pytest.mark.parametrize("name", every(2, TYPES))
@few
@given(data=st.data())
def test_both_ways(library, store, rosbags_store, tools, name, data):
    values = data.draw(tools.messages(store, name))
    cdr = store.encode(name, values)
    if name not in NOT_OF_ROSBAGS:
        assert bytes(rosbags_store.serialize_cdr(rosbags_store.deserialize_cdr(cdr, name), name)) == cdr

    status, message = library.decode(name, cdr)
    assert status == library.OK
    assert library.encode(name, message) == (library.OK, cdr)
    status, swapped = library.decode(name, store.encode(name, values, big_endian=True))
    assert library.encode(name, swapped) == (library.OK, cdr)

    made = library.created(name)
    for path, kind, value in tools.leaves(store, name, values):
        if kind is None:
            assert library.count(message, name, path) == value
            assert library.dll.resize_sequence(made, library.info(name), path.encode(), value)
        else:
            assert exact(library.get(message, name, path, kind)) == exact(value)
            assert library.set(made, name, path, kind, value)
    assert library.encode(name, made) == (library.OK, cdr)


@pytest.mark.parametrize("name", TYPES)
def test_new_messages_have_their_defaults(library, store, name):
    assert library.encode(name, library.created(name)) == (library.OK, store.encode(name, {}))


@pytest.mark.each(5)
@pytest.mark.parametrize("name", every(2, TYPES))
@few
@given(data=st.data())
def test_what_is_read_is_what_our_reader_reads(library, store, tools, name, data):
    """Spoilt messages: valid for the one where for the other, but for what is longer than its bound."""
    cdr = bytearray(
        store.encode(name, data.draw(tools.messages(store, name)), big_endian=data.draw(st.booleans()))
    )
    for _ in range(data.draw(st.integers(0, 3))):
        cdr[data.draw(st.integers(0, len(cdr) - 1))] = data.draw(st.integers(0, 255))
    cdr = bytes(cdr[: data.draw(st.integers(0, len(cdr)))] if data.draw(st.booleans()) else cdr)
    cdr += bytes(data.draw(st.integers(0, 5)))
    status, message = library.decode(name, cdr)
    try:
        expected = store.decode(name, cdr)
    except WireError:
        assert status not in {library.OK, library.ARGUMENT, library.NO_SPACE}
        assert library.encode(name, message) == (library.OK, store.encode(name, {}))
    else:
        assert status in {library.OK, library.BOUND}
        if status == library.OK:
            again = store.decode(name, library.encode(name, message)[1])
            assert str(again) == str(expected)


@pytest.mark.parametrize("name", ["sensor_msgs/msg/JointState", "probe_msgs/msg/All"])
def test_a_buffer_that_is_too_small(library, store, name):
    message = library.created(name)
    whole = store.encode(name, {})
    for room in range(len(whole) + 3):
        status, cdr = library.encode(name, message, room)
        assert (status, cdr) == ((library.OK, whole) if room >= len(whole) else (library.NO_SPACE, b""))


def test_longer_than_the_bound(library, store):
    name = "sensor_msgs/msg/JointState"
    for values, status in (
        ({"position": [0.0] * 5}, library.OK),
        ({"position": [0.0] * 6}, library.BOUND),
        ({"name": ["x" * 24]}, library.OK),
        ({"name": ["x" * 25]}, library.BOUND),
        ({"header": {"frame_id": "é" * 12}}, library.OK),
        ({"header": {"frame_id": "é" * 12 + "x"}}, library.BOUND),
    ):
        assert library.decode(name, store.encode(name, values))[0] == status


def test_sizes_that_somebody_spoilt_are_refused(library):
    """A message is memory of the app's: what it claims is not believed."""
    name = "std_msgs/msg/String"
    message = library.message(name)
    for size, status in ((24, library.OK), (25, library.BOUND), (0xFFFFFFFF, library.BOUND)):
        struct.pack_into("<I", message, 0, size)
        assert library.encode(name, message)[0] == status
    name = "std_msgs/msg/UInt8MultiArray"
    message = library.message(name)
    assert library.encode(name, message)[0] == library.BOUND


@pytest.mark.parametrize(
    ("cdr", "status"),
    [
        ("", "TRUNCATED"),
        ("000100", "TRUNCATED"),
        ("00010000", "TRUNCATED"),
        ("0001000001000000", "TRUNCATED"),
        ("000100000000000001", "OK"),  # an empty string without its NUL, and a byte of padding
        ("00010000 02000000 61 62", "UNTERMINATED"),
        ("00010000 02000000 61 00", "OK"),
        ("00000000 00000002 61 00", "OK"),
        ("00010000 02000000 61 00 000000", "OK"),
        ("00010000 02000000 61 00 ffffffffffffff", "OK"),  # a writer may round up to 8
        ("00010000 02000000 61 00 0000000000000000", "TRAILING"),
        ("00020000 02000000 61 00", "ENCAPSULATION"),
        ("01010000 02000000 61 00", "ENCAPSULATION"),
        ("00010000 ffffffff 61 00", "TRUNCATED"),
        ("00010000 1a000000" + "61" * 25 + "00", "BOUND"),
    ],
)
def test_bytes_of_a_string(library, cdr, status):
    assert library.decode("std_msgs/msg/String", bytes.fromhex(cdr))[0] == getattr(library, status)


def test_null(library):
    import ctypes

    decode = library.dll.std_msgs__msg__String__decode
    encode = library.dll.std_msgs__msg__String__encode
    size = ctypes.c_size_t(8)
    message = library.message("std_msgs/msg/String")
    assert decode(None, b"\0" * 8, size) == library.ARGUMENT
    assert decode(message, None, size) == library.ARGUMENT
    assert encode(None, ctypes.create_string_buffer(8), size, None) == library.ARGUMENT
    assert encode(message, None, size, None) == library.ARGUMENT


def test_statuses_have_words(library):
    texts = [library.dll.edoras_status_text(status) for status in range(9)]
    assert texts[0] == b"ok"
    assert texts[8] == b"unknown status"
    assert len(set(texts)) == 9

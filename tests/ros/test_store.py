from __future__ import annotations

import math
import re
import struct
from enum import IntEnum

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from places import CAPTURES

from edoras_tools.errors import FieldError, RouteError, TruncatedError, WireError
from edoras_tools.ros import TypeStore
from edoras_tools.ros.store import USUAL, types_that_fit

TWIST = "geometry_msgs/msg/Twist"
STAMPED = "geometry_msgs/msg/PoseStamped"
JOINTS = "sensor_msgs/msg/JointState"


def captured(file, msg_id):
    """CDR of every datagram of a capture that is one space packet: Ethernet, IPv4, UDP, cFE, envelope."""
    raw = (CAPTURES / file).read_bytes()
    found, position = [], 24
    while position < len(raw):
        length = int.from_bytes(raw[position + 8 : position + 12], "little")
        packet = raw[position + 16 + 42 : position + 16 + length]
        position += 16 + length
        if packet[:2] == msg_id.to_bytes(2, "big"):
            envelope = packet[8 if msg_id & 0x1000 else 16 :]
            found.append(envelope[16 : 16 + int.from_bytes(envelope[:8], "little")])
    return found


@pytest.mark.parametrize(
    ("file", "msg_id", "name", "count", "size"),
    [
        ("a_rover.pcap", 0x1827, TWIST, 600, 52),
        ("a_rover.pcap", 0x0827, STAMPED, 63, 84),
        ("b_arm_single.pcap", 0x1827, "geometry_msgs/msg/Pose", 120, 60),
        ("b_arm_single.pcap", 0x0827, JOINTS, 63, 236),
    ],
)
def test_captures(store, rosbags_store, tools, file, msg_id, name, count, size):
    cdrs = captured(file, msg_id)
    assert (len(cdrs), {len(cdr) for cdr in cdrs}) == (count, {size})
    data, length = np.frombuffer(b"".join(cdrs), np.uint8), np.full(count, size, np.int32)
    columns = store.columns(name, data, np.arange(count) * size, length)
    assert columns.valid.all()
    for row, cdr in enumerate(cdrs):
        values = store.decode(name, cdr)
        assert values == tools.from_rosbags(rosbags_store, name, rosbags_store.deserialize_cdr(cdr, name))
        assert store.encode(name, values) == cdr
        for item in store.spans(name, cdr):
            if item.path in columns.fields:
                assert np.array_equal(columns.fields[item.path][row], item.value)


def test_known_types(store):
    assert store.has(TWIST)
    assert store.has("geometry_msgs/Twist")
    assert store.check(TWIST) is None
    assert TWIST in store.types()


@pytest.mark.parametrize(
    ("asked", "first"),
    [
        ("geometry_msgs/msg/Twst", TWIST),
        ("geometry_msg/msg/Twist", TWIST),
        ("Twist", TWIST),
        ("geometry_msgs/msg/twist", TWIST),
        ("sensor_msgs/msg/JointStates", JOINTS),
        ("std_msgs/msg/Pose", "geometry_msgs/msg/Pose"),
    ],
)
def test_nearest(store, asked, first):
    assert store.nearest(asked)[0] == first
    assert not store.has(asked)
    assert store.check(asked).startswith(f"type {asked!r} is not known to ROS 2 jazzy; did you mean {first}")


def test_nothing_near(store):
    assert store.nearest("zzz/msg/Qqqqqq") == []
    with pytest.raises(RouteError, match="--set msg-path"):
        store.definition("zzz/msg/Qqqqqq")


def test_definition(store):
    assert store.definition("geometry_msgs/msg/PoseStamped") == (
        "std_msgs/Header header\ngeometry_msgs/Pose pose\n"
        + "=" * 80
        + "\nMSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n"
        + "=" * 80
        + "\nMSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
        + "=" * 80
        + "\nMSG: geometry_msgs/Pose\ngeometry_msgs/Point position\ngeometry_msgs/Quaternion orientation\n"
        + "=" * 80
        + "\nMSG: geometry_msgs/Point\nfloat64 x\nfloat64 y\nfloat64 z\n"
        + "=" * 80
        + "\nMSG: geometry_msgs/Quaternion\nfloat64 x\nfloat64 y\nfloat64 z\nfloat64 w 1.0\n"
    )


def test_definitions_are_the_type_and_then_what_it_uses(store):
    names = [item.name for item in store.definitions(STAMPED)]
    assert names[0] == STAMPED
    assert set(names[1:]) == {
        "std_msgs/msg/Header",
        "builtin_interfaces/msg/Time",
        "geometry_msgs/msg/Pose",
        "geometry_msgs/msg/Point",
        "geometry_msgs/msg/Quaternion",
    }


@pytest.mark.parametrize(
    ("name", "size"),
    [
        (TWIST, 52),
        ("geometry_msgs/msg/Pose", 60),
        ("std_msgs/msg/Bool", 5),
        ("std_msgs/msg/Empty", 5),
        ("builtin_interfaces/msg/Time", 12),
        ("odd_msgs/msg/Inner", 4 + 17),
        (STAMPED, None),
        (JOINTS, None),
        ("odd_msgs/msg/Gaps", None),
        ("odd_msgs/msg/Defaults", None),
    ],
)
def test_fixed_size(store, name, size):
    assert store.fixed_size(name) == size
    if size:
        assert len(store.encode(name, {})) == size


def test_fixed_size_of_arrays_with_gaps():
    types = TypeStore(definitions={"a/A": "B[3] b\nint8 x\n", "a/B": "float64 d\nint8 c\n"})
    assert types.fixed_size("a/A") == len(types.encode("a/A", {})) == 4 + 42


def test_defaults(store):
    assert store.decode("odd_msgs/msg/Defaults", store.encode("odd_msgs/msg/Defaults", {})) == {
        "a": 5,
        "s": "it's",
        "f": [1.5, -2.0],
        "b": [True, False],
        "q": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0},
    }
    assert store.decode(STAMPED, store.encode(STAMPED, {}))["pose"]["orientation"]["w"] == 1.0


def test_bytes_on_the_wire(store):
    values = {
        "header": {"stamp": {"sec": 1, "nanosec": 2}, "frame_id": "map"},
        "name": ["a"],
        "effort": [0.5],
    }
    little = store.encode(JOINTS, values)
    head, stamp, frame_id = b"\0\1\0\0", b"\1\0\0\0\2\0\0\0", b"\4\0\0\0map\0"
    name, position, velocity = b"\1\0\0\0\2\0\0\0a\0\0\0", b"\0\0\0\0", b"\0\0\0\0"
    effort = b"\1\0\0\0" + struct.pack("<d", 0.5)
    assert little == head + stamp + frame_id + name + position + velocity + effort
    big = store.encode(JOINTS, values, big_endian=True)
    assert big[:4] == b"\0\0\0\0"
    assert store.decode(JOINTS, big) == store.decode(JOINTS, little)
    assert [item[:1] + item[2:] for item in store.spans(JOINTS, big)] == [
        item[:1] + item[2:] for item in store.spans(JOINTS, little)
    ]


def test_a_wide_string_has_four_bytes_a_unit():
    types = TypeStore(definitions={"a/A": "wstring w\n"})
    assert types.encode("a/A", {"w": "é"})[4:] == b"\1\0\0\0\xe9\0\0\0"
    for big in (False, True):
        assert types.decode("a/A", types.encode("a/A", {"w": "a𝄞"}, big_endian=big)) == {"w": "a𝄞"}


def test_strings_are_read_leniently(store):
    name = "std_msgs/msg/String"
    assert store.decode(name, b"\0\1\0\0\0\0\0\0") == {"data": ""}
    assert store.decode(name, b"\0\1\0\0\3\0\0\0\xffa\0") == {"data": "\ufffda"}


WRONG_BYTES = [
    (
        TWIST,
        b"",
        TruncatedError,
        "geometry_msgs/msg/Twist encapsulation at byte 0 needs 4 bytes, 0 are there",
    ),
    (TWIST, b"\0\1\0\0" + bytes(20), TruncatedError, "Twist linear.z at byte 20 needs 8 bytes, 4 are there"),
    (TWIST, b"\0\3\0\0" + bytes(48), WireError, "representation 0x0003 is not supported"),
    (TWIST, b"\0\7\0\0" + bytes(48), WireError, "representation 0x0007 is not supported"),
    (
        "std_msgs/msg/String",
        b"\0\1\0\0\xff\xff\xff\xff",
        TruncatedError,
        "data at byte 8 needs 4294967295 bytes, 0 are",
    ),
    (
        "std_msgs/msg/String",
        b"\0\1\0\0\2\0\0\0ab",
        FieldError,
        "the string of 2 bytes at byte 8 does not end in NUL",
    ),
    (
        "odd_msgs/msg/Bounds",
        b"\0\1\0\0\6\0\0\0abcde\0",
        FieldError,
        "Bounds.word: 6 characters at byte 8; at most 4 ",
    ),
    (
        "odd_msgs/msg/Bounds",
        b"\0\1\0\0\1\0\0\0\0\0\0\0\4\0\0\0",
        FieldError,
        ".few: 4 elements at byte 12; at most 3",
    ),
    (
        JOINTS,
        b"\0\1\0\0" + bytes(12) + b"\0\0\0\x20",
        TruncatedError,
        "name at byte 20 needs 2147483648 bytes, 0 are",
    ),
    (
        "geometry_msgs/msg/PoseArray",
        b"\0\1\0\0" + bytes(12) + b"\2\0\0\0" + bytes(60),
        TruncatedError,
        "poses at byte 20 needs 112 bytes, 60 are there",
    ),
    (
        "tf2_msgs/msg/TFMessage",
        b"\0\1\0\0\1\0\0\0" + bytes(8) + b"\x40\0\0\0" + bytes(60),
        TruncatedError,
        "transforms[0].header.frame_id at byte 20 needs 64 bytes, 60 are there",
    ),
]


@pytest.mark.parametrize(("name", "cdr", "kind", "message"), WRONG_BYTES)
def test_errors_say_what_and_where(store, name, cdr, kind, message):
    for read in (store.decode, store.spans):
        with pytest.raises(kind, match=re.escape(message)) as caught:
            read(name, cdr)
        assert type(caught.value) is kind
        assert "\n" not in str(caught.value)


WRONG_VALUES = [
    (TWIST, [], "(message): takes a mapping of linear, angular, not list []"),
    (TWIST, {"lin": 1}, "geometry_msgs/msg/Twist has no field lin; it has linear, angular"),
    (TWIST, {"linear": {"w": 1}}, "Twist.linear: geometry_msgs/msg/Vector3 has no field w; it has x, y, z"),
    (TWIST, {"linear": {"x": "1"}}, "Twist.linear.x: takes a number that fits float64, not str '1'"),
    (TWIST, {"linear": {"x": True}}, "linear.x: takes a number that fits float64, not bool True"),
    (TWIST, {"linear": {"x": None}}, "linear.x: takes a number that fits float64, not NoneType None"),
    (TWIST, {"linear": {"x": 10**400}}, "linear.x: takes a number that fits float64, not int 1"),
    (TWIST, {"linear": None}, "Twist.linear: takes a mapping of x, y, z, not NoneType None"),
    ("std_msgs/msg/Float32", {"data": 1e39}, "data: takes a number that fits float32, not float 1e+39"),
    ("std_msgs/msg/UInt8", {"data": -1}, "data: takes a whole number from 0 to 255, not int -1"),
    ("std_msgs/msg/UInt8", {"data": 1.0}, "data: takes a whole number from 0 to 255, not float 1.0"),
    ("std_msgs/msg/Int16", {"data": 32768}, "data: takes a whole number from -32768 to 32767, not int 32768"),
    ("std_msgs/msg/Bool", {"data": 1}, "data: takes true or false, not int 1"),
    ("std_msgs/msg/String", {"data": 1}, "data: takes a string, not int 1"),
    ("std_msgs/msg/String", {"data": "\ud800"}, "data: takes a string of Unicode characters"),
    ("std_msgs/msg/Empty", {"x": 1}, "std_msgs/msg/Empty has no field x; it has no field"),
    (
        JOINTS,
        {"position": [1, 2, "3"]},
        "JointState.position[2]: takes a number that fits float64, not str '3'",
    ),
    (JOINTS, {"position": "12"}, "position: float64[] takes a list, not str '12'"),
    (JOINTS, {"position": b"12"}, "position: float64[] takes a list, not bytes b'12'"),
    (JOINTS, {"name": ["a", 2]}, "JointState.name[1]: takes a string, not int 2"),
    ("sensor_msgs/msg/Imu", {"orientation_covariance": [1.0]}, "float64[9] takes a list of 9 values, not 1"),
    (
        "sensor_msgs/msg/Image",
        {"data": [1, 256]},
        "Image.data[1]: takes a whole number from 0 to 255, not int 256",
    ),
    ("sensor_msgs/msg/Image", {"data": 5}, "data: uint8[] takes a list or bytes, not int 5"),
    ("odd_msgs/msg/Bounds", {"few": [1] * 4}, "few: int32[<=3] takes a list of at most 3 values, not 4"),
    ("odd_msgs/msg/Bounds", {"word": "abcde"}, "word: takes a string of at most 4 characters, not 5"),
    ("odd_msgs/msg/Bounds", {"word": "ééé"}, "word: takes a string of at most 4 characters, not 6"),
    (
        "odd_msgs/msg/Deep",
        {"gaps": [{}, {"many": [{"a": 300}]}]},
        "Deep.gaps[1].many[0].a: takes a whole number",
    ),
]


@pytest.mark.parametrize(("name", "values", "message"), WRONG_VALUES)
def test_refused_values_name_their_path(store, name, values, message):
    with pytest.raises(FieldError, match=re.escape(message)) as caught:
        store.encode(name, values)
    assert "\n" not in str(caught.value)


def test_numbers_of_other_kinds(store):
    class Level(IntEnum):
        HIGH = 3

    class Metres(float):
        __slots__ = ()

    assert store.decode("std_msgs/msg/Int8", store.encode("std_msgs/msg/Int8", {"data": Level.HIGH})) == {
        "data": 3
    }
    assert store.decode(
        "std_msgs/msg/Float32", store.encode("std_msgs/msg/Float32", {"data": Metres(1.5)})
    ) == {"data": 1.5}


def test_values_of_numpy(store):
    cdr = store.encode(
        JOINTS,
        {
            "header": {"stamp": {"sec": np.int32(4)}},
            "position": np.array([1, 2], np.float32),
            "effort": (1, np.float64(2)),
        },
    )
    values = store.decode(JOINTS, cdr)
    assert values["header"]["stamp"]["sec"] == 4
    assert (values["position"], values["effort"]) == ([1.0, 2.0], [1.0, 2.0])
    assert all(type(item) is float for item in values["position"])


@pytest.mark.parametrize(
    "data", [b"\1\2\xff", bytearray(b"\1\2\xff"), memoryview(b"\1\2\xff"), [1, 2, 255], (1, 2, 255)]
)
def test_bytes_as_values(store, data):
    assert store.decode("sensor_msgs/msg/Image", store.encode("sensor_msgs/msg/Image", {"data": data}))[
        "data"
    ] == [1, 2, 255]


def test_spans_cover_the_message(store):
    values = {"gaps": [{"many": [{"b": 2.5}]}, {}], "last": -1}
    cdr = store.encode("odd_msgs/msg/Deep", values)
    spans = store.spans("odd_msgs/msg/Deep", cdr)
    assert [item.path for item in spans][:4] == [
        "gaps[0].flag",
        "gaps[0].one.a",
        "gaps[0].one.b",
        "gaps[0].one.c",
    ]
    assert next(item for item in spans if item.path == "gaps[0].many[0].b").value == 2.5
    assert next(item for item in spans if item.path == "gaps[1].many").value == []
    assert spans[-1] == ("last", -1, len(cdr) - 8, len(cdr))
    position = 4
    for item in spans:
        assert position <= item.start <= position + 11  # padding, and the count of the sequence around
        assert item.end > item.start
        position = item.end


def test_spans_hold_the_values_of_decode(store):
    cdr = store.encode(STAMPED, {"header": {"frame_id": "map"}, "pose": {"position": {"x": math.pi}}})
    found = {item.path: (item.value, item.start, item.end) for item in store.spans(STAMPED, cdr)}
    assert found["header.frame_id"] == ("map", 12, 20)
    assert found["pose.position.x"] == (math.pi, 20, 28)


@given(cdr=st.binary(max_size=80), plain=st.booleans())
def test_garbage(store, tools, cdr, plain):
    cdr = b"\0\1\0\0" + cdr if plain else cdr
    for name in (
        TWIST,
        STAMPED,
        JOINTS,
        "std_msgs/msg/Empty",
        "diagnostic_msgs/msg/DiagnosticArray",
        *tools.custom,
    ):
        try:
            spans = store.spans(name, cdr)
        except WireError:
            with pytest.raises(WireError):
                store.decode(name, cdr)
            continue
        assert isinstance(store.decode(name, cdr), dict)
        assert all(4 <= item.start <= item.end <= len(cdr) for item in spans)


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=3) | st.binary(max_size=3),
    lambda inner: (
        st.lists(inner, max_size=3)
        | st.dictionaries(
            st.sampled_from(["header", "stamp", "sec", "name", "position", "x"]), inner, max_size=3
        )
    ),
)


@given(values=JSON)
def test_garbage_values(store, values):
    for name in (JOINTS, STAMPED, "odd_msgs/msg/Deep", "std_msgs/msg/Empty"):
        try:
            cdr = store.encode(name, values)
        except FieldError:
            continue
        assert store.valid(
            name, np.frombuffer(cdr, np.uint8), np.zeros(1, np.int64), np.array([len(cdr)], np.int32)
        ).all()


def test_a_sequence_of_octets_is_bytes_and_equals_its_numbers(store):
    values = store.decode("sensor_msgs/msg/Image", store.encode("sensor_msgs/msg/Image", {"data": [1, 255]}))
    assert isinstance(values["data"], bytes)
    assert values == {**values, "data": [1, 255]}
    assert {**values, "data": [1, 255]} == values
    assert values["data"] not in ([1], [255, 1], b"", (1, 255))
    assert {values["data"]: 1} == {b"\1\xff": 1}


STORE = TypeStore()
JOINT_STATE = {"name": ["a", "bc"], "position": [1.0, 2.0], "velocity": [], "effort": []}


@pytest.mark.parametrize("name", USUAL)
def test_a_message_fits_its_own_type_first(name):
    values = JOINT_STATE if name.endswith("JointState") else {}
    assert types_that_fit(STORE, [STORE.encode(name, values)])[0] == name


def test_all_samples_must_fit():
    twist, pose = (STORE.encode(f"geometry_msgs/msg/{name}", {}) for name in ("Twist", "Pose"))
    assert "geometry_msgs/msg/Wrench" in types_that_fit(STORE, [twist])
    assert types_that_fit(STORE, [twist, pose]) == []
    assert types_that_fit(STORE, []) == []


def test_own_types_are_tried_too_and_come_first():
    cdr = STORE.encode("geometry_msgs/msg/Twist", {})
    assert types_that_fit(STORE, [cdr], ["geometry_msgs/msg/Wrench"])[0] == "geometry_msgs/msg/Wrench"
    log = STORE.encode("rcl_interfaces/msg/Log", {"name": "node", "msg": "text", "line": 7})
    assert "rcl_interfaces/msg/Log" in types_that_fit(STORE, [log], ["rcl_interfaces/msg/Log"])
    assert "rcl_interfaces/msg/Log" not in types_that_fit(STORE, [log])

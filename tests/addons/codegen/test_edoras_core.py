"""The functions of edoras_core: the paper's figures word for word, names, pools, and what is refused."""

from __future__ import annotations

import ctypes
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st
from places import ROOT

from edoras_tools.addons.codegen.generation import LibraryOrder, generate
from edoras_tools.addons.codegen.writing import write_folder
from edoras_tools.mission import load
from edoras_tools.ros import TypeStore
from edoras_tools.wire.envelope import ENVELOPE_FORMATS

TOGETHER = "a library in C"
JOINTS = "sensor_msgs/msg/JointState"
POSE = "geometry_msgs/msg/Pose"
APP_FLAGS = ("-std=c99", "-Wall", "-Wextra", "-Werror", "-shared", "-fPIC")


def packets(capture, msg_id):
    """Every space packet of a MsgId in an Ethernet, IPv4, UDP pcap of bare packets."""
    raw = (ROOT / f"samples/captures/{capture}.pcap").read_bytes()
    found, place = [], 24
    while place < len(raw):
        length = int.from_bytes(raw[place + 8 : place + 12], "little")
        packet = raw[place + 16 + 42 : place + 16 + length]
        place += 16 + length
        if packet[:2] == msg_id.to_bytes(2, "big"):
            found.append(packet)
    return found


def app(cc, tools, folder, name, types):
    """A flight app, compiled with a library of its own at default bounds."""
    write_folder(folder, generate(TypeStore(), LibraryOrder(types)).files)
    sources = [tools.HERE / "c" / file for file in (f"{name}.c", "cfe.c")] + sorted(folder.glob("*.c"))
    out = folder / f"{name}.so"
    return ctypes.CDLL(str(cc(out, f"-I{folder}", f"-I{tools.HERE / 'c'}", *sources, flags=APP_FLAGS)))


@pytest.fixture(scope="module")
def arm(cc, tools, tmp_path_factory):
    made = app(cc, tools, tmp_path_factory.mktemp("arm"), "arm", (POSE, JOINTS))
    made.AppInit()
    return made


@pytest.fixture(scope="module")
def rover(cc, tools, tmp_path_factory):
    types = ("geometry_msgs/msg/Twist", "geometry_msgs/msg/PoseStamped")
    made = app(cc, tools, tmp_path_factory.mktemp("rover"), "rover", types)
    made.AppInit()
    made.RoverTelemetry.restype = ctypes.c_bool
    return made


def put(made, kind, name, *values):
    (kind * len(values)).in_dll(made, name)[:] = values


def sent(made, packet):
    """What the app transmits once cFE's clock and count are those of a captured packet."""
    count, seconds, subseconds = struct.unpack_from(">H2xIH", packet, 2)
    put(made, ctypes.c_uint16, "sequence_count", count & 0x3FFF)
    put(made, ctypes.c_uint32, "mission_seconds", seconds)
    put(made, ctypes.c_uint16, "mission_subseconds", subseconds)
    yield
    size = ctypes.c_size_t.in_dll(made, "transmitted_size").value
    yield bytes((ctypes.c_uint8 * size).in_dll(made, "transmitted"))


def test_figure_14(arm, store):
    captured = packets("b_arm_single", 0x1827)
    assert len(captured) == 120
    for packet in captured:
        put(arm, ctypes.c_double, "commanded", *[9.0] * 7)
        arm.EdorasAppProcessGroundCommand(packet)
        told = store.decode(POSE, packet[24:84])
        expected = [told["position"][axis] for axis in "xyz"] + [told["orientation"][axis] for axis in "xyzw"]
        assert list((ctypes.c_double * 7).in_dll(arm, "commanded")) == expected


def test_figure_16_makes_the_packets_of_the_capture(arm, store):
    captured = packets("b_arm_single", 0x0827)
    assert len(captured) == 63
    for packet in captured:
        told = store.decode(JOINTS, packet[32 : 32 + 236])
        put(arm, ctypes.c_double, "joints", *told["position"])
        put(arm, ctypes.c_int32, "sec", told["header"]["stamp"]["sec"])
        put(arm, ctypes.c_uint32, "nanosec", told["header"]["stamp"]["nanosec"])
        outcome = sent(arm, packet)
        next(outcome)
        assert arm.EdorasAppReportHousekeeping(None) == 0
        assert next(outcome) == packet


@pytest.mark.long
def test_the_rover_reads_its_commands(rover, store):
    captured = packets("a_rover", 0x1827)
    assert len(captured) == 600
    for packet in captured:
        rover.AppCommand(packet)
        told = store.decode("geometry_msgs/msg/Twist", packet[24:76])
        expected = [told[part][axis] for part in ("linear", "angular") for axis in "xyz"]
        assert list((ctypes.c_double * 6).in_dll(rover, "twist")) == expected


def test_the_rover_makes_the_packets_of_the_capture(rover, store):
    """Its app frees what it is given, as both apps here do."""
    captured = packets("a_rover", 0x0827)
    assert len(captured) == 63
    for packet in captured:
        told = store.decode("geometry_msgs/msg/PoseStamped", packet[32 : 32 + 84])
        place, turn = told["pose"]["position"], told["pose"]["orientation"]
        put(
            rover, ctypes.c_double, "pose", *[place[axis] for axis in "xyz"], *[turn[axis] for axis in "xyzw"]
        )
        put(rover, ctypes.c_int32, "pose_sec", told["header"]["stamp"]["sec"])
        put(rover, ctypes.c_uint32, "pose_nanosec", told["header"]["stamp"]["nanosec"])
        outcome = sent(rover, packet)
        next(outcome)
        assert rover.RoverTelemetry()
        assert next(outcome) == packet


def test_a_command_that_is_cut_stops_the_rover(rover):
    packet = next(packet for packet in packets("a_rover", 0x1827) if any(packet[28:76]))
    for length in range(8, len(packet)):
        rover.AppCommand(packet)
        assert any((ctypes.c_double * 6).in_dll(rover, "twist"))
        rover.AppCommand(packet[:4] + (length - 7).to_bytes(2, "big") + packet[6:length] + b"\xa5" * 100)
        assert not any((ctypes.c_double * 6).in_dll(rover, "twist"))


@pytest.mark.long
def test_memory_of_a_heap_is_still_freed(library):
    heap_only = library.dll.edoras_heap_only
    heap_only.restype, heap_only.argtypes = ctypes.c_void_p, [ctypes.c_void_p]
    info, size = library.info(POSE), ctypes.c_size_t()
    message = library.created(POSE)
    buffer = library.dll.from_msg_pointer_to_uint_buffer(message, None, info, ctypes.byref(size))
    last = info.contents.size_of_ - 1
    for pointer in (message, message + last, buffer, buffer + info.contents.buffer_size - 1, None):
        assert heap_only(pointer) is None
    mine = ctypes.addressof(ctypes.create_string_buffer(8))
    assert heap_only(mine) == mine


def test_types(library):
    info = library.info(JOINTS).contents
    assert (info.message_namespace_, info.message_name_, info.member_count_) == (
        b"sensor_msgs",
        b"JointState",
        5,
    )
    for package, name in (
        (b"sensor_msgs", b"Joint"),
        (b"", b""),
        (b"sensor_msgs", b"Twist"),
        (None, b"Pose"),
    ):
        assert not library.dll.get_type_info(package, name)
        assert not library.dll.get_type_support(package, name, None)
        assert not library.dll.get_type_support_library(package, name)
    assert library.dll.get_type_support(b"sensor_msgs", b"JointState", None)
    assert library.dll.get_type_support_library(b"sensor_msgs", b"JointState")


def test_every_type_is_found(library, tools):
    for name in tools.TYPES:
        package, _, short = name.split("/")
        info = library.info(name).contents
        assert (info.message_namespace_, info.message_name_) == (package.encode(), short.encode())


NOWHERE = """
. x position.3 position.-1 position.0x1 position. position position.00000000000000000001x
position.18446744073709551616 header. header.stamp Position.0 header..stamp.sec .position.0 position.0.x
positions.0 position.0. positio.0 name.0.size position.+1 position.0/
"""


@pytest.mark.parametrize("path", ["", " position.0", *NOWHERE.split()])
def test_names_that_lead_nowhere(library, path):
    message = library.created(JOINTS)
    assert library.dll.resize_sequence(message, library.info(JOINTS), b"position", 3)
    before = library.encode(JOINTS, message)
    assert library.get(message, JOINTS, path, "float64") is None
    assert not library.set(message, JOINTS, path, "float64", 1.0)
    assert library.encode(JOINTS, message) == before


def test_names_that_lead_somewhere(library):
    message = library.created(JOINTS)
    assert library.dll.resize_sequence(message, library.info(JOINTS), b"position", 3)
    for path in ("position.0", "position.1", "position.02"):
        assert library.set(message, JOINTS, path, "float64", 1.5)
        assert library.get(message, JOINTS, path, "float64") == 1.5


@given(path=st.text("abcdehimnoprstxyz._0123456789[]", max_size=24))
def test_any_name(library, path):
    message = library.created(JOINTS)
    for kind in ("float64", "uint32", "string", "wstring"):
        found = library.get(message, JOINTS, path, kind)
        assert found is None or path in {"header.frame_id", "header.stamp.nanosec"}


def test_kinds_are_kept_apart(library):
    name = "probe_msgs/msg/All"
    message = library.created(name)
    kinds = [*library.C_TYPES, "string"]
    same = {"uint8", "byte", "char"}
    for kind in kinds:
        for other in kinds:
            value = b"" if other == "string" else 0
            fits = kind == other or {kind, other} <= same
            assert (
                library.set(message, name, f"one_{kind}", other, "" if other == "string" else value) == fits
            )
            assert (library.get(message, name, f"one_{kind}", other) is not None) == fits


def test_resizing(library, store):
    name = "probe_msgs/msg/All"
    message, info = library.created(name), library.info(name)
    assert library.dll.resize_sequence(message, info, b"many_inner", 2)
    assert library.get(message, name, "many_inner.1.text", "string") == "inner"
    assert library.set(message, name, "many_inner.0.text", "string", "other")
    assert library.set(message, name, "many_inner.1.text", "string", "")
    assert library.dll.resize_sequence(message, info, b"many_inner", 1)
    assert library.dll.resize_sequence(message, info, b"many_inner", 5)
    texts = [library.get(message, name, f"many_inner.{index}.text", "string") for index in range(6)]
    assert texts == ["other", "inner", "inner", "inner", "inner", None]
    for path, size in (
        (b"many_inner", 6),
        (b"three_inner", 3),
        (b"one_inner", 1),
        (b"few_int8", 3),
        (b"no", 0),
    ):
        assert not library.dll.resize_sequence(message, info, path, size)
    assert not library.dll.resize_sequence(message, info, b"few_int8", 2**64 - 1)
    assert [
        library.count(message, name, path) for path in ("three_int8", "many_inner", "one_int8", "few_int8.0")
    ] == [*(3, 5, None, None)]


def test_strings_at_their_bounds(library):
    name = "probe_msgs/msg/Bounds"
    message = library.created(name)
    assert library.set(message, name, "word", "string", "abcd")
    assert not library.set(message, name, "word", "string", "abcde")
    assert library.get(message, name, "word", "string") == "abcd"
    small = ctypes.create_string_buffer(b"\xa5" * 8, 8)
    into = library.dll.get_const_char_into
    into.restype = ctypes.c_bool
    arguments = (ctypes.c_void_p(message), library.info(name), b"word", small)
    assert not into(*arguments, ctypes.c_size_t(4))
    assert small.raw == b"\0" * 4 + b"\xa5" * 4
    assert into(*arguments, ctypes.c_size_t(5))
    assert small.raw == b"abcd\0\xa5\xa5\xa5"


@pytest.fixture(scope="module")
def keeping(cc, tools, tmp_path_factory):
    """A library whose get_ functions leave the variable alone when they fail."""
    folder = tmp_path_factory.mktemp("keeping")
    write_folder(folder, generate(TypeStore(), LibraryOrder((JOINTS,), keep_values=True)).files)
    return tools.Library(cc(folder / "library.so", "-shared", "-fPIC", f"-I{folder}", *folder.glob("*.c")))


@pytest.mark.each(3)
@pytest.mark.parametrize("kind", ["bool", "uint8", "int16", "uint32", "int64", "float32", "float64"])
@pytest.mark.parametrize("message", [True, False])
def test_a_variable_that_nothing_is_found_for(library, keeping, kind, message):
    """It is 0, unless the library was generated with --keep-values."""
    width = ctypes.sizeof(library.C_TYPES[kind])
    for made, left in ((library, b"\0"), (keeping, b"\xa5")):
        value = ctypes.create_string_buffer(b"\xa5" * 16, 16)
        given = made.created(JOINTS) if message else None
        assert not getattr(made.dll, f"get_{kind}")(given, made.info(JOINTS), b"position.0", value)
        assert value.raw == left * width + b"\xa5" * (16 - width)


def test_texts_and_sizes_that_nothing_is_found_for(library, keeping):
    for made, left in ((library, b"\0"), (keeping, b"\xa5")):
        text, info = ctypes.create_string_buffer(b"\xa5" * 204, 204), made.info(JOINTS)
        assert not made.dll.get_const_char16(None, info, b"header.frame_id", text)
        assert text.raw == left * 200 + b"\xa5" * 4
        text = ctypes.create_string_buffer(b"\xa5" * 104, 104)
        assert not made.dll.get_const_char(None, info, b"header.frame_id", text)
        assert text.raw == left * 100 + b"\xa5" * 4
        assert not made.dll.get_sequence_size(None, info, b"position", text)
        assert text.raw[:8] == left * 8


def test_null_is_refused(library):
    info, value = library.info(JOINTS), ctypes.c_double(7.0)
    message = library.created(JOINTS)
    dll, name = library.dll, b"header.stamp.sec"
    assert not dll.create_msg(None)
    for arguments in ((None, info, name), (message, None, name), (message, info, None)):
        assert not dll.get_int32(*arguments, ctypes.byref(value))
        assert not dll.set_int32(*arguments, 1)
        assert not dll.resize_sequence(*arguments, 1)
    assert not dll.get_int32(message, info, name, None)
    assert not dll.get_const_char(message, info, b"header.frame_id", None)
    assert not dll.set_const_char(message, info, b"header.frame_id", None)
    assert not dll.from_uint_buffer_to_msg_pointer(None, 0, None, info, None)
    assert not dll.from_msg_pointer_to_uint_buffer(None, None, info, None)
    assert not dll.from_msg_pointer_to_uint_buffer(message, None, None, None)
    assert bytes(value)[:4] == bytes(4)


def test_the_pool_goes_round(library):
    first = [library.created(POSE) for _ in range(4)]
    assert len(set(first)) == 4
    assert [library.created(POSE) for _ in range(4)] == first
    size = ctypes.c_size_t()
    buffers = [
        library.dll.from_msg_pointer_to_uint_buffer(first[0], None, library.info(POSE), ctypes.byref(size))
        for _ in range(5)
    ]
    assert size.value == 76
    assert len(set(buffers)) == 4
    assert buffers[4] == buffers[0]


def test_into_buffers_of_the_caller(library, store):
    message = library.created(POSE)
    assert library.set(message, POSE, "position.x", "float64", 0.25)
    cdr = store.encode(POSE, {"position": {"x": 0.25}})
    envelope = struct.pack("<QQ", 60, 60) + cdr
    info, size = library.info(POSE), ctypes.c_size_t()
    for room in (0, 15, 16, 75, 76, 90):
        buffer = ctypes.create_string_buffer(b"\xa5" * 99, 99)
        status = library.dll.from_msg_pointer_to_uint_buffer_into(
            message, None, info, buffer, room, ctypes.byref(size)
        )
        assert status == (library.OK if room >= 76 else library.NO_SPACE)
        assert size.value == (76 if room >= 76 else 0)
        assert buffer.raw[room:] == b"\xa5" * (99 - room)
    assert buffer.raw[:76] == envelope

    read = library.dll.from_uint_buffer_to_msg_pointer_into
    target, room = library.message(POSE), info.contents.size_of_
    assert read(b"12345678" + envelope, 84, 8, None, info, target, room) == library.OK
    assert library.encode(POSE, target) == (library.OK, cdr)
    assert read(envelope, 75, 0, None, info, target, room) == library.TRUNCATED
    assert read(envelope, 15, 0, None, info, target, room) == library.TRUNCATED
    assert read(envelope, 76, 77, None, info, target, room) == library.TRUNCATED
    assert read(envelope, 76, 0, None, info, target, room - 1) == library.ARGUMENT
    assert read(envelope, 76, 0, None, None, target, room) == library.ARGUMENT
    assert read(b"\xff" * 16 + cdr, 76, 0, None, info, target, room) == library.TRUNCATED


def test_the_classic_reader_trusts_nothing(library, store):
    """With a header in front, its length counts; without, the longest message does."""
    info, size = library.info(POSE), ctypes.c_size_t(5)
    envelope = struct.pack("<QQ", 60, 60) + store.encode(POSE, {})
    read = library.dll.from_uint_buffer_to_msg_pointer
    assert read(envelope, 0, None, info, ctypes.byref(size))
    assert size.value == info.contents.size_of_ == 56
    assert not read(struct.pack("<QQ", 61, 61) + envelope[16:], 0, None, info, ctypes.byref(size))
    assert size.value == 0
    for length, works in ((84, True), (83, False), (85, True), (7, False)):
        packet = struct.pack(">HHHBB", 0x1827, 0, length - 7, 1, 0) + envelope
        assert bool(read(packet, 8, None, info, None)) == works


@pytest.mark.each(2)
@pytest.mark.quick("8/8 be", "1/1")
@pytest.mark.parametrize("envelope", ENVELOPE_FORMATS, ids=str)
def test_envelopes(cc, tmp_path, store, tools, envelope):
    write_folder(
        tmp_path, generate(store, LibraryOrder(("std_msgs/String",), envelope=envelope, pool=1)).files
    )
    out = tmp_path / "library.so"
    made = tools.Library(cc(out, "-shared", "-fPIC", f"-I{tmp_path}", *sorted(tmp_path.glob("*.c"))))
    name = "std_msgs/msg/String"
    message, size = made.created(name), ctypes.c_size_t()
    assert made.set(message, name, "data", "string", "hello")
    assert made.created(name) == message
    assert made.set(message, name, "data", "string", "hello")
    info = made.info(name)
    buffer = made.dll.from_msg_pointer_to_uint_buffer(message, None, info, ctypes.byref(size))
    written = ctypes.string_at(buffer, size.value)
    assert written == envelope.emit(store.encode(name, {"data": "hello"}))
    again = made.dll.from_uint_buffer_to_msg_pointer(written, 0, None, info, None)
    assert made.get(again, name, "data", "string") == "hello"


def test_types_that_are_only_nested_have_no_pool(rover):
    """They cost no memory; what they are made of is known."""
    rover.get_type_info.restype = rover.create_msg.restype = ctypes.c_void_p
    info = ctypes.c_void_p(rover.get_type_info(b"geometry_msgs", b"Point"))
    assert info
    assert rover.create_msg(info) is None


def test_a_mission_compiles_with_cfe(cc, tools, tmp_path):
    mission = load([ROOT / f"samples/missions/two_rovers_{side}.yaml" for side in ("ground", "flight")])
    write_folder(tmp_path, generate(TypeStore(), LibraryOrder(mission=mission)).files)
    source = tmp_path / "app.c"
    source.write_text(
        """\
#include "edoras_mission/packets.h"
typedef struct { CFE_SB_MsgId_t Stream; CFE_SB_Qos_t Flags; uint16_t BufLimit; } Sub;
const Sub subscriptions[] = {
#include "edoras_mission/to_lab_subs.inc"
    {{0}, {0, 0}, 0}};
const uint16_t received[] = EDORAS_MISSION_SUBSCRIPTIONS;
const size_t sizes[] = {sizeof(EdorasMissionPoseTlm1Ground_t), sizeof(EdorasMissionTwistCmd2Flight_t)};
"""
    )
    flags = ("-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-Werror", "-shared", "-fPIC")
    made = ctypes.CDLL(
        str(cc(tmp_path / "app.so", f"-I{tmp_path}", f"-I{tools.HERE / 'c'}", source, flags=flags))
    )
    assert list((ctypes.c_uint16 * 4).in_dll(made, "received")) == [0x1827, 0x1828, 0x1829, 0x182A]
    assert list((ctypes.c_uint32 * 6).in_dll(made, "subscriptions"))[::2] == [0x0828, 0x0829, 0]
    assert list((ctypes.c_size_t * 2).in_dll(made, "sizes")) == [16 + 16 + 140, 16 + 16 + 52]

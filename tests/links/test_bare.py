"""The robot link: told by port, length and likely doubles, in bulk and one by one."""

import math
import struct

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from edoras_tools.decode import ColumnDecoder, Context, Dissector, Options
from edoras_tools.decode.filters.filter import Where
from edoras_tools.decode.filters.layers import structs_of
from edoras_tools.decode.filters.rows import ColumnRows
from edoras_tools.errors import ConfigError
from edoras_tools.links import CFS_PORT, ROBOT_PORT
from edoras_tools.links.bare import ROBOT
from edoras_tools.model import OTHER, PacketBatch
from edoras_tools.structs import Structs, shipped_structs
from edoras_tools.structs.files import parse_key, parse_layout

TWIST = struct.pack("<6d", 0.5, 0, 0, 0, 0, -0.2)
POSE = struct.pack("<7d", 0.5, 0, 0.7, 0, 0, 0, 1)
STATE = struct.pack("<7d2i", 0.1, 0.5, 0, 0, 0, 0, 1, 1795241709, 999_999_999)
STAMPED = struct.pack("<6d", 0, 1795242013.8605866, 1.79e18, 3.16e-322, -1e-70, 0)
TEXT = b'{"jsonrpc": "2.0", "method": "status", "params": [1, 2, 3, 45]}\n'


def batch_of(payload, port, whole):
    """Make a batch of one datagram, of which ``whole`` bytes were on the wire."""
    one = {name: np.array([1], kind) for name, kind in (("number", "i8"), ("time_ns", "i8"))}
    have, zero = np.array([len(payload)], np.int32), np.zeros(1, np.int64)
    return PacketBatch(
        data=np.frombuffer(payload or b"\0", np.uint8),
        **one,
        link_type=np.array([101], np.uint16),
        frame_offset=zero,
        frame_length=have,
        original_length=np.array([whole], np.int32),
        offset=zero,
        length=have,
        source_address=np.array([0x7F000001], np.uint32),
        source_port=np.array([40000], np.uint16),
        destination_address=np.array([0x7F000001], np.uint32),
        destination_port=np.array([port], np.uint16),
        ip_version=np.array([4], np.uint8),
        capture_findings=np.zeros(1, np.uint32),
    )


def link_of(payload, port, whole=None, ports=()):
    """Return the link of a datagram, on which both readers agree, and the names of its layers."""
    context = Context(options=Options(ports=ports))
    batch = batch_of(payload, port, whole or len(payload))
    decoded = Dissector(context).dissect(batch[0])
    assert ColumnDecoder(context).decode(batch).link[0] == decoded.link
    return decoded.link, [layer.name for layer in decoded.layers]


OWN = [
    ("Twist to the robot", TWIST, ROBOT_PORT, "robot_command"),
    ("Pose to the robot", POSE, ROBOT_PORT, "robot_pose"),
    ("state from the robot", STATE, CFS_PORT, "robot_state"),
    ("numbers of a big-endian target", struct.pack(">7d", *range(7)), ROBOT_PORT, "robot_pose"),
    ("all zero", bytes(56), ROBOT_PORT, "robot_pose"),
    ("times, and what a variable happened to hold", STAMPED, ROBOT_PORT, "robot_command"),
]


@pytest.mark.parametrize(
    ("payload", "port", "layer"), [case[1:] for case in OWN], ids=[case[0] for case in OWN]
)
def test_what_is_of_the_robot(payload, port, layer):
    assert link_of(payload, port) == (ROBOT, [layer])


OTHERS = [
    ("Pose to cFS", POSE, CFS_PORT),
    ("Twist to cFS", TWIST, CFS_PORT),
    ("state to the robot", STATE, ROBOT_PORT),
    ("one byte less", POSE[:-1], ROBOT_PORT),
    ("one byte more", POSE + b"\0", ROBOT_PORT),
    ("a Pose with its time", STATE[:56] + bytes(16), ROBOT_PORT),
    ("nothing", b"", ROBOT_PORT),
    ("text as long as a Twist", TEXT[:48], ROBOT_PORT),
    ("text as long as a Pose", TEXT[:56], ROBOT_PORT),
    ("text as long as a state", TEXT, CFS_PORT),
    ("not a number", POSE[:48] + struct.pack("<d", math.nan), ROBOT_PORT),
    ("infinite", POSE[:48] + struct.pack("<d", -math.inf), ROBOT_PORT),
    ("1e30", POSE[:48] + struct.pack("<d", 1e30), ROBOT_PORT),
    ("1e-100", POSE[:48] + struct.pack("<d", 1e-100), ROBOT_PORT),
    ("two byte orders in one", POSE[:48] + struct.pack(">d", 0.7), ROBOT_PORT),
]


@pytest.mark.parametrize(("payload", "port"), [case[1:] for case in OTHERS], ids=[case[0] for case in OTHERS])
def test_what_is_of_others(payload, port):
    assert link_of(payload, port) == (OTHER, [])


def test_what_the_capture_cut_is_told_by_the_rest():
    assert link_of(POSE[:18], ROBOT_PORT, whole=56)[0] is ROBOT
    assert link_of(TEXT[:18], ROBOT_PORT, whole=56)[0] is OTHER


@pytest.mark.parametrize("payload", [TWIST, POSE, STATE])
def test_on_a_port_that_was_named_each_length_counts(payload):
    assert link_of(payload, 9000, ports=((ROBOT, 9000),))[0] is ROBOT
    assert link_of(TEXT[: len(payload)], 9000, ports=((ROBOT, 9000),))[0] is OTHER


@given(payload=st.sampled_from([48, 56, 64]).flatmap(lambda size: st.binary(min_size=size, max_size=size)))
@example(payload=bytes(range(56)))
@example(payload=b"\xff" * 48)
def test_any_bytes_are_judged_as_their_doubles_are(payload):
    port = CFS_PORT if len(payload) == 64 else ROBOT_PORT
    body = payload[:56]

    def likely(value):
        return abs(value) < 2.0**-1022 or 2.0**-256 <= abs(value) < 2.0**64

    orders = (struct.unpack(f"{order}{len(body) // 8}d", body) for order in "<>")
    assert (link_of(payload, port)[0] is ROBOT) == any(all(map(likely, values)) for values in orders)


@given(
    values=st.lists(
        st.floats(-1e6, 1e6).filter(lambda value: not 0 < abs(value) < 1e-70), min_size=7, max_size=7
    )
)
def test_every_pose_is_of_the_robot(values):
    assert link_of(struct.pack("<7d", *values), ROBOT_PORT) == (ROBOT, ["robot_pose"])


LAYOUT = b"""
edoras_structs: 1
byte_order: big
package: rover_msgs
bind: {'udp:9100': rover_command}
structs:
  rover_command: {members: {linear_x: float32, angular_z: float32, mode: uint16}}
"""


def bound(payload, port):
    """Return a datagram of a robot of one's own by both readers: decoded, and the rows of each struct."""
    context = Context(structs=Structs([parse_layout(LAYOUT, "rover"), *shipped_structs().layouts]))
    batch = batch_of(payload, port, len(payload))
    decoded, columns = Dissector(context).dissect(batch[0]), ColumnDecoder(context).decode(batch)
    assert (columns.link[0], columns.findings[0]) == (decoded.link, decoded.findings)
    for expression in ("linear_x > 0", "message", "topic == /cfs/rover_command", "type == RobotCommand"):
        where = Where(expression, context)
        in_bulk = where.mask(batch, columns, np.arange(1)).tolist()
        assert in_bulk == where.judge([decoded]).tolist(), expression
    held = structs_of(ColumnRows(context, 0, batch, columns))
    return decoded, [item.topic for item in held]


def test_the_doubles_have_names_and_are_a_message():
    decoded, topics = bound(TWIST, ROBOT_PORT)
    values = {name: value for name, value in decoded.message.values.items() if name != "header"}
    assert values == decoded.layer("robot_command").values()
    assert values == dict.fromkeys(values, 0) | {"linear_x": 0.5, "angular_z": -0.2}
    assert topics == [decoded.message.topic] == ["/cfs/robot_command"]
    state = bound(STATE, CFS_PORT)[0].message.values
    assert (state["orientation_w"], state["stamp_nanoseconds"]) == (1, 999_999_999)


def test_a_struct_that_is_bound_to_a_port_is_of_the_robot_whatever_it_holds():
    decoded, topics = bound(struct.pack(">ffH", 0.5, -1e30, 7), 9100)
    assert decoded.link is ROBOT
    assert topics == [decoded.message.topic] == ["/cfs/rover_command"]
    assert [field.name for field in decoded.layers[0].fields] == ["linear_x", "angular_z", "mode"]
    assert decoded.message.values["mode"] == 7
    assert bound(struct.pack(">ffHxxx", 0.5, 0, 7), 9100)[0].link is OTHER  # another length


@pytest.mark.parametrize("key", ["udp:0", "udp:65536", "udp:x", "udp:", "udp:robot", "udp:8585/x"])
def test_a_port_that_is_none_is_refused_in_one_line(key):
    with pytest.raises(ConfigError, match=r"^'udp:.*' is not a UDP port as udp:8585, from 1 to 65535$"):
        parse_key(key)


def test_a_struct_with_a_header_is_no_datagram():
    layout = parse_layout(LAYOUT.replace(b"{members:", b"{header: 4, members:"), "rover")
    with pytest.raises(ConfigError, match=r"^rover: udp:9100: rover_command begins with a cFE header"):
        _ = Structs([layout]).all

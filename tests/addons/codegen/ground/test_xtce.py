"""XTCE: judged by ``space_packet_parser`` on real captures, and by what ``inject`` sends."""

import math
import re
import struct
import warnings
from xml.etree import ElementTree as ET

import pytest
from effort import every
from ground_packets import GROUND_SAMPLES, WORD, flat, health_payload, sample_bench, struct_bench, telemetry
from places import CAPTURES, MISSIONS
from rewriting import datagrams
from space_packet_parser.xtce.definitions import XtcePacketDefinition

from edoras_tools.addons.codegen.ground import StringItem, identifier, route_packet, xtce
from edoras_tools.addons.codegen.writing import describe_packets
from edoras_tools.decode import Options
from edoras_tools.errors import ConfigError
from edoras_tools.links import table
from edoras_tools.mission import Route
from edoras_tools.pipelines.sending.replay import Encoder
from edoras_tools.pipelines.workbench import Settings
from edoras_tools.ros import TypeStore
from edoras_tools.wire import cfe

TO_PORT = 1235
NS = "{http://www.omg.org/spec/XTCE/20180204}"


@pytest.fixture
def definition(tmp_path):
    """A function: what the independent reader makes of a description."""

    def load(text):
        path = tmp_path / "x.xml"
        path.write_bytes(text)
        return XtcePacketDefinition.from_xtce(path)

    return load


def parsed(definition, packet):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # bytes behind what is described
        return dict(definition.parse_bytes(packet, root_container_name="CCSDSPacket").items())


@pytest.mark.quick("b_arm_single")
@pytest.mark.parametrize("name", GROUND_SAMPLES)
def test_the_independent_reader_reads_the_values_that_we_do(name, definition):
    bench = sample_bench(name)
    made = definition(describe_packets(bench).text)
    known = telemetry(name, bench)
    compared, told = 0, set()
    first = {item.message.topic: item for item in reversed(known)}
    read = [*first.values(), *every(11, known)]
    for item in read:
        prefix = f"{identifier(item.message.topic.removeprefix('/cfs/'))}_"
        theirs = parsed(made, item.datagram.payload)
        for field, value in flat(item.message.values):
            names = [key for key in theirs if re.fullmatch(f"{prefix}{identifier(field)}(_[0-7])?", key)]
            for key in names:
                compared += 1
                found = theirs[key]
                if isinstance(found, str) and not isinstance(value, str):
                    told.add((field, value, str(found)))
                    found = found.raw_value
                assert found == value or (value == "" and found == ""), field
    assert told >= {("event_type", 2, "info"), ("clock_state", -1, "invalid")}
    assert len(known) > 300
    assert compared > 10 * len(read)


@pytest.mark.quick("6", "9", "15")
@pytest.mark.parametrize("length", [0, 1, 2, 6, 7, 8, 9, 15, 63, 254])
def test_a_string_of_any_length_leaves_the_next_fields_in_place(length, definition):
    route = Route("/odom", "nav_msgs/msg/Odometry", 0x0827, table.link_of_label("to"), "telemetry")
    types = TypeStore()
    packet = route_packet(route, types, 1)
    made = definition(xtce("t", [packet], [], cfe.STANDARD))
    pose = {"position": {"x": 1.5, "y": -2.0, "z": 3.25}}
    names = {"header": {"frame_id": "a" * length}, "child_frame_id": "b" * (254 - length)}
    cdr = types.encode(route.type, {**names, "pose": {"pose": pose, "covariance": [*map(float, range(36))]}})
    data = cfe.emit_telemetry(0x0827, struct.pack("<QQ", len(cdr), len(cdr)) + cdr)
    theirs = parsed(made, data)
    assert packet.whole
    assert theirs[f"odom_header_frame_id_{(length + 1) % 8}"] == "a" * length
    assert [theirs[f"odom_pose_pose_position_{axis}"] for axis in "xyz"] == [1.5, -2.0, 3.25]
    assert theirs["odom_pose_covariance_35_"] == 35.0
    assert theirs["odom_twist_covariance_35_"] == 0.0


def test_what_cannot_be_described_is_left_out_and_told():
    types = TypeStore()
    route = Route("/j", "sensor_msgs/msg/JointState", 0x0827, table.link_of_label("to"), "telemetry")
    packet = route_packet(route, types, 1)
    assert not packet.whole
    assert isinstance(packet.items[-1], StringItem)
    assert all(not follow for follow in packet.items[-1].after)


def test_cfe_housekeeping_is_read_too(definition):
    made = definition(describe_packets(Settings([MISSIONS / "rover_ground.yaml"]).workbench()).text)
    events = [
        item.payload
        for item in datagrams(CAPTURES / "e_ci_errors.pcap")
        if item.destination[1] == TO_PORT and item.payload[:2] == b"\x08\x08"
    ]
    assert len(events) > 10
    for data in events:
        (name,) = [value for key, value in parsed(made, data).items() if key.endswith("_app_name")]
        assert name == data[16:36].split(b"\0")[0].decode()


def test_a_command_is_the_packet_that_inject_sends():
    bench = Settings([MISSIONS / "rover_ground.yaml"]).workbench()
    root = ET.fromstring(describe_packets(bench).text)
    command = root.find(f".//{NS}MetaCommand[@name='cmd_vel']")
    values = {"linear_x": 1.5, "linear_y": -0.25, "angular_z": math.pi}
    data = b""
    for entry in command.iter():
        if entry.tag == f"{NS}FixedValueEntry":
            data += bytes.fromhex(entry.get("binaryValue"))
            assert int(entry.get("sizeInBits")) == 4 * len(entry.get("binaryValue"))
        elif entry.tag == f"{NS}ArgumentRefEntry":
            data += struct.pack("<d", values.get(entry.get("argumentRef"), 0.0))
    (route,) = (item for item in bench.mission.routes if item.topic == "/cmd_vel")
    twist = {"linear": {"x": 1.5, "y": -0.25}, "angular": {"z": math.pi}}
    sent = Encoder.of(route, bench).packet(bench.types.encode(route.type, twist), 0)
    assert data == sent.packet


@pytest.mark.parametrize("order", ["little", "big"])
def test_a_c_struct_is_read_as_a_compiler_lays_it_out(order, definition, tmp_path):
    made = describe_packets(struct_bench(tmp_path, order))
    assert made.notes == [
        "0x1892, Any: no command is described: bind 0x1892/CODE, its function code",
        "Upload: no command is described: its size varies",
    ]
    theirs = parsed(definition(made.text), cfe.emit_telemetry(0x0890, health_payload(order)))
    charge = 700 | 1 << 10 if order == "little" else 700 << 6 | 1 << 5
    names = ("count", "charge_on", "mode", "name", "word")
    assert [theirs[f"Health_{name}"] for name in names] == [7, charge, "DRIVING", "rove", WORD]
    path = [theirs[f"Health_path_{place}__{axis}"] for place in (0, 1) for axis in "xy"]
    assert path == [1.5, 2.5, 3.5, 4.5]


MIXED = """
byte_order: little
bind: {0x0890: Mixed, "0x1890/2": Order}
structs:
  Point: {packed: true, members: {at: "float32[2] big", label: "char[3]"}}
  Mixed:
    packed: true
    members: {a: uint16, b: uint16 big, names: "char[2][4]", grid: "int16[2][3] big",
      points: "Point[2]", c: float64 big}
  Order: {packed: true, members: {x: int32 big, y: int32, z: "uint16[2] big"}}
"""


def test_byte_orders_of_fields_nested_arrays_and_texts(definition, tmp_path):
    """Three readers give what Python's ``struct`` wrote: ours, the independent one, and XTCE that we read."""
    (tmp_path / "own.yaml").write_text(MIXED)
    bench = Settings(structs=[tmp_path / "own.yaml"]).workbench()
    text = describe_packets(bench).text
    (tmp_path / "again.xml").write_bytes(text)
    again = Settings(structs=[tmp_path / "again.xml"]).workbench().columns.context
    points = [(1.5, -2.5, b"ab"), (0.25, 8.0, b"xy")]
    body = struct.pack("<H", 258) + struct.pack(">H", 772) + b"one\0fou\0" + struct.pack(">6h", *range(-3, 3))
    body += b"".join(struct.pack(">2f3s", *item) for item in points) + struct.pack(">d", math.pi)
    theirs = parsed(definition(text), cfe.emit_telemetry(0x0890, body))
    flat_names = [f"Mixed_points_{place}__at_{axis}_" for place in (0, 1) for axis in (0, 1)]
    assert [theirs[name] for name in ("Mixed_a", "Mixed_b", "Mixed_c")] == [258, 772, math.pi]
    assert [theirs[f"Mixed_grid_{place}_"] for place in range(6)] == [*range(-3, 3)]
    assert [theirs[f"Mixed_names_{place}_"] for place in (0, 1)] == ["one", "fou"]
    assert [theirs[name] for name in flat_names] == [1.5, -2.5, 0.25, 8.0]
    for context in (bench.columns.context, again):
        bound = context.structs.find(0x0890, None, len(body))
        values = context.structs.types.decode(bound.type, bound.encode_one(body, (0, 0x0890, 0, 0, 0)))
        assert (values["a"], values["b"], values["c"]) == (258, 772, math.pi)
        assert [*values["grid"]] == [*range(-3, 3)]
        assert [*values["names"]] == ["one", "fou"]
        sent = struct.pack(">i", -5) + struct.pack("<i", 6) + struct.pack(">2H", 7, 8)
        bound = context.structs.find(0x1890, 2, len(sent))
        values = context.structs.types.decode(bound.type, bound.encode_one(sent, (0, 0x1890, 0, 2, 0)))
        assert (values["x"], values["y"], [*values["z"]]) == (-5, 6, [7, 8])


def test_units_calibrations_and_limits(definition, tmp_path):
    """The reader calibrates; limits are where XTCE has them."""
    (tmp_path / "own.yaml").write_text(
        "bind: {0x0890: Own}\nstructs: {Own: {members: {charge: {type: 'uint16', unit: V,"
        " polynomial: [9, 0.01], yellow: [11.5, 16.8], red: [10.5, null]},"
        " plain: {type: int16, red: [-5, 5]}}}}"
    )
    text = describe_packets(Settings(structs=[tmp_path / "own.yaml"]).workbench()).text
    theirs = parsed(definition(text), cfe.emit_telemetry(0x0890, struct.pack("<Hh", 200, -7)))
    assert (theirs["Own_charge"], theirs["Own_charge"].raw_value, theirs["Own_plain"]) == (11.0, 200, -7)
    root = ET.fromstring(text)
    types = {item.get("name"): item for item in root.find(f".//{NS}ParameterTypeSet")}
    found = {
        item.get("name"): [
            (part.tag.removeprefix(NS), part.text, dict(part.attrib))
            for part in types[item.get("parameterTypeRef")].iter()
        ]
        for item in root.iter(f"{NS}Parameter")
    }
    assert ("Unit", "V", {}) in found["Own_charge"]
    assert ("WarningRange", None, {"minInclusive": "11.5", "maxInclusive": "16.8"}) in found["Own_charge"]
    assert ("CriticalRange", None, {"minInclusive": "10.5"}) in found["Own_charge"]
    ranges = [item for item in found["Own_plain"] if item[0].endswith("Range")]
    assert ranges == [("CriticalRange", None, {"minInclusive": "-5", "maxInclusive": "5"})]


def test_msg_ids_of_version_2_are_refused():
    bench = Settings([MISSIONS / "rover_ground.yaml"], options=Options(msg_id_version=2)).workbench()
    with pytest.raises(ConfigError, match="use version 1"):
        describe_packets(bench)

"""OpenC3 COSMOS itself reads what we write for it: telemetry of the samples and our commands, by value."""

import json
import math
import re
import struct
import subprocess

import pytest
from declared_commands import DECLARED, target_text
from ground_packets import (
    DRIVE,
    GROUND_SAMPLES,
    WORD,
    drive_payload,
    flat,
    health_payload,
    sample_bench,
    struct_bench,
    telemetry,
)
from places import MISSIONS, ROOT, SUPPORT
from waiting import PATIENCE_S

from edoras_tools.addons.codegen.ground import PacketItem, cosmos, identifier, route_packet
from edoras_tools.addons.codegen.writing import describe_packets
from edoras_tools.cfs.arguments import ARGUMENTS, BARE_TOO
from edoras_tools.cfs.commands import CALLS, call
from edoras_tools.decode import Options
from edoras_tools.links import table
from edoras_tools.mission import Route
from edoras_tools.pipelines.sending.replay import Encoder
from edoras_tools.pipelines.workbench import Settings
from edoras_tools.ros import TypeStore
from edoras_tools.wire import cfe
from edoras_tools.wire.cfe import WITH_EXTENDED

HOME = ROOT / ".cosmos"
ABSENT = HOME / "absent"
WHY = ABSENT.read_text().strip() if ABSENT.exists() else "OpenC3 COSMOS is not installed: make cosmos"
needs_cosmos = pytest.mark.skipif(not (HOME / ".installed").exists(), reason=WHY)
ROVER = MISSIONS / "rover_ground.yaml"
ONE_STRING = "geometry_msgs/msg/PoseStamped"


def ask(folder, text, questions):
    """Return what COSMOS answers to each question, after it read a target's file without a warning."""
    path = folder / "tlm.txt"
    path.write_bytes(text)
    done = subprocess.run(
        [HOME / "bin/python", SUPPORT / "cosmos_judge.py", path, "ROVER"],
        input="".join(f"{json.dumps(item)}\n" for item in questions),
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    head, *answers = map(json.loads, done.stdout.splitlines())
    assert head == {"warnings": []}
    assert len(answers) == len(questions)
    return answers


def ours(decoded):
    """Return the values of a packet by the names that they have there."""
    leaves = flat(decoded.message.values)
    header = {field.name.upper() for layer in decoded.layers[:2] for field in layer.fields}
    named = {"_".join(filter(None, identifier(name).upper().split("_"))): value for name, value in leaves}
    return {
        f"{name}_2" if name in header else name: value
        for name, value in named.items()
        if not (
            decoded.message.topic.startswith("/cfs/") and name.startswith("HEADER_")
        )  # ours, not the packet's
    }


@pytest.mark.quick("b_arm_single")
@needs_cosmos
@pytest.mark.parametrize("capture", GROUND_SAMPLES)
def test_cosmos_reads_the_values_that_we_do(capture, tmp_path):
    bench = sample_bench(capture)
    made = describe_packets(bench, "rover", for_cosmos=True)
    known = telemetry(capture, bench)
    answers = ask(tmp_path, made.text, [{"read": item.datagram.payload.hex()} for item in known])
    names, compared = set(), 0
    for item, answer in zip(known, answers, strict=True):
        assert answer is not None, item.message.topic
        names.add(answer["packet"])
        theirs = answer["items"]
        header = {field.name: field.value for layer in item.layers[:2] for field in layer.fields}
        for name in ("apid", "packet_sequence_count", "packet_data_length", "seconds", "subseconds"):
            assert theirs[name.upper()] == header[name]
        values = ours(item)
        for name in values.keys() & theirs.keys():
            assert theirs[name] == values[name], (item.message.topic, name)
            compared += 1
        if "REST" not in theirs:  # all of it is described
            assert values.keys() <= theirs.keys(), item.message.topic
    assert len(names) >= 9
    assert len(known) > 300
    assert compared > 10 * len(known)


@pytest.mark.quick("extended header")
@needs_cosmos
@pytest.mark.parametrize("headers", [cfe.STANDARD, cfe.SHORT, WITH_EXTENDED], ids=lambda item: item.name)
def test_a_string_of_any_length_leaves_the_next_fields_in_place(headers, tmp_path):
    types = TypeStore()
    route = Route("/pose", ONE_STRING, 0x0827, table.link_of_label("to"), "telemetry")
    text = cosmos("rover", [route_packet(route, types, 1)], [], headers)
    lengths = [*range(20), 63, 127, 253, 254, 255, 256, 1000]
    questions = []
    for length in lengths:
        pose = {"position": {"x": 1.5, "y": -2.0, "z": length}}
        cdr = types.encode(ONE_STRING, {"header": {"frame_id": "a" * length}, "pose": pose})
        data = cfe.emit_telemetry(0x0827, struct.pack("<QQ", len(cdr), len(cdr)) + cdr, headers=headers)
        questions.append({"read": data.hex()})
    for length, answer in zip(lengths, ask(tmp_path, text, questions), strict=True):
        assert answer["packet"] == f"POSE_{(length + 1) % 8}"
        items = answer["items"]
        assert items["HEADER_FRAME_ID"] == "a" * length
        assert [items[f"POSE_POSITION_{axis}"] for axis in "XYZ"] == [1.5, -2.0, length]


@needs_cosmos
def test_what_follows_a_second_string_or_a_sequence_is_one_block(tmp_path):
    types = TypeStore()
    odometry, joints, text = (
        Route(f"/{name}", kind, msg_id, table.link_of_label("to"), "telemetry")
        for name, kind, msg_id in (
            ("odom", "nav_msgs/msg/Odometry", 0x0827),
            ("joints", "sensor_msgs/msg/JointState", 0x0828),
            ("words", "std_msgs/msg/String", 0x0829),
        )
    )
    sent = {
        odometry: {"header": {"frame_id": "map"}, "child_frame_id": "base"},
        joints: {"header": {"stamp": {"sec": 7}, "frame_id": "map"}, "name": ["a"], "position": [2.0]},
        text: {"data": "hello " * 100},
    }
    questions = []
    for route, values in sent.items():
        cdr = types.encode(route.type, values)
        data = cfe.emit_telemetry(route.msg_id, struct.pack("<QQ", len(cdr), len(cdr)) + cdr)
        questions.append({"read": data.hex()})
    made = cosmos("rover", [route_packet(route, types, 1) for route in sent], [], cfe.STANDARD)
    first, second, third = ask(tmp_path, made, questions)
    assert (first["packet"], second["packet"], third["packet"]) == ("ODOM_4", "JOINTS", "WORDS")
    items = first["items"]
    # The padding behind "base" and its NUL, a pose with its covariance, and a twist with its own.
    assert (items["CHILD_FRAME_ID"], len(items["REST"]) // 2) == ("base", 7 + (7 + 36 + 6 + 36) * 8)
    assert second["items"]["HEADER_STAMP_SEC"] == 7
    assert second["items"]["REST"].startswith("01000000020000006100")
    assert (third["items"]["DATA"], "REST" in third["items"]) == ("hello " * 100, False)


@pytest.mark.quick("extended")
@needs_cosmos
@pytest.mark.parametrize("options", [Options(), Options(extended_header=True)], ids=["usual", "extended"])
def test_a_command_is_the_packet_that_inject_sends(options, tmp_path):
    bench = Settings([ROVER], options=options).workbench()
    made = describe_packets(bench, "rover", for_cosmos=True)
    assert made.commands == 1 + len({key for key, item in ARGUMENTS.items() if item.size} - BARE_TOO)
    values = {"LINEAR_X": 1.5, "LINEAR_Y": -0.25, "ANGULAR_Z": math.pi}
    chosen, default = ask(
        tmp_path, made.text, [{"build": "CMD_VEL", "values": values}, {"build": "CMD_VEL", "values": {}}]
    )
    (route,) = (item for item in bench.mission.routes if item.topic == "/cmd_vel")
    for answer, twist in (
        (chosen, {"linear": {"x": 1.5, "y": -0.25}, "angular": {"z": math.pi}}),
        (default, {}),
    ):
        sent = Encoder.of(route, bench).packet(bench.types.encode(route.type, twist), 0)
        assert answer["hex"] == sent.packet.hex()


@pytest.mark.quick("little")
@needs_cosmos
@pytest.mark.parametrize("order", ["little", "big"])
def test_packets_of_c_structs_are_those_that_a_compiler_lays_out(order, tmp_path):
    made = describe_packets(struct_bench(tmp_path, order), "rover", for_cosmos=True)
    sent = {name.upper(): value for name, value in DRIVE.items()} | {"WORD": WORD.decode()}
    health = cfe.emit_telemetry(0x0890, health_payload(order))
    second, third, reset, read = ask(
        tmp_path,
        made.text,
        [
            {"build": "DRIVE_0X1890_2", "values": sent},
            {"build": "DRIVE_0X1890_3", "values": sent | {"MODE": "DRIVING"}},
            {"build": "RESET", "values": {}},
            {"read": health.hex()},
        ],
    )
    for code, answer in ((2, second), (3, third)):
        expected = cfe.emit_command(0x1890, code, drive_payload(order), sequence_flags=0, with_checksum=False)
        assert answer["hex"] == expected.hex()
    assert reset["hex"] == "1891000000010000"
    items = read["items"]
    charge = 700 | 1 << 10 if order == "little" else 700 << 6 | 1 << 5
    assert (items["COUNT"], items["CHARGE_ON"], items["MODE"], items["NAME"]) == (7, charge, 1, "rove")
    assert [items[f"PATH_{place}_{axis}"] for place in (0, 1) for axis in "XY"] == [1.5, 2.5, 3.5, 4.5]
    assert items["WORD"] == WORD.hex()
    assert read["named"] == {"MODE": "DRIVING"}
    assert "REST" not in items


def test_no_two_items_of_a_packet_share_a_name_and_texts_end_where_they_do(tmp_path):
    folder = tmp_path / "my_msgs/msg"
    folder.mkdir(parents=True)
    (folder / "Clock.msg").write_text("uint32 seconds\nuint8 apid\nfloat64 rest\nuint8[] more\n")
    types = TypeStore(msg_paths=[tmp_path])
    route = Route('/a "clock"', "my_msgs/msg/Clock", 0x0827, table.link_of_label("to"), "telemetry")
    lines = cosmos("t", [route_packet(route, types, 1)], [], cfe.STANDARD).decode().splitlines()
    assert lines[0] == "TELEMETRY T A_CLOCK LITTLE_ENDIAN \"/a 'clock', my_msgs/msg/Clock\""
    names = [line.split()[1] for line in lines[1:]]
    assert len(set(names)) == len(names)
    assert {"SECONDS", "SECONDS_2", "APID", "APID_2", "REST", "REST_2"} <= set(names)


def test_items_follow_each_other():
    route = Route("/pose", "geometry_msgs/msg/Pose", 0x0827, table.link_of_label("to"), "telemetry")
    packet = route_packet(route, TypeStore(), 1)
    lines = cosmos("ROVER", [packet], [], cfe.STANDARD).decode().splitlines()
    assert lines[0] == 'TELEMETRY ROVER POSE LITTLE_ENDIAN "/pose, geometry_msgs/msg/Pose"'
    assert any(re.match(r"  APPEND_ID_ITEM APID 11 UINT 39 ", line) for line in lines)
    bits = sum(int(line.split()[2]) for line in lines[1:])
    assert bits == 8 * (16 + 16 + 4 + 7 * 8)
    assert sum(item.bits for item in packet.items if isinstance(item, PacketItem)) == 8 * (16 + 4 + 56)


@needs_cosmos
def test_commands_with_arguments_are_those_that_cosmos_builds(tmp_path):
    asked = [
        {"build": f"C{number}", "values": {f"P{place}": value for place, (_, value) in enumerate(declared)}}
        for number, (_, _, _, declared) in enumerate(DECLARED)
    ]
    built = ask(tmp_path, target_text("ROVER").encode(), asked)
    assert len(built) >= 40
    for (typed, *_), answer in zip(DECLARED, built, strict=True):
        name, *words = typed.split()
        packet = cfe.emit_command(*CALLS[name], call(name, words), sequence_flags=0, with_checksum=False)
        assert packet.hex() == answer["hex"], typed

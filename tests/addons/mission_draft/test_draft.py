"""A drafted mission file is one, and its own capture decodes with it; its types are those that were sent."""

import re
import struct
from contextlib import closing

import numpy as np
import pytest
from made_system import write
from msgspec.structs import replace
from places import ROOT

from edoras_tools.addons.lab.emulator import WireDatagram
from edoras_tools.addons.mission_draft.draft import read_traffic
from edoras_tools.errors import CaptureError
from edoras_tools.io.formats.open import open_file
from edoras_tools.mission import load, loads
from edoras_tools.model import NO_ROUTE, Finding
from edoras_tools.pipelines.workbench import Settings
from edoras_tools.ros import TypeStore
from edoras_tools.wire.envelope import EnvelopeFormat

WRONG = Finding.CDR_INVALID | Finding.CDR_TOO_LONG | Finding.ENVELOPE_OVERRUN | Finding.TRUNCATED
CAPTURES = {
    "a_rover.pcap": ["rover_ground"],
    "b_arm_single.pcap": ["single_arm_ground"],
    "f_sbn_disconnect.pcap": ["two_rovers_ground", "two_rovers_flight"],
    "d3_cpu1_cpu2.pcap.gz": ["two_rovers_ground"],
}


def drafted(path, settings=None):
    captured, _ = read_traffic(lambda own: (open_file(path), own.workbench()), settings or Settings())
    return captured[0].draft()


@pytest.mark.parametrize(("name", "missions"), CAPTURES.items())
def test_types_and_links_are_those_that_were_sent(name, missions):
    made = drafted(ROOT / "samples/captures" / name)
    mission = loads({"draft.yaml": made.text.encode()}, check_type=TypeStore().check)
    real = load([ROOT / f"samples/missions/{item}.yaml" for item in missions])
    types = {(route.link, route.msg_id): (route.type, route.direction) for route in real.routes}
    found = {(route.link, route.msg_id): (route.type, route.direction) for route in mission.routes}
    common = types.keys() & found.keys()
    assert common
    assert {key: found[key] for key in common} == {key: types[key] for key in common}
    assert mission.warnings == ()
    if name != "d3_cpu1_cpu2.pcap.gz":  # several bridges
        assert [item.command_ingest for item in mission.ground] == [
            item.command_ingest for item in real.ground
        ]
        assert [(item.peer, item.bridge, item.processor_id) for item in mission.flight] == [
            (item.peer, item.bridge, item.processor_id) for item in real.flight
        ]
    assert made.topics == len(mission.routes)


@pytest.mark.each(2)
@pytest.mark.parametrize("name", [*CAPTURES, "e_ci_errors.pcap"])
def test_its_own_capture_decodes_with_it(name, tmp_path):
    path = tmp_path / "draft.yaml"
    path.write_text(drafted(ROOT / "samples/captures" / name).text, encoding="utf-8")
    bench = Settings([path]).workbench()
    decoded = {route.msg_id: 0 for route in bench.mission.routes}
    with closing(open_file(ROOT / "samples/captures" / name)) as source:
        for batch in source.batches():
            columns = bench.columns.decode(batch)
            read = (columns.route != NO_ROUTE) & (columns.cdr_length > 0)
            good = read & ((columns.findings & np.uint32(WRONG)) == 0)
            for msg_id in decoded:
                decoded[msg_id] += int((good & (columns.msg_id == msg_id)).sum())
    assert all(decoded.values())


def test_what_the_mission_has_is_left_out():
    settings = Settings([ROOT / "samples/missions/rover_ground.yaml"])
    with pytest.raises(CaptureError, match="2 MsgIds of it are in the mission already"):
        drafted(ROOT / "samples/captures/a_rover.pcap", settings)
    made = drafted(ROOT / "samples/captures/f_sbn_disconnect.pcap", settings)
    assert "0x828" in made.text
    assert "ci_1827" not in made.text
    assert "1 MsgId left out: the mission has them already" in made.notes


def test_what_is_left_out_is_said():
    notes = drafted(ROOT / "samples/captures/d3_cpu1_cpu2.pcap.gz").notes
    assert "0x18f0 (CI): 4 packets left out: 4 of 4 looked at hold no whole EDORAS envelope" in notes
    assert any(note.endswith("left out: between two cFS") for note in notes)


@pytest.fixture
def commands(tmp_path):
    """A function: a sample whose commands hold other bytes in place of their envelope and CDR."""

    def write(change):
        data = (ROOT / "samples/captures/a_rover.pcap").read_bytes()
        made, count = re.subn(rb"(?s)\x34\0{7}.{8}(\0\x01.{50})", lambda found: change(found[1]), data)
        assert (count, len(made)) == (600, len(data))
        path = tmp_path / "x.pcap"
        path.write_bytes(made)
        return path

    return write


@pytest.mark.parametrize("name", ["4/4 le", "4/4 be", "8/8 be"])
def test_another_envelope_is_named(name, commands):
    envelope = EnvelopeFormat.of_name(name)
    path = commands(lambda cdr: envelope.emit(cdr).ljust(68, b"\0"))
    route = loads({"x.yaml": drafted(path).text.encode()}).find(0x1827)
    assert (route.type, route.envelope) == ("geometry_msgs/msg/Twist", name)


def test_no_type_fits(commands):
    made = drafted(commands(lambda cdr: struct.pack("<QQ", 9, 9) + cdr[:4] + b"\xff" * 48))
    assert "1827" not in made.text
    assert made.notes == [
        "0x1827 (CI): left out: no known type fits 1 different message; give --set msg-path"
    ]


def test_ports_that_no_option_names_are_drafted(tmp_path):
    moved = {1234: 5010, 1235: 5011}
    sent = [
        WireDatagram(
            item.time_ns,
            item.source,
            replace(item.destination, port=moved.get(item.destination.port, item.destination.port)),
            bytes(item.payload),
        )
        for batch in open_file(ROOT / "samples/captures/a_rover.pcap").batches()
        for item in batch
    ]
    text = drafted(write(sent, tmp_path / "moved.pcap")).text
    (ground,) = loads({"draft.yaml": text.encode()}).ground
    assert (ground.fsw_port, ground.bridge_port) == (5010, 5011)
    assert (
        drafted(ROOT / "samples/captures/a_rover.pcap").text.partition("command:")[2]
        == text.partition("command:")[2]
    )

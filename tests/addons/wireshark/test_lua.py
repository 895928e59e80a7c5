"""Structs of own layouts in Wireshark: the values that tshark shows are those that our decoder reads."""

import json
import subprocess

import pytest

from edoras_tools.addons.lab.emulator import WireDatagram
from edoras_tools.addons.wireshark.program import dissector, engine_structs
from edoras_tools.io.formats.open import open_file
from edoras_tools.io.formats.pcap import PcapSink
from edoras_tools.io.frames.frame_batch import frames_of
from edoras_tools.io.frames.linklayer import Demux
from edoras_tools.model import Endpoint
from edoras_tools.pipelines.workbench import Settings
from edoras_tools.structs import Structs
from edoras_tools.structs.files import parse_layout
from edoras_tools.structs.shapes import Key
from edoras_tools.wire import cfe

LAYOUT = """
byte_order: {order}
bind: {{0x0890: Health, 0x1890/2: Drive, 0x1890/3: Stop, udp:8585: Stop}}
enums: {{Mode: {{type: uint8, values: {{IDLE: 0, DRIVING: 1}}}}}}
structs:
  Point: {{members: {{x: float32, y: float64}}}}
  Health: {{members: {{
    count: uint16, charge: {{type: 'uint16:10', unit: V}}, on: 'uint16:1', mode: Mode, name: 'char[5]',
    path: 'Point[2]', levels: 'int16[3]', sum: uint64, flag: bool, serial: uint32 hex, more: 'uint8[]'}}}}
  Drive: {{members: {{speed: int16, angle: float64}}}}
  Stop: {{members: {{}}}}
"""
PAYLOAD = bytes(range(1, 60)) + b"\xff\xfe"


@pytest.mark.parametrize("order", ["little", "big"])
def test_tshark_shows_the_values_that_we_read(tmp_path, order):
    path = tmp_path / "own.yaml"
    path.write_text(LAYOUT.format(order=order))
    settings = Settings([], structs=[path])
    layout = parse_layout(path.read_bytes(), "own")
    body = PAYLOAD + bytes(layout.structs["Health"].size)
    packets = [
        (cfe.emit_telemetry(0x0890, body[: layout.structs["Health"].size]), 1235),
        (cfe.emit_command(0x1890, 2, body[: layout.structs["Drive"].size]), 1234),
        (cfe.emit_command(0x1890, 3), 1234),
        (cfe.emit_telemetry(0x0890, b"short"), 1235),
    ]
    frames, ours = listed(tmp_path, settings, packets)
    health = fields(frames[0], "cfs.Health.")
    values = ours[0].message.values
    assert {
        name: int(health[name], 0) for name in ("count", "charge", "on", "mode", "sum", "flag", "serial")
    } == {name: values[name] for name in ("count", "charge", "on", "mode", "sum", "flag", "serial")}
    assert health["name"] == values["name"]
    assert [int(item) for item in health["levels"]] == [*values["levels"]]
    for axis in "xy":
        shown = [float(item) for item in health[f"path.{axis}"]]
        assert shown == pytest.approx([point[axis] for point in values["path"]], rel=1e-5)
    drive = fields(frames[1], "cfs.Drive.")
    assert int(drive["speed"]) == ours[1].message.values["speed"]
    assert float(drive["angle"]) == pytest.approx(ours[1].message.values["angle"], rel=1e-9)
    assert (ours[2].message.topic, "Stop" in frames[2]["edoras"] or "Stop" in str(frames[2])) == (
        "/cfs/Stop/0x1890/3",
        True,
    )
    assert "struct_length" in str(frames[3])
    assert not any("unknown_msg_id" in str(frame) for frame in frames)


@pytest.mark.parametrize("big", [0, 1])
def test_housekeeping_has_the_values_that_we_read(tmp_path, big):
    mission = tmp_path / "mission.yaml"
    mission.write_text(f"software:\n  ros__parameters:\n    cfs: {{big_endian: {big}}}\n")
    settings = Settings([mission])
    telemetry = [
        item
        for item in Structs(None).all
        if item.key.function_code is None
        and item.key.port is None
        and item.key.msg_id not in (0x0803, 0x0808)
    ]
    assert len(telemetry) == 9
    fits = [(item, bytes(33 + place * 7 % 90 for place in range(item.extent[0]))) for item in telemetry]
    packets = [(cfe.emit_telemetry(item.key.msg_id, body), 1235) for item, body in fits]
    packets += [(cfe.emit_telemetry(item.key.msg_id, body + bytes(3)), 1235) for item, body in fits]
    frames, ours = listed(tmp_path, settings, packets)
    compared = 0
    for (item, _), frame, packet in zip(fits, frames, ours, strict=False):
        theirs = fields(frame, f"cfs.{item.name}.")
        for name, value in flat(packet.message.values):
            if isinstance(value, str):
                assert theirs[name] == value, name
            elif value != []:
                texts = theirs[name] if isinstance(theirs[name], list) else [theirs[name]]
                numbers = [int({"True": "1", "False": "0"}.get(text, text), 0) for text in texts]
                ours_too = value if isinstance(value, list) else [value]
                if isinstance(ours_too[0], bool):
                    numbers = [number != 0 for number in numbers]
                assert numbers == ours_too, name
            compared += 1
    assert compared > 150
    for frame, packet in zip(frames[len(fits) :], ours[len(fits) :], strict=True):
        assert ("struct_length" in str(frame)) == ("struct_length" in packet.findings.labels)
    assert sum("struct_length" in str(frame) for frame in frames) >= 7


def flat(values, path=""):
    """Yield name and value of all that is in a message, with dots between the names."""
    for name, value in values.items():
        if name == "header":
            continue
        if isinstance(value, dict):
            yield from flat(value, f"{path}{name}.")
        else:
            yield f"{path}{name}", value


def listed(folder, settings, packets):
    """Return what tshark shows of packets and their ports, a tree each, and what our decoder says of them."""
    here = Endpoint("127.0.0.1", 40000)
    sent = [
        WireDatagram(place * 10**9, here, Endpoint("127.0.0.1", port), packet)
        for place, (packet, port) in enumerate(packets)
    ]
    capture = folder / "a.pcap"
    with capture.open("wb") as file:
        sink = PcapSink(file, nanosecond=True)
        sink.write(Demux().demux(frames_of(sent, 1)))
        sink.close()
    script = folder / "edoras.lua"
    script.write_text(dissector(settings)[0])
    words = ("tshark", "-r", capture, "-X", f"lua_script:{script}", "-T", "json", "--no-duplicate-keys")
    done = subprocess.run(words, capture_output=True, text=True, check=True)
    assert "Lua" not in done.stderr
    frames = [item["_source"]["layers"] for item in json.loads(done.stdout)]
    bench = settings.workbench()
    ours = [bench.dissector.dissect(item) for batch in open_file(capture).batches() for item in batch]
    return frames, ours


def fields(layers, prefix):
    """Return all values below a name, wherever they stand."""
    found = {}
    for name, value in layers.items():
        if name.startswith(prefix):
            found[name.removeprefix(prefix)] = value
        elif isinstance(value, dict):
            found |= fields(value, prefix)
        elif isinstance(value, list):
            for item in value:
                found |= fields(item, prefix) if isinstance(item, dict) else {}
    return found


def test_what_is_left_to_others():
    made = engine_structs(Structs([parse_layout(LAYOUT.format(order="little").encode(), "own")]))
    assert made["packets"] == {
        0x0890: {"name": "Health", -1: f"struct {Key(0x0890)}"},
        0x1890: {"name": None, 2: f"struct {Key(0x1890, 2)}", 3: f"struct {Key(0x1890, 3)}"},
    }
    cfe_own = engine_structs(Structs(None))
    assert {0x0800, 0x0804, 0x0884} < cfe_own["packets"].keys()
    assert not {0x0803, 0x0808, 0x1806} & cfe_own["packets"].keys()  # these the engine knows by itself
    assert {name for item in cfe_own["packets"].values() for name in item.values() if name} == {
        *cfe_own["layouts"]
    }
    assert "levels" in {item["name"] for item in made["layouts"]["struct 0x0890"]["fields"]}


def test_mission_time_is_read_as_the_mission_file_says(tmp_path):
    (tmp_path / "a.yaml").write_text(
        '/**: {ros__parameters: {cfs: {time: "little, 1/1000 s, since 2000-01-01T12:00:00"}}}'
    )
    settings = Settings([tmp_path / "a.yaml"])
    bench = settings.workbench()
    time = bench.columns.context.time
    packet = cfe.emit_telemetry(0x803, bytes(28), **time.words(1_700_000_000_250_000_000), time=time)
    here, there = Endpoint("127.0.0.1", 40000), Endpoint("127.0.0.1", 1235)
    capture, script = tmp_path / "a.pcap", tmp_path / "edoras.lua"
    batch = Demux().demux(frames_of([WireDatagram(0, here, there, packet)], 1))
    with capture.open("wb") as file:
        sink = PcapSink(file, nanosecond=True)
        sink.write(batch)
        sink.close()
    script.write_text(dissector(settings)[0])
    names = ("cfe.telemetry.seconds", "cfe.telemetry.subseconds", "edoras.mission_time", "edoras.mission_utc")
    words = ("tshark", "-r", capture, "-X", f"lua_script:{script}", "-T", "fields")
    asked = [word for name in names for word in ("-e", name)]
    done = subprocess.run((*words, *asked), capture_output=True, text=True, check=True)
    values = bench.dissector.dissect(batch[0]).layer("cfe_telemetry")
    assert values.fields[0].text == "2023-11-14T22:13:20Z (753272000)"
    seconds, subseconds, both, utc = done.stdout.split()
    assert (seconds, subseconds, float(both), utc) == (
        "753272000",
        "250",
        753272000.25,
        "2023-11-14T22:13:20Z",
    )

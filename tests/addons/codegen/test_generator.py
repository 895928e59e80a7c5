"""The generator app, compiled against cFE's interface and run: it does what the emulated one does."""

from __future__ import annotations

import ctypes

import numpy as np
import pytest

from edoras_tools.addons.codegen.generator import generator_app
from edoras_tools.addons.codegen.writing import write_folder
from edoras_tools.cfs.profile import SimProfile
from edoras_tools.errors import ConfigError
from edoras_tools.ros import TypeStore
from edoras_tools.wire import cfe

lab = pytest.importorskip("edoras_tools.addons.lab.emulator", reason="the emulated app is an add-on's")
generator = pytest.importorskip("edoras_tools.addons.lab.emulator.apps.generator")
FLAGS = (
    *("-std=c99", "-Wall", "-Wextra", "-Werror", "-Wpedantic", "-Wconversion", "-Wcast-align", "-Wcast-qual"),
    *("-Wstrict-prototypes", "-Wwrite-strings", "-Wshadow", "-Wpointer-arith"),
)
SECOND_US = 1_000_000


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    made = tmp_path_factory.mktemp("generator")
    write_folder(made, generator_app(0x18F0))
    return made


@pytest.fixture
def run(cc, tools, folder, tmp_path):
    """A function: give the app commands at their times in s; the result is its library at the end."""

    def fly(*commands, seconds=4.0):
        sources = (folder / "fsw/src/edoras_gen.c", tools.HERE / "c/bus.c")
        flags = (*FLAGS, "-shared", "-fPIC", "-fsanitize=undefined", "-fsanitize-undefined-trap-on-error")
        places = (f"-I{folder / 'fsw/inc'}", f"-I{tools.HERE / 'c'}")
        app = ctypes.CDLL(str(cc(tmp_path / "app.so", *places, *sources, flags=flags)))
        for index, (at, packet) in enumerate(commands):
            (ctypes.c_int64 * 16).in_dll(app, "bus_due")[index] = int(at * SECOND_US)
            place = (ctypes.c_uint8 * 2048).in_dll(app, "bus_commands")
            ctypes.memmove(ctypes.byref(place, index * 128), packet, 64)
        ctypes.c_uint32.in_dll(app, "bus_command_count").value = len(commands)
        ctypes.c_int64.in_dll(app, "bus_end").value = int(seconds * SECOND_US)
        app.EDORAS_GEN_Main()
        return app

    return fly


def command(*numbers, **named):
    return cfe.emit_command(0x18F0, generator.SET, generator.set_command(*numbers, **named)).ljust(64, b"\0")


def published(app):
    size = ctypes.c_size_t.in_dll(app, "bus_published_size").value
    data = bytes((ctypes.c_uint8 * size).in_dll(app, "bus_published"))
    packets = []
    while data:
        length = int.from_bytes(data[4:6], "big") + 7
        packets.append(data[:length])
        data = data[length:]
    return packets, np.array((ctypes.c_int64 * len(packets)).in_dll(app, "bus_times"))


def events(app):
    return (ctypes.c_char * 65536).in_dll(app, "bus_events").value.decode().splitlines()


def emulated(*commands):
    """What the emulated generator says of commands at their times in s, as ``events`` has it."""
    simulation, said = lab.Simulation(SimProfile(), "two-rovers", bridges=False).boot(), []
    for at, packet in commands:
        whole = packet[: int.from_bytes(packet[4:6], "big") + 7]
        simulation.feed(simulation.now + int(at * 1e9), simulation.cfs.ci_endpoint, whole)
    report = simulation.cfs.report

    def listen(event):
        if event.app == generator.NAME:
            said.append(f"{event.event_id} {event.event_type} {event.message}")
        report(event)

    simulation.cfs.report = listen
    list(simulation.run(simulation.now + int(4e9)))
    return said


def test_it_starts(run):
    app = run()
    assert events(app) == ["1 2 EDORAS_GEN initialized, command MID 0x18F0"]
    assert ctypes.c_uint32.in_dll(app, "bus_subscribed").value == 0x18F0
    assert published(app)[0] == []


@pytest.mark.quick("1", "7", "1000")
@pytest.mark.parametrize("rate", [1, 3, 7, 40, 333, 1000, 4000])
def test_rates(run, rate):
    """So many in three seconds, and none more than a millisecond late."""
    app = run((0.5, command(0x8F1, rate, length=20, kind=0)), (3.5, command(0x8F1, 0)))
    packets, times = published(app)
    assert abs(len(packets) - 3 * rate) <= 4
    assert {packet[:2] for packet in packets} == {b"\x08\xf1"}
    assert {len(packet) for packet in packets} == {16 + 20}
    late = times - 0.5 * SECOND_US - np.arange(len(times)) * SECOND_US / rate
    assert ((late > -1.1) & (late < 1001)).all()


def test_it_publishes_what_the_emulated_one_does(run):
    """Lengths, MsgIds, events word for word; of a PoseStamped all but its time and x."""
    given = [(1.0, command(0x828, 5, length=120)), (2.0, command(0x8F2, 10, slot=1, length=33, kind=0))]
    app = run(*given)
    assert events(app)[1:] == emulated(*given)
    assert len(events(app)) == 3
    packets, _ = published(app)
    poses = [packet for packet in packets if packet[:2] == b"\x08\x28"]
    assert len(poses) == 15
    told = TypeStore().decode("geometry_msgs/msg/PoseStamped", poses[-1][32 : 32 + 84])
    assert told["header"]["frame_id"] == "world"
    assert told["header"]["stamp"] == {"sec": 3, "nanosec": 800_000_000}
    assert told["pose"]["orientation"] == {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}
    assert {packet[16:] for packet in packets if packet[:2] == b"\x08\xf2"} == {bytes(33)}


@pytest.mark.each(2)
@pytest.mark.quick("*there is no such slot", "*too long", "*function code 2*", "*telemetry1")
@pytest.mark.parametrize(
    ("packet", "reason"),
    [
        (command(0x8F1, 10, slot=8), "slot 8 refused: there is no such slot"),
        (command(0x18F1, 10), "slot 0 refused: the MsgId is none of telemetry"),
        (command(0, 10), "slot 0 refused: the MsgId is none of telemetry"),
        (command(0xFFFF, 10), "slot 0 refused: the MsgId is none of telemetry"),
        (command(0x8F1, 10, length=65521, kind=0), "slot 0 refused: the message is too long"),
        (command(0x8F1, 10, length=99), "slot 0 refused: a PoseStamped does not fit the length"),
        (cfe.emit_command(0x18F0, 2, bytes(9)), "command refused: function code 2, 17 bytes"),
        (cfe.emit_command(0x18F0, 9, bytes(10)), "command refused: function code 9, 18 bytes"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_what_it_refuses(run, packet, reason):
    app = run((1, packet.ljust(64, b"\0")))
    assert events(app)[1:] == [f"3 3 EDORAS_GEN {reason}"] == emulated((1, packet))
    assert published(app)[0] == []


def test_a_no_op(run):
    packet = cfe.emit_command(0x18F0, 0)
    assert events(run((1, packet.ljust(64, b"\0"))))[1:] == ["4 2 EDORAS_GEN no-op"] == emulated((1, packet))


@pytest.mark.parametrize("msg_id", [0, 0x8F0, 0x17FF, 0x2000])
def test_msg_ids_that_are_none_of_commands(msg_id):
    with pytest.raises(ConfigError, match="a command's MsgId is from 0x1800 to 0x1fff"):
        generator_app(msg_id)


def test_32_bits(cc, tools, folder, tmp_path):
    tools.need_32_bits(cc, tmp_path)
    places = (f"-I{folder / 'fsw/inc'}", f"-I{tools.HERE / 'c'}")
    cc(tmp_path / "app.o", "-c", *places, folder / "fsw/src/edoras_gen.c", flags=(*FLAGS, "-m32"))

"""``edoras structs`` from a source to a recording, and what it says when it cannot."""

import json
import shutil
import subprocess

import here
import pytest
from mcap.reader import make_reader

from edoras_tools.ros import TypeStore
from edoras_tools.wire import cfe

SOURCE = """
#include <stdint.h>
typedef struct { uint8_t Bytes[16]; } CFE_MSG_TelemetryHeader_t;
enum Mode { IDLE, DRIVE };
typedef struct {
    CFE_MSG_TelemetryHeader_t TelemetryHeader;
    struct { uint16_t CommandCounter; enum Mode Mode; char Name[6]; double Pose[2]; } Payload;
} ROVER_HkTlm_t;
typedef struct { int X; } Other_t;
ROVER_HkTlm_t hk;
Other_t other;
"""
needs_gcc = pytest.mark.skipif(shutil.which("gcc") is None, reason="needs gcc")


def edoras(capfd, *arguments):
    """Run a command line; return the exit code, stdout and stderr."""
    import sys

    sys.argv = ["edoras", *map(str, arguments)]
    with pytest.raises(SystemExit) as end:
        here.edoras()
    out, err = capfd.readouterr()
    return end.value.code or 0, out, err


@pytest.fixture
def call(capfd, monkeypatch):
    monkeypatch.setattr("sys.argv", ["edoras"])
    return lambda *arguments: edoras(capfd, *arguments)


@pytest.fixture
def library(tmp_path):
    (tmp_path / "rover.c").write_text(SOURCE)
    made = tmp_path / "rover.so"
    subprocess.run(["gcc", "-g", "-shared", "-fPIC", tmp_path / "rover.c", "-o", made], check=True)
    return made


def capture(path):
    """Write a capture with three packets: two that fit, one that is too short."""
    import struct

    body = struct.pack("<HxxI6sxxdd", 7, 1, b"rover", 0.5, -1.5)
    body = body[:14] + bytes(-14 % 8) + struct.pack("<dd", 0.5, -1.5)
    with path.open("wb") as file:
        file.write(struct.pack("<IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 262144, 101))
        for number, payload in enumerate((body, body, body[:-1])):
            packet = cfe.emit_telemetry(0x0890, payload, sequence_count=number)
            udp = struct.pack(">HHHH", 40000, 1235, 8 + len(packet), 0) + packet
            host = b"\x7f\0\0\1"
            frame = struct.pack(">BBHHHBBH", 0x45, 0, 20 + len(udp), 0, 0, 64, 17, 0) + host + host + udp
            file.write(struct.pack("<IIII", number, 0, len(frame), len(frame)) + frame)
    return path


@needs_gcc
def test_from_a_library_to_a_recording(call, library, tmp_path):
    code, out, _ = call("structs", library)
    assert code == 0
    assert " ".join(out.splitlines()[1].split()) == "ROVER_HkTlm_t 48 2 begins with a header of 16"

    out_dir = tmp_path / "out"
    code, out, err = call(
        "structs", library, "-o", out_dir, "--bind", "0x890=ROVER_HkTlm", "--package", "rover_msgs"
    )
    assert (code, err) == (0, "")
    assert [line.rpartition("/")[2] for line in out.splitlines()] == [
        "CfsHeader.msg",
        "RoverHkTlm.msg",
        "structs.yaml",
    ]
    types = TypeStore(msg_paths=[out_dir])
    assert [item.name for item in types.fields("rover_msgs/msg/RoverHkTlm")] == [
        *("header", "command_counter", "mode", "name", "pose"),
    ]

    packets = capture(tmp_path / "a.pcap")
    code, out, _ = call("sniff", "-r", packets, "--structs", out_dir, "--json")
    first, _, last = map(json.loads, out.splitlines())
    assert (first["topic"], first["message"]["name"], first["message"]["pose"]) == (
        *("/cfs/ROVER_HkTlm", "rover", [0.5, -1.5]),
    )
    assert (last["message"], last["findings"]) == (None, ["struct_length"])
    code, out, _ = call(
        *("sniff", "-r", packets, "--structs", out_dir, "--where", "mode == DRIVE and pose[1] < 0"),
        *("--fields", "number,ROVER_HkTlm.mode,command_counter", "--format", "csv"),
    )
    assert out.splitlines() == ["number,ROVER_HkTlm.mode,command_counter", "1,DRIVE,7", "2,DRIVE,7"]

    recording = tmp_path / "a.mcap"
    code, _, _ = call("record", "-r", packets, "--structs", out_dir, "-o", recording, "-q")
    assert code == 0
    with recording.open("rb") as file:
        found = [
            (channel.topic, types.decode(schema.name, message.data))
            for schema, channel, message in make_reader(file).iter_messages(topics=["/cfs/ROVER_HkTlm"])
        ]
    assert [(topic, values["mode"], values["header"]["sequence_count"]) for topic, values in found] == [
        ("/cfs/ROVER_HkTlm", 1, 0),
        ("/cfs/ROVER_HkTlm", 1, 1),
    ]
    # The recording carries its layout.
    code, out, _ = call("sniff", "-r", recording, "--json", "-n", "1")
    assert json.loads(out)["message"] == first["message"]


@needs_gcc
def test_headers_alone_will_do(call, tmp_path):
    (tmp_path / "inc").mkdir()
    (tmp_path / "inc/types.h").write_text("typedef unsigned short uint16;\n")
    (tmp_path / "app.h").write_text('#include "types.h"\ntypedef struct { uint16 A[N]; void *P; } X_t;\n')
    code, out, _ = call("structs", tmp_path / "app.h", "X", "-I", tmp_path / "inc", "--cflag=-DN=3")
    assert code == 0
    assert out.splitlines() == [
        "struct X_t: 16 bytes, little-endian, cfs_msgs/msg/X",
        "  0  uint16[3]   A  a",
        "  6  2 bytes of padding",
        "  8  uint64 hex  P  p",
    ]


@needs_gcc
def test_headers_of_any_name_and_of_classes(call, tmp_path):
    quoted, classes, empty = tmp_path / 'a "b.h', tmp_path / "c.hpp", tmp_path / "d.h"
    quoted.write_text("struct X { int a; };\n")
    classes.write_text("class Y { int a; };\n")
    empty.touch()
    assert call("structs", quoted)[1].splitlines()[1].split() == ["X", "4", "1"]
    assert call("structs", empty)[1].splitlines() == ["struct   bytes  members  packet"]
    if shutil.which("g++"):
        assert call("structs", classes)[1].splitlines()[1].split() == ["Y", "4", "1"]


@needs_gcc
def test_a_compiler_that_makes_nothing_is_said_in_one_line(call, tmp_path, monkeypatch):
    header = tmp_path / "a.h"
    header.write_text("struct X { int a; };\n")
    for flag, said in (("-fsyntax-only", "the compiler makes no object file"), ("-g0", "it has no debug")):
        code, out, err = call("structs", header, f"--cflag={flag}")
        assert (code, out, err.count("\n")) == (2, "", 1)
        assert err.startswith(f"edoras: {header}: {said}")
    monkeypatch.setenv("CC", 'gcc "')
    assert call("structs", header)[2] == "edoras: CC: 'gcc \"' is not a command: No closing quotation\n"


def test_what_is_shipped_is_listed_and_written(call, tmp_path):
    code, out, _ = call("structs")
    assert code == 0
    lines = [line.split() for line in out.splitlines()]
    assert ["CFE_ES_HousekeepingTlm", "148", "42", "0x0800"] in lines
    assert ["CFE_ES_StopAppCmd", "20", "1", "0x1806/5"] in lines
    code, out, err = call("structs", "cfe", "-o", tmp_path / "out")
    assert (code, err) == (0, "")
    code, again, _ = call("structs", tmp_path / "out")
    assert again == call("structs")[1]


@needs_gcc
def test_nothing_is_written_over_without_being_told(call, library, tmp_path):
    out_dir = tmp_path / "out"
    assert call("structs", library, "ROVER_HkTlm", "-o", out_dir)[0] == 0
    before = {path: path.read_text() for path in out_dir.rglob("*.*")}
    assert call("structs", library, "ROVER_HkTlm", "-o", out_dir)[0] == 0  # the same again
    code, out, err = call(
        "structs", library, "-o", out_dir, "--bind", "0x890=ROVER_HkTlm", "--bind", "0x891=Other"
    )
    assert (code, out) == (2, "")
    assert "structs.yaml: exists and differs, the first of 1; overwrite with --force" in err
    assert {path: path.read_text() for path in out_dir.rglob("*.*")} == before
    assert call("structs", library, "-o", out_dir, "--bind", "0x890=Other", "--force")[0] == 0


@needs_gcc
def test_what_cannot_be_read_is_said_in_one_line(call, library, tmp_path):
    stripped = tmp_path / "stripped.so"
    subprocess.run(["strip", "-o", stripped, library], check=True)
    broken = tmp_path / "broken.so"
    data = bytearray(library.read_bytes())
    broken.write_bytes(data[:200])
    (tmp_path / "bad.h").write_text("struct {\n")
    (tmp_path / "x.txt").write_text("hello")
    (tmp_path / "lib.a").write_bytes(b"!<arch>\n")
    cases = [
        (
            ["structs", stripped],
            "stripped.so: it has no debug information, was stripped or",
        ),
        (["structs", broken], "broken.so: its debug information cannot be read"),
        (["structs", tmp_path / "none.so"], "none.so: cannot be read (No such file or directory)"),
        (["structs", tmp_path / "none.h"], "none.h: no such file; give a C header, or an ELF file"),
        (["structs", tmp_path / "bad.h"], "bad.h: does not compile: "),
        (["structs", tmp_path / "x.txt"], "x.txt: no layout file: it has no 'structs'"),
        (["structs", library, "ROVER_Hk"], "no struct 'ROVER_Hk'; did you mean ROVER_HkTlm_t?"),
        (["structs", library, "--bind", "0x890"], "'0x890' is not MSGID=STRUCT; write 0x0890=ROVER_HkTlm_t"),
        (["structs", library, "--bind", "x=Y"], "'x' is not a MsgId as 0x0801"),
        (
            ["structs", library, "--bind", "0x890=Other", "--bind", "2192=ROVER_HkTlm"],
            "--bind: 0x0890 is bound to Other and to ROVER_HkTlm; leave one out",
        ),
        (["structs", tmp_path / "lib.a"], "lib.a: is an archive; extract its objects with 'ar x"),
        (
            ["structs", library, "X", "--package", "Rover"],
            "--package: 'Rover' is not a ROS package name",
        ),
        (
            ["sniff", "-r", "x.pcap", "--structs", library],
            "rover.so: a program, not a layout",
        ),
    ]
    capture(tmp_path / "x.pcap")
    for arguments, said in cases:
        code, out, err = call(*[tmp_path / "x.pcap" if item == "x.pcap" else item for item in arguments])
        assert (code, out) == (2, ""), arguments
        assert said in err, err
        assert err.count("\n") == 1


def test_without_the_library_the_extra_is_named(call, library, monkeypatch):
    import sys

    for name in [name for name in sys.modules if name.startswith("elftools")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "elftools", None)
    code, _, err = call("structs", library)
    assert (code, err) == (
        *(2, "edoras: debug information is read by pyelftools: pip install 'edoras-tools[elf]'\n"),
    )

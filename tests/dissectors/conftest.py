"""Running tshark with our Lua, and reading what it says."""

import struct
import subprocess
from dataclasses import dataclass, field
from pathlib import Path
from xml.parsers import expat

import pytest

from edoras_tools.pipelines.wireshark import dissector
from edoras_tools.pipelines.workbench import Settings

OURS = "ccsds_sp cfe sbn edoras ros2cdr"
PREFIXES = tuple(f"{name}." for name in (*OURS.split(), "ros2"))


@dataclass
class Frame:
    """What tshark says of one frame: field name to (show, raw bytes as hex) of each occurrence."""

    fields: dict[str, list[tuple[str, str]]] = field(default_factory=dict)
    info: str = ""
    protocol: str = ""


class Tshark:
    """tshark with one generated dissector; whatever it says of Lua fails the test."""

    def __init__(self, script, settings):
        self.script = script
        if settings is not None:
            script.write_text(dissector(settings)[0])

    def run(self, *arguments, script=True):
        lua = ["-X", f"lua_script:{self.script}"] if script else []
        command = ["tshark", "-n", *lua, *map(str, arguments)]
        done = subprocess.run(command, capture_output=True, check=False, timeout=300)
        said = [line for line in done.stderr.decode().splitlines() if line and "Running as user" not in line]
        assert not said, said[:5]
        assert done.returncode == 0
        assert b"Lua Error" not in done.stdout
        return done.stdout

    def frames(self, capture, *options):
        """Return what is said of every frame of a capture, by number: of the tree, and of the columns."""
        found: dict[int, Frame] = {}
        current = Frame()

        def start(name, attributes):
            nonlocal current
            label = attributes.get("name", "")
            if name == "field" and label == "num":
                current = found.setdefault(int(attributes["show"], 0), Frame())
            elif name == "field" and label.startswith(PREFIXES):
                shown = attributes.get("show", ""), attributes.get("value", "")
                current.fields.setdefault(label, []).append(shown)

        parser = expat.ParserCreate()
        parser.StartElementHandler = start
        parser.Parse(self.run("-r", capture, "-T", "pdml", "-J", OURS, *options), True)
        columns = ["-T", "fields", "-e", "frame.number", "-e", "_ws.col.Protocol", "-e", "_ws.col.Info"]
        for line in self.run("-r", capture, *columns, *options).decode().splitlines():
            number, protocol, info = line.split("\t", 2)
            frame = found.setdefault(int(number), Frame())
            frame.protocol, frame.info = protocol, info
        return found


@pytest.fixture(scope="session")
def tshark(tmp_path_factory):
    """Make a tshark that knows missions, or runs a script that is there."""

    def make(*configs, script=None, **settings):
        if script is not None:
            return Tshark(script, None)
        return Tshark(tmp_path_factory.mktemp("lua") / "edoras.lua", Settings(configs, **settings))

    return make


@pytest.fixture(scope="session")
def write_pcap():
    """Write (source port, destination port, payload) as raw IPv4 frames on loopback, 1 ms apart."""

    def write(path, datagrams, *, snap=65535):
        with Path(path).open("wb") as file:
            file.write(struct.pack("<IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 262144, 101))
            for number, (source, destination, payload) in enumerate(datagrams):
                udp = struct.pack(">HHHH", source, destination, 8 + len(payload), 0) + payload
                host = b"\x7f\0\0\1"
                ip = struct.pack(">BBHHHBBH", 0x45, 0, 20 + len(udp), 0, 0, 64, 17, 0) + host + host
                frame = (ip + udp)[:snap]
                second, microsecond = divmod(number * 1000, 1_000_000)
                lengths = len(frame), len(ip + udp)
                file.write(struct.pack("<IIII", second, microsecond, *lengths) + frame)
        return path

    return write

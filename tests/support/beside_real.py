"""The captures of a real cFS, fed into the emulated one at their captured times; what both did with them."""

from __future__ import annotations

import io
import re
import struct
from collections import Counter
from functools import cache
from typing import NamedTuple

import zstandard
from places import ROOT

from edoras_tools.addons.lab.emulator import Simulation
from edoras_tools.cfs.profile import SimProfile
from edoras_tools.units import SECOND

FOLDER = ROOT / "tests/captures"
_EVENT = re.compile(r"^([0-9.]+) .*?EVS Port1 66/1/(\S+) (\d+): (.*)", re.MULTILINE)
_BUSY_HOST = {("CFE_TIME", 20), ("CFE_TIME", 21)}  # FLYWHEEL: the host stood still


class Row(NamedTuple):
    time_ns: int
    source_port: int
    destination_port: int
    payload: bytes


def unpacked(name):
    """The bytes of a file of the folder."""
    with zstandard.open(FOLDER / f"{name}.zst", "rb") as file:
        return io.BytesIO(file.read()).getvalue()


@cache
def rows(name):
    """The UDP datagrams of a capture, read without the code under test."""
    data, at, found = unpacked(f"{name}.pcap"), 24, []
    while at < len(data):
        seconds, micros, length = struct.unpack_from("<III", data, at)
        frame = data[at + 16 : at + 16 + length]
        at += 16 + length
        if frame[23] == 17:
            ports = struct.unpack_from(">HH", frame, 34)
            found.append(Row(seconds * SECOND + micros * 1000, *ports, frame[42:]))
    return found


@cache
def console(name):
    """The console of a capture, with later boots behind the first."""
    texts = [unpacked(f"{name}.cfs.log")]
    if (FOLDER / f"{name}.cfs2.log.zst").exists():
        texts.append(unpacked(f"{name}.cfs2.log"))
    return [text.decode(errors="replace") for text in texts]


def boots(name):
    """When Telemetry Output began, at each boot: seconds since 1970."""
    began = re.compile(r"^([0-9.]+) .*TO_LAB_APP 1:", re.MULTILINE)
    return [float(began.search(text)[1]) for text in console(name)]


class Beside:
    """One capture and the emulated cFS that got the same.

    Args:
        name: of the capture.
        seed: of the emulated cFS.
        constants: of the profile.
    """

    def __init__(self, name, seed=1, **constants):
        self.rows = rows(name)
        began_s = boots(name)
        self.since_s = began_s[0] + 2
        profile = SimProfile(seed=seed, **constants)
        simulation = Simulation(profile, "rover", start_ns=int(began_s[0] * SECOND), bridges=False)
        self.simulation, self.name = simulation, name
        ends = {1234: simulation.cfs.ci_endpoint, 2234: simulation.cfs.sbn_endpoint}
        for row in self.rows:
            if row.destination_port in ends:
                simulation.feed(row.time_ns, ends[row.destination_port], row.payload)
        self.sent = []

    def run(self, until_ns=None):
        """Let time pass, to the end of the capture by default; return this."""
        self.sent += self.simulation.run(until_ns or self.rows[-1].time_ns)
        return self

    def killed(self, killed_s):
        """Run with a cFS that is killed, and begins again as the console says; return this."""
        self.run(int(killed_s * SECOND)).simulation.cfs.halt()
        self.run(int(boots(self.name)[1] * SECOND)).simulation.cfs.boot()
        return self.run()

    @property
    def commands(self):
        """Commands to the robot that were sent."""
        return sum(row.payload[:2] == b"\x18\x27" for row in self.rows)

    @property
    def reached(self):
        """Commands that reached the robot: in flight, and emulated."""
        return sum(
            row.destination_port == 8585 for row in self.rows
        ), self.simulation.apps.edoras.robot_commands

    def steps(self):
        """Run a capture of rates; yield each rate, its commands, how many reached the robot in both."""
        begins = [row.time_ns for row in self.rows if row.payload[:2] == b"\x18\x01"]
        ends = [*begins[1:], self.rows[-1].time_ns + SECOND]
        for begin, end in zip(begins, ends, strict=True):
            part = [row for row in self.rows if begin <= row.time_ns < end]
            sent = [row.time_ns for row in part if row.payload[:2] == b"\x18\x27"]
            if len(sent) > 1:
                rate = round((len(sent) - 1) * SECOND / (sent[-1] - sent[0]))
                before = self.reached[1]
                yield (
                    rate,
                    len(sent),
                    sum(row.destination_port == 8585 for row in part),
                    self.run(end).reached[1] - before,
                )

    def events(self):
        """How often each event came since it ran, by application and number: in flight, and emulated."""
        lines = "\n".join(f"{time_ns / SECOND:.6f} {text}" for time_ns, text in self.simulation.cfs.console)
        return self._counted("\n".join(console(self.name))), self._counted(lines)

    def _counted(self, text):
        booting = [(began - 4, began + 0.5) for began in boots(self.name)[1:]]
        found = ((float(item[1]), (item[2], int(item[3]))) for item in _EVENT.finditer(text))
        return Counter(
            event
            for when, event in found
            if when > self.since_s and event not in _BUSY_HOST and not any(a < when < b for a, b in booting)
        )

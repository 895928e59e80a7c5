"""Wireshark brings Lua 5.2 up to 4.2 and may bring 5.4 from 4.4 on: the script says the same under both."""

import random
import shutil
import subprocess
from contextlib import closing
from pathlib import Path

import pytest
from fprime_session import DICTIONARY
from places import ROOT

from edoras_tools.addons.wireshark.program import dissector
from edoras_tools.io.formats.open import open_file
from edoras_tools.pipelines.workbench import Settings

LUAS = ["lua5.2", "lua5.4"]


def rows():
    """Yield the datagrams of the captures, and some with bytes changed or cut."""
    chance = random.Random(9)
    names = "captures/a_rover", "captures/e_ci_errors", "captures/f_sbn_disconnect", "fprime/rover"
    for name in names:
        with closing(open_file(ROOT / f"samples/{name}.pcap")) as source:
            for batch in source.batches():
                for row in range(len(batch)):
                    datagram = batch[row]
                    ports = datagram.source.port, datagram.destination.port
                    yield (*ports, datagram.payload)
                    changed = bytearray(datagram.payload[: chance.randrange(len(datagram.payload) + 1)])
                    for _ in range(min(len(changed), 2)):
                        changed[chance.randrange(min(len(changed), 40))] = chance.choice((0, 1, 4, 128, 255))
                    yield (*ports, bytes(changed))


@pytest.mark.skipif(not all(map(shutil.which, LUAS)), reason="needs lua5.2 and lua5.4: make judges")
def test_both_luas_say_the_same(tmp_path):
    table = tmp_path / "datagrams.txt"
    lines = [f"{number} {source} {to} {data.hex()}" for number, (source, to, data) in enumerate(rows(), 1)]
    table.write_text("\n".join(lines) + "\n")
    script = tmp_path / "edoras.lua"
    script.write_text(dissector(Settings(structs=[DICTIONARY]))[0])
    command = [Path(__file__).with_name("wslua.lua"), script, table]
    old, new = (subprocess.run([lua, *command], capture_output=True, text=True, check=False) for lua in LUAS)
    assert (old.stderr, old.returncode) == (new.stderr, new.returncode) == ("", 0)
    assert old.stdout == new.stdout
    assert old.stdout.count("ros2.geometry_msgs.Twist.linear.x") > 600
    assert old.stdout.count("fprime.events.Rover.drive.ModeChanged.mode") >= 2

"""``w``: what the list shows goes to Wireshark, at the same packet."""

import os
import struct
import sys

import pytest
from waiting import until

from edoras_tools.addons.tui import viewer
from edoras_tools.errors import CaptureError

PRETENDER = """#!{python}
import shutil, sys
if "--version" in sys.argv:
    print("Wireshark 4.0.17 with Lua 5.2.4")
elif __import__("os").path.exists("{folder}/fails"):
    sys.exit(3)
else:
    shutil.copy(sys.argv[sys.argv.index("-r") + 1], "{folder}/seen.pcapng")
    open("{folder}/done", "w").write("\\n".join(sys.argv[1:]))
"""


@pytest.fixture
def pretender(tmp_path, monkeypatch):
    """A program called wireshark that keeps what it was given."""
    program = tmp_path / "bin/wireshark"
    program.parent.mkdir()
    program.write_text(PRETENDER.format(python=sys.executable, folder=tmp_path))
    program.chmod(0o755)
    monkeypatch.setenv("DISPLAY", ":99")
    monkeypatch.setenv("PATH", f"{program.parent}{os.pathsep}{os.environ['PATH']}")
    return tmp_path


def blocks(data):
    """The types of a pcapng file's blocks, by its definition."""
    at, found = 0, []
    while at < len(data):
        kind, length = struct.unpack_from("<II", data, at)
        found.append(kind)
        at += length
    return found


def test_wireshark_gets_what_is_shown_and_goes_to_the_packet(drive, pretender):
    async def script(hands):
        await hands.filter("msg_id == 0x082a")
        await hands.settle()
        await hands.press("j", "j", "w")
        await hands.until((pretender / "done").exists, "Wireshark has run")
        await hands.until(lambda: "Wireshark opens at packet 3" in hands.status, "that is said")

    drive(script)
    arguments = (pretender / "done").read_text().splitlines()
    assert arguments[arguments.index("-g") + 1] == "3"
    assert blocks((pretender / "seen.pcapng").read_bytes()).count(6) == 57
    folder = os.path.dirname(arguments[arguments.index("-r") + 1])  # noqa: PTH120  a name, no file
    until(lambda: not os.path.exists(folder), "the files are gone")  # noqa: PTH110


def test_wireshark_without_a_display_is_one_line(drive, pretender, monkeypatch):
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)

    async def script(hands):
        await hands.press("w")
        await hands.until(lambda: "Wireshark needs a display" in hands.status, "the reason")
        monkeypatch.setenv("DISPLAY", ":99")
        (pretender / "fails").touch()
        await hands.press("w")
        await hands.until(lambda: "Wireshark ended with exit code 3" in hands.status, "it ended at once")

    drive(script, size=(120, 30))


def test_absent_is_said(monkeypatch):
    monkeypatch.setenv("PATH", "/nowhere")
    with pytest.raises(CaptureError, match="wireshark is not installed"):
        viewer.open_in_wireshark([], 0, None)

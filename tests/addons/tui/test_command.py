"""``sniff --tui`` on a terminal of its own, and where it cannot be."""

import os
import pty
import re
import select
import struct
import subprocess
import sys
import time
from fcntl import ioctl
from io import FileIO
from pathlib import Path
from termios import TIOCSWINSZ

import pytest
from places import ROOT
from waiting import PATIENCE_S

from edoras_tools.addons.tui.viewer import TerminalOutput
from edoras_tools.cli import main

EDORAS = Path(sys.executable).with_name("edoras")
CAPTURE = ROOT / "samples/captures/a_rover.pcap"


def call(monkeypatch, capsys, *arguments):
    monkeypatch.setattr(sys, "argv", ["edoras", *map(str, arguments)])
    with pytest.raises(SystemExit) as ending:
        main.run(main.program("sniff"))
    return ending.value.code, capsys.readouterr().err.splitlines()


def test_without_textual_it_says_what_to_install(monkeypatch, capsys):
    monkeypatch.setattr("edoras_tools.addons.tui.cli.find_spec", lambda name: None)
    code, err = call(monkeypatch, capsys, "sniff", "--tui", "-r", CAPTURE)
    assert (code, err) == (2, ["edoras: --tui needs textual: pip install 'edoras-tools[tui]'"])


def test_without_a_terminal_it_says_so(monkeypatch, capsys):
    code, err = call(monkeypatch, capsys, "sniff", "--tui", "-r", CAPTURE)
    assert code == 2
    assert len(err) == 1
    assert "needs a terminal" in err[0]


def test_it_is_one_view_of_several(monkeypatch, capsys):
    code, err = call(monkeypatch, capsys, "sniff", "--tui", "-V", "-r", CAPTURE)
    assert (code, err) == (2, ["edoras: -V and --tui exclude each other; choose one"])


class Terminal:
    """A command on a pseudo-terminal of 80x24, its input given or the terminal itself."""

    def __init__(self, *arguments, stdin=None):
        self.seen = b""
        self._master, slave = pty.openpty()
        ioctl(slave, TIOCSWINSZ, struct.pack("HHHH", 24, 80, 0, 0))
        self.process = subprocess.Popen(
            [EDORAS, "sniff", "--tui", *arguments],
            stdin=slave if stdin is None else stdin,
            stdout=slave,
            stderr=slave,
            env=os.environ | {"TERM": "xterm-256color"},
            start_new_session=True,
            preexec_fn=lambda: ioctl(slave, 0x540E, 0),  # noqa: PLW1509  TIOCSCTTY: it is the process's own
        )
        os.close(slave)

    def until(self, text):
        deadline = time.monotonic() + PATIENCE_S
        while text not in re.sub(rb"\x1b\[[0-9;?]*[a-zA-Z]", b"", self.seen):
            assert time.monotonic() < deadline, f"{text} never came: {self.seen[-2000:]}"
            if select.select([self._master], [], [], 0.1)[0]:
                try:
                    self.seen += os.read(self._master, 65536)
                except OSError:  # the other end is closed
                    assert text in self.seen
                    return

    def press(self, keys):
        os.write(self._master, keys)

    def end(self):
        deadline = time.monotonic() + PATIENCE_S
        while self.process.poll() is None:
            assert time.monotonic() < deadline, "it did not end"
            if select.select([self._master], [], [], 0.05)[0]:
                try:
                    self.seen += os.read(self._master, 65536)
                except OSError:
                    self.process.wait(PATIENCE_S)
        os.close(self._master)
        return self.process.returncode


def test_what_goes_to_a_closed_terminal_is_dropped():
    master, slave = pty.openpty()
    with FileIO(slave, "w") as plain:
        output = TerminalOutput(plain)
        output.write(b"a")
        assert os.read(master, 1) == b"a"
        os.close(master)
        with pytest.raises(OSError, match="Input/output"):
            plain.write(b"b")
        output.write(b"b")
        output.flush()


@pytest.fixture
def on_terminal():
    """A function: run the command on a terminal; what still runs at the end is killed."""
    made = []

    def run(*arguments, **keywords):
        made.append(Terminal(*arguments, **keywords))
        return made[-1]

    yield run
    for terminal in made:
        if terminal.process.poll() is None:
            terminal.process.kill()
            terminal.end()


@pytest.mark.quick("q")
@pytest.mark.parametrize("key", [b"q", b"\x03"])
def test_it_runs_on_a_terminal_and_gives_it_back(key, on_terminal):
    terminal = on_terminal("-r", str(CAPTURE))
    terminal.until(b"1,827 packets")
    terminal.press(key)
    assert terminal.end() == 0
    assert b"\x1b[?1049l" in terminal.seen  # back on the screen that was there before
    assert b"Traceback" not in terminal.seen


@pytest.mark.long
def test_a_pipe_gives_packets_while_the_terminal_gives_keys(on_terminal):
    reading, writing = os.pipe()
    terminal = on_terminal("-r", "-", stdin=reading)
    os.close(reading)
    data = CAPTURE.read_bytes()
    os.write(writing, data[:30_000])
    terminal.until(b"219 packets")
    terminal.press(b"q")
    assert terminal.end() == 0
    os.close(writing)

"""The programs that a shell starts: Ctrl-C at any moment ends them without a word."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
import typer
from places import ROOT

from edoras_tools import __version__
from edoras_tools.cli.main import INTERRUPTED, run
from edoras_tools.errors import ConfigError

WHILE_READING = "import os, signal, edoras_tools.cli.programs; os.kill(os.getpid(), signal.SIGINT)"

AT_ONCE = """
import os, signal, sys

class AtOnce:
    def find_spec(self, name, path=None, target=None):
        if not name.startswith("edoras_tools"):
            os.kill(os.getpid(), signal.SIGINT)

for name in ("__future__", "importlib", "warnings", "typing", "gc", "contextlib"):
    sys.modules.pop(name, None)
sys.meta_path.insert(0, AtOnce())
import edoras_tools.cli.programs
"""
"""Ctrl-C as soon as a first module is loaded that is none of ours."""


@pytest.mark.parametrize("code", [WHILE_READING, AT_ONCE])
def test_ctrl_c_while_modules_are_read(code):
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (-signal.SIGINT, "", "")


def test_who_is_not_to_hear_ctrl_c_does_not():
    deaf = f"import signal; signal.signal(signal.SIGINT, signal.SIG_IGN); {WHILE_READING}; print('here')"
    done = subprocess.run([sys.executable, "-c", deaf], capture_output=True, text=True, check=True)
    assert (done.stdout, done.stderr) == ("here\n", "")


def test_a_file_s_own_words_steer_no_terminal(capfd, monkeypatch):
    made = typer.Typer()

    @made.command()
    def work():
        raise ConfigError("x.msg: \x1b]0;mine\x07 is not a type", "y.msg: all\u202egood")

    monkeypatch.setattr(sys, "argv", ["work"])
    with pytest.raises(SystemExit) as end:
        run(made)
    assert end.value.code == ConfigError.exit_code
    assert capfd.readouterr().err.splitlines() == [
        r"edoras: x.msg: \x1b]0;mine\x07 is not a type",
        r"edoras: y.msg: all\u202egood",
    ]


def test_ctrl_c_in_a_command(capfd, monkeypatch):
    monkeypatch.setattr("os.dup2", lambda *_: None)  # the test's own output stays
    made = typer.Typer()

    @made.command()
    def work():
        raise KeyboardInterrupt

    monkeypatch.setattr(sys, "argv", ["work"])
    with pytest.raises(SystemExit) as end:
        run(made)
    assert end.value.code == INTERRUPTED
    assert capfd.readouterr().err.strip() == ""


@pytest.mark.each(2)
@pytest.mark.quick("edoras", "edoras-proxy")
@pytest.mark.parametrize("name", ["edoras", "edoras-sniff", "edoras-record", "edoras-replay", "edoras-proxy"])
def test_every_program_has_a_version(name):
    program = str(Path(sys.executable).with_name(name))
    done = subprocess.run([program, "--version"], capture_output=True, text=True, check=True)
    assert done.stdout == f"edoras-tools {__version__}\n"


def test_the_package_is_a_program():
    line = [sys.executable, "-m", "edoras_tools", "--version"]
    done = subprocess.run(line, capture_output=True, text=True, check=True)
    assert done.stdout == f"edoras-tools {__version__}\n"


CAPTURE = str(ROOT / "samples/captures/a_rover.pcap")


@pytest.mark.each(3)
@pytest.mark.quick("always-*", "never-*")
@pytest.mark.parametrize(
    ("when", "environ", "coloured"),
    [
        ("always", {}, True),
        ("always", {"NO_COLOR": "1"}, True),
        ("never", {"FORCE_COLOR": "1"}, False),
        ("auto", {}, False),
        ("auto", {"FORCE_COLOR": "1"}, True),
    ],
)
def test_colour_is_asked_for(when, environ, coloured, call, monkeypatch):
    for name in ("FORCE_COLOR", "NO_COLOR"):
        monkeypatch.setenv(name, environ.get(name, ""))
    for line in (("info", CAPTURE, "--color", when), ("--color", when, "sniff", CAPTURE, "-n", 3)):
        done = call(*line)
        assert done.code == 0
        assert ("\x1b[" in done.out) == coloured


def test_an_unknown_colour(call):
    done = call("info", CAPTURE, "--color", "yes")
    assert (done.code, "'yes' is not auto, always or never" in done.err[0]) == (2, True)


MISSION = str(ROOT / "samples/missions/rover_ground.yaml")


@pytest.mark.each(3)
@pytest.mark.quick("edoras sn*", "*--msg-id*", "*rover_ground*")
@pytest.mark.parametrize(
    ("line", "told"),
    [
        ("edoras sn", {"sniff"}),
        ("edoras sniff --dur", {"--duration"}),
        ("edoras sniff --set tel", {"telemetry-header="}),
        ("edoras wireshark pa", {"path"}),
        ("edoras mission ", {"draft"}),
        ("edoras help doc", {"doctor"}),
        ("edoras help wireshark p", {"path", "print"}),
        ("edoras help nothing ", set()),
        ("edoras sniff --link s", {"sbn"}),
        ("edoras sniff --msg-id TO_C", {"TO_CMD"}),
        (f"edoras sniff -c {MISSION} --topic /c", {"/cmd_vel"}),
        ("edoras sniff -c nowhere.yaml --topic /", set()),
    ],
)
def test_a_shell_completes(line, told, edoras):
    words = {"COMP_WORDS": line, "COMP_CWORD": str(line.count(" ")), "_EDORAS_COMPLETE": "complete_bash"}
    done = edoras(env={**os.environ, **words})
    assert (done.returncode, done.stderr) == (0, b"")
    assert set(done.stdout.decode().split()) == told


@pytest.mark.parametrize("option", ["--install-completion", "--show-completion"])
def test_what_follows_an_option_about_completion_is_not_ignored(option, call):
    done = call(option, "zsh")
    assert (done.code, done.out) == (2, "")
    assert f"{option} takes no value: run it alone, in the shell that it is for" in done.err[0]

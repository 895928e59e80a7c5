"""The programs that a shell starts: Ctrl-C at any moment ends them without a word."""

from __future__ import annotations

import signal
import subprocess
import sys

import pytest
import typer

from edoras_tools.cli.main import INTERRUPTED, run
from edoras_tools.errors import ConfigError

WHILE_READING = "import os, signal, edoras_tools.cli.programs; os.kill(os.getpid(), signal.SIGINT)"


def test_ctrl_c_while_modules_are_read():
    done = subprocess.run([sys.executable, "-c", WHILE_READING], capture_output=True, text=True, check=False)
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

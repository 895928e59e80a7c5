"""What commands print."""

import sys

import pytest

from edoras_tools.cli.output import print_csv


@pytest.mark.parametrize("terminal", [False, True])
def test_csv_on_a_terminal_cannot_drive_it(terminal, monkeypatch, capsys):
    monkeypatch.setattr(sys.stdout, "isatty", lambda: terminal)
    print_csv([{"a\x1b[2J": "\x9bm", "b": ["\x9b"], "c": 1}])
    said = capsys.readouterr().out
    assert ("\x1b" in said, "\x9b" in said) == (not terminal, not terminal)
    assert said.splitlines()[1].endswith(",1")

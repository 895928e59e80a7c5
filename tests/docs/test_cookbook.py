"""Every command of the cookbook is one that can be typed."""

import re
import shlex

import pytest
import typer
from places import ROOT

from edoras_tools.cli.main import program

PAGES = ("cookbook", "troubleshooting", "settings")
LINES = [
    line
    for page in PAGES
    for line in re.findall(r"`(edoras [a-z][^`]*)`", (ROOT / f"docs/{page}.md").read_text(encoding="utf-8"))
    if not re.search(r"COMMAND|CAPTURE|\.\.\.", line)
]
EDORAS = typer.main.get_command(program())


def test_there_are_commands():
    assert len(LINES) > 50


@pytest.mark.parametrize("line", LINES)
def test_it_parses(line, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)  # no settings
    command, context = EDORAS, EDORAS.make_context("edoras", [], resilient_parsing=True)
    words = shlex.split(line.partition(" | ")[0])[1:]
    while hasattr(command, "commands"):
        command, name = command.commands[words[0]], words.pop(0)
    if {"-h", "--help"}.isdisjoint(words):
        assert command.make_context(name, words, parent=context).args == []

"""The door to add-ons and to packages of other people: what each adds is found by name, and loaded late."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest
import typer
from typer.testing import CliRunner

from edoras_tools import addons, doors
from edoras_tools.addons import Addon, ListedCommand
from edoras_tools.cli import main, options
from edoras_tools.diagnosis.rules import rules, shipped_rules
from edoras_tools.errors import ConfigError
from edoras_tools.io.formats.table import installed_formats
from edoras_tools.links.table import links
from edoras_tools.middleware.graph import middleware
from edoras_tools.structs.files import parse_layout

GONE = Addon(
    "gone",
    commands={"vanish": ListedCommand("Send", "Do what the folder did.", "cli:vanish", before="proxy")},
    adds={"parts": {"show": "view:show"}, "middleware": {"smoke": "graph:SMOKE"}},
)
MODULE = """
def hello(times: int = 1) -> None:
    \"\"\"Greet the modem.\"\"\"
    print("hello " * times)

VALUE = 7

def quiet(case):
    yield from ()

def read(data, name):
    return parse_layout(data.removeprefix(b"MODEM "), name)

from edoras_tools.structs.files import Database, parse_layout
FILES = Database(lambda data: data.startswith(b"MODEM "), read)
"""


@pytest.fixture
def table(monkeypatch):
    """The table with a row whose folder does not exist."""
    monkeypatch.setattr(addons, "ADDONS", (*addons.ADDONS, GONE))
    groups = main._groups()
    monkeypatch.setattr(main, "GROUPS", groups)
    monkeypatch.setattr(main, "COMMANDS", {name: group for group, names in groups.items() for name in names})


@pytest.fixture
def package(tmp_path, monkeypatch):
    """A function that installs a package with some entry points, as pip would lay it out."""

    def install(**groups):
        (tmp_path / "modem_tools.py").write_text(MODULE)
        info = tmp_path / "modem_tools-1.0.dist-info"
        info.mkdir()
        (info / "METADATA").write_text("Metadata-Version: 2.1\nName: modem-tools\nVersion: 1.0\n")
        (info / "entry_points.txt").write_text(
            "\n".join(f"[edoras.{group}]\n{line}\n" for group, line in groups.items())
        )
        monkeypatch.syspath_prepend(tmp_path)
        return tmp_path

    yield install
    sys.modules.pop("modem_tools", None)


def run(*words):
    names = [word for word in words[:1] if main.is_command(word)]
    return CliRunner().invoke(main.program(*names), words)


def test_what_an_absent_add_on_added_is_refused_in_one_line(table):
    for item in (doors.shipped("middleware")["smoke"], doors.find("parts", "show")):
        assert item.absent
        with pytest.raises(ConfigError, match="of the add-on gone: it is left out of this installation"):
            item.load()
    with pytest.raises(ConfigError, match="part 'show' of the add-on gone"):
        doors.part("show")


def test_its_command_is_still_listed_and_ends_with_that_line(table):
    listed = run("--help").output.splitlines()
    (line,) = (item for item in listed if " vanish " in f"{item} ")
    assert line.endswith("Do what the folder did (not in this installation).")
    assert listed.index(line) + 1 == listed.index(next(item for item in listed if " proxy " in item))
    assert "(not in this installation)" in run("vanish", "--help").output
    for words in ([], ["a.pcap", "--json", "-o", "x"], ["--never-heard-of"]):
        ended = run("vanish", *words)
        assert isinstance(ended.exception, ConfigError), ended.output
        assert "command 'vanish' of the add-on gone" in str(ended.exception)


def test_every_row_of_the_table_is_as_its_code_says():
    for row in addons.ADDONS:
        for kind in doors.KINDS:
            for name in row.places(kind):
                item = doors.shipped(kind)[name]
                assert item.absent or item.load() is not None
        for name, command in row.commands.items():
            assert command.group in main.GROUPS
            made = typer.main.get_command(main.program(name)).commands[name]
            sentence = made.help.partition("\n\n")[0].split(". ")[0]
            assert row.commands[name].help == (sentence if sentence[-1] in ".?" else f"{sentence}.")


def test_a_package_adds_a_command(package):
    package(commands="hello = modem_tools:hello")
    assert main.is_command("hello")
    assert run("hello", "--times", "2").output == "hello hello \n"
    assert "Installed hello" in " ".join(run("--help").output.split())
    assert not main.is_command("--times")


def test_a_package_is_not_imported_before_its_name_is_asked_for(package):
    package(commands="hello = modem_tools:hello", rules="slow = modem_tools:VALUE")
    (item,) = doors.installed("rules")
    assert (item.name, item.package, item.absent) == ("slow", "modem-tools", False)
    assert "modem_tools" not in sys.modules
    assert item.load() == 7
    assert doors.find("rules", "none") is None


def test_a_command_that_cannot_be_loaded_does_not_hide_the_others(package):
    package(commands="hello = modem_tools:goodbye")
    assert "Cannot be loaded (not in this installation)." in run("--help").output
    ended = run("hello", "--times", "2")
    assert "command 'hello' of the installed package modem-tools: cannot be loaded" in str(ended.exception)


def test_the_core_and_its_add_ons_are_asked_first(package):
    package(commands="info = modem_tools:hello")
    assert "hello" not in run("info", "--help").output


@pytest.mark.each(3)
@pytest.mark.parametrize(
    ("line", "opened"),
    [("info --help", False), ("hello", True), ("nonsense", True)],
)
def test_packages_are_looked_at_only_where_that_is_needed(package, line, opened):
    folder = package(commands="hello = modem_tools:hello")
    program = """
import json, sys
from pathlib import Path
looked = []
sys.addaudithook(lambda name, what: looked.append(str(what[0])) if name == "open" else None)
sys.argv = ["edoras", *sys.argv[1:]]
from edoras_tools.cli import main, options
try:
    main.run(main.program(*(word for word in sys.argv[1:2] if main.is_command(word))))
except SystemExit:
    sys.stderr.write(json.dumps([name for name in looked if name.endswith("entry_points.txt")]))
"""
    done = subprocess.run(
        [sys.executable, "-c", program, *line.split()],
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
        env={"PYTHONPATH": str(folder), "PATH": ""},
    )
    names = json.loads(done.stderr.splitlines()[-1])
    assert any(str(folder) in name for name in names) == opened


def test_a_package_adds_a_rule_which_runs_last(package):
    package(rules="quiet_modem = modem_tools:quiet")
    assert [*rules()] == [*shipped_rules(), "quiet_modem"]
    assert list(rules()["quiet_modem"](None)) == []


def test_a_rule_whose_name_is_taken_is_refused(package):
    package(rules="not_cfs = modem_tools:quiet")
    with pytest.raises(ConfigError, match="package modem-tools: another rule"):
        rules()


LAYOUT = b"structs: {S: {members: {a: uint8}}}\nbind: {0x0801: S}\n"


def test_a_package_reads_other_files_of_layouts(package):
    with pytest.raises(ConfigError, match=r"is not YAML|no 'structs'"):
        parse_layout(b"MODEM " + LAYOUT, "x.modem")
    package(databases="modem = modem_tools:FILES")
    assert parse_layout(b"MODEM " + LAYOUT, "x.modem").structs == parse_layout(LAYOUT, "x").structs


@pytest.mark.parametrize(
    ("group", "ask"), [("databases", lambda: parse_layout(LAYOUT, "x")), ("formats", installed_formats)]
)
def test_what_is_not_of_its_kind_is_refused(package, group, ask):
    package(**{group: "modem = modem_tools:VALUE"})
    with pytest.raises(ConfigError, match=r"of the installed package modem-tools: .* is not an object of"):
        ask()


def test_a_middleware_that_is_none_is_refused(package):
    package(middleware="modem = modem_tools:VALUE")
    with pytest.raises(ConfigError, match=r"of the installed package modem-tools: .* is not an object of"):
        middleware("modem")


def test_the_options_name_every_link_that_ships():
    assert {*options.LINKS} == {*(link.label for link in links()), "other"}

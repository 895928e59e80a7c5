"""The systemd unit in the samples: its command is one that ``record`` takes."""

import re
import shlex

import typer
from places import ROOT

from edoras_tools.cli.main import program

UNIT = (ROOT / "samples/service/edoras-record.service").read_text()


def test_its_command_has_only_options_that_exist():
    (line,) = re.findall(r"^ExecStart=((?:.*\\\n)*.*)$", UNIT, re.MULTILINE)
    line = line.replace("\\\n", " ")
    assert not re.search(r"(?<!%)(?:%%)*%(?!%)", line), "systemd replaces a single %"
    _, name, *arguments = shlex.split(line.replace("%%", "%"))
    context = typer.main.get_command(program()).commands[name].make_context(name, arguments)
    assert context.args == []
    given = context.params
    assert given["interface"] == "wait:eth0"
    assert list(given["keep"]) == [("size", 20_000_000_000)]
    assert str(given["output"]).startswith("/var/lib/edoras/run_2")


def test_it_may_do_nothing_but_capture():
    settings = dict(line.split("=", 1) for line in UNIT.splitlines() if re.match(r"\w+=", line))
    assert settings["AmbientCapabilities"] == settings["CapabilityBoundingSet"] == "CAP_NET_RAW"
    assert settings["StateDirectory"] == "edoras"
    assert (settings["Restart"], settings["NoNewPrivileges"]) == ("always", "yes")

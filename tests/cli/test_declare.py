"""An option's annotation and what typer makes of it."""

from __future__ import annotations

from typing import Annotated

import pytest
import typer

from edoras_tools.cli.declare import grouped
from edoras_tools.cli.options import Count, Time

CASES = {
    "its own name": (Annotated[Time, "Text."], None, ["--given-x"], "TIME"),
    "another value": (Annotated[Count, "[=N]", "Text."], None, ["--given-x"], "[=N]"),
    "other names": (Annotated[Count, "--count -n", "Text."], None, ["--count", "-n"], "N"),
    "names and value": (Annotated[str, "--code -c FROM TO", "Text."], "", ["--code", "-c"], "FROM TO"),
    "a switch": (Annotated[bool, "Text."], False, ["--given-x"], None),
    "on and off": (Annotated[bool, "--on/--no-on", "Text."], False, ["--on"], None),
    "an argument": (Annotated[str, typer.Argument(), "-- REST", "Text."], "", ["given_x"], "-- REST"),
}


@pytest.mark.parametrize(("annotation", "default", "names", "value"), CASES.values(), ids=CASES)
def test_an_annotation_becomes_an_option(annotation, default, names, value):
    def command(given_x=default):
        told.append(given_x)

    told = []
    command.__annotations__ = {"given_x": annotation}
    program = typer.Typer()
    program.command()(grouped(command))
    made = typer.main.get_command(program)
    shown = next(item for item in made.params if item.name == "given_x")
    assert (shown.opts, shown.metavar, shown.help) == (names, value, "Text.")
    made([], standalone_mode=False)
    assert told == [default]

"""A command takes options in groups, and Typer sees an option for each field."""

from __future__ import annotations

from typing import Annotated, NamedTuple

import pytest
import typer
from typer import BadParameter, Option

from edoras_tools.cli.options import duration, grouped, headed, share


class Inner(NamedTuple):
    after: Annotated[int | None, Option(parser=duration, help="How long.")] = None


@headed("Times")
class Outer(NamedTuple):
    inner: Inner
    name: Annotated[str, Option("--called", "-c", metavar="WHO", help="Whose.")] = "me"


def made(command):
    program = typer.Typer(add_completion=False)
    program.command()(grouped(command))
    return typer.main.get_command(program)


def test_each_field_of_a_group_is_an_option_under_its_heading():
    calls = []

    def command(group: Outer, plain: Annotated[bool, Option("--plain", help="Or not.")] = False):
        calls.append((group, plain))

    program = made(command)
    shown = {item.name: item for item in program.params}
    assert {name: item.opts for name, item in shown.items()} == {
        "after": ["--after"],
        "name": ["--called", "-c"],
        "plain": ["--plain"],
    }
    assert [item.rich_help_panel for item in shown.values()] == ["Times", "Times", None]
    assert (shown["name"].metavar, shown["name"].help) == ("WHO", "Whose.")
    program(["--after", "2s", "-c", "you", "--plain"], standalone_mode=False)
    program([], standalone_mode=False)
    assert calls == [(Outer(Inner(2_000_000_000), "you"), True), (Outer(Inner(None), "me"), False)]


@pytest.mark.parametrize(("text", "value"), [("1%", 0.01), ("0.01", 0.01), ("100%", 1), ("0", 0)])
def test_a_share_is_a_percentage_or_a_part_of_one(text, value):
    assert share(text) == value


@pytest.mark.parametrize("text", ["1", "1.0", "2", "-1%", "101%", "%", "nan"])
def test_what_may_mean_one_percent_or_all_is_no_share(text):
    with pytest.raises(BadParameter, match="is not a share; write 1%"):
        share(text)

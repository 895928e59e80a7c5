"""Help texts: at most a screen on a terminal, everything elsewhere."""

import os
import re

import pytest
import typer

from edoras_tools.cli import main, usage
from edoras_tools.render.terminal.terminal import Terminal

ROWS, COLUMNS = 40, 80


def tree(command, context):
    yield command, context
    for name, inner in getattr(command, "commands", {}).items():
        yield from tree(inner, inner.make_context(name, [], parent=context, resilient_parsing=True))


ROOT = typer.main.get_command(main.program())
TREE = {
    context.command_path: (command, context)
    for command, context in tree(ROOT, ROOT.make_context("edoras", [], resilient_parsing=True))
}


@pytest.fixture
def shown(monkeypatch):
    """A function: the lines of a command's help on a stream."""

    def lines(path, *, interactive, everything=False, rows=ROWS):
        monkeypatch.setattr(usage, "look", lambda _: Terminal(COLUMNS, colour=False, interactive=interactive))
        monkeypatch.setattr("shutil.get_terminal_size", lambda: os.terminal_size((COLUMNS, rows)))
        command, context = TREE[path]
        return usage.command_help(command, context, everything=everything).splitlines()

    return lines


def options(path):
    command, context = TREE[path]
    return {name for item in command.get_params(context) if not item.hidden for name in item.opts}


def named(lines):
    return {word.strip("(,.;):") for line in lines for word in line.split() if word.startswith("-")}


@pytest.mark.parametrize("path", TREE)
def test_at_most_a_screen_on_a_terminal(path, shown):
    lines = shown(path, interactive=True)
    assert len(lines) < ROWS
    assert max(map(len, lines)) <= COLUMNS


@pytest.mark.parametrize("path", TREE)
def test_every_option_is_explained_in_a_pipe_and_by_help(path, shown):
    lines = shown(path, interactive=False)
    starts = named(re.match(r" {2}(\S.*?)(?= {2}|$)", line)[1] for line in lines if re.match(r" {2}\S", line))
    assert {name for name in options(path) if name.startswith("-")} <= starts
    assert shown(path, interactive=True, everything=True) == lines


@pytest.mark.parametrize("path", TREE)
def test_no_option_is_missing_on_a_terminal(path, shown):
    """Those that are not explained are named, by one of their names."""
    command, context = TREE[path]
    there = named(shown(path, interactive=True))
    for item in command.get_params(context):
        assert item.param_type_name == "argument" or there.intersection(item.opts), item.name


@pytest.mark.parametrize("path", TREE)
def test_a_screen_of_24_rows_has_the_most_usual_options_and_every_heading(path, shown):
    lines = shown(path, interactive=True, rows=24)
    assert len(lines) <= 22
    assert max(map(len, lines)) <= COLUMNS
    command, context = TREE[path]
    for heading in usage.sections(command, context):
        assert any(line.strip().startswith(heading) for line in lines), heading
    for item in command.get_params(context):
        if item.param_type_name == "argument":
            assert any(
                line.strip().startswith(usage.argument(item.make_metavar(context))) for line in lines
            ), item.name


def test_the_list_of_commands_fits_a_small_screen(shown, monkeypatch):
    lines = shown("edoras", interactive=True, rows=24)
    assert len(lines) <= 22
    text = "\n".join(lines)
    for name in main.COMMANDS:
        assert re.search(rf"\b{name}\b", text), name
    for group, (first, *_) in main.GROUPS.items():
        command, _ = TREE[f"edoras {first}"]
        assert any(line.startswith(group) and line.endswith(usage.first_line(command)) for line in lines)
    assert "edoras help all: what each of them does" in lines


def test_commands_stand_in_their_groups(shown):
    lines = shown("edoras", interactive=True)
    column = max(map(len, main.GROUPS)) + 1
    groups, found = {}, None
    for line in lines[
        : lines.index("Start: edoras FILE, or edoras demo. All of a command: edoras help COMMAND")
    ]:
        heading, name = line[:column].strip(), line[column:].partition(" ")[0]
        found = (
            groups.setdefault(heading, set()) if heading in main.GROUPS else found if not heading else None
        )
        if found is not None and name:
            found.add(name)
    assert groups == {group: set(names) for group, names in main.GROUPS.items()}


def test_each_command_of_the_list_has_one_line(shown):
    lines = shown("edoras", interactive=True)
    for name in main.COMMANDS:
        command, _ = TREE[f"edoras {name}"]
        assert any(line.endswith(usage.first_line(command)) for line in lines), name


@pytest.mark.parametrize("path", TREE)
def test_shortened_texts_still_say_something_and_end_alike(path):
    command, context = TREE[path]
    for entries in usage.sections(command, context).values():
        for text in (usage._shortened(item).help for item in entries):
            assert re.search(r"[^.]$|\.\.\.?$", text), text
            assert len(text) > len("E.g."), text


def test_what_is_left_out_is_said_and_where_it_is(shown):
    assert "More options: edoras help wireshark run explains them" not in shown(
        "edoras wireshark run", interactive=False
    )
    assert "More options: edoras help replay explains them" in shown("edoras replay", interactive=True)

"""Help texts: ``-h`` is a screen, ``edoras help`` says everything; and how many options there are.

An entry is an option of one command; a name is a long spelling of an option in any command. Both are counted
over all that click parses, but for ``--help``, which click adds to each command, and for older spellings,
which are hidden and go on working. ``pytest -s`` prints the figures.
"""

import ast
import re

import pytest
import typer
from places import ROOT

from edoras_tools.cli import main
from edoras_tools.cli.options import OLD_NAMES

ENTRIES, NAMES = 552, 145
PACKAGE = ROOT / "edoras_tools"
LINES, COLUMNS = 40, 80
LISTED = 46
"""The first screen has a line for each command."""


def tree(command, context):
    yield command, context
    for name, inner in getattr(command, "commands", {}).items():
        yield from tree(inner, inner.make_context(name, [], parent=context, resilient_parsing=True))


def commands():
    root = typer.main.get_command(main.program())
    return list(tree(root, root.make_context("edoras", [], resilient_parsing=True)))


TREE = {context.command_path: (command, context) for command, context in commands()}


@pytest.fixture
def shown(monkeypatch):
    """A function: the lines of a command's help text."""

    def lines(path, *, whole=False):
        monkeypatch.setenv("COLUMNS", str(COLUMNS))
        command, context = TREE[path]
        monkeypatch.setitem(context.meta, main.WHOLE, whole)
        return command.get_help(context).splitlines()

    return lines


def options(path):
    command, context = TREE[path]
    return [
        item
        for item in command.get_params(context)
        if item.param_type_name == "option" and not item.hidden and item.name != "help"
    ]


@pytest.mark.parametrize("path", TREE)
def test_a_screen(path, shown):
    lines = shown(path)
    assert len(lines) <= (LISTED if path == "edoras" else LINES)
    assert max(map(len, lines)) <= COLUMNS


@pytest.mark.parametrize("path", TREE)
def test_every_option_is_named_and_help_explains_it(path, shown):
    short, whole = "\n".join(shown(path)), "\n".join(shown(path, whole=True))
    for item in options(path):
        names = [*item.opts, *item.secondary_opts]
        assert any(re.search(rf"(?<![\w-]){name}(?![\w-])", short) for name in names), names
        assert re.search(rf"^  .*{names[-1]}\b.*\n? +\S", whole, re.MULTILINE), names
        assert item.help


def test_commands_stand_in_their_groups(shown):
    column, groups, heading = max(map(len, main.GROUPS)) + 1, {}, ""
    for line in shown("edoras")[5:]:
        if not line:
            break
        heading = line[:column].strip() or heading
        groups.setdefault(heading, set()).add(line[column:].split()[0])
    assert groups == {group: set(names) for group, names in main.GROUPS.items()}


def test_each_command_of_the_list_has_one_line(shown):
    lines = shown("edoras")
    for name in main.COMMANDS:
        command, _ = TREE[f"edoras {name}"]
        assert any(line.endswith(f"  {main.first_line(command)}") for line in lines), name


def test_what_is_only_named_says_where_it_is_explained(shown):
    assert "More (edoras help replay explains):" in shown("edoras replay")
    assert not any(line.startswith("More") for line in shown("edoras replay", whole=True))


def test_an_old_name_is_the_new_one(call, captures):
    """Each is of an option that there is; one of them, run."""
    now = {name for path in TREE for item in options(path) for name in (*item.opts, *item.secondary_opts)}
    assert set(OLD_NAMES.values()) <= now
    lines = ("sniff", captures("a_rover"), "-n", 40)
    assert call(*lines, "--sequence", "mermaid").out == call(*lines, "--diagram", "mermaid").out != ""


@pytest.mark.each(3)
@pytest.mark.parametrize(
    ("old", "new"),
    [
        (["--envelope", "4/4 le"], ["--set", "envelope=4/4 le"]),
        (["--port", "ci:5010", "--port", "to:5011"], ["--set", "port=ci:5010", "--set", "port=to:5011"]),
        (["--extended-header"], ["--set", "extended-header=yes"]),
        (["--telemetry-header", "12"], ["--set", "telemetry-header=12"]),
    ],
)
def test_what_was_an_option_of_decoding_is_a_setting(old, new, call, captures):
    lines = [call("sniff", captures("a_rover"), "-n", 30, "-V", *words).out for words in (old, new)]
    assert lines[0] == lines[1] != ""


def test_a_setting_that_there_is_not(call, captures):
    done = call("sniff", captures("a_rover"), "--set", "envelop=8/8")
    assert (done.code, done.out) == (2, "")
    assert "did you mean envelope?" in done.err[0]
    done = call("sniff", captures("a_rover"), "--set", "app_msg_limit=8")
    assert done.err[0].endswith("constants of cFS are for doctor, report, trace, hz, check and sim")


def test_help_decoding_has_every_setting(call):
    text = call("help", "decoding").out
    for name in ("distro", "msg-path", "structs", "port", "envelope", "extended-header", "app_msg_limit=4"):
        assert name in text


def test_what_every_command_takes_may_stand_before_it(call, captures):
    assert call("-q", "info", captures("a_rover")).out == call("info", captures("a_rover"), "-q").out
    assert call("-v", "info", captures("a_rover")).err[0].startswith("edoras: edoras-tools ")


def test_there_are_no_more_options_than_that():
    parsed = [
        item
        for command, context in commands()
        for item in command.get_params(context)
        if item.param_type_name == "option" and item.name != "help"
    ]
    listed = [item for item in parsed if not item.hidden]
    names = {name for item in listed for name in (*item.opts, *item.secondary_opts) if name.startswith("--")}
    print(
        f"\n{len(commands())} commands, {len(listed)} entries of {len(names)} names; with older spellings "
        f"{len(parsed)} entries; --help of each command besides"
    )
    assert len(listed) <= ENTRIES
    assert len(names) <= NAMES


OF_OTHERS = {
    *("--cap-add", "--card"),
    *(
        "--remap",
        "--param",
        "--params-file",
        "--log-level",
        "--log-config-file",
        "--log-file-name",
        "--enclave",
    ),
}
"""Of docker, a variable of CSS, and of rcl behind ``--ros-args``."""


def test_messages_name_options_that_help_lists():
    """What an option was called before goes on working, and is proposed by no advice, hint or example."""
    listed = {"--help", "--quiet", "--verbose", "--color"}
    listed |= {name for path in TREE for item in options(path) for name in (*item.opts, *item.secondary_opts)}
    option = re.compile(r"(?<![\w-])--[a-z][a-z-]+")
    unknown = [
        (str(file.relative_to(PACKAGE)), name)
        for file in PACKAGE.rglob("*.py")
        if "cli" not in file.parts and file.name not in {"cli.py", "extcap.py"}
        if set(option.findall(text := file.read_text(encoding="utf-8"))) - listed - OF_OTHERS
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.Constant) and isinstance(node.value, str)
        for name in option.findall(node.value)
        if name not in listed | OF_OTHERS
    ]
    assert unknown == [("pipelines/sending/options.py", "--unlimited")]  # told to who wrote it

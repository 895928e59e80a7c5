"""Help texts: a screen of them on a terminal; all of them in a pipe, and with ``edoras help``."""

from __future__ import annotations

import re
import shutil
import sys
import textwrap
from itertools import chain
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from edoras_tools.render.terminal.terminal import look

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

OWN: Final = "Options"
"""Heading of a command's own options."""
_WIDEST: Final = 100
_NAMES: Final = 26
"""Columns for the names of options."""
_OTHERS: Final = "Others"
"""Heading of a command's own options that are named only."""
_FEWEST: Final = 5
"""So many options of its own are explained on the smallest screen."""
_RESERVE: Final = 2
"""Lines for the shell's prompt below a help text."""


class Entry(NamedTuple):
    """One line of a help text: an option, an argument or a command."""

    names: str
    help: str


def command_help(command: Any, ctx: Any, *, everything: bool = False) -> str:
    """Return the help text of a command or a group of commands.

    Where the text would be longer than the screen, options that belong together are listed by their names
    only: the last ones first. A command's own options are always explained, if need be in their first words.
    So are the commands of a group; if they are still too many, the first under each heading. On a screen that
    is smaller still, only the first paragraph says what a command does, one line names what belongs together,
    and the last of a command's own options are named only.

    Args:
        command: click's object.
        everything: show all options in full.
    """
    terminal = look(sys.stdout)
    width = min(terminal.width, _WIDEST)
    height = shutil.get_terminal_size().lines - _RESERVE
    groups = sections(command, ctx)
    inner = _inner(command)
    left = [name for name in groups if (groups[name][0].names not in inner if inner else name != OWN)]
    folded: list[str] = []
    brief = tight = False
    while True:
        lines = list(_lines(command, ctx, groups, folded, width, brief=brief, tight=tight))
        if everything or not terminal.interactive or len(lines) <= height:
            break
        if left:
            folded.append(left.pop())
        elif any(entry != _shortened(entry) for entry in groups.get(OWN, ())):
            groups = {**groups, OWN: [_shortened(entry) for entry in groups[OWN]]}
        elif inner and not brief:
            brief = True
        elif not inner and not tight:
            tight = True
        elif not inner and len(groups[OWN]) > _FEWEST:
            last = next(entry for entry in reversed(groups[OWN]) if entry.names.startswith("-"))
            groups = {**groups, OWN: [entry for entry in groups[OWN] if entry is not last]}
            groups[_OTHERS] = [last, *groups.get(_OTHERS, ())]
            folded = [_OTHERS, *(name for name in folded if name != _OTHERS)]
        else:
            break
    if not terminal.colour:
        return "\n".join(lines)
    pattern = "|".join(map(re.escape, [_more(ctx), *groups]))
    return re.sub(rf"^({pattern})(?=$| )", "\x1b[1m\\1\x1b[0m", "\n".join(lines), flags=re.MULTILINE)


def sections(command: Any, ctx: Any) -> Mapping[str, list[Entry]]:
    """Return what a command takes by heading: its own options first, those of a group of commands last."""
    found: dict[str, list[Entry]] = {OWN: []}
    for item in command.get_params(ctx):
        if item.param_type_name == "argument":
            name = argument(item.make_metavar(ctx))
            if item.help:
                found[OWN].append(Entry(name, _sentence(item.help)))
        elif not item.hidden:
            heading = getattr(item, "rich_help_panel", None) or OWN
            found.setdefault(heading, []).append(Entry(names(item, ctx), _option_help(item)))
    for name in getattr(command, "list_commands", lambda _: ())(ctx):
        inner = command.get_command(ctx, name)
        if not inner.hidden:
            heading = inner.rich_help_panel or "Commands"
            found.setdefault(heading, []).append(Entry(name, first_line(inner)))
    own = found.pop(OWN) + found.pop("Printing", []) if _inner(command) else []
    found |= {OWN: own} if own else {}
    return {heading: entries for heading, entries in found.items() if entries}


def first_line(command: Any) -> str:
    """Return what a command does, in a sentence."""
    return re.split(r"(?<=\.) ", " ".join(command.help.partition("\n\n")[0].split()))[0]


def names(option: Any, ctx: Any) -> str:
    """Return the names of an option, short ones first, and what its value is called."""
    shown = sorted(option.opts, key=len) + option.secondary_opts
    value = "" if option.is_flag or option.count else f" {option.make_metavar(ctx)}"
    return f"{', '.join(shown)}{value}"


def argument(text: str) -> str:
    """Return how an argument is shown: typer's ``{ROUTE}`` as ``ROUTE``, ``[kind]:<a|b>`` as ``[a|b]``.

    >>> [argument(text) for text in ("{ROUTE}", "[FILE]...", "[kind]:<a|b>", "{link}:<a|b>", "link:<a|b>")]
    ['ROUTE', '[FILE]...', '[a|b]', '<a|b>', '<a|b>']
    """
    text = re.sub(r"^\[\w+\]:<(.*)>$", r"[\1]", text)
    return re.sub(r"^\{?\w+\}?:(?=<)|[{}]", "", text)


def _option_help(option: Any) -> str:
    text = _sentence(option.help or "")
    if option.envvar:
        text += f" [{option.envvar}]"
    default = option.default
    if option.show_default and not (option.is_flag or default in {None, ""} or callable(default)):
        text += f" [default: {getattr(default, 'value', default)}]"
    return text


def _sentence(text: str) -> str:
    return " ".join(text.split())


def _lines(
    command: Any,
    ctx: Any,
    groups: Mapping[str, list[Entry]],
    folded: list[str],
    width: int,
    *,
    brief: bool,
    tight: bool,
) -> Iterator[str]:
    usage = " ".join([ctx.command_path, *map(argument, command.collect_usage_pieces(ctx))])
    yield from textwrap.wrap(f"Usage: {usage}", width, subsequent_indent="  ")
    paragraphs = (command.help or "").split("\n\n")
    for paragraph in paragraphs[:1] if tight else paragraphs:
        yield ""
        yield from textwrap.wrap(" ".join(paragraph.split()), width)
    commands = {name: group for name, group in groups.items() if group[0].names in _inner(command)}
    if commands:
        yield ""
        yield from _command_lines(commands, width, brief=brief)
        yield from [f"{ctx.command_path} help all: what each of them does"] if brief else []
    for heading in [name for name in groups if name not in {*commands, *folded}]:
        yield ""
        yield heading
        yield from chain.from_iterable(_entry(item, _NAMES, width) for item in groups[heading])
    if folded:
        yield ""
        yield from [] if commands else [_more(ctx)]
        column = 8 if commands else 15
        for heading in [name for name in groups if name in folded]:
            short = ", ".join(item.names.partition(", ")[0].partition(" ")[0] for item in groups[heading])
            start = f"{'' if commands else '  '}{heading} "
            yield from textwrap.wrap(
                f"{start:<{column}}{short}",
                width,
                subsequent_indent=" " * column,
                max_lines=1 if tight else None,
                placeholder=" ...",
                break_on_hyphens=False,
            )
    if command.epilog:
        yield from [] if folded else [""]
        yield from textwrap.wrap(command.epilog, width)


def _inner(command: Any) -> Mapping[str, Any]:
    """Return the commands of a group; none of a command."""
    inner: Mapping[str, Any] = getattr(command, "commands", {})
    return inner


def _command_lines(groups: Mapping[str, list[Entry]], width: int, *, brief: bool) -> Iterator[str]:
    """Yield commands with what they do; the group stands in front of its first one.

    Args:
        groups: of commands, by heading.
        brief: explain only the first of each group, and name the others.
    """
    first = max(map(len, groups)) + 1
    second = first + max(len(entry.names) for group in groups.values() for entry in group) + 1
    for heading, entries in groups.items():
        for place, entry in enumerate(entries[:1] if brief else entries):
            start = f"{'' if place else heading:<{first}}{entry.names}"
            text = textwrap.wrap(entry.help, max(20, width - second))
            yield f"{start:<{second}}{text[0] if text else ''}".rstrip()
            yield from (f"{'':{second}}{line}" for line in text[1:])
        if brief and entries[1:]:
            rest = f"also {', '.join(entry.names for entry in entries[1:])}"
            yield from (f"{'':{first}}{line}" for line in textwrap.wrap(rest, max(20, width - first)))


def _shortened(entry: Entry) -> Entry:
    """Return an entry with the first clause of its text."""
    return entry._replace(help=re.split(r"; |, e\.g\. |\. ", entry.help)[0].removesuffix("."))


def _more(ctx: Any) -> str:
    root, _, path = ctx.command_path.partition(" ")
    return f"More options: {f'{root} help {path}'.strip()} explains them"


def _entry(entry: Entry, column: int, width: int) -> Iterator[str]:
    """Yield the names, and the help text beside them, or below where they are too long for their column."""
    text = textwrap.wrap(entry.help, max(20, width - column)) or [""]
    if len(entry.names) + 4 <= column:
        yield f"  {entry.names:<{column - 2}}{text.pop(0)}".rstrip()
    else:
        yield f"  {entry.names}"
    for line in text:
        yield f"{'':{column}}{line}"

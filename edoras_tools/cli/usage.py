"""Help texts in click's style, on one screen: ``-h`` names options that ``edoras help COMMAND`` explains.

Typer would draw them with rich, which takes longer to import than all the rest of ``--help``; and neither
has a short form. So two methods replace Typer's: below ``-h``, options that belong together share one line,
and commands stand in their groups.
"""

from __future__ import annotations

import re
from itertools import groupby
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from collections.abc import Mapping

OWN: Final = "Options"
"""Heading of a command's own options."""
WHOLE: Final = "edoras.whole"
"""Key of a context's ``meta``: all options are explained."""
_TYPE: Final = re.compile(r"<([\w ]+)>")
_VALUES: Final = {"str": "text", "int range": "number", "float range": "number", "recording_path": "path"}
"""Name of a parser to its name in help texts; other parsers keep their names."""
_EVERYWHERE: Final = "Every command: -q, -v, --color WHEN"


def sections(command: Any, ctx: Any) -> Mapping[str, list[tuple[str, str]]]:
    """Return the names and texts of a command's parameters by heading, its own heading first."""
    rows: dict[str, list[tuple[str, str]]] = {OWN: []}
    for item in command.get_params(ctx):
        if record := item.get_help_record(ctx):  # a hidden parameter has none
            names, text = record
            names = _TYPE.sub(lambda match: _VALUES.get(match[1], match[1]).upper(), names)
            text = text.removesuffix("  [default: True]")  # of a switch that only has its no
            heading = getattr(item, "rich_help_panel", None) or OWN
            if getattr(item, "multiple", False):
                text = f"{text.removesuffix('.')}; repeatable."
            rows.setdefault(heading, []).append((names.lstrip(" /"), text))  # "/ --no-x" of one for no alone
    return rows


def write_options(command: Any, ctx: Any, formatter: Any) -> None:
    """Write a command's parameters; without full help, those under a heading are only named."""
    whole, summaries = ctx.meta.get(WHOLE, False), []
    for heading, rows in sections(command, ctx).items():
        if whole or (heading == OWN and not hasattr(command, "commands")):
            with formatter.section(heading):
                formatter.write_dl(rows)
        elif rows:
            summaries.append((heading, ", ".join(names.split(",")[-1].split()[0] for names, _ in rows)))
    if hasattr(command, "commands"):
        _write_commands(command, formatter)
    if summaries:
        root, _, path = ctx.command_path.partition(" ")
        with formatter.section(f"More ({f'{root} help {path}'.strip()} explains)"):
            formatter.write_dl(summaries)
    if not whole and not hasattr(command, "commands"):
        formatter.write_paragraph()
        formatter.write_text(_EVERYWHERE)


def _write_commands(command: Any, formatter: Any) -> None:
    """Write the commands of a group with their texts; a heading stands in front of its first one."""
    commands = {name: item for name, item in command.commands.items() if not item.hidden}
    rows = []
    column = max(len(item.rich_help_panel or "") for item in commands.values())
    panels = [item.rich_help_panel or "" for item in commands.values()]  # groups of commands come last
    ordered = sorted(commands, key=lambda name: panels.index(commands[name].rich_help_panel or ""))
    for heading, names in groupby(ordered, lambda name: commands[name].rich_help_panel or ""):
        for place, name in enumerate(names):
            rows.append((f"{'' if place else heading:<{column}} {name}".rstrip(), first_line(commands[name])))
    formatter.write_paragraph()
    formatter.write_dl(rows)


def first_line(command: Any) -> str:
    """Return the first sentence about a command."""
    return re.split(r"(?<=\.) ", " ".join((command.help or "").partition("\n\n")[0].split()))[0]

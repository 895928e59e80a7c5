"""``edoras help``: all options of a command, page by page, and the manual pages."""

from __future__ import annotations

import os
import re
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, get_args

import typer
from typer import Argument, Option

from edoras_tools import __version__
from edoras_tools.cli import recordings
from edoras_tools.cli.main import WHOLE, first_line, sections
from edoras_tools.cli.options import DecodingOptions, grouped, parameters
from edoras_tools.errors import ConfigError
from edoras_tools.words import did_you_mean

_EXIT_CODES = {
    "0": "Success.",
    "1": "Failed.",
    "2": "Wrong usage.",
    "3": "Finished, but data was lost or found lost.",
    "130": "Stopped by Ctrl-C before all was read or sent.",
}
_FILES = {
    "edoras.toml": "Options that one would repeat; looked for in the working folder and its parents.",
    "EDORAS_CONFIG": "Names another file.",
    "NO_COLOR, FORCE_COLOR": "As --color never and --color always.",
}


def page(command: Any, ctx: Any) -> str:
    """Return the manual page of a command.

    Args:
        command: click's object.
    """
    return "".join(f"{line}\n" for line in _lines(command, ctx))


def _lines(command: Any, ctx: Any) -> Iterator[str]:
    name = ctx.command_path.replace(" ", "-")
    yield f'.TH "{_text(name.upper())}" 1 "" "edoras-tools {__version__}" "edoras-tools"'
    yield ".SH NAME"
    yield f"{_text(name)} \\- {_text(first_line(command)).rstrip('.')}"
    yield ".SH SYNOPSIS"
    yield f".B {_text(ctx.command_path)}"
    yield _text(" ".join(command.collect_usage_pieces(ctx)))
    yield ".SH DESCRIPTION"
    for place, paragraph in enumerate((command.help or "").split("\n\n")):
        yield from [".PP"] if place else []
        yield _text(" ".join(paragraph.split()))
    for heading, entries in sections(command, ctx).items():
        yield f".SH {_text(heading.upper())}"
        yield from _listed(dict(entries))
    yield ".SH EXIT STATUS"
    yield from _listed(_EXIT_CODES)
    yield ".SH FILES AND VARIABLES"
    yield from _listed(_FILES)
    above = ctx.parent.command_path.replace(" ", "-") if ctx.parent else ""
    below = [f"{name}-{item}" for item in getattr(command, "commands", {})]
    yield ".SH SEE ALSO"
    yield ",\n".join(f".BR {_text(item)} (1)" for item in [above, *below] if item).replace("(1),", '"(1),"')


def _listed(entries: dict[str, str]) -> Iterator[str]:
    for names, text in entries.items():
        yield ".TP"
        yield f".B {_text(names)}"
        yield _text(text)


def _text(text: str) -> str:
    """Return a line of text without anything that roff would take for a request."""
    text = re.sub(r"[\\-]", lambda match: "\\e" if match[0] == "\\" else "\\-", text)
    return f"\\&{text}" if text[:1] in {".", "'"} else text


def _named_commands(ctx: typer.Context, incomplete: str) -> list[str]:
    """Return the commands that may follow those on the command line."""
    from edoras_tools.cli.main import COMMANDS, program

    typed = ctx.params.get("names") or ()
    command: Any = typer.main.get_command(program(*typed[:1])) if {*typed[:1]} <= {*COMMANDS} else None
    for name in typed:
        command = getattr(command, "commands", {}).get(name)
    commands = getattr(command, "commands", {})
    return [name for name, item in commands.items() if name.startswith(incomplete) and not item.hidden]


@grouped
def help_(
    names: Annotated[
        list[str] | None,
        Argument(autocompletion=_named_commands, metavar="[COMMAND]...", help="Or decoding, for --set."),
    ] = None,
    man: Annotated[Path | None, Option(help="Write the manual pages to a folder, e.g. man1.")] = None,
    force: recordings.Force = False,
) -> None:
    """Explain all options of a command, or write manual pages."""
    from edoras_tools.cli.main import program

    if force and man is None:
        raise ConfigError("--force can only be used with --man DIR")

    root = typer.main.get_command(program())
    context = root.make_context("edoras", [], resilient_parsing=True)
    if names == ["decoding"]:
        typer.echo(_decoding(context), nl=False)
        return
    if man is not None:
        _write_pages(root, context, man, force=force)
        return
    command: Any = root
    for name in () if names == ["all"] else names or ():
        commands = getattr(command, "commands", {})
        if name not in commands:
            hint = did_you_mean(name, commands) or f"see {context.command_path} -h"
            raise ConfigError(f"{context.command_path} has no command {name!r}; {hint}")
        command = commands[name]
        context = command.make_context(name, [], parent=context, resilient_parsing=True)
    context.meta[WHOLE] = True
    text = command.get_help(context) + "\n"
    if sys.stdout.isatty() and text.count("\n") > shutil.get_terminal_size().lines:
        from pydoc import pager

        os.environ.setdefault("LESS", "-R")  # it shows bold text
        pager(text)
    else:
        typer.echo(text, nl=False, color=True)


def _decoding(context: Any) -> str:
    """Return the decoding settings for ``--set`` and ``edoras.toml``."""
    from edoras_tools.cfs.profile import SimProfile, constant_names

    formatter = context.make_formatter()
    formatter.write_text(
        "Captures say themselves how they are to be read, where they can. What they do not say, or wrongly, "
        "--set NAME=VALUE adds in every command that decodes, and edoras.toml as NAME = VALUE."
    )
    fields = {item.name: get_args(item.annotation)[1].help for item in parameters(DecodingOptions)[2:]}
    with formatter.section("Decoding"):
        formatter.write_dl([(name.replace("_", "-"), text) for name, text in fields.items()])
    with formatter.section("Constants of cFS, for doctor, report, trace, hz, check and sim"):
        usual = SimProfile()
        whole = [f"{name}={getattr(usual, name)}" for name in constant_names()]
        formatter.write_text(", ".join([*whole, "to_limits=FILE", "sbn_table=FILE"]))
    return str(formatter.getvalue())


def _write_pages(root: Any, context: Any, folder: Path, *, force: bool) -> None:
    from edoras_tools.io.outputs import write_files
    from edoras_tools.words import plural

    pages = {
        folder / f"{ctx.command_path.replace(' ', '-')}.1": page(command, ctx).encode()
        for command, ctx in _tree(root, context)
    }
    write_files(pages, force=force)
    typer.echo(f"{folder}: {plural(len(pages), 'manual page')}; man -l {folder / 'edoras.1'} shows the first")


def _tree(command: Any, ctx: Any) -> Iterator[tuple[Any, Any]]:
    """Yield a command and all below it, with their contexts."""
    yield command, ctx
    for name, inner in getattr(command, "commands", {}).items():
        yield from _tree(inner, inner.make_context(name, [], parent=ctx, resilient_parsing=True))

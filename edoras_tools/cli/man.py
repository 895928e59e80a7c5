"""Manual pages in roff, made from the commands."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any

from edoras_tools import __version__
from edoras_tools.cli.usage import first_line, sections

if TYPE_CHECKING:
    from collections.abc import Iterator

_EXIT_CODES = {
    "0": "Success.",
    "1": "Failed.",
    "2": "Wrong usage.",
    "3": "Finished, but data was lost or found lost.",
    "130": "Stopped by Ctrl-C.",
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
        yield from _listed({entry.names: entry.help for entry in entries})
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
    text = re.sub(r"[\\-]", lambda found: "\\e" if found[0] == "\\" else "\\-", text)
    return f"\\&{text}" if text[:1] in {".", "'"} else text

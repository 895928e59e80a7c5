"""The results of a check, for people."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from rich.console import Group, RenderableType
from rich.text import Text

from edoras_tools.render import units
from edoras_tools.render.severity import Level
from edoras_tools.render.terminal import palette
from edoras_tools.render.terminal.table import plain
from edoras_tools.words import plural

if TYPE_CHECKING:
    from collections.abc import Mapping


def check_view(report: Mapping[str, Any]) -> RenderableType:
    """Return the view of a check.

    Args:
        report: the report, in the form of ``check --json``.
    """
    head = plain(report["source"], palette.STRONG)
    head.append(f"  {units.duration(report['seconds'])}", palette.DIM)
    parts: list[RenderableType] = [head, Text()]
    for item in report["results"]:
        mark, style = ("✓", "green") if item["passed"] else (Level.ERROR.mark, Level.ERROR.style)
        expected = "" if item["expected"] is None else f" {item['expected']}"
        line = Text.assemble((f"{mark} ", style), plain(f"{item['about']}  {item['expectation']}{expected}"))
        line.append_text(plain(f"  {item['found']}", palette.DIM if item["passed"] else style))
        parts.append(line)
    of = plural(len(report["results"]), "expectation")
    if report["failed"]:
        end = Text(f"{report['failed']:,} of {of} not met.", Level.ERROR.style)
    else:
        end = Text(f"{of} met.", "green")
    return Group(*parts, Text(), end)

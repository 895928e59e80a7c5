"""The differences of two runs, for people."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rich.console import Group, RenderableType
from rich.text import Text

from edoras_tools.render import units
from edoras_tools.render.severity import Level
from edoras_tools.render.terminal import palette
from edoras_tools.render.terminal.table import plain
from edoras_tools.words import plural

if TYPE_CHECKING:
    from collections.abc import Sequence

    from edoras_tools.addons.runs.differences import Run, RunDifference


def runs_view(good: Run, bad: Run, changes: Sequence[RunDifference]) -> RenderableType:
    """Return the view of a comparison."""
    parts: list[RenderableType] = [_head("good", good), _head("bad", bad), Text()]
    for item in changes:
        severity = Level.ERROR if item.worse else Level.NOTE
        parts.append(Text.assemble((f"{severity.mark} ", severity.style), plain(item.text)))
    if changes:
        parts.append(Text())
    worse = sum(item.worse for item in changes)
    if worse:
        parts.append(Text(f"The second run is worse in {plural(worse, 'point')}.", Level.ERROR.style))
    else:
        parts.append(Text("The second run is no worse.", "green"))
    return Group(*parts)


def _head(label: str, run: Run) -> Text:
    line = plain(f"{label:<5}{run.info['source']}", palette.STRONG)
    line.append(
        f"  {plural(run.info['datagrams'], 'datagram')} over {units.duration(run.seconds)}, "
        f"{units.count(run.doctor['lost'])} lost",
        palette.DIM,
    )
    return line

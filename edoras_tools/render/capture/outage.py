"""Text about interfaces that were away."""

from __future__ import annotations

from typing import TYPE_CHECKING

from edoras_tools.render import units
from edoras_tools.render.terminal.text import clean

if TYPE_CHECKING:
    from collections.abc import Sequence

    from edoras_tools.model import InterfaceOutage


def outage_news(outage: InterfaceOutage) -> str:
    """Return the line for an interface that went away, or is back."""
    name = clean(outage.interface)
    if not outage.end_ns:
        return f"{name} is {outage.why}; waiting for it"
    return f"{name} is back; it was away {_lasted([outage])}"


def outage_lines(outages: Sequence[InterfaceOutage]) -> list[str]:
    """Return a line for each interface that was away: how often, how long, and whether it still is."""
    lines = []
    for name in dict.fromkeys(outage.interface for outage in outages):
        own = [outage for outage in outages if outage.interface == name]
        over = [outage for outage in own if outage.end_ns]
        words = []
        if over:
            words.append(f"was away {_lasted(over)}" + (f", {len(over):,} times" if len(over) > 1 else ""))
        if len(own) > len(over):
            words.append("was not back at the end")
        lines.append(f"{clean(name)} {' and '.join(words)}")
    return lines


def _lasted(outages: Sequence[InterfaceOutage]) -> str:
    return units.duration(sum(outage.end_ns - outage.start_ns for outage in outages) / 1e9)

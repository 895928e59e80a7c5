"""What ``edoras export`` wrote."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from edoras_tools.render.terminal.text import clean
from edoras_tools.words import plural

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping


def exported_lines(summary: Mapping[str, Any]) -> Iterator[str]:
    """Yield a line for each file of a report in the shape of ``export --json``."""
    for item in summary["files"]:
        kind = f", {item['type']}" if item["type"] else ""
        yield clean(f"{item['path']}: {plural(item['rows'], 'row')} of {item['topic']}{kind}")

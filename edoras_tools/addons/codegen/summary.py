"""Lines on the generated files for a terminal: each type with the size of its longest CDR, and its bounds."""

from __future__ import annotations

from typing import TYPE_CHECKING

from edoras_tools.addons.codegen.generation import STARTUP

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence
    from pathlib import Path

    from edoras_tools.addons.codegen.generation import Generated
    from edoras_tools.addons.codegen.plan import Message


def summary(generated: Generated, folder: Path, removed: Sequence[str]) -> list[str]:
    """Return the lines: one for each type, then the files.

    Args:
        removed: files of an earlier library that were deleted.
    """
    rows = [
        (message.ros_name, f"{message.most_bytes:,}", ", ".join(_bounded(message, "")) or "always")
        for message in generated.library.requested
    ]
    head = ("TYPE", "CDR BYTES", "AT MOST")
    widths = [max(len(row[column]) for row in [head, *rows]) for column in (0, 1)]
    lines = [f"{name:{widths[0]}}  {size:>{widths[1]}}  {bounds}" for name, size, bounds in [head, *rows]]
    nested = len(generated.library.messages) - len(rows)
    lines.append("")
    lines.append(
        f"{len(generated.files)} files in {folder}{f'; {nested} more types are nested' if nested else ''}"
    )
    if removed:
        lines.append(f"removed, of an earlier library: {', '.join(removed)}")
    return lines


def app_summary(files: Iterable[str], folder: Path) -> list[str]:
    """Return the lines for the generator app: its files, and how to build it into a cFS."""
    return [
        *(f"{folder / name}" for name in files),
        "",
        f"in targets.cmake:          list(APPEND MISSION_GLOBAL_APPLIST {folder.name})",
        f"in cfe_es_startup.scr:     {STARTUP}",
        "in to_lab_sub.c:           the MsgIds that it is to publish, if the ground is to get them",
    ]


def _bounded(message: Message, prefix: str) -> Iterator[str]:
    """Yield the fields of variable length: paths and their bounds."""
    for member in message.members:
        path = prefix + member.ros.name
        parts = [str(member.elements)] * member.is_sequence + [str(member.characters)] * bool(
            member.characters
        )
        if parts:
            yield f"{path} {' of '.join(parts)}"
        if member.message:
            yield from _bounded(member.message, f"{path}[]." if member.elements else f"{path}.")

"""A live diagnosis: the table kept current on a terminal, a line for each new verdict anywhere else."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

from edoras_tools.diagnosis.verdict import Severity
from edoras_tools.render.doctor.doctor import verdict_line, verdict_table
from edoras_tools.render.terminal.live_table import LiveView
from edoras_tools.render.terminal.terminal import detect_terminal, error_console

if TYPE_CHECKING:
    from rich.console import RenderableType
    from typing_extensions import Self

    from edoras_tools.diagnosis.examination import Diagnosis


class LiveVerdicts:
    """Shows verdicts as they come, and rings the terminal bell once for each new one; a context manager."""

    def __init__(self, title: str, *, quiet: bool = False) -> None:
        self._title = title
        self._quiet = quiet
        self._known: set[tuple[object, ...]] = set()
        self._console = error_console()
        interactive = detect_terminal(sys.stderr).interactive and not quiet
        self._live = LiveView(self._table, self._console) if interactive else None

    def _table(self, diagnosis: Diagnosis, _now: float) -> RenderableType:
        return verdict_table(diagnosis, self._title, self._console.height)

    def __enter__(self) -> Self:
        if self._live:
            self._live.__enter__()
        return self

    def __exit__(self, *_: object) -> None:
        if self._live:
            self._live.__exit__()

    def update(self, diagnosis: Diagnosis) -> None:
        """Show the diagnosis as it is now."""
        new = []
        for verdict in diagnosis.verdicts:
            if verdict.severity >= Severity.WARNING and verdict.key not in self._known:
                self._known.add(verdict.key)
                new.append(verdict)
        if self._live:
            self._live.update(diagnosis)
            if new:
                self._console.bell()
        elif not self._quiet:
            for verdict in new:
                sys.stderr.write(f"\a{verdict_line(verdict)}\n")
            sys.stderr.flush()

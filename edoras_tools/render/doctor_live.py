"""A live diagnosis: the table kept current on a terminal, a line for each new verdict anywhere else."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Self

from rich.live import Live

from edoras_tools.diagnosis.verdict import Severity
from edoras_tools.render.console import error_console
from edoras_tools.render.doctor import one_line, verdict_table
from edoras_tools.render.terminal import look

if TYPE_CHECKING:
    from edoras_tools.diagnosis.examination import Diagnosis


class LiveVerdicts:
    """Shows verdicts while they come, and rings once for each new one; a context manager.

    Args:
        title: what is watched.
        quiet: show nothing.
    """

    def __init__(self, title: str, *, quiet: bool = False) -> None:
        self._title = title
        self._quiet = quiet
        self._known: set[tuple[object, ...]] = set()
        self._console = error_console()
        interactive = look(sys.stderr).interactive and not quiet
        self._live = Live(console=self._console, auto_refresh=False) if interactive else None

    def __enter__(self) -> Self:
        if self._live:
            self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._live:
            self._live.update("", refresh=True)
            self._live.stop()

    def update(self, diagnosis: Diagnosis) -> None:
        """Show the diagnosis as it is now."""
        new = []
        for verdict in diagnosis.verdicts:
            if verdict.severity >= Severity.WARNING and verdict.key not in self._known:
                self._known.add(verdict.key)
                new.append(verdict)
        if self._live:
            self._live.update(verdict_table(diagnosis, self._title, self._console.height), refresh=True)
            if new:
                self._console.bell()
        elif not self._quiet:
            for verdict in new:
                sys.stderr.write(f"\a{one_line(verdict)}\n")
            sys.stderr.flush()

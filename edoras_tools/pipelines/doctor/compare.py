"""Compares two captures of the same traffic."""

from __future__ import annotations

from typing import TYPE_CHECKING

from edoras_tools.diagnosis.evidence.table import Recorder
from edoras_tools.diagnosis.matching.comparison import CaptureComparison, compare_captures
from edoras_tools.pipelines.doctor.scope import Chosen, Scope
from edoras_tools.pipelines.reading import reading

if TYPE_CHECKING:
    from edoras_tools.io import Source
    from edoras_tools.pipelines.workbench import Workbench
    from edoras_tools.render.terminal.run import Progress


def diff(
    first: Source,
    second: Source,
    bench: Workbench,
    scope: Scope | None = None,
    progress: Progress | None = None,
) -> CaptureComparison:
    """Read two sources to their ends and compare them.

    Args:
        first: the capture at one point.
        second: the capture at the other point.
        bench: decodes both.
        scope: which time of the first is compared, and which routes are shown.
        progress: shows the progress of reading.

    Raises:
        CaptureError: one of them cannot be read to its end.
        RouteError: the scope names a topic that is not configured.
        ConfigError: its filter has an error.
    """
    scope = scope or Scope()
    chosen = Chosen(scope.selection, bench)
    recorders = (
        read_capture(first, bench, scope, chosen, progress),
        read_capture(second, bench, Scope(), chosen, progress),
    )
    found, choice = compare_captures(*recorders, bench.mission), chosen.choice()
    return found if choice is None else found.limited(choice)


def read_capture(
    source: Source, bench: Workbench, scope: Scope, chosen: Chosen, progress: Progress | None
) -> Recorder:
    """Read a source to its end; see ``diff``."""
    recorder = Recorder(bench.columns.context)
    with reading(source, bench, examined=scope.period) as loop:
        for rows in loop:
            recorder.add(rows.batch, rows.columns)
            chosen.add(rows.batch, rows.columns)
            if progress is not None:
                progress.read(source)
    if loop.interrupted:
        raise KeyboardInterrupt  # a part of a capture must not be compared
    return recorder

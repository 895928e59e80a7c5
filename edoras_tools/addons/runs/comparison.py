"""Reads two captures of different runs and compares them."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

from edoras_tools.addons.runs.differences import Run, RunDifference, run_differences
from edoras_tools.pipelines.capture.info import Counting
from edoras_tools.pipelines.doctor.doctor import examine
from edoras_tools.pipelines.workbench import Settings, open_files
from edoras_tools.render.severity import NOTABLE

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from edoras_tools.pipelines.doctor.scope import Scope
    from edoras_tools.render.terminal.text import Progress


@dataclass(frozen=True, slots=True)
class Runs:
    """The result of a comparison.

    Attributes:
        good: the reference run.
        bad: the other run.
        changes: all differences, those for the worse first.
    """

    good: Run
    bad: Run
    changes: Sequence[RunDifference]

    @property
    def worse(self) -> bool:
        """Whether anything is worse in the bad run."""
        return any(item.worse for item in self.changes)

    def as_json(self) -> dict[str, Any]:
        """Return it in the shape of ``compare --json``."""

        def run_json(run: Run) -> dict[str, Any]:
            return {
                "source": run.info["source"],
                "datagrams": run.info["datagrams"],
                "seconds": run.seconds,
                "lost": run.doctor["lost"],
            }

        return {
            "good": run_json(self.good),
            "bad": run_json(self.bad),
            "worse": self.worse,
            "changes": [asdict(item) for item in self.changes],
        }


def compare_runs(
    good: Path,
    bad: Path,
    settings: Settings,
    *,
    tolerance: float,
    scope: Scope | None = None,
    progress: Progress | None = None,
) -> Runs:
    """Read two captures and compare them as runs of the same system.

    Args:
        good: the reference run.
        bad: the other run.
        settings: missions and decoding options, the same for both.
        tolerance: accepted relative difference of rates and latencies, e.g. 0.1.
        scope: what of both is compared.
        progress: updated while they are read and judged.

    Raises:
        CaptureError: one of them cannot be read to its end, or contains no datagram.
    """
    good_run, bad_run = (_run(path, settings, scope, progress) for path in (good, bad))
    serious = {item.label for item in NOTABLE}
    changes = run_differences(good_run, bad_run, tolerance=tolerance, serious=serious)
    return Runs(good_run, bad_run, changes)


def _run(path: Path, settings: Settings, scope: Scope | None, progress: Progress | None) -> Run:
    source = open_files([path])
    bench = settings.workbench(source.info)
    counting = Counting(source, bench)
    judged = examine(source, bench, scope=scope, progress=progress, counting=counting)
    if judged.failure is not None:
        raise judged.failure
    return Run(counting.report.summary(), judged.summary())

"""The doctor as a library: what is wrong on a link, where and why.

>>> from edoras_tools import doctor
>>> diagnosis = doctor.examine("rover.pcap", config=["rover_ground.yaml"])  # doctest: +SKIP
>>> [verdict.reason for verdict in diagnosis.verdicts]  # doctest: +SKIP
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from edoras_tools.diagnosis.accounting.budget import Budget
from edoras_tools.diagnosis.accounting.budget import predict as predict_budgets
from edoras_tools.diagnosis.examination import Diagnosis, Examination
from edoras_tools.diagnosis.verdict import Severity, Verdict
from edoras_tools.io.formats.open import open_file
from edoras_tools.pipelines.doctor import examine as examine_source
from edoras_tools.pipelines.workbench import Settings

if TYPE_CHECKING:
    from edoras_tools.cfs.profile import SimProfile
    from edoras_tools.io import Source

__all__ = ["Diagnosis", "Examination", "Severity", "Verdict", "examine", "predict"]


def examine(
    source: str | os.PathLike[str] | Source,
    *,
    config: Sequence[str | os.PathLike[str]] = (),
    profile: SimProfile | None = None,
) -> Diagnosis:
    """Read a capture or a recording to its end and judge it.

    Args:
        source: a file (pcap, pcapng or MCAP), or any ``Source``.
        config: mission files; if none is named, those that a recording carries apply.
        profile: the constants of the cFS on the link.

    Raises:
        CaptureError: the file cannot be read, or ended early.
        ConfigError: a mission file has mistakes.
    """
    opened = open_file(Path(source)) if isinstance(source, (str, os.PathLike)) else source
    bench = Settings(configs=[Path(item) for item in config]).workbench(opened.info)
    findings = examine_source(opened, bench, examination=Examination(bench.columns.context, profile))
    if findings.failure is not None:
        raise findings.failure
    return findings.diagnosis


def predict(config: Sequence[str | os.PathLike[str]], *, profile: SimProfile | None = None) -> list[Budget]:
    """Return the highest clean rate of every route of some mission files.

    Raises:
        ConfigError: a mission file has mistakes.
    """
    bench = Settings(configs=[Path(item) for item in config]).workbench()
    return predict_budgets(bench.mission, bench.types, profile or bench.mission.software.profile)

"""The capture kept only the beginnings of frames: what it cannot show is nobody's fault."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from edoras_tools.diagnosis.verdict import Severity, Verdict
from edoras_tools.model import Finding

if TYPE_CHECKING:
    from collections.abc import Iterator

    from edoras_tools.diagnosis.case import Case

ID = "cut_frames"


def judge(case: Case) -> Iterator[Verdict]:
    """Say so before anything else."""
    cut = np.flatnonzero(case.rows.has(Finding.CAPTURE_CUT))
    if len(cut):
        yield Verdict(
            ID,
            Severity.WARNING,
            f"{len(cut):,} of {len(case.rows):,} frames were cut by the capture: what their ends would show "
            "(messages, events, counters) is not judged; datagrams are counted",
            hop="capture",
            start_ns=int(case.rows.time_ns[cut[0]]),
            end_ns=int(case.rows.time_ns[cut[-1]]),
            evidence=("the capture says that these frames were longer on the wire",),
            remedy="capture whole frames, without -s or with -s 0",
        )

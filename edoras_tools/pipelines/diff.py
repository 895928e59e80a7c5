"""Two sources held against each other."""

from __future__ import annotations

from typing import TYPE_CHECKING

from edoras_tools.diagnosis.comparison import Comparison, compare
from edoras_tools.diagnosis.table import Recorder

if TYPE_CHECKING:
    from edoras_tools.diagnosis.table import Rows
    from edoras_tools.pipelines.workbench import Workbench
    from edoras_tools.sources import Source


def diff(first: Source, second: Source, bench: Workbench) -> Comparison:
    """Read two sources to their ends and compare them.

    Raises:
        CaptureError: one of them cannot be read to its end.
    """
    return compare(_rows(first, bench), _rows(second, bench), bench.mission)


def _rows(source: Source, bench: Workbench) -> Rows:
    recorder = Recorder(bench.columns.context)
    try:
        for batch in source.batches():
            if len(batch):
                recorder.add(batch, bench.columns.decode(batch))
    finally:
        source.close()
    return recorder.rows()

"""The messages that were lost, with their values."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from edoras_tools.decode import Dissector
from edoras_tools.diagnosis.missing import Missing, missing

if TYPE_CHECKING:
    from edoras_tools.diagnosis.case import Case
    from edoras_tools.diagnosis.choice import Choice
    from edoras_tools.io import Source
    from edoras_tools.pipelines.workbench import Workbench
    from edoras_tools.render.terminal.run import Progress


def list_missing(
    case: Case,
    source: Source,
    bench: Workbench,
    choice: Choice | None = None,
    progress: Progress | None = None,
) -> list[Missing]:
    """Return the messages that were lost, with the values of those that the capture contains.

    Args:
        case: the judged capture.
        source: the same capture again, for the values; it is closed.
        bench: decodes them.
        choice: which messages; None for all.
        progress: updated while the source is read.
    """
    found = [item for item in missing(case) if choice is None or choice.takes(*item.concerns)]
    wanted = {item.number: place for place, item in enumerate(found) if item.number is not None}
    dissector = Dissector(bench.columns.context, detail=False)
    try:
        for batch in source.batches() if wanted else ():
            if progress is not None:
                progress.read(source)
            for row in np.flatnonzero(np.isin(batch.number, list(wanted))).tolist():
                message = dissector.dissect(batch[row]).message
                place = wanted[int(batch.number[row])]
                found[place] = replace(found[place], message=dict(message.values) if message else None)
    finally:
        source.close()
    return found

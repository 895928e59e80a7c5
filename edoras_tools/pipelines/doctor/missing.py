"""The messages that were lost, with their values."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from edoras_tools.decode import Dissector
from edoras_tools.io.formats.jsonl.writer import json_value
from edoras_tools.io.formats.merge import follow_streams

if TYPE_CHECKING:
    from edoras_tools.diagnosis.examination import Diagnosis
    from edoras_tools.diagnosis.missing import Missing
    from edoras_tools.io import Source
    from edoras_tools.pipelines.workbench import Workbench
    from edoras_tools.render.terminal.run import Progress


def list_missing(
    diagnosis: Diagnosis,
    source: Source,
    bench: Workbench,
    progress: Progress | None = None,
) -> list[Missing]:
    """Return the messages that were lost, with the values of those that the capture contains.

    Args:
        diagnosis: of the capture, with what is missing.
        source: the same capture again, for the values; it is closed.
        bench: decodes them.
        progress: updated while the source is read.
    """
    choice = diagnosis.choice
    found = [item for item in diagnosis.missing if choice is None or choice.takes(*item.concerns)]
    wanted = {item.number: place for place, item in enumerate(found) if item.number is not None}
    dissector = Dissector(bench.columns.context, detail=False)
    follow_streams(source, bench.columns.context.framings)
    try:
        for batch in source.batches() if wanted else ():
            if progress is not None:
                progress.read(source)
            for row in np.flatnonzero(np.isin(batch.number, list(wanted))).tolist():
                message = dissector.dissect(batch[row]).message
                place = wanted[int(batch.number[row])]
                found[place] = replace(found[place], message=json_value(message.values) if message else None)
    finally:
        source.close()
    return found

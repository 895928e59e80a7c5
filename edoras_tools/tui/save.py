"""Writes the packets of the list to a file, in the format of its suffix."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from edoras_tools.decode.filters.rows import ColumnRows
from edoras_tools.model import SourceStatistics
from edoras_tools.pipelines.capture.record import Target, check_output, open_sink
from edoras_tools.pipelines.recorder import PushedSource

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from edoras_tools.model import SourceInfo
    from edoras_tools.pipelines.workbench import Workbench
    from edoras_tools.tui.data.store import Part


def save_packets(parts: Sequence[Part], path: Path, info: SourceInfo, bench: Workbench, chosen: str) -> int:
    """Write packets to a new file; return how many.

    Args:
        parts: what ``Store.parts`` returned.
        path: the file; its suffix sets the format.
        chosen: the filter that the packets passed; a recording stores it.

    Raises:
        CaptureError: the file cannot be written.
        ConfigError: the suffix is unknown, or the file exists.
    """
    target = Target(path)
    check_output(target, ())
    source, count = PushedSource(info, SourceStatistics()), 0
    sink = open_sink(target, source, bench, chosen=chosen)
    try:
        for block, _, shown in parts:
            rows = ColumnRows(bench.columns.context, 0, block.batch, block.columns, np.asarray(shown))
            sink.write(*rows.alone())
            count += len(shown)
    finally:
        sink.close(source.statistics)
    return count

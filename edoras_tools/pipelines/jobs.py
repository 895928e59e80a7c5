"""How many processes share the work on a file."""

from __future__ import annotations

import os
import sys
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from edoras_tools.io import Source

_LARGE: Final = 32 << 20
"""Files of at least this many bytes are worth several processes."""
_MOST_JOBS: Final = 3
"""One process reads and decodes; two others do the rest as fast as it does."""


def jobs_for(source: Source, asked: int) -> int:
    """Return how many processes share the work on a source.

    Args:
        source: what is read; one that is live, from a pipe or small is one process's.
        asked: as many; 0: as many as there are processor cores, at most three.
    """
    if source.statistics.total_bytes < _LARGE:
        return 1
    cores = len(os.sched_getaffinity(0)) if sys.platform == "linux" else 1
    return asked or min(_MOST_JOBS, cores)

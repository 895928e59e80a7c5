"""How many processes share the work on a file."""

from __future__ import annotations

import os
import sys
from time import sleep
from typing import TYPE_CHECKING, Final

from edoras_tools.io.processors import spare_processors

if TYPE_CHECKING:
    from edoras_tools.io import Source

_LARGE: Final = 32 << 20
"""Files of at least this many bytes are worth several processes."""
_MOST_JOBS: Final = 3
"""One process reads and decodes; two others do the rest as fast as it does."""
_LOOKS: Final = 5
_LOOK_S: Final = 0.002
"""Something short may run just when it is looked."""


def jobs_for(source: Source, asked: int, *, fixed: bool = True) -> int:
    """Return how many processes share the work on a source.

    Args:
        source: what is read; one that is live, from a pipe or small is one process's.
        asked: as many; 0: as many as there are processor cores, at most three.
        fixed: the number stays, so that with 0 only those cores count that are free now.
    """
    if source.statistics.total_bytes < _LARGE:
        return 1
    if asked:
        return asked
    cores = len(os.sched_getaffinity(0)) if sys.platform == "linux" else 1
    others = min(_MOST_JOBS, cores) - 1
    return 1 + (_spare(others) if fixed else others)


def _spare(wanted: int) -> int:
    """Return how many processors are free, at most as many as are wanted."""
    found = 0
    for look in range(_LOOKS if wanted else 0):
        if look:
            sleep(_LOOK_S)
        found = max(found, min(wanted, spare_processors()))
        if found == wanted:
            break
    return found

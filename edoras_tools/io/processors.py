"""How many processors of this machine are free: who shares work takes them, and leaves others theirs."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Final

_LOAD: Final = Path("/proc/loadavg")


def spare_processors() -> int:
    """Return for how many more processes there is a processor now; below 0 where some wait for one.

    Those that run are counted on the whole machine, and this process is one of them (proc(5), ``loadavg``).
    Where that cannot be told, nothing else is taken to run.
    """
    processors = os.cpu_count() or 1
    if sys.platform != "linux":
        return processors - 1
    try:
        running = int(_LOAD.read_text().split()[3].partition("/")[0])
    except (OSError, ValueError, IndexError):
        return processors - 1
    return processors - max(running, 1)

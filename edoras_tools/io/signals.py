"""The signals that end a program which writes: Ctrl-C, ``kill``, and a closed terminal."""

from __future__ import annotations

import signal
from typing import Final

ENDING: Final = tuple(
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)
)

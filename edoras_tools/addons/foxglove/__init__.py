"""Links, recordings and graphs live in Foxglove: ``edoras live``, ``--live``, ``bridge --ros foxglove``."""

from __future__ import annotations

from typing import Final

from edoras_tools.middleware.graph import Middleware

FOXGLOVE: Final = Middleware(
    f"{__name__}.graph:open_graph", "an extra ({why}): pip install 'edoras-tools[live]'"
)

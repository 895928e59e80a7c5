"""The laboratory: an emulated cFS, the demos that it runs, and the measurement of what a route carries."""

from __future__ import annotations

from typing import Final

from edoras_tools.middleware.graph import Middleware

LOCAL: Final = Middleware(f"{__name__}.demo.local_graph:open_graph")

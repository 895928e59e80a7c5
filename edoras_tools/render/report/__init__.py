"""A diagnosis as one self-contained HTML page: no network, no scripts needed to read it."""

from edoras_tools.render.report.page import page

__all__ = ["page"]

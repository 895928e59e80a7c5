"""A diagnosis as one self-contained HTML page: no network, no scripts needed to read it."""

from edoras_tools.render.doctor.report.page import page
from edoras_tools.render.doctor.report.parts import Made

__all__ = ["Made", "page"]

"""The languages that describe packets; this file imports nothing else, for the command's help."""

from __future__ import annotations

from edoras_tools.older import StrEnum


class GroundForm(StrEnum):
    """A language that describes packets."""

    XTCE = "xtce"
    COSMOS = "cosmos"

"""The links: one file each, one row each in the table below; see docs/links.md.

This file imports nothing: help texts name the links without loading them. The links themselves are in
:mod:`edoras_tools.links.table`.
"""

from __future__ import annotations

from typing import Final

ROWS: Final = {
    "ci": "edoras_tools.links.bare:CI",
    "to": "edoras_tools.links.bare:TO",
    "sbn": "edoras_tools.links.sbn:SBN",
    "robot": "edoras_tools.links.bare:ROBOT",
    "file": "edoras_tools.links.table:STORED",
    "reset": "edoras_tools.links.table:RESETS",
    "icmp": "edoras_tools.links.icmp:ICMP",
}
"""Locations of the built-in links; other packages add theirs by entry points."""

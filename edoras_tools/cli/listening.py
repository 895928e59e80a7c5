"""Ports that other machines can reach: a line says who may send to them, before any traffic."""

from __future__ import annotations

from typing import TYPE_CHECKING

from edoras_tools.cli.endings import tell

if TYPE_CHECKING:
    from edoras_tools.model import Endpoint


def tell_reach(endpoint: Endpoint, may: str, **words: str) -> None:
    """Print who may send to a port; print nothing for a port on loopback. See ``reach_note``."""
    from edoras_tools.io.net.address import reach_note

    if note := reach_note(endpoint, may, **words):
        tell(note)

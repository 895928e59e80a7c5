"""``edoras demo``: the tour."""

from __future__ import annotations


def demo() -> None:
    """Show the main job on loopback against the emulated cFS: sniff, record, decode, and what to look at next."""

"""Figures in sentences."""

from __future__ import annotations


def plural(number: int, noun: str) -> str:
    """Return ``1 packet``, ``1,827 packets``."""
    return f"{number:,} {noun}" + ("" if number == 1 else "s")


def listed(items: list[str], most: int = 8) -> str:
    """Return the first of some items, and that there are more."""
    return ", ".join(items[:most]) + (", ..." if len(items) > most else "")

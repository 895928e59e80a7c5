"""Numbers, lists and suggestions in sentences."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from difflib import get_close_matches


def plural(number: int, noun: str) -> str:
    """Return ``1 packet``, ``1,827 packets``."""
    return f"{number:,} {noun}" + ("" if number == 1 else "s")


def seconds(value: float, digits: int = 1) -> str:
    """Return a span of time, a long one in a larger unit too: ``5.0 s``, ``1478876100.4 s (46.9 years)``."""
    units = (
        (120, 60, "minutes"),
        (7200, 3600, "hours"),
        (172_800, 86_400, "days"),
        (6.4e7, 3.15576e7, "years"),
    )
    text = f"{value:.{digits}f} s"
    larger = [f"{value / size:.1f} {name}" for least, size, name in units if abs(value) >= least]
    return f"{text} ({larger[-1]})" if larger else text


def listed(items: Sequence[str], most: int = 8) -> str:
    """Return the first ``most`` items as a list in text, and ``...`` if there are more."""
    return ", ".join(items[:most]) + (", ..." if len(items) > most else "")


def either(items: Sequence[str]) -> str:
    """Return ``a``, ``a or b``, ``a, b or c``."""
    return " or ".join([", ".join(items[:-1]), items[-1]] if items[1:] else items)


def did_you_mean(word: str, names: Iterable[str], most: int = 3, cutoff: float = 0.6) -> str:
    """Return ``did you mean a or b?`` with the nearest names, case ignored; empty if none is near.

    >>> did_you_mean("linaer.x", ["linear.x", "angular.z"])
    'did you mean linear.x?'
    """
    lower = {item.lower(): item for item in names}
    near = [lower[item] for item in get_close_matches(word.lower(), lower, most, cutoff)]
    return f"did you mean {either(near)}?" if near else ""

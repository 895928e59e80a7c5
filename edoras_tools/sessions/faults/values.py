"""Text to values: the times, probabilities, counts, rates and field changes of a fault rule.

Each function raises ValueError for another text; the message says which texts are allowed.
"""

from __future__ import annotations

import math
from typing import NamedTuple

_TIMES = {"ns": 1, "us": 10**3, "ms": 10**6, "s": 10**9, "m": 60 * 10**9, "h": 3600 * 10**9}
_MULTIPLES = {"k": 10**3, "M": 10**6, "G": 10**9}
_LONGEST_NS = 1 << 60


class NumberChange(NamedTuple):
    """A change of a number: ``+3`` and ``-3`` are added, ``12`` replaces it.

    Attributes:
        amount: number to add, or the new value.
        relative: whether to add it.
    """

    amount: int
    relative: bool

    def apply(self, value: int) -> int:
        """Return the changed number."""
        return value + self.amount if self.relative else self.amount


def time_ns(text: str) -> int:
    """Read a length of time in ns: ``200ms``, ``1.5s``, ``2m``; a bare number is seconds."""
    unit = next((name for name in sorted(_TIMES, key=len, reverse=True) if text.endswith(name)), "")
    value = _decimal(text.removesuffix(unit)) * _TIMES.get(unit, 10**9)
    if not 0 <= value < _LONGEST_NS:  # also if it is not a number
        raise ValueError("a length of time is needed, as 200ms, 1.5s or 2m")
    return int(value)


def probability(text: str) -> float:
    """Read a probability: ``0.1``, ``10%``."""
    value = _decimal(text.removesuffix("%")) / (100 if text.endswith("%") else 1)
    if not 0 <= value <= 1:
        raise ValueError("a probability is needed, from 0 to 1 or from 0% to 100%")
    return value


def natural(text: str) -> int:
    """Read a count, 1 or more, decimal or hex."""
    value = _integer(text)
    if value is None or not 1 <= value < 1 << 32:
        raise ValueError("a whole number is needed, 1 or more")
    return value


def byte_count(text: str) -> int:
    """Read a number of bytes, 0 to 65,507: ``40``, ``0x40``."""
    value = _integer(text)
    if value is None or not 0 <= value <= 65507:
        raise ValueError("a number of bytes is needed, from 0 to 65507")
    return value


def volume(text: str) -> int:
    """Read an amount of bytes: ``65536``, ``64k``, ``2M``."""
    value = _decimal(text.removesuffix(text[-1:] if text[-1:] in _MULTIPLES else "")) * _MULTIPLES.get(
        text[-1:], 1
    )
    if not 1 <= value < 1 << 40:
        raise ValueError("an amount of bytes is needed, as 65536, 64k or 2M")
    return int(value)


def hertz(text: str) -> float:
    """Read a rate in messages a second: ``30``, ``0.5``, ``30Hz``."""
    value = _decimal(text.removesuffix("Hz").removesuffix("hz"))
    if not 1e-6 <= value <= 1e9:
        raise ValueError("a rate is needed, above 0, as 30 or 0.5Hz")
    return value


def bits_per_second(text: str) -> float:
    """Read a bandwidth in bits a second: ``9600``, ``128k``, ``2M``, with or without ``bit/s``."""
    text = text.removesuffix("bit/s").removesuffix("bit")
    unit = text[-1:] if text[-1:] in _MULTIPLES else ""
    value = _decimal(text.removesuffix(unit)) * _MULTIPLES.get(unit, 1)
    if not 1 <= value <= 1e15:
        raise ValueError("a bandwidth in bits a second is needed, as 9600, 128k or 2M")
    return value


def change(text: str) -> NumberChange:
    """Read a change of a field: ``+3``, ``-3``, ``12``, ``0xFFFF``."""
    value = _integer(text)
    if value is None or abs(value) >= 1 << 64:
        raise ValueError("a number to set is needed, as 12, or one to add, as +3 or -3")
    return NumberChange(value, text[:1] in {"+", "-"})


def _decimal(text: str) -> float:
    """Return a number, or NaN, which fits no limits."""
    try:
        return float(text)
    except ValueError:
        return math.nan


def _integer(text: str) -> int | None:
    try:
        return int(text, 0)
    except ValueError:
        return None

"""Bounds of an expectation: ``600``, ``9.5..10.5 Hz``, ``at least 1``, ``at most 300ms``, ``at most 1%``."""

from __future__ import annotations

import re
from contextlib import suppress
from dataclasses import dataclass
from enum import Enum
from math import inf
from typing import Final

from edoras_tools.render import units
from edoras_tools.sessions.faults.values import time_ns
from edoras_tools.units import SECOND
from edoras_tools.words import plural

_FORM: Final = re.compile(r"(at least|at most|>=|<=)\s*(\S.*)|(\S+?)\s*\.\.\s*(\S.*)|(\S.*)")


class Unit(Enum):
    """What a bound counts; the value is how one is written."""

    MESSAGES = "600, 590..610 or at least 1"
    BYTES = "76, 76..116 or at most 768"
    RATE = "9..11 or at least 9 Hz"
    TIME = "at most 300ms or 1s..3s"
    LOSS = "0, at most 12 or at most 1%"

    def number(self, text: str) -> float:
        """Read one number; times are in seconds.

        Raises:
            ValueError: it is none of this unit.
        """
        if self is Unit.TIME:
            return time_ns(text) / SECOND
        name = {Unit.RATE: "Hz", Unit.BYTES: "bytes"}.get(self, "")
        plain = text.removesuffix(name).strip()
        if not re.fullmatch(r"\d+(\.\d+)?", plain) or ("." in plain and self is not Unit.RATE):
            raise ValueError(text)
        return float(plain)

    def text_of(self, value: float | None) -> str:
        """Return a value for people."""
        if value is None:
            return units.NONE
        if self is Unit.RATE:
            return f"{value:.4g} Hz"
        if self is Unit.TIME:
            return units.milliseconds(value * 1e3)
        return plural(int(value), "byte" if self is Unit.BYTES else "message")


@dataclass(frozen=True, slots=True)
class Tolerance:
    """The least and the most that is accepted, both included.

    Attributes:
        text: as written.
        unit: of both; times are in seconds.
        low: the least.
        high: the most.
        share: both are shares of what was sent, from 0 to 1.
    """

    text: str
    unit: Unit
    low: float = 0
    high: float = inf
    share: bool = False

    def holds(self, value: float) -> bool:
        """Return whether a value is accepted."""
        return self.low <= value <= self.high


def parse_bound(text: str, unit: Unit) -> Tolerance:
    """Read a bound.

    Raises:
        ValueError: with what is allowed instead.
    """
    match = _FORM.fullmatch(text.strip())
    word, alone, low, high, exact = match.groups() if match else ("", "", "", "", "")
    numbers = [item for item in (alone, low, high, exact) if item]
    share = unit is Unit.LOSS and bool(numbers) and all(item.endswith("%") for item in numbers)
    values = []
    with suppress(ValueError):
        values = [float(item[:-1]) / 100 if share else unit.number(item) for item in numbers]
    never = exact and (share or unit in {Unit.RATE, Unit.TIME})  # a rate is never exactly so
    if not values or never or values != sorted(values) or (share and not 0 <= values[-1] <= 1):
        raise ValueError(f"{text!r} is no bound; write {unit.value}")
    least, most = values[0], values[-1]
    if word in {"at least", ">="}:
        most = inf
    elif word:
        least = 0
    return Tolerance(text.strip(), unit, least, most, share)

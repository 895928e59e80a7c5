"""Numbers, times, lists and suggestions as text."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from datetime import datetime, timedelta
from difflib import get_close_matches
from typing import Final

from edoras_tools.older import UTC, StrEnum

_EPOCH: Final = datetime(1970, 1, 1, tzinfo=UTC)
NONE: Final = "-"


class TimeFormat(StrEnum):
    """Formats of the time column."""

    RELATIVE = "relative"
    """Seconds since the first packet."""
    DELTA = "delta"
    """Seconds since the previous packet."""
    UTC = "utc"
    """Date, if there is room, and time of day."""
    EPOCH = "epoch"
    """Seconds since 1970-01-01 UTC, as in flight logs."""


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


def count(value: int | None) -> str:
    """Return ``1,827``; ``-`` for None."""
    return NONE if value is None else f"{value:,}"


def rate(hertz: float | None) -> str:
    """Return ``10.0 Hz``, ``250 Hz``, ``12.4 kHz``; ``-`` for None."""
    if hertz is None:
        return NONE
    return f"{hertz / 1e3:,.1f} kHz" if abs(hertz) >= 9999.5 else f"{_shortened(hertz, 1)} Hz"


def milliseconds(value: float | None) -> str:
    """Return ``0.42 ms``, ``12.5 ms``, ``1.3 s``; ``-`` for None."""
    if value is None:
        return NONE
    return f"{value / 1e3:,.1f} s" if abs(value) >= 999.5 else f"{_shortened(value, 9.995)} ms"


def microseconds(value: float | None) -> str:
    """Return ``420 µs``, from 1 ms on as milliseconds; ``-`` for None."""
    return NONE if value is None else f"{value:.0f} µs" if value < 999.5 else milliseconds(value / 1000)


def size(octets: float) -> str:
    """Return ``840 B``, ``12.4 MiB``."""
    if abs(octets) < 1023.5:
        return f"{octets:.0f} B"
    power = next((power for power in (1, 2, 3) if abs(octets) < 1023.95 * 1024**power), 4)
    return f"{octets / 1024**power:,.1f} {'BKMGT'[power]}iB"


def duration(seconds: float) -> str:
    """Return ``65.1 s``, ``3:24``, ``1:02:03``, ``2 d 1:02:03``."""
    if seconds < 99.95:
        return f"{seconds:.1f} s"
    whole = round(seconds)
    days, hours, minutes, whole = whole // 86400, whole // 3600 % 24, whole // 60 % 60, whole % 60
    clock = f"{hours}:{minutes:02}:{whole:02}" if days or hours else f"{minutes}:{whole:02}"
    return f"{days} d {clock}" if days else clock


def utc(time_ns: int, *, digits: int = 6) -> str:
    """Return ``2026-11-21 06:36:42.553538``.

    Args:
        time_ns: ns since 1970-01-01 UTC; a time outside the years 1 to 9999 is given in seconds.
        digits: of the second's fraction, 0 to 6.
    """
    try:
        moment = _EPOCH + timedelta(microseconds=time_ns // 1000)
    except OverflowError:
        return f"{time_ns / 1e9:.{digits}f} s"
    text = f"{moment:%Y-%m-%d %H:%M:%S.%f}"
    return text[: len(text) - 6 + digits] if digits else text[:-7]


def _shortened(value: float, one_from: float) -> str:
    """Return a number with no decimals from 100 on, one from ``one_from`` on, else two."""
    decimals = 0 if abs(value) >= 99.95 else 1 if abs(value) >= one_from else 2
    return f"{value:,.{decimals}f}"

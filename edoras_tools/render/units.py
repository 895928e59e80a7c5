"""Numbers with units, and times, as text."""

from __future__ import annotations

from datetime import datetime, timedelta
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

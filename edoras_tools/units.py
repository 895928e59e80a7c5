"""Spans of time in ns, the unit of every time in this package, and rates."""

from __future__ import annotations

from typing import Final

MICROSECOND: Final = 1_000
MILLISECOND: Final = 1_000_000
SECOND: Final = 1_000_000_000


def rate_hz(count: int, span_ns: int) -> float:
    """Return the rate of messages between the first and the last, which every command means by a rate.

    Args:
        count: messages, the first and the last among them.
        span_ns: from the first to the last; without one the rate is 0.
    """
    return (count - 1) * SECOND / span_ns if count > 1 and span_ns > 0 else 0.0

"""Why more of a MsgId came than one sender means to send: several senders at once, or copies on the way."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from edoras_tools.units import MILLISECOND, SECOND

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from edoras_tools.diagnosis.evidence.table import Rows
    from edoras_tools.model import Endpoint

_LEAST: Final = 3
_LEAST_SHARE: Final = 0.1
_ECHO: Final = 0.4
"""A copy follows within this share of the usual time from one message to the next,"""
_ECHO_SHARE: Final = 0.02
_STEADY: Final = 0.6
"""and so many of the others come at that usual time, give or take a third."""


def crowding(rows: Rows, own: NDArray[np.intp], endpoints: Sequence[Endpoint]) -> str:
    """Return half a sentence that says who sent some datagrams more than once; empty where one sender did.

    Args:
        own: rows of datagrams of one MsgId that went to one receiver, in order of time.
    """
    return _several_senders(rows, own, endpoints) or _echoes(rows, own)


def _several_senders(rows: Rows, own: NDArray[np.intp], endpoints: Sequence[Endpoint]) -> str:
    """Tell of senders that sent at one time, not one after the other."""
    sources, counts = np.unique(rows.source[own], return_counts=True)
    least = max(_LEAST, _LEAST_SHARE * len(own))
    times = {
        int(source): rows.time_ns[own[rows.source[own] == source]]
        for source, count in zip(sources, counts, strict=True)
        if count >= least
    }
    if len(times) < 2:
        return ""
    start_ns, end_ns = max(at[0] for at in times.values()), min(at[-1] for at in times.values())
    if any(2 * int(((at >= start_ns) & (at <= end_ns)).sum()) < len(at) for at in times.values()):
        return ""
    each = ", ".join(f"{endpoints[source]} at {_hz(at)}" for source, at in times.items())
    return f"{len(times)} senders sent it at once ({each})"


def find_echoes(rows: Rows, own: NDArray[np.intp]) -> NDArray[np.bool_]:
    """Tell which of a steady sender's datagrams are copies: they come a short time after an equal one.

    That time is always about the same; a burst of equal ones has no usual time from one to the next. What a
    second sender sends is no copy.
    """
    times, prints = rows.time_ns[own], rows.bytes_print[own]
    steps, none = np.diff(times), np.zeros(len(own), bool)
    if len(steps) < 2 * _LEAST:
        return none
    usual = _usual(steps)
    sources = rows.source[own]
    echo = (steps < _ECHO * usual) & (prints[1:] == prints[:-1]) & (sources[1:] == sources[:-1])
    if int(echo.sum()) < max(_LEAST, _ECHO_SHARE * len(own)):
        return none
    first, median, third = np.quantile(steps[echo], (0.25, 0.5, 0.75))
    rest = np.diff(times[np.concatenate(([True], ~echo))])
    steady = np.abs(rest - usual) < usual / 3
    if third - first > max(median / 3, 5 * MILLISECOND) or steady.mean() < _STEADY:
        return none
    return np.concatenate(([False], echo))


def _echoes(rows: Rows, own: NDArray[np.intp]) -> str:
    """Tell of copies on the way."""
    echo, steps = find_echoes(rows, own), np.diff(rows.time_ns[own])
    if not echo.any():
        return ""
    late_ms = np.median(steps[echo[1:]]) / MILLISECOND
    return (
        f"{int(echo.sum()):,} of them are copies that came {late_ms:.0f} ms after an equal one, the others "
        f"at {SECOND / _usual(steps):.1f} Hz, so the network or a relay doubles them"
    )


def _usual(steps: NDArray[np.int64]) -> float:
    """Return the time from one message to the next, of most of them."""
    return float(np.quantile(steps, 0.75))


def _hz(times: NDArray[np.int64]) -> str:
    return f"{(len(times) - 1) * SECOND / max(1, int(times[-1] - times[0])):.1f} Hz"

"""Compares the answers in a replay with an earlier run of the same input: the first different message.

1. Commands are not compared, because they are the input. Both runs begin with the first command.
2. A value differs if the earlier run had no value near it within ``_WINDOW_NS`` before or after: losses and
   times vary from run to run.
3. A value is near if it is within the ``--tolerance`` of the field, else within a share of the field's range.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from edoras_tools.addons.runs.differences import range_text
from edoras_tools.addons.runs.run import Run, TopicValues
from edoras_tools.pipelines.workbench import Workbench, open_files
from edoras_tools.units import SECOND

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping
    from pathlib import Path

    from numpy.typing import NDArray

_WINDOW_NS: Final = SECOND
_PERCENT: Final = 10.0
_PERIODS: Final = 1.5
"""Least window, as a multiple of the usual time between two messages."""


def unlike(good: Path, sent: Path, bench: Workbench, rooms: Mapping[str, float]) -> list[str]:
    """Return the first difference of each field from a good run, one line for each.

    Args:
        good: a capture of the good run.
        sent: recording of the other run.
        bench: workbench for both.
        rooms: name of a field to its tolerance; with the empty name, the tolerance of all other fields in
            percent of their range.

    Raises:
        EdorasError: one of them cannot be read to its end.
    """
    runs = [Run.read(open_files([path]), bench.fresh()) for path in (good, sent)]
    for failure in (run.findings.failure for run in runs):
        if failure is not None:
            raise failure
    return list(unlike_lines(runs[0], runs[1], rooms))


def unlike_lines(good: Run, sent: Run, rooms: Mapping[str, float]) -> Iterator[str]:
    """Yield the lines of ``unlike`` for runs that are already read."""
    begins = [_begin_ns(run) for run in (good, sent)]
    for topic, ours in good.values.items():
        if ours.to_cfs:
            continue
        if topic not in sent.values:
            yield f"{topic} did not come"
            continue
        yield from _fields(topic, (ours, sent.values[topic]), begins, rooms)


def _begin_ns(run: Run) -> int:
    """Return the time of the first command, ns since 1970; without commands, the begin of the run."""
    times = [int(item.times_ns[0]) for item in run.values.values() if item.to_cfs and len(item.times_ns)]
    return min(times, default=run.ledger.start_ns)


def _fields(
    topic: str, sides: tuple[TopicValues, TopicValues], begins: list[int], rooms: Mapping[str, float]
) -> Iterator[str]:
    ours, theirs = sides
    times = [item.times_ns - begin_ns for item, begin_ns in zip(sides, begins, strict=True)]
    step_ns = float(np.median(np.diff(times[0]))) if len(times[0]) > 1 else 0.0
    window_ns = max(_WINDOW_NS, int(_PERIODS * step_ns))
    first = np.searchsorted(times[0], times[1] - window_ns)
    end = np.searchsorted(times[0], times[1] + window_ns, "right")
    for name, field in ours.fields.items():
        if name not in theirs.fields or not field.count:
            continue
        room = rooms.get(name, rooms.get("", _PERCENT) / 100 * (field.high - field.low))
        low, high = _extremes(field.first_values, first, end)
        values = theirs.fields[name].first_values
        outside = (values < low - room) | (values > high + room) | (np.isnan(values) & ~np.isnan(low))
        if outside.any():
            place = int(outside.argmax())
            number, time_ns = theirs.place(place)
            yield (
                f"{topic} {name} is {values[place]:.6g} in message {number:,}, "
                f"{(time_ns - begins[1]) / SECOND:.3f} s after the first command; "
                f"it was {range_text(low[place], high[place])} then"
            )


def _extremes(
    values: NDArray[np.float64], first: NDArray[np.intp], end: NDArray[np.intp]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the smallest and the largest value of each ``values[first:end]``; NaN for an empty one."""
    low = np.full(len(first), np.nan)
    high = low.copy()
    some = np.flatnonzero(end > first)
    if len(some):
        bounds = np.stack((first[some], end[some]), axis=1).ravel()
        padded = np.append(values, values[-1])
        low[some] = np.minimum.reduceat(padded, bounds)[::2]
        high[some] = np.maximum.reduceat(padded, bounds)[::2]
    return low, high

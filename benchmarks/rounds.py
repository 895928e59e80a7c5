"""Several ways to do the same, in alternation: the least and the median of each figure."""

from __future__ import annotations

import os
import shutil
import signal
import statistics
import subprocess
import time
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

ROUNDS = 10
LEAST_ROUNDS = 3
BUDGET_S = 30.0
"""No further round begins after this time, once there were ``LEAST_ROUNDS``."""


def alternated(ways: Mapping[str, Callable[[], Mapping[str, float]]]) -> dict[str, object]:
    """Run each way once a round; return its figures as ``[least, median]``, and the number of rounds."""
    found: dict[str, dict[str, list[float]]] = {name: {} for name in ways}
    began, rounds = time.perf_counter(), 0
    while rounds < LEAST_ROUNDS or (rounds < ROUNDS and time.perf_counter() - began < BUDGET_S):
        for name, run in ways.items():
            for figure, value in run().items():
                found[name].setdefault(figure, []).append(value)
        rounds += 1
    return {"rounds": rounds, **{name: summed_up(figures) for name, figures in found.items()}}


def absent(*names: str) -> dict[str, str]:
    """Say which of some peers are not installed."""
    return {name: "not installed" for name in names if not shutil.which(name)}


def summed_up(figures: Mapping[str, list[float]]) -> dict[str, list[float]]:
    """Return the least and the median of some figures."""
    return {
        name: [float(f"{value:.4g}") for value in (min(values), statistics.median(values))]
        for name, values in figures.items()
    }


def command(arguments: list[object]) -> dict[str, float]:
    """Run a command; return its wall and CPU time in s, those of the processes that it started included."""
    began = time.perf_counter()
    process = subprocess.Popen(
        list(map(str, arguments)), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    _, status, used = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode not in {0, 3}:  # 3: it found that data was lost
        raise SystemExit(f"{' '.join(map(str, arguments))} ended with {process.returncode}")
    return {"wall_s": time.perf_counter() - began, "cpu_s": used.ru_utime + used.ru_stime}


def busy_ns(process: int) -> int:
    """Return for how many ns a process, and those that it started, had a processor so far."""
    total = 0
    for task in Path(f"/proc/{process}/task").iterdir():
        total += int((task / "schedstat").read_text().split()[0])
        total += sum(busy_ns(int(child)) for child in (task / "children").read_text().split())
    return total


@contextmanager
def running(arguments: list[object]) -> Iterator[subprocess.Popen[str]]:
    """Start a program that captures, and end it."""
    process = subprocess.Popen(
        list(map(str, arguments)), stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
    )
    try:
        yield process
    finally:
        process.send_signal(signal.SIGINT)
        process.communicate()

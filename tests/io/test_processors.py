"""How many processors are free, by what the kernel counts."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from waiting import until

from edoras_tools.io import processors
from edoras_tools.io.processors import spare_processors


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux tells")
@pytest.mark.parametrize(
    ("cores", "told", "spare"),
    [
        (2, "0.10 0.50 0.90 1/345 7890\n", 1),
        (2, "0.10 0.50 0.90 2/345 7890\n", 0),
        (2, "0.10 0.50 0.90 9/345 7890\n", -7),
        (8, "0.10 0.50 0.90 3/345 7890\n", 5),
        (8, "0.10 0.50 0.90 0/345 7890\n", 7),  # this process runs, whatever is said
        (4, "", 3),
        (4, "0.10 0.50 0.90\n", 3),
        (4, "0.10 0.50 0.90 many/345 7890\n", 3),
        (4, None, 3),
    ],
)
def test_those_that_run_are_counted(cores, told, spare, tmp_path, monkeypatch):
    monkeypatch.setattr(os, "cpu_count", lambda: cores)
    monkeypatch.setattr(processors, "_LOAD", tmp_path / "loadavg")
    if told is not None:
        (tmp_path / "loadavg").write_text(told)
    assert spare_processors() == spare


@pytest.mark.skipif(not Path("/proc/loadavg").exists(), reason="only Linux tells")
def test_one_that_computes_takes_a_processor():
    """Eight times as many as there are processors: others that run beside this test change less."""
    busy = [
        subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(8 * (os.cpu_count() or 1))
    ]
    try:
        until(lambda: spare_processors() <= -4 * (os.cpu_count() or 1))
    finally:
        for item in busy:
            item.kill()
            item.wait()

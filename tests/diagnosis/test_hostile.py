"""Captures that are hard on whoever reads them: N and 4N at most six times the CPU, garbled times no fault.

The captures are those of ``benchmarks/hostile.py``, which are measured at their full size by ``make bench``.
"""

import resource
import subprocess
import sys

import pytest
from effort import long_but
from places import ROOT

sys.path.insert(0, str(ROOT / "benchmarks"))

import hostile

MISSION = ["-c", str(ROOT / "samples/missions/rover_ground.yaml")]
EDORAS = [sys.executable, "-c", "from edoras_tools.cli.programs import main; main()"]
LEAST_S = 1.0
"""What a start costs differs by so much on a busy machine."""
SIZES = {"sources": 5000, "sbn_sources": 800, "telemetry_sources": 2000, "pairs": 5000, "msg_ids": 1000}
QUICK = {("doctor", "sbn_sources")}


def used_s(command, path):
    """Return the CPU time of a command on a capture; of a run of 0 or 3, so that it did its work."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run([*EDORAS, *command.split(), path, *MISSION], capture_output=True, check=False)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    assert done.returncode in {0, 3}, done.stderr
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


@pytest.mark.long
@pytest.mark.parametrize(
    ("command", "kind"),
    long_but(
        QUICK,
        [(command, kind) for command in ("doctor", "info", "sniff --json") for kind in SIZES],
    ),
)
def test_four_times_as_much_takes_at_most_six_times_as_long(tmp_path, command, kind):
    used = []
    for number in (SIZES[kind], 4 * SIZES[kind]):
        path = tmp_path / f"{number}.pcap"
        hostile.write(path, hostile.KINDS[kind](number))
        used.append(used_s(command, path))
    assert used[1] <= 6 * max(used[0], LEAST_S)


@pytest.mark.quick("doctor-4-0.003")
@pytest.mark.parametrize(
    ("seed", "share"),
    long_but(
        {(2, 0.3), (4, 0.003)}, [(seed, share) for seed in range(12) for share in (0.003, 0.02, 0.3, 0.9)]
    ),
)
@pytest.mark.parametrize(
    "command", long_but({"doctor"}, ["doctor", "info", "plot", "doctor --list-lost csv"])
)
def test_garbled_times_end_without_a_fault(tmp_path, seed, share, command):
    path = tmp_path / "times.pcap"
    hostile.write(path, hostile.times(seed, share))
    done = subprocess.run(
        [*EDORAS, *command.split(), path, *MISSION],
        capture_output=True,
        check=False,
        text=True,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_AS, (2 << 30, 2 << 30)),
    )
    assert done.returncode in {0, 3}, done.stderr
    assert "Traceback" not in done.stderr

"""The doctor from a source to a diagnosis: at the end, and again and again on the way."""

import pytest

from edoras_tools import doctor
from edoras_tools.errors import CaptureError, ConfigError
from edoras_tools.model import SourceInfo, SourceStatistics
from edoras_tools.pipelines.doctor import examine, profile_with
from edoras_tools.pipelines.workbench import Settings
from edoras_tools.sessions.profile import SECOND
from edoras_tools.sim import Simulation
from edoras_tools.sim.source import SimulatedSource


def simulated(seconds=20, hz=10.0):
    return SimulatedSource(Simulation(command_rate_hz=hz, start_ns=1_800_000_000 * SECOND), seconds * SECOND)


class Onlooker:
    def __init__(self):
        self.seen = []

    def update(self, diagnosis):
        self.seen.append(diagnosis)


def test_a_live_diagnosis_is_made_again_and_grows():
    now = iter(range(0, 10_000 * SECOND, SECOND // 2))
    onlooker = Onlooker()
    findings = examine(
        simulated(), Settings().workbench(), clock=lambda: next(now), every_ns=SECOND, onlooker=onlooker
    )
    counts = [item.datagrams for item in onlooker.seen]
    assert len(counts) > 3
    assert counts == sorted(counts)
    assert findings.diagnosis.datagrams >= counts[-1]
    assert {item.rule for item in findings.diagnosis.verdicts} >= {"app_pipe_limit"}


def test_it_stops_when_told_to():
    now = iter(range(0, 10_000 * SECOND, SECOND))
    findings = examine(simulated(60), Settings().workbench(), clock=lambda: next(now), duration_ns=5 * SECOND)
    assert 0 < findings.diagnosis.datagrams < 200


class Broken:
    """A source that fails after its first batches."""

    def __init__(self):
        self.info = SourceInfo("broken", "pcap")
        self.statistics = SourceStatistics(kernel_drops=3, warnings=["odd"])
        self.closed = False

    def batches(self):
        yield from simulated(15).batches()
        raise CaptureError("cut off")

    def close(self):
        self.closed = True


def test_what_was_read_before_a_failure_is_judged():
    source = Broken()
    findings = examine(source, Settings().workbench())
    assert source.closed
    assert isinstance(findings.failure, CaptureError)
    assert findings.diagnosis.verdicts[0].rule in {"capture_drops", "app_pipe_limit"}
    summary = findings.summary()
    assert (summary["capture_drops"], summary["warnings"], summary["source"]) == (3, ["odd"], "broken")
    # Frames that the capture lost are no messages that cFS lost.
    assert summary["lost"] == sum(
        item["lost"] or 0 for item in summary["verdicts"] if item["rule"] != "capture_drops"
    )


def test_the_library_reads_a_file_or_a_source(tmp_path):
    diagnosis = doctor.examine(simulated())
    assert diagnosis.lost > 0
    with pytest.raises(CaptureError):
        doctor.examine(tmp_path / "none.pcap")


def test_importing_the_package_does_not_bring_the_doctor():
    import subprocess
    import sys

    code = "import sys, edoras_tools; print('numpy' in sys.modules, 'edoras_tools.doctor' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["False", "False"]


def test_constants_are_named():
    assert profile_with(["app_msg_limit=0x10", "ci_wake_ns=250000000"]).app_msg_limit == 16
    for text, words in (
        ("app_limit=3", "did you mean app_msg_limit"),
        ("app_msg_limit=many", "no whole number"),
        ("seed", "no whole number"),
        ("cores=0", "1 or more"),
    ):
        with pytest.raises(ConfigError, match=words):
            profile_with([text])

"""The doctor from a source to a diagnosis: at the end, and again and again on the way."""

import os
import signal
from functools import cache
from types import SimpleNamespace

import many
import pytest
from effort import every
from places import ROOT
from rewriting import Udp, write
from transfer_frames import Maker, space_packet

from edoras_tools import doctor
from edoras_tools.addons.frames.link import FRAMES
from edoras_tools.addons.lab.emulator import Simulation
from edoras_tools.addons.lab.emulator.simulation import SimulatedSource
from edoras_tools.diagnosis import examination
from edoras_tools.diagnosis.rules import shipped_rules
from edoras_tools.errors import CaptureError
from edoras_tools.io import SourceDefaults
from edoras_tools.links.bare import TO
from edoras_tools.model import SourceInfo, SourceStatistics
from edoras_tools.pipelines.doctor import Pace, Scope, examine
from edoras_tools.pipelines.selection import Period, Selection
from edoras_tools.pipelines.workbench import Settings, open_files
from edoras_tools.units import SECOND


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
        simulated(), Settings().workbench(), pace=Pace(lambda: next(now), SECOND, watcher=onlooker)
    )
    counts = [item.datagrams for item in onlooker.seen]
    assert len(counts) > 3
    assert counts == sorted(counts)
    assert findings.diagnosis.datagrams >= counts[-1]
    assert {item.rule for item in findings.diagnosis.verdicts} >= {"app_pipe_limit"}


def test_it_stops_when_told_to():
    now = iter(range(0, 10_000 * SECOND, SECOND))
    findings = examine(
        simulated(60), Settings().workbench(), pace=Pace(lambda: next(now), duration_ns=5 * SECOND)
    )
    assert 0 < findings.diagnosis.datagrams < 200


def test_progress_is_told_after_every_batch_and_while_judging():
    source, told, steps = simulated(), [], []
    progress = SimpleNamespace(
        read=lambda of: told.append(of.statistics.datagrams), step=lambda *step: steps.append(step)
    )
    examine(source, Settings().workbench(), progress=progress)
    assert len(told) > 3
    assert told == sorted(told)
    assert told[-1] == source.statistics.datagrams
    assert steps == sorted(steps)
    assert steps[-1] == ("judging", len(shipped_rules()), len(shipped_rules()))


class Broken(SourceDefaults):
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


def test_peers_alone_are_judged(tmp_path):
    """Two of one boot, and no Telemetry Output that sends."""
    many.peers(tmp_path / "peers.pcap", 5)
    source = open_files([tmp_path / "peers.pcap"])
    assert examine(source, Settings().workbench()).diagnosis.verdicts


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


@cache
def found(scope):
    return examine(simulated(), Settings().workbench(), scope=scope).diagnosis


def test_a_span_of_time_is_cut_out_and_the_rest_counted():
    whole = found(Scope())
    parts = [found(Scope(period=Period(a, b))) for a, b in ((0, 8 * SECOND), (8 * SECOND, 0))]
    assert sum(part.datagrams for part in parts) == whole.datagrams
    assert [part.left_out - whole.left_out for part in parts] >= [part.datagrams for part in parts[::-1]]
    assert {part.zero_ns for part in parts} == {whole.zero_ns}
    assert parts[0].end_ns < whole.zero_ns + 8 * SECOND <= parts[1].start_ns
    assert parts[1].as_json()["not_examined"] == parts[1].left_out
    with pytest.raises(CaptureError, match="its times go from 0 to "):
        found(Scope(period=Period(900 * SECOND)))


@pytest.mark.each(2)
@pytest.mark.quick("selection0*")
@pytest.mark.parametrize(
    ("selection", "links", "lost"),
    [
        (Selection(msg_ids=(0x1827,)), {"ci"}, True),
        (Selection(links=(TO,)), {"to"}, False),
        (Selection(where="msg_id == 0x1827 and length > 40"), {"ci"}, True),
        (Selection(where="msg_id == 0x1827 and length > 9999"), set(), False),
    ],
)
def test_a_choice_limits_what_is_shown_not_what_is_counted(selection, links, lost):
    whole, part = found(Scope()), found(Scope(selection))
    assert {row["link"] for row in part.routes} == links
    assert {row.link for row in part.balance} == links
    assert part.lost == (whole.lost if lost else 0)
    assert part.bad == lost
    assert part.datagrams == whole.datagrams
    told = part.as_json()
    assert told["choice"] == str(selection)
    assert told["not_shown"]["lost"] == whole.lost - part.lost
    assert told["not_shown"]["verdicts"] == len(whole.verdicts) - len(part.verdicts) > 0
    assert (whole.as_json()["choice"], whole.as_json()["not_shown"]) == (None, None)


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


CAPTURES = sorted((ROOT / "samples/captures").glob("*.pcap"))
ERRORS = ROOT / "tests/captures/season3/q25_robot_off_then_bridge_off.pcap.zst"
"""A capture with ICMP errors about closed ports."""


def chapters(monkeypatch, path, jobs, *, listing=False, configs=()):
    """What is found in chapters of some hundred datagrams."""
    monkeypatch.setattr("edoras_tools.io.processes._LARGE", 1)
    monkeypatch.setattr(examination, "CHAPTER", 150)
    source = open_files([path])
    parts = _Parts(source, 100)
    bench = Settings(configs).workbench(source.info)
    judge = examination.Examination(bench.columns.context)
    judge.listing = listing
    return examine(parts, bench, pace=Pace(lambda: 0, jobs=jobs), examination=judge)


class _Parts(SourceDefaults):
    """A source in smaller batches."""

    def __init__(self, source, rows):
        self._source, self._rows = source, rows
        self.info, self.statistics, self.close = source.info, source.statistics, source.close

    def batches(self):
        for batch in self._source.batches():
            for first in range(0, len(batch), self._rows):
                yield batch.take(slice(first, first + self._rows))


@pytest.mark.quick("b_arm_single")
@pytest.mark.filterwarnings("ignore:.*multi-threaded, use of fork:DeprecationWarning")
@pytest.mark.parametrize("path", [*CAPTURES, ERRORS], ids=lambda path: path.stem)
def test_chapters_are_judged_alike_by_any_number_of_processes(monkeypatch, path):
    one, *others = (chapters(monkeypatch, path, jobs, listing=True) for jobs in every(2, (1, 2, 3)))
    assert others
    for other in others:
        assert other.summary() == one.summary()
        assert other.diagnosis.missing == one.diagnosis.missing
        assert other.diagnosis.balance == one.diagnosis.balance
    assert one.diagnosis.datagrams > 300


@pytest.mark.filterwarnings("ignore:.*multi-threaded, use of fork:DeprecationWarning")
def test_a_process_that_is_killed_while_it_judges_is_told(monkeypatch):
    here, judge = os.getpid(), examination.judge

    def killed(*given):
        if os.getpid() != here:
            os.kill(os.getpid(), signal.SIGKILL)
        return judge(*given)

    monkeypatch.setattr(examination, "judge", killed)
    with pytest.raises(CaptureError, match=r"a_rover\.pcap: a process that examined .* was killed, perhaps"):
        chapters(monkeypatch, ROOT / "samples/captures/a_rover.pcap", 2)


@pytest.mark.long
@pytest.mark.filterwarnings("ignore:.*multi-threaded, use of fork:DeprecationWarning")
def test_what_is_followed_over_chapters_comes_to_the_one_that_judges(monkeypatch, tmp_path):
    maker, packets = Maker("tm", 60), [space_packet(1, bytes([number % 256]) * 80) for number in range(400)]
    frames = [frame for frame, _ in maker.carry(packets)]
    ends = ("10.0.0.2", 5000), ("10.0.0.1", 5001)
    path = write(tmp_path / "f.pcap", [Udp(at, *ends, item) for at, item in enumerate(frames) if at != 2])
    config = tmp_path / "f.yaml"
    told = f"{{port: 5001, kind: tm, length: {maker.length}}}"
    config.write_text(f"link: {{ros__parameters: {{frames: {{down: {told}}}}}}}")
    one, two = (chapters(monkeypatch, path, jobs, configs=[config]) for jobs in (1, 2))
    assert one.summary() == two.summary()
    assert "frames_lost" in [item.rule for item in two.diagnosis.verdicts]
    assert two.diagnosis.capture.unwrappers[FRAMES].channels


@pytest.mark.long
@pytest.mark.parametrize("what", ["os.fork", "mmap.mmap"])
def test_where_there_is_no_other_process_this_one_judges(monkeypatch, what):
    path = ROOT / "samples/captures/a_rover.pcap"
    alone = chapters(monkeypatch, path, 1)

    def none(*_):
        raise BlockingIOError("Resource temporarily unavailable")

    monkeypatch.setattr(what, none)
    assert chapters(monkeypatch, path, 2).summary() == alone.summary()


@pytest.mark.filterwarnings("ignore:.*multi-threaded, use of fork:DeprecationWarning")
def test_what_one_that_judges_raises_is_raised_here(monkeypatch):
    def fails(*_):
        raise CaptureError("no.pcap: bad")

    monkeypatch.setattr(examination, "judge", fails)
    with pytest.raises(CaptureError, match=r"^no\.pcap: bad$"):
        chapters(monkeypatch, ROOT / "samples/captures/a_rover.pcap", 2)

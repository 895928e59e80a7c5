"""Drafts: they pass on their own recording and on another good run, and fail on one with a fault."""

from itertools import cycle, product

import pytest
from effort import long_but
from places import CAPTURES, MISSIONS, ROOT

from edoras_tools.addons.lab.emulator import Simulation
from edoras_tools.addons.lab.emulator.simulation import SimulatedSource
from edoras_tools.addons.runs.check import check, junit
from edoras_tools.addons.runs.draft import Draft
from edoras_tools.addons.runs.expectations import load_expectations
from edoras_tools.addons.runs.run import Run
from edoras_tools.cfs.profile import SimProfile
from edoras_tools.io import SourceDefaults
from edoras_tools.pipelines.workbench import Settings, open_files
from edoras_tools.units import SECOND

RECORDINGS = sorted(path.name for path in (ROOT / "tests/captures").glob("*.pcap.zst"))
SETTINGS = Settings([MISSIONS / "rover_ground.yaml"])


def draft(source, bench):
    """Draft from one run."""
    return Draft([Run.read(source, bench)])


def held(source, text, folder, settings=SETTINGS):
    """Check a source against a draft."""
    path = folder / "expect.yaml"
    path.write_text(text)
    return check(source, settings.workbench(source.info), load_expectations(path))


@pytest.mark.each(5)
@pytest.mark.quick("a_rover*", "f_sbn*", "n10*", "n5*", "p6b*")
@pytest.mark.parametrize(
    ("name", "configured"),
    long_but(list(zip(RECORDINGS, cycle((True, False)))), list(product(RECORDINGS, (True, False)))),
)
def test_a_draft_passes_on_its_own_recording(name, configured, tmp_path):
    settings = SETTINGS if configured else Settings()
    path = ROOT / "tests/captures" / name
    source = open_files([path])
    made = draft(source, settings.workbench(source.info))
    report = held(open_files([path]), made.text, tmp_path, settings)
    assert report.results
    unmet = [(item.about, item.name) for item in report.results if not item.passed]
    unnamed = made.runs[0].diagnosis.unnamed
    assert {about for about, _ in unmet} == ({"verdicts"} if unnamed else set())
    assert all(name.startswith("not_examined") for _, name in unmet)


def test_what_was_lost_becomes_a_bound_and_is_told():
    source = open_files([CAPTURES / "a_rover.pcap"])
    made = draft(source, SETTINGS.workbench(source.info))
    assert "    lost: at most 18.6%  # 92 of 600 in 1 run" in made.text.splitlines()
    assert "/cmd_vel: lost 92 of 600 in 1 run; the draft accepts up to 18.6%" in made.notes
    assert "verdicts: [app_pipe_limit]" in made.text


def test_a_topic_without_messages_is_told():
    source = open_files([CAPTURES / "a_rover.pcap"])
    made = draft(source, Settings([MISSIONS / "two_rovers_ground.yaml"]).workbench(source.info))
    assert any("no message was examined in this run" in note for note in made.notes)


def run(seconds=16, hertz=5.0, start_s=1_800_000_000, **profile):
    simulation = Simulation(SimProfile(**profile), command_rate_hz=hertz, start_ns=start_s * SECOND)
    return SimulatedSource(simulation, seconds * SECOND)


class Muted(SourceDefaults):
    """A run in which telemetry of one MsgId stops halfway."""

    def __init__(self, source):
        self.inner, self.info, self.statistics = source, source.info, source.statistics

    def close(self):
        self.inner.close()

    def batches(self):
        decoder = SETTINGS.workbench().columns
        for at, batch in enumerate(self.inner.batches()):
            columns = decoder.decode(batch)
            yield batch.take((columns.msg_id != 0x827).nonzero()[0]) if at > 8 else batch


@pytest.fixture(scope="module")
def good():
    return draft(run(), SETTINGS.workbench())


@pytest.mark.long
def test_another_good_run_passes(good, tmp_path):
    assert good.notes == []
    report = held(run(seconds=55, start_s=1_800_100_000, seed=7), good.text, tmp_path)
    assert [(item.about, item.name, item.found) for item in report.results if not item.passed] == []


@pytest.mark.quick("<lambda>-failed2")
@pytest.mark.parametrize(
    ("source", "failed"),
    [
        (
            lambda: run(hertz=12.0),
            {("/cmd_vel", "rate"), ("/cmd_vel", "lost"), ("verdicts", "app_pipe_limit")},
        ),
        (lambda: Muted(run()), {("/telemetry_pose", "silence")}),
        (lambda: run(hertz=0.0), {("/cmd_vel", "count")}),
    ],
)
def test_a_fault_fails_by_its_name_in_junit(source, failed, good, tmp_path):
    junitparser = pytest.importorskip("junitparser")
    report = held(source(), good.text, tmp_path)
    (suite,) = junitparser.JUnitXml.fromstring(junit(report.results, ("check", report.file, report.source)))
    assert (suite.tests, suite.failures) == (len(report.results), report.failed)
    told = {(case.classname, case.name.partition(":")[0]) for case in suite if not case.is_passed}
    assert failed <= told
    assert len(told) == report.failed

"""Plans: what they say, and every mistake in one go."""

from __future__ import annotations

import filecmp
import json
import shutil
import sys

import pytest
from places import CAPTURES, ROOT
from schema import check, published

from edoras_tools.addons.lab.experiment import CellBench, Experiment, ExperimentPlan, load_plan
from edoras_tools.errors import ConfigError, InterruptError
from edoras_tools.pipelines.workbench import open_files
from edoras_tools.units import SECOND


@pytest.fixture
def plan(tmp_path):
    def load(text):
        path = tmp_path / "plan.yaml"
        path.write_text(text)
        return load_plan(path)

    return load


def test_cells_are_every_scenario_with_every_setting(plan):
    read = plan(
        "scenario: [rover, arm]\nsettings: {rate: [5, 7.5], app_msg_limit: 8}\nruns: 3..9\nduration: 4s\n"
    )
    assert [cell.name for cell in read.cells()] == [
        f"{name},rate={rate},app_msg_limit=8" for name in ("rover", "arm") for rate in ("5", "7.5")
    ]
    assert (read.least, read.most, read.duration_ns, read.width) == (3, 9, 4 * SECOND, 0)


def test_paths_are_relative_to_the_plan(plan, tmp_path):
    (tmp_path / "drive.pcap").write_bytes(b"")
    read = plan("target: 10.0.0.5:1234\nreplay: drive.pcap\n")
    assert read.replay == read.as_json()["replay"] == tmp_path / "drive.pcap"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("{}", "scenario or target is needed"),
        ("scenario: rover\ntarget: a:1\n", "and not both"),
        ("scenario: boat\n", "'boat' is no scenario; there are rover"),
        ("target: a:1\n", "a real target needs a capture"),
        ("scenario: rover\nruns: 1\n", "one run shows no spread"),
        ("scenario: rover\nruns: 9..3\n", "is no number of runs"),
        ("scenario: rover\nreplay: none.pcap\n", "there is no such file"),
        ("scenario: rover\nsettings: {app_msg_limi: 4}\n", "did you mean app_msg_limit?"),
        ("scenario: rover\nsettings: {rate: fast}\n", "a rate is needed"),
        ("scenario: rover\nwidth: 200%\n", "a probability is needed"),
        ("scenario: rover\nseeds: 1\n", "did you mean seed?"),
        ("schema: 2\nscenario: rover\n", "this version reads schema 1"),
    ],
)
def test_a_mistake_names_its_place(text, words, plan):
    with pytest.raises(ConfigError, match=r"plan\.yaml") as caught:
        plan(text)
    assert words in str(caught.value)


def test_constants_are_not_set_in_a_real_cfs(plan, tmp_path):
    (tmp_path / "drive.pcap").write_bytes((ROOT / "samples/captures/a_rover.pcap").read_bytes()[:24])
    with pytest.raises(ConfigError, match="emulated cFS alone"):
        plan("target: a:1\nreplay: drive.pcap\nsettings: {app_msg_limit: 4}\n")


PLAN = ExperimentPlan(("rover",), settings={"rate": (5.0, 30.0)}, duration_ns=SECOND, least=2, most=2)


class BrokenError(Exception):
    """What ends an experiment early."""


def carried_out(folder, plan=PLAN, most=99):
    """Carry out a plan, but for runs beyond so many."""
    made = []

    def on_run(text):
        if len(made) == most:
            raise BrokenError
        made.append(text)

    return Experiment(plan, folder).run(on_run), made


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    folder = tmp_path_factory.mktemp("whole")
    return folder, carried_out(folder)[0]


def test_broken_off_and_resumed_it_is_the_same(whole, tmp_path):
    first = next(PLAN.cells()).name
    shutil.copytree(whole[0] / first, tmp_path / first)
    (tmp_path / first / "002.json").unlink()  # as if it had been broken off between recording and diagnosis
    with pytest.raises(BrokenError):
        carried_out(tmp_path, most=1)
    report, made = carried_out(tmp_path)
    assert len(made) == 2
    assert report["cells"] == whole[1]["cells"]
    for path in sorted(whole[0].glob("*/*")):
        assert filecmp.cmp(path, tmp_path / path.relative_to(whole[0]), shallow=False), path


def test_runs_are_those_that_the_emulator_accounts_for(whole):
    folder, report = whole
    check(report, published("experiment"))
    slow, fast = ({item["topic"]: item for item in cell["topics"]} for cell in report["cells"])
    assert slow["/cmd_vel"]["loss"]["mean"] == 0
    assert fast["/cmd_vel"]["loss"]["mean"] > 0
    for path in folder.glob("*/*.json"):
        run = json.loads(path.read_text())
        counted = sum(number for hop, _, _, number in run["account"] if hop == "EDORAS_APP_PIPE")
        assert run["topics"]["/cmd_vel"]["lost"] == counted
        source = open_files([path.with_suffix(".mcap")])
        assert source.info.kind == "mcap"
        source.close()


def test_another_plan_needs_another_folder(whole):
    with pytest.raises(ConfigError, match="runs of another plan"):
        Experiment(ExperimentPlan(("rover",), seed=2), whole[0])


def test_it_stops_when_narrow_enough(whole):
    folder, _ = whole
    plan = ExperimentPlan(("rover",), settings=PLAN.settings, duration_ns=SECOND, least=2, most=3, width=0.8)
    report, made = carried_out(folder, plan, most=1)
    assert [cell["known"] for cell in report["cells"]] == [True, True]
    assert made == []


def test_a_capture_is_replayed_into_the_emulator(tmp_path):
    plan = ExperimentPlan(
        ("rover",), replay=CAPTURES / "f_sbn_disconnect.pcap", settings={"rate": (100.0,)}, least=2, most=2
    )
    run = CellBench(plan, next(plan.cells())).run(tmp_path / "001.mcap", 0, 1)
    command = run["topics"]["/cmd_vel"]
    assert command["rate_hz"] == pytest.approx(100, rel=0.01)
    assert command["lost"] / command["sent"] > 0.2


def test_a_run_that_is_interrupted_is_not_kept(tmp_path, monkeypatch):
    def interrupted(*_args, **_options):
        raise InterruptError("interrupted")

    monkeypatch.setattr("edoras_tools.addons.lab.experiment.record", interrupted)
    with pytest.raises(InterruptError):
        carried_out(tmp_path)
    assert not list(tmp_path.glob("*/*.json"))


@pytest.mark.long
def test_intervals_hold_the_account(tmp_path):
    """A small version of ``benchmarks/experiment.py``: of 40 intervals at least 34 hold the account."""
    sys.path.insert(0, str(ROOT / "benchmarks"))
    import experiment

    held, cells = experiment.coverage(tmp_path, 40, 30)
    assert cells == 40
    assert held >= 34

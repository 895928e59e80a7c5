"""Plans: what they say, and every mistake in one go."""

from __future__ import annotations

import pytest
from places import ROOT

from edoras_tools.addons.lab.experiment.plan import load_plan
from edoras_tools.errors import ConfigError
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

"""``edoras compare``: its exit codes and what it prints."""

from __future__ import annotations

import json

import pytest
from places import CAPTURES, MISSIONS, ROOT
from schema import check, published
from typer.testing import CliRunner

from edoras_tools.cli.main import program

ROVER = CAPTURES / "a_rover.pcap"
MISSION = MISSIONS / "rover_ground.yaml"


@pytest.fixture(scope="module")
def compare():
    made = program("compare")

    def call(*words):
        return CliRunner().invoke(made, ["compare", *map(str, words)])

    return call


def test_a_run_beside_itself(compare):
    done = compare(ROVER, ROVER, "-c", MISSION)
    assert (done.exit_code, done.stdout.splitlines()[-1]) == (0, "The second run is no worse.")


def test_a_worse_run(compare):
    done = compare(CAPTURES / "b_arm_single.pcap", ROVER, "--json")
    assert done.exit_code == 3
    told = json.loads(done.stdout)
    assert (told["schema"], told["worse"], told["bad"]["lost"]) == (1, True, 92)
    assert [item["worse"] for item in told["changes"]] == sorted(
        (item["worse"] for item in told["changes"]), reverse=True
    )
    assert {"verdict", "lost"} <= {item["what"] for item in told["changes"] if item["worse"]}


def test_a_file_that_is_not_there(compare, tmp_path):
    done = compare(ROVER, tmp_path / "none.pcap")
    assert done.exit_code != 0
    assert "there is no such file" in str(done.exception) + done.output


@pytest.mark.parametrize("name", ["a_rover", "d3_cpu1_cpu2", "f2_sbn_announce_reload", "n10_uplink_loss"])
def test_json_holds_to_its_schema(compare, name):
    path = ROOT / f"tests/captures/{name}.pcap.zst"
    for runs in ((ROVER, path), (path, ROVER)):
        done = compare(*runs, "-c", MISSION, "--json")
        told = json.loads(done.stdout)
        check(told, published("compare"))
        assert done.exit_code == 3 * told["worse"]

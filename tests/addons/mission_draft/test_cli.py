"""``edoras mission`` as a shell sees it."""

import pytest
from places import ROOT

ROVER = ROOT / "samples/captures/a_rover.pcap"


def test_a_draft_is_given_with_c(call, tmp_path):
    path = tmp_path / "missions/draft.yaml"
    done = call("mission", "draft", ROVER, "-o", path)
    assert (done.code, done.out) == (0, "")
    assert done.err == [f"edoras: {path}: 2 topics; several types fit 2 of them: check these"]
    rows = call("info", ROVER, "-c", path, "--json").json()["routes"]
    assert {row["topic"]: row["count"] for row in rows if row["topic"]} == {"/ci_1827": 600, "/to_0827": 63}
    assert call("mission", "draft", ROVER).out == path.read_text(encoding="utf-8")


def test_a_draft_is_not_overwritten(call, tmp_path):
    path = tmp_path / "draft.yaml"
    path.write_text("edited")
    done = call("mission", "draft", ROVER, "-o", path)
    assert done.code == 2
    assert path.read_text() == "edited"
    assert call("mission", "draft", ROVER, "-o", path, "--force", "-q").err == []
    assert path.read_text() != "edited"


@pytest.mark.parametrize(
    ("arguments", "code", "said"),
    [
        ([], 2, "name the input to read"),
        (["nowhere.pcap"], 1, "nowhere.pcap: "),
        ([ROVER, "-c", ROOT / "samples/missions/rover_ground.yaml"], 1, "are in the mission already"),
    ],
)
def test_bad_input(arguments, code, said, call):
    done = call("mission", "draft", *arguments)
    assert done.code == code
    assert said in done.err[-1]


def test_a_system_is_learned_and_given_with_c(call, tmp_path):
    path = tmp_path / "system.yaml"
    done = call("mission", "learn", ROVER, "-o", path)
    assert (done.code, done.out) == (0, "")
    assert done.err == [
        f"edoras: {path}: 2 topics, 7 constants of cFS; several types fit 2 of them: check these"
    ]
    rows = call("doctor", ROVER, "-c", path, "--json").json()["verdicts"]
    assert any("every 500 ms: 8 a second get through (told)" in row["reason"] for row in rows)
    (up, _) = call("doctor", "--predict", "-c", path, "--set", "app_msg_limit=2", "--json").json()["routes"]
    assert (up["msg_id"], up["limit_hz"]) == ("0x1827", 4.0)
    swept = call("sweep", "ci_1827", "-c", path, "--sim", "rover", "--rate", "4..12", "--dry-run", "--json")
    assert swept.code == 0


def test_learn_needs_files(call):
    done = call("mission", "learn", "-")
    assert done.code == 2
    assert "it needs files, not stdin" in done.err[-1]

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

"""Many recordings as one mapping of tables, each read by itself."""

import numpy as np
import pytest
from places import CAPTURES, MISSIONS

import edoras_tools
from edoras_tools.errors import CaptureError, RouteError
from edoras_tools.pipelines.capture.record import Target, record
from edoras_tools.pipelines.reading import Limits
from edoras_tools.pipelines.workbench import Settings, open_files

PAIRS = (("a_rover.pcap", "rover_ground", "one"), ("b_arm_single.pcap", "single_arm_ground", "two"))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A rover, an arm, and the rover again: each with its own mission."""
    folder = tmp_path_factory.mktemp("runs")
    for capture, mission, name in (*PAIRS, (*PAIRS[0][:2], "three")):
        source = open_files([CAPTURES / capture])
        bench = Settings([MISSIONS / f"{mission}.yaml"]).workbench(source.info)
        count = 100 if name == "three" else 200
        record(source, bench, Target(folder / f"{name}.mcap"), limits=Limits(count=count))
    (folder / "notes.txt").touch()
    return folder


@pytest.mark.quick("pattern")
@pytest.mark.parametrize("name", ["", "*.mcap"], ids=["folder", "pattern"])
def test_a_folder_or_a_pattern(folder, name):
    runs = edoras_tools.read(folder / name)
    assert repr(runs) == "<3 recordings: one, three, two; list() names their topics>"
    assert {"/cmd_vel", "/command_pose"} <= {*runs}, "of any of them"
    columns = runs["cmd_vel"].to_numpy()
    alone = {name: edoras_tools.read(folder / f"{name}.mcap")["/cmd_vel"] for name in ("one", "three")}
    assert [*columns["recording"]] == ["one"] * len(alone["one"]) + ["three"] * len(alone["three"])
    assert (columns["linear.x"][: len(alone["one"])] == alone["one"].to_numpy()["linear.x"]).all()
    assert runs.topics["/cmd_vel"] == len(runs["/cmd_vel"])
    if not name:
        assert {*np.unique(runs.lost.to_numpy()["recording"])} == {"one"}
    assert set(runs["/edoras/link_statistics"].to_numpy()["recording"]) == {"one", "two", "three"}


def test_several_that_are_named_are_read_as_one_and_say_whose_a_row_is(folder):
    paths = [folder / "one.mcap", folder / "three.mcap"]
    both = edoras_tools.read(paths)
    columns = both["/cmd_vel"].to_numpy()
    assert (np.diff(columns["time"].astype(np.int64)) >= 0).all()
    counts = {name: int((columns["recording"] == name).sum()) for name in ("one", "three")}
    assert counts == {path.stem: len(edoras_tools.read(path)["/cmd_vel"]) for path in paths}
    assert "recording" not in edoras_tools.read(paths[0])["/cmd_vel"].to_numpy()


def test_what_is_not_there(folder, tmp_path):
    runs = edoras_tools.read(f"{folder}/*.mcap")
    with pytest.raises(KeyError, match=r"no topic of .* matches '/no_such'"):
        runs["/no_such"]
    with pytest.raises(CaptureError, match="no capture or recording is there"):
        edoras_tools.read(tmp_path)
    with pytest.raises(CaptureError, match="there is no such file"):
        edoras_tools.read(tmp_path / "no.mcap")


def test_one_topic_of_two_types_is_refused(folder, tmp_path):
    for capture, _, name in PAIRS:
        text = (MISSIONS / "rover_ground.yaml").read_text()
        if name == "two":
            text = text.replace("geometry_msgs/msg/Twist", "geometry_msgs/msg/Pose")
        (tmp_path / "mission.yaml").write_text(text)
        source = open_files([CAPTURES / capture])
        bench = Settings([tmp_path / "mission.yaml"]).workbench(source.info)
        record(source, bench, Target(tmp_path / f"{name}.mcap"), limits=Limits(count=100))
    with pytest.raises(RouteError, match="is geometry_msgs/msg/Pose in two and geometry_msgs/msg/Twist in"):
        len(edoras_tools.read(tmp_path)["/cmd_vel"])

"""Recordings in a notebook."""

from collections.abc import Mapping

import numpy as np
import pytest
from places import CAPTURES, MISSIONS

import edoras_tools
from edoras_tools.errors import CaptureError, ConfigError, RouteError

ROVER, MISSION = CAPTURES / "a_rover.pcap", MISSIONS / "rover_ground.yaml"


@pytest.fixture(scope="module")
def rover():
    return edoras_tools.read(ROVER, config=MISSION)


def test_a_topic_as_arrays(rover):
    table = rover["cmd_vel"]
    assert (len(table), table.topic, table.type) == (600, "/cmd_vel", "geometry_msgs/msg/Twist")
    columns = table.to_numpy()
    assert columns["time"].dtype == "datetime64[ns]"
    assert columns["linear.x"].dtype == np.float64
    assert columns["linear.x"].max() == 0.599999374285702
    assert rover["/cmd_vel"] is table, "it is read once"


def test_a_table_says_what_it_is(rover):
    assert repr(rover["cmd_vel"]).startswith("<600 rows of /cmd_vel, geometry_msgs/msg/Twist: time, ")
    assert repr(rover.lost).startswith("<92 rows of /edoras/lost: time, "), "which has no ROS type"


def test_topics_have_counts(rover):
    assert rover.topics["/cmd_vel"] == 600
    assert rover.topics["/telemetry_pose"] == 63
    assert "/edoras/faults" not in rover.topics
    assert len(rover["/edoras/faults"]) == 0


def test_it_is_a_mapping(rover):
    assert isinstance(rover, Mapping)
    assert list(rover) == list(rover.topics)
    assert len(rover) == len(rover.topics)
    assert "/cmd_vel" in rover
    assert "cmd_vel" in rover
    assert "/edoras/faults" not in rover
    assert rover.get("/no_such") is None
    with pytest.raises(KeyError, match=r"^no topic of .*a_rover.pcap matches '/no_such'"):
        rover["/no_such"]


def test_events(rover):
    assert set(rover.events.to_numpy()["name"]) == {"TO_LAB_APP", "CFE_SB"}


def test_pandas(rover):
    pandas = pytest.importorskip("pandas")
    frame = rover["/telemetry_pose"].to_pandas()
    assert str(frame["time"].dtype) == "datetime64[ns, UTC]"
    assert frame["time"][0] == pandas.Timestamp(1795241639600092000, tz="UTC")
    assert frame["header.frame_id"].tolist() == ["world"] * 63
    datagrams = rover["/edoras/datagrams"].to_pandas()
    assert (
        datagrams["frame"].map(len).tolist()
        == rover["/edoras/datagrams"].to_pandas()["frame"].map(len).tolist()
    )


def test_arrow(rover):
    pytest.importorskip("pyarrow")
    table = rover["/cmd_vel"].to_arrow()
    assert table.num_rows == 600
    assert table.column("linear.x").to_pylist() == rover["/cmd_vel"].to_numpy()["linear.x"].tolist()


def test_what_is_wrong_is_told_early(tmp_path):
    with pytest.raises(CaptureError, match="there is no such file"):
        edoras_tools.read(tmp_path / "no.mcap")
    with pytest.raises(ConfigError, match="use utc, ns, seconds"):
        edoras_tools.read(ROVER, time="local")
    with pytest.raises(RouteError, match="did you mean /cmd_vel"):
        edoras_tools.read(ROVER, config=MISSION)["/cmdvel"]


def test_a_capture_that_is_cut_off_warns_and_gives_what_it_holds(tmp_path):
    (tmp_path / "cut.pcap").write_bytes(ROVER.read_bytes()[:-7])
    with pytest.warns(UserWarning, match="cut off"):
        assert len(edoras_tools.read(tmp_path / "cut.pcap", config=MISSION)["/cmd_vel"]) == 600


def test_nothing_else_of_the_package_has_the_name():
    with pytest.raises(AttributeError, match="no attribute 'reed'"):
        edoras_tools.reed  # noqa: B018

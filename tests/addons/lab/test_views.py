"""A demo as people see it."""

from __future__ import annotations

import io
from math import pi
from pathlib import Path

import pytest
from rich.console import Console

from edoras_tools.addons.lab import views
from edoras_tools.addons.lab.views import draw_tracks, joints


def plain(lines):
    return [line.plain for line in lines]


def test_a_track_goes_where_the_rover_went():
    lines = plain(draw_tracks([([(0.0, 0.0), (4.0, 0.0)], (4.0, 0.0, 0.0))], 20, 3))
    assert len(lines) == 3
    drawn = [line for line in lines if line.strip()]
    assert len(drawn) == 1
    assert drawn[0].endswith("→")
    assert set(drawn[0].strip()[:-1]) <= set(map(chr, range(0x2801, 0x2900)))
    assert len(drawn[0].strip()) > 15


@pytest.mark.parametrize(("eighth", "arrow"), list(enumerate("→↗↑↖←↙↓↘")))
def test_the_arrow_points_where_the_rover_does(eighth, arrow):
    (line,) = plain(draw_tracks([([(1.0, 1.0)], (1.0, 1.0, eighth * pi / 4))], 10, 1))
    assert line.strip() == arrow
    (line,) = plain(draw_tracks([([(1.0, 1.0)], (1.0, 1.0, eighth * pi / 4 - 2 * pi))], 10, 1))
    assert line.strip() == arrow


def test_what_is_farther_up_is_drawn_higher():
    lines = plain(draw_tracks([([(0.0, 0.0)], (0.0, 0.0, 0.0)), ([(0.0, 1.0)], (0.0, 1.0, pi))], 20, 4))
    assert [line.strip() for line in lines if line.strip()] == ["←", "→"]


@pytest.mark.parametrize("size", [(1, 1), (3, 2), (76, 9)])
@pytest.mark.parametrize("far", [0.0, 1e-3, 1.0, 1e6])
def test_it_stays_inside_its_frame(size, far):
    track = [(-far, far), (far, -far), (0.0, 3 * far)]
    lines = plain(draw_tracks([(track, (0.0, 3 * far, 1.0)), ([(far, far)], ())], *size))
    assert len(lines) == size[1]
    assert all(len(line) <= size[0] for line in lines)
    assert any("↗" in line for line in lines)


def test_a_rover_without_a_pose_leaves_room_for_the_other_one():
    lines = plain(draw_tracks([([], ()), ([(1.0, 2.0)], (1.0, 2.0, 0.0))], 20, 3))
    assert [line.strip() for line in lines if line.strip()] == ["→"]


def test_without_a_pose_it_waits():
    assert plain(draw_tracks([([], ()), ([], ())], 20, 4)) == ["waiting for the first pose ..."]
    assert plain(joints([("big_arm", [])])) == ["waiting for the first joint state ..."]


def test_joints_are_bars():
    lines = plain(joints([("big_arm", [pi / 2, 0.0, -9.0])]))
    assert [line.count("█") for line in lines] == [12, 0, 24]
    assert lines[0].startswith("joint 2   1.57 ")


def test_arms_stand_side_by_side():
    head, *lines = plain(joints([("big_arm", [1.0, 2.0]), ("little_arm", [3.0])]))
    assert head.index("little_arm") == lines[0].rindex("joint 2")
    assert [line.count("joint") for line in lines] == [2, 2]


NOWHERE = Path("none.mcap")


def leg(first, last, kind, **values):
    usual = {
        "from": first, "to": last, "type": kind, "said": 100, "into_cfs": 100, "arrived": 90, "of_others": 0,
        "latency_us": {"p50": 302_000.0, "p99": 501_000.0, "max": 502_000.0},
        "added_us": {"p50": 640.0, "p99": 4240.0, "max": 9000.0},
        "held": 0, "refused": 0, "lost": {}, "replaced": 0, "others_said": 0,
    }  # fmt: skip
    return usual | values


@pytest.fixture
def summary():
    twist, pose = "geometry_msgs/msg/Twist", "geometry_msgs/msg/PoseStamped"
    return {
        "demo": "two-rovers", "ros": "zenoh", "seconds": 12.0, "output": "two_rovers.mcap",
        "layout": "two_rovers_layout.json", "ports": {"ci": 1, "to": 2, "sbn": 3, "peer": 4},
        "foxglove": {"url": "ws://127.0.0.1:8765", "clients": []},
        "recorded": 1234, "unrecorded": 7, "lost": 7, "bridges": [], "notes": [],
        "robots": [
            {
                "robot": "robot_1", "place": [1.0, 2.0, 0.5], "start": [0.0, 0.0, 0.0], "way": 3.21,
                "commands": leg("/robot_1/ground/cmd_vel", "/robot_1/cmd_vel", twist, others_said=4,
                                lost={"EDORAS_APP_PIPE": 5}, replaced=40),
                "states": leg("/robot_1/pose", "/robot_1/ground/pose", pose, said=1000, held=880),
            }
        ],
    }  # fmt: skip


class Running:
    tracks = [[(0.0, 0.0), (1.0, 2.0)]]  # noqa: RUF012  a stand-in
    events = ["first", "EVS Port1 66/1/SBN 5: Peer 66:3 connected."]  # noqa: RUF012  likewise

    def __init__(self, summary):
        self._summary = summary

    def summary(self):
        return self._summary


def text(renderable, width):
    console = Console(width=width, file=io.StringIO(), color_system=None)
    console.print(renderable)
    return console.file.getvalue()


@pytest.mark.parametrize("width", [60, 80, 120, 200])
def test_the_outcome_says_all_within_its_width(summary, width):
    shown = text(views.outcome(summary, Running.tracks, width, NOWHERE), width)
    assert all(len(line) <= width for line in shown.splitlines())
    assert "Arrived" in shown
    sentences = " ".join(shown.split())
    assert "EDORAS_APP_PIPE takes no more of one MsgId at a time" in sentences, "wrapped, not cut"
    if width >= 120:
        for part in (
            "/robot_1/ground/cmd_vel → /robot_1/cmd_vel",
            "robot_1: 100 commands of the ground station, 4 of other nodes; 90 reached it; it drove 3.2 m",
            "robot_1: commands: 5 lost inside cFS: EDORAS_APP_PIPE takes no more of one MsgId at a time",
            "robot_1: commands: 40 replaced by newer ones",
            "robot_1: states: 880 of 1,000 held back by the bridge's rate limit",
            "7 datagrams bridged, but not recorded",
            "edoras doctor two_rovers.mcap",
            "302 ms",
            "0.64 ms",
        ):
            assert part in shown


def test_arms_are_shown_by_their_joints(summary):
    robot = summary["robots"][0]
    robot["commands"]["type"], robot["place"], robot["way"] = "geometry_msgs/msg/Pose", [1.0] * 7, 2.5
    shown = text(views.outcome(summary, Running.tracks, 120, NOWHERE), 120)
    assert "joint 8   1.00 ███" in shown
    assert "its joints turned 2.5 rad together" in shown


def test_what_is_on_its_way_is_told_unless_others_blur_the_count(summary):
    robot = summary["robots"][0]
    assert not any("on their way" in line for line in views.loss_lines(summary))
    robot["commands"] |= {"others_said": 0, "said": 138}
    told = [line for line in views.loss_lines(summary) if "on their way" in line]
    assert told[0].startswith("robot_1: commands: 3 on their way at the end")
    assert told[1].startswith("robot_1: states: 30 on their way")


def test_a_robot_that_nobody_heard_of_is_told(summary):
    summary["robots"][0]["place"] = []
    summary["robots"][0]["commands"]["latency_us"] = dict.fromkeys(("p50", "p99", "max"))
    shown = text(views.outcome(summary, [[]], 120, NOWHERE), 120)
    assert "no state of it arrived" in shown
    assert "waiting for the first pose" in shown


def test_the_command_to_look_at_it_names_the_ports(summary):
    assert views.beside(summary).endswith(
        "edoras sniff -i lo --set port=ci:1 --set port=to:2 --set port=sbn:3"
    )
    del summary["ports"]["sbn"]
    assert views.beside(summary).endswith("--set port=to:2")


def test_it_is_drawn_while_it_runs(summary):
    console = Console(width=140, height=40, file=io.StringIO(), force_terminal=True, color_system=None)
    with views.live_table(console, NOWHERE) as table:
        table.update(Running(summary))
        table.update(Running(summary))
    shown = console.file.getvalue()
    assert "demo two-rovers, ROS 2 through zenoh   12.0 s" in shown
    assert "Foxglove ws://127.0.0.1:8765" in shown
    assert "Peer 66:3 connected." in shown
    assert "in Hz" in shown

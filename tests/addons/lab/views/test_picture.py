"""Robots in terminal cells."""

from __future__ import annotations

from math import pi

import pytest

from edoras_tools.addons.lab.views.picture import draw_tracks, joints


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

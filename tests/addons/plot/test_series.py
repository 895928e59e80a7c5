"""Fields, rates, losses and events of the samples, beside ``edoras_tools.read`` and plain loops."""

from __future__ import annotations

import numpy as np
import pytest
from places import ROOT

import edoras_tools
from edoras_tools.addons.plot import series as lines
from edoras_tools.addons.plot.series import (
    MOST_MARKS,
    PlotRequest,
    Quantity,
    Values,
    numbers,
    open_recordings,
    parse_request,
    read_plot,
)
from edoras_tools.errors import CaptureError, ConfigError, RouteError
from edoras_tools.io.formats.columns import TableColumn
from edoras_tools.pipelines.doctor import Scope
from edoras_tools.pipelines.selection import Period, Selection
from edoras_tools.pipelines.workbench import Settings
from edoras_tools.ros.cdr.bulk import Ragged

ROVER = ROOT / "samples/captures/a_rover.pcap"
ERRORS = ROOT / "samples/captures/e_ci_errors.pcap"
MISSION = ROOT / "samples/missions/rover_ground.yaml"


def plotted(*asked, paths=(ROVER,), bare=False, topics=(), **period):
    scope = Scope(Selection(topics=topics), Period(**period))
    sources = open_recordings(paths, Settings((MISSION,)), scope)
    return read_plot(
        sources, [path.stem for path in paths], [parse_request(item) for item in asked], scope, bare=bare
    ).figure


@pytest.fixture(scope="module")
def tables():
    return edoras_tools.read(ROVER, config=MISSION, time="seconds")


def test_a_field_with_rates_losses_and_events_beneath(tables):
    figure = plotted("/cmd_vel.linear.x")
    field, beneath = figure.panels
    columns = tables["/cmd_vel"].to_numpy()
    line = field.lines[0]
    np.testing.assert_allclose(line.seconds, columns["time"])
    np.testing.assert_array_equal(line.values, columns["linear.x"])
    assert [item.label for item in beneath.lines] == ["/cmd_vel", "/cmd_vel lost"]
    lost = tables.lost.to_numpy()
    assert [item.read for item in beneath.lines] == [600, lost["count"][lost["topic"] == "/cmd_vel"].sum()]
    assert figure.events == len(tables.events) == len(figure.marks)
    levels = tables.events.to_numpy()["level"]
    assert sum(mark.severe for mark in figure.marks) == (levels >= 40).sum() > 0
    assert figure.footnotes(10_000) == ["rates: means over 1 s"]


XYZ = ["x", "y", "z"]


@pytest.mark.each(3)
@pytest.mark.parametrize(
    ("asked", "panels"),
    [
        (["/cmd_vel.linear.*"], {"/cmd_vel.linear.*": [f"linear.{name}" for name in XYZ]}),
        (
            ["/cmd_vel.linear.x,rate:/cmd_vel"],
            {"/cmd_vel.linear.x, rate:/cmd_vel": ["/cmd_vel.linear.x", "/cmd_vel"]},
        ),
        (
            ["/cmd_vel.sequence", "cmd_vel.angular"],
            {
                "/cmd_vel.sequence": ["/cmd_vel.sequence"],
                "cmd_vel.angular": [f"angular.{name}" for name in XYZ],
            },
        ),
        (
            ["/cfs/CFE_TIME_*.command_*"],
            {"/cfs/CFE_TIME_*.command_*": ["command_counter", "command_error_counter"]},
        ),
        (["rate:/cmd_vel"], {"/cmd_vel": ["/cmd_vel"]}),
        (["loss:/telemetry_pose"], {"/telemetry_pose lost": ["/telemetry_pose lost"]}),
    ],
)
def test_requests_and_their_panels(asked, panels):
    figure = plotted(*asked, bare=True)
    assert figure.marks is None
    assert {panel.title: [line.label for line in panel.lines] for panel in figure.panels} == panels


def test_without_a_request_the_rates_of_all_topics(tables):
    (panel,) = plotted(bare=True).panels
    counts = {topic: rows for topic, rows in tables.topics.items() if not topic.startswith("/edoras/")}
    assert {line.label: line.read for line in panel.lines} == counts


@pytest.mark.long
def test_two_recordings_start_at_their_own_zero(tables):
    figure = plotted("/cmd_vel.linear.x", paths=(ROVER, ERRORS))
    lines = figure.panels[0].lines
    assert [line.label for line in lines] == ["a_rover", "e_ci_errors"]
    assert [line.recording for line in lines] == [0, 1]
    assert {line.colour for line in lines} == {0}, "a field has one colour"
    assert all(0 <= line.seconds[0] < 10 for line in lines)
    np.testing.assert_array_equal(lines[0].values, tables["/cmd_vel"].to_numpy()["linear.x"])


def test_a_part_of_the_time_is_drawn_alone():
    figure = plotted("/cmd_vel.linear.x", start_ns=10 * 10**9, end_ns=20 * 10**9)
    assert figure.span == (10, 20)
    assert all(
        10 <= line.seconds[0] <= line.seconds[-1] < 20 for panel in figure.panels for line in panel.lines
    )
    assert figure.panels[1].lines[0].values == pytest.approx(np.full(100, 10))


@pytest.mark.parametrize(
    ("asked", "keywords", "error", "words"),
    [
        ("/cmd_vel.linaer.x", {}, ConfigError, "'linaer.x' is no field of /cmd_vel; did you mean linear.x"),
        ("/cmd_vle.linear.x", {}, RouteError, r"matches '/cmd_vle'; did you mean /cmd_vel\?"),
        ("/edoras/events.msg", {}, ConfigError, "msg of /edoras/events holds text, not numbers"),
        ("/cmd_vel.linear.x[2]", {}, ConfigError, r"linear.x is one number; leave out \[2\]"),
        ("/cmd_vel.linear.x", {"start_ns": 10**11}, CaptureError, "its times go from 0 to 65.270 s"),
        ("/cmd_vel.linear.x", {"topics": ("/telemetry_pose",)}, RouteError, "--topic leaves out /cmd_vel"),
        ("/cfs/CFE_ES_HousekeepingTlm", {}, ConfigError, "more than 24 lines"),
    ],
)
def test_mistakes_say_what_to_do(asked, keywords, error, words):
    with pytest.raises(error, match=words):
        plotted(asked, **keywords)


def test_of_many_events_the_most_severe_are_drawn(monkeypatch):
    monkeypatch.setattr("edoras_tools.addons.plot.series.MOST_MARKS", 5)
    figure = plotted("/cmd_vel.linear.x")
    assert MOST_MARKS > 5 >= len(figure.marks) > 0
    assert figure.event_title == f"{figure.events} events, {len(figure.marks)} drawn"
    assert any(mark.severe for mark in figure.marks)


def test_losses_of_a_large_capture_are_looked_for_when_asked_for(monkeypatch):
    monkeypatch.setattr("edoras_tools.addons.plot.series.LARGE", 1000)
    figure = plotted("/cmd_vel.linear.x")
    assert [line.label for line in figure.panels[1].lines] == ["/cmd_vel"]
    assert any("not looked for in a_rover, a large file; loss:/topic asks" in note for note in figure.notes)
    figure = plotted("/cmd_vel.linear.x", "loss:/cmd_vel")
    assert figure.panels[1].lines[0].read == 92
    assert not any("not looked for" in note for note in figure.notes)


def test_elements_of_lists():
    path, mission = (
        ROOT / "samples/captures/b_arm_single.pcap",
        ROOT / "samples/missions/single_arm_ground.yaml",
    )
    topic = "/telemetry_joint_state"
    asked = [parse_request(f"{topic}.{item}") for item in ("position", "position[2]")]
    sources = open_recordings([path], Settings((mission,)), Scope())
    whole, one = read_plot(sources, ["arm"], asked, Scope(), bare=True).figure.panels
    rows = edoras_tools.read(path, config=mission)[topic].to_numpy()["position"]
    assert [line.label for line in whole.lines] == [f"position[{place}]" for place in range(7)]
    assert one.title == f"{topic}.position[2]"
    np.testing.assert_array_equal(one.lines[0].values, [row[2] for row in rows])
    np.testing.assert_array_equal(one.lines[0].values, whole.lines[2].values)
    sources = open_recordings([path], Settings((mission,)), Scope())
    with pytest.raises(ConfigError, match=r"position\[7\]: no list of .* has so many elements"):
        read_plot(sources, ["arm"], [parse_request(f"{topic}.position[7]")], Scope(), bare=True)


RAGGED = Ragged(np.array([1, 2, 3, 4, 5]), np.array([0, 2, 2, 5]))


@pytest.mark.parametrize(
    ("values", "there", "index", "found"),
    [
        (np.array([7, 8, 9]), None, None, {None: [(0, 7), (1, 8), (2, 9)]}),
        (np.array([7, 8, 9]), [True, False, True], None, {None: [(0, 7), (2, 9)]}),
        (np.array([[1, 2], [3, 4]]), None, None, {0: [(0, 1), (1, 3)], 1: [(0, 2), (1, 4)]}),
        (np.array([[1, 2], [3, 4]]), None, 1, {1: [(0, 2), (1, 4)]}),
        (RAGGED, None, None, {0: [(0, 1), (2, 3)], 1: [(0, 2), (2, 4)], 2: [(2, 5)]}),
        (RAGGED, None, 1, {1: [(0, 2), (2, 4)]}),
        (RAGGED, None, 9, {9: []}),
    ],
)
def test_numbers_of_columns_and_lists(values, there, index, found):
    column = TableColumn("x", values, None if there is None else np.array(there))
    read = {
        place: list(zip(rows.tolist(), items.tolist(), strict=True))
        for place, rows, items in numbers(column, index)
    }
    assert read == found


def test_values_come_in_the_order_of_time_and_nan_is_counted():
    made = Values()
    made.add(np.array([3.0, 1.0]), np.array([30.0, np.nan]))
    made.add(np.array([2.0, 0.5]), np.array([True, False]))
    line = made.line(1)
    assert (line.seconds.tolist(), line.values.tolist()) == ([0.5, 2.0, 3.0], [0.0, 1.0, 30.0])
    assert (line.read, line.not_finite, line.recording) == (3, 1, 1)


def test_long_lines_are_held_in_bounded_memory_and_keep_their_peaks(monkeypatch):
    monkeypatch.setattr(lines, "_MOST", 1000)
    monkeypatch.setattr(lines, "_COLUMNS", 50)
    made = Values()
    for start in range(0, 20_000, 500):
        values = np.zeros(500)
        values[77] = start
        made.add(np.arange(start, start + 500) / 100, values)
        assert made._count <= 1000
    line = made.line(0)
    assert line.read == 20_000
    assert line.values.max() == 19_500


FIELD, RATE, LOSS = Quantity.FIELD, Quantity.RATE, Quantity.LOSS


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("/cmd_vel", [(FIELD, "/cmd_vel", "", None)]),
        ("cmd_vel.linear.x", [(FIELD, "cmd_vel", "linear.x", None)]),
        ("/robot_*.linear.*", [(FIELD, "/robot_*", "linear.*", None)]),
        ("/imu.covariance[4]", [(FIELD, "/imu", "covariance", 4)]),
        ("/path.poses[3].position.x", [(FIELD, "/path", "poses.position.x", 3)]),
        (
            "/a.b, rate:/c ,loss:/d",
            [(FIELD, "/a", "b", None), (RATE, "/c", "", None), (LOSS, "/d", "", None)],
        ),
    ],
)
def test_requests(text, parts):
    assert [(item.quantity, item.topic, item.field, item.index) for item in parse_request(text)] == parts


@pytest.mark.parametrize("text", [",", "", "speed:/cmd_vel", "rate:", "field:/a", "/a.b[1].c[2]"])
def test_mistakes(text):
    with pytest.raises(ConfigError, match=r"cannot be plotted; write /topic\.field|more than one index"):
        parse_request(text)


def test_a_request_is_told_as_it_was_given():
    assert parse_request("/a.b[1]")[0] == PlotRequest("/a.b[1]", FIELD, "/a", "b", 1)

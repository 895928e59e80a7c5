"""How a request is read."""

import pytest

from edoras_tools.addons.plot.request import PlotRequest, Quantity, parse_request
from edoras_tools.errors import ConfigError

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

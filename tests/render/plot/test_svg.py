"""A plot as SVG, judged by an XML reader."""

from xml.etree import ElementTree as ET

import pytest

from edoras_tools.render.plot.svg import PLOT_WIDTH, plot_svg

NAME = "{http://www.w3.org/2000/svg}"


@pytest.fixture(scope="module")
def root(figure):
    return ET.fromstring(plot_svg(figure))


def test_it_says_what_it_shows_and_loads_nothing(figure, root):
    text = " ".join(root.itertext())
    for words in (
        "/cmd_vel.linear.*",
        "x · bad",
        "messages/s",
        "3 events, 2 drawn",
        "seconds since",
        "a note",
    ):
        assert words in text
    assert "prefers-color-scheme:dark" in text
    assert "href" not in plot_svg(figure)
    assert "url(" not in plot_svg(figure)


def test_lines_stay_inside_and_keep_their_peak(root):
    lines = [item for item in root.iter(f"{NAME}path") if item.get("stroke-linejoin")]
    assert len(lines) == 3, "a line without values is not drawn"
    for item in lines:
        points = [tuple(map(float, point.split())) for point in item.get("d")[1:].split("L")]
        assert all(0 <= x <= PLOT_WIDTH for x, _ in points)
    wave = [float(point.split()[1]) for point in lines[0].get("d")[1:].split("L")]
    assert len(wave) < 5000
    assert min(wave) < sorted(wave)[1] - 50, "one value stands out"
    assert lines[1].get("stroke-dasharray"), "the second recording is dashed"
